"""Demonstrations for an off-policy learner: in the batches of its replay buffer, and in the loss of its actor."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional
from torch.utils.hooks import RemovableHandle

from leapnav.training.actors import mean_action, policy_of
from leapnav.training.cloning import ROBUST, check_observations
from leapnav.training.dataset import Dataset


class DemonstrationReplayBuffer(ReplayBuffer):
    """A replay buffer of which a share of every batch is drawn from demonstrations, which are never overwritten.

    For `SAC(..., replay_buffer_class=DemonstrationReplayBuffer, replay_buffer_kwargs={"dataset": ..., "share": 0.25})`,
    after P. Ball, L. Smith, I. Kostrikov and S. Levine, "Efficient online reinforcement learning with offline data"
    (ICML 2023), where the share is a half.

    Args:
        args, kwargs: of `ReplayBuffer`.
        dataset: the demonstrations.
        share: of a batch that is demonstrations; what the demonstrations lack, rewards, makes them unusable.
        reward_scale: factor of the demonstrations' rewards, as that of the environment's.

    Raises:
        ValueError: no transition of the dataset has a reward, or the share is impossible.

    """

    def __init__(
        self, *args: Any, dataset: Dataset, share: float = 0.25, reward_scale: float = 1.0, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        if not 0 < share < 1:
            raise ValueError(f"share: expected a number in (0, 1), got {share!r}")
        self.share = share
        self.demonstrate(dataset, reward_scale)

    def demonstrate(self, dataset: Dataset, reward_scale: float = 1.0) -> None:
        """Draws from these demonstrations from now on; a buffer that was loaded from a file has none.

        Raises:
            ValueError: no transition of the dataset has a reward.

        """
        last = np.append(dataset.episodes[1:] != dataset.episodes[:-1], True)
        following = np.arange(len(dataset)) + ~last  # after the last step nothing follows, so any observation does
        usable = np.isfinite(dataset.rewards) & np.isfinite(dataset.executed).all(axis=1)
        if not usable.any():
            raise ValueError("dataset: no transition has a reward; demonstrations from `leapnav rollout` have")
        # The dataset's own arrays, of which rows are drawn: copies would be as large again.
        self._demonstrated = dataset, np.flatnonzero(usable), following, last, reward_scale

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """A batch, the demonstrations last.

        Raises:
            ValueError: there is a `VecNormalize`, whose running statistics the demonstrations do not have.

        """
        if env is not None:
            raise ValueError("env: demonstrations cannot be normalised by a VecNormalize; scale the rewards instead")
        count = round(self.share * batch_size)
        driven = super().sample(batch_size - count)
        dataset, usable, following, last, scale = self._demonstrated
        rows = usable[np.random.randint(0, len(usable), size=count)]  # noqa: NPY002 (as for the others)
        demonstrated = (
            dataset.observations[rows],
            dataset.executed[rows],
            dataset.observations[following[rows]],
            last[rows].astype(np.float32)[:, None],
            (scale * dataset.rewards[rows]).astype(np.float32)[:, None],
        )
        pairs = zip(driven[:5], map(self.to_torch, demonstrated), strict=True)
        return ReplayBufferSamples(*(th.cat(pair) for pair in pairs))

    def __getstate__(self) -> dict[str, Any]:
        # A checkpoint need not hold the demonstrations again.
        return {name: value for name, value in self.__dict__.items() if name != "_demonstrated"}


def imitate(
    model: OffPolicyAlgorithm,
    dataset: Dataset | str | os.PathLike[str] | Sequence[Any],
    weight: float,
    batch_size: int = 256,
) -> RemovableHandle:
    """Gives the loss of an off-policy learner's actor a term for its errors where the expert has been.

    After A. Nair et al., "Overcoming exploration in reinforcement learning with demonstrations" (ICRA 2018), and
    S. Fujimoto and S. Gu, "A minimalist approach to offline reinforcement learning" (NeurIPS 2021). Its gradient is
    added before each step of the actor's optimiser, so it goes with SAC, TD3 and their kin as they are; the log has it
    as `train/imitation_loss`.

    Args:
        model: whose actor it is; one that is loaded from a file needs it anew.
        dataset: a `Dataset`, a folder that `leapnav rollout` wrote, or demonstrations.
        weight: of Huber's loss of the actions, beside the values in units of the rewards that the model sees.
        batch_size: demonstrated samples per step.

    Returns:
        What takes the term away again: its method `remove`.

    Raises:
        TypeError: the model is no off-policy algorithm, or has no actor.
        ValueError: the dataset's observations are not the model's, or a number is impossible.

    """
    policy: Any = policy_of(model)
    if not isinstance(cast(object, model), OffPolicyAlgorithm) or not hasattr(policy, "actor"):
        raise TypeError(f"model: expected an off-policy algorithm with an actor, got {type(model).__name__}")
    if not (math.isfinite(weight) and weight > 0):
        raise ValueError(f"weight: expected a positive number, got {weight!r}")
    if batch_size < 1:
        raise ValueError(f"batch_size: expected at least 1, got {batch_size!r}")
    samples = Dataset.of(dataset)
    check_observations(policy, samples)

    def add(*_: Any) -> None:
        # Drawn as the replay buffer draws, so that a resumed run draws the same.
        rows = np.random.randint(0, len(samples), size=batch_size)  # noqa: NPY002
        observations, actions = (
            th.as_tensor(column[rows], dtype=th.float32, device=policy.device)
            for column in (samples.observations, samples.actions)
        )
        with th.enable_grad():
            error = mean_action(policy, observations) - actions
            loss = functional.huber_loss(error, th.zeros_like(error), delta=ROBUST)
            (weight * loss).backward()
        model.logger.record("train/imitation_loss", float(loss.detach()))

    return policy.actor.optimizer.register_step_pre_hook(add)
