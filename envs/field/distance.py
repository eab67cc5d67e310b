"""Exact distances from a disc to walls and to the parts of a packed field, and the barrier of a distance (kernels).

The gradient of a distance is the outward unit normal, and its Hessian is the curvature of the level line times t t'
with the tangent t.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.field.barrier import barrier
from leapnav.envs.field.layout import HEADER_TYPE, PART_TYPE, edges_of
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of

# Smallest distances (m) from the centre of a circle, and from a vertex, with which normal and curvature are computed.
# Only guesses deep in an obstacle come so close to a centre. The corner of a rectangle comes close to a vertex; the
# distance is below that at which the barrier becomes a polynomial.
MIN_CENTRE_DISTANCE, MIN_DISTANCE = 1e-3, 1e-6
HASH_FACTOR = 31  # of numbers that are combined to one


@kernel(float64(float64, float64, HEADER_TYPE, int64), forceinline=True)
def wall_distance(x, y, header, side):
    """Distance (m) to a wall, positive inside the arena; `side` is 0 to 3 for x_min, y_min, x_max, y_max."""
    sign = 1.0 if side < 2 else -1.0
    return sign * ((x if side % 2 == 0 else y) - header.arena[side])


@kernel(tuple_of(float64, int64, float64)(float64, float64, CONSTANT, PART_TYPE), forceinline=True)
def _nearest_edge(x, y, field, part):
    """Edge of a polygon whose line is farthest away: (signed distance of the line (m), number of the edge, beyond).

    `beyond` is the coordinate (m) along the line beyond the ends of the edge: negative before its first vertex,
    positive after its second, zero between them.
    """
    edges = edges_of(field, part)
    largest, nearest = -np.inf, 0
    for k in range(part.edges):
        height = edges[k].nx * x + edges[k].ny * y - edges[k].offset
        if height > largest:
            largest, nearest = height, k
    edge = edges[nearest]
    along = edge.nx * (y - edge.y) - edge.ny * (x - edge.x)
    return largest, nearest, min(along, max(along - edge.length, 0.0))


@kernel(int64(float64, float64, CONSTANT, PART_TYPE, float64), forceinline=True)
def closest_feature(x, y, field, part, reach):
    """Number of the edge or of the vertex of a rounded polygon that is closest to a point outside.

    Edges have even numbers, and vertices odd ones. The curvature of the distance is continuous where the feature does
    not change. Beyond the distance `reach` (m) the result is 0.
    """
    largest, nearest, beyond = _nearest_edge(x, y, field, part)
    if math.sqrt(largest * largest + beyond * beyond) - part.rounding >= reach:
        return 0
    if beyond > 0.0:
        nearest = (nearest + 1) % part.edges  # which begins at the vertex
    return 2 * (1 + part.first + nearest) + (1 if beyond != 0.0 else 0)


@kernel(tuple_of(*[float64] * 4)(float64, float64, float64, CONSTANT, PART_TYPE), forceinline=True)
def part_geometry(x, y, radius, field, part):
    """Signed distance (m) from a disc to a part, its gradient (2), and the curvature (1/m) of its level line.

    The nearest point of a polygon is on the edge whose line is farthest away, or one of its ends.

    Args:
        x, y, radius: the disc (m).
        field: packed obstacle field.
        part: one of its shapes.

    """
    if part.edges == 0:
        dx, dy = x - part.x, y - part.y
        distance = math.sqrt(dx * dx + dy * dy)
        curvature = 1.0 / (distance if distance > MIN_CENTRE_DISTANCE else MIN_CENTRE_DISTANCE)
        return distance - (part.rounding + radius), dx * curvature, dy * curvature, curvature
    largest, nearest, beyond = _nearest_edge(x, y, field, part)
    edge = edges_of(field, part)[nearest]
    if beyond == 0.0:  # everywhere inside
        return largest - part.rounding - radius, edge.nx, edge.ny, 0.0
    distance = math.sqrt(largest * largest + beyond * beyond)
    curvature = 1.0 / (distance if distance > MIN_DISTANCE else MIN_DISTANCE)
    across, beside = largest * curvature, beyond * curvature
    nx, ny = across * edge.nx - beside * edge.ny, across * edge.ny + beside * edge.nx
    return distance - part.rounding - radius, nx, ny, curvature


@kernel(tuple_of(*[float64] * 6)(float64, float64, float64, float64, HEADER_TYPE), forceinline=True)
def barrier_term(distance, nx, ny, curvature, header):
    """Barrier of a distance, with gradient and Hessian.

    Args:
        distance: from the robot's outline (m).
        nx, ny, curvature: gradient of the distance, and curvature of its level line (1/m).
        header: header of the packed obstacle field.

    """
    steepness = 1.0 / header.scale
    value, slope, bend = barrier(distance * steepness, header.least_distance)
    slope *= steepness
    curl = slope * curvature
    bend = bend * steepness * steepness - curl
    return value, slope * nx, slope * ny, bend * nx * nx + curl, bend * nx * ny, bend * ny * ny + curl
