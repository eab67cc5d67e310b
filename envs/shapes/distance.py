"""Exact distances from a point to walls, circles and rounded convex polygons (kernels).

Each shape has one kernel: (x, y) -> signed distance, outward unit normal, curvature of its level line. The gradient of
the distance is the normal, and its Hessian is the curvature times t t' with the tangent t.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of
from leapnav.envs.shapes.field import ARENA, COLUMNS, POLYGON_HEAD, ROUNDING

# Smallest distance (m) from a point, the centre of a circle or a vertex, with which normal and curvature are computed;
# only guesses deep in an obstacle come closer.
MIN_DISTANCE = 1e-3


@kernel(float64(float64, float64, CONSTANT, int64), inline="always")
def wall_distance(x, y, field, side):
    """Distance (m) to a wall, positive inside the arena; `side` is 0 to 3 for x_min, y_min, x_max, y_max."""
    sign = 1.0 if side < 2 else -1.0
    return sign * ((x if side % 2 == 0 else y) - field[ARENA + side])


@kernel(tuple_of(*[float64] * 4)(float64, float64, float64), inline="always")
def circle_geometry(dx, dy, radius):
    """Signed distance (m), normal (2) and curvature (1/m) for a circle.

    Args:
        dx, dy: position relative to the centre (m).
        radius: of the circle (m).

    """
    distance = math.sqrt(dx * dx + dy * dy)
    curvature = 1.0 / (distance if distance > MIN_DISTANCE else MIN_DISTANCE)
    return distance - radius, dx * curvature, dy * curvature, curvature


@kernel(tuple_of(float64, int64, float64)(float64, float64, CONSTANT, int64), inline="always")
def _nearest_edge(x, y, field, at):
    """Edge of a polygon whose line is farthest away: (signed distance of the line (m), index of the edge, beyond).

    `beyond` is the coordinate (m) along the line beyond the ends of the edge: negative before its first vertex,
    positive after its second, zero between them.
    """
    largest, nearest = -np.inf, at + POLYGON_HEAD
    row = at + POLYGON_HEAD
    for _ in range(int(field[at])):
        height = field[row] * x + field[row + 1] * y - field[row + 2]
        if height > largest:
            largest, nearest = height, row
        row += COLUMNS
    along = field[nearest] * (y - field[nearest + 4]) - field[nearest + 1] * (x - field[nearest + 3])
    return largest, nearest, min(along, max(along - field[nearest + 5], 0.0))


@kernel(int64(float64, float64, CONSTANT, int64, float64), inline="always")
def closest_feature(x, y, field, at, reach):
    """Index in the field of the edge or of the vertex of a rounded polygon that is closest to a point outside.

    A vertex has the index of the edge that begins there, plus 1. The curvature of the distance is continuous where the
    feature does not change. Beyond the distance `reach` (m) the result is 0.
    """
    largest, nearest, beyond = _nearest_edge(x, y, field, at)
    if math.sqrt(largest * largest + beyond * beyond) - field[at + ROUNDING] >= reach:
        return 0
    if beyond <= 0.0:
        return nearest if beyond == 0.0 else nearest + 1
    following = nearest + COLUMNS
    return following + 1 if following < at + POLYGON_HEAD + COLUMNS * int(field[at]) else at + POLYGON_HEAD + 1


@kernel(tuple_of(*[float64] * 4)(float64, float64, CONSTANT, int64), inline="always")
def polygon_geometry(x, y, field, at):
    """Signed distance (m), normal (2) and curvature (1/m) for a rounded convex polygon.

    The nearest point of the polygon is on the edge whose line is farthest away, or one of its ends.

    Args:
        x, y: the point (m).
        field: packed obstacle field.
        at: index at which the polygon begins in the field.

    """
    largest, nearest, beyond = _nearest_edge(x, y, field, at)
    nx, ny, rounding = field[nearest], field[nearest + 1], field[at + ROUNDING]
    if beyond == 0.0:  # everywhere inside
        return largest - rounding, nx, ny, 0.0
    distance = math.sqrt(largest * largest + beyond * beyond)
    curvature = 1.0 / (distance if distance > MIN_DISTANCE else MIN_DISTANCE)
    across, beside = largest * curvature, beyond * curvature
    return distance - rounding, across * nx - beside * ny, across * ny + beside * nx, curvature
