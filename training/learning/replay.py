"""Demonstrations for off-policy algorithms, in the batches of the replay buffer and in the loss of the actor."""

from __future__ import annotations

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

from leapnav.envs.utils.validation import check_at_least, check_fraction, check_positive
from leapnav.training.learning.cloning import HUBER_DELTA, check_observations
from leapnav.training.learning.dataset import Dataset
from leapnav.training.policies.actors import mean_action, policy_of


class DemonstrationReplayBuffer(ReplayBuffer):
    """A replay buffer that draws a fixed fraction of each batch from demonstrations, which are never overwritten.

    Use it as `SAC(..., replay_buffer_class=DemonstrationReplayBuffer, replay_buffer_kwargs={"dataset": ...})`.
    Reference: P. Ball, L. Smith, I. Kostrikov and S. Levine, "Efficient online reinforcement learning with offline
    data" (ICML 2023), with a fraction of 0.5.

    Args:
        args, kwargs: arguments of `ReplayBuffer`.
        dataset: the demonstrations; only transitions with a known reward and executed action are used.
        share: fraction of demonstrations in a batch, in (0, 1).
        reward_scale: factor of the demonstrations' rewards, equal to that of the environment's rewards.

    Raises:
        ValueError: no transition of the dataset has a reward, or `share` is invalid.

    """

    def __init__(
        self, *args: Any, dataset: Dataset, share: float = 0.25, reward_scale: float = 1.0, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        check_fraction("share", share, zero=False, one=False)
        self.share = share
        self.demonstrate(dataset, reward_scale)

    def demonstrate(self, dataset: Dataset, reward_scale: float = 1.0) -> None:
        """Set the demonstrations. A buffer loaded from a file has none and needs this call.

        Args:
            dataset: the demonstrations.
            reward_scale: factor of their rewards.

        Raises:
            ValueError: no transition of the dataset has a reward.

        """
        last = np.append(dataset.episodes[1:] != dataset.episodes[:-1], True)
        following = np.arange(len(dataset)) + ~last  # the last observation of an episode is followed by itself
        usable = np.isfinite(dataset.rewards) & np.isfinite(dataset.executed).all(axis=1)
        if not usable.any():
            raise ValueError("dataset: no transition has a reward; use demonstrations from `leapnav rollout`")
        # Rows are drawn from the arrays of the dataset: a copy would double the memory.
        self._demonstrated = dataset, np.flatnonzero(usable), following, last, reward_scale

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch; its last rows are demonstrations.

        Raises:
            ValueError: `env` is given; its running normalisation cannot be applied to the demonstrations.

        """
        if env is not None:
            raise ValueError("env: demonstrations cannot be normalised by a VecNormalize; scale the rewards instead")
        n_demonstrated = round(self.share * batch_size)
        experience = super().sample(batch_size - n_demonstrated)
        dataset, usable, following, last, scale = self._demonstrated
        rows = usable[np.random.randint(0, len(usable), size=n_demonstrated)]  # noqa: NPY002 (as in the base class)
        demonstrated = (
            dataset.observations[rows],
            dataset.executed[rows],
            dataset.observations[following[rows]],
            last[rows].astype(np.float32)[:, None],
            (scale * dataset.rewards[rows]).astype(np.float32)[:, None],
        )
        pairs = zip(experience[:5], map(self.to_torch, demonstrated), strict=True)
        return ReplayBufferSamples(*(th.cat(pair) for pair in pairs))

    def __getstate__(self) -> dict[str, Any]:
        # Checkpoints do not contain the demonstrations, which exist as a dataset.
        return {name: value for name, value in self.__dict__.items() if name != "_demonstrated"}


def imitate(
    model: OffPolicyAlgorithm,
    dataset: Dataset | str | os.PathLike[str] | Sequence[Any],
    weight: float,
    batch_size: int = 256,
) -> RemovableHandle:
    """Add an imitation term to the loss of an off-policy algorithm's actor.

    The term is the weighted Huber loss between the actor's and the expert's actions on the demonstrations. Its gradient
    is added before each step of the actor's optimiser, so the algorithm itself is unchanged. The logger records the
    loss as `train/imitation_loss`. References: A. Nair et al., "Overcoming exploration in reinforcement learning with
    demonstrations" (ICRA 2018); S. Fujimoto and S. Gu, "A minimalist approach to offline reinforcement learning"
    (NeurIPS 2021).

    Args:
        model: the algorithm. A model loaded from a file needs a new call.
        dataset: a `Dataset`, a directory written by `leapnav rollout`, or demonstrations.
        weight: weight of the term; the other term of the loss is in units of the (scaled) return.
        batch_size: demonstrations per gradient step.

    Returns:
        A handle; its method `remove` removes the term.

    Raises:
        TypeError: the model is not an off-policy algorithm, or has no actor.
        ValueError: the observations of the dataset do not fit the model, or a number is invalid.

    """
    policy: Any = policy_of(model)
    if not isinstance(cast(object, model), OffPolicyAlgorithm) or not hasattr(policy, "actor"):
        raise TypeError(f"model: expected an off-policy algorithm with an actor, got {type(model).__name__}")
    check_positive("weight", weight)
    check_at_least("batch_size", batch_size, 1)
    samples = Dataset.of(dataset)
    check_observations(policy, samples)

    def add_gradient(*_: Any) -> None:
        # The replay buffer uses the same global generator.
        rows = np.random.randint(0, len(samples), size=batch_size)  # noqa: NPY002
        observations, actions = (
            th.as_tensor(column[rows], dtype=th.float32, device=policy.device)
            for column in (samples.observations, samples.actions)
        )
        with th.enable_grad():
            error = mean_action(policy, observations) - actions
            loss = functional.huber_loss(error, th.zeros_like(error), delta=HUBER_DELTA)
            (weight * loss).backward()
        model.logger.record("train/imitation_loss", float(loss.detach()))

    return policy.actor.optimizer.register_step_pre_hook(add_gradient)
