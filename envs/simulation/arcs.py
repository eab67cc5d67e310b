"""Circular arcs of a disc among obstacles (kernels): first contact, clearance and proximity cost.

An arc starts at a pose (x, y, heading), has the length `distance` (m; negative: backwards) and turns by `turn` (rad).
"""

from __future__ import annotations

import math

from numba import float64, types

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT
from leapnav.envs.robots.arcs import sinc
from leapnav.envs.shapes.barrier import CONTACT
from leapnav.envs.shapes.clearance import clearance
from leapnav.envs.shapes.field import header_of
from leapnav.envs.shapes.proximity import proximity_values

PANEL_LENGTH, MAX_PANELS = 1.5, 1000  # length (proximity scales) and number of the panels of an integral of Phi
# Near an obstacle, the integrals over both halves of a panel may differ from that over the whole by this relative
# difference; the error of their sum is 1/10 of it or less.
PANEL_TOLERANCE = 1e-4
ROUNDED_UP = 1e-12  # of a sum of widths of panels
CLEARANCE_TOLERANCE = 1e-3  # m, absolute ...
RELATIVE_CLEARANCE_TOLERANCE = 0.02  # ... and relative error of the smallest clearance along an arc
CONTACT_TOLERANCE = 1e-5  # m: an arc is cut at a clearance below this


@kernel(types.UniTuple(float64, 2)(float64, float64, float64, float64, float64, float64))
def arc_point(x, y, heading, distance, turn, fraction):
    """Return (x, y) at a fraction of an arc. The chord from the start to this point has the mean heading."""
    chord = distance * fraction * sinc(turn * fraction / 2)
    middle = heading + turn * fraction / 2
    return x + chord * math.cos(middle), y + chord * math.sin(middle)


@kernel(float64(float64, float64, float64, float64, float64, float64, CONSTANT))
def _clearance_at(x, y, heading, distance, turn, fraction, field):
    x, y = arc_point(x, y, heading, distance, turn, fraction)
    return clearance(x, y, field)[0]


@kernel(types.UniTuple(float64, 3)(float64, float64, float64, float64, float64, float64, CONSTANT))
def follow_arc(x, y, heading, distance, turn, before, field):
    """Find the smallest clearance along an arc, and the first contact.

    Args:
        x, y, heading: start (m, rad).
        distance: length (m; negative: backwards).
        turn: change of the heading (rad).
        before: clearance at the start (m).
        field: the packed field of the scenario.

    Returns:
        The smallest clearance (m), with an error of at most 1 mm or 2 %, whichever is larger; the fraction of the arc
        before the first contact; and the clearance (m) at the end. Without contact the fraction is 1. With contact,
        the smallest clearance is not positive, and the end is at this fraction, with a clearance of 0 to 0.01 mm.

    """
    total = abs(distance)
    if before <= 0.0:
        return before, 0.0, before
    # Along the arc, clearance is Lipschitz continuous with constant 1, so the values c0 and c1 at the arc lengths s0
    # and s1 bound the values between.
    s0, c0 = 0.0, before
    s1, c1 = total, _clearance_at(x, y, heading, distance, turn, 1.0, field)
    c_end = c1
    lowest = min(before, c1)
    while s0 < total and lowest > 0.0:
        if (c0 + c1 - (s1 - s0)) / 2 >= lowest - max(CLEARANCE_TOLERANCE, RELATIVE_CLEARANCE_TOLERANCE * lowest):
            s0, c0 = s1, c1
            s1, c1 = total, c_end
        else:
            s1 = (s0 + s1) / 2
            c1 = _clearance_at(x, y, heading, distance, turn, s1 / total, field)
            lowest = min(lowest, c1)
    if lowest > 0.0:
        return lowest, 1.0, c_end
    # From a free point, the first contact is at least as far away as the clearance. Steps are slightly shorter, so that
    # rounding cannot move the point across an obstacle.
    for _ in range(200):
        step = 0.999 * c0
        following = _clearance_at(x, y, heading, distance, turn, min((s0 + step) / total, 1.0), field)
        if following <= 0.0:
            break
        s0 += step
        c0 = following
        if c0 < CONTACT_TOLERANCE:
            break
    # Where the arc is almost parallel to an outline, these steps converge slowly; bisection finds the rest.
    while c0 >= CONTACT_TOLERANCE and s1 - s0 > 1e-12 * total:
        middle = (s0 + s1) / 2
        following = _clearance_at(x, y, heading, distance, turn, middle / total, field)
        if following <= 0.0:
            s1 = middle
        else:
            s0, c0 = middle, following
    return min(lowest, 0.0), min(s0 / total, 1.0 - 1e-15), c0


@kernel(float64(float64, float64, float64, float64, float64, float64, float64, CONSTANT))
def _panel(x, y, heading, distance, turn, start, width, field):
    """Return the integral of Phi over a panel of an arc, from a fraction `start` to `start` + `width` (Gauss rule)."""
    middle, offset = start + 0.5 * width, 0.5 * math.sqrt(0.6) * width
    xa, ya = arc_point(x, y, heading, distance, turn, middle - offset)
    xb, yb = arc_point(x, y, heading, distance, turn, middle)
    xc, yc = arc_point(x, y, heading, distance, turn, middle + offset)
    first, second, third = proximity_values(xa, ya, xb, yb, xc, yc, header_of(field).radius, field)
    return (5.0 * first + 8.0 * second + 5.0 * third) / 18.0 * width


@kernel(float64(float64, float64, float64, float64, float64, float64, CONSTANT))
def arc_proximity(x, y, heading, distance, turn, lowest, field):
    """Return the mean of Phi along an arc, by three-point Gauss rules over panels of at most PANEL_LENGTH.

    If an obstacle is nearer than the length of a panel, panels are halved until the halves agree with the whole.
    Measured on 1,500 random arcs of 1 to 15 cm that begin 0.1 mm to 0.3 m from an obstacle, the relative error is at
    most 1e-4 (median 1e-6); on arcs that end in a collision it exceeded 1e-4 once in 550 arcs (1e-3).

    Args:
        x, y, heading, distance, turn, field: see `follow_arc`.
        lowest: smallest clearance (m) along the arc.

    """
    length = abs(distance)
    panels = min(max(math.ceil(length / (PANEL_LENGTH * header_of(field).scale)), 1.0), MAX_PANELS)
    largest, total = 1.0 / panels, 0.0
    if lowest >= largest * length:
        for k in range(int(panels)):
            total += _panel(x, y, heading, distance, turn, k * largest, largest, field)
        return total
    shortest = CONTACT * header_of(field).scale / length
    start, width = 0.0, largest
    whole = _panel(x, y, heading, distance, turn, start, width, field)
    while True:
        half = 0.5 * width
        first = _panel(x, y, heading, distance, turn, start, half, field)
        both = first + _panel(x, y, heading, distance, turn, start + half, half, field)
        if abs(both - whole) > PANEL_TOLERANCE * both and width > shortest:
            width, whole = half, first
            continue
        total += both
        start += width
        if start >= 1.0 - ROUNDED_UP:
            return total
        width = min(2.0 * width, largest, 1.0 - start)
        whole = _panel(x, y, heading, distance, turn, start, width, field)
