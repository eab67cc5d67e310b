"""The proximity cost and the clearance of a packed obstacle field on a regular grid of points (kernel)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CONSTANT, MATRIX, tuple_of
from leapnav.envs.shapes.circle import softened_distance
from leapnav.envs.shapes.field import CENTRE, CIRCLES, LENGTH, RECORDS, RIM, SHAPES
from leapnav.envs.shapes.half_plane import wall_distance
from leapnav.envs.shapes.polygon import half_plane_distance, polygon_distance, polygon_term
from leapnav.envs.shapes.records import first_polygon, record_distance, record_smooth_distance


class PointGrid(NamedTuple):
    """The points (x0 + i spacing, y0 + j spacing), i < columns and j < lines; in metres."""

    x0: float
    y0: float
    spacing: float
    columns: int
    lines: int


POINT_GRID = record_type(PointGrid, x0=float64, y0=float64, spacing=float64, columns=int64, lines=int64)


@kernel(tuple_of(*[int64] * 2)(float64, float64, float64, float64, int64))
def _index_range(low, high, origin, spacing, count):
    """First index, and the index after the last one, of the points from `low` to `high`."""
    return max(int((low - origin) / spacing), 0), min(int((high - origin) / spacing) + 2, count)


@kernel(tuple_of(MATRIX, MATRIX)(CONSTANT, float64, POINT_GRID, float64))
def sample_grid(field, radius, grid, band):
    """Phi and clearance (m) of a disc of a radius (m), both (columns, lines), at the points of a grid.

    Obstacles farther away than `band` (m) do not contribute to Phi, and the clearance is at most `band`, so that each
    obstacle is evaluated at the points around it only.
    """
    weight, steepness = field[0], 1.0 / field[1]
    x0, y0, spacing, columns, lines = grid.x0, grid.y0, grid.spacing, grid.columns, grid.lines
    phi = np.empty((columns, lines))
    closest = np.empty((columns, lines))
    for i in range(columns):
        for j in range(lines):
            x, y = x0 + i * spacing, y0 + j * spacing
            phi[i, j], closest[i, j] = 0.0, band
            for side in range(4):
                distance = wall_distance(x, y, field, side) - radius
                if distance < band:
                    phi[i, j] += weight * math.exp(-distance * steepness)
                    closest[i, j] = min(closest[i, j], distance)
    reach = band + radius
    at = SHAPES
    for _ in range(int(field[CIRCLES])):
        cx, cy, r = field[at], field[at + 1], field[at + 2]
        at += 3
        first, last = _index_range(cx - r - reach, cx + r + reach, x0, spacing, columns)
        bottom, top = _index_range(cy - r - reach, cy + r + reach, y0, spacing, lines)
        for i in range(first, last):
            for j in range(bottom, top):
                dx, dy = x0 + i * spacing - cx, y0 + j * spacing - cy
                distance = math.hypot(dx, dy) - r - radius
                if distance < band:
                    phi[i, j] += weight * math.exp((r + radius - softened_distance(dx, dy)) * steepness)
                    closest[i, j] = min(closest[i, j], distance)
    others = first_polygon(field)[1]
    for _ in range(others):
        cx, cy, r = field[at + CENTRE], field[at + CENTRE + 1], field[at + RIM]
        first, last = _index_range(cx - r - reach, cx + r + reach, x0, spacing, columns)
        bottom, top = _index_range(cy - r - reach, cy + r + reach, y0, spacing, lines)
        for i in range(first, last):
            for j in range(bottom, top):
                x, y = x0 + i * spacing, y0 + j * spacing
                distance = record_distance(x, y, field, at) - radius
                if distance < band:
                    smooth = record_smooth_distance(x, y, field, at)[0]
                    phi[i, j] += weight * math.exp((radius - smooth) * steepness)
                    closest[i, j] = min(closest[i, j], distance)
        at += 2 + int(field[at + LENGTH])
    for _ in range(int(field[RECORDS]) - others):
        edges = int(field[at])
        rows = at + 1
        at = rows + 5 * edges
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for k in range(edges):
            low_x, high_x = min(low_x, field[rows + 5 * k + 3]), max(high_x, field[rows + 5 * k + 3])
            low_y, high_y = min(low_y, field[rows + 5 * k + 4]), max(high_y, field[rows + 5 * k + 4])
        first, last = _index_range(low_x - reach, high_x + reach, x0, spacing, columns)
        bottom, top = _index_range(low_y - reach, high_y + reach, y0, spacing, lines)
        for i in range(first, last):
            for j in range(bottom, top):
                x, y = x0 + i * spacing, y0 + j * spacing
                if half_plane_distance(x, y, field, rows, edges) - radius < band:
                    phi[i, j] += weight * polygon_term(x, y, field, rows, edges, radius, steepness)
                    closest[i, j] = min(closest[i, j], polygon_distance(x, y, field, rows, edges) - radius)
    return phi, closest
