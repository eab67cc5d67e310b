"""The packed field: obstacles, walls and proximity cost of a scenario as one flat array for compiled kernels.

The entries of the array are, by index:

    [0] proximity weight k   [1] proximity scale sigma   [2] largest radius of a disc of the robot's footprint
    [3] circles   [4] records after the circles
    [5:9] arena (x_min, y_min, x_max, y_max)   [9] index at which the grid begins
    then per circle:   x, y, r
    then per obstacle of another shape: minus the number of its kind, length of the rest, centre x, y, radius of a
                       circle around the centre that contains it, radius of a circle beyond which its proximity cost is
                       negligible, radius and number v of vertices of its rounded polygon, v vertices x, y, then the
                       numbers of its kernels
    then per polygon:  number of edges m, then m rows (n_x, n_y, c, x, y): outward normal, offset, first vertex
    then the obstacles' indices in the scenario, since they are packed in this order
    then the grid:     x, y, cell size, columns, lines, then the offset of each cell in the grid, then the
                       cells: number of circles n, of polygons p, maximum number of edges m; then x, y, r of the n
                       circles, column by column, and (n_x, n_y, c) of the p polygons for each of the m edges, also
                       column by column

A cell lists the obstacles that contribute to the proximity cost somewhere in it, so that the work at a point does not
depend on the number of distant obstacles. n and p are multiples of LANES; the remaining entries are obstacles without
any contribution. Polygons with fewer than m edges are padded with edges without any contribution. With at most
MAX_OBSTACLES_WITHOUT_GRID circles and polygons there is no grid, and columns and lines are 0, or a grid of one cell if
there are other shapes. These are not in the grid: a comparison with the circle of their proximity cost skips them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast
from weakref import WeakValueDictionary

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT
from leapnav.envs.shapes.base import Shape, call_smooth_distance, compile_shape, kind_number, shape_class
from leapnav.envs.shapes.polygon import edge_rows

# Terms of obstacles farther away than 30 sigma are skipped: they are below 1e-13 k, 1/10 of the integrator's tolerance.
CUTOFF = 30.0
CIRCLES, RECORDS, ARENA, GRID, SHAPES = 3, 4, 5, 9, 10  # indices into the packed field
# Indices into the record of a shape other than circle and polygon.
KIND, LENGTH, CENTRE, RIM, REACH, ROUNDING, N_VERTICES, VERTICES = 0, 1, 2, 4, 5, 6, 7, 8
MAX_OBSTACLES_WITHOUT_GRID = 16  # fewer obstacles are evaluated faster one by one
# Smallest and largest number of cells per axis. Between them, a cell is as large as this multiple of the reach of an
# obstacle.
MIN_GRID_CELLS, MAX_GRID_CELLS, REACHES_PER_CELL = 16, 128, 2.0
LANES = 8  # doubles in a vector register of 512 bits
FAR_AWAY = 1e30  # m, at which an obstacle does not contribute
OUTLINE_MARGIN = 1.02  # factor of the circle through the outline, between whose points a shape may be larger
N_DIRECTIONS, REACH_STEP, REACH_MARGIN = (
    64,
    1.2,
    1.1,
)  # for the circle of the proximity cost; both factors of its radius


class FieldParts(NamedTuple):
    """The obstacles of a packed field.

    Attributes:
        circles (count, 3): x, y and radius (m).
        records: the record of each obstacle of another shape.
        polygons: the rows (m, 5) of each polygon.

    """

    circles: np.ndarray
    records: list[np.ndarray]
    polygons: list[np.ndarray]


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
    header = [weight, scale, radius, 0.0, 0.0, *arena]
    parts = FieldParts(np.empty((0, 3)), [], [])
    circles: list[tuple[float, ...]] = []
    indices: tuple[list[float], list[float], list[float]] = [], [], []
    for index, shape in enumerate(shapes):
        if shape.kind == "circle":
            circles.append(shape.values())
            indices[0].append(float(index))
        elif shape.kind == "polygon":
            parts.polygons.append(np.reshape(shape.values(), (-1, 5)))
            indices[2].append(float(index))
        else:
            parts.records.append(_pack_record(shape, header))
            indices[1].append(float(index))
    parts = parts._replace(circles=np.reshape(circles, (-1, 3)))
    packed = _assemble(header, parts, [*indices[0], *indices[1], *indices[2]])
    return with_grid(packed) if grid else packed


def _pack_record(shape: Shape, header: Sequence[float]) -> np.ndarray:
    """Return the record of a shape other than circle and polygon."""
    compile_shape(type(shape))
    vertices, rounding = shape.rounded_polygon()
    centre = np.array(shape.centre())
    rim = OUTLINE_MARGIN * float(np.hypot(*(vertices - centre).T).max()) + rounding
    number = float(kind_number(shape.kind))
    rest = [*centre.tolist(), rim, 0.0, rounding, float(len(vertices)), *np.ravel(vertices).tolist(), *shape.values()]
    record = np.array([-number, len(rest), *rest])
    if not np.isfinite(record).all():
        raise ValueError(f"{shape.kind}: values() and rounded_polygon(): expected finite numbers, got {rest}")
    record[REACH] = _proximity_reach(record, header[2] + CUTOFF * header[1], header[1])
    return record


@kernel(float64(CONSTANT, float64, float64))
def _proximity_reach(record, distance, scale):
    """Radius (m) of a circle around the centre of a record outside of which its smooth distance exceeds `distance`."""
    values = record[VERTICES + 2 * int(record[N_VERTICES]) :]
    reach = record[RIM] + distance
    k = 0
    while k < N_DIRECTIONS and reach < FAR_AWAY:
        angle = 2 * math.pi * k / N_DIRECTIONS
        x, y = record[CENTRE] + reach * math.cos(angle), record[CENTRE + 1] + reach * math.sin(angle)
        k += 1
        if not call_smooth_distance(2 * int(-record[KIND]) + 1, x, y, scale, values)[0] >= distance:
            reach *= REACH_STEP
            k = 0
    return REACH_MARGIN * reach


def blend_fields(first: np.ndarray, second: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate linearly between two packed fields, obstacle by obstacle.

    Args:
        first, second: packed fields with the same kinds of obstacles.
        fraction: 0 gives the first field, 1 the second.

    Raises:
        ValueError: the fields do not contain the same kinds of obstacles.

    """
    a, b = unpack_field(first), unpack_field(second)
    if (
        len(a.circles) != len(b.circles)
        or [len(polygon) for polygon in a.polygons] != [len(polygon) for polygon in b.polygons]
        or [(len(r), r[KIND], r[N_VERTICES]) for r in a.records]
        != [(len(r), r[KIND], r[N_VERTICES]) for r in b.records]
    ):
        raise ValueError("obstacles: two fields can be blended only if they contain the same kinds of obstacles")
    header = ((1.0 - fraction) * first[:GRID] + fraction * second[:GRID]).tolist()
    blended = FieldParts((1.0 - fraction) * a.circles + fraction * b.circles, [], [])
    for record, other in zip(a.records, b.records, strict=True):
        between = (1.0 - fraction) * record + fraction * other
        between[KIND] = record[KIND]
        between[REACH] = _proximity_reach(between, header[2] + CUTOFF * header[1], header[1])
        blended.records.append(between)
    for polygon, other in zip(a.polygons, b.polygons, strict=True):
        blended.polygons.append(edge_rows((1.0 - fraction) * polygon[:, 3:] + fraction * other[:, 3:]))
    return with_grid(_assemble(header, blended, first[int(first[GRID]) - _count(a) : int(first[GRID])].tolist()))


