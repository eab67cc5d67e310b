"""Exact distances between a rectangular footprint and the parts of a packed field, and their proximity cost (kernels).

A row of an outline is (rear, front, half_width, radius, joint) (m): the rectangle from `rear` to `front` along an axis
and up to `half_width` to both sides, enlarged by a radius. The axis has the robot's heading plus the state whose index
is the joint; with the joint 0, it has the heading. Two convex shapes that move continuously meet first at a vertex
of one of them. The proximity cost therefore sums the barrier over the distances of the rectangle's corners from the
walls and from each polygon, and of the vertices of each polygon, or the centre of each disc, from the rectangle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.field.distance import (
    HASH_FACTOR,
    MIN_DISTANCE,
    barrier_term,
    closest_feature,
    part_geometry,
    wall_distance,
)
from leapnav.envs.field.layout import CUTOFF, HEADER_TYPE, PART_TYPE, edges_of, header_of, parts_in, parts_near
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, NOTHING, VECTOR, tuple_of

OUTLINE_ENTRIES = 5  # in a row of an outline
ROW = tuple_of(*[float64] * 4)  # of an outline, without the joint


@kernel(float64(CONSTANT, float64), forceinline=True)
def row_axis(q, joint):
    """Angle (rad) of the axis of a row of an outline with a joint, at a state q of the robot."""
    return q[2] + (q[int(joint)] if joint > 0.0 else 0.0)


@kernel(tuple_of(*[float64] * 4)(float64, float64, float64, float64, float64), forceinline=True)
def point_geometry(ahead, left, rear, front, half_width):
    """Signed distance (m) from a point in the frame of a rectangle, its gradient (2), and the curvature (1/m).

    Args:
        ahead, left: the point (m).
        rear, front, half_width: the rectangle (m).

    """
    beyond = min(ahead - rear, max(ahead - front, 0.0))
    beside = min(left + half_width, max(left - half_width, 0.0))
    if beyond != 0.0 and beside != 0.0:
        distance = math.sqrt(beyond * beyond + beside * beside)
        curvature = 1.0 / (distance if distance > MIN_DISTANCE else MIN_DISTANCE)
        return distance, beyond * curvature, beside * curvature, curvature
    along = max(rear - ahead, ahead - front)  # negative between the ends
    across = abs(left) - half_width
    if along > across:
        return along, (1.0 if ahead - front > rear - ahead else -1.0), 0.0, 0.0
    return across, 0.0, (1.0 if left > 0.0 else -1.0), 0.0


@kernel(float64(float64, float64, float64, float64, ROW, HEADER_TYPE))
def wall_separation(x, y, cos, sin, row, header):
    """Smallest distance (m) from a rectangle to a wall; negative outside the arena.

    Args:
        x, y, cos, sin: position (m), and cosine and sine of the heading.
        row: row of an outline.
        header: header of the packed obstacle field.

    """
    middle, half = (row[0] + row[1]) / 2.0, (row[1] - row[0]) / 2.0
    width = abs(cos) * half + abs(sin) * row[2] + row[3]
    height = abs(sin) * half + abs(cos) * row[2] + row[3]
    x, y = x + middle * cos, y + middle * sin
    best = np.inf
    for side in range(4):
        best = min(best, wall_distance(x, y, header, side) - (width if side % 2 == 0 else height))
    return best


@kernel(float64(float64, float64, float64, float64, ROW, CONSTANT, PART_TYPE))
def separation(x, y, cos, sin, row, field, part):
    """Signed distance (m) from a rectangle to a part; if they overlap, the least translation that separates them.

    The theorem of separating axes decides whether they overlap.

    Args:
        x, y, cos, sin: position (m), and cosine and sine of the heading.
        row: row of an outline.
        field: packed obstacle field.
        part: one of its parts.

    """
    rear, front, half_width, rounding = row[0], row[1], row[2], row[3] + part.rounding
    if part.edges == 0:
        dx, dy = part.x - x, part.y - y
        return point_geometry(cos * dx + sin * dy, cos * dy - sin * dx, rear, front, half_width)[0] - rounding
    middle, half = (rear + front) / 2.0, (front - rear) / 2.0
    middle_x, middle_y = x + middle * cos, y + middle * sin
    gap = -np.inf  # largest gap along a normal
    nearest, first, last, right, left = np.inf, np.inf, -np.inf, np.inf, -np.inf
    for edge in edges_of(field, part):
        extent = half * abs(edge.nx * cos + edge.ny * sin) + half_width * abs(edge.ny * cos - edge.nx * sin)
        gap = max(gap, edge.nx * middle_x + edge.ny * middle_y - edge.offset - extent)
        dx, dy = edge.x - x, edge.y - y
        ahead, beside = cos * dx + sin * dy, cos * dy - sin * dx
        first, last, right, left = min(first, ahead), max(last, ahead), min(right, beside), max(left, beside)
        nearest = min(nearest, point_geometry(ahead, beside, rear, front, half_width)[0])
    gap = max(gap, max(max(first - front, rear - last), max(right - half_width, -half_width - left)))
    if gap <= 0.0:
        return gap - rounding
    for k in range(4):
        ahead, beside = (front if k < 2 else rear), (half_width if k % 2 == 0 else -half_width)
        corner_x, corner_y = x + ahead * cos - beside * sin, y + ahead * sin + beside * cos
        nearest = min(nearest, part_geometry(corner_x, corner_y, 0.0, field, part)[0] + part.rounding)
    return nearest - rounding


@kernel(NOTHING(float64, float64, float64, float64, float64, float64, HEADER_TYPE, VECTOR), forceinline=True)
def _add_corner(distance, nx, ny, curvature, ox, oy, header, total):
    """Add the barrier of the distance of a corner (ox, oy) (m), relative to the robot's position, from an obstacle."""
    value, gx, gy, hxx, hxy, hyy = barrier_term(distance, nx, ny, curvature, header)
    dx, dy = -oy, ox  # derivatives of the corner with respect to the heading
    total[0] += value
    total[1] += gx
    total[2] += gy
    total[3] += gx * dx + gy * dy
    total[4] += hxx
    total[5] += hxy
    total[6] += hxx * dx + hxy * dy
    total[7] += hyy
    total[8] += hxy * dx + hyy * dy
    total[9] += (hxx * dx + 2.0 * hxy * dy) * dx + hyy * dy * dy - (gx * ox + gy * oy)


