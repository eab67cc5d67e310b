"""The proximity cost Phi of a packed obstacle field (kernels), with gradient and Hessian or without.

Unless stated otherwise it is that of the walls and of the obstacles at rest; that of the others is in `moving`.
Phi sums a term for each wall and each part of an obstacle: the proximity weight times the barrier function of
distance / proximity scale, where the distance is that from the robot's outline.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.field.barrier import barrier
from leapnav.envs.field.distance import HASH_FACTOR, barrier_term, closest_feature, part_geometry, wall_distance
from leapnav.envs.field.layout import CUTOFF, HEADER_TYPE, header_of, parts_in, parts_near, time_of
from leapnav.envs.field.moving import moving_row_value
from leapnav.envs.field.rectangle import OUTLINE_ENTRIES, add_rectangle, rectangle_features, row_axis
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import carray, scratch_buffer
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, MATRIX, VECTOR, tuple_of

BLOCK = 16  # shapes whose barriers are computed in one loop
LANES = 4  # numbers of a vector instruction, of 256 bits
TERM_ENTRIES = 4 * BLOCK  # of a block, see `_sum_terms`
VALUE_CUTOFF = 20.0  # proximity scales beyond which a term is skipped where nothing is differentiated


@kernel(tuple_of(*[float64] * 6)(MATRIX, int64, HEADER_TYPE), forceinline=True, fastmath={"contract", "reassoc"})
def _sum_terms(terms, count, header):
    """Sum the barriers of distances: (b, b_x, b_y, b_xx, b_xy, b_yy).

    The loop is vectorised. The order of the sum depends on the width of the processor's vectors, so that the results of
    two processors differ by rounding errors.

    Args:
        terms (4, BLOCK): distance (m), its gradient (2), and the curvature (1/m) of its level line, of `count` shapes.
        count: at most BLOCK.
        header: header of the packed obstacle field.

    """
    value = gx = gy = hxx = hxy = hyy = 0.0
    for k in range(count):
        b, bx, by, bxx, bxy, byy = barrier_term(terms[0, k], terms[1, k], terms[2, k], terms[3, k], header)
        value, gx, gy = value + b, gx + bx, gy + by
        hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
    return value, gx, gy, hxx, hxy, hyy


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT))
def disc_proximity(x, y, radius, field):
    """Proximity cost of a disc: (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy).

    The distances of up to BLOCK shapes are computed first, and then their barriers, several at once.
    """
    header, parts = header_of(field), parts_in(field)
    reach = CUTOFF * header.scale
    terms, count = carray(scratch_buffer(TERM_ENTRIES), (4, BLOCK)), 0
    value = gx = gy = hxx = hxy = hyy = 0.0
    for side in range(4):
        distance = wall_distance(x, y, header, side) - radius
        if distance < reach:
            sign = 1.0 if side < 2 else -1.0
            nx, ny = (sign, 0.0) if side % 2 == 0 else (0.0, sign)
            terms[0, count], terms[1, count], terms[2, count], terms[3, count] = distance, nx, ny, 0.0
            count += 1
    for number in parts_near(x, y, field):
        part = parts[number]
        dx, dy = x - part.x, y - part.y
        if dx * dx + dy * dy < (part.rim + radius + reach) ** 2:
            distance, nx, ny, curvature = part_geometry(x, y, radius, field, part)
            if distance < reach:
                terms[0, count], terms[1, count], terms[2, count], terms[3, count] = distance, nx, ny, curvature
                count += 1
                if count == BLOCK:
                    b, bx, by, bxx, bxy, byy = _sum_terms(terms, count, header)
                    value, gx, gy = value + b, gx + bx, gy + by
                    hxx, hxy, hyy = hxx + bxx, hxy + bxy, hyy + byy
                    count = 0
    while count > 2 and count % LANES > 0:  # filled up with shapes far away: the remainder of a loop takes longer
        terms[0, count], terms[1, count], terms[2, count], terms[3, count] = 2.0 * reach, 0.0, 0.0, 0.0
        count += 1
    b, bx, by, bxx, bxy, byy = _sum_terms(terms, count, header)
    k = header.weight
    return k * (value + b), k * (gx + bx), k * (gy + by), k * (hxx + bxx), k * (hxy + bxy), k * (hyy + byy)


@kernel(tuple_of(*[float64] * 6)(float64, float64, CONSTANT))
def proximity(x, y, field):
    """Proximity cost of a disc with the radius of the field, see `disc_proximity`."""
    return disc_proximity(x, y, header_of(field).radius, field)


@kernel(tuple_of(*[float64] * 3)(float64, float64, float64, float64, float64, float64, float64, CONSTANT))
def proximity_values(xa, ya, xb, yb, xc, yc, radius, field):
    """Proximity cost, as `proximity_value`, at three points near each other, the second between the others.

    One test of the distance serves all three, which takes half the time of three calls.
    """
    header, parts = header_of(field), parts_in(field)
    if header.columns * header.lines > 1:  # a cell of the grid lists the parts near one point
        first, second = disc_proximity(xa, ya, radius, field)[0], disc_proximity(xb, yb, radius, field)[0]
        return first, second, disc_proximity(xc, yc, radius, field)[0]
    steepness, contact = 1.0 / header.scale, header.least_distance
    apart = max(abs(xa - xb) + abs(ya - yb), abs(xc - xb) + abs(yc - yb))
    reach = VALUE_CUTOFF * header.scale + apart
    first = second = third = 0.0
    for side in range(4):
        between = wall_distance(xb, yb, header, side) - radius
        if between < reach:
            first += barrier((wall_distance(xa, ya, header, side) - radius) * steepness, contact)[0]
            second += barrier(between * steepness, contact)[0]
            third += barrier((wall_distance(xc, yc, header, side) - radius) * steepness, contact)[0]
    for part in parts[: header.parts - header.moving]:
        if (xb - part.x) ** 2 + (yb - part.y) ** 2 < (part.rim + radius + reach) ** 2:
            first += barrier(part_geometry(xa, ya, radius, field, part)[0] * steepness, contact)[0]
            second += barrier(part_geometry(xb, yb, radius, field, part)[0] * steepness, contact)[0]
            third += barrier(part_geometry(xc, yc, radius, field, part)[0] * steepness, contact)[0]
    weight = header.weight
    return weight * first, weight * second, weight * third


@kernel(float64(float64, float64, float64, CONSTANT))
def proximity_value(x, y, radius, field):
    """Proximity cost of a disc, without derivatives, to 2e-9 of the weight for each obstacle."""
    return proximity_values(x, y, x, y, x, y, radius, field)[1]


@kernel(tuple_of(*[float64] * 10)(float64, float64, float64, int64, CONSTANT, int64, CONSTANT))
def footprint_proximity(x, y, heading, joint, data, first, field):
    """Proximity cost of a footprint: the sum over the rows of its outline with a joint.

    Args:
        x, y, heading: position (m), and angle of the axis of these rows (rad).
        joint: see `leapnav.envs.field.rectangle`; other rows are skipped.
        data: rows of an outline, from the index `first` to the end. A disc has the half width 0, and its rear and its
            front are its centre.
        first: see `data`.
        field: packed obstacle field.

    Returns:
        (Phi, Phi_x, Phi_y, Phi_h, Phi_xx, Phi_xy, Phi_xh, Phi_yy, Phi_yh, Phi_hh); h is the heading.

    """
    cos, sin = math.cos(heading), math.sin(heading)
    value = gx = gy = gh = hxx = hxy = hxh = hyy = hyh = hhh = 0.0
    for k in range(first, len(data), OUTLINE_ENTRIES):
        if data[k + 4] != joint:
            continue
        a = data[k]
        if data[k + 1] > a:
            total, row = np.zeros(10), (a, data[k + 1], data[k + 2], data[k + 3])
            add_rectangle(x, y, cos, sin, row, field, total)
            weight = header_of(field).weight
            value, gx, gy, gh = (
                value + weight * total[0],
                gx + weight * total[1],
                gy + weight * total[2],
                gh + weight * total[3],
            )
            hxx, hxy, hxh = hxx + weight * total[4], hxy + weight * total[5], hxh + weight * total[6]
            hyy, hyh, hhh = hyy + weight * total[7], hyh + weight * total[8], hhh + weight * total[9]
            continue
        term, tx, ty, txx, txy, tyy = disc_proximity(x + a * cos, y + a * sin, data[k + 3], field)
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


@kernel(float64(CONSTANT, CONSTANT_MATRIX, CONSTANT))
def footprint_value(q, outline, field):
    """Proximity cost of the outline (K, 5) of a robot at a state q, without derivatives, with moving obstacles."""
    x, y, value, weight = q[0], q[1], 0.0, header_of(field).weight
    moves, time = header_of(field).moving > 0, time_of(q, field)
    for k in range(len(outline)):
        a = outline[k, 0]
        if moves and outline[k, 3] + outline[k, 2] > 0.0:
            axis, row = row_axis(q, outline[k, 4]), (a, outline[k, 1], outline[k, 2], outline[k, 3])
            value += moving_row_value(x, y, math.cos(axis), math.sin(axis), row, time, field)
        if a == 0.0 and outline[k, 1] == 0.0:
            if outline[k, 3] > 0.0:  # otherwise unused
                value += proximity_value(x, y, outline[k, 3], field)
            continue
        axis = row_axis(q, outline[k, 4])
        cos, sin = math.cos(axis), math.sin(axis)
        if outline[k, 1] > a:
            total = np.zeros(10)
            add_rectangle(x, y, cos, sin, (a, outline[k, 1], outline[k, 2], outline[k, 3]), field, total)
            value += weight * total[0]
        else:
            value += proximity_value(x + a * cos, y + a * sin, outline[k, 3], field)
    return value


@kernel(int64(float64, float64, float64, CONSTANT))
def disc_features(x, y, radius, field):
    """Number of the edges and vertices of polygons that are closest to a disc.

    The number changes where second derivatives of the proximity cost are discontinuous, apart from negligible terms.
    """
    number, parts = 0, parts_in(field)
    reach = CUTOFF * header_of(field).scale + radius
    for index in parts_near(x, y, field):
        part = parts[index]
        dx, dy = x - part.x, y - part.y
        if part.edges > 0 and dx * dx + dy * dy < (part.rim + reach) ** 2:
            feature = closest_feature(x, y, field, part, reach) * HASH_FACTOR
            number += feature * feature  # a sum does not depend on the order of the parts
    return number


@kernel(int64(float64, float64, float64, int64, CONSTANT, int64, CONSTANT))
def footprint_features(x, y, heading, joint, data, first, field):
    """Number of the closest features of a footprint, see `disc_features` and `footprint_proximity`."""
    cos, sin = math.cos(heading), math.sin(heading)
    number = 0
    for k in range(first, len(data), OUTLINE_ENTRIES):
        if data[k + 4] != joint:
            continue
        a = data[k]
        if data[k + 1] > a:
            features = rectangle_features(x, y, cos, sin, (a, data[k + 1], data[k + 2], data[k + 3]), field)
        else:
            features = disc_features(x + a * cos, y + a * sin, data[k + 3], field)
        number = HASH_FACTOR * number + features
    return number


@kernel(VECTOR(MATRIX, CONSTANT_MATRIX, CONSTANT))
def footprint_proximities(states, outline, field):
    """Proximity cost of the outline (K, 5) of a robot at many states, shape (N, n) -> (N,), to 2e-9 of the weight."""
    result = np.zeros(len(states))
    for i in range(len(states)):
        result[i] = footprint_value(states[i], outline, field)
    return result
