"""Behaviour cloning: a policy fitted to the expert's actions by regression."""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch.nn import functional
from tqdm.auto import tqdm

from leapnav.envs.observations import GOAL_ENTRIES
from leapnav.experts.demonstrations import Demonstration
from leapnav.training.actors import actor_parameters, mean_action, policy_of, set_noise, update_target
from leapnav.training.config import CloningConfig
from leapnav.training.dataset import Dataset
from leapnav.training.symmetries import mirror, turn_round

WARM_UP = 200  # steps over which the learning rate rises
SMALLEST_STD = 0.01  # of the fitted action noise
LARGEST_NORM = 1.0  # of the gradient, longer ones are shortened
AT_THE_LIMIT = 1.0 - 1e-4  # an action beyond it is one that the robot's limit cuts off
EVALUATION_BATCH = 65_536
ROBUST = 0.05  # in units of the actions; errors beyond it count by their length, not by its square


@dataclass(frozen=True)
class EpochLoss:
    """The loss after an epoch: on the training samples (their mean during the epoch) and on those held out.

    In units of what the mean action would lose, so 1 is no better than that; NaN without validation.
    """

    epoch: int
    training: float
    validation: float


def behaviour_clone(
    model: BaseAlgorithm | BasePolicy,
    dataset: Dataset | str | os.PathLike[str] | Sequence[Demonstration],
    config: CloningConfig | None = None,
    *,
    progress: bool = True,
    on_epoch: Callable[[EpochLoss], None] | None = None,
) -> list[EpochLoss]:
    """Fits the policy's mean action to the expert's, in place, and its noise to what error remains.

    The same model, dataset and configuration give the same weights on the same machine, and the global generators stay
    as they are.

    Args:
        model: an algorithm of Stable-Baselines3 with continuous actions (PPO, A2C, SAC, TQC, TD3, ...) or its policy.
        dataset: a `Dataset`, a folder that `leapnav rollout` wrote, or demonstrations.
        config: settings, see there.
        progress: show a progress bar.
        on_epoch: called after each epoch.

    Raises:
        FileNotFoundError: there is no such dataset.
        ValueError: the dataset is empty, damaged or of other observations, or a setting is impossible.

    """
    fit = Cloning(policy_of(model), Dataset.of(dataset), config or CloningConfig())
    total = fit.config.epochs * fit.batches
    with tqdm(total=total, desc="Cloning", unit="batch", disable=not progress) as bar:
        while not fit.finished:
            loss = fit.run_epoch(bar.update)
            bar.set_postfix(training=f"{loss.training:.4f}", validation=f"{loss.validation:.4f}")
            if on_epoch is not None:
                on_epoch(loss)
    fit.finish()
    return fit.losses


