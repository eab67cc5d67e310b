"""Level samplers: which scenarios of a bank a vector environment plays."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank


@dataclass(frozen=True)
class LevelOutcome:
    """The end of an episode in a scenario of a bank.

    Attributes:
        index: index of the scenario in the bank.
        success, collision: outcome.
        episode_return: minus the cost J and the penalties of the episode, without a shaped reward.
        regret: the return of the optimum, -J*, minus that of the episode.

    """

    index: int
    success: bool
    collision: bool
    episode_return: float
    regret: float


class LevelSampler(Protocol):
    """Chooses the scenarios of a vector environment's episodes, see `leapnav.training.RegretSampler`."""

    def draw(self, rng: np.random.Generator) -> int:
        """Return the index in the bank of the scenario of the next episode."""
        ...

    def record(self, outcome: LevelOutcome) -> None:
        """Store the outcome of an episode."""
        ...


def check_sampler(sampler: Any, bank: ScenarioBank | None) -> None:
    """Check that a level sampler has the methods, and is one for a bank.

    Raises:
        TypeError: a method is missing.
        ValueError: the sampler is one for another bank.

    """
    if not all(callable(getattr(sampler, name, None)) for name in ("draw", "record")):
        raise TypeError(f"sampler: expected an object with the methods draw and record, got {sampler!r}")
    own = getattr(sampler, "bank", None)
    if isinstance(own, ScenarioBank) and bank is not None and (own.path, len(own)) != (bank.path, len(bank)):
        raise ValueError(f"sampler: expected one for the bank {bank.path}, got one for {own.path}")


def draw_level(sampler: LevelSampler, rng: np.random.Generator, count: int) -> int:
    """Return the index that a sampler draws.

    Raises:
        IndexError: it is not that of one of the `count` scenarios.

    """
    index = operator.index(sampler.draw(rng))
    if not 0 <= index < count:
        raise IndexError(f"sampler: expected an index of the {count} scenarios of the bank, got {index}")
    return index
