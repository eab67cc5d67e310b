"""Motion along the heading (kernels): circular arcs, and paths whose speed and turn rate vary in time."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, types

from leapnav.envs.kernels import kernel

# Gauss-Legendre rule with 3 points on [0, 1]: with a change of the heading of at most MAX_PANEL_TURN per panel, the
# error of a position is below 1e-10 of the distance.
GAUSS_NODES, GAUSS_WEIGHTS = (np.ascontiguousarray(values) for values in np.polynomial.legendre.leggauss(3))
GAUSS_NODES, GAUSS_WEIGHTS = 0.5 * (GAUSS_NODES + 1.0), 0.5 * GAUSS_WEIGHTS
MAX_PANEL_TURN = 0.2  # rad


@kernel(float64(float64))
def sinc(angle):
    """Return sin(angle) / angle, continuous at 0."""
    return 1.0 - angle * angle / 6.0 if abs(angle) < 1e-4 else math.sin(angle) / angle


@kernel(types.UniTuple(float64, 2)(float64))
def rotation(angle):
    """Return cos(angle) and sin(angle), for small angles by series with errors below 1e-11."""
    square = angle * angle
    if square > MAX_PANEL_TURN**2:
        return math.cos(angle), math.sin(angle)
    cos = 1.0 - square / 2.0 * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)))
    return cos, angle * (1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0)))


@kernel(types.UniTuple(float64, 3)(float64, float64, float64, float64, float64))
def advance_arc(x, y, heading, distance, turn):
    """Return the pose at the end of a circular arc of a length (m; negative: backwards) and a turn (rad)."""
    chord, middle = distance * sinc(0.5 * turn), heading + 0.5 * turn
    return x + chord * math.cos(middle), y + chord * math.sin(middle), heading + turn


@kernel(types.UniTuple(float64, 2)(float64, float64, float64, float64, float64), forceinline=True)
def until_limit(value, rate, low, high, h):
    """Return the rate of a state, 0 at its limit, and the time, at most h, before it reaches its limit."""
    if (rate > 0.0 and value >= high) or (rate < 0.0 and value <= low):
        return 0.0, h
    return rate, min(((high if rate > 0.0 else low) - value) / rate, h) if rate != 0.0 else h
