"""Random scenarios by family. A family is a function from a generator to obstacles; the rest is common to all."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from leapnav.envs.obstacles import clearances, pack_field
from leapnav.envs.scenario import Circle, Cost, Obstacle, Robot, Scenario

ARENA = (0.0, 0.0, 10.0, 10.0)
PACE = 0.8  # m/s along the shortest path: the horizon is this path's length over the pace
SHORTEST_TASK = 4.0  # m between start and goal
POSE_CLEARANCE = 0.25  # m around start and goal
PASSAGE = 0.1  # m on either side of a robot in the narrowest gap that a task may need
GRID = 0.25  # m, of the search for the shortest path
DECIMALS = 4  # of every sampled number, so that scenario files stay short


def _open(rng: np.random.Generator) -> list[Obstacle]:
    """Nothing but the walls."""
    return []


def _clutter(rng: np.random.Generator) -> list[Obstacle]:
    """6 to 12 discs of 0.3 to 1 m, which may overlap."""
    return [
        Obstacle(
            circle=Circle(center=_point(rng.uniform(1.0, 9.0, 2)), radius=round(float(rng.uniform(0.3, 1.0)), DECIMALS))
        )
        for _ in range(rng.integers(6, 13))
    ]


FAMILIES: dict[str, Callable[[np.random.Generator], list[Obstacle]]] = {"open": _open, "clutter": _clutter}


def sample_scenario(family: str, seed: int | np.random.Generator) -> Scenario:
    """A random scenario; the same family and seed give the same one.

    Start and goal are at least 4 m apart, joined by a path that leaves the robot 0.1 m on either side, and the horizon
    lets the robot follow the shortest such path at 0.8 m/s.

    Args:
        family: one of `FAMILIES`.
        seed: an integer, or a generator to draw from.

    Raises:
        ValueError: the family is unknown.

    """
    if family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family!r}")
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    name = family if isinstance(seed, np.random.Generator) else f"{family}-{seed}"
    robot, cost = Robot(), Cost()
    while True:  # a third of the draws has no path; each draw is independent, so this ends
        obstacles = FAMILIES[family](rng)
        field = pack_field(
            [obstacle.shape for obstacle in obstacles], ARENA, robot.radius, cost.proximity_weight, cost.proximity_scale
        )
        poses = np.column_stack([rng.uniform(0.5, 9.5, (2, 2)), rng.uniform(-math.pi, math.pi, 2)])
        if math.dist(poses[0, :2], poses[1, :2]) < SHORTEST_TASK or clearances(poses, field).min() < POSE_CLEARANCE:
            continue
        length = _shortest_path(field, poses[0, :2], poses[1, :2])
        if length is not None:
            break
    start, goal = ((*_point(pose), round(float(pose[2]), DECIMALS)) for pose in poses)
    return Scenario(
        name=name,
        arena=ARENA,
        robot=robot,
        start=start,
        goal=goal,
        horizon=round(length / PACE, 1),
        obstacles=tuple(obstacles),
        cost=cost,
    )


def _point(values: np.ndarray) -> tuple[float, float]:
    return round(float(values[0]), DECIMALS), round(float(values[1]), DECIMALS)


def _grid_edges() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The grid's points, and its edges to neighbours and by knight's moves (heads, tails, lengths)."""
    steps = np.arange(ARENA[0] + GRID, ARENA[2], GRID)
    n = len(steps)
    points = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(n * n).reshape(n, n)
    heads, tails, lengths = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        low, high = max(0, -dy), n - max(0, dy)
        a = index[: n - dx, low:high]
        heads.append(a.ravel())
        tails.append(index[dx:, low + dy : high + dy].ravel())
        lengths.append(np.full(a.size, GRID * math.hypot(dx, dy)))
    return points, np.concatenate(heads), np.concatenate(tails), np.concatenate(lengths)


_POINTS, _HEADS, _TAILS, _LENGTHS = _grid_edges()
_MIDDLES = (_POINTS[_HEADS] + _POINTS[_TAILS]) / 2


def _shortest_path(field: np.ndarray, start: np.ndarray, goal: np.ndarray) -> float | None:
    """Length (m) of the shortest way for a disc with the passage's margin, on a grid; None if there is none."""
    free = clearances(_POINTS, field) > PASSAGE
    ends = [int(np.argmin(np.where(free, np.sum((_POINTS - p) ** 2, axis=1), np.inf))) for p in (start, goal)]
    usable = free[_HEADS] & free[_TAILS]
    usable[usable] = clearances(_MIDDLES[usable], field) > PASSAGE
    size = len(_POINTS)
    graph = csr_array((_LENGTHS[usable], (_HEADS[usable], _TAILS[usable])), shape=(size, size))
    length = float(dijkstra(graph, directed=False, indices=ends[0])[ends[1]])
    if not math.isfinite(length):
        return None
    return max(length, math.dist(start, goal))
