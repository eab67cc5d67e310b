"""What the robot senses of its surroundings, as compiled kernels: lidar ranges, or a map of what is near."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.envs.fields import ARENA, CIRCLES, POLYGONS, SHAPES
from leapnav.envs.obstacles import polygon_distance

_field = types.Array(types.float64, 1, "C", readonly=True)

WALL_ENTRIES = 6  # of a survey, before the obstacles


@njit(
    types.none(float64, float64, float64, float64, _field, float64, float64[:, ::1], float64[:, ::1]),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def scan(x, y, cos, sin, field, reach, beams, scratch):
    """Lidar ranges (m), at most `reach`, into `scratch[2]`.

    Args:
        x, y, cos, sin: where the lidar is and looks.
        field: the packed field of the scenario.
        reach: m.
        beams (2, n): cosines and sines of the beams' angles in the lidar's frame.
        scratch (5, n): the last rows are used.

    Every obstacle is cast at all beams at once, without branches: compilers turn that into vector instructions.

    """
    count = beams.shape[1]
    dxs, dys, nearest, enter, leave = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    to_right, to_top = field[ARENA + 2] - x, field[ARENA + 3] - y
    to_left, to_bottom = field[ARENA] - x, field[ARENA + 1] - y
    for k in range(count):
        dx = cos * beams[0, k] - sin * beams[1, k]
        dy = sin * beams[0, k] + cos * beams[1, k]
        dxs[k], dys[k] = dx, dy
        across = (to_right if dx > 0.0 else to_left) / dx if dx != 0.0 else np.inf
        along = (to_top if dy > 0.0 else to_bottom) / dy if dy != 0.0 else np.inf
        first = across if across < along else along
        nearest[k] = first if first < reach else reach
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        cx, cy, r = field[at] - x, field[at + 1] - y, field[at + 2]
        at += 3
        if cx * cx + cy * cy >= (r + reach) ** 2:
            continue
        for k in range(count):
            along = cx * dxs[k] + cy * dys[k]
            beside = cx * dys[k] - cy * dxs[k]
            square = r * r - beside * beside
            half = math.sqrt(square if square > 0.0 else 0.0)
            hit = along - half if square > 0.0 and along + half > 0.0 else reach
            nearest[k] = hit if hit < nearest[k] else nearest[k]
    for _ in range(int(field[POLYGONS])):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        farthest = -np.inf
        for j in range(edges):
            row = rows + 5 * j
            farthest = max(farthest, field[row] * x + field[row + 1] * y - field[row + 2])
        if farthest >= reach:
            continue
        # The part of a ray inside the polygon is the part behind all of its edges.
        for k in range(count):
            enter[k], leave[k] = -np.inf, np.inf
        for j in range(edges):
            row = rows + 5 * j
            nx, ny = field[row], field[row + 1]
            height = nx * x + ny * y - field[row + 2]
            for k in range(count):
                rate = nx * dxs[k] + ny * dys[k]
                # A ray along an edge is inside or outside of it all the way.
                crossing = -height / rate if rate != 0.0 else (-np.inf if height > 0.0 else np.inf)
                enter[k] = crossing if rate < 0.0 and crossing > enter[k] else enter[k]
                leave[k] = crossing if rate >= 0.0 and crossing < leave[k] else leave[k]
        for k in range(count):
            hit = enter[k] if enter[k] <= leave[k] and leave[k] > 0.0 else reach
            nearest[k] = hit if hit < nearest[k] else nearest[k]
    for k in range(count):
        nearest[k] = nearest[k] if nearest[k] > 0.0 else 0.0


@njit(int64(_field), cache=True, error_model="numpy", nogil=True)
def most_vertices(field):
    """Vertices of the polygon that has most, 0 without polygons."""
    at = SHAPES + 3 * int(field[CIRCLES])
    most = 0
    for _ in range(int(field[POLYGONS])):
        most = max(most, int(field[at]))
        at += 1 + 5 * int(field[at])
    return most


@njit(
    types.none(float64, float64, float64, float64, _field, int64, int64, float64[::1]),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def survey(x, y, cos, sin, field, obstacles, vertices, out):
    """The walls and the nearest obstacles in the robot's frame, nearest first.

    `out` takes WALL_ENTRIES + obstacles (2 + 2 vertices) numbers. An obstacle is a polygon rounded by a radius: 1, the
    radius, and the vertices; a disc has one vertex, a polygon no radius. Vertices are repeated to fill the row; rows
    without an obstacle are zeros.
    """
    out[0], out[1] = x - field[ARENA], y - field[ARENA + 1]
    out[2], out[3] = field[ARENA + 2] - x, field[ARENA + 3] - y
    out[4], out[5] = cos, sin
    width = 2 + 2 * vertices
    out[WALL_ENTRIES : WALL_ENTRIES + obstacles * width] = 0.0
    circles, polygons = int(field[CIRCLES]), int(field[POLYGONS])
    # Insertion into a short list, nearest first.
    distances = np.full(obstacles, np.inf)
    places = np.zeros(obstacles, np.int64)
    at = SHAPES
    for i in range(circles + polygons):
        if i < circles:
            distance = math.sqrt((field[at] - x) ** 2 + (field[at + 1] - y) ** 2) - field[at + 2]
            size = 3
        else:
            edges = int(field[at])
            distance = polygon_distance(x, y, field, at + 1, edges)
            size = 1 + 5 * edges
        place = obstacles
        while place > 0 and distance < distances[place - 1]:
            place -= 1
        if place < obstacles:
            for k in range(obstacles - 1, place, -1):
                distances[k], places[k] = distances[k - 1], places[k - 1]
            distances[place], places[place] = distance, (at if i < circles else -at)
        at += size
    for k in range(obstacles):
        if distances[k] == np.inf:
            break
        row = WALL_ENTRIES + k * width
        at = abs(places[k])
        disc = places[k] > 0
        out[row] = 1.0
        out[row + 1] = field[at + 2] if disc else 0.0
        edges = 1 if disc else int(field[at])
        for j in range(vertices):
            vertex = at if disc else at + 1 + 5 * (j % edges) + 3
            dx, dy = field[vertex] - x, field[vertex + 1] - y
            out[row + 2 + 2 * j] = cos * dx + sin * dy
            out[row + 3 + 2 * j] = cos * dy - sin * dx
