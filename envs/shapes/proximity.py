"""The smooth proximity cost Phi of a packed obstacle field (kernels), with gradient and Hessian or without.

Phi sums a term for each wall and obstacle: the proximity weight times exp(-distance / proximity scale), where
the distance is that from the robot's outline.
"""

from __future__ import annotations

import math

from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of
from leapnav.envs.shapes.circle import SOFTENING, circle_derivatives, softened_distance
from leapnav.envs.shapes.field import CIRCLES, CUTOFF, GRID, RECORDS, SHAPES
from leapnav.envs.shapes.half_plane import wall_distance
from leapnav.envs.shapes.polygon import half_plane_distance, polygon_derivatives, polygon_term
from leapnav.envs.shapes.proximity_grid import grid_proximity
from leapnav.envs.shapes.records import first_polygon, records_proximity

VALUE_CUTOFF = 25.0  # proximity scales beyond which a term is skipped where nothing is differentiated


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT))
def proximity(x, y, field):
    """Proximity cost of a disc with the radius of the field, see `disc_proximity`."""
    return disc_proximity(x, y, field[2], field)


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT))
def disc_proximity(x, y, radius, field):
    """Proximity cost of a disc: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy)."""
    k = field[0]
    reach = CUTOFF * field[1]
    steepness = 1.0 / field[1]  # divisions are the slow part of a term, after exp()
    value = gx = gy = hxx = hxy = hyy = 0.0
    for side in range(4):  # walls: one half-plane each, the inside positive
        along_x = side % 2 == 0
        sign = 1.0 if side < 2 else -1.0
        distance = wall_distance(x, y, field, side) - radius
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
    if field[int(field[GRID]) + 3] > 0.0:  # so that the loops below need not distinguish other shapes
        found = _many_proximity(x, y, radius, field)
        gx, gy = gx + found[1], gy + found[2]
        return value + found[0], gx, gy, hxx + found[3], hxy + found[4], hyy + found[5]
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        dx, dy = x - field[at], y - field[at + 1]
        rim = field[at + 2] + radius
        at += 3
        if dx * dx + dy * dy + SOFTENING < (rim + reach) ** 2:
            smooth = softened_distance(dx, dy)
            term = k * math.exp((rim - smooth) * steepness)
            value += term
            ax, ay, bxx, bxy, byy = circle_derivatives(dx, dy, smooth, term, steepness)
            gx -= ax
            gy -= ay
            hxx += bxx
            hxy += bxy
            hyy += byy
    for _ in range(int(field[RECORDS])):
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


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT))
def _many_proximity(x, y, radius, field):
    """Proximity cost of the obstacles of a field with a grid, without the walls, see `disc_proximity`."""
    found = grid_proximity(x, y, radius, field)
    others = first_polygon(field)[1]
    if others == 0:
        return found
    more = records_proximity(x, y, radius, field, others)
    value, gx, gy = found[0] + more[0], found[1] + more[1], found[2] + more[2]
    return value, gx, gy, found[3] + more[3], found[4] + more[4], found[5] + more[5]


@kernel(float64(float64, float64, float64, CONSTANT))
def proximity_value(x, y, radius, field):
    """Proximity cost of a disc, without derivatives, to 1e-11 of the weight for each obstacle."""
    return proximity_values(x, y, x, y, x, y, radius, field)[1]


@kernel(tuple_of(*[float64] * 3)(float64, float64, float64, float64, float64, float64, float64, CONSTANT))
def proximity_values(xa, ya, xb, yb, xc, yc, radius, field):
    """Proximity cost, as `proximity_value`, at three points near each other, the second between the others.

    One test of the distance serves all three, which takes half the time of three calls.
    """
    if field[int(field[GRID]) + 3] > 0.0:  # the cells of the grid list the relevant obstacles
        first, second = disc_proximity(xa, ya, radius, field)[0], disc_proximity(xb, yb, radius, field)[0]
        return first, second, disc_proximity(xc, yc, radius, field)[0]
    steepness = 1.0 / field[1]
    apart = max(abs(xa - xb) + abs(ya - yb), abs(xc - xb) + abs(yc - yb))
    reach = VALUE_CUTOFF * field[1] + apart
    first = second = third = 0.0
    for side in range(4):
        between = wall_distance(xb, yb, field, side)
        if between - radius < reach:
            first += math.exp((radius - wall_distance(xa, ya, field, side)) * steepness)
            second += math.exp((radius - between) * steepness)
            third += math.exp((radius - wall_distance(xc, yc, field, side)) * steepness)
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        x, y, rim = field[at], field[at + 1], field[at + 2] + radius
        at += 3
        if (xb - x) ** 2 + (yb - y) ** 2 + SOFTENING < (rim + reach) ** 2:
            first += math.exp((rim - softened_distance(xa - x, ya - y)) * steepness)
            second += math.exp((rim - softened_distance(xb - x, yb - y)) * steepness)
            third += math.exp((rim - softened_distance(xc - x, yc - y)) * steepness)
    for _ in range(int(field[RECORDS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        if half_plane_distance(xb, yb, field, rows, edges) - radius < reach:
            first += polygon_term(xa, ya, field, rows, edges, radius, steepness)
            second += polygon_term(xb, yb, field, rows, edges, radius, steepness)
            third += polygon_term(xc, yc, field, rows, edges, radius, steepness)
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
