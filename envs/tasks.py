"""Where episodes get their scenarios from."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import ALL, check_family, sample_scenario
from leapnav.envs.scenario import Scenario, ScenarioError

SPLITS = ("train", "test", "fresh")


class Tasks:
    """The choice of scenarios, as `NavigateEnv` documents it.

    Raises:
        ValueError: unknown or contradictory arguments.
        ScenarioError: `scenario` is not a valid one.
        FileNotFoundError, BankError: see `ScenarioBank`.

    """

    def __init__(
        self,
        family: str = "clutter",
        scenario: Scenario | Mapping[str, Any] | str | None = None,
        split: str | None = None,
        bank: ScenarioBank | str | os.PathLike[str] | None = None,
    ) -> None:
        check_family(family)
        arguments = (("scenario", scenario), ("split", split), ("bank", bank))
        given = [name for name, value in arguments if value is not None]
        if len(given) > 1:
            raise ValueError(f"{given[1]}: cannot be combined with {given[0]}")
        if split is not None and split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}")
        if family == ALL and split not in (None, "fresh"):
            raise ValueError(f"split: all families together have 'fresh' scenarios only, got {split!r}")
        self.family = family
        self.scenario = None if scenario is None else as_scenario(scenario)
        self.bank: ScenarioBank | None = None
        if bank is not None:
            if not isinstance(bank, (ScenarioBank, str, os.PathLike)):
                raise ValueError(f"bank: expected a ScenarioBank or its file, got {bank!r}")
            self.bank = bank if isinstance(bank, ScenarioBank) else ScenarioBank(bank)
            if len(self.bank) == 0:
                raise ValueError(f"bank: expected at least one scenario, {self.bank.path} has none")
        elif scenario is None and split != "fresh" and family != ALL:
            self.bank = ScenarioBank.shipped(family, split or "train")

    def given(self, scenario: Any = None, index: Any = None) -> Scenario | int | None:
        """The scenario that the options of a reset ask for, or its number in the bank; None if they ask for none.

        Raises:
            ValueError, ScenarioError, IndexError: there is no such scenario.

        """
        if index is not None and (scenario is not None or self.bank is None):
            raise ValueError(f"options: 'index' needs a bank and no 'scenario', got {index!r}")
        if scenario is not None:
            return as_scenario(scenario)
        if index is None or self.bank is None:
            return None
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)):
            raise ValueError(f"options: index: expected an integer, got {index!r}")
        if not -len(self.bank) <= index < len(self.bank):
            raise IndexError(f"options: index: {self.bank.path.name} has {len(self.bank)} scenarios, got {index}")
        return int(index) % len(self.bank)

    def draw(self, rng: np.random.Generator) -> Scenario | int:
        """An episode's scenario, or its number in the bank, where the options ask for none."""
        if self.bank is not None:
            return int(rng.integers(len(self.bank)))
        return sample_scenario(self.family, rng) if self.scenario is None else self.scenario


def as_scenario(value: Scenario | Mapping[str, Any] | str) -> Scenario:
    """A scenario from any of the forms that the environments take.

    Raises:
        ScenarioError: it is none.

    """
    if isinstance(value, Scenario):
        return value
    if isinstance(value, Mapping):
        return Scenario.from_dict(dict(value))
    if isinstance(value, str):  # as datasets store it
        return Scenario.from_json(value)
    raise ScenarioError(f"scenario: expected a Scenario, a dict or JSON text, got {type(value).__name__}")


def scenario_of(choice: Scenario | int, bank: ScenarioBank | None) -> Scenario:
    """A chosen scenario, taken from the bank if a number was chosen."""
    if isinstance(choice, Scenario):
        return choice
    assert bank is not None  # numbers are of a bank
    return bank[choice]
