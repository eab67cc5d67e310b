"""The path of a robot during a control period (kernels): first contact, clearance, proximity and state cost.

The path is that of the model's `advance` with held controls. The kernels are inlined: calls would pass all arrays of a
`Path` by value, and a step of 1,024 unicycles would take 1.4 of the time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, int64, types

from leapnav.envs.field.barrier import CONTACT
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.layout import header_of
from leapnav.envs.field.proximity import footprint_value, proximity_values
from leapnav.envs.field.rectangle import row_axis
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import FunctionPointer, function_at
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING, VECTOR
from leapnav.envs.robots.base import ADVANCE_SIGNATURE, STATE_COST_SIGNATURE

ADVANCE_FUNCTION = types.FunctionType(ADVANCE_SIGNATURE)
STATE_COST_FUNCTION = types.FunctionType(STATE_COST_SIGNATURE)
NODES = 0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6)  # of Gauss's rule with three points on [0, 1]
NODE_WEIGHTS = 5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0
# The largest speed along a path is that at its start or its end, measured over this fraction of the path ...
SHORT = 1e-3
# ... and, for a maximum between them, this fraction of the difference of both is added.
SPEED_MARGIN = 0.25
PANEL_LENGTH, MAX_PANELS = 1.5, 1000  # length (proximity scales) and number of the panels of an integral of Phi
# Near an obstacle, the integrals over both halves of a panel may differ from that over the whole by this relative
# difference; the error of their sum is 1/10 of it or less.
PANEL_TOLERANCE = 1e-4
ROUNDED_UP = 1e-12  # of a sum of widths of panels
CLEARANCE_TOLERANCE = 1e-3  # m, absolute ...
RELATIVE_CLEARANCE_TOLERANCE = 0.02  # ... and relative error of the smallest clearance along a path
CONTACT_TOLERANCE = 1e-5  # m: a path is cut at a clearance below this


class RobotMotion(NamedTuple):
    """The kernels of a robot's model.

    Attributes:
        advance: see `leapnav.envs.robots.base.ADVANCE_SIGNATURE`.
        state_cost: see `leapnav.envs.robots.base.STATE_COST_SIGNATURE`.

    """

    advance: FunctionPointer
    state_cost: FunctionPointer


MOTION = record_type(RobotMotion, advance=ADVANCE_FUNCTION, state_cost=STATE_COST_FUNCTION)
ADDRESSES = types.UniTuple(int64, 2)  # of both kernels: Numba takes 4 us to receive a function from Python


@kernel(MOTION(ADDRESSES), forceinline=True)
def motion_at(addresses):
    """Return the motion with the kernels at two addresses."""
    return RobotMotion(function_at(addresses[0], ADVANCE_FUNCTION), function_at(addresses[1], STATE_COST_FUNCTION))


class Path(NamedTuple):
    """The path of a robot with held controls.

    Attributes:
        motion: kernels of the robot's model.
        q (n + 1,): state at the start, and its time (s) in the episode.
        u (m,): held controls.
        parameters: parameters of the model.
        outline (K, 5): footprint, see `leapnav.envs.robots.footprints.outline_of`.
        field: packed obstacle field.
        duration: s.
        samples (5 or more, n + 1): working memory: the states at the nodes of a panel, and two other states, with
            their times. Further rows are not used.

    """

    motion: RobotMotion
    q: np.ndarray
    u: np.ndarray
    parameters: np.ndarray
    outline: np.ndarray
    field: np.ndarray
    duration: float
    samples: np.ndarray


PATH = record_type(
    Path,
    motion=MOTION,
    q=VECTOR,
    u=VECTOR,
    parameters=VECTOR,
    outline=MATRIX,
    field=CONSTANT,
    duration=float64,
    samples=MATRIX,
)


@kernel(STATE_COST_SIGNATURE)
def no_state_cost(q, parameters):
    """Return the state cost of a robot without one."""
    return 0.0


@kernel(ADVANCE_SIGNATURE)
def coast(q, u, h, parameters, new):
    """Write the pose after a time with a constant velocity u = (vx, vy, spin)."""
    new[0], new[1], new[2] = q[0] + u[0] * h, q[1] + u[1] * h, q[2] + u[2] * h


@kernel(NOTHING(PATH, float64, VECTOR), forceinline=True)
def state_after(path, fraction, new):
    """Write the state at a fraction of the path, and its time, to new (n + 1,)."""
    path.motion.advance(path.q, path.u, path.duration * fraction, path.parameters, new)
    last = len(new) - 1
    new[last] = path.q[last] + path.duration * fraction


@kernel(float64(PATH, VECTOR), forceinline=True)
def clearance_at(path, q):
    """Return the clearance (m) at a state of the path."""
    return footprint_clearance(q, path.outline, path.field)[0]


@kernel(float64(PATH, VECTOR), forceinline=True)
def _speed_after(path, q):
    """Return the largest speed (m/s) of the robot's position and of its outline at a state of the path."""
    new, time = path.samples[4], SHORT * path.duration
    path.motion.advance(q, path.u, time, path.parameters, new)
    speed = math.sqrt((new[0] - q[0]) ** 2 + (new[1] - q[1]) ** 2) / time
    sweep = 0.0  # largest distance (m) by which a rotation moves a disc or a corner
    for k in range(len(path.outline)):
        reach, joint = max(abs(path.outline[k, 0]), abs(path.outline[k, 1])), path.outline[k, 4]
        if path.outline[k, 2] > 0.0:  # the corners of a rectangle
            reach = math.hypot(reach, path.outline[k, 2])
        sweep = max(sweep, reach * abs(row_axis(new, joint) - row_axis(q, joint)))
    return speed + sweep / time


