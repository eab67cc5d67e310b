"""The packed field: obstacles, walls and proximity cost of a scenario as one array for compiled kernels.

The array contains, one after the other, a `HEADER`, the `PART` of each disc and rounded convex polygon, the `EDGE` of
each edge of a polygon, the `KNOT`s of the paths of moving parts, and a grid: for each cell the index at which its list
begins, then the end of the last list, then the lists. A cell lists the parts at rest that contribute to the proximity
cost somewhere in it, so that the work at a point does not depend on the number of distant obstacles. The moving parts
are the last ones. The array has no addresses: it can be copied and pickled.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import from_dtype, int64, types

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import records_of
from leapnav.envs.kernels.types import CONSTANT

HEADER = np.dtype(
    [
        ("weight", "f8"),  # proximity weight
        ("scale", "f8"),  # proximity scale (m)
        ("radius", "f8"),  # radius (m) of the largest disc in the robot's outline
        ("extent", "f8"),  # largest distance (m) of the outline from the middle of a disc or rectangle of the footprint
        ("top_speed", "f8"),  # largest speed (m/s) of a moving part
        ("least_distance", "f8"),  # distance (scales) below which the barrier is a quadratic polynomial
        ("arena", "f8", (4,)),  # x_min, y_min, x_max, y_max (m)
        ("grid_x", "f8"),  # corner (m) of the grid
        ("grid_y", "f8"),
        ("cell_size", "f8"),  # m
        ("columns", "i8"),  # cells of the grid in x and y
        ("lines", "i8"),
        ("parts", "i8"),  # number of parts
        ("edges", "i8"),  # number of edges of all parts
        ("moving", "i8"),  # number of moving parts
        ("knots", "i8"),  # number of knots of all parts
        ("clock", "i8"),  # index of the time in a state, if a part moves; shorter states are those at time 0
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
        ("first_knot", "i8"),  # number of the first knot
        ("knots", "i8"),  # number of knots: 0 at rest
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
# A path is linear between its knots. Before the first one the part is where it is given; after the last one it keeps
# its velocity.
KNOT = np.dtype(
    [
        ("time", "f8"),  # s
        ("x", "f8"),  # displacement (m)
        ("y", "f8"),
        ("vx", "f8"),  # velocity (m/s) after this time
        ("vy", "f8"),
    ]
)
KINDS = HEADER, PART, EDGE, KNOT
HEADER_SIZE, PART_SIZE, EDGE_SIZE, KNOT_SIZE = (kind.itemsize // 8 for kind in KINDS)
HEADER_TYPE, PART_TYPE, EDGE_TYPE, KNOT_TYPE = map(from_dtype, KINDS)
PARTS_TYPE, EDGES_TYPE, KNOTS_TYPE, NUMBERS = (
    types.Array(kind, 1, "C", readonly=True) for kind in (PART_TYPE, EDGE_TYPE, KNOT_TYPE, int64)
)
COUNT = np.dtype("i8")
# Terms of obstacles farther away than 30 sigma are skipped: they are below 1e-13 k, 1/10 of the integrator's tolerance.
CUTOFF = 30.0


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


@kernel(KNOTS_TYPE(CONSTANT, PART_TYPE))
def knots_of(field, part):
    """Return the `KNOT`s of the path of a part of a packed field; none at rest."""
    head = header_of(field)
    start = HEADER_SIZE + PART_SIZE * head.parts + EDGE_SIZE * head.edges + KNOT_SIZE * part.first_knot
    return records_of(field, start, part.knots, KNOT)


@kernel(int64(CONSTANT, PART_TYPE, types.float64))
def piece_at(field, part, time):
    """Return the number of the piece of a moving part's path at a time (s), 0 before the first knot."""
    knots, low, high = knots_of(field, part), 0, part.knots
    while low < high:
        middle = (low + high) // 2
        if knots[middle].time <= time:
            low = middle + 1
        else:
            high = middle
    return low


@kernel(types.float64(CONSTANT, types.float64))
def time_to_knot(field, time):
    """Return the time (s) after which a moving part reaches the next knot of its path; infinite if none does."""
    header, parts = header_of(field), parts_in(field)
    found = np.inf
    for number in range(header.parts - header.moving, header.parts):
        part = parts[number]
        piece = piece_at(field, part, time)
        if piece < part.knots:
            found = min(found, knots_of(field, part)[piece].time - time)
    return found


@kernel(types.UniTuple(types.float64, 4)(CONSTANT, PART_TYPE, types.float64))
def motion_of(field, part, time):
    """Return the displacement (2) (m) and the velocity (2) (m/s) of a part at a time (s)."""
    piece = piece_at(field, part, time)
    if piece == 0:
        return 0.0, 0.0, 0.0, 0.0
    knot = knots_of(field, part)[piece - 1]
    elapsed = time - knot.time
    return knot.x + elapsed * knot.vx, knot.y + elapsed * knot.vy, knot.vx, knot.vy


@kernel(types.UniTuple(types.float64, 2)(CONSTANT, PART_TYPE, types.float64), forceinline=True)
def displacement_of(field, part, time):
    """Return the displacement (2) (m) of a part at a time (s); 0 of one at rest."""
    if part.knots == 0:
        return 0.0, 0.0
    dx, dy, _, _ = motion_of(field, part, time)
    return dx, dy


@kernel(types.float64(CONSTANT, CONSTANT), forceinline=True)
def time_of(q, field):
    """Return the time (s) of a state, which is its entry with the index `clock` of the field; 0 if it has none."""
    clock = header_of(field).clock
    return q[clock] if 0 < clock < len(q) else 0.0


@kernel(NUMBERS(types.float64, types.float64, CONSTANT))
def parts_near(x, y, field):
    """Return the numbers of the parts at rest that contribute to the proximity cost at a point, and perhaps of others.

    A point outside the grid uses the nearest cell. That lists all parts that contribute at the point: its projection
    onto the grid, which is convex and contains the obstacles, is not farther away from any of them.
    """
    head = header_of(field)
    start = HEADER_SIZE + PART_SIZE * head.parts + EDGE_SIZE * head.edges + KNOT_SIZE * head.knots
    column = min(max(int((x - head.grid_x) / head.cell_size), 0), head.columns - 1)
    line = min(max(int((y - head.grid_y) / head.cell_size), 0), head.lines - 1)
    bounds = records_of(field, start + column * head.lines + line, 2, COUNT)
    return records_of(field, start + bounds[0], bounds[1] - bounds[0], COUNT)


def read_header(field: np.ndarray) -> Any:
    """Return the `HEADER` of a packed field, a record of NumPy that shares its memory."""
    return field[:HEADER_SIZE].view(HEADER)[0]
