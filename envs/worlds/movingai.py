"""Problems of the Moving AI Lab: maps with start and goal cells from a scenario file.

N. Sturtevant, "Benchmarks for grid-based pathfinding", IEEE Trans. Comput. Intell. AI Games 4 (2012); maps and scenario
files are at https://movingai.com/benchmarks (Open Data Commons Attribution License).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import REFERENCE_SPEED
from leapnav.envs.scenarios.maps import read_movingai
from leapnav.envs.scenarios.scenario import Scenario, check_robot
from leapnav.envs.utils.validation import check_at_least, check_positive


@dataclass(frozen=True)
class GridProblem:
    """A problem of a scenario file.

    Attributes:
        line: number of its line in the file, from 1.
        width, height: size of the map (cells).
        start, goal: column and line of the cells, from the top left corner.
        length: length of the shortest path on the grid (cells).

    """

    line: int
    width: int
    height: int
    start: tuple[int, int]
    goal: tuple[int, int]
    length: float


def read_movingai_problems(
    map_file: str | os.PathLike[str],
    scen_file: str | os.PathLike[str],
    *,
    count: int | None = None,
    cell_size: float = 1.0,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
) -> list[Scenario]:
    """Read problems on a map of the Moving AI Lab as scenarios, in the order of the file.

    The robot starts in the middle of a cell, in the direction of the goal; the heading at the goal is free. The horizon
    is the length of the grid's shortest path divided by 0.8 m/s. Problems whose start is the goal are left out.

    Args:
        map_file: the map (`.map`).
        scen_file: the scenario file (`.map.scen`).
        count: number of problems, evenly spaced in the file; None: all.
        cell_size: side length of a cell (m).
        robot: name of a robot model, a dict of its fields with `model`, or a robot.

    Raises:
        OSError: a file cannot be read.
        ScenarioError: the robot does not fit into a start or goal cell.
        ValueError: a file or an argument is invalid, or the scenario file is for a map of another size; the message
            names the file and the line, or the argument.

    """
    if count is not None:
        check_at_least("count", count, 1)
    check_positive("cell_size", cell_size)
    body = check_robot(robot)
    problems = read_scen(scen_file)
    height, width = read_movingai(map_file).shape
    for problem in problems:
        _check_size(problem, width, height, map_file, scen_file)
    problems = [problem for problem in problems if problem.start != problem.goal]
    if count is not None and count < len(problems):
        problems = [problems[i * len(problems) // count] for i in range(count)]
    return [_scenario(map_file, problem, cell_size, body) for problem in problems]


def read_scen(path: str | os.PathLike[str]) -> list[GridProblem]:
    """Read the problems of a scenario file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a scenario file of version 1; the message names the file and the line.

    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or lines[0].split()[:1] != ["version"]:
        raise ValueError(f"{path}: not a scenario file of the Moving AI Lab: expected a line version")
    problems = []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split("\t") if "\t" in line else line.split()
        if not line.strip():
            continue
        try:
            width, height, *cells = (int(word) for word in words[-7:-1])
            problems.append(
                GridProblem(number, width, height, (cells[0], cells[1]), (cells[2], cells[3]), float(words[-1]))
            )
        except (ValueError, IndexError):
            raise ValueError(
                f"{path}: line {number}: expected bucket, map, width, height, start, goal and length, got {line[:80]!r}"
            ) from None
    return problems


def _check_size(
    problem: GridProblem,
    width: int,
    height: int,
    map_file: str | os.PathLike[str],
    scen_file: str | os.PathLike[str],
) -> None:
    """Raise ValueError if a problem is for a map of another size, or its cells are not on the map."""
    place = f"{scen_file}: line {problem.line}"
    if (problem.width, problem.height) != (width, height):
        raise ValueError(
            f"{place}: expected the size {width} x {height} of {map_file}, got {problem.width} x {problem.height}; "
            "scaled maps are not supported"
        )
    for name, (column, line) in (("start", problem.start), ("goal", problem.goal)):
        if not (0 <= column < width and 0 <= line < height):
            raise ValueError(f"{place}: {name}: expected a cell of the map {width} x {height}, got {column} {line}")


def _scenario(map_file: str | os.PathLike[str], problem: GridProblem, cell_size: float, robot: RobotModel) -> Scenario:
    start, goal = (_centre(cell, problem.height, cell_size) for cell in (problem.start, problem.goal))
    heading = math.atan2(goal[1] - start[1], goal[0] - start[0])
    return Scenario.from_movingai(
        map_file,
        start=(*start, round(heading, 4)),
        goal=(*goal, None),
        horizon=round(max(problem.length, 1.0) * cell_size / REFERENCE_SPEED, 1),
        cell_size=cell_size,
        name=f"{Path(map_file).stem}-{problem.line}",
        robot=robot,
    )


def _centre(cell: Sequence[int], height: int, cell_size: float) -> tuple[float, float]:
    """Return the middle of a cell (m)."""
    column, line = cell
    return (column + 0.5) * cell_size, (height - line - 0.5) * cell_size
