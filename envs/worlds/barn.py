"""The worlds of the BARN challenge: Gazebo worlds in which about 250 cylinders form narrow passages.

D. Perille, A. Truong, X. Xiao, P. Stone, "Benchmarking metric ground navigation", IEEE SSRR (2020). The worlds and the
length of a path through each are part of the challenge's repository, https://github.com/Daffan/the-barn-challenge (MIT
licence), in the directory `jackal_helper/worlds/BARN`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import REFERENCE_SPEED, random_cost
from leapnav.envs.scenarios.scenario import Scenario, check_robot
from leapnav.envs.settings import HORIZONS, OBSTACLE_KINDS
from leapnav.envs.utils.validation import check_choice

# Of the challenge: the pose of the robot at the start, and the goal position; the heading at the goal is free.
START, GOAL = (-2.25, 3.0, 1.57), (-2.25, 13.0)
GOAL_DISTANCE = 1.0  # m from the goal, at which the challenge counts a success
CELL, LEFT, BOTTOM = 0.15, -4.575, 5.075  # m: the grid of the path files, and its position in the world
ORIGIN, LICENCE = "BARN challenge, https://github.com/Daffan/the-barn-challenge", "mit"
PATHS = "path_files"  # directory of the paths, beside the worlds or beside their directory


def read_barn(
    folder: str | os.PathLike[str],
    *,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
    obstacles: str = "cost",
) -> list[Scenario]:
    """Read the worlds of the BARN challenge as scenarios, in the order of their numbers.

    The horizon is the length of the challenge's path divided by 0.8 m/s, or free with the time weight 0.5.

    Args:
        folder: directory of the files `world_N.world`, or one that contains it as a directory named BARN.
        robot: name of a robot model, a dict of its fields with `model`, or a robot.
        horizon: "fixed" or "free".
        obstacles: "cost" or "hard", see `sample_scenario`.

    Raises:
        FileNotFoundError: there are no such files.
        ValueError: a world is invalid, or an argument is; the message names the file or the argument.

    """
    body = check_robot(robot)
    check_choice("horizon", horizon, HORIZONS)
    check_choice("obstacles", obstacles, OBSTACLE_KINDS)
    cost = random_cost(horizon, obstacles)
    paths = _worlds(Path(folder))
    lengths = path_lengths(folder)
    scenarios = []
    for path in paths:
        name = _name(path)
        length = lengths.get(name, math.dist(START[:2], GOAL))
        scenarios.append(
            Scenario.from_discs(
                read_cylinders(path),
                name=name,
                start=START,
                goal=(*GOAL, None),
                horizon=None if horizon == "free" else round(length / REFERENCE_SPEED, 1),
                cost=cost,
                robot=body,
            )
        )
    return scenarios


def path_lengths(folder: str | os.PathLike[str]) -> dict[str, float]:
    """Return the lengths (m) of the challenge's paths from the start to the goal, by the names of the scenarios.

    Args:
        folder: see `read_barn`. A world without a path file has no entry.

    Raises:
        FileNotFoundError: there are no worlds.
        ValueError: a file is not an array of points.

    """
    lengths = {}
    for world in _worlds(Path(folder)):
        number = world.stem.rpartition("_")[2]
        for path in (place / PATHS / f"path_{number}.npy" for place in (world.parent, world.parent.parent)):
            if path.is_file():
                lengths[_name(world)] = _length(path)
                break
    return lengths


def read_cylinders(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the cylinders (n, 3) of a Gazebo world as discs: x, y and radius (m).

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a Gazebo world with cylinders.

    """
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not a Gazebo world: {error}") from None
    discs = []
    for model in root.iterfind("world/model"):
        radius = model.findtext("link/collision/geometry/cylinder/radius")
        if radius is None:
            continue
        pose = (model.findtext("pose") or "0 0").split()
        try:
            discs.append((float(pose[0]), float(pose[1]), float(radius)))
        except (ValueError, IndexError):
            name = model.get("name")
            raise ValueError(f"{path}: model {name!r}: expected numbers, got {pose} and {radius!r}") from None
    if not discs:
        raise ValueError(f"{path}: expected a Gazebo world with cylinders, found none")
    return np.array(discs)


def _worlds(folder: Path) -> list[Path]:
    """Return the files of the worlds, in the order of their numbers."""
    found = list(folder.glob("world_*.world")) or list(folder.glob("**/BARN/world_*.world"))
    numbered = [(int(path.stem.rpartition("_")[2]), path) for path in found if _name(path)[5:].isdecimal()]
    if not numbered:
        raise FileNotFoundError(f"{folder}: expected files world_N.world, as in the directory BARN of the challenge")
    return [path for _, path in sorted(numbered)]


def _name(path: Path) -> str:
    return f"barn-{path.stem.rpartition('_')[2]}"


def _length(path: Path) -> float:
    try:
        cells = np.load(path, allow_pickle=False).astype(float).reshape(-1, 2)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected an array of points (n, 2): {error}") from None
    points = np.vstack([START[:2], cells * CELL + (LEFT, BOTTOM), GOAL])
    return float(np.hypot(*np.diff(points, axis=0).T).sum())