class Cloning:
    """A fit, epoch by epoch, that can be put aside and taken up again exactly.

    Args:
        policy: what is fitted, in place.
        dataset: what it is fitted to.
        config: settings.
        stream: of the order of the samples and the twins; the split is the same for all.

    Attributes:
        losses: of the epochs so far.

    Raises:
        ValueError: the dataset has other observations than the policy, or a setting is impossible.

    """

    def __init__(self, policy: BasePolicy, dataset: Dataset, config: CloningConfig, stream: int = 0) -> None:
        check_cloning(config)
        check_observations(policy, dataset)
        beams = dataset.observations.shape[1] - GOAL_ENTRIES
        if config.augment and beams % 2:
            raise ValueError(f"augment: turning round needs an even number of lidar beams, got {beams}")
        self.config, self.losses = config, []
        self._policy = policy
        self._rng = th.Generator().manual_seed(config.seed + stream)
        train, held_out = _split(dataset, config.validation_share, config.seed)
        self._train, self._held_out = (_Samples(dataset, chosen, policy.device) for chosen in (train, held_out))
        self._scale = _scale(self._train, config.loss)
        parameters = actor_parameters(policy)
        self._optimiser = th.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
        self.batches = math.ceil(len(self._train) / config.batch_size)
        self._step = 0
        self._best: tuple[float, dict[str, th.Tensor]] | None = None

    @property
    def finished(self) -> bool:
        """Whether all epochs have run, or the validation loss has not fallen for long enough."""
        done, patience = len(self.losses), self.config.patience
        if done >= self.config.epochs:
            return True
        validation = [loss.validation for loss in self.losses]
        return bool(patience and done > patience and min(validation[:-patience]) <= min(validation[-patience:]))

    def run_epoch(self, on_batch: Callable[[], Any] = lambda: None) -> EpochLoss:
        """Goes through the samples once."""
        config, summed = self.config, 0.0
        self._policy.set_training_mode(True)
        order = th.randperm(len(self._train), generator=self._rng)
        for chosen in order.split(config.batch_size):
            for group in self._optimiser.param_groups:
                decay = 0.5 * (1 + math.cos(math.pi * self._step / (config.epochs * self.batches)))
                group["lr"] = config.learning_rate * min(1.0, (self._step + 1) / WARM_UP) * decay
            loss = self._loss(self._train.twins(chosen, self._rng) if config.augment else self._train.at(chosen))
            if not th.isfinite(loss):
                raise ValueError(
                    f"learning_rate: the fit diverged in epoch {len(self.losses) + 1} at {config.learning_rate!r}"
                )
            self._optimiser.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(actor_parameters(self._policy), LARGEST_NORM)
            self._optimiser.step()
            summed += float(loss.detach()) * len(chosen)
            self._step += 1
            on_batch()
        self._policy.set_training_mode(False)
        found = EpochLoss(len(self.losses) + 1, summed / len(self._train), self._validation())
        # Without anything held out the last epoch is the best.
        if self._best is None or found.validation < self._best[0] or not len(self._held_out):
            self._best = (found.validation, copy.deepcopy(self._policy.state_dict()))
        self.losses.append(found)
        return found

    def finish(self) -> None:
        """Gives the policy the weights of the best epoch, and the noise of the error that remains."""
        if self._best is not None:
            self._policy.load_state_dict(self._best[1])
        samples = self._held_out if len(self._held_out) else self._train
        with th.no_grad():
            squares = [
                (mean_action(self._policy, part[0]) - part[1]).square().sum(dim=0)
                for part in samples.parts(EVALUATION_BATCH)
            ]
        set_noise(self._policy, (th.stack(squares).sum(dim=0) / len(samples)).sqrt().clamp(min=SMALLEST_STD))
        update_target(self._policy)

    def state_dict(self) -> dict[str, Any]:
        """All that the rest of the fit depends on, besides policy, dataset and settings: tensors and numbers only."""
        return {
            "optimiser": self._optimiser.state_dict(),
            "rng": self._rng.get_state(),
            "step": self._step,
            "losses": [(loss.epoch, loss.training, loss.validation) for loss in self.losses],
            "best": self._best,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up the fit that `state_dict` described; the policy's weights are the caller's business."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._rng.set_state(state["rng"])
        self._step = state["step"]
        self.losses = [EpochLoss(*loss) for loss in state["losses"]]
        self._best = state["best"]

    def _loss(self, samples: tuple[th.Tensor, ...]) -> th.Tensor:
        observations, actions, slopes, weights = samples
        error = mean_action(self._policy, observations) - actions
        return (
            (_action_loss(error) if self.config.loss == "action" else _hamiltonian_loss(error, slopes, weights))
            .mul(self._scale)
            .sum(dim=1)
            .mean()
        )

    def _validation(self) -> float:
        if not len(self._held_out):
            return math.nan
        with th.no_grad():
            losses = [float(self._loss(part)) * len(part[0]) for part in self._held_out.parts(EVALUATION_BATCH)]
        return sum(losses) / len(self._held_out)


class _Samples:
    """What the losses need, as tensors: observations, actions, slopes and weights, see `_hamiltonian_loss`."""

    def __init__(self, dataset: Dataset, chosen: np.ndarray, device: th.device) -> None:
        columns = dataset.observations, dataset.actions, action_slopes(dataset), dataset.weights * dataset.limits**2
        self._columns = tuple(th.as_tensor(np.asarray(c[chosen], dtype=np.float32), device=device) for c in columns)

    def __len__(self) -> int:
        return len(self._columns[0])

    @property
    def columns(self) -> tuple[th.Tensor, ...]:
        return self._columns

    def at(self, chosen: th.Tensor) -> tuple[th.Tensor, ...]:
        return tuple(column[chosen] for column in self._columns)

    def parts(self, size: int) -> list[tuple[th.Tensor, ...]]:
        return list(zip(*(column.split(size) for column in self._columns), strict=True))

    def twins(self, chosen: th.Tensor, rng: th.Generator) -> tuple[th.Tensor, ...]:
        """The samples, or all of them seen in one of the task's symmetries."""
        observations, actions, slopes, weights = self.at(chosen)
        twin = int(th.randint(4, (1,), generator=rng))
        for bit, transform in ((1, mirror), (2, turn_round)):
            if twin & bit:
                _, slopes = transform(observations, slopes)  # what belongs to an action changes its sign with it
                observations, actions = transform(observations, actions)
        return observations, actions, slopes, weights


def _action_loss(error: th.Tensor) -> th.Tensor:
    """Huber's: squares for small errors, but only lengths for large ones.

    Where the way round an obstacle is a matter of millimetres, the mean of both sides, which squares would find, leads
    into it; the median leads round it.
    """
    return functional.huber_loss(error, th.zeros_like(error), reduction="none", delta=ROBUST)


def _hamiltonian_loss(error: th.Tensor, slopes: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """H(q, lambda, u) - H(q, lambda, u*) for each component of the action: what an error costs per second.

    With H = 1/2 u'Ru + Phi + lambda'(a + Bu) and p = B'lambda it is 1/2 r e^2 + (p + r u*) e for the error e of a
    control. Where u* minimises H inside the robot's limits the second term vanishes; on a limit it is what the costate
    says that staying away from the limit costs. Beyond the limit nothing is gained.

    Args:
        error, slopes, weights (B, 2): in units of the actions; slopes are p + r u*.

    """
    return 0.5 * weights * error.square() + functional.relu(slopes * error)


def action_slopes(dataset: Dataset) -> np.ndarray:
    """dH/du (N, 2) at the expert's actions, in units of the actions; zero unless a limit cuts them off."""
    heading = dataset.states[:, 2]
    costates = dataset.costates
    p = np.stack([np.cos(heading) * costates[:, 0] + np.sin(heading) * costates[:, 1], costates[:, 2]], axis=1)
    slopes = (p + dataset.weights * dataset.limits * dataset.actions) * dataset.limits
    # The expert's action is that of the middle of the control period, the costate that of its beginning; inside the
    # limits what the two leave over means nothing, and beyond them the slope must push outwards.
    limited = (np.abs(dataset.actions) >= AT_THE_LIMIT) & (slopes * dataset.actions < 0)
    return np.where(limited & np.isfinite(slopes), slopes, 0.0)


def _scale(samples: _Samples, loss: str) -> th.Tensor:
    """Factors (2,) of the loss's components, so that the mean action would have the loss 1."""
    _, actions, slopes, weights = samples.columns
    error = actions.mean(dim=0) - actions
    if loss == "action":
        return 0.5 / _action_loss(error).mean(dim=0).clamp(min=1e-6)
    return (1.0 / _hamiltonian_loss(error, slopes, weights).sum(dim=1).mean()).clamp(max=1e6).repeat(2)


def _split(dataset: Dataset, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks (N,) of the training and the validation samples; no obstacle course is in both.

    Which courses are held out hangs on what they are, so that those of a dataset that grows mostly stay the same.
    """
    courses = dataset.course_texts
    drawn = {text: hashlib.blake2b(f"{seed} {text}".encode()).digest() for text in set(courses)}
    held_out = set(sorted(drawn, key=drawn.__getitem__)[: int(share * len(drawn))])
    mask = np.array([text in held_out for text in courses])[dataset.episodes]
    return ~mask, mask


def check_observations(policy: BasePolicy, dataset: Dataset) -> None:
    """Checks that a dataset's observations are of the length that a policy observes.

    Raises:
        ValueError: they are not.

    """
    shape, width = policy.observation_space.shape, dataset.observations.shape[1]
    if shape != (width,):
        expected = "a dict" if shape is None else " x ".join(map(str, shape))
        raise ValueError(f"dataset: its observations have {width} numbers, the policy's {expected}")


def check_cloning(config: CloningConfig) -> None:
    """Checks the settings of a fit.

    Raises:
        ValueError: one is impossible; the message names it and its value.

    """
    for name in ("epochs", "batch_size", "learning_rate"):
        if not (math.isfinite(getattr(config, name)) and getattr(config, name) > 0):
            raise ValueError(f"{name}: expected a positive number, got {getattr(config, name)!r}")
    for name in ("weight_decay", "patience"):
        if not (math.isfinite(getattr(config, name)) and getattr(config, name) >= 0):
            raise ValueError(f"{name}: expected a number >= 0, got {getattr(config, name)!r}")
    if not 0 <= config.seed < 2**63:
        raise ValueError(f"seed: expected a number from 0 to 2^63 - 1, got {config.seed!r}")
    if not 0 <= config.validation_share < 1:
        raise ValueError(f"validation_share: expected a number in [0, 1), got {config.validation_share!r}")
    if config.loss not in ("action", "hamiltonian"):
        raise ValueError(f"loss: expected action or hamiltonian, got {config.loss!r}")