@kernel(NOTHING(float64, float64, float64, float64, ROW, float64, HEADER_TYPE, VECTOR), forceinline=True)
def _add_point(rx, ry, cos, sin, row, rounding, header, total):
    """Add the barrier of the distance of the rectangle from a fixed point (rx, ry) (m), relative to the position."""
    ahead, left = cos * rx + sin * ry, cos * ry - sin * rx
    distance, along, across, curvature = point_geometry(ahead, left, row[0], row[1], row[2])
    nx, ny = cos * along - sin * across, sin * along + cos * across
    value, gx, gy, hxx, hxy, hyy = barrier_term(distance - rounding, nx, ny, curvature, header)
    dx, dy = ry, -rx  # a rotation of the robot moves the point backwards in its frame
    total[0] += value
    total[1] -= gx
    total[2] -= gy
    total[3] += gx * dx + gy * dy
    total[4] += hxx
    total[5] += hxy
    total[6] += gy - hxx * dx - hxy * dy
    total[7] += hyy
    total[8] -= gx + hxy * dx + hyy * dy
    total[9] += (hxx * dx + 2.0 * hxy * dy) * dx + hyy * dy * dy - (gx * rx + gy * ry)


@kernel(NOTHING(float64, float64, float64, float64, ROW, CONSTANT, PART_TYPE, VECTOR), forceinline=True)
def add_part(x, y, cos, sin, row, field, part, total):
    """Add the proximity cost of a rectangle near a part, see `add_rectangle`."""
    header, radius = header_of(field), row[3]
    rounding = radius + part.rounding
    if part.edges == 0:
        _add_point(part.x - x, part.y - y, cos, sin, row, rounding, header, total)
        return
    for edge in edges_of(field, part):
        _add_point(edge.x - x, edge.y - y, cos, sin, row, rounding, header, total)
    for k in range(4):
        ahead, left = (row[1] if k < 2 else row[0]), (row[2] if k % 2 == 0 else -row[2])
        ox, oy = ahead * cos - left * sin, ahead * sin + left * cos
        distance, nx, ny, curvature = part_geometry(x + ox, y + oy, radius, field, part)
        _add_corner(distance, nx, ny, curvature, ox, oy, header, total)


