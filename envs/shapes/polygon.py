"""Convex polygons."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import field_validator

from leapnav.envs.shapes.base import Part, register
from leapnav.envs.utils.records import Point


@register
class Polygon(Part):
    """A convex polygon obstacle: at least three vertices (x, y) (m), in either orientation."""

    kind: ClassVar = "polygon"

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

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return the vertices and the radius 0."""
        return self.outline(), 0.0

    def outline(self) -> np.ndarray:
        """Return the vertices (m, 2)."""
        return np.asarray(self.vertices, dtype=float)


def _following(rows: np.ndarray) -> np.ndarray:
    """Return the row after each row, which for the last one is the first; np.roll takes five times as long."""
    return np.concatenate([rows[1:], rows[:1]])


def edge_rows(vertices: np.ndarray) -> np.ndarray:
    """Return the rows (m, 6) of the edges of a convex polygon: outward normal, offset, first vertex and length.

    Two vertices make the two sides of a segment.
    """
    # Relative to a vertex, so that rounding does not change the sign of the area of a small polygon.
    (x, y), (next_x, next_y) = (vertices - vertices[0]).T, (_following(vertices) - vertices[0]).T
    if float(np.sum(x * next_y - y * next_x)) < 0:
        vertices = vertices[::-1]  # counter-clockwise, so that (dy, -dx) points outwards
    edges = _following(vertices) - vertices
    lengths = np.hypot(edges[:, :1], edges[:, 1:])
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / lengths
    offsets = np.sum(normals * vertices, axis=1)
    return np.column_stack([normals, offsets, vertices, lengths])
