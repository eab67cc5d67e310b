"""Random scenarios by family.

A family is a function from a random generator to a layout. Robot, cost, poses and horizon are common to all families.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.cost import Cost, cruise_speed
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import TIME_LIMIT_FACTOR, Scenario, check_robot
from leapnav.envs.settings import HORIZONS
from leapnav.envs.shapes import Circle, Polygon
from leapnav.envs.shapes.clearance import clearances, footprint_clearances
from leapnav.envs.shapes.field import pack_field
from leapnav.envs.utils.validation import check_choice, suggestion

ARENA = (0.0, 0.0, 10.0, 10.0)
REFERENCE_SPEED = 0.8  # m/s: the horizon is the length of the shortest path divided by this speed
MAX_HORIZON = 40.0  # s
TIME_WEIGHT = 0.5  # cost per second if the horizon is free
# Duration of an optimum with a free horizon, relative to the shortest path at the cruise speed: the median of the
# families is 1.07 to 1.15, because it also turns.
RELATIVE_DURATION = 1.1
MIN_DISTANCE = 4.0  # m between start and goal
MIN_POSE_CLEARANCE = 0.25  # m at the start and the goal
PASSAGE_MARGIN = 0.1  # m on either side of the robot, in the narrowest passage that a scenario may require
GRID_SPACING = 0.25  # m, of the grid on which the shortest path is computed
DECIMALS = 4  # of every sampled number, so that scenario files stay short


Box = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max
ANYWHERE: Box = (0.5, 0.5, 9.5, 9.5)


@dataclass(frozen=True)
class ScenarioLayout:
    """The obstacles of a random scenario, and the regions in which start and goal are sampled."""

    obstacles: list[Obstacle]
    start: Box = ANYWHERE
    goal: Box = ANYWHERE


def _open(rng: np.random.Generator) -> ScenarioLayout:
    """The walls of the arena only."""
    return ScenarioLayout([])


def _clutter(rng: np.random.Generator) -> ScenarioLayout:
    """6 to 12 discs with radii from 0.3 to 1 m, which may overlap."""
    return ScenarioLayout(
        [
            Obstacle(circle=Circle(center=_point(rng.uniform(1.0, 9.0, 2)), radius=_rounded(rng.uniform(0.3, 1.0))))
            for _ in range(rng.integers(6, 13))
        ]
    )


def _polygons(rng: np.random.Generator) -> ScenarioLayout:
    """4 to 8 convex polygons, which may overlap: 3/4 are rotated rectangles, 1/4 convex hulls of random points."""
    return ScenarioLayout([_hull(rng) if rng.random() < 0.25 else _box(rng) for _ in range(rng.integers(4, 9))])


def _box(rng: np.random.Generator) -> Obstacle:
    half = np.array([rng.uniform(0.2, 0.8), rng.uniform(0.2, 1.2)])
    angle = rng.uniform(-math.pi, math.pi)
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return _polygon(rng.uniform(1.0, 9.0, 2) + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half @ turn)


def _hull(rng: np.random.Generator) -> Obstacle:
    centre, reach = rng.uniform(1.0, 9.0, 2), rng.uniform(0.5, 1.0)
    # One point in each sector, so that the hull is never very thin.
    angles = (np.arange(6) + rng.uniform(0.0, 1.0, 6)) * math.pi / 3
    points = centre + reach * rng.uniform(0.5, 1.0, (6, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    points = points.round(DECIMALS)
    # Imported here because only fresh scenarios need it: it takes a third of a second.
    from scipy.spatial import ConvexHull

    return _polygon(points[ConvexHull(points).vertices])


def _rooms(rng: np.random.Generator) -> ScenarioLayout:
    """Four rooms with a door in each of the four walls, all of the same width (1.0 to 1.6 m).

    In 3/4 of the scenarios, one of the doors is closed.
    """
    width = rng.uniform(1.0, 1.6)
    closed = rng.integers(4) if rng.random() < 0.75 else None
    walls = []
    for index, (axis, begin) in enumerate(((1, 0.0), (1, 5.0), (0, 0.0), (0, 5.0))):
        door = rng.uniform(begin + 0.5, begin + 4.5 - width)
        ends = [(begin, begin + 5.0)] if index == closed else [(begin, door), (door + width, begin + 5.0)]
        for low, high in ends:
            corners = (4.9, low, 5.1, high) if axis == 1 else (low, 4.9, high, 5.1)
            walls.append(_rectangle(*corners))
    return ScenarioLayout(walls)


def _slalom(rng: np.random.Generator) -> ScenarioLayout:
    """2 to 4 walls between start and goal, alternately from above and below, with passages of 1.4 to 3.5 m."""
    count = int(rng.integers(2, 5))
    above = bool(rng.integers(2))
    walls = []
    for number in range(count):
        left = 10.0 * (number + 1) / (count + 1) - 0.15 + rng.uniform(-0.4, 0.4)
        length = 10.0 - rng.uniform(1.4, 3.5)
        low, high = (10.0 - length, 10.0) if above else (0.0, length)
        walls.append(_rectangle(left, low, left + 0.3, high))
        above = not above
    return ScenarioLayout(walls, start=(0.6, 1.0, 1.2, 9.0), goal=(8.8, 1.0, 9.4, 9.0))


FAMILIES: dict[str, Callable[[np.random.Generator], ScenarioLayout]] = {
    "open": _open,
    "clutter": _clutter,
    "polygons": _polygons,
    "rooms": _rooms,
    "slalom": _slalom,
}


ALL = "all"  # selects all families: the family is sampled, too


def check_family(family: object) -> None:
    """Check that a family exists.

    Raises:
        ValueError: it is neither one of `FAMILIES` nor "all".

    """
    if not isinstance(family, str) or family not in (*FAMILIES, ALL):
        hint = suggestion(family, (*FAMILIES, ALL))
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)} or {ALL}, got {family!r}{hint}")


def collection_name(family: str, robot: str = "unicycle", horizon: str = "fixed") -> str:
    """Return the name of the scenarios of a family for a robot model and a kind of horizon, such as "car-clutter"."""
    return "-".join([*([] if robot == "unicycle" else [robot]), *([] if horizon == "fixed" else [horizon]), family])


def sample_scenario(
    family: str,
    seed: int | np.random.Generator,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
) -> Scenario:
    """Sample a random scenario; the same family and seed give the same scenario.

    Start and goal are at least 4 m apart and connected by a path with a margin of 0.1 m on either side of the robot.
    The horizon is the length of the shortest such path divided by 0.8 m/s, and at most 40 s; or it is free with the
    time weight 0.5, and the time limit is 3 times an estimate of the duration of the optimum.

    Args:
        family: one of `FAMILIES`, or "all" to sample the family, too.
        seed: an integer, or a random generator.
        robot: name of a robot model, a dict of its fields with `model`, or a robot. Robots with the same footprint
            get the same obstacles and poses.
        horizon: "fixed" or "free"; both have the same obstacles and poses.

    Raises:
        ValueError: an argument is invalid.

    """
    check_family(family)
    check_choice("horizon", horizon, HORIZONS)
    body = check_robot(robot)
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    if family == ALL:
        family = list(FAMILIES)[rng.integers(len(FAMILIES))]
    name = family if isinstance(seed, np.random.Generator) else f"{family}-{seed}"
    discs, cost = body.discs(), Cost() if horizon == "fixed" else Cost(time_weight=TIME_WEIGHT)
    while True:  # rejection sampling: the draws are independent, so it ends
        layout = FAMILIES[family](rng)
        areas = np.array([layout.start, layout.goal])
        field = pack_field(
            [obstacle.shape for obstacle in layout.obstacles],
            ARENA,
            float(discs[:, 1].max()),
            cost.proximity_weight,
            cost.proximity_scale,
        )
        poses = np.column_stack([rng.uniform(areas[:, :2], areas[:, 2:]), rng.uniform(-math.pi, math.pi, 2)])
        if math.dist(poses[0, :2], poses[1, :2]) < MIN_DISTANCE or (
            footprint_clearances(poses, discs, field).min() < MIN_POSE_CLEARANCE
        ):
            continue
        length = _shortest_path(field, poses[0, :2], poses[1, :2])
        if length is not None:
            break
    start, goal = ((*_point(pose), _rounded(pose[2])) for pose in poses)
    times: dict[str, float | None] = {"horizon": round(min(length / REFERENCE_SPEED, MAX_HORIZON), 1)}
    if horizon == "free":
        limit = TIME_LIMIT_FACTOR * RELATIVE_DURATION * length / cruise_speed(body, cost)
        times = {"horizon": None, "time_limit": round(limit, 1)}
    return Scenario(
        name=name,
        arena=ARENA,
        robot=body,
        start=start,
        goal=goal,
        **times,
        obstacles=tuple(layout.obstacles),
        cost=cost,
    )


def _rounded(value: float) -> float:
    return round(float(value), DECIMALS)


def _rectangle(x_min: float, y_min: float, x_max: float, y_max: float) -> Obstacle:
    return _polygon(np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]))


def _polygon(vertices: np.ndarray) -> Obstacle:
    return Obstacle(polygon=Polygon(vertices=tuple(_point(vertex) for vertex in vertices)))


def _point(values: np.ndarray) -> tuple[float, float]:
    return _rounded(values[0]), _rounded(values[1])


def _grid_edges() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of the grid, and the heads, tails and lengths of its edges (16 directions)."""
    steps = np.arange(ARENA[0] + GRID_SPACING, ARENA[2], GRID_SPACING)
    n = len(steps)
    points = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(n * n).reshape(n, n)
    heads, tails, lengths = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        low, high = max(0, -dy), n - max(0, dy)
        a = index[: n - dx, low:high]
        heads.append(a.ravel())
        tails.append(index[dx:, low + dy : high + dy].ravel())
        lengths.append(np.full(a.size, GRID_SPACING * math.hypot(dx, dy)))
    return points, np.concatenate(heads), np.concatenate(tails), np.concatenate(lengths)


_POINTS, _HEADS, _TAILS, _LENGTHS = _grid_edges()
_MIDDLES = (_POINTS[_HEADS] + _POINTS[_TAILS]) / 2


def _shortest_path(field: np.ndarray, start: np.ndarray, goal: np.ndarray) -> float | None:
    """Return the length (m) of the shortest path on the grid, with the passage margin; None if there is no path."""
    free = clearances(_POINTS, field) > PASSAGE_MARGIN
    ends = [int(np.argmin(np.where(free, np.sum((_POINTS - p) ** 2, axis=1), np.inf))) for p in (start, goal)]
    usable = free[_HEADS] & free[_TAILS]
    usable[usable] = clearances(_MIDDLES[usable], field) > PASSAGE_MARGIN
    size = len(_POINTS)
    # Imported here because only fresh scenarios need it.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    graph = csr_array((_LENGTHS[usable], (_HEADS[usable], _TAILS[usable])), shape=(size, size))
    length = float(dijkstra(graph, directed=False, indices=ends[0])[ends[1]])
    if not math.isfinite(length):
        return None
    return max(length, math.dist(start, goal))