@kernel(NOTHING(float64, float64, float64, float64, ROW, CONSTANT, VECTOR))
def add_rectangle(x, y, cos, sin, row, field, total):
    """Add the proximity cost of a rectangle among obstacles at rest, divided by its weight, with derivatives.

    Args:
        x, y, cos, sin: position (m), and cosine and sine of the heading.
        row: row of an outline.
        field: packed obstacle field.
        total (10,): see the result of `leapnav.envs.field.proximity.footprint_proximity`.

    """
    header, parts = header_of(field), parts_in(field)
    reach = CUTOFF * header.scale
    middle, radius = (row[0] + row[1]) / 2.0, row[3]
    rim = math.hypot((row[1] - row[0]) / 2.0, row[2]) + radius
    middle_x, middle_y = x + middle * cos, y + middle * sin
    near_wall = False
    for side in range(4):
        near_wall = near_wall or wall_distance(middle_x, middle_y, header, side) < rim + reach
    for k in range(4):
        ahead, left = (row[1] if k < 2 else row[0]), (row[2] if k % 2 == 0 else -row[2])
        ox, oy = ahead * cos - left * sin, ahead * sin + left * cos
        if near_wall:
            for side in range(4):
                distance = wall_distance(x + ox, y + oy, header, side) - radius
                if distance < reach:
                    sign = 1.0 if side < 2 else -1.0
                    nx, ny = (sign, 0.0) if side % 2 == 0 else (0.0, sign)
                    _add_corner(distance, nx, ny, 0.0, ox, oy, header, total)
    for number in parts_near(middle_x, middle_y, field):
        part = parts[number]
        dx, dy = part.x - middle_x, part.y - middle_y
        if dx * dx + dy * dy < (part.rim + rim + reach) ** 2:
            add_part(x, y, cos, sin, row, field, part, total)


@kernel(int64(float64, float64, float64, float64, ROW), forceinline=True)
def _side(rx, ry, cos, sin, row):
    """Number of the edge or of the corner of a rectangle that is closest to a point outside, relative to the robot."""
    ahead, left = cos * rx + sin * ry, cos * ry - sin * rx
    along = 0 if ahead < row[0] else 2 if ahead > row[1] else 1
    return 3 * along + (0 if left < -row[2] else 2 if left > row[2] else 1)


@kernel(int64(int64, float64, float64, float64, float64, ROW, CONSTANT, PART_TYPE), forceinline=True)
def part_features(features, x, y, cos, sin, row, field, part):
    """Combine a number with that of the closest edges and vertices of a rectangle and a part."""
    if part.edges == 0:
        return HASH_FACTOR * features + _side(part.x - x, part.y - y, cos, sin, row)
    reach = CUTOFF * header_of(field).scale + row[3]
    for edge in edges_of(field, part):
        features = HASH_FACTOR * features + _side(edge.x - x, edge.y - y, cos, sin, row)
    for k in range(4):
        ahead, left = (row[1] if k < 2 else row[0]), (row[2] if k % 2 == 0 else -row[2])
        corner_x, corner_y = x + ahead * cos - left * sin, y + ahead * sin + left * cos
        features = HASH_FACTOR * features + closest_feature(corner_x, corner_y, field, part, reach)
    return features


@kernel(int64(float64, float64, float64, float64, ROW, CONSTANT))
def rectangle_features(x, y, cos, sin, row, field):
    """Number of the edges and vertices that are closest to each other.

    The number changes where second derivatives of the proximity cost are discontinuous, apart from negligible terms.
    """
    number, parts = 0, parts_in(field)
    middle, reach = (row[0] + row[1]) / 2.0, CUTOFF * header_of(field).scale + row[3]
    rim = math.hypot((row[1] - row[0]) / 2.0, row[2])
    middle_x, middle_y = x + middle * cos, y + middle * sin
    for index in parts_near(middle_x, middle_y, field):
        part = parts[index]
        dx, dy = part.x - middle_x, part.y - middle_y
        if dx * dx + dy * dy >= (part.rim + rim + reach) ** 2:
            continue
        features = part_features(index, x, y, cos, sin, row, field, part)
        number += features * features  # a sum does not depend on the order of the parts
    return number
