"""Geodesic distances to the goal: the length of the shortest path among the obstacles, and how much each beam adds.

The length is measured in the metric m(x) ds with m = sqrt(1 + Phi(x) / E), in which the path of an optimum is nearly a
shortest path: at constant energy E = 1/2 v^2 - Phi, the integral of 1/2 v^2 + Phi along a path is proportional to that
of sqrt(E + Phi) (Jacobi's form of the principle of least action; V. I. Arnold, Mathematical Methods of Classical
Mechanics, 1989, section 45). Far from obstacles it is the length in metres. The distances solve the eikonal equation
|grad D| = m, D(goal) = 0, on a grid, by fast sweeping (H. Zhao, "A fast sweeping method for eikonal equations",
Mathematics of Computation 74, 2005). The robot's position may lie anywhere in the arena: in obstacles the metric is
large, but finite.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import float32, float64, from_dtype

from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.layout import header_of, read_header
from leapnav.envs.field.packing import field_parts, replace_parts
from leapnav.envs.field.proximity import proximity_value
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import records_of
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING, VECTOR

SPACING = 0.1  # m, of the grid; larger in an arena in which the grid would have more than MAX_POINTS points
MAX_POINTS = 40_000
REFERENCE_SPEED = 0.8  # m/s; E is half its square
OBSTACLE_METRIC = 20.0  # lower bound of the metric in obstacles
SOURCE_RADIUS = 2.5  # spacings around the goal in which the distance is that of a straight line
TOLERANCE = 1e-3  # m; largest change in the last iteration of the sweeps
MAX_SWEEPS = 60
FAR = 1e6
BEAM_STEP = 0.25  # m between the points of a beam at which a detour is evaluated
MAX_BEAM = 5.0  # m; more distant points are not evaluated
MAX_DETOUR = 3.0  # m; upper bound of an observed detour
CACHE_SIZE = 512  # maps; each has 41 kB in an arena of 10 m x 10 m

# The beginning of a packed map, before the distances: first point, spacing (m), numbers of points in x and y.
MAP_HEADER = np.dtype([("x_min", "f4"), ("y_min", "f4"), ("spacing", "f4"), ("nx", "i4"), ("ny", "i4")])
MAP_ENTRIES = MAP_HEADER.itemsize // 4


def geodesic_map(field: np.ndarray, goal_x: float, goal_y: float) -> np.ndarray:
    """Return the distances to a goal on a grid over the arena, as a packed map for the kernels of this module, float32.

    Moving obstacles are left out: they may be elsewhere when the robot arrives.

    The most recently used maps are kept, so that the episodes of a scenario share one.

    Args:
        field: packed obstacle field.
        goal_x, goal_y: position of the goal (m).

    """
    if read_header(field)["moving"]:
        field = replace_parts(field, [part for part in field_parts(field) if not len(part.knots)])
    return _solve(field.tobytes(), goal_x, goal_y)


@lru_cache(CACHE_SIZE)
def _solve(content: bytes, goal_x: float, goal_y: float) -> np.ndarray:
    field = np.frombuffer(content)
    x_min, y_min, x_max, y_max = read_header(field)["arena"].tolist()
    spacing = max(SPACING, math.sqrt((x_max - x_min) * (y_max - y_min) / MAX_POINTS))
    nx, ny = (math.ceil(side / spacing - 1e-9) + 1 for side in (x_max - x_min, y_max - y_min))
    distances = np.empty((nx, ny))
    solve_eikonal(field, goal_x, goal_y, spacing, distances)
    header = np.array([(x_min, y_min, spacing, nx, ny)], MAP_HEADER)
    return np.concatenate([header.view(np.float32), distances.ravel().astype(np.float32)])


@kernel(from_dtype(MAP_HEADER)(float32[::1]))
def map_header_of(packed):
    """Return the `MAP_HEADER` of a packed map."""
    return records_of(packed, 0, 1, MAP_HEADER)[0]


@kernel(NOTHING(CONSTANT, float64, float64, float64, MATRIX))
def solve_eikonal(field, goal_x, goal_y, spacing, distances):
    """Write the distances to a goal (nx, ny) on a grid that starts at the lower left corner of the arena."""
    header, (nx, ny) = header_of(field), distances.shape
    metric = np.empty((nx, ny))
    energy = 0.5 * REFERENCE_SPEED**2
    for i in range(nx):
        for j in range(ny):
            x, y = header.arena[0] + spacing * i, header.arena[1] + spacing * j
            factor = math.sqrt(1.0 + proximity_value(x, y, header.radius, field) / energy)
            if clearance(x, y, field)[0] <= 0.0:
                factor = OBSTACLE_METRIC
            metric[i, j] = spacing * min(factor, OBSTACLE_METRIC)
            away = math.sqrt((x - goal_x) ** 2 + (y - goal_y) ** 2) / spacing
            distances[i, j] = away * metric[i, j] if away <= SOURCE_RADIUS else FAR
    for _ in range(MAX_SWEEPS):
        largest = 0.0
        for order in range(4):
            for row in range(nx):
                i = row if order % 2 == 0 else nx - 1 - row
                for column in range(ny):
                    j = column if order < 2 else ny - 1 - column
                    a = min(distances[i - 1, j] if i > 0 else FAR, distances[i + 1, j] if i < nx - 1 else FAR)
                    b = min(distances[i, j - 1] if j > 0 else FAR, distances[i, j + 1] if j < ny - 1 else FAR)
                    step, low = metric[i, j], min(a, b)
                    if low >= FAR:
                        continue
                    new = low + step  # from one neighbour, or from two
                    if abs(a - b) < step:
                        new = 0.5 * (a + b + math.sqrt(2.0 * step * step - (a - b) ** 2))
                    if new < distances[i, j] - 1e-9:
                        largest = max(largest, distances[i, j] - new)
                        distances[i, j] = new
        if largest < TOLERANCE:
            break


@kernel(float64(float64, float64, float32[::1]))
def geodesic_distance(x, y, packed):
    """Return the distance (m) from a point to the goal, by bilinear interpolation in a packed map."""
    header = map_header_of(packed)
    nx, ny = header.nx, header.ny
    u = min(max((x - header.x_min) / header.spacing, 0.0), nx - 1.0)
    v = min(max((y - header.y_min) / header.spacing, 0.0), ny - 1.0)
    i, j = min(int(u), nx - 2), min(int(v), ny - 2)
    a, b = u - i, v - j
    at = MAP_ENTRIES + i * ny + j
    near = (1.0 - b) * packed[at] + b * packed[at + 1]
    return (1.0 - a) * near + a * ((1.0 - b) * packed[at + ny] + b * packed[at + ny + 1])


@kernel(NOTHING(float64, float64, float64, float32[::1], float64, MATRIX, VECTOR, VECTOR))
def geodesic_detours(x, y, heading, packed, radius, beams, ranges, out):
    """Write the detour of each lidar beam: what a path along the beam and then to the goal is longer than the shortest.

    It is the minimum of s + D(p + s e) - D(p) over points of the beam at the distances s = 0.25 m, 0.5 m, ... up to the
    farthest that the robot can reach, at least 0 and at most `MAX_DETOUR`. Thus it is 0 in the direction of the
    shortest path, and 0.5 m in the opposite direction.

    Args:
        x, y, heading: pose of the robot (m, rad), at the position p.
        packed: see `geodesic_map`.
        radius: radius of the robot (m).
        beams (2, n): cosine and sine of the angle of each beam, relative to the heading.
        ranges (n,): lidar ranges (m).
        out (n,): overwritten.

    """
    here, cos, sin = geodesic_distance(x, y, packed), math.cos(heading), math.sin(heading)
    for k in range(beams.shape[1]):
        ex, ey = cos * beams[0, k] - sin * beams[1, k], sin * beams[0, k] + cos * beams[1, k]
        reach = min(max(ranges[k] - radius, 0.0), MAX_BEAM)
        best = MAX_DETOUR
        for number in range(1, int(reach / BEAM_STEP) + 2):
            s = min(BEAM_STEP * number, reach)
            best = min(best, s + geodesic_distance(x + s * ex, y + s * ey, packed) - here)
        out[k] = max(best, 0.0)
