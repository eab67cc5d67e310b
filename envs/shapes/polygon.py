"""Convex polygons (kernels): distances, and the value and the derivatives of a proximity term.

In a packed field the rows of a polygon with m edges begin at `rows`: m times (n_x, n_y, c, x, y), see
`leapnav.envs.shapes.field`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of


@kernel(float64(float64, float64, CONSTANT, int64, int64))
def half_plane_distance(x, y, field, rows, edges):
    """Largest signed distance (m) to the half-planes of the edges: at most the distance to the polygon."""
    largest = -np.inf
    for j in range(edges):
        row = rows + 5 * j
        largest = max(largest, field[row] * x + field[row + 1] * y - field[row + 2])
    return largest


@kernel(float64(float64, float64, CONSTANT, int64, int64))
def polygon_distance(x, y, field, rows, edges):
    """Euclidean distance (m) to the polygon, negative inside."""
    inside = -np.inf
    outside = np.inf
    for j in range(edges):
        row = rows + 5 * j
        nx, ny = field[row], field[row + 1]
        following = rows + 5 * ((j + 1) % edges)
        ax, ay = field[row + 3], field[row + 4]
        inside = max(inside, nx * x + ny * y - field[row + 2])
        # Position along the edge, whose direction is the normal rotated by 90 degrees, clamped to the edge.
        length = -ny * (field[following + 3] - ax) + nx * (field[following + 4] - ay)
        along = min(max(-ny * (x - ax) + nx * (y - ay), 0.0), length)
        outside = min(outside, math.hypot(x - ax + ny * along, y - ay - nx * along))
    return inside if inside < 0 else outside


@kernel(float64(float64, float64, CONSTANT, int64, int64, float64, float64))
def polygon_term(x, y, field, rows, edges, radius, steepness):
    """Value of the proximity term per unit of weight: 1 / (sum over the edges of exp((distance - radius) / scale))."""
    largest = half_plane_distance(x, y, field, rows, edges)
    total = 0.0
    for j in range(edges):
        row = rows + 5 * j
        # Shifted by the largest distance: exp() of the distances themselves overflows.
        total += math.exp((field[row] * x + field[row + 1] * y - field[row + 2] - largest) * steepness)
    return math.exp((radius - largest) * steepness) / total


@kernel(tuple_of(*[float64] * 5)(float64, float64, float64, float64, float64, float64, float64))
def polygon_derivatives(mx, my, sxx, sxy, syy, term, steepness):
    """Minus the gradient, and the Hessian (xx, xy, yy), of a proximity term of a polygon.

    Args:
        mx, my: mean normal of the edges, weighted by their exponentials.
        sxx, sxy, syy: weighted mean products of the normals' components.
        term: value of the term.
        steepness: 1 / proximity scale (1/m).

    """
    slope = term * steepness
    bend = slope * steepness
    return slope * mx, slope * my, bend * (2 * mx * mx - sxx), bend * (2 * mx * my - sxy), bend * (2 * my * my - syy)
