"""The packed field: obstacles, walls and proximity cost of a scenario as one flat array for compiled kernels.

The entries of the array are, by index:

    [0] proximity weight k   [1] proximity scale sigma   [2] largest radius of a disc of the robot's footprint
    [3] circles   [4] polygons
    [5:9] arena (x_min, y_min, x_max, y_max)   [9] index at which the grid begins
    [10] distance (scales) below which the barrier is a quadratic polynomial
    then per circle:   x, y, r
    then per rounded convex polygon: number of edges m, radius by which the polygon is enlarged, x, y, r of a circle
                       that contains it, then m rows (n_x, n_y, c, x, y, l): outward normal, offset, first vertex and
                       length. A capsule has two edges.
    then the index in the scenario of the obstacle to which each circle and polygon belongs
    then the grid:     x, y, cell size, columns, lines, then the offset of each cell in the grid, then the
                       cells: number of circles n, of polygons p; then the indices of these circles and polygons in
                       the field

A cell lists the obstacles that contribute to the proximity cost somewhere in it, so that the work at a point does not
depend on the number of distant obstacles. With at most MAX_OBSTACLES_WITHOUT_GRID obstacles there is no grid, and
columns and lines are 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast
from weakref import WeakValueDictionary

import numpy as np

from leapnav.envs.shapes.barrier import CONTACT
from leapnav.envs.shapes.base import Shape
from leapnav.envs.shapes.polygon import edge_rows

# Terms of obstacles farther away than 30 sigma are skipped: they are below 1e-13 k, 1/10 of the integrator's tolerance.
CUTOFF = 30.0
CIRCLES, POLYGONS, ARENA, GRID, LEAST_DISTANCE, SHAPES = 3, 4, 5, 9, 10, 11  # indices into the packed field
# Indices into a polygon, number of entries before its edges, and of an edge.
ROUNDING, CENTRE, RIM, POLYGON_HEAD, COLUMNS = 1, 2, 4, 5, 6
MAX_OBSTACLES_WITHOUT_GRID = 16  # fewer obstacles are evaluated faster one by one
# Smallest and largest number of cells per axis. Between them, a cell is as large as this multiple of the reach of an
# obstacle.
MIN_GRID_CELLS, MAX_GRID_CELLS, REACHES_PER_CELL = 16, 128, 2.0
FAR_AWAY = 1e30  # m, at which an obstacle does not contribute


class FieldParts(NamedTuple):
    """The obstacles of a packed field.

    Attributes:
        circles (count, 3): x, y and radius (m).
        polygons: vertices (m, 2) and radius (m) of each rounded polygon.
        indices (count,): index in the scenario of the obstacle to which each circle and then each polygon belongs.

    """

    circles: np.ndarray
    polygons: list[tuple[np.ndarray, float]]
    indices: np.ndarray


def pack_field(
    shapes: Sequence[Shape],
    arena: tuple[float, float, float, float],
    radius: float,
    weight: float,
    scale: float,
    *,
    grid: bool = True,
) -> np.ndarray:
    """Pack obstacles, walls and proximity cost into the flat array that the kernels read.

    Args:
        shapes: the obstacles.
        arena: (x_min, y_min, x_max, y_max) (m).
        radius: largest radius of a disc of the robot's footprint (m).
        weight, scale: proximity weight and proximity scale (m).
        grid: whether to compute the grid, which takes most of the time; clearances do not need it.

    """
    circles: list[tuple[float, float, float]] = []
    polygons: list[tuple[np.ndarray, float]] = []
    owners: tuple[list[int], list[int]] = [], []
    for index, shape in enumerate(shapes):
        for part in shape.parts():
            vertices, rounding = part.rounded_polygon()
            if (vertices[1:] == vertices[:1]).all():  # a disc, or a capsule of length zero
                circles.append((*vertices[0].tolist(), rounding))
                owners[0].append(index)
            else:
                polygons.append((vertices, rounding))
                owners[1].append(index)
    parts = FieldParts(np.reshape(circles, (-1, 3)), polygons, np.array([*owners[0], *owners[1]], dtype=float))
    packed = _assemble((weight, scale, radius), arena, parts)
    return _with_grid(packed) if grid else packed


def _assemble(header: Sequence[float], arena: Sequence[float], parts: FieldParts) -> np.ndarray:
    """Return the packed field without its grid."""
    polygons = [_pack_polygon(vertices, rounding) for vertices, rounding in parts.polygons]
    obstacles = np.concatenate([np.ravel(parts.circles), *polygons, parts.indices])
    counts = float(len(parts.circles)), float(len(polygons))
    field = np.concatenate([[*header, *counts, *arena, float(SHAPES + len(obstacles)), CONTACT], obstacles])
    field.flags.writeable = False
    return field


def _pack_polygon(vertices: np.ndarray, rounding: float) -> np.ndarray:
    """Return the entries of a rounded polygon."""
    rows = edge_rows(vertices)
    x, y = centre = vertices.mean(axis=0)
    rim = float(np.hypot(*(vertices - centre).T).max()) + rounding
    return np.concatenate([[len(rows), rounding, x, y, rim], rows.ravel()])


def blend_fields(first: np.ndarray, second: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate linearly between two packed fields, obstacle by obstacle.

    Args:
        first, second: packed fields with the same kinds of obstacles.
        fraction: 0 gives the first field, 1 the second.

    Raises:
        ValueError: the fields do not contain the same kinds of obstacles.

    """
    a, b = unpack_field(first), unpack_field(second)
    if len(a.circles) != len(b.circles) or [len(one) for one, _ in a.polygons] != [len(one) for one, _ in b.polygons]:
        raise ValueError("obstacles: two fields can be blended only if they contain the same kinds of obstacles")
    header = (1.0 - fraction) * first[:GRID] + fraction * second[:GRID]
    polygons = [
        ((1.0 - fraction) * one + fraction * other, (1.0 - fraction) * radius + fraction * rounding)
        for (one, radius), (other, rounding) in zip(a.polygons, b.polygons, strict=True)
    ]
    circles = (1.0 - fraction) * a.circles + fraction * b.circles
    blended = FieldParts(circles, polygons, a.indices)
    return _with_grid(_assemble(header[:CIRCLES].tolist(), header[ARENA:].tolist(), blended))


