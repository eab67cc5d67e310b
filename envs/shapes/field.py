"""The packed field: obstacles, walls and proximity cost of a scenario as one flat array for compiled kernels.

The entries of the array are, by index:

    [0] proximity weight k   [1] proximity scale sigma   [2] largest radius of a disc of the robot's footprint
    [3] circles   [4] polygons
    [5:9] arena (x_min, y_min, x_max, y_max)   [9] index at which the grid begins
    then per circle:   x, y, r
    then per polygon:  number of edges m, then m rows (n_x, n_y, c, x, y): outward normal, offset, first vertex
    then the obstacles' indices in the scenario, since circles are packed before polygons
    then the grid:     x, y, cell size, columns, lines, then the offset of each cell in the grid, then the
                       cells: number of circles n, of polygons p, maximum number of edges m; then x, y, r of the n
                       circles, column by column, and (n_x, n_y, c) of the p polygons for each of the m edges, also
                       column by column

A cell lists the obstacles that contribute to the proximity cost somewhere in it, so that the work at a point does not
depend on the number of distant obstacles. n and p are multiples of LANES; the remaining entries are obstacles without
any contribution. Polygons with fewer than m edges are padded with edges without any contribution. With at most
MAX_OBSTACLES_WITHOUT_GRID obstacles there is no grid: columns and lines are 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

# Terms of obstacles farther away than 30 sigma are skipped: they are below 1e-13 k, 1/10 of the integrator's tolerance.
CUTOFF = 30.0
CIRCLES, POLYGONS, ARENA, GRID, SHAPES = 3, 4, 5, 9, 10  # indices into the packed field
MAX_OBSTACLES_WITHOUT_GRID = 16  # fewer obstacles are evaluated faster one by one
MAX_GRID_CELLS = 16  # per axis
LANES = 8  # doubles in a vector register of 512 bits
FAR_AWAY = 1e30  # m, at which an obstacle does not contribute


def pack_field(
    shapes: Sequence[Any],
    arena: tuple[float, float, float, float],
    radius: float,
    weight: float,
    scale: float,
) -> np.ndarray:
    """Pack obstacles, walls and proximity cost into the flat array that the kernels read.

    Args:
        shapes: obstacles with `center` and `radius`, or with `vertices`.
        arena: (x_min, y_min, x_max, y_max) (m).
        radius: largest radius of a disc of the robot's footprint (m).
        weight, scale: proximity weight and proximity scale (m).

    """
    circles: list[float] = []
    polygons: list[float] = []
    circle_indices: list[int] = []
    polygon_indices: list[int] = []
    for index, shape in enumerate(shapes):
        if hasattr(shape, "radius"):
            circles += [*shape.center, shape.radius]
            circle_indices.append(index)
        else:
            polygons += _pack_polygon(np.asarray(shape.vertices, dtype=float))
            polygon_indices.append(index)
    header = [weight, scale, radius, float(len(circle_indices)), float(len(polygon_indices)), *arena]
    return _assemble(header, circles, polygons, [float(i) for i in circle_indices + polygon_indices])


def blend_fields(first: np.ndarray, second: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate linearly between two packed fields, obstacle by obstacle.

    Args:
        first, second: packed fields with the same kinds of obstacles.
        fraction: 0 gives the first field, 1 the second.

    Raises:
        ValueError: the fields do not contain the same kinds of obstacles.

    """
    parts = [unpack_field(first), unpack_field(second)]
    (circles, polygons), (other_circles, other_polygons) = parts
    if len(circles) != len(other_circles) or [len(p) for p in polygons] != [len(p) for p in other_polygons]:
        raise ValueError("obstacles: two fields can be blended only if they contain the same kinds of obstacles")
    header = (1.0 - fraction) * first[:GRID] + fraction * second[:GRID]
    blended = [float(x) for x in ((1.0 - fraction) * circles + fraction * other_circles).ravel()]
    rows: list[float] = []
    for polygon, other in zip(polygons, other_polygons, strict=True):
        rows += _pack_polygon((1.0 - fraction) * polygon[:, 3:] + fraction * other[:, 3:])
    count = len(circles) + len(polygons)
    indices = first[int(first[GRID]) - count : int(first[GRID])].tolist()
    return _assemble(header.tolist(), blended, rows, indices)


def _assemble(header: list[float], circles: list[float], polygons: list[float], indices: list[float]) -> np.ndarray:
    """Return the packed field with its grid, whose index is not in `header`."""
    grid_index = SHAPES + len(circles) + len(polygons) + len(indices)
    packed = np.array([*header, grid_index, *circles, *polygons, *indices], dtype=np.float64)
    field = np.concatenate([packed, _pack_grid(packed)])
    field.flags.writeable = False
    return field


