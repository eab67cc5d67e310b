"""The proximity cost Phi of a packed obstacle field (kernels), with gradient and Hessian or without.

Phi sums a term for each wall and each part of an obstacle: the proximity weight times the barrier function of
distance / proximity scale, where the distance is that from the robot's outline.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, MATRIX, VECTOR, tuple_of
from leapnav.envs.shapes.barrier import barrier
from leapnav.envs.shapes.distance import circle_geometry, closest_feature, polygon_geometry, wall_distance
from leapnav.envs.shapes.field import (
    CENTRE,
    CIRCLES,
    COLUMNS,
    CUTOFF,
    GRID,
    LEAST_DISTANCE,
    POLYGON_HEAD,
    POLYGONS,
    RIM,
    SHAPES,
)

VALUE_CUTOFF = 20.0  # proximity scales beyond which a term is skipped where nothing is differentiated
HASH_FACTOR = 31  # of numbers that are combined to one


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, float64, CONSTANT), inline="always")
def barrier_term(distance, nx, ny, curvature, field):
    """Barrier of a distance, with gradient and Hessian.

    Args:
        distance: from the robot's outline (m).
        nx, ny, curvature: gradient of the distance, and curvature of its level line (1/m).
        field: packed obstacle field.

    """
    steepness = 1.0 / field[1]
    value, slope, bend = barrier(distance * steepness, field[LEAST_DISTANCE])
    slope *= steepness
    curl = slope * curvature
    bend = bend * steepness * steepness - curl
    return value, slope * nx, slope * ny, bend * nx * nx + curl, bend * nx * ny, bend * ny * ny + curl


@kernel(int64(float64, float64, CONSTANT), inline="always")
def cell_of(x, y, field):
    """Index in the field of the cell of its grid at (x, y); 0 without a grid."""
    grid = int(field[GRID])
    columns, lines = int(field[grid + 3]), int(field[grid + 4])
    if columns == 0:
        return 0
    column = min(max(int((x - field[grid]) / field[grid + 2]), 0), columns - 1)
    line = min(max(int((y - field[grid + 1]) / field[grid + 2]), 0), lines - 1)
    return grid + int(field[grid + 5 + column * lines + line])


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, float64, CONSTANT, int64), inline="always")
def _polygon_term(x, y, radius, reach, field, at):
    """Barrier of the rounded polygon at an index of the field, zero beyond `reach` (m), with gradient and Hessian."""
    dx, dy, rim = x - field[at + CENTRE], y - field[at + CENTRE + 1], field[at + RIM] + radius
    if dx * dx + dy * dy < (rim + reach) ** 2:
        distance, nx, ny, curvature = polygon_geometry(x, y, field, at)
        if distance - radius < reach:
            return barrier_term(distance - radius, nx, ny, curvature, field)
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, float64, CONSTANT, int64), inline="always")
def _circle_term(x, y, radius, reach, field, at):
    """Barrier of the circle at an index of the field, zero beyond `reach` (m), with gradient and Hessian."""
    dx, dy, rim = x - field[at], y - field[at + 1], field[at + 2] + radius
    if dx * dx + dy * dy >= (rim + reach) ** 2:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    distance, nx, ny, curvature = circle_geometry(dx, dy, rim)
    return barrier_term(distance, nx, ny, curvature, field)


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT))
def disc_proximity(x, y, radius, field):
    """Proximity cost of a disc: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    reach = CUTOFF * field[1]
    value = gx = gy = hxx = hxy = hyy = 0.0
    for side in range(4):
        distance = wall_distance(x, y, field, side) - radius
        if distance < reach:
            sign = 1.0 if side < 2 else -1.0
            nx, ny = (sign, 0.0) if side % 2 == 0 else (0.0, sign)
            b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, 0.0, field)
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    cell = cell_of(x, y, field)
    if cell == 0:
        at = SHAPES
        for _ in range(int(field[CIRCLES])):
            b, bx, by, bxx, bxy, byy = _circle_term(x, y, radius, reach, field, at)
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
            at += 3
        for _ in range(int(field[POLYGONS])):
            b, bx, by, bxx, bxy, byy = _polygon_term(x, y, radius, reach, field, at)
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
            at += POLYGON_HEAD + COLUMNS * int(field[at])
    else:
        first = cell + 2 + int(field[cell])
        for i in range(cell + 2, first):
            b, bx, by, bxx, bxy, byy = _circle_term(x, y, radius, reach, field, int(field[i]))
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
        for i in range(first, first + int(field[cell + 1])):
            b, bx, by, bxx, bxy, byy = _polygon_term(x, y, radius, reach, field, int(field[i]))
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    k = field[0]
    return k * value, k * gx, k * gy, k * hxx, k * hxy, k * hyy


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT))
def proximity(x, y, field):
    """Proximity cost of a disc with the radius of the field, see `disc_proximity`."""
    return disc_proximity(x, y, field[2], field)