def with_weight(packed: np.ndarray, weight: float, least_distance: float = CONTACT) -> np.ndarray:
    """Return a packed field with a given proximity weight.

    Args:
        packed: the field.
        weight: proximity weight.
        least_distance: distance (proximity scales) below which the barrier is a quadratic polynomial.

    """
    if packed[0] == weight and packed[LEAST_DISTANCE] == least_distance:
        return packed
    field = packed.copy()
    field[0], field[LEAST_DISTANCE] = weight, least_distance
    field.flags.writeable = False
    return field


def _with_grid(packed: np.ndarray) -> np.ndarray:
    """Return a packed field with its grid."""
    field = np.concatenate([packed, _pack_grid(packed)])
    field.flags.writeable = False
    return field


def unpack_field(packed: np.ndarray) -> FieldParts:
    """Return the obstacles of a packed field."""
    at = SHAPES + 3 * int(packed[CIRCLES])
    circles, polygons = packed[SHAPES:at].reshape(-1, 3), []
    for _ in range(int(packed[POLYGONS])):
        end = at + POLYGON_HEAD + COLUMNS * int(packed[at])
        rows = packed[at + POLYGON_HEAD : end].reshape(-1, COLUMNS)
        polygons.append((rows[:, 3:5], float(packed[at + ROUNDING])))
        at = end
    return FieldParts(circles, polygons, packed[at : at + len(circles) + len(polygons)])


# Fields that `check_field` has accepted, by their identity; the check takes as long as a short search.
_checked: WeakValueDictionary[int, np.ndarray] = WeakValueDictionary()


def check_field(packed: np.ndarray) -> np.ndarray:
    """Check that kernels can read a packed field, and return it, read-only and with its grid.

    The field is unpacked and packed again, which must not change it.

    Raises:
        ValueError: it is not a packed field.

    """
    if _checked.get(id(packed)) is packed:
        return packed
    if not isinstance(cast(object, packed), np.ndarray) or packed.dtype != np.float64 or packed.ndim != 1:
        raise ValueError(f"field: expected a vector of float64 (Scenario.field), got {packed!r}")
    try:
        with np.errstate(all="ignore"):
            _check_counts(packed)
            field = _with_grid(_assemble(packed[:CIRCLES].tolist(), packed[ARENA:GRID].tolist(), unpack_field(packed)))
    except (IndexError, OverflowError, ValueError) as error:
        raise ValueError(f"field: not a packed field (Scenario.field): {error}") from None
    # Another processor may round the edges of polygons differently.
    is_whole = len(packed) in (int(packed[GRID]), len(field))  # without a grid, or with all of it
    if not is_whole or not np.allclose(field[: len(packed)], packed, rtol=1e-9, atol=1e-9):
        raise ValueError("field: not a packed field (Scenario.field): its entries contradict each other")
    _checked[id(field)] = field
    return field


