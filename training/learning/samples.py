"""The samples of a dataset as tensors."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from leapnav.experts.problem.system import switching_functions
from leapnav.training.learning.dataset import Dataset
from leapnav.training.policies.actors import action_mixture
from leapnav.training.policies.mixture import Mixture
from leapnav.training.policies.symmetries import Transformation

SATURATION = 1.0 - 1e-4  # actions of this absolute value or more are limited by the robot's maximum speed or turn rate


@dataclass(frozen=True)
class Batch:
    """Samples as tensors.

    Attributes:
        observations (B, d): the observations.
        actions (B, m): the expert's actions.
        slopes, weights (B, m): see `action_slopes`; cost weights of the actions.

    """

    observations: th.Tensor
    actions: th.Tensor
    slopes: th.Tensor
    weights: th.Tensor

    def __len__(self) -> int:
        return len(self.actions)

    def mixture_of(self, policy: BasePolicy) -> Mixture:
        """Compute the mixture of the actions of a policy, with gradients."""
        return action_mixture(policy, self.observations)


class Samples:
    """The chosen samples of a dataset.

    Args:
        dataset: the dataset.
        chosen: (N,), bool.
        device: device of the tensors.

    """

    def __init__(self, dataset: Dataset, chosen: np.ndarray, device: th.device) -> None:
        self._rows = th.as_tensor(np.flatnonzero(chosen), device=device)
        self._observations = _tensor(dataset.observations, device)
        columns = dataset.actions, action_slopes(dataset), dataset.weights * dataset.halves**2
        self._columns = [_tensor(column, device) for column in columns]

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def columns(self) -> tuple[th.Tensor, ...]:
        """Actions, slopes and weights of all samples, see `Batch`."""
        return tuple(column[self._rows] for column in self._columns)

    def n_batches(self, size: int) -> int:
        """Return the number of batches of `size` samples in a pass."""
        return math.ceil(len(self) / size)

    def shuffled(self, size: int, rng: th.Generator) -> Iterator[th.Tensor]:
        """Yield what `batch` takes, for one pass over the samples in random order."""
        yield from th.randperm(len(self), generator=rng).split(size)

    def in_order(self, size: int) -> Iterator[th.Tensor]:
        """Yield what `batch` takes, for one pass over the samples in their order."""
        yield from th.arange(len(self)).split(size)

    def batch(self, chosen: th.Tensor, symmetries: Sequence[Transformation] = ()) -> Batch:
        """Return some samples, after transformations by symmetries."""
        rows = self._rows[chosen]
        observations = self._observations[rows]
        actions, slopes, weights = (column[rows] for column in self._columns)
        for transform in symmetries:
            _, slopes = transform(observations[:0], slopes)  # the slopes change sign with the actions
            observations, actions = transform(observations, actions)
        return Batch(observations, actions, slopes, weights)


def _tensor(values: Any, device: th.device) -> th.Tensor:
    return th.as_tensor(np.asarray(values, dtype=np.float32), device=device)


def action_slopes(dataset: Dataset) -> np.ndarray:
    """dH/du (N, m) at the expert's actions, per unit of the action; zero for actions that no limit bounds."""
    p = switching_functions(dataset.settings.model, dataset.states, dataset.costates, dataset.parameters)
    slopes = (p + dataset.weights * dataset.controls) * dataset.halves
    # The expert's action belongs to the middle of the control period, the costate to its beginning. Inside the limits
    # the difference of the two is not meaningful, and at a limit dH/du must point outwards.
    limited = (np.abs(dataset.actions) >= SATURATION) & (slopes * dataset.actions < 0)
    return np.where(limited & np.isfinite(slopes), slopes, 0.0)


def split_courses(dataset: Dataset, fraction: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks (N,) of the training and the validation samples, which have no obstacle course in common.

    A hash of the course decides, so that most courses stay in their part when the dataset grows.
    """
    courses = dataset.course_texts
    hashes = {text: hashlib.blake2b(f"{seed} {text}".encode()).digest() for text in set(courses)}
    held_out = set(sorted(hashes, key=hashes.__getitem__)[: int(fraction * len(hashes))])
    mask = np.array([text in held_out for text in courses])[dataset.episodes]
    return ~mask, mask
