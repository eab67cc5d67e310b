"""Circles."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from leapnav.envs.shapes.base import Part, register
from leapnav.envs.utils.records import Point, Positive

N_OUTLINE = 64  # points on the outline


@register
class Circle(Part):
    """A disc obstacle: center (x, y) and radius (m)."""

    kind: ClassVar = "circle"

    center: Point
    radius: Positive

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return the centre and the radius."""
        return np.array([self.center]), self.radius

    def outline(self) -> np.ndarray:
        """Return points on the circle, counter-clockwise (N_OUTLINE, 2)."""
        return arc(self.center, self.radius, 0.0, 2 * math.pi, N_OUTLINE + 1)[:-1]


def arc(center: Point, radius: float, first: float, last: float, count: int) -> np.ndarray:
    """Return `count` points (count, 2) on an arc of a circle between two angles (rad)."""
    angles = np.linspace(first, last, count)
    return np.array(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
