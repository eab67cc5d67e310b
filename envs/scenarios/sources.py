"""Sources of the scenarios of an environment's episodes, and level samplers, which choose among those of a bank."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import (
    ALL,
    CustomFamily,
    find_family,
    has_moving_obstacles,
    sample_scenario,
    task_of,
)
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import Disturbance, Motor
from leapnav.envs.utils.validation import check_choice, is_integer

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

SPLITS = ("train", "test", "fresh")
DEFAULT_FAMILY = "clutter"


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


class ScenarioSource:
    """The source of an environment's scenarios: a fixed scenario, a bank, or a family.

    Args:
        family, scenario, split, bank, robot, horizon, obstacles: see `NavigateEnv`.

    Attributes:
        robot, horizon, obstacles: the robot and the kinds of horizon and obstacles of new scenarios; those of the bank
            or of the fixed scenario if one is given.
        family: name of the family; that of the bank if a bank is given. A family that is not built in has fresh
            scenarios only.
        scenario: the fixed scenario, or None.
        bank: the scenario bank, or None.

    Raises:
        ValueError: unknown or contradictory arguments.
        ScenarioError: `scenario` is invalid.
        FileNotFoundError, BankError: see `ScenarioBank`.

    """

    _custom: CustomFamily | None = None
    obstacles: str = "cost"

    def __init__(
        self,
        family: str | None = None,
        scenario: Scenario | Mapping[str, Any] | str | None = None,
        split: str | None = None,
        bank: ScenarioBank | str | os.PathLike[str] | None = None,
        robot: RobotModel | Mapping[str, Any] | str | None = None,
        horizon: str | None = None,
        obstacles: str | None = None,
    ) -> None:
        known_family = find_family(DEFAULT_FAMILY if family is None else family)
        arguments = (("scenario", scenario), ("bank", bank), ("split", split), ("family", family))
        given = [name for name, value in arguments if value is not None]
        if len(given) > 1 and given[0] in ("scenario", "bank"):
            raise ValueError(f"{given[1]}: cannot be combined with {given[0]}; pass one of the two")
        if split is not None:
            check_choice("split", split, SPLITS)
        if family == ALL and split not in (None, "fresh"):
            raise ValueError(f"split: all families together have 'fresh' scenarios only, got {split!r}")
        if isinstance(known_family, CustomFamily) and split not in (None, "fresh"):
            raise ValueError(
                f"split: the family {family!r} has 'fresh' scenarios only, got {split!r}; build a bank and pass bank="
            )
        self.family = family = family or DEFAULT_FAMILY
        self._custom = known_family if isinstance(known_family, CustomFamily) else None
        self.scenario = None if scenario is None else as_scenario(scenario)
        self.bank: ScenarioBank | None = None
        if bank is not None:
            if not isinstance(bank, (ScenarioBank, str, os.PathLike)):
                raise ValueError(f"bank: expected a ScenarioBank or its file, got {bank!r}")
            self.bank = bank if isinstance(bank, ScenarioBank) else ScenarioBank(bank)
            self.family = self.bank.family
            if len(self.bank) == 0:
                raise ValueError(f"bank: expected at least one scenario, {self.bank.path} has none")
        chosen, *new_kinds = task_of(known_family, robot, horizon, obstacles)
        if self.bank is None and scenario is None and split != "fresh" and family != ALL and self._custom is None:
            self.bank = _shipped_bank(family, split, chosen, *new_kinds)
        given_by = (
            self.scenario.robot if self.scenario is not None else self.bank.robot if self.bank is not None else None
        )
        place = "scenario" if self.scenario is not None else "bank"
        # A name selects the model only.
        agrees = given_by is None or (given_by.model == robot if isinstance(robot, str) else given_by == chosen)
        if robot is not None and not agrees:
            raise ValueError(f"robot: expected that of the {place}, {given_by!r}, got {chosen!r}")
        self.robot: RobotModel = given_by or chosen
        kinds: tuple[str, str] | None = None
        if self.scenario is not None:
            kinds = self.scenario.horizon_kind, self.scenario.cost.obstacles
        elif self.bank is not None:
            kinds = self.bank.horizon, self.bank.obstacles
        if kinds is not None:
            for name, kind, known in zip(("horizon", "obstacles"), (horizon, obstacles), kinds, strict=True):
                if kind not in (None, known):
                    raise ValueError(f"{name}: expected that of the {place}, {known!r}, got {kind!r}")
        self.horizon, self.obstacles = kinds or new_kinds

    @property
    def moves(self) -> bool:
        """Whether obstacles move by themselves: those of the fixed scenario, of the bank's first one or of the family.

        Of a family that is not built in it is not known, and False.
        """
        if self.scenario is not None:
            return self.scenario.moves
        return has_moving_obstacles(self.family) if self.bank is None else self.bank[0].moves

    def select(self, scenario: Any = None, index: Any = None) -> Scenario | int | None:
        """Return the scenario that the options of a reset select, or its index in the bank; None without a selection.

        Raises:
            ValueError, ScenarioError, IndexError: there is no such scenario.

        """
        if index is not None and (scenario is not None or self.bank is None):
            raise ValueError(f"options: 'index' needs a bank and no 'scenario', got {index!r}")
        if scenario is not None:
            return as_scenario(scenario)
        if index is None or self.bank is None:
            return None
        if not is_integer(index):
            raise ValueError(f"options: index: expected an integer, got {index!r}")
        if not -len(self.bank) <= index < len(self.bank):
            raise IndexError(f"options: index: {self.bank.path.name} has {len(self.bank)} scenarios, got {index}")
        return int(index) % len(self.bank)

    def draw(self, rng: np.random.Generator) -> Scenario | int:
        """Sample the scenario of an episode, or its index in the bank."""
        if self.bank is not None:
            return int(rng.integers(len(self.bank)))
        if self.scenario is not None:
            return self.scenario
        return sample_scenario(self._custom or self.family, rng, self.robot, self.horizon, self.obstacles)


def _shipped_bank(
    family: str, split: str | None, robot: RobotModel, horizon: str, obstacles: str
) -> ScenarioBank | None:
    """Return the included bank of a family for a robot and kinds of horizon and obstacles, or None for fresh scenarios.

    Raises:
        ValueError: a split is given, and there is no included bank.

    """
    names = ScenarioBank.shipped_families(robot.model, horizon, obstacles, split or "train")
    if family in names and robot == type(robot)():
        return ScenarioBank.shipped(family, split or "train", robot.model, horizon, obstacles)
    if split is not None:
        reason = f"for {', '.join(names)}" if names else "for no family"
        which = f"{robot.model!r}" if robot == type(robot)() else f"{robot.model!r} with these parameters"
        if horizon != "fixed":
            which += f" with a {horizon} horizon"
        if obstacles != "cost":
            which += f" with {obstacles} obstacles"
        if robot != type(robot)():
            reason = "for the default parameters only"
        raise ValueError(f"split: the robot {which} has included banks {reason}, got {split!r} of {family!r}")
    return None


def as_scenario(value: Scenario | Mapping[str, Any] | str | os.PathLike[str]) -> Scenario:
    """Return a scenario given in any of the forms that the environments accept.

    Raises:
        ScenarioError: it is invalid.

    """
    if isinstance(value, Scenario):
        return value
    if isinstance(value, Mapping):
        return Scenario.from_dict(dict(value))
    if isinstance(value, str | os.PathLike):  # datasets store the text
        return Scenario.from_json(value if isinstance(value, str) else Path(value))
    raise ScenarioError(f"scenario: expected a Scenario, a dict, JSON text or a file, got {type(value).__name__}")


def get_scenario(choice: Scenario | int, bank: ScenarioBank | None) -> Scenario:
    """Return a selected scenario; an index is looked up in the bank."""
    if isinstance(choice, Scenario):
        return choice
    assert bank is not None  # an index always refers to a bank
    return bank[choice]


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


def draw_level(source: ScenarioSource, sampler: LevelSampler | None, rng: np.random.Generator) -> Scenario | int:
    """Return the scenario of an episode, or its index in the bank, that a sampler draws; without one, the source.

    Raises:
        IndexError: the sampler draws another index than that of a scenario of the bank.

    """
    if sampler is None:
        return source.draw(rng)
    index, count = operator.index(sampler.draw(rng)), len(source.bank or ())
    if not 0 <= index < count:
        raise IndexError(f"sampler: expected an index of the {count} scenarios of the bank, got {index}")
    return index


class WithSpec:
    """Mixin of the environments, single and vector: a `spec` that `EnvSpec.to_json` can write.

    The objects among the arguments, such as a scenario or a robot, are stored in the form of dicts and names, which the
    environments accept as well.
    """

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The specification with which `gymnasium.make` has created the environment, or None."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else replace(spec, kwargs=to_json_value(spec.kwargs))


def to_json_value(value: Any) -> Any:
    """Return an argument of an environment as a value of JSON that has the same meaning for the environment."""
    match value:
        case Scenario():
            return value.to_dict()
        case RobotModel():
            return value.model_dump(mode="json", exclude_none=True)
        case Disturbance() | Motor():
            return to_json_value(asdict(value))
        case ScenarioBank():
            return str(value.path)
        case os.PathLike():
            return os.fspath(value)
        case Enum():
            return value.value
        case np.generic():
            return value.item()
        case Mapping():
            return {key: to_json_value(item) for key, item in value.items()}
        case list() | tuple():
            return [to_json_value(item) for item in value]
        case _:
            return value


def reference_infos(choice: Scenario | int, bank: ScenarioBank) -> dict[str, Any]:
    """Return what the info of an episode contains of its scenario in a bank."""
    if not isinstance(choice, int):
        return {"index": -1, "reference_cost": math.nan, "lower_bound": -math.inf}
    cost, bound = float(bank.costs[choice]), float(bank.lower_bounds[choice])
    return {"index": choice, "reference_cost": cost, "lower_bound": -math.inf if math.isnan(bound) else bound}