def _check_counts(packed: np.ndarray) -> None:
    """Raise IndexError unless the counts of a field agree with its length, and its first entries are valid."""
    weight, scale, radius = packed[:CIRCLES].tolist()
    if not (np.isfinite(packed).all() and weight >= 0 and scale > 0 and radius > 0):
        raise IndexError("its first entries are invalid")
    count, polygons, end = (_count_at(packed, index) for index in (CIRCLES, POLYGONS, GRID))
    at = SHAPES + 3 * count
    for _ in range(polygons):
        if _count_at(packed, at) < 2:
            raise IndexError("a polygon has fewer than 2 edges")
        at += POLYGON_HEAD + COLUMNS * int(packed[at])
    if at + count + polygons != end or end > len(packed):
        raise IndexError("its length is invalid")
    if not (packed[at:end] % 1 == 0).all() or (packed[at:end] < 0).any() or (packed[at:end] > end).any():
        raise IndexError("an index of an obstacle is invalid")


def _count_at(packed: np.ndarray, index: int) -> int:
    """Return a count of a packed field.

    Raises:
        IndexError: it is not one.

    """
    value = float(packed[index])
    if not (value.is_integer() and 0 <= value <= len(packed)):
        raise IndexError(f"entry {index}: expected a count, got {value!r}")
    return int(value)


def obstacle_centres(packed: np.ndarray) -> np.ndarray:
    """Return a point inside each obstacle in the scenario's order, (n, 2): the centre of its first part."""
    circles, polygons, indices = unpack_field(packed)
    centres = np.array([*circles[:, :2], *(vertices.mean(axis=0) for vertices, _ in polygons)]).reshape(-1, 2)
    return centres[np.unique(indices, return_index=True)[1]]


def _pack_grid(packed: np.ndarray) -> np.ndarray:
    """Return the grid of a field. Obstacles contribute up to CUTOFF proximity scales from the robot's rim."""
    circles, polygons, indices = unpack_field(packed)
    if len(indices) <= MAX_OBSTACLES_WITHOUT_GRID:
        return np.zeros(5)
    reach = packed[2] + CUTOFF * packed[1]
    # Obstacles may extend beyond the arena. A point outside the grid uses the nearest cell, which lists all obstacles
    # that contribute at the point: its projection onto the convex grid is not farther from any obstacle in the grid.
    corners = [packed[ARENA : ARENA + 4].reshape(2, 2)]
    corners += [circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    corners += [vertices + side * rounding for vertices, rounding in polygons for side in (-1.0, 1.0)]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    side = float(np.max(high - low))
    count = min(max(math.ceil(side / (REACHES_PER_CELL * reach)), MIN_GRID_CELLS), MAX_GRID_CELLS)
    size = side / count
    shape = np.ceil((high - low) / size - 1e-9).astype(int).clip(1)
    first = low + size * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    near: list[tuple[list[int], list[int]]] = [([], []) for _ in first]
    for k, (x, y, radius) in enumerate(circles.tolist()):
        box = np.array([[x, y]]) + (radius + reach) * np.array([[-1.0], [1.0]])
        cells = _cells_in(box, low, size, shape)
        nearest = np.clip((x, y), first[cells], first[cells] + size)
        for cell in cells[np.linalg.norm(nearest - (x, y), axis=1) - radius < reach].tolist():
            near[cell][0].append(SHAPES + 3 * k)
    at = SHAPES + circles.size
    for vertices, rounding in polygons:
        rows = edge_rows(vertices)
        distance = reach + rounding
        cells = _cells_in(np.concatenate([vertices - distance, vertices + distance]), low, size, shape)
        # The minimum over the cell of the distance to each half-plane; the maximum of these is a lower bound for the
        # distance to the polygon.
        lowest = np.minimum(rows[:, :2] * size, 0.0).sum(axis=1) - rows[:, 2]
        for cell in cells[(first[cells] @ rows[:, :2].T + lowest).max(axis=1) < distance].tolist():
            near[cell][1].append(at)
        at += POLYGON_HEAD + rows.size
    cells = [[len(some), len(others), *some, *others] for some, others in near]
    offsets = 5 + len(first) + np.cumsum([0, *map(len, cells[:-1])])
    return np.concatenate([low, [size], shape, offsets, *cells])


def _cells_in(points: np.ndarray, low: np.ndarray, size: float, shape: np.ndarray) -> np.ndarray:
    """Return the indices of the cells that the bounding box of points (n, 2) meets, or of the closest cells."""
    first = np.clip(((points.min(axis=0) - low) / size).astype(int), 0, shape - 1)
    last = np.clip(((points.max(axis=0) - low) / size).astype(int), 0, shape - 1)
    columns, lines = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    return (columns[:, None] * shape[1] + lines).ravel()
