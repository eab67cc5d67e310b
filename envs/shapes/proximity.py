"""The smooth proximity cost Phi of a packed obstacle field (kernels), with gradient and Hessian or without.

Phi sums a term for each wall, circle and polygon: the proximity weight times exp(-distance / proximity scale), where
the distance is that from the robot's outline.
"""

from __future__ import annotations

import math

from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of
from leapnav.envs.shapes.circle import SOFTENING, circle_derivatives, smooth_distance
from leapnav.envs.shapes.field import ARENA, CIRCLES, CUTOFF, GRID, POLYGONS, SHAPES
from leapnav.envs.shapes.polygon import half_plane_distance, polygon_derivatives, polygon_term
from leapnav.envs.shapes.proximity_grid import grid_proximity

VALUE_CUTOFF = 25.0  # proximity scales beyond which a term is skipped where nothing is differentiated


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT))
def proximity(x, y, field):
    """Proximity cost at a point: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    k, radius = field[0], field[2]
    reach = CUTOFF * field[1]
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
        found = grid_proximity(x, y, field)
        gx, gy = gx + found[1], gy + found[2]
        return value + found[0], gx, gy, hxx + found[3], hxy + found[4], hyy + found[5]
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        dx, dy = x - field[at], y - field[at + 1]
        rim = field[at + 2] + radius
        at += 3
        if dx * dx + dy * dy + SOFTENING < (rim + reach) ** 2:
            smooth = smooth_distance(dx, dy)
            term = k * math.exp((rim - smooth) * steepness)
            value += term
            ax, ay, bxx, bxy, byy = circle_derivatives(dx, dy, smooth, term, steepness)
            gx -= ax
            gy -= ay
            hxx += bxx
            hxy += bxy
            hyy += byy
    for _ in range(int(field[POLYGONS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        largest = half_plane_distance(x, y, field, rows, edges)
        distance = largest - radius
        if distance < reach:
            # An edge's contribution to a term that is small itself may be smaller than the cutoff, and is skipped.
            least = distance * steepness - CUTOFF
            total = mx = my = sxx = sxy = syy = 0.0
            for j in range(edges):
                row = rows + 5 * j
                nx, ny = field[row], field[row + 1]
                # Shifted by the largest half-plane distance: exp() of the distances themselves overflows.
                exponent = (nx * x + ny * y - field[row + 2] - largest) * steepness
                if exponent < least:
                    continue
                weight = math.exp(exponent)
                total += weight
                mx += weight * nx
                my += weight * ny
                sxx += weight * nx * nx
                sxy += weight * nx * ny
                syy += weight * ny * ny
            part = 1.0 / total
            term = k * math.exp(-distance * steepness) * part
            value += term
            ax, ay, bxx, bxy, byy = polygon_derivatives(
                mx * part, my * part, sxx * part, sxy * part, syy * part, term, steepness
            )
            gx -= ax
            gy -= ay
            hxx += bxx
            hxy += bxy
            hyy += byy
    return value, gx, gy, hxx, hxy, hyy


@kernel(float64(float64, float64, CONSTANT))
def proximity_value(x, y, field):
    """Proximity cost at a point, without derivatives, to 1e-11 of the weight for each obstacle."""
    return proximity_values(x, y, x, y, x, y, field)[1]


@kernel(tuple_of(*[float64] * 3)(float64, float64, float64, float64, float64, float64, CONSTANT))
def proximity_values(xa, ya, xb, yb, xc, yc, field):
    """Proximity cost, as `proximity_value`, at three points near each other, the second between the others.

    One test of the distance serves all three, which takes half the time of three calls.
    """
    if field[int(field[GRID]) + 3] > 0.0:  # the cells of the grid list the relevant obstacles
        first, second = proximity(xa, ya, field)[0], proximity(xb, yb, field)[0]
        return first, second, proximity(xc, yc, field)[0]
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
        if (xb - x) ** 2 + (yb - y) ** 2 + SOFTENING < (rim + reach) ** 2:
            first += math.exp((rim - smooth_distance(xa - x, ya - y)) * steepness)
            second += math.exp((rim - smooth_distance(xb - x, yb - y)) * steepness)
            third += math.exp((rim - smooth_distance(xc - x, yc - y)) * steepness)
    for _ in range(int(field[POLYGONS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        if half_plane_distance(xb, yb, field, rows, edges) - radius < reach:
            first += polygon_term(xa, ya, field, rows, edges, steepness)
            second += polygon_term(xb, yb, field, rows, edges, steepness)
            third += polygon_term(xc, yc, field, rows, edges, steepness)
    weight = field[0]
    return weight * first, weight * second, weight * third
