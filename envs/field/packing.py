"""Packing of obstacles, walls and proximity cost into the array that the kernels read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, cast
from weakref import WeakValueDictionary

import numpy as np

from leapnav.envs.field.barrier import CONTACT, CORNER_CONTACT
from leapnav.envs.field.layout import (
    COUNT,
    CUTOFF,
    EDGE,
    EDGE_SIZE,
    HEADER,
    HEADER_SIZE,
    KNOT_SIZE,
    PART,
    PART_SIZE,
    read_header,
)
from leapnav.envs.kernels.types import constant
from leapnav.envs.shapes.base import Shape
from leapnav.envs.shapes.polygon import edge_rows

COSTS = ("weight", "scale", "radius", "extent")

MAX_PARTS_WITHOUT_GRID = 16  # fewer parts are evaluated faster one by one
# Smallest and largest number of cells per axis. Between them, a cell is as large as this multiple of the reach of an
# obstacle.
MIN_GRID_CELLS, MAX_GRID_CELLS, REACHES_PER_CELL = 16, 128, 2.0

_NO_EDGES = np.empty((0, EDGE_SIZE))
NO_KNOTS = np.empty((0, KNOT_SIZE))

# Fields that were packed here with their grids, by their identity; to check a field takes as long as a short search.
_checked: WeakValueDictionary[int, np.ndarray] = WeakValueDictionary()


class FieldPart(NamedTuple):
    """A disc or a rounded convex polygon of a packed field.

    Attributes:
        vertices (m, 2): vertices (m); one for a disc.
        rounding: radius (m) by which they are enlarged.
        obstacle: index in the scenario of the obstacle to which the part belongs.
        knots (K, 5): of its path, see `KNOT`; none at rest.

    """

    vertices: np.ndarray
    rounding: float
    obstacle: int
    knots: np.ndarray = NO_KNOTS


def pack_field(
    shapes: Sequence[Shape],
    arena: tuple[float, float, float, float],
    sizes: tuple[float, float],
    weight: float,
    scale: float,
    *,
    motions: Sequence[np.ndarray] = (),
    clock: int = 0,
    grid: bool = True,
) -> np.ndarray:
    """Pack obstacles, walls and proximity cost into the array that the kernels read.

    Args:
        shapes: the obstacles.
        arena: (x_min, y_min, x_max, y_max) (m).
        sizes: radius and extent (m) of the robot, see `HEADER`.
        weight, scale: proximity weight and proximity scale (m).
        motions: for each obstacle the knots (K, 5) of its path, see `KNOT`; empty if all are at rest.
        clock: index of the time in a state.
        grid: whether to compute the grid, which takes most of the time; clearances do not need it.

    """
    parts = []
    for index, shape in enumerate(shapes):
        knots = motions[index] if motions else NO_KNOTS
        for part in shape.parts():
            vertices, rounding = part.rounded_polygon()
            # A capsule of length zero is a disc.
            is_disc = len(vertices) == 1 or bool((vertices == vertices[0]).all())
            parts.append(FieldPart(vertices[:1] if is_disc else vertices, rounding, index, knots))
    return _pack(parts, arena, (weight, scale, *sizes), clock, grid=grid)


def _pack(
    parts: Sequence[FieldPart], arena: Any, costs: Sequence[float], clock: int = 0, *, grid: bool = True
) -> np.ndarray:
    """Return the packed field of parts, an arena, and the values of COSTS."""
    header = np.zeros(1, HEADER)
    for name, value in zip(COSTS, costs, strict=True):
        header[name] = value
    has_corners = header["extent"] > header["radius"]
    header["least_distance"], header["arena"] = np.where(has_corners, CORNER_CONTACT, CONTACT), arena
    resting, moving = ([part for part in parts if bool(len(part.knots)) == moves] for moves in (False, True))
    resting.sort(key=lambda part: len(part.vertices) > 1)  # discs first
    ordered = [*resting, *moving]
    edges = [edge_rows(part.vertices) if len(part.vertices) > 1 else _NO_EDGES for part in ordered]
    rows, first, first_knot = [], 0, 0
    for part, lines in zip(ordered, edges, strict=True):
        rim = part.rounding
        if len(lines):
            x, y = centre = part.vertices.mean(axis=0)
            rim += float(np.hypot(*(part.vertices - centre).T).max())
        else:
            x, y = part.vertices[0].tolist()
        rows.append((x, y, rim, part.rounding, first, len(lines), part.obstacle, first_knot, len(part.knots)))
        first, first_knot = first + len(lines), first_knot + len(part.knots)
    header["parts"], header["edges"], header["moving"], header["knots"] = len(rows), first, len(moving), first_knot
    knots = np.concatenate([NO_KNOTS, *(part.knots for part in ordered)])
    header["top_speed"], header["clock"] = np.hypot(*knots[:, 3:].T).max(initial=0.0), clock if moving else 0
    lists: list[Sequence[int]] = [range(len(resting))]
    header["columns"] = header["lines"] = header["cell_size"] = 1
    if grid and len(resting) > MAX_PARTS_WITHOUT_GRID:
        lists = _grid_lists(resting, edges[: len(resting)], header[0])
    starts = len(lists) + 1 + np.cumsum([0, *map(len, lists)])
    numbers = np.concatenate([starts, *lists]).astype(COUNT)
    whole = (header, np.array(rows, PART), np.concatenate([_NO_EDGES, *edges]), knots, numbers)
    field = np.concatenate([np.ascontiguousarray(one).view(np.float64).ravel() for one in whole])
    field.flags.writeable = False
    if grid:
        _checked[id(field)] = field
    return field


def _grid_lists(parts: Sequence[FieldPart], edges: Sequence[np.ndarray], header: Any) -> list[Sequence[int]]:
    """Return the parts that contribute in each cell of a grid, which is written to the header.

    Obstacles contribute up to CUTOFF proximity scales from the robot's outline. They may extend beyond the arena.
    """
    reach = float(header["extent"] + CUTOFF * header["scale"])
    corners = [header["arena"].reshape(2, 2)]
    corners += [part.vertices + side * part.rounding for part in parts for side in (-1.0, 1.0)]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    side = float(np.max(high - low))
    size = side / min(max(math.ceil(side / (REACHES_PER_CELL * reach)), MIN_GRID_CELLS), MAX_GRID_CELLS)
    counts = np.ceil((high - low) / size - 1e-9).astype(int).clip(1)
    (header["grid_x"], header["grid_y"]), header["cell_size"] = low, size
    header["columns"], header["lines"] = counts
    first = low + size * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 2)
    near: list[list[int]] = [[] for _ in first]
    for number, (part, rows) in enumerate(zip(parts, edges, strict=True)):
        distance = reach + part.rounding
        cells = _cells_in(np.concatenate([part.vertices - distance, part.vertices + distance]), low, size, counts)
        if len(rows):
            # The minimum over the cell of the distance to each half-plane; the maximum of these is a lower bound for
            # the distance to the polygon.
            lowest = np.minimum(rows[:, :2] * size, 0.0).sum(axis=1) - rows[:, 2]
            bounds = (first[cells] @ rows[:, :2].T + lowest).max(axis=1)
        else:
            nearest = np.clip(part.vertices[0], first[cells], first[cells] + size)
            bounds = np.linalg.norm(nearest - part.vertices[0], axis=1)
        for cell in cells[bounds < distance].tolist():
            near[cell].append(number)
    return list(near)


def _cells_in(points: np.ndarray, low: np.ndarray, size: float, shape: np.ndarray) -> np.ndarray:
    """Return the indices of the cells that the bounding box of points (n, 2) meets, or of the closest cells."""
    first = np.clip(((points.min(axis=0) - low) / size).astype(int), 0, shape - 1)
    last = np.clip(((points.max(axis=0) - low) / size).astype(int), 0, shape - 1)
    columns, lines = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    return (columns[:, None] * shape[1] + lines).ravel()


def _unpack(field: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Return the header, the parts, the edges and the knots (K, 5) of a packed field, which share its memory."""
    header, ends = read_header(field), [HEADER_SIZE]
    for name, size in (("parts", PART_SIZE), ("edges", EDGE_SIZE), ("knots", KNOT_SIZE)):
        ends.append(ends[-1] + size * int(header[name]))
    shapes, edges, knots = (field[start:end] for start, end in pairwise(ends))
    return header, shapes.view(PART), edges.view(EDGE), knots.reshape(-1, KNOT_SIZE)


