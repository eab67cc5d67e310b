"""Capsules: thick segments, such as the walls of a map of lines."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import tuple_of
from leapnav.envs.shapes.base import DISTANCE_SIGNATURE, SMOOTH_DISTANCE_SIGNATURE, Shape, register
from leapnav.envs.shapes.circle import N_OUTLINE, arc, softened_distance
from leapnav.envs.utils.records import Point, Positive


@kernel(DISTANCE_SIGNATURE)
def distance(x, y, values):
    """Distance (m), negative inside; `values` are start, end and radius."""
    dx, dy, ex, ey = x - values[0], y - values[1], values[2] - values[0], values[3] - values[1]
    square = ex * ex + ey * ey
    part = min(max((dx * ex + dy * ey) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return math.hypot(dx - part * ex, dy - part * ey) - values[4]


@kernel(tuple_of(*[float64] * 3)(float64))
def softplus(z):
    """Softplus log(1 + exp(z)), with its first and second derivative."""
    small = math.exp(-abs(z))
    slope = (1.0 if z > 0.0 else small) / (1.0 + small)
    return max(z, 0.0) + math.log1p(small), slope, slope * (1.0 - slope)


@kernel(SMOOTH_DISTANCE_SIGNATURE)
def smooth_distance(x, y, scale, values):
    """Distance (m) with derivatives; the transition from a side to an end is smooth on the length `scale`."""
    dx, dy, ex, ey = x - values[0], y - values[1], values[2] - values[0], values[3] - values[1]
    length = math.hypot(ex, ey)
    ux, uy = (ex / length, ey / length) if length > 0.0 else (1.0, 0.0)
    along, across = dx * ux + dy * uy, dy * ux - dx * uy
    # The excess of `along` over [0, length]: a difference of two softplus functions, which is `along` for length 0.
    past, past_1, past_2 = softplus((along - length) / scale)
    before, before_1, before_2 = softplus(-along / scale)
    excess, slope, bend = scale * (past - before), past_1 + before_1, (past_2 - before_2) / scale
    d = softened_distance(excess, across)
    na, nc = excess / d, across / d
    # Derivatives along and across the segment, then in x and y.
    da, daa = na * slope, ((1.0 - na * na) * slope * slope + excess * bend) / d
    dac, dcc = -na * nc * slope / d, (1.0 - nc * nc) / d
    dxx = daa * ux * ux - 2.0 * dac * ux * uy + dcc * uy * uy
    dxy = (daa - dcc) * ux * uy + dac * (ux * ux - uy * uy)
    dyy = daa * uy * uy + 2.0 * dac * ux * uy + dcc * ux * ux
    return d - values[4], da * ux - nc * uy, da * uy + nc * ux, dxx, dxy, dyy


@register
class Capsule(Shape):
    """A thick segment: all points within `radius` (m) of the segment from `start` to `end` (x, y) (m)."""

    kind: ClassVar = "capsule"
    distance: ClassVar = distance
    smooth_distance: ClassVar = smooth_distance
    is_lipschitz: ClassVar[bool] = True

    start: Point
    end: Point
    radius: Positive

    def values(self) -> tuple[float, ...]:
        """Return start, end and radius."""
        return (*self.start, *self.end, self.radius)

    def outline(self) -> np.ndarray:
        """Return points on the boundary, counter-clockwise (N_OUTLINE + 2, 2)."""
        angle = math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])
        ends = ((self.end, angle - math.pi / 2), (self.start, angle + math.pi / 2))
        return np.concatenate([arc(p, self.radius, a, a + math.pi, N_OUTLINE // 2 + 1) for p, a in ends])

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return both ends and the radius."""
        return np.array([self.start, self.end]), self.radius
