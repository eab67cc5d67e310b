"""Capsules: thick segments, such as the walls of a map of lines."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from leapnav.envs.shapes.base import Part, register
from leapnav.envs.shapes.circle import N_OUTLINE, arc
from leapnav.envs.utils.records import Point, Positive


@register
class Capsule(Part):
    """A thick segment: all points within `radius` (m) of the segment from `start` to `end` (x, y) (m)."""

    kind: ClassVar = "capsule"

    start: Point
    end: Point
    radius: Positive

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return both ends and the radius."""
        return np.array([self.start, self.end]), self.radius

    def outline(self) -> np.ndarray:
        """Return points on the boundary, counter-clockwise (N_OUTLINE + 2, 2)."""
        angle = math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])
        ends = ((self.end, angle - math.pi / 2), (self.start, angle + math.pi / 2))
        return np.concatenate([arc(p, self.radius, a, a + math.pi, N_OUTLINE // 2 + 1) for p, a in ends])