@kernel(tuple_of(*[float64] * 3)(float64, float64, float64, float64, float64, float64, float64, CONSTANT))
def proximity_values(xa, ya, xb, yb, xc, yc, radius, field):
    """Proximity cost, as `proximity_value`, at three points near each other, the second between the others.

    One test of the distance serves all three, which takes half the time of three calls.
    """
    if field[int(field[GRID]) + 3] > 0.0:  # the cells of the grid list the relevant obstacles
        first, second = disc_proximity(xa, ya, radius, field)[0], disc_proximity(xb, yb, radius, field)[0]
        return first, second, disc_proximity(xc, yc, radius, field)[0]
    steepness, contact = 1.0 / field[1], field[LEAST_DISTANCE]
    apart = max(abs(xa - xb) + abs(ya - yb), abs(xc - xb) + abs(yc - yb))
    reach = VALUE_CUTOFF * field[1] + apart
    first = second = third = 0.0
    for side in range(4):
        between = wall_distance(xb, yb, field, side) - radius
        if between < reach:
            first += barrier((wall_distance(xa, ya, field, side) - radius) * steepness, contact)[0]
            second += barrier(between * steepness, contact)[0]
            third += barrier((wall_distance(xc, yc, field, side) - radius) * steepness, contact)[0]
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        x, y, rim = field[at], field[at + 1], field[at + 2] + radius
        at += 3
        if (xb - x) ** 2 + (yb - y) ** 2 < (rim + reach) ** 2:
            first += barrier(circle_geometry(xa - x, ya - y, rim)[0] * steepness, contact)[0]
            second += barrier(circle_geometry(xb - x, yb - y, rim)[0] * steepness, contact)[0]
            third += barrier(circle_geometry(xc - x, yc - y, rim)[0] * steepness, contact)[0]
    for _ in range(int(field[POLYGONS])):
        x, y, rim = field[at + CENTRE], field[at + CENTRE + 1], field[at + RIM] + radius
        if (xb - x) ** 2 + (yb - y) ** 2 < (rim + reach) ** 2:
            first += barrier((polygon_geometry(xa, ya, field, at)[0] - radius) * steepness, contact)[0]
            second += barrier((polygon_geometry(xb, yb, field, at)[0] - radius) * steepness, contact)[0]
            third += barrier((polygon_geometry(xc, yc, field, at)[0] - radius) * steepness, contact)[0]
        at += POLYGON_HEAD + COLUMNS * int(field[at])
    weight = field[0]
    return weight * first, weight * second, weight * third


@kernel(float64(float64, float64, float64, CONSTANT))
def proximity_value(x, y, radius, field):
    """Proximity cost of a disc, without derivatives, to 2e-9 of the weight for each obstacle."""
    return proximity_values(x, y, x, y, x, y, radius, field)[1]


