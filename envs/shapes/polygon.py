"""Convex polygons.

The loops over the polygons of a packed field are written out where speed matters. They use the kernels of the
distances, and of the value and the derivatives of a proximity term. In a packed field the rows of a polygon with m
edges begin at `rows`: m times (n_x, n_y, c, x, y), see `leapnav.envs.shapes.field`.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numba import float64, int64
from pydantic import field_validator

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, tuple_of
from leapnav.envs.shapes.base import DISTANCE_SIGNATURE, SMOOTH_DISTANCE_SIGNATURE, Shape, register
from leapnav.envs.utils.records import Point


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


@kernel(DISTANCE_SIGNATURE)
def distance(x, y, values):
    """Distance (m), negative inside; `values` are the rows of the edges."""
    return polygon_distance(x, y, values, 0, len(values) // 5)


@kernel(SMOOTH_DISTANCE_SIGNATURE)
def smooth_distance(x, y, scale, values):
    """Smooth maximum of the distances (m) to the half-planes of the edges, with derivatives."""
    largest = half_plane_distance(x, y, values, 0, len(values) // 5)
    total = mx = my = sxx = sxy = syy = 0.0
    for row in range(0, len(values), 5):
        nx, ny = values[row], values[row + 1]
        weight = math.exp((nx * x + ny * y - values[row + 2] - largest) / scale)
        total += weight
        mx += weight * nx
        my += weight * ny
        sxx += weight * nx * nx
        sxy += weight * nx * ny
        syy += weight * ny * ny
    mx, my = mx / total, my / total
    hxx, hxy, hyy = sxx / total - mx * mx, sxy / total - mx * my, syy / total - my * my
    return largest + scale * math.log(total), mx, my, hxx / scale, hxy / scale, hyy / scale


@register
class Polygon(Shape):
    """A convex polygon obstacle: at least three vertices (x, y) (m), in either orientation."""

    kind: ClassVar = "polygon"
    distance: ClassVar = distance
    smooth_distance: ClassVar = smooth_distance
    is_lipschitz: ClassVar[bool] = True

    vertices: tuple[Point, ...]

    @field_validator("vertices")
    @classmethod
    def _check_convex(cls, vertices: tuple[Point, ...]) -> tuple[Point, ...]:
        if len(vertices) < 3:
            raise ValueError(f"a polygon needs at least 3 vertices, this one has {len(vertices)}")
        points = np.asarray(vertices)
        edges = _following(points) - points
        following = _following(edges)
        turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        angles = np.arctan2(turns, np.sum(edges * following, axis=1))
        # The boundary of a convex polygon turns in one direction only, by 2 pi in total (that of a star by more).
        same_direction = bool(np.all(turns > 0) or np.all(turns < 0))
        if not same_direction or not math.isclose(abs(float(angles.sum())), 2 * math.pi, rel_tol=1e-6):
            raise ValueError("the polygon is not strictly convex; write a non-convex obstacle as several convex ones")
        return vertices

    def values(self) -> tuple[float, ...]:
        """Return the rows (n_x, n_y, c, x, y) of the edges."""
        return tuple(edge_rows(self.outline()).ravel().tolist())

    def outline(self) -> np.ndarray:
        """Return the vertices (m, 2)."""
        return np.asarray(self.vertices, dtype=float)

    def centre(self) -> tuple[float, float]:
        """Return the mean of the vertices."""
        x, y = self.outline().mean(axis=0).tolist()
        return x, y


def _following(rows: np.ndarray) -> np.ndarray:
    """Return the row after each row, which for the last one is the first; np.roll takes five times as long."""
    return np.concatenate([rows[1:], rows[:1]])


def edge_rows(vertices: np.ndarray) -> np.ndarray:
    """Return the rows (m, 5) of the edges of a polygon: outward normal, offset and first vertex."""
    after = _following(vertices)
    edges = after - vertices
    area = float(np.sum(vertices[:, 0] * after[:, 1] - vertices[:, 1] * after[:, 0]))
    if area < 0:  # reverse to counter-clockwise, so that (dy, -dx) points outwards
        return edge_rows(vertices[::-1])
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    offsets = np.sum(normals * vertices, axis=1)
    return np.column_stack([normals, offsets, vertices])
