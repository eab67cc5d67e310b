"""Circular arcs among obstacles, as compiled kernels: where they touch, how near they come, what they cost.

An arc starts at a pose (x, y, heading), is `distance` metres long (negative: backwards) and turns by `turn` radians.
"""

from __future__ import annotations

import math

from numba import float64, types

from leapnav.envs.compiling import njit
from leapnav.envs.obstacles import clearance, proximity_values, sinc

PANEL = 1.5  # proximity scales that one Gauss rule spans
MOST_PANELS = 1000
_field = types.Array(types.float64, 1, "C", readonly=True)
_options = {"cache": True, "error_model": "numpy", "nogil": True}


@njit(types.UniTuple(float64, 2)(float64, float64, float64, float64, float64, float64), **_options)
def arc_point(x, y, heading, distance, turn, share):
    """(x, y) at a share of a circular arc: the end of a chord at the mean heading."""
    chord = distance * share * sinc(turn * share / 2)
    middle = heading + turn * share / 2
    return x + chord * math.cos(middle), y + chord * math.sin(middle)


@njit(float64(float64, float64, float64, float64, float64, float64, _field), **_options)
def _clearance_at(x, y, heading, distance, turn, share, field):
    x, y = arc_point(x, y, heading, distance, turn, share)
    return clearance(x, y, field)[0]


@njit(types.UniTuple(float64, 3)(float64, float64, float64, float64, float64, float64, _field), **_options)
def follow_arc(x, y, heading, distance, turn, before, field):
    """Walks along a circular arc: (smallest clearance in m, share until the first touch, clearance at the end).

    The arc starts at a pose whose clearance is `before`, is `distance` metres long (negative: backwards) and turns by
    `turn` radians. Its smallest clearance is exact to a millimetre, or to 2 % where that is more. A share below 1 means
    a touch: the walk ends there, at a clearance of 0 to 0.01 mm, and the smallest clearance is then not positive.
    """
    total = abs(distance)
    if before <= 0.0:
        return before, 0.0, before
    # Clearance changes by no more than the way driven, so two ends bound all between them.
    at, here = 0.0, before
    end, there = total, _clearance_at(x, y, heading, distance, turn, 1.0, field)
    last = there
    lowest = min(before, there)
    while at < total and lowest > 0.0:
        if (here + there - (end - at)) / 2 >= lowest - max(1e-3, 0.02 * lowest):
            at, here = end, there
            end, there = total, last
        else:
            end = (at + end) / 2
            there = _clearance_at(x, y, heading, distance, turn, end / total, field)
            lowest = min(lowest, there)
    if lowest > 0.0:
        return lowest, 1.0, last
    # From a free point, the way to the first touch is at least the clearance; all of it could end on the other side.
    for _ in range(200):
        step = 0.999 * here
        following = _clearance_at(x, y, heading, distance, turn, min((at + step) / total, 1.0), field)
        if following <= 0.0:
            break
        at += step
        here = following
        if here < 1e-5:
            break
    # Where the arc nearly follows an outline, that way is long, but what is left of it is short.
    while here >= 1e-5 and end - at > 1e-12 * total:
        middle = (at + end) / 2
        following = _clearance_at(x, y, heading, distance, turn, middle / total, field)
        if following <= 0.0:
            end = middle
        else:
            at, here = middle, following
    return min(lowest, 0.0), min(at / total, 1.0 - 1e-15), here


@njit(float64(float64, float64, float64, float64, float64, _field), **_options)
def arc_proximity(x, y, heading, distance, turn, field):
    """Mean of Phi along an arc, by three-point Gauss rules, each over a way as short as the proximity scale asks."""
    panels = min(max(math.ceil(abs(distance) / (PANEL * field[1])), 1.0), MOST_PANELS)
    width = 1.0 / panels
    offset = 0.5 * math.sqrt(0.6) * width
    total = 0.0
    for panel in range(int(panels)):
        middle = (panel + 0.5) * width
        xa, ya = arc_point(x, y, heading, distance, turn, middle - offset)
        xb, yb = arc_point(x, y, heading, distance, turn, middle)
        xc, yc = arc_point(x, y, heading, distance, turn, middle + offset)
        first, second, third = proximity_values(xa, ya, xb, yb, xc, yc, field)
        total += 5.0 * first + 8.0 * second + 5.0 * third
    return total / 18.0 * width
