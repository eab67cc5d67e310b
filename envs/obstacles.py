"""Obstacle geometry as compiled kernels: clearance, and the smooth proximity cost with gradient and Hessian.

All of them read the packed field, see `leapnav.envs.fields`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.envs.crowds import crowd_proximity
from leapnav.envs.fields import ARENA, CIRCLES, CUTOFF, GRID, POLYGONS, SHAPES

VALUE_CUTOFF = 25.0  # where nothing is differentiated
_field = types.Array(types.float64, 1, "C", readonly=True)


@njit(float64(float64), cache=True, error_model="numpy", nogil=True)
def sinc(angle):
    """sin(angle) / angle, smooth through zero."""
    return 1.0 - angle * angle / 6.0 if abs(angle) < 1e-4 else math.sin(angle) / angle


@njit(float64(float64, float64, _field, int64, int64), cache=True, error_model="numpy", nogil=True)
def polygon_distance(x, y, field, rows, edges):
    """Euclidean distance to a convex polygon, negative inside."""
    inside = -np.inf
    outside = np.inf
    for j in range(edges):
        row = rows + 5 * j
        nx, ny = field[row], field[row + 1]
        following = rows + 5 * ((j + 1) % edges)
        ax, ay = field[row + 3], field[row + 4]
        inside = max(inside, nx * x + ny * y - field[row + 2])
        # Position along the edge, whose direction is the normal turned by 90 degrees, held within the edge.
        length = -ny * (field[following + 3] - ax) + nx * (field[following + 4] - ay)
        along = min(max(-ny * (x - ax) + nx * (y - ay), 0.0), length)
        outside = min(outside, math.hypot(x - ax + ny * along, y - ay - nx * along))
    return inside if inside < 0 else outside


def _proximity_kernel(name: str, derivatives: bool, cutoff: float) -> Any:
    """The proximity cost with or without its derivatives; if few, of the obstacles up to `cutoff` scales away."""

    def kernel(x, y, field):
        k, radius = field[0], field[2]
        reach = cutoff * field[1]
        steepness = 1.0 / field[1]  # divisions are the slow part of a term, after exp()
        value = gx = gy = hxx = hxy = hyy = 0.0
        for side in range(4):  # walls: one half-plane each, the inside positive
            along_x = side % 2 == 0
            sign = 1.0 if side < 2 else -1.0
            distance = sign * ((x if along_x else y) - field[ARENA + side]) - radius
            if distance < reach:
                term = k * math.exp(-distance * steepness)
                slope = sign * term * steepness
                value += term
                if along_x:
                    gx -= slope
                    hxx += sign * slope * steepness
                else:
                    gy -= slope
                    hyy += sign * slope * steepness
        if field[int(field[GRID]) + 3] > 0.0:
            found = crowd_proximity(x, y, field)
            gx, gy = gx + found[1], gy + found[2]
            return value + found[0], gx, gy, hxx + found[3], hxy + found[4], hyy + found[5]
        at = SHAPES
        for _ in range(int(field[CIRCLES])):
            dx, dy = x - field[at], y - field[at + 1]
            rim = field[at + 2] + radius
            at += 3
            square = dx * dx + dy * dy + 1e-6  # differentiable at the centre
            if square < (rim + reach) ** 2:
                smooth = math.sqrt(square)
                term = k * math.exp((rim - smooth) * steepness)
                value += term
                if not derivatives:
                    continue
                inverse = 1.0 / smooth
                nx, ny = dx * inverse, dy * inverse
                slope = term * steepness
                curl = slope * inverse
                bend = slope * steepness + curl
                gx -= slope * nx
                gy -= slope * ny
                hxx += bend * nx * nx - curl
                hxy += bend * nx * ny
                hyy += bend * ny * ny - curl
        for _ in range(int(field[POLYGONS])):
            edges = int(field[at])
            rows = at + 1
            at = rows + 5 * edges
            farthest = -np.inf
            for j in range(edges):
                row = rows + 5 * j
                farthest = max(farthest, field[row] * x + field[row + 1] * y - field[row + 2])
            distance = farthest - radius
            if distance < reach:
                # An edge's share of a term that is small itself may be the smaller.
                least = distance * steepness - cutoff
                total = mx = my = sxx = sxy = syy = 0.0
                for j in range(edges):
                    row = rows + 5 * j
                    nx, ny = field[row], field[row + 1]
                    # Shifted by the largest half-plane distance: exp() of the plain distances overflows.
                    exponent = (nx * x + ny * y - field[row + 2] - farthest) * steepness
                    if exponent < least:
                        continue
                    share = math.exp(exponent)
                    total += share
                    if not derivatives:
                        continue
                    mx += share * nx
                    my += share * ny
                    sxx += share * nx * nx
                    sxy += share * nx * ny
                    syy += share * ny * ny
                part = 1.0 / total
                term = k * math.exp(-distance * steepness) * part
                value += term
                if not derivatives:
                    continue
                mx, my = mx * part, my * part
                slope = term * steepness
                bend = slope * steepness
                gx -= slope * mx
                gy -= slope * my
                hxx += bend * (2 * mx * mx - sxx * part)
                hxy += bend * (2 * mx * my - sxy * part)
                hyy += bend * (2 * my * my - syy * part)
        return value, gx, gy, hxx, hxy, hyy

    kernel.__name__ = kernel.__qualname__ = name
    signature = types.UniTuple(float64, 6)(float64, float64, _field)
    return njit(signature, cache=True, error_model="numpy", nogil=True)(kernel)


_proximity = _proximity_kernel("_proximity", derivatives=True, cutoff=CUTOFF)
_proximity_value = _proximity_kernel("_proximity_value", derivatives=False, cutoff=VALUE_CUTOFF)


@njit(types.UniTuple(float64, 6)(float64, float64, _field), cache=True, error_model="numpy", nogil=True)
def proximity(x, y, field):
    """Proximity cost at a point: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    return _proximity(x, y, field)


