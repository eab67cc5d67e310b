"""The packed field: obstacles, walls and proximity cost of a scenario as one array for compiled kernels.

The array contains, one after the other, a `HEADER`, the `PART` of each disc and rounded convex polygon, the `EDGE` of
each edge of a polygon, and a grid: for each cell the index at which its list begins, then the end of the last list,
then the lists. A cell lists the parts that contribute to the proximity cost somewhere in it, so that the work at a
point does not depend on the number of distant obstacles. The array has no addresses: it can be copied and pickled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast
from weakref import WeakValueDictionary

import numpy as np
from numba import from_dtype, int64, types

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import records_of
from leapnav.envs.kernels.types import CONSTANT
from leapnav.envs.shapes.barrier import CONTACT, CORNER_CONTACT
from leapnav.envs.shapes.base import Shape
from leapnav.envs.shapes.polygon import edge_rows

HEADER = np.dtype(
    [
        ("weight", "f8"),  # proximity weight
        ("scale", "f8"),  # proximity scale (m)
        ("radius", "f8"),  # radius (m) of the largest disc in the robot's outline
        ("extent", "f8"),  # largest distance (m) of the outline from the middle of a disc or rectangle of the footprint
        ("least_distance", "f8"),  # distance (scales) below which the barrier is a quadratic polynomial
        ("arena", "f8", (4,)),  # x_min, y_min, x_max, y_max (m)
        ("grid_x", "f8"),  # corner (m) of the grid
        ("grid_y", "f8"),
        ("cell_size", "f8"),  # m
        ("columns", "i8"),  # cells of the grid in x and y
        ("lines", "i8"),
        ("parts", "i8"),  # number of parts
        ("edges", "i8"),  # number of edges of all parts
    ]
)
PART = np.dtype(
    [
        ("x", "f8"),  # centre and radius (m) of a circle that contains the part
        ("y", "f8"),
        ("rim", "f8"),
        ("rounding", "f8"),  # radius (m) by which the polygon is enlarged, or that of the disc
        ("first", "i8"),  # number of the first edge
        ("edges", "i8"),  # number of edges: 0 for a disc, 2 for a capsule
        ("obstacle", "i8"),  # index in the scenario of the obstacle to which the part belongs
    ]
)
EDGE = np.dtype(
    [
        ("nx", "f8"),  # outward normal
        ("ny", "f8"),
        ("offset", "f8"),  # of the line n . p = offset (m)
        ("x", "f8"),  # first vertex (m)
        ("y", "f8"),
        ("length", "f8"),  # m
    ]
)
HEADER_SIZE, PART_SIZE, EDGE_SIZE = (kind.itemsize // 8 for kind in (HEADER, PART, EDGE))
HEADER_TYPE, PART_TYPE, EDGE_TYPE = from_dtype(HEADER), from_dtype(PART), from_dtype(EDGE)
PARTS_TYPE, EDGES_TYPE, NUMBERS = (types.Array(kind, 1, "C", readonly=True) for kind in (PART_TYPE, EDGE_TYPE, int64))
COUNT = np.dtype("i8")
COSTS = ("weight", "scale", "radius", "extent")

# Terms of obstacles farther away than 30 sigma are skipped: they are below 1e-13 k, 1/10 of the integrator's tolerance.
CUTOFF = 30.0
MAX_PARTS_WITHOUT_GRID = 16  # fewer parts are evaluated faster one by one
# Smallest and largest number of cells per axis. Between them, a cell is as large as this multiple of the reach of an
# obstacle.
MIN_GRID_CELLS, MAX_GRID_CELLS, REACHES_PER_CELL = 16, 128, 2.0

_NO_EDGES = np.empty((0, EDGE_SIZE))


@kernel(HEADER_TYPE(CONSTANT))
def header_of(field):
    """Return the `HEADER` of a packed field."""
    return records_of(field, 0, 1, HEADER)[0]


@kernel(PARTS_TYPE(CONSTANT))
def parts_in(field):
    """Return the `PART` of each disc and polygon of a packed field; the discs are first."""
    return records_of(field, HEADER_SIZE, header_of(field).parts, PART)


@kernel(EDGES_TYPE(CONSTANT, PART_TYPE))
def edges_of(field, part):
    """Return the `EDGE` of each edge of a part of a packed field; none for a disc."""
    start = HEADER_SIZE + PART_SIZE * header_of(field).parts + EDGE_SIZE * part.first
    return records_of(field, start, part.edges, EDGE)


@kernel(NUMBERS(types.float64, types.float64, CONSTANT))
def parts_near(x, y, field):
    """Return the numbers of the parts that contribute to the proximity cost at a point, and perhaps of others.

    A point outside the grid uses the nearest cell. That lists all parts that contribute at the point: its projection
    onto the grid, which is convex and contains the obstacles, is not farther away from any of them.
    """
    head = header_of(field)
    start = HEADER_SIZE + PART_SIZE * head.parts + EDGE_SIZE * head.edges
    column = min(max(int((x - head.grid_x) / head.cell_size), 0), head.columns - 1)
    line = min(max(int((y - head.grid_y) / head.cell_size), 0), head.lines - 1)
    bounds = records_of(field, start + column * head.lines + line, 2, COUNT)
    return records_of(field, start + bounds[0], bounds[1] - bounds[0], COUNT)


class FieldPart(NamedTuple):
    """A disc or a rounded convex polygon of a packed field.

    Attributes:
        vertices (m, 2): vertices (m); one for a disc.
        rounding: radius (m) by which they are enlarged.
        obstacle: index in the scenario of the obstacle to which the part belongs.

    """

    vertices: np.ndarray
    rounding: float
    obstacle: int


def pack_field(
    shapes: Sequence[Shape],
    arena: tuple[float, float, float, float],
    sizes: tuple[float, float],
    weight: float,
    scale: float,
    *,
    grid: bool = True,
) -> np.ndarray:
    """Pack obstacles, walls and proximity cost into the array that the kernels read.

    Args:
        shapes: the obstacles.
        arena: (x_min, y_min, x_max, y_max) (m).
        sizes: radius and extent (m) of the robot, see `HEADER`.
        weight, scale: proximity weight and proximity scale (m).
        grid: whether to compute the grid, which takes most of the time; clearances do not need it.

    """
    parts = []
    for index, shape in enumerate(shapes):
        for part in shape.parts():
            vertices, rounding = part.rounded_polygon()
            # A capsule of length zero is a disc.
            parts.append(FieldPart(vertices[:1] if (vertices == vertices[0]).all() else vertices, rounding, index))
    return _pack(parts, arena, (weight, scale, *sizes), grid=grid)


def _pack(parts: Sequence[FieldPart], arena: Any, costs: Sequence[float], *, grid: bool = True) -> np.ndarray:
    """Return the packed field of parts, an arena, and the values of COSTS."""
    header = np.zeros(1, HEADER)
    for name, value in zip(COSTS, costs, strict=True):
        header[name] = value
    has_corners = header["extent"] > header["radius"]
    header["least_distance"], header["arena"] = np.where(has_corners, CORNER_CONTACT, CONTACT), arena
    discs = [part for part in parts if len(part.vertices) == 1]
    polygons = [part for part in parts if len(part.vertices) > 1]
    edges = [edge_rows(part.vertices) for part in polygons]
    rows = [(*part.vertices[0].tolist(), part.rounding, part.rounding, 0, 0, part.obstacle) for part in discs]
    first = 0
    for part, lines in zip(polygons, edges, strict=True):
        x, y = centre = part.vertices.mean(axis=0)
        rim = float(np.hypot(*(part.vertices - centre).T).max()) + part.rounding
        rows.append((x, y, rim, part.rounding, first, len(lines), part.obstacle))
        first += len(lines)
    shapes = np.array(rows, PART)
    header["parts"], header["edges"] = len(rows), first
    lists: list[Sequence[int]] = [range(len(parts))]
    header["columns"] = header["lines"] = header["cell_size"] = 1
    if grid and len(parts) > MAX_PARTS_WITHOUT_GRID:
        lists = _grid_lists([*discs, *polygons], [*[_NO_EDGES] * len(discs), *edges], header[0])
    starts = len(lists) + 1 + np.cumsum([0, *map(len, lists)])
    numbers = np.concatenate([starts, *lists]).astype(COUNT)
    whole = (header, shapes, np.concatenate([_NO_EDGES, *edges]), numbers)
    field = np.concatenate([np.ascontiguousarray(one).view(np.float64).ravel() for one in whole])
    field.flags.writeable = False
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


def read_header(field: np.ndarray) -> Any:
    """Return the `HEADER` of a packed field, a record of NumPy that shares its memory."""
    return field[:HEADER_SIZE].view(HEADER)[0]


def _unpack(field: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return the header, the parts and the edges of a packed field, which share its memory."""
    header = read_header(field)
    middle = HEADER_SIZE + PART_SIZE * int(header["parts"])
    end = middle + EDGE_SIZE * int(header["edges"])
    return header, field[HEADER_SIZE:middle].view(PART), field[middle:end].view(EDGE)