@kernel(tuple_of(*[float64] * 10)(float64, float64, float64, CONSTANT, int64, CONSTANT))
def footprint_proximity(x, y, heading, data, first, field):
    """Proximity cost of a footprint: the sum over its discs.

    Args:
        x, y, heading: pose (m, rad).
        data: offset along the robot's axis and radius (m) of each disc, from the index `first` to the end.
        first: see `data`.
        field: packed obstacle field.

    Returns:
        (Phi, Phi_x, Phi_y, Phi_h, Phi_xx, Phi_xy, Phi_xh, Phi_yy, Phi_yh, Phi_hh); h is the heading.

    """
    cos, sin = math.cos(heading), math.sin(heading)
    value = gx = gy = gh = hxx = hxy = hxh = hyy = hyh = hhh = 0.0
    for k in range(first, len(data), 2):
        a = data[k]
        term, tx, ty, txx, txy, tyy = disc_proximity(x + a * cos, y + a * sin, data[k + 1], field)
        # Derivatives of the disc's centre with respect to the heading.
        dx, dy = -a * sin, a * cos
        value += term
        gx += tx
        gy += ty
        gh += tx * dx + ty * dy
        hxx += txx
        hxy += txy
        hyy += tyy
        hxh += txx * dx + txy * dy
        hyh += txy * dx + tyy * dy
        hhh += (txx * dx + 2.0 * txy * dy) * dx + tyy * dy * dy - a * (tx * cos + ty * sin)
    return value, gx, gy, gh, hxx, hxy, hxh, hyy, hyh, hhh


@kernel(int64(float64, float64, float64, CONSTANT, int64), inline="always")
def _feature(x, y, radius, field, at):
    """Index of the feature of the polygon at an index of the field that is closest to a disc; 0 if it is far away."""
    reach = CUTOFF * field[1] + radius
    dx, dy = x - field[at + CENTRE], y - field[at + CENTRE + 1]
    if dx * dx + dy * dy >= (field[at + RIM] + reach) ** 2:
        return 0
    return closest_feature(x, y, field, at, reach)


@kernel(int64(float64, float64, float64, CONSTANT))
def disc_features(x, y, radius, field):
    """Number of the edges and vertices of polygons that are closest to a disc.

    The number changes where second derivatives of the proximity cost are discontinuous, apart from negligible terms.
    """
    number, cell = 0, cell_of(x, y, field)
    if cell == 0:
        at = SHAPES + 3 * int(field[CIRCLES])
        for _ in range(int(field[POLYGONS])):
            number = HASH_FACTOR * number + _feature(x, y, radius, field, at)
            at += POLYGON_HEAD + COLUMNS * int(field[at])
    else:
        first = cell + 2 + int(field[cell])
        for i in range(first, first + int(field[cell + 1])):
            feature = _feature(x, y, radius, field, int(field[i]))
            number += feature * feature  # a sum does not depend on the order of the polygons in the cell
    return number


@kernel(int64(float64, float64, float64, CONSTANT, int64, CONSTANT))
def footprint_features(x, y, heading, data, first, field):
    """Number of the closest features of a footprint, see `disc_features` and `footprint_proximity`."""
    cos, sin = math.cos(heading), math.sin(heading)
    number = 0
    for k in range(first, len(data), 2):
        features = disc_features(x + data[k] * cos, y + data[k] * sin, data[k + 1], field)
        number = HASH_FACTOR * number + features
    return number


@kernel(VECTOR(MATRIX, CONSTANT_MATRIX, CONSTANT))
def footprint_proximities(poses, discs, field):
    """Proximity cost of the discs of a robot at many poses, shape (N, >= 3) -> (N,)."""
    result = np.zeros(len(poses))
    for i in range(len(poses)):
        cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for k in range(len(discs)):
            x, y = poses[i, 0] + discs[k, 0] * cos, poses[i, 1] + discs[k, 0] * sin
            result[i] += disc_proximity(x, y, discs[k, 1], field)[0]
    return result
