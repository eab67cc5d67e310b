"""The proximity cost Phi of a packed obstacle field (kernels), with gradient and Hessian or without.

Phi sums a term for each wall and each part of an obstacle: the proximity weight times the barrier function of
distance / proximity scale, where the distance is that from the robot's outline.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, VECTOR, tuple_of
from leapnav.envs.shapes.barrier import barrier, barrier_value
from leapnav.envs.shapes.distance import circle_geometry, polygon_geometry, wall_distance
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


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, float64, float64, float64), fastmath={"contract"})
def barrier_term(distance, nx, ny, curvature, steepness, contact):
    """Barrier of a distance, with gradient and Hessian.

    Args:
        distance: from the robot's outline (m).
        nx, ny, curvature: gradient of the distance, and curvature of its level line (1/m).
        steepness: 1 / proximity scale (1/m).
        contact: see `barrier`.

    """
    value, slope, bend = barrier(distance * steepness, contact)
    slope *= steepness
    bend *= steepness * steepness
    curl = slope * curvature
    bend -= curl
    return value, slope * nx, slope * ny, bend * nx * nx + curl, bend * nx * ny, bend * ny * ny + curl


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT))
def proximity(x, y, field):
    """Proximity cost of a disc with the radius of the field, see `disc_proximity`."""
    return disc_proximity(x, y, field[2], field)


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT))
def disc_proximity(x, y, radius, field):
    """Proximity cost of a disc: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    k = field[0]
    reach = CUTOFF * field[1]
    steepness, contact = 1.0 / field[1], field[LEAST_DISTANCE]
    has_grid = field[int(field[GRID]) + 3] > 0.0
    value = gx = gy = hxx = hxy = hyy = 0.0
    if has_grid:
        value, gx, gy, hxx, hxy, hyy = _listed_proximity(x, y, radius, field)
    for side in range(4):
        distance = wall_distance(x, y, field, side) - radius
        if distance < reach:
            sign = 1.0 if side < 2 else -1.0
            nx, ny = (sign, 0.0) if side % 2 == 0 else (0.0, sign)
            b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, 0.0, steepness, contact)
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    if not has_grid:
        at = SHAPES
        for _ in range(int(field[CIRCLES])):
            dx, dy, rim = x - field[at], y - field[at + 1], field[at + 2] + radius
            at += 3
            if dx * dx + dy * dy < (rim + reach) ** 2:
                distance, nx, ny, curvature = circle_geometry(dx, dy, rim)
                b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, curvature, steepness, contact)
                value, gx, gy = value + b, gx + bx, gy + by
                hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
        for _ in range(int(field[POLYGONS])):
            dx, dy, rim = x - field[at + CENTRE], y - field[at + CENTRE + 1], field[at + RIM] + radius
            if dx * dx + dy * dy < (rim + reach) ** 2:
                distance, nx, ny, curvature = polygon_geometry(x, y, field, at)
                b, bx, by, bxx, bxy, byy = barrier_term(distance - radius, nx, ny, curvature, steepness, contact)
                value, gx, gy = value + b, gx + bx, gy + by
                hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
            at += POLYGON_HEAD + COLUMNS * int(field[at])
    return k * value, k * gx, k * gy, k * hxx, k * hxy, k * hyy


# The compiler vectorizes the loop over the circles and chooses the order of its sums, so the last bits depend on the
# processor.
@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT), fastmath={"contract", "nsz", "reassoc"})
def _listed_proximity(x, y, radius, field):
    """Sums of the barrier terms of the obstacles in the cell of the grid at (x, y)."""
    steepness, contact = 1.0 / field[1], field[LEAST_DISTANCE]
    reach = radius + CUTOFF * field[1]
    grid = np.uint64(field[GRID])
    columns, lines = int(field[grid + 3]), int(field[grid + 4])
    column = min(max(int((x - field[grid]) / field[grid + 2]), 0), columns - 1)
    line = min(max(int((y - field[grid + 1]) / field[grid + 2]), 0), lines - 1)
    # Unsigned, because the check for negative indices, which count from the end, prevents vectorization.
    at = grid + np.uint64(field[grid + np.uint64(5 + column * lines + line)])
    circles, polygons = np.uint64(field[at]), np.uint64(field[at + 1])
    at += np.uint64(2)
    value = gx = gy = hxx = hxy = hyy = 0.0
    for i in range(circles):
        dx, dy = x - field[at + i], y - field[at + circles + i]
        distance, nx, ny, curvature = circle_geometry(dx, dy, field[at + circles + circles + i] + radius)
        b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, curvature, steepness, contact)
        value, gx, gy = value + b, gx + bx, gy + by
        hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    at += np.uint64(3) * circles
    for i in range(polygons):
        polygon = int(field[at + i])
        dx, dy, rim = x - field[polygon + CENTRE], y - field[polygon + CENTRE + 1], field[polygon + RIM] + reach
        if dx * dx + dy * dy < rim * rim:
            distance, nx, ny, curvature = polygon_geometry(x, y, field, polygon)
            b, bx, by, bxx, bxy, byy = barrier_term(distance - radius, nx, ny, curvature, steepness, contact)
            value, gx, gy = value + b, gx + bx, gy + by
            hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    return value, gx, gy, hxx, hxy, hyy


@kernel(float64(float64, float64, float64, CONSTANT))
def proximity_value(x, y, radius, field):
    """Proximity cost of a disc, without derivatives, to 2e-9 of the weight for each obstacle."""
    return proximity_values(x, y, x, y, x, y, radius, field)[1]


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
            first += barrier_value((wall_distance(xa, ya, field, side) - radius) * steepness, contact)
            second += barrier_value(between * steepness, contact)
            third += barrier_value((wall_distance(xc, yc, field, side) - radius) * steepness, contact)
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        x, y, rim = field[at], field[at + 1], field[at + 2] + radius
        at += 3
        if (xb - x) ** 2 + (yb - y) ** 2 < (rim + reach) ** 2:
            first += barrier_value(circle_geometry(xa - x, ya - y, rim)[0] * steepness, contact)
            second += barrier_value(circle_geometry(xb - x, yb - y, rim)[0] * steepness, contact)
            third += barrier_value(circle_geometry(xc - x, yc - y, rim)[0] * steepness, contact)
    for _ in range(int(field[POLYGONS])):
        x, y, rim = field[at + CENTRE], field[at + CENTRE + 1], field[at + RIM] + radius
        if (xb - x) ** 2 + (yb - y) ** 2 < (rim + reach) ** 2:
            first += barrier_value((polygon_geometry(xa, ya, field, at)[0] - radius) * steepness, contact)
            second += barrier_value((polygon_geometry(xb, yb, field, at)[0] - radius) * steepness, contact)
            third += barrier_value((polygon_geometry(xc, yc, field, at)[0] - radius) * steepness, contact)
        at += POLYGON_HEAD + COLUMNS * int(field[at])
    weight = field[0]
    return weight * first, weight * second, weight * third


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


@kernel(VECTOR(float64[:, :], CONSTANT_MATRIX, CONSTANT))
def footprint_proximities(poses, discs, field):
    """Proximity cost of the discs of a robot at many poses, shape (N, >= 3) -> (N,)."""
    result = np.zeros(len(poses))
    for i in range(len(poses)):
        cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for k in range(len(discs)):
            x, y = poses[i, 0] + discs[k, 0] * cos, poses[i, 1] + discs[k, 0] * sin
            result[i] += disc_proximity(x, y, discs[k, 1], field)[0]
    return result