def _count(parts: FieldParts) -> int:
    return sum(map(len, parts))


def _assemble(header: Sequence[float], parts: FieldParts, indices: Sequence[float]) -> np.ndarray:
    """Return the packed field without its grid; its counts and the index of the grid are not in `header`."""
    polygons = [value for rows in parts.polygons for value in (float(len(rows)), *rows.ravel().tolist())]
    obstacles = [*parts.circles.ravel().tolist(), *(x for record in parts.records for x in record.tolist()), *polygons]
    counts = float(len(parts.circles)), float(len(parts.records) + len(parts.polygons))
    grid_index = float(SHAPES + len(obstacles) + len(indices))
    return np.array([*header[:CIRCLES], *counts, *header[ARENA:], grid_index, *obstacles, *indices], dtype=np.float64)


def without_grid(packed: np.ndarray) -> np.ndarray:
    """Return a packed field without its grid, most of its size, if that has several cells; see `with_grid`."""
    at = int(packed[GRID])
    return packed[:at] if packed[at + 3] * packed[at + 4] > 1 else packed


def with_grid(packed: np.ndarray) -> np.ndarray:
    """Return a packed field with its grid, computed if it is missing."""
    if len(packed) > packed[GRID]:
        return packed
    field = np.concatenate([packed, _pack_grid(packed)])
    field.flags.writeable = False
    return field


def unpack_field(packed: np.ndarray) -> FieldParts:
    """Return the obstacles of a packed field."""
    at = SHAPES + 3 * int(packed[CIRCLES])
    parts = FieldParts(packed[SHAPES:at].reshape(-1, 3), [], [])
    for _ in range(int(packed[RECORDS])):
        if packed[at] < 0:
            parts.records.append(packed[at : at + 2 + int(packed[at + LENGTH])])
            at += len(parts.records[-1])
        else:
            edges = int(packed[at])
            parts.polygons.append(packed[at + 1 : at + 1 + 5 * edges].reshape(edges, 5))
            at += 1 + 5 * edges
    return parts


