"""Obstacles of a packed field that are neither circles nor polygons (kernels).

The distance of each is a function of its shape, which is called by its number, see `leapnav.envs.shapes.base`. `at` is
the index of a record in the packed field.
"""

from __future__ import annotations

import math

from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.numba_internals import part_of
from leapnav.envs.kernels.types import CONSTANT, NOTHING, VECTOR, tuple_of
from leapnav.envs.shapes.base import call_distance, call_smooth_distance
from leapnav.envs.shapes.field import (
    CENTRE,
    CIRCLES,
    KIND,
    LENGTH,
    N_VERTICES,
    REACH,
    RECORDS,
    RIM,
    SHAPES,
    VERTICES,
)

HIT = 1e-11  # m, distance at which a ray has arrived
NEAR = 1e-3  # m, distance below which the slope of the distance along a ray is used
MAX_RAY_STEPS = 200


@kernel(tuple_of(int64, int64)(CONSTANT))
def first_polygon(field):
    """Index at which the polygons of a field begin, and the number of records before them."""
    at = SHAPES + 3 * int(field[CIRCLES])
    count = 0
    for _ in range(int(field[RECORDS])):
        if field[at] > 0.0:
            break
        at += 2 + int(field[at + LENGTH])
        count += 1
    return at, count


@kernel(float64(float64, float64, CONSTANT, int64))
def record_distance(x, y, field, at):
    """Signed distance (m) from a point to an obstacle."""
    vertices = VERTICES + 2 * int(field[at + N_VERTICES])
    values = part_of(field, at + vertices, 2 + int(field[at + LENGTH]) - vertices)
    return call_distance(2 * int(-field[at + KIND]), x, y, values)


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT, int64))
def record_smooth_distance(x, y, field, at):
    """Smooth distance (m) from a point to an obstacle, with gradient and Hessian."""
    vertices = VERTICES + 2 * int(field[at + N_VERTICES])
    values = part_of(field, at + vertices, 2 + int(field[at + LENGTH]) - vertices)
    return call_smooth_distance(2 * int(-field[at + KIND]) + 1, x, y, field[1], values)


@kernel(tuple_of(float64, int64)(float64, float64, CONSTANT, int64, float64))
def nearest_record(x, y, field, count, best):
    """Signed distance (m) from a point to the nearest obstacle, and its number; `best` and -1 if none is nearer."""
    at = SHAPES + 3 * int(field[CIRCLES])
    nearest = -1
    for i in range(count):
        dx, dy = x - field[at + CENTRE], y - field[at + CENTRE + 1]
        if dx * dx + dy * dy < max(best + field[at + RIM], 0.0) ** 2:
            distance = record_distance(x, y, field, at)
            if distance < best:
                best, nearest = distance, i
        at += 2 + int(field[at + LENGTH])
    return best, nearest


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT, int64))
def records_proximity(x, y, radius, field, count):
    """Proximity cost of a disc for these obstacles: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    steepness = 1.0 / field[1]
    value = gx = gy = hxx = hxy = hyy = 0.0
    at = SHAPES + 3 * int(field[CIRCLES])
    for _ in range(count):
        dx, dy = x - field[at + CENTRE], y - field[at + CENTRE + 1]
        if dx * dx + dy * dy < field[at + REACH] ** 2:
            d, d_x, d_y, d_xx, d_xy, d_yy = record_smooth_distance(x, y, field, at)
            term = field[0] * math.exp((radius - d) * steepness)
            slope = term * steepness
            value += term
            gx -= slope * d_x
            gy -= slope * d_y
            hxx += slope * (d_x * d_x * steepness - d_xx)
            hxy += slope * (d_x * d_y * steepness - d_xy)
            hyy += slope * (d_y * d_y * steepness - d_yy)
        at += 2 + int(field[at + LENGTH])
    return value, gx, gy, hxx, hxy, hyy


@kernel(tuple_of(float64, int64)(float64, float64, float64, float64, float64, CONSTANT, int64))
def _advance_ray(t, x, y, dx, dy, field, at):
    """One step of sphere tracing from the distance t (m) along a ray: the following t, and whether the ray ends."""
    here = record_distance(x + t * dx, y + t * dy, field, at)
    if here < HIT:
        return t, 1
    step = here
    if here < NEAR:
        # Along a ray that meets the boundary at an angle, the distance is nearly linear here; the next step halves it
        # at least.
        before = record_distance(x + (t - here) * dx, y + (t - here) * dy, field, at)
        slope = (before - here) / here
        if slope > HIT:
            candidate = here / slope
            there = record_distance(x + (t + candidate) * dx, y + (t + candidate) * dy, field, at)
            if -HIT < there < 0.5 * here:
                step = candidate
    return t + step, 0


@kernel(NOTHING(float64, float64, VECTOR, VECTOR, VECTOR, float64, CONSTANT, int64))
def trace_rays(x, y, dxs, dys, nearest, reach, field, at):
    """Shorten rays from (x, y) in the directions (dxs, dys), of lengths `nearest` (m), to the rim of an obstacle."""
    cx, cy, rim = field[at + CENTRE] - x, field[at + CENTRE + 1] - y, field[at + RIM]
    if cx * cx + cy * cy >= (rim + reach) ** 2:
        return
    for k in range(len(nearest)):
        along = cx * dxs[k] + cy * dys[k]
        beside = cx * dys[k] - cy * dxs[k]
        square = rim * rim - beside * beside
        if square <= 0.0 or along + math.sqrt(square) <= 0.0:
            continue
        t, leave = max(along - math.sqrt(square), 0.0), along + math.sqrt(square)
        for _ in range(MAX_RAY_STEPS):
            t, has_arrived = _advance_ray(t, x, y, dxs[k], dys[k], field, at)
            if has_arrived:
                nearest[k] = min(nearest[k], t)
            if has_arrived or t >= min(nearest[k], leave):
                break
