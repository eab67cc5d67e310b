"""The packed field: the obstacles, walls and proximity cost of a scenario as one flat array for compiled kernels.

One array can pass through any compiled function:

    [0] proximity weight k   [1] proximity scale sigma   [2] robot radius   [3] circles   [4] polygons
    [5:9] arena (x_min, y_min, x_max, y_max)   [9] position of the grid
    then per circle:   x, y, r
    then per polygon:  number of edges m, then m rows (n_x, n_y, c, x, y): outward normal, offset, first vertex
    then the obstacles' numbers in the scenario, since circles are packed before polygons
    then the grid:     x, y, cell size, columns, lines, then where each cell is, counted from the grid's beginning, then
                       the cells: number of circles n, of polygons p, of their edges m; then n times x, y, r, column by
                       column, and m times p rows (n_x, n_y, c), also column by column

A cell holds the obstacles that are felt somewhere in it, which keeps the proximity cost of a point independent of those
far away. n and p are multiples of LANES, filled up with obstacles that are felt nowhere; polygons of fewer edges than m
are filled up with edges that are felt nowhere. Up to FEW obstacles there is no grid: columns and lines are 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

# A term whose distance exceeds 30 sigma is below 1e-13 k, a tenth of what the integrator is asked for, and is skipped.
CUTOFF = 30.0
CIRCLES, POLYGONS, ARENA, GRID, SHAPES = 3, 4, 5, 9, 10  # positions in the packed field
FEW, MOST_CELLS = 16, 16  # obstacles without a grid; columns or lines of one
LANES = 8  # numbers that a processor takes at once
NOWHERE = 1e30  # m


def pack_field(
    shapes: Sequence[Any],
    arena: tuple[float, float, float, float],
    radius: float,
    weight: float,
    scale: float,
) -> np.ndarray:
    """Packs shapes (with `center` and `radius`, or with `vertices`) into the flat array that the kernels read."""
    circles: list[float] = []
    polygons: list[float] = []
    circle_numbers: list[int] = []
    polygon_numbers: list[int] = []
    for number, shape in enumerate(shapes):
        if hasattr(shape, "radius"):
            circles += [*shape.center, shape.radius]
            circle_numbers.append(number)
        else:
            polygons += _pack_polygon(np.asarray(shape.vertices, dtype=float))
            polygon_numbers.append(number)
    header = [weight, scale, radius, float(len(circle_numbers)), float(len(polygon_numbers)), *arena]
    return _finish(header, circles, polygons, [float(n) for n in circle_numbers + polygon_numbers])


def blend_fields(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """The packed field at `share` of the way from the first (0) to the second (1), obstacle by obstacle.

    Raises:
        ValueError: they do not hold the same kinds of obstacles.

    """
    parts = [unpack_field(first), unpack_field(second)]
    (circles, polygons), (other_circles, other_polygons) = parts
    if len(circles) != len(other_circles) or [len(p) for p in polygons] != [len(p) for p in other_polygons]:
        raise ValueError("obstacles: two fields can be blended only if they hold the same kinds of obstacles")
    header = (1.0 - share) * first[:GRID] + share * second[:GRID]
    blended = [float(x) for x in ((1.0 - share) * circles + share * other_circles).ravel()]
    rows: list[float] = []
    for polygon, other in zip(polygons, other_polygons, strict=True):
        rows += _pack_polygon((1.0 - share) * polygon[:, 3:] + share * other[:, 3:])
    count = len(circles) + len(polygons)
    numbers = first[int(first[GRID]) - count : int(first[GRID])].tolist()
    return _finish(header.tolist(), blended, rows, numbers)


def _finish(header: list[float], circles: list[float], polygons: list[float], numbers: list[float]) -> np.ndarray:
    """The packed field, with its grid, of which `header` lacks the position."""
    position = SHAPES + len(circles) + len(polygons) + len(numbers)
    packed = np.array([*header, position, *circles, *polygons, *numbers], dtype=np.float64)
    field = np.concatenate([packed, _pack_grid(packed)])
    field.flags.writeable = False
    return field


def unpack_field(packed: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Circles (count, 3) and the rows (m, 5) of each polygon."""
    at = SHAPES + 3 * int(packed[CIRCLES])
    circles = packed[SHAPES:at].reshape(-1, 3)
    polygons = []
    for _ in range(int(packed[POLYGONS])):
        edges = int(packed[at])
        polygons.append(packed[at + 1 : at + 1 + 5 * edges].reshape(edges, 5))
        at += 1 + 5 * edges
    return circles, polygons