def field_parts(field: np.ndarray) -> list[FieldPart]:
    """Return the parts of a packed field, the moving ones where they are given."""
    _, shapes, edges, knots = _unpack(field)
    parts = []
    for x, y, _, rounding, first, count, obstacle, first_knot, n_knots in shapes.tolist():
        rows, path = edges[first : first + count], knots[first_knot : first_knot + n_knots]
        vertices = np.stack([rows["x"], rows["y"]], 1) if count else np.array([[x, y]])
        parts.append(FieldPart(vertices, rounding, obstacle, path))
    return parts


def displacements(knots: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the displacements (N, 2) (m) along a path, given by its knots (K, 5), at times (N,) (s)."""
    pieces = np.searchsorted(knots[:, 0], times, side="right") - 1
    rows = knots[np.maximum(pieces, 0)]
    moved = rows[:, 1:3] + (times - rows[:, 0])[:, None] * rows[:, 3:]
    return np.where((pieces >= 0)[:, None], moved, 0.0)


def parts_at(field: np.ndarray, time: float) -> list[FieldPart]:
    """Return the parts of a packed field at rest, where they are at a time (s)."""
    at = np.array([time])
    return [
        part._replace(vertices=part.vertices + displacements(part.knots, at), knots=NO_KNOTS)
        if len(part.knots)
        else part
        for part in field_parts(field)
    ]


def replace_parts(field: np.ndarray, parts: Sequence[FieldPart]) -> np.ndarray:
    """Return the packed field of other parts in the same arena, with the same proximity cost."""
    header = read_header(field)
    return _pack(parts, header["arena"], [float(header[name]) for name in COSTS], int(header["clock"]))


def blend_fields(first: np.ndarray, second: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate linearly between two packed fields, obstacle by obstacle.

    Args:
        first, second: packed fields with the same kinds of obstacles.
        fraction: 0 gives the first field, 1 the second.

    Raises:
        ValueError: the fields do not contain the same kinds of obstacles.

    """

    def blend(a: Any, b: Any) -> Any:
        return (1.0 - fraction) * a + fraction * b

    a, b = field_parts(first), field_parts(second)
    if [(len(part.vertices), len(part.knots)) for part in a] != [(len(part.vertices), len(part.knots)) for part in b]:
        raise ValueError("obstacles: two fields can be blended only if they contain the same kinds of obstacles")
    parts = [
        one._replace(
            vertices=blend(one.vertices, other.vertices),
            rounding=blend(one.rounding, other.rounding),
            knots=blend(one.knots, other.knots),
        )
        for one, other in zip(a, b, strict=True)
    ]
    one, other = read_header(first), read_header(second)
    costs = [float(blend(one[name], other[name])) for name in COSTS]
    return _pack(parts, blend(one["arena"], other["arena"]), costs, int(one["clock"]))


def with_weight(packed: np.ndarray, weight: float, least_distance: float | None = None) -> np.ndarray:
    """Return a packed field with a given proximity weight.

    Args:
        packed: the field.
        weight: proximity weight.
        least_distance: distance (proximity scales) below which the barrier is a quadratic polynomial; None for that of
            the field.

    """
    header = read_header(packed)
    if least_distance is None:
        least_distance = float(header["least_distance"])
    if header["weight"] == weight and header["least_distance"] == least_distance:
        return packed
    field = packed.copy()
    header = read_header(field)
    header["weight"], header["least_distance"] = weight, least_distance
    return constant(field)


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
    packed = np.ascontiguousarray(packed)
    try:
        with np.errstate(all="ignore"):
            fields = [_pack_again(packed, grid=grid) for grid in (True, False)]
    except (IndexError, OverflowError, ValueError) as error:
        raise ValueError(f"field: not a packed field (Scenario.field): {error}") from None
    if not any(_equals(packed, field) for field in fields):
        raise ValueError("field: not a packed field (Scenario.field): its entries contradict each other")
    return fields[0]


def _pack_again(packed: np.ndarray, *, grid: bool) -> np.ndarray:
    """Return the packed field of the parts of a field.

    Raises:
        IndexError, ValueError: the vector is not a packed field.

    """
    if len(packed) < HEADER_SIZE or not np.isfinite(packed).all():
        raise IndexError("expected a header and finite numbers")
    header, n = read_header(packed), len(packed)
    if not (header["weight"] >= 0 and header["scale"] > 0 and 0 < header["radius"] <= header["extent"]):
        raise IndexError("weight, scale, radius or extent is invalid")
    if not all(0 <= header[name] <= n for name in ("parts", "edges", "knots", "clock")):
        raise IndexError("a number of parts, edges or knots is invalid")
    _, shapes, edges, knots = _unpack(packed)
    for rows, first, count in ((edges, "first", "edges"), (knots, "first_knot", "knots")):
        ends = shapes[first] + shapes[count]
        if len(rows) != header[count] or (shapes[first] < 0).any() or (ends > len(rows)).any():
            raise IndexError("its length is invalid")
    if ((shapes["edges"] < 0) | (shapes["edges"] == 1)).any():
        raise IndexError("a polygon has fewer than 2 edges")
    if (shapes["obstacle"] < 0).any() or (shapes["obstacle"] > n).any():
        raise IndexError("an index of an obstacle is invalid")
    costs = [float(header[name]) for name in COSTS]
    return _pack(field_parts(packed), header["arena"], costs, int(header["clock"]), grid=grid)


def _equals(packed: np.ndarray, field: np.ndarray) -> bool:
    """Return whether a vector is a packed field up to the rounding of edges, which depends on the processor."""
    if len(packed) != len(field) or not np.allclose(packed, field, rtol=1e-9, atol=1e-9):
        return False
    (header, shapes, edges, knots), (expected, others, *_) = _unpack(packed), _unpack(field)
    end = HEADER_SIZE + PART_SIZE * len(shapes) + EDGE_SIZE * len(edges) + knots.size
    integers = [name for name in PART.names or () if PART[name] == COUNT]
    return (
        all(np.array_equal(shapes[name], others[name]) for name in integers)
        and (header["columns"], header["lines"]) == (expected["columns"], expected["lines"])
        and np.array_equal(packed[end:].view(COUNT), field[end:].view(COUNT))
    )


def obstacle_centres(packed: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return a point inside each obstacle in the scenario's order at times (N,) (s): the centre of its first part.

    The shape of the result is (N, n, 2).
    """
    _, shapes, _, knots = _unpack(packed)
    centres = np.empty((len(times), 0, 2))
    for number in np.unique(shapes["obstacle"], return_index=True)[1]:
        x, y, *_, first, count = shapes[number].tolist()
        moved = displacements(knots[first : first + count], times) if count else np.zeros((len(times), 2))
        centres = np.concatenate([centres, (moved + np.array([x, y]))[:, None]], axis=1)
    return centres