@kernel(float64(PATH, VECTOR), forceinline=True)
def largest_distance(path, end):
    """Return a bound of the distance (m) that a disc or corner of the robot travels along the path to a state.

    That of the obstacles is added.
    """
    first, last = _speed_after(path, path.q), _speed_after(path, end)
    robot = max(first, last) + SPEED_MARGIN * abs(first - last)
    return path.duration * (robot + header_of(path.field).top_speed)


@kernel(types.UniTuple(float64, 3)(PATH, float64, float64, VECTOR), forceinline=True)
def first_contact(path, before, total, new):
    """Find the smallest clearance along a path, and the first contact.

    Args:
        path: the path, of a positive duration.
        before: clearance (m) at the start.
        total: see `largest_distance`.
        new: the state at the end of the period; overwritten by that at the end of the path.

    Returns:
        The smallest clearance (m), with an error of at most 1 mm or 2 %, whichever is larger; the fraction of the
        duration before the first contact; and the clearance (m) at the end. Without contact the fraction is 1. With
        contact, the smallest clearance is not positive, and the end is at this fraction, with a clearance of 0 to
        0.01 mm.

    """
    if before <= 0.0:
        for i in range(len(new)):
            new[i] = path.q[i]
        return before, 0.0, before
    # Along the path, clearance is Lipschitz continuous with constant 1 in the distance, so the values c0 and c1 at the
    # distances s0 and s1 bound the values between.
    state = path.samples[3]
    s0, c0 = 0.0, before
    s1, c1 = total, clearance_at(path, new)
    c_end = c1
    lowest = min(before, c1)
    while s0 < total and lowest > 0.0:
        if (c0 + c1 - (s1 - s0)) / 2 >= lowest - max(CLEARANCE_TOLERANCE, RELATIVE_CLEARANCE_TOLERANCE * lowest):
            s0, c0 = s1, c1
            s1, c1 = total, c_end
        else:
            s1 = (s0 + s1) / 2
            state_after(path, s1 / total, state)
            c1 = clearance_at(path, state)
            lowest = min(lowest, c1)
    if lowest > 0.0:
        return lowest, 1.0, c_end
    # From a free point, the first contact is at least as far away as the clearance. Steps are slightly shorter, so that
    # rounding cannot move the point across an obstacle.
    for _ in range(200):
        s = min(s0 + 0.999 * c0, total)
        state_after(path, s / total, state)
        following = clearance_at(path, state)
        if following <= 0.0:
            break
        s0, c0 = s, following
        if c0 < CONTACT_TOLERANCE or s0 >= total:
            break
    # Where the path is almost parallel to an outline, these steps converge slowly; bisection finds the rest.
    while c0 >= CONTACT_TOLERANCE and s1 - s0 > 1e-12 * total:
        middle = (s0 + s1) / 2
        state_after(path, middle / total, state)
        following = clearance_at(path, state)
        if following <= 0.0:
            s1 = middle
        else:
            s0, c0 = middle, following
    fraction = min(s0 / total, 1.0 - 1e-15)
    state_after(path, fraction, new)
    return min(lowest, 0.0), fraction, c0


@kernel(types.boolean(MATRIX), forceinline=True)
def _has_rectangle(outline):
    """Return whether a row of an outline is a rectangle."""
    found = False
    for k in range(len(outline)):
        found = found or outline[k, 1] > outline[k, 0]
    return found


