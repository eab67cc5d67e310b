"""The clearance of a packed obstacle field (kernels): signed distance of the robot to the nearest obstacle."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.field.distance import part_geometry, wall_distance
from leapnav.envs.field.layout import displacement_of, header_of, parts_in, time_of
from leapnav.envs.field.rectangle import ROW, row_axis, separation, wall_separation
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, MATRIX, VECTOR, tuple_of


@kernel(tuple_of(float64, int64)(float64, float64, float64, CONSTANT))
def obstacle_distance(x, y, time, field):
    """Signed distance (m) from a point to the nearest obstacle or wall at a time (s), and the index of that obstacle.

    Negative inside. The wall has the index -1.
    """
    header = header_of(field)
    best = min(
        min(wall_distance(x, y, header, 0), wall_distance(x, y, header, 2)),
        min(wall_distance(x, y, header, 1), wall_distance(x, y, header, 3)),
    )
    nearest = -1
    for part in parts_in(field):
        moved_x, moved_y = displacement_of(field, part, time)
        dx, dy = x - moved_x - part.x, y - moved_y - part.y
        if dx * dx + dy * dy < max(best + part.rim, 0.0) ** 2:  # compares squares, since most parts are farther away
            distance = part_geometry(x - moved_x, y - moved_y, 0.0, field, part)[0]
            if distance < best:
                best, nearest = distance, part.obstacle
    return best, nearest


@kernel(tuple_of(float64, int64)(float64, float64, CONSTANT))
def clearance(x, y, field):
    """Signed distance (m) from a disc with the radius of the field at time 0, and the index of the nearest obstacle.

    See `obstacle_distance`.
    """
    distance, nearest = obstacle_distance(x, y, 0.0, field)
    return distance - header_of(field).radius, nearest


@kernel(tuple_of(float64, int64)(float64, float64, float64, float64, ROW, float64, CONSTANT))
def _rectangle_clearance(x, y, cos, sin, row, time, field):
    """Signed distance (m) from a rectangle to the nearest obstacle or wall at a time (s), and the obstacle's index."""
    middle, rim = (row[0] + row[1]) / 2.0, math.hypot((row[1] - row[0]) / 2.0, row[2]) + row[3]
    middle_x, middle_y = x + middle * cos, y + middle * sin
    best, nearest = wall_separation(x, y, cos, sin, row, header_of(field)), -1
    for part in parts_in(field):
        moved_x, moved_y = displacement_of(field, part, time)
        dx, dy = middle_x - moved_x - part.x, middle_y - moved_y - part.y
        if dx * dx + dy * dy < max(best + part.rim + rim, 0.0) ** 2:
            distance = separation(x - moved_x, y - moved_y, cos, sin, row, field, part)
            if distance < best:
                best, nearest = distance, part.obstacle
    return best, nearest


@kernel(tuple_of(float64, int64)(CONSTANT, CONSTANT_MATRIX, CONSTANT))
def footprint_clearance(q, outline, field):
    """Signed distance (m) from the robot's outline to the nearest obstacle or wall, and the index of that obstacle.

    Args:
        q: state of the robot, or its pose (m, rad) if the outline has no joint. Its entry with the index `clock` of the
            field is the time (s) at which moving obstacles are considered; without one it is 0.
        outline (K, 5): see `leapnav.envs.robots.footprints.outline_of`; rows of zeros are unused.
        field: packed obstacle field.

    """
    x, y, time = q[0], q[1], time_of(q, field)
    if len(outline) == 1 and outline[0, 0] == 0.0 and outline[0, 1] == 0.0:
        distance, nearest = obstacle_distance(x, y, time, field)
        return distance - outline[0, 3], nearest
    best, found = np.inf, -1
    for k in range(len(outline)):
        a, axis = outline[k, 0], row_axis(q, outline[k, 4])
        cos, sin = math.cos(axis), math.sin(axis)
        if outline[k, 1] > a:
            row = (a, outline[k, 1], outline[k, 2], outline[k, 3])
            distance, nearest = _rectangle_clearance(x, y, cos, sin, row, time, field)
        elif outline[k, 3] > 0.0:
            distance, nearest = obstacle_distance(x + a * cos, y + a * sin, time, field)
            distance -= outline[k, 3]
        else:
            continue
        if distance < best:
            best, found = distance, nearest
    return best, found


@kernel(VECTOR(MATRIX, CONSTANT_MATRIX, CONSTANT))
def footprint_clearances(states, outline, field):
    """Clearance (m) of the robot's outline at many states, shape (N, n) -> (N,), see `footprint_clearance`."""
    result = np.empty(len(states))
    for i in range(len(states)):
        result[i] = footprint_clearance(states[i], outline, field)[0]
    return result


@kernel(float64(MATRIX, CONSTANT_MATRIX, CONSTANT))
def path_clearance(states, outline, field):
    """Smallest clearance (m) of the robot's outline along a path of states (N, n), N >= 2, also between them.

    In the middle between two states, the chord of a circle of the radius of the smallest disc in the outline, such as
    around a vertex of an obstacle, is closer to its centre than the arc, by the sagitta that is added.
    """
    radius = np.inf
    for k in range(len(outline)):
        radius = min(radius, outline[k, 2] + outline[k, 3])
    best = footprint_clearance(states[0], outline, field)[0]
    for i in range(1, len(states)):
        best = min(best, footprint_clearance(states[i], outline, field)[0])
        middle = 0.5 * (states[i] + states[i - 1])
        step = math.hypot(states[i, 0] - states[i - 1, 0], states[i, 1] - states[i - 1, 1])
        best = min(best, footprint_clearance(middle, outline, field)[0] + step * step / (8.0 * radius))
    return best


@kernel(VECTOR(MATRIX, CONSTANT))
def clearances(points, field):
    """Clearance (m) of many points, shape (N, >= 2) -> (N,)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = clearance(points[i, 0], points[i, 1], field)[0]
    return result