@njit(float64(float64, float64, _field), cache=True, error_model="numpy", nogil=True)
def proximity_value(x, y, field):
    """Proximity cost at a point, without derivatives, to 1e-11 of the weight for each obstacle."""
    return _proximity_value(x, y, field)[0]


@njit(
    types.UniTuple(float64, 3)(float64, float64, float64, float64, float64, float64, _field),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def proximity_values(xa, ya, xb, yb, xc, yc, field):
    """`proximity_value` at three points near each other, the second between the others.

    One look at an obstacle serves all three, which takes half the time of three calls.
    """
    if field[int(field[GRID]) + 3] > 0.0:  # the grid knows better what to look at
        first, second = proximity_value(xa, ya, field), proximity_value(xb, yb, field)
        return first, second, proximity_value(xc, yc, field)
    radius, steepness = field[2], 1.0 / field[1]
    apart = max(abs(xa - xb) + abs(ya - yb), abs(xc - xb) + abs(yc - yb))
    reach = VALUE_CUTOFF * field[1] + apart
    first = second = third = 0.0
    for side in range(4):
        sign = 1.0 if side < 2 else -1.0
        wall = field[ARENA + side]
        a, b, c = (xa, xb, xc) if side % 2 == 0 else (ya, yb, yc)
        if sign * (b - wall) - radius < reach:
            first += math.exp((radius - sign * (a - wall)) * steepness)
            second += math.exp((radius - sign * (b - wall)) * steepness)
            third += math.exp((radius - sign * (c - wall)) * steepness)
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        x, y, rim = field[at], field[at + 1], field[at + 2] + radius
        at += 3
        square = (xb - x) ** 2 + (yb - y) ** 2 + 1e-6
        if square < (rim + reach) ** 2:
            first += math.exp((rim - math.sqrt((xa - x) ** 2 + (ya - y) ** 2 + 1e-6)) * steepness)
            second += math.exp((rim - math.sqrt(square)) * steepness)
            third += math.exp((rim - math.sqrt((xc - x) ** 2 + (yc - y) ** 2 + 1e-6)) * steepness)
    for _ in range(int(field[POLYGONS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        farthest_a = farthest_b = farthest_c = -np.inf
        for j in range(edges):
            nx, ny, offset = field[rows + 5 * j], field[rows + 5 * j + 1], field[rows + 5 * j + 2]
            farthest_a = max(farthest_a, nx * xa + ny * ya - offset)
            farthest_b = max(farthest_b, nx * xb + ny * yb - offset)
            farthest_c = max(farthest_c, nx * xc + ny * yc - offset)
        if farthest_b - radius < reach:
            total_a = total_b = total_c = 0.0
            for j in range(edges):
                nx, ny, offset = field[rows + 5 * j], field[rows + 5 * j + 1], field[rows + 5 * j + 2]
                total_a += math.exp((nx * xa + ny * ya - offset - farthest_a) * steepness)
                total_b += math.exp((nx * xb + ny * yb - offset - farthest_b) * steepness)
                total_c += math.exp((nx * xc + ny * yc - offset - farthest_c) * steepness)
            first += math.exp((radius - farthest_a) * steepness) / total_a
            second += math.exp((radius - farthest_b) * steepness) / total_b
            third += math.exp((radius - farthest_c) * steepness) / total_c
    weight = field[0]
    return weight * first, weight * second, weight * third


@njit(types.Tuple((float64, int64))(float64, float64, _field), cache=True, error_model="numpy", nogil=True)
def clearance(x, y, field):
    """Signed distance (m) from the robot's rim to the nearest obstacle or wall, and that obstacle's number.

    Negative inside. The wall has the number after the last obstacle.
    """
    radius = field[2]
    circles, polygons = int(field[CIRCLES]), int(field[POLYGONS])
    numbers = int(field[GRID]) - circles - polygons
    best = min(
        min(x - field[ARENA], field[ARENA + 2] - x),
        min(y - field[ARENA + 1], field[ARENA + 3] - y),
    )
    nearest = circles + polygons
    at = SHAPES
    for i in range(circles):
        dx, dy, rim = x - field[at], y - field[at + 1], field[at + 2]
        at += 3
        if dx * dx + dy * dy < max(best + rim, 0.0) ** 2:  # a root only for the few that are nearer
            distance = math.sqrt(dx * dx + dy * dy) - rim
            if distance < best:
                best, nearest = distance, int(field[numbers + i])
    for i in range(polygons):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        farthest = -np.inf  # of the half-planes: never more than the distance
        for j in range(edges):
            row = rows + 5 * j
            farthest = max(farthest, field[row] * x + field[row + 1] * y - field[row + 2])
        if farthest < best:
            distance = polygon_distance(x, y, field, rows, edges)
            if distance < best:
                best, nearest = distance, int(field[numbers + circles + i])
    return best - radius, nearest


@njit(float64[::1](float64[:, :], _field), cache=True, error_model="numpy", nogil=True)
def clearances(points, field):
    """`clearance` of many points, shape (N, >= 2) -> (N,)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = clearance(points[i, 0], points[i, 1], field)[0]
    return result


@njit(
    types.UniTuple(float64[:, ::1], 2)(_field, float64, float64, float64, int64, int64, float64),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def sample_grid(field, x0, y0, spacing, columns, lines, band):
    """Phi and clearance (m), both (columns, lines), at the points (x0 + i spacing, y0 + j spacing).

    Obstacles farther than `band` (m) are not felt, and clearance is `band` at most, so that every obstacle is looked at
    near its own place only.
    """
    weight, steepness, radius = field[0], 1.0 / field[1], field[2]
    phi = np.zeros((columns, lines))
    closest = np.full((columns, lines), band)
    for i in range(columns):
        for j in range(lines):
            x, y = x0 + i * spacing, y0 + j * spacing
            for side in range(4):
                sign = 1.0 if side < 2 else -1.0
                distance = sign * ((x if side % 2 == 0 else y) - field[ARENA + side]) - radius
                if distance < band:
                    phi[i, j] += weight * math.exp(-distance * steepness)
                    closest[i, j] = min(closest[i, j], distance)
    circles, polygons = int(field[CIRCLES]), int(field[POLYGONS])
    at = SHAPES
    for number in range(circles + polygons):
        edges = 0 if number < circles else int(field[at])
        rows = at + 1
        if edges == 0:
            low_x, high_x = field[at] - field[at + 2], field[at] + field[at + 2]
            low_y, high_y = field[at + 1] - field[at + 2], field[at + 1] + field[at + 2]
        else:
            low_x = low_y = np.inf
            high_x = high_y = -np.inf
            for k in range(edges):
                low_x, high_x = min(low_x, field[rows + 5 * k + 3]), max(high_x, field[rows + 5 * k + 3])
                low_y, high_y = min(low_y, field[rows + 5 * k + 4]), max(high_y, field[rows + 5 * k + 4])
        reach = band + radius
        first = max(int((low_x - reach - x0) / spacing), 0)
        last = min(int((high_x + reach - x0) / spacing) + 2, columns)
        bottom = max(int((low_y - reach - y0) / spacing), 0)
        top = min(int((high_y + reach - y0) / spacing) + 2, lines)
        for i in range(first, last):
            for j in range(bottom, top):
                x, y = x0 + i * spacing, y0 + j * spacing
                if edges == 0:
                    gap = math.hypot(x - field[at], y - field[at + 1]) - field[at + 2] - radius
                    if gap < band:
                        phi[i, j] += weight * math.exp(-gap * steepness)
                        closest[i, j] = min(closest[i, j], gap)
                    continue
                farthest = -np.inf
                for k in range(edges):
                    row = rows + 5 * k
                    farthest = max(farthest, field[row] * x + field[row + 1] * y - field[row + 2])
                if farthest - radius < band:
                    total = 0.0
                    for k in range(edges):
                        row = rows + 5 * k
                        total += math.exp((field[row] * x + field[row + 1] * y - field[row + 2] - farthest) * steepness)
                    phi[i, j] += weight * math.exp((radius - farthest) * steepness) / total
                    closest[i, j] = min(closest[i, j], polygon_distance(x, y, field, rows, edges) - radius)
        at += 3 if edges == 0 else 1 + 5 * edges
    return phi, closest