@kernel(types.UniTuple(float64, 2)(PATH, float64, float64), forceinline=True)
def _panel_costs(path, start, width):
    """Return the integrals of the proximity cost and of the state cost over a panel of a path (Gauss's rule).

    The panel is from a fraction `start` to `start` + `width`.
    """
    samples, outline, proximity, state_cost = path.samples, path.outline, 0.0, 0.0
    for k in range(3):
        state_after(path, start + NODES[k] * width, samples[k])
        state_cost += NODE_WEIGHTS[k] * path.motion.state_cost(samples[k], path.parameters)
    first, second, third = samples[0], samples[1], samples[2]
    if _has_rectangle(outline) or header_of(path.field).moving > 0:
        for k in range(3):
            proximity += NODE_WEIGHTS[k] * footprint_value(samples[k], outline, path.field)
        return proximity * width, state_cost * width
    for d in range(len(outline)):
        a, radius = outline[d, 0], outline[d, 3]
        if radius <= 0.0:
            continue
        x0, y0, x1, y1, x2, y2 = first[0], first[1], second[0], second[1], third[0], third[1]
        if a != 0.0:
            joint = outline[d, 4]
            h0, h1, h2 = row_axis(first, joint), row_axis(second, joint), row_axis(third, joint)
            x0, y0 = x0 + a * math.cos(h0), y0 + a * math.sin(h0)
            x1, y1 = x1 + a * math.cos(h1), y1 + a * math.sin(h1)
            x2, y2 = x2 + a * math.cos(h2), y2 + a * math.sin(h2)
        three = proximity_values(x0, y0, x1, y1, x2, y2, radius, path.field)
        proximity += NODE_WEIGHTS[0] * three[0] + NODE_WEIGHTS[1] * three[1] + NODE_WEIGHTS[2] * three[2]
    return proximity * width, state_cost * width


@kernel(types.UniTuple(float64, 2)(PATH, float64, float64), forceinline=True)
def path_costs(path, total, lowest):
    """Return the means of the proximity cost and of the state cost over a path.

    They are computed by three-point Gauss rules over panels of at most PANEL_LENGTH. If an obstacle is nearer than the
    length of a panel, panels are halved until the halves agree with the whole. Measured on 1,500 random arcs of 1 to 15
    cm that begin 0.1 mm to 0.3 m from an obstacle, the relative error is at most 1e-4 (median 1e-6); on arcs that end
    in a collision it exceeded 1e-4 once in 550 arcs (1e-3).

    Args:
        path: the path.
        total: see `largest_distance`.
        lowest: smallest clearance (m) along the path.

    """
    scale = header_of(path.field).scale
    panels = min(max(math.ceil(total / (PANEL_LENGTH * scale)), 1.0), MAX_PANELS)
    largest, proximity, state_cost = 1.0 / panels, 0.0, 0.0
    is_near, shortest = lowest < largest * total, CONTACT * scale / max(total, CONTACT * scale)
    start, width = 0.0, largest
    while start < 1.0 - ROUNDED_UP:
        whole, cost = _panel_costs(path, start, width)
        while is_near:
            half = 0.5 * width
            first, cost = _panel_costs(path, start, half)
            second, further = _panel_costs(path, start + half, half)
            change = abs(first + second - whole)
            if change <= PANEL_TOLERANCE * (first + second) or width <= shortest:
                whole, cost = first + second, cost + further
                break
            width, whole = half, first
        proximity, state_cost, start = proximity + whole, state_cost + cost, start + width
        width = min(2.0 * width, largest, 1.0 - start)
    return proximity, state_cost


@kernel(types.UniTuple(float64, 5)(PATH, float64, VECTOR), forceinline=True)
def drive_path(path, before, new):
    """Follow a path up to the first contact.

    Args:
        path: the path, of a positive duration.
        before: clearance (m) at the start.
        new (n + 1,): overwritten by the state at the end and its time.

    Returns:
        See `first_contact`; then the integrals of the proximity cost and of the state cost.

    """
    state_after(path, 1.0, new)
    total = largest_distance(path, new)
    lowest, fraction, after = first_contact(path, before, total, new)
    if fraction == 0.0:
        return lowest, fraction, after, 0.0, 0.0
    driven = path.duration * fraction
    part = Path(path.motion, path.q, path.u, path.parameters, path.outline, path.field, driven, path.samples)
    proximity, state_cost = path_costs(part, total * fraction, lowest)
    return lowest, fraction, after, proximity * driven, state_cost * driven
