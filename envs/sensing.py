"""What the robot senses: lidar ranges and the goal, as compiled kernels."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, float64, njit, types

from leapnav.envs.obstacles import ARENA, CIRCLES, POLYGONS, SHAPES

_field = types.Array(types.float64, 1, "C", readonly=True)

# Entries of the observation before the lidar ranges; the environment's docstring says what they mean.
POSE_ENTRIES = 9


@njit(float64(float64, float64, float64, float64, _field, float64), cache=True, error_model="numpy", nogil=True)
def cast_ray(x, y, dx, dy, field, reach):
    """Distance (m) from (x, y) along the unit vector (dx, dy) to the first obstacle or wall, at most `reach`."""
    nearest = reach
    if dx > 0:
        nearest = min(nearest, (field[ARENA + 2] - x) / dx)
    elif dx < 0:
        nearest = min(nearest, (field[ARENA] - x) / dx)
    if dy > 0:
        nearest = min(nearest, (field[ARENA + 3] - y) / dy)
    elif dy < 0:
        nearest = min(nearest, (field[ARENA + 1] - y) / dy)
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        cx, cy, r = field[at] - x, field[at + 1] - y, field[at + 2]
        at += 3
        along = cx * dx + cy * dy
        beside = cx * dy - cy * dx
        square = r * r - beside * beside
        if square > 0:
            half = math.sqrt(square)
            if along + half > 0:
                nearest = min(nearest, along - half)
    for _ in range(int(field[POLYGONS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        # The part of the ray inside the polygon is the part behind all of its edges.
        enter, leave = -np.inf, np.inf
        for j in range(edges):
            row = rows + 5 * j
            rate = field[row] * dx + field[row + 1] * dy
            height = field[row] * x + field[row + 1] * y - field[row + 2]
            if rate < 0:
                enter = max(enter, -height / rate)
            elif rate > 0:
                leave = min(leave, -height / rate)
            elif height > 0:
                leave = -np.inf
        if enter <= leave and leave > 0:
            nearest = min(nearest, enter)
    return max(nearest, 0.0)


@njit(
    types.none(
        float64, float64, float64, float64, float64, float64, float64, float64, float64, _field, float64, float32[::1]
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def observe(x, y, heading, goal_x, goal_y, goal_heading, time_left, shortest_time, limit, field, reach, out):
    """Fills `out` with the observation that `Navigate`'s docstring describes; a NaN goal heading is a free one.

    Velocities needed are distances over the time left, at least `shortest_time`, and no larger than `limit`.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = goal_x - x, goal_y - y
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    turn = 0.0 if math.isnan(goal_heading) else (goal_heading - heading + math.pi) % (2 * math.pi) - math.pi
    time = max(time_left, shortest_time)
    out[0] = ahead
    out[1] = left
    out[2] = 0.0 if math.isnan(goal_heading) else math.cos(turn)
    out[3] = 0.0 if math.isnan(goal_heading) else math.sin(turn)
    out[4] = time_left
    out[5] = min(max(ahead / time, -limit), limit)
    out[6] = min(max(left / time, -limit), limit)
    out[7] = min(math.hypot(dx, dy) / time, limit)
    out[8] = min(max(turn / time, -limit), limit)
    beams = len(out) - POSE_ENTRIES
    for k in range(beams):
        angle = heading + 2 * math.pi * k / beams
        out[POSE_ENTRIES + k] = cast_ray(x, y, math.cos(angle), math.sin(angle), field, reach)