def obstacle_centres(packed: np.ndarray) -> np.ndarray:
    """Middle of each obstacle (number, 2), a polygon's the mean of its vertices, in the scenario's order."""
    circles, polygons = unpack_field(packed)
    centres = [*circles[:, :2], *(polygon[:, 3:].mean(axis=0) for polygon in polygons)]
    numbers = packed[int(packed[GRID]) - len(centres) : int(packed[GRID])].astype(int)
    ordered = np.empty((len(centres), 2))
    for number, centre in zip(numbers, centres, strict=True):
        ordered[number] = centre
    return ordered


def _pack_grid(packed: np.ndarray) -> np.ndarray:
    """The grid of a field; obstacles are felt up to CUTOFF scales from the robot's rim."""
    circles, polygons = unpack_field(packed)
    if len(circles) + len(polygons) <= FEW:
        return np.zeros(5)
    reach = packed[2] + CUTOFF * packed[1]
    # Obstacles may reach out of the arena. A point beyond the grid belongs to the cell nearest to it, where everything
    # that it feels is listed: the way to the nearest point of a convex set shortens the distances to all in the set.
    corners = [packed[ARENA : ARENA + 4].reshape(2, 2)]
    corners += [circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    corners += [polygon[:, 3:] for polygon in polygons]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    size = float(np.max(high - low)) / MOST_CELLS
    shape = np.ceil((high - low) / size - 1e-9).astype(int).clip(1)
    first = low + size * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    nearest = np.clip(circles[:, :2], first[:, None], first[:, None] + size)
    felt_circles = np.linalg.norm(nearest - circles[:, :2], axis=2) - circles[:, 2] < reach
    felt_polygons = np.empty((len(first), len(polygons)), dtype=bool)
    for k, polygon in enumerate(polygons):
        # The smallest value of each half-plane's distance in the cell; their largest bounds the polygon's from below.
        offsets = np.minimum(polygon[:, :2] * size, 0.0).sum(axis=1) - polygon[:, 2]
        felt_polygons[:, k] = (first @ polygon[:, :2].T + offsets).max(axis=1) < reach
    cells = [
        _pack_cell(circles[a], [polygons[k] for k in np.flatnonzero(b)])
        for a, b in zip(felt_circles, felt_polygons, strict=True)
    ]
    begins = 5 + len(first) + np.cumsum([0, *map(len, cells[:-1])])
    return np.concatenate([low, [size], shape, begins, *cells])


def _pack_cell(circles: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    n, p = (-(-len(felt) // LANES) * LANES for felt in (circles, polygons))
    m = max(map(len, polygons), default=0)
    columns = np.zeros((3, n))
    columns[0] = NOWHERE
    columns[:, : len(circles)] = circles.T
    rows = np.zeros((m, 3, p))
    rows[:, 2] = -NOWHERE  # every half-plane is that far away
    for k, polygon in enumerate(polygons):
        rows[: len(polygon), :, k] = polygon[:, :3]
        rows[len(polygon) :, 2, k] = NOWHERE  # the robot is that deep within the half-plane
    return np.concatenate([[n, p, m], columns.ravel(), rows.ravel()])


def _pack_polygon(vertices: np.ndarray) -> list[float]:
    edges = np.roll(vertices, -1, axis=0) - vertices
    area = float(np.sum(vertices[:, 0] * np.roll(vertices[:, 1], -1) - vertices[:, 1] * np.roll(vertices[:, 0], -1)))
    if area < 0:  # counter-clockwise from here on, so that (dy, -dx) points outwards
        return _pack_polygon(vertices[::-1])
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    offsets = np.sum(normals * vertices, axis=1)
    return [float(len(vertices)), *np.column_stack([normals, offsets, vertices]).ravel().tolist()]
