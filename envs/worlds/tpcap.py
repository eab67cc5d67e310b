"""The cases of the Trajectory Planning Competition of Automated Parking (TPCAP): a car among polygons.

B. Li et al., "Trajectory planning competition of automated parking", IEEE ITSC (2022), https://www.tpcap.net. A file
`CaseN.csv` contains, in one line, the poses (x, y, heading) at the start and at the goal, the number of obstacles, the
number of vertices of each, and the vertices.
"""

from __future__ import annotations

import math
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
from pymunk.autogeometry import convex_decomposition

from leapnav.envs.robots import Box, DynamicCar
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Polygon

# The car of the competition: dimensions (m) from the middle of the rear axle, and limits (m/s, m/s^2, rad, rad/s).
WHEELBASE, FRONT_OVERHANG, REAR_OVERHANG, WIDTH = 2.8, 0.96, 0.929, 1.942
MAX_SPEED, MAX_ACCELERATION, MAX_STEERING, MAX_STEERING_RATE = 2.5, 1.0, 0.75, 0.5
MARGIN = 8.0  # m around start and goal, which is the area of the competition
PROXIMITY_WEIGHT, PROXIMITY_SCALE = 1.0, 0.05
CASE = "Case"


def read_tpcap(folder: str | os.PathLike[str]) -> list[Scenario]:
    """Read the cases of the competition as scenarios with a free horizon, in the order of their numbers.

    The car starts at rest and is at rest at the goal; its steering is free there.
    Obstacles that are not convex are divided into convex polygons.

    Args:
        folder: directory of the files `CaseN.csv`.

    Raises:
        FileNotFoundError: there are no such files.
        ScenarioError: the car touches an obstacle at the start or at the goal.
        ValueError: a file is not a case; the message names the file.

    """
    paths = [path for path in Path(folder).glob(f"{CASE}*.csv") if path.stem.removeprefix(CASE).isdecimal()]
    if not paths:
        raise FileNotFoundError(f"{folder}: expected files {CASE}N.csv, as in the cases of the competition")
    return [_scenario(path) for path in sorted(paths, key=lambda path: int(path.stem.removeprefix(CASE)))]


def _scenario(path: Path) -> Scenario:
    text = path.read_text(encoding="utf-8")
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
        count = int(values[6])
        sizes = [int(value) for value in values[7 : 7 + count]]
        points = np.reshape(values[7 + count :], (-1, 2))
    except (ValueError, IndexError):
        raise ValueError(f"{path}: expected two poses, numbers of vertices, and vertices, got {text[:80]!r}") from None
    if len(sizes) != count or sum(sizes) != len(points):
        raise ValueError(f"{path}: expected {sum(sizes)} vertices of {count} obstacles, got {len(points)}")
    ends = np.cumsum([0, *sizes])
    parts = [part for a, b in pairwise(ends.tolist()) for part in convex_parts(points[a:b])]
    start, goal = values[:3], values[3:6]
    low, high = np.minimum(start[:2], goal[:2]) - MARGIN, np.maximum(start[:2], goal[:2]) + MARGIN
    car = DynamicCar(
        footprint=Box(
            length=WHEELBASE + FRONT_OVERHANG + REAR_OVERHANG,
            width=WIDTH,
            offset=(WHEELBASE + FRONT_OVERHANG - REAR_OVERHANG) / 2,
        ),
        wheelbase=WHEELBASE,
        max_steering=MAX_STEERING,
        max_speed=MAX_SPEED,
        max_acceleration=MAX_ACCELERATION,
        acceleration_weight=1.0 / MAX_ACCELERATION**2,
        # The steering angle changes at most tan(max_steering) times as fast as the steering state.
        max_steering_rate=MAX_STEERING_RATE / math.tan(MAX_STEERING),
        steering_weight=1.0,
    )
    return Scenario(
        name=f"tpcap-{path.stem.removeprefix(CASE)}",
        arena=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        robot=car,
        start=(start[0], start[1], math.remainder(start[2], 2 * math.pi)),
        goal=(goal[0], goal[1], math.remainder(goal[2], 2 * math.pi)),
        horizon=None,
        obstacles=tuple(Obstacle(polygon=Polygon(vertices=tuple(map(tuple, part.tolist())))) for part in parts),
        cost=Cost(
            time_weight=1.0,
            speed_weight=1.0 / MAX_SPEED**2,
            proximity_weight=PROXIMITY_WEIGHT,
            proximity_scale=PROXIMITY_SCALE,
        ),
    )


def convex_parts(vertices: np.ndarray) -> list[np.ndarray]:
    """Return convex polygons (k, 2) that cover a simple polygon (n, 2), which is one itself if it is convex.

    Repeated vertices, and those on a straight line between their neighbours, are left out.
    """
    vertices = vertices[(vertices != np.roll(vertices, 1, axis=0)).any(axis=1)]
    before, after = vertices - np.roll(vertices, 1, axis=0), np.roll(vertices, -1, axis=0) - vertices
    vertices = vertices[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]]
    x, y = vertices.T
    if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):  # clockwise
        vertices = vertices[::-1]
    points = vertices.tolist()
    return [np.array(part[:-1]) for part in convex_decomposition([*points, points[0]], 0.0)]
