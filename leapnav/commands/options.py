"""Options that several commands have: families, policies, and the environment of a policy."""

from __future__ import annotations

import ast
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from leapnav.training.config import AtRest, FamilyName, HorizonName, Moving, ObstaclesName, RobotName

# Literals, so that the help texts show the choices and shells complete them; a test compares them with the packages.
Family = Literal[AtRest, Moving] | str
FamilyOrAll = FamilyName
Robot = RobotName
Horizon = HorizonName
Obstacles = ObstaclesName
PolicyName = (
    Literal[
        "expert",
        "go-to-goal",
        "random",
        "dwa",
        "mppi",
        "lattice",
        "freespace",
        "open",
        "clutter",
        "polygons",
        "rooms",
        "slalom",
        "crossing",
        "crowd",
        "car-clutter",
        "dynamic_unicycle-clutter",
        "all",
        "free-clutter",
        "clutter-lidar",
        "polygons-lidar",
        "rooms-lidar",
        "slalom-lidar",
    ]
    | str
)
EnvironmentOption = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Options of commands that make scenarios."""

    robot: Robot = "unicycle"
    """Model of the robot."""
    horizon: Horizon = "fixed"
    """Fixed or free horizon."""
    obstacles: Obstacles = "cost"
    """Obstacles with a proximity cost, or hard obstacles, which cost nothing."""

    @property
    def task(self) -> dict[str, str]:
        """The options as arguments of functions."""
        return {"robot": self.robot, "horizon": self.horizon, "obstacles": self.obstacles}


@dataclass(frozen=True, kw_only=True)
class FamilyTaskOptions:
    """Options of commands that make scenarios of a family, which may be the file of a bank."""

    robot: Robot | None = None
    """Model of the robot, or JSON of one with other parameters; by default that of the scenarios of a file, otherwise
    the unicycle."""
    horizon: Horizon | None = None
    """Fixed or free horizon; by default that of the scenarios of a file, otherwise fixed."""
    obstacles: Obstacles | None = None
    """Obstacles with a proximity cost (default), or hard obstacles, which cost nothing."""

    @property
    def task(self) -> dict[str, str | None]:
        """The options as arguments of functions."""
        return {"robot": self.robot, "horizon": self.horizon, "obstacles": self.obstacles}


@dataclass(frozen=True, kw_only=True)
class ParallelOptions:
    """Options of commands that use several processes."""

    workers: int = os.cpu_count() or 1
    """Number of processes; the result does not depend on it."""
    dask: str | None = None
    """Address of a Dask scheduler (tcp://host:8786) whose workers are used instead."""

    @property
    def parallel(self) -> dict[str, Any]:
        """The options as arguments of functions."""
        return {"workers": self.workers, "dask": self.dask}


def parse_environment(words: Sequence[str]) -> dict[str, Any] | None:
    """Return the arguments of an environment given as KEY=VALUE; None without any.

    Values are literals of JSON or of Python, or plain text.

    Raises:
        ValueError: a word has no "=", or the argument is unknown.

    """
    from dataclasses import fields

    from leapnav.envs.settings import EnvironmentSettings
    from leapnav.envs.utils.validation import check_choice

    arguments: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise ValueError(f"env: expected KEY=VALUE, such as observation=map, got {word!r}")
        check_choice("env", name, [field.name for field in fields(EnvironmentSettings)])
        arguments[name] = text
        for parse in (json.loads, ast.literal_eval):
            with suppress(ValueError, SyntaxError):
                arguments[name] = parse(text)
                break
    return arguments or None
