"""Layouts of the built-in families whose obstacles do not move."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from leapnav.envs.scenarios.layouts.layout import DECIMALS, ScenarioLayout, point, polygon, rectangle, rounded
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.shapes import Circle


def _open(rng: np.random.Generator) -> ScenarioLayout:
    """The walls of the arena only."""
    return ScenarioLayout([])


def _clutter(rng: np.random.Generator) -> ScenarioLayout:
    """6 to 12 discs with radii from 0.3 to 1 m, which may overlap."""
    return ScenarioLayout(
        [
            Obstacle(circle=Circle(center=point(rng.uniform(1.0, 9.0, 2)), radius=rounded(rng.uniform(0.3, 1.0))))
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
    return polygon(rng.uniform(1.0, 9.0, 2) + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half @ turn)


def _hull(rng: np.random.Generator) -> Obstacle:
    centre, reach = rng.uniform(1.0, 9.0, 2), rng.uniform(0.5, 1.0)
    # One point in each sector, so that the hull is never very thin.
    angles = (np.arange(6) + rng.uniform(0.0, 1.0, 6)) * math.pi / 3
    points = centre + reach * rng.uniform(0.5, 1.0, (6, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    points = points.round(DECIMALS)
    # Imported here because only fresh scenarios need it: it takes a third of a second.
    from scipy.spatial import ConvexHull

    return polygon(points[ConvexHull(points).vertices])


def _rooms(rng: np.random.Generator) -> ScenarioLayout:
    """Four rooms with a door in each of the four walls, all of the same width (1.0 to 1.6 m).

    In 3/4 of the scenarios, one of the doors is closed.
    """
    return ScenarioLayout(rooms_of(rng)[0])


def rooms_of(rng: np.random.Generator) -> tuple[list[Obstacle], list[tuple[int, float, float]]]:
    """Return the walls of `rooms`, and for each opening the axis along which its wall extends, and its ends (m)."""
    width = rng.uniform(1.0, 1.6)
    closed = rng.integers(4) if rng.random() < 0.75 else None
    walls, openings = [], []
    for index, (axis, begin) in enumerate(((1, 0.0), (1, 5.0), (0, 0.0), (0, 5.0))):
        door = rng.uniform(begin + 0.5, begin + 4.5 - width)
        ends = [(begin, begin + 5.0)] if index == closed else [(begin, door), (door + width, begin + 5.0)]
        if index != closed:
            openings.append((axis, door, door + width))
        for low, high in ends:
            corners = (4.9, low, 5.1, high) if axis == 1 else (low, 4.9, high, 5.1)
            walls.append(rectangle(*corners))
    return walls, openings


def _slalom(rng: np.random.Generator) -> ScenarioLayout:
    """2 to 4 walls between start and goal, alternately from above and below, with passages of 1.4 to 3.5 m."""
    count = int(rng.integers(2, 5))
    above = bool(rng.integers(2))
    walls = []
    for number in range(count):
        left = 10.0 * (number + 1) / (count + 1) - 0.15 + rng.uniform(-0.4, 0.4)
        length = 10.0 - rng.uniform(1.4, 3.5)
        low, high = (10.0 - length, 10.0) if above else (0.0, length)
        walls.append(rectangle(left, low, left + 0.3, high))
        above = not above
    return ScenarioLayout(walls, start=(0.6, 1.0, 1.2, 9.0), goal=(8.8, 1.0, 9.4, 9.0))


def _maze(rng: np.random.Generator) -> ScenarioLayout:
    """A maze of 6 x 6 to 8 x 8 cells of 2 m: a random spanning tree, and 1/8 of the other openings."""
    n, size = int(rng.integers(6, 9)), 2.0
    # closed[axis][i, j]: wall between the cells (i, j) and (i + 1, j), or (i, j) and (i, j + 1)
    closed = [np.ones((n - 1, n), dtype=bool), np.ones((n, n - 1), dtype=bool)]
    visited, stack = {(0, 0)}, [(0, 0)]
    while stack:
        i, j = stack[int(rng.integers(len(stack)))]  # a random cell of the tree: short dead ends
        free = [cell for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if min(cell) >= 0 and max(cell) < n]
        free = [cell for cell in free if cell not in visited]
        if not free:
            stack.remove((i, j))
            continue
        k, m = free[int(rng.integers(len(free)))]
        closed[0 if k != i else 1][min(i, k), min(j, m)] = False
        visited.add((k, m))
        stack.append((k, m))
    closed = [walls & (rng.random(walls.shape) >= 1 / 8) for walls in closed]
    found = []
    for axis, walls in enumerate((closed[0], closed[1].T)):
        for line, row in enumerate(walls):
            across = size * (line + 1)
            for first, last in _runs(row):
                low, high = max(0.0, size * first - 0.1), min(size * n, size * last + 0.1)
                corners = (across - 0.1, low, across + 0.1, high)
                found.append(rectangle(*corners) if axis == 0 else rectangle(low, corners[0], high, corners[2]))
    return ScenarioLayout(found, arena=(0.0, 0.0, size * n, size * n))


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the first index and the last index + 1 of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _corridors(rng: np.random.Generator) -> ScenarioLayout:
    """Blocks between 4 or 5 corridors in each direction (0.9 to 1.5 m wide), of whose sections 1/6 are closed; 16 m."""
    size = 16.0
    columns, rows = (_divide(rng, int(rng.integers(4, 6)), size) for _ in range(2))
    found = [rectangle(x[0], y[0], x[1], y[1]) for x in columns.blocks for y in rows.blocks]
    for corridors, blocks, is_vertical in (
        (columns.corridors, rows.blocks, True),
        (rows.corridors, columns.blocks, False),
    ):
        for low, high in corridors:
            for first, last in blocks:
                if rng.random() < 1 / 6:
                    at = rng.uniform(first, last - 0.2)
                    corners = (low, at, high, at + 0.2) if is_vertical else (at, low, at + 0.2, high)
                    found.append(rectangle(*corners))
    return ScenarioLayout(found, arena=(0.0, 0.0, size, size))


@dataclass(frozen=True)
class _Cuts:
    """Intervals of the corridors and of the blocks between them along an axis."""

    corridors: list[tuple[float, float]]
    blocks: list[tuple[float, float]]


def _divide(rng: np.random.Generator, count: int, size: float) -> _Cuts:
    """Divide a length into `count` corridors, the first and the last along the walls, and the blocks between them."""
    widths = rng.uniform(0.9, 1.5, count)
    shares = rng.uniform(0.5, 1.5, count - 1)
    lengths = np.empty(2 * count - 1)
    lengths[0::2], lengths[1::2] = widths, (size - widths.sum()) * shares / shares.sum()
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    intervals = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
    return _Cuts(intervals[0::2], intervals[1::2])


LAYOUTS_AT_REST: dict[str, Callable[[np.random.Generator], ScenarioLayout]] = {
    "open": _open,
    "clutter": _clutter,
    "polygons": _polygons,
    "rooms": _rooms,
    "slalom": _slalom,
    "maze": _maze,
    "corridors": _corridors,
}