def record_outline(record: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the vertices (v, 2) and the radius (m) of the rounded polygon of a record, see `Shape`."""
    end = VERTICES + 2 * int(record[N_VERTICES])
    return record[VERTICES:end].reshape(-1, 2), float(record[ROUNDING])


# Fields that `check_field` has accepted, by their identity; the check takes as long as a short search.
_checked: WeakValueDictionary[int, np.ndarray] = WeakValueDictionary()


def check_field(packed: np.ndarray) -> np.ndarray:
    """Check that kernels can read a packed field, and return it, read-only and with its grid.

    Raises:
        ValueError: it is not a packed field, or one of its shapes is not known in this process.

    """
    if _checked.get(id(packed)) is packed:
        return packed
    if not isinstance(cast(object, packed), np.ndarray) or packed.dtype != np.float64 or packed.ndim != 1:
        raise ValueError(f"field: expected a vector of float64 (Scenario.field), got {packed!r}")
    if packed.flags.writeable or not packed.flags.c_contiguous:
        packed = packed.copy()
        packed.flags.writeable = False
    try:
        end = _check_obstacles(packed)
        packed = with_grid(packed)
        _check_grid(packed[end:])
    except (IndexError, OverflowError) as error:
        raise ValueError(f"field: not a packed field (Scenario.field): {error}") from None
    _checked[id(packed)] = packed
    return packed


def _check_obstacles(packed: np.ndarray) -> int:
    """Check all of a field but its grid; return the index at which the grid begins."""
    weight, scale, radius = packed[:CIRCLES].tolist()
    end = _count_at(packed, GRID)
    if not (np.isfinite(packed).all() and weight >= 0 and scale > 0 and radius > 0 and end <= len(packed)):
        raise IndexError("its first entries or its length are invalid")
    at = SHAPES + 3 * _count_at(packed, CIRCLES)
    count, is_polygon = _count_at(packed, CIRCLES), False
    for _ in range(_count_at(packed, RECORDS)):
        if packed[at] < 0 and not is_polygon:
            length, kind = 2 + _count_at(packed, at + LENGTH), shape_class(-int(packed[at + KIND]))
            if length < VERTICES or length < VERTICES + 2 * _count_at(packed, at + N_VERTICES):
                raise IndexError(f"the record of a {kind.kind} is too short")
            compile_shape(kind)
            at += length
        else:
            is_polygon = True
            if _count_at(packed, at) < 3:
                raise IndexError("a polygon has fewer than 3 edges")
            at += 1 + 5 * int(packed[at])
        count += 1
        if at > end:
            break
    if at + count != end or sorted(packed[at:end].tolist()) != list(range(count)):
        raise IndexError("the obstacles do not end where the grid begins")
    return end


def _count_at(packed: np.ndarray, index: int) -> int:
    """Return an entry that is a number of entries."""
    value = float(packed[index])
    if not (value.is_integer() and 0 <= value <= len(packed)):
        raise IndexError(f"entry {index}: expected a count, got {value!r}")
    return int(value)


def _check_grid(grid: np.ndarray) -> None:
    """Check that the offsets and the counts of the cells of a grid lie within it."""
    columns, lines = _count_at(grid, 3), _count_at(grid, 4)
    if columns * lines == 0:
        return
    offsets = grid[5 : 5 + columns * lines]
    if len(offsets) < columns * lines or not grid[2] > 0:
        raise IndexError("the grid is incomplete")
    if not ((offsets >= 5 + columns * lines) & (offsets <= len(grid) - 3) & (offsets % 1 == 0)).all():
        raise IndexError("a cell begins outside of the grid")
    n, p, m = (grid[offsets.astype(int) + k] for k in range(3))
    counts = np.array([n, p, m])
    if (counts < 0).any() or (counts % 1 != 0).any() or (counts[:2] % LANES != 0).any():
        raise IndexError("a cell has invalid counts")
    if (offsets + 3 + 3 * n + 3 * p * m > len(grid)).any():
        raise IndexError("a cell ends outside of the grid")


def obstacle_centres(packed: np.ndarray) -> np.ndarray:
    """Return the centres (n, 2) of the obstacles in the scenario's order; for a polygon, the mean of its vertices."""
    circles, records, polygons = unpack_field(packed)
    centres = [*circles[:, :2], *(record[CENTRE : CENTRE + 2] for record in records)]
    centres += [polygon[:, 3:].mean(axis=0) for polygon in polygons]
    indices = packed[int(packed[GRID]) - len(centres) : int(packed[GRID])].astype(int)
    ordered = np.empty((len(centres), 2))
    for index, centre in zip(indices, centres, strict=True):
        ordered[index] = centre
    return ordered


def _pack_grid(packed: np.ndarray) -> np.ndarray:
    """Return the grid of a field. Obstacles contribute up to CUTOFF proximity scales from the robot's rim."""
    circles, records, polygons = unpack_field(packed)
    are_few = len(circles) + len(polygons) <= MAX_OBSTACLES_WITHOUT_GRID
    if are_few and not records:
        return np.zeros(5)
    reach = packed[2] + CUTOFF * packed[1]
    # Obstacles may extend beyond the arena. A point outside the grid uses the nearest cell, which lists all obstacles
    # that contribute at the point: its projection onto the convex grid is not farther from any obstacle in the grid.
    corners = [packed[ARENA : ARENA + 4].reshape(2, 2)]
    corners += [circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    corners += [polygon[:, 3:] for polygon in polygons]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    side = float(np.max(high - low))
    count = min(max(math.ceil(side / (REACHES_PER_CELL * reach)), MIN_GRID_CELLS), MAX_GRID_CELLS)
    size = side / (1 if are_few else count)
    shape = np.ceil((high - low) / size - 1e-9).astype(int).clip(1)
    first = low + size * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    near_circles: list[list[int]] = [[] for _ in first]
    near_polygons: list[list[int]] = [[] for _ in first]
    for k, (x, y, radius) in enumerate(circles.tolist()):
        box = np.array([[x, y]]) + (radius + reach) * np.array([[-1.0], [1.0]])
        cells = _cells_in(box, low, size, shape)
        nearest = np.clip((x, y), first[cells], first[cells] + size)
        for cell in cells[np.linalg.norm(nearest - (x, y), axis=1) - radius < reach].tolist():
            near_circles[cell].append(k)
    for k, polygon in enumerate(polygons):
        cells = _cells_in(_offset(polygon, reach), low, size, shape)
        # The minimum over the cell of the distance to each half-plane; the maximum of these is a lower bound for the
        # distance to the polygon.
        lowest = np.minimum(polygon[:, :2] * size, 0.0).sum(axis=1) - polygon[:, 2]
        for cell in cells[(first[cells] @ polygon[:, :2].T + lowest).max(axis=1) < reach].tolist():
            near_polygons[cell].append(k)
    edges = np.array([len(polygon) for polygon in polygons], dtype=int)
    rows = np.zeros((len(polygons), max(edges, default=0), 3))
    rows[:, :, 2] = FAR_AWAY  # padding edges: the robot is this deep inside the half-plane
    for k, polygon in enumerate(polygons):
        rows[k, : len(polygon)] = polygon[:, :3]
    packed_cells = [
        _pack_cell(circles[a], rows[b, : edges[b].max(initial=0)])
        for a, b in zip(near_circles, near_polygons, strict=True)
    ]
    offsets = 5 + len(first) + np.cumsum([0, *map(len, packed_cells[:-1])])
    return np.concatenate([low, [size], shape, offsets, *packed_cells])


def _cells_in(points: np.ndarray, low: np.ndarray, size: float, shape: np.ndarray) -> np.ndarray:
    """Return the indices of the cells that the bounding box of points (n, 2) meets, or of the closest cells."""
    first = np.clip(((points.min(axis=0) - low) / size).astype(int), 0, shape - 1)
    last = np.clip(((points.max(axis=0) - low) / size).astype(int), 0, shape - 1)
    columns, lines = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    return (columns[:, None] * shape[1] + lines).ravel()


def _offset(polygon: np.ndarray, distance: float) -> np.ndarray:
    """Return the vertices (m, 2) of a polygon whose edges are moved outwards by a distance (m)."""
    normals, before = polygon[:, :2], np.roll(polygon[:, :2], 1, axis=0)
    return polygon[:, 3:] + distance * (normals + before) / (1.0 + (normals * before).sum(axis=1, keepdims=True))


def _pack_cell(circles: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Return the entries of a cell with circles (n, 3) and the padded rows of polygons (p, m, 3)."""
    n, p = (-(-len(obstacles) // LANES) * LANES for obstacles in (circles, polygons))
    columns = np.zeros((3, n))
    columns[0] = FAR_AWAY
    columns[:, : len(circles)] = circles.T
    rows = np.zeros((polygons.shape[1], 3, p))
    rows[:, 2] = -FAR_AWAY  # padding polygons: every half-plane is at this distance
    rows[:, :, : len(polygons)] = polygons.transpose(1, 2, 0)
    return np.concatenate([[n, p, len(rows)], columns.ravel(), rows.ravel()])