def field_parts(field: np.ndarray) -> list[FieldPart]:
    """Return the parts of a packed field."""
    _, shapes, edges = _unpack(field)
    parts = []
    for x, y, _, rounding, first, count, obstacle in shapes.tolist():
        rows = edges[first : first + count]
        parts.append(
            FieldPart(np.stack([rows["x"], rows["y"]], 1) if count else np.array([[x, y]]), rounding, obstacle)
        )
    return parts


def replace_parts(field: np.ndarray, parts: Sequence[FieldPart]) -> np.ndarray:
    """Return the packed field of other parts in the same arena, with the same proximity cost."""
    header = read_header(field)
    return _pack(parts, header["arena"], [float(header[name]) for name in COSTS])


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
    if [len(part.vertices) for part in a] != [len(part.vertices) for part in b]:
        raise ValueError("obstacles: two fields can be blended only if they contain the same kinds of obstacles")
    parts = [
        FieldPart(blend(one.vertices, other.vertices), blend(one.rounding, other.rounding), one.obstacle)
        for one, other in zip(a, b, strict=True)
    ]
    one, other = read_header(first), read_header(second)
    costs = [float(blend(one[name], other[name])) for name in COSTS]
    return _pack(parts, blend(one["arena"], other["arena"]), costs)


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
    field.flags.writeable = False
    return field


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
    packed = np.ascontiguousarray(packed)
    try:
        with np.errstate(all="ignore"):
            fields = [_pack_again(packed, grid=grid) for grid in (True, False)]
    except (IndexError, OverflowError, ValueError) as error:
        raise ValueError(f"field: not a packed field (Scenario.field): {error}") from None
    if not any(_equals(packed, field) for field in fields):
        raise ValueError("field: not a packed field (Scenario.field): its entries contradict each other")
    _checked[id(fields[0])] = fields[0]
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
    if not (0 <= header["parts"] <= n and 0 <= header["edges"] <= n):
        raise IndexError("a number of parts or edges is invalid")
    _, shapes, edges = _unpack(packed)
    ends = shapes["first"] + shapes["edges"]
    if len(edges) != header["edges"] or (shapes["first"] < 0).any() or (ends > len(edges)).any():
        raise IndexError("its length is invalid")
    if ((shapes["edges"] < 0) | (shapes["edges"] == 1)).any():
        raise IndexError("a polygon has fewer than 2 edges")
    if (shapes["obstacle"] < 0).any() or (shapes["obstacle"] > n).any():
        raise IndexError("an index of an obstacle is invalid")
    costs = [float(header[name]) for name in COSTS]
    return _pack(field_parts(packed), header["arena"], costs, grid=grid)


def _equals(packed: np.ndarray, field: np.ndarray) -> bool:
    """Return whether a vector is a packed field up to the rounding of edges, which depends on the processor."""
    if len(packed) != len(field) or not np.allclose(packed, field, rtol=1e-9, atol=1e-9):
        return False
    (header, shapes, edges), (expected, others, _) = _unpack(packed), _unpack(field)
    end = HEADER_SIZE + PART_SIZE * len(shapes) + EDGE_SIZE * len(edges)
    integers = [name for name in PART.names or () if PART[name] == COUNT]
    return (
        all(np.array_equal(shapes[name], others[name]) for name in integers)
        and (header["columns"], header["lines"]) == (expected["columns"], expected["lines"])
        and np.array_equal(packed[end:].view(COUNT), field[end:].view(COUNT))
    )


def obstacle_centres(packed: np.ndarray) -> np.ndarray:
    """Return a point inside each obstacle in the scenario's order, (n, 2): the centre of its first part."""
    _, shapes, _ = _unpack(packed)
    first = np.unique(shapes["obstacle"], return_index=True)[1]
    return np.stack([shapes["x"], shapes["y"]], axis=1)[first]
