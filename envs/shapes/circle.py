"""Circles.

A packed field contains circles as x, y and r, and the loops over them are written out where speed matters; these use
`softened_distance` and `circle_derivatives`.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import tuple_of
from leapnav.envs.shapes.base import DISTANCE_SIGNATURE, SMOOTH_DISTANCE_SIGNATURE, Shape, register
from leapnav.envs.utils.records import Point, Positive

N_OUTLINE = 64  # points on the outline
SOFTENING = 1e-6  # m^2, added to the squared distance to make it differentiable at the centre


@kernel(float64(float64, float64))
def softened_distance(dx, dy):
    """Distance (m) to the centre of a circle, softened."""
    return math.sqrt(dx * dx + dy * dy + SOFTENING)


@kernel(tuple_of(*[float64] * 5)(float64, float64, float64, float64, float64))
def circle_derivatives(dx, dy, smooth, term, steepness):
    """Minus the gradient, and the Hessian (xx, xy, yy), of a proximity term of a circle.

    Args:
        dx, dy: position relative to the centre (m).
        smooth: `softened_distance` (m).
        term: value of the term.
        steepness: 1 / proximity scale (1/m).

    """
    inverse = 1.0 / smooth
    nx, ny = dx * inverse, dy * inverse
    slope = term * steepness
    curl = slope * inverse
    bend = slope * steepness + curl
    return slope * nx, slope * ny, bend * nx * nx - curl, bend * nx * ny, bend * ny * ny - curl


@kernel(DISTANCE_SIGNATURE)
def distance(x, y, values):
    """Distance (m), negative inside; `values` are the centre and the radius."""
    return math.hypot(x - values[0], y - values[1]) - values[2]


@kernel(SMOOTH_DISTANCE_SIGNATURE)
def smooth_distance(x, y, scale, values):
    """Distance (m), differentiable at the centre, with derivatives."""
    dx, dy = x - values[0], y - values[1]
    smooth = softened_distance(dx, dy)
    nx, ny = dx / smooth, dy / smooth
    return smooth - values[2], nx, ny, (1.0 - nx * nx) / smooth, -nx * ny / smooth, (1.0 - ny * ny) / smooth


@register
class Circle(Shape):
    """A disc obstacle: center (x, y) and radius (m)."""

    kind: ClassVar = "circle"
    distance: ClassVar = distance
    smooth_distance: ClassVar = smooth_distance
    is_lipschitz: ClassVar[bool] = True

    center: Point
    radius: Positive

    def values(self) -> tuple[float, ...]:
        """Return x, y and radius."""
        return (*self.center, self.radius)

    def outline(self) -> np.ndarray:
        """Return points on the circle, counter-clockwise (N_OUTLINE, 2)."""
        return arc(self.center, self.radius, 0.0, 2 * math.pi, N_OUTLINE + 1)[:-1]

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return the centre and the radius."""
        return np.array([self.center]), self.radius


def arc(center: Point, radius: float, first: float, last: float, count: int) -> np.ndarray:
    """Return `count` points (count, 2) on an arc of a circle between two angles (rad)."""
    angles = np.linspace(first, last, count)
    return np.array(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
