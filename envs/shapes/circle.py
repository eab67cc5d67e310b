"""Circles (kernels): the softened distance, and the derivatives of a proximity term."""

from __future__ import annotations

import math

from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import tuple_of

SOFTENING = 1e-6  # m^2, added to the squared distance to make it differentiable at the centre


@kernel(float64(float64, float64))
def smooth_distance(dx, dy):
    """Distance (m) to the centre of a circle, softened."""
    return math.sqrt(dx * dx + dy * dy + SOFTENING)


@kernel(tuple_of(*[float64] * 5)(float64, float64, float64, float64, float64))
def circle_derivatives(dx, dy, smooth, term, steepness):
    """Minus the gradient, and the Hessian (xx, xy, yy), of a proximity term of a circle.

    Args:
        dx, dy: position relative to the centre (m).
        smooth: `smooth_distance` (m).
        term: value of the term.
        steepness: 1 / proximity scale (1/m).

    """
    inverse = 1.0 / smooth
    nx, ny = dx * inverse, dy * inverse
    slope = term * steepness
    curl = slope * inverse
    bend = slope * steepness + curl
    return slope * nx, slope * ny, bend * nx * nx - curl, bend * nx * ny, bend * ny * ny - curl