def unpack_field(packed: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the circles (count, 3) and the rows (m, 5) of each polygon."""
    at = SHAPES + 3 * int(packed[CIRCLES])
    circles = packed[SHAPES:at].reshape(-1, 3)
    polygons = []
    for _ in range(int(packed[POLYGONS])):
        edges = int(packed[at])
        polygons.append(packed[at + 1 : at + 1 + 5 * edges].reshape(edges, 5))
        at += 1 + 5 * edges
    return circles, polygons


def obstacle_centres(packed: np.ndarray) -> np.ndarray:
    """Return the centres (n, 2) of the obstacles in the scenario's order; for a polygon, the mean of its vertices."""
    circles, polygons = unpack_field(packed)
    centres = [*circles[:, :2], *(polygon[:, 3:].mean(axis=0) for polygon in polygons)]
    indices = packed[int(packed[GRID]) - len(centres) : int(packed[GRID])].astype(int)
    ordered = np.empty((len(centres), 2))
    for index, centre in zip(indices, centres, strict=True):
        ordered[index] = centre
    return ordered


def _pack_grid(packed: np.ndarray) -> np.ndarray:
    """Return the grid of a field. Obstacles contribute up to CUTOFF proximity scales from the robot's rim."""
    circles, polygons = unpack_field(packed)
    if len(circles) + len(polygons) <= MAX_OBSTACLES_WITHOUT_GRID:
        return np.zeros(5)
    reach = packed[2] + CUTOFF * packed[1]
    # Obstacles may extend beyond the arena. A point outside the grid uses the nearest cell, which lists all obstacles
    # that contribute at the point: its projection onto the convex grid is not farther from any obstacle in the grid.
    corners = [packed[ARENA : ARENA + 4].reshape(2, 2)]
    corners += [circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    corners += [polygon[:, 3:] for polygon in polygons]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    size = float(np.max(high - low)) / MAX_GRID_CELLS
    shape = np.ceil((high - low) / size - 1e-9).astype(int).clip(1)
    first = low + size * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    nearest = np.clip(circles[:, :2], first[:, None], first[:, None] + size)
    near_circles = np.linalg.norm(nearest - circles[:, :2], axis=2) - circles[:, 2] < reach
    near_polygons = np.empty((len(first), len(polygons)), dtype=bool)
    for k, polygon in enumerate(polygons):
        # The minimum over the cell of the distance to each half-plane; the maximum of these is a lower bound for the
        # distance to the polygon.
        lowest = np.minimum(polygon[:, :2] * size, 0.0).sum(axis=1) - polygon[:, 2]
        near_polygons[:, k] = (first @ polygon[:, :2].T + lowest).max(axis=1) < reach
    cells = [
        _pack_cell(circles[a], [polygons[k] for k in np.flatnonzero(b)])
        for a, b in zip(near_circles, near_polygons, strict=True)
    ]
    offsets = 5 + len(first) + np.cumsum([0, *map(len, cells[:-1])])
    return np.concatenate([low, [size], shape, offsets, *cells])


def _pack_cell(circles: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    n, p = (-(-len(obstacles) // LANES) * LANES for obstacles in (circles, polygons))
    m = max(map(len, polygons), default=0)
    columns = np.zeros((3, n))
    columns[0] = FAR_AWAY
    columns[:, : len(circles)] = circles.T
    rows = np.zeros((m, 3, p))
    rows[:, 2] = -FAR_AWAY  # padding polygons: every half-plane is at this distance
    for k, polygon in enumerate(polygons):
        rows[: len(polygon), :, k] = polygon[:, :3]
        rows[len(polygon) :, 2, k] = FAR_AWAY  # padding edges: the robot is this deep inside the half-plane
    return np.concatenate([[n, p, m], columns.ravel(), rows.ravel()])


def _pack_polygon(vertices: np.ndarray) -> list[float]:
    edges = np.roll(vertices, -1, axis=0) - vertices
    area = float(np.sum(vertices[:, 0] * np.roll(vertices[:, 1], -1) - vertices[:, 1] * np.roll(vertices[:, 0], -1)))
    if area < 0:  # reverse to counter-clockwise, so that (dy, -dx) points outwards
        return _pack_polygon(vertices[::-1])
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    offsets = np.sum(normals * vertices, axis=1)
    return [float(len(vertices)), *np.column_stack([normals, offsets, vertices]).ravel().tolist()]
