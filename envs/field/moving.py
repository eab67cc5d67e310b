"""The proximity cost of moving obstacles (kernels), with derivatives with respect to the time, too.

A moving part at a time is the part at rest, seen by a robot that is displaced by the opposite of the part's
displacement. With its velocity v, the derivative with respect to the time is minus v times the gradient. The velocity
is constant between the knots of a path; at the knots, the derivatives with respect to the time are discontinuous.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.field.distance import HASH_FACTOR, barrier_term, closest_feature, part_geometry
from leapnav.envs.field.layout import CUTOFF, displacement_of, header_of, motion_of, parts_in
from leapnav.envs.field.rectangle import OUTLINE_ENTRIES, ROW, add_part, part_features
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, NOTHING, VECTOR, tuple_of

ENTRIES = 15  # value, gradient and Hessian (upper triangle, by rows) with respect to x, y, heading and time
SCRATCH = 10  # entries of working memory after them


@kernel(tuple_of(*[float64] * 10)(float64, float64, float64, float64, CONSTANT))
def moving_disc_proximity(x, y, time, radius, field):
    """Proximity cost of a disc among the moving obstacles.

    Args:
        x, y: position (m).
        time: s.
        radius: m.
        field: packed obstacle field.

    Returns:
        (Phi, Phi_x, Phi_y, Phi_t, Phi_xx, Phi_xy, Phi_xt, Phi_yy, Phi_yt, Phi_tt).

    """
    header, parts = header_of(field), parts_in(field)
    reach = CUTOFF * header.scale
    value = gx = gy = gt = hxx = hxy = hxt = hyy = hyt = htt = 0.0
    for number in range(header.parts - header.moving, header.parts):
        part = parts[number]
        moved_x, moved_y, vx, vy = motion_of(field, part, time)
        dx, dy = x - moved_x - part.x, y - moved_y - part.y
        if dx * dx + dy * dy >= (part.rim + radius + reach) ** 2:
            continue
        distance, nx, ny, curvature = part_geometry(x - moved_x, y - moved_y, radius, field, part)
        if distance < reach:
            b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, curvature, header)
            bxt, byt = -(bxx * vx + bxy * vy), -(bxy * vx + byy * vy)
            value, gx, gy, gt = value + b, gx + bx, gy + by, gt - bx * vx - by * vy
            hxx, hxy, hxt = hxx + bxx, hxy + bxy, hxt + bxt
            hyy, hyt, htt = hyy + byy, hyt + byt, htt - bxt * vx - byt * vy
    k = header.weight
    return k * value, k * gx, k * gy, k * gt, k * hxx, k * hxy, k * hxt, k * hyy, k * hyt, k * htt


@kernel(NOTHING(float64, float64, float64, float64, ROW, float64, CONSTANT, VECTOR), forceinline=True)
def _add_row(x, y, cos, sin, row, time, field, total):
    """Add the proximity cost of a row of an outline, divided by its weight, to the first 15 entries of total (25,)."""
    header, parts, local = header_of(field), parts_in(field), total[ENTRIES:]
    reach = CUTOFF * header.scale
    middle = (row[0] + row[1]) / 2.0
    rim = math.hypot((row[1] - row[0]) / 2.0, row[2]) + row[3]
    for number in range(header.parts - header.moving, header.parts):
        part = parts[number]
        moved_x, moved_y, vx, vy = motion_of(field, part, time)
        px, py = x - moved_x, y - moved_y
        dx, dy = px + middle * cos - part.x, py + middle * sin - part.y
        if dx * dx + dy * dy >= (part.rim + rim + reach) ** 2:
            continue
        local[:] = 0.0
        if row[1] > row[0]:
            add_part(px, py, cos, sin, row, field, part, local)
        else:
            ox, oy = middle * cos, middle * sin
            distance, nx, ny, curvature = part_geometry(px + ox, py + oy, row[3], field, part)
            if distance >= reach:
                continue
            b, bx, by, bxx, bxy, byy = barrier_term(distance, nx, ny, curvature, header)
            # The heading moves the disc by (-oy, ox).
            bxh, byh = bxy * ox - bxx * oy, byy * ox - bxy * oy
            local[0], local[1], local[2], local[3] = b, bx, by, by * ox - bx * oy
            local[4], local[5], local[6], local[7], local[8] = bxx, bxy, bxh, byy, byh
            local[9] = byh * ox - bxh * oy - bx * ox - by * oy
        xt, yt = -(local[4] * vx + local[5] * vy), -(local[5] * vx + local[7] * vy)
        total[0] += local[0]
        total[1] += local[1]
        total[2] += local[2]
        total[3] += local[3]
        total[4] -= local[1] * vx + local[2] * vy
        total[5] += local[4]
        total[6] += local[5]
        total[7] += local[6]
        total[8] += xt
        total[9] += local[7]
        total[10] += local[8]
        total[11] += yt
        total[12] += local[9]
        total[13] -= local[6] * vx + local[8] * vy
        total[14] -= xt * vx + yt * vy


@kernel(tuple_of(*[float64] * ENTRIES)(float64, float64, float64, float64, int64, CONSTANT, int64, CONSTANT))
def moving_footprint_proximity(x, y, heading, time, joint, data, first, field):
    """Proximity cost of a footprint among the moving obstacles, see `footprint_proximity`.

    Returns:
        Phi, its gradient and its Hessian (upper triangle, by rows) with respect to x, y, heading and time.

    """
    cos, sin = math.cos(heading), math.sin(heading)
    total = np.zeros(ENTRIES + SCRATCH)
    for k in range(first, len(data), OUTLINE_ENTRIES):
        if data[k + 4] == joint:
            row = (data[k], data[k + 1], data[k + 2], data[k + 3])
            _add_row(x, y, cos, sin, row, time, field, total)
    w, s = header_of(field).weight, total
    return (
        w * s[0],
        w * s[1],
        w * s[2],
        w * s[3],
        w * s[4],
        w * s[5],
        w * s[6],
        w * s[7],
        w * s[8],
        w * s[9],
        w * s[10],
        w * s[11],
        w * s[12],
        w * s[13],
        w * s[14],
    )


@kernel(float64(float64, float64, float64, float64, ROW, float64, CONSTANT))
def moving_row_value(x, y, cos, sin, row, time, field):
    """Proximity cost of a row of an outline among the moving obstacles, without derivatives."""
    total = np.zeros(ENTRIES + SCRATCH)
    _add_row(x, y, cos, sin, row, time, field, total)
    return header_of(field).weight * total[0]


@kernel(int64(float64, float64, float64, float64, CONSTANT))
def moving_disc_features(x, y, time, radius, field):
    """Number of the closest features of moving parts, see `disc_features`."""
    number, header, parts = 0, header_of(field), parts_in(field)
    reach = CUTOFF * header.scale + radius
    for index in range(header.parts - header.moving, header.parts):
        part = parts[index]
        moved_x, moved_y = displacement_of(field, part, time)
        px, py = x - moved_x, y - moved_y
        if (px - part.x) ** 2 + (py - part.y) ** 2 < (part.rim + reach) ** 2:
            feature = index + 1
            if part.edges > 0:
                feature = HASH_FACTOR * feature + closest_feature(px, py, field, part, reach)
            number += feature * feature  # a sum does not depend on the order of the parts
    return number


@kernel(int64(float64, float64, float64, float64, int64, CONSTANT, int64, CONSTANT))
def moving_footprint_features(x, y, heading, time, joint, data, first, field):
    """Number of the closest features of a footprint, see `moving_disc_features` and `footprint_features`."""
    cos, sin = math.cos(heading), math.sin(heading)
    number, header, parts = 0, header_of(field), parts_in(field)
    for k in range(first, len(data), OUTLINE_ENTRIES):
        if data[k + 4] != joint:
            continue
        a, row = data[k], (data[k], data[k + 1], data[k + 2], data[k + 3])
        if row[1] == row[0]:
            features = moving_disc_features(x + a * cos, y + a * sin, time, row[3], field)
            number = HASH_FACTOR * number + features
            continue
        middle, rim = (row[0] + row[1]) / 2.0, math.hypot((row[1] - row[0]) / 2.0, row[2])
        features, reach = 0, CUTOFF * header.scale + row[3] + rim
        for index in range(header.parts - header.moving, header.parts):
            part = parts[index]
            moved_x, moved_y = displacement_of(field, part, time)
            px, py = x - moved_x, y - moved_y
            dx, dy = px + middle * cos - part.x, py + middle * sin - part.y
            if dx * dx + dy * dy < (part.rim + reach) ** 2:
                feature = part_features(index + 1, px, py, cos, sin, row, field, part)
                features += feature * feature
        number = HASH_FACTOR * number + features
    return number
