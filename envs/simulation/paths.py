"""Paths of any robot during a control period (kernels): first contact, clearance, proximity and state cost.

The path is that of the model's `advance` with held controls. `leapnav.envs.simulation.arcs` is the same for circular
arcs of a disc, for which the distances are known in closed form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING, VECTOR
from leapnav.envs.robots.base import ADVANCE_SIGNATURE, STATE_COST_SIGNATURE
from leapnav.envs.shapes.barrier import CONTACT
from leapnav.envs.shapes.clearance import footprint_clearance
from leapnav.envs.shapes.field import header_of
from leapnav.envs.shapes.proximity import proximity_values
from leapnav.envs.simulation.arcs import (
    CLEARANCE_TOLERANCE,
    CONTACT_TOLERANCE,
    MAX_PANELS,
    PANEL_LENGTH,
    PANEL_TOLERANCE,
    RELATIVE_CLEARANCE_TOLERANCE,
    ROUNDED_UP,
)

ADVANCE_FUNCTION = types.FunctionType(ADVANCE_SIGNATURE)
STATE_COST_FUNCTION = types.FunctionType(STATE_COST_SIGNATURE)
# Fractions of the period at which a path is sampled: the nodes of Gauss's three-point rule, and the end.
NODES = 3
SAMPLED_FRACTIONS = np.array([0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6), 1.0])
# The bound of the speed exceeds the largest mean speed between two samples by these fractions of itself, for the
# curvature of the path, and of the spread of the mean speeds, for accelerations.
CURVATURE_MARGIN, ACCELERATION_MARGIN = 0.01, 0.25


class RobotMotion(NamedTuple):
    """The kernels of a robot's model.

    Attributes:
        advance: see `leapnav.envs.robots.base.ADVANCE_SIGNATURE`.
        state_cost: see `leapnav.envs.robots.base.STATE_COST_SIGNATURE`.

    """

    advance: FunctionPointer
    state_cost: FunctionPointer


MOTION = record_type(RobotMotion, advance=ADVANCE_FUNCTION, state_cost=STATE_COST_FUNCTION)


class HeldPath(NamedTuple):
    """The path of a robot with held controls.

    Attributes:
        motion: kernels of the robot's model.
        q (n,): state at the start.
        u (m,): held controls.
        parameters: parameters of the model.
        discs (D, 2): footprint.

    """

    motion: RobotMotion
    q: np.ndarray
    u: np.ndarray
    parameters: np.ndarray
    discs: np.ndarray


HELD_PATH = record_type(HeldPath, motion=MOTION, q=VECTOR, u=VECTOR, parameters=VECTOR, discs=MATRIX)


@kernel(STATE_COST_SIGNATURE)
def no_state_cost(q, parameters):
    """Return the state cost of a robot without one."""
    return 0.0


@kernel(NOTHING(HELD_PATH, float64, VECTOR))
def state_after(path, duration, new):
    """Overwrite new (n,) by the state of the path after a duration (s)."""
    path.motion.advance(path.q, path.u, duration, path.parameters, new)


@kernel(float64(HELD_PATH, float64, MATRIX))
def sample_path(path, duration, samples):
    """Fill the states (4, n) at the sampled fractions; return a bound of the distance (m) that a disc travels."""
    q, discs, arm = path.q, path.discs, 0.0
    for k in range(len(discs)):
        arm = max(arm, abs(discs[k, 0]))
    x, y, heading, before, smallest, largest = q[0], q[1], q[2], 0.0, np.inf, 0.0
    for k in range(len(SAMPLED_FRACTIONS)):
        fraction, new = SAMPLED_FRACTIONS[k], samples[k]
        state_after(path, duration * fraction, new)
        travelled = math.sqrt((new[0] - x) ** 2 + (new[1] - y) ** 2) + arm * abs(new[2] - heading)
        mean = travelled / (fraction - before)
        smallest, largest = min(smallest, mean), max(largest, mean)
        x, y, heading, before = new[0], new[1], new[2], fraction
    return (1.0 + CURVATURE_MARGIN) * largest + ACCELERATION_MARGIN * (largest - smallest)


@kernel(types.UniTuple(float64, 3)(HELD_PATH, float64, CONSTANT, float64, float64, VECTOR))
def follow_path(path, duration, field, before, total, new):
    """Find the smallest clearance along a path, and the first contact.

    Args:
        path: the robot's path.
        duration: duration of the period (s), positive.
        field: packed obstacle field.
        before: clearance (m) at the start.
        total: bound of the distance (m) that a disc of the footprint travels.
        new: the state at the end of the period; overwritten by that at the end of the path.

    Returns:
        The smallest clearance (m), the fraction of the period before the first contact, and the clearance (m) at the
        end, with the errors of `leapnav.envs.simulation.arcs.follow_arc`.

    """
    discs = path.discs
    if before <= 0.0:
        for i in range(len(new)):
            new[i] = path.q[i]
        return before, 0.0, before
    # Clearance is Lipschitz continuous with constant 1 in the distance travelled, which is at most `total`.
    s0, c0 = 0.0, before
    s1, c1 = total, footprint_clearance(new[0], new[1], new[2], discs, field)[0]
    c_end, is_end = c1, True
    lowest = min(before, c1)
    while s0 < total and lowest > 0.0:
        if (c0 + c1 - (s1 - s0)) / 2 >= lowest - max(CLEARANCE_TOLERANCE, RELATIVE_CLEARANCE_TOLERANCE * lowest):
            s0, c0 = s1, c1
            s1, c1 = total, c_end
        else:
            s1 = (s0 + s1) / 2
            is_end = False
            state_after(path, duration * s1 / total, new)
            c1 = footprint_clearance(new[0], new[1], new[2], discs, field)[0]
            lowest = min(lowest, c1)
    if lowest > 0.0:
        if not is_end:
            state_after(path, duration, new)
        return lowest, 1.0, c_end
    # As for arcs: steps of at most the clearance, then bisection.
    for _ in range(200):
        s = min(s0 + 0.999 * c0, total)
        state_after(path, duration * s / total, new)
        following = footprint_clearance(new[0], new[1], new[2], discs, field)[0]
        if following <= 0.0:
            break
        s0, c0 = s, following
        if c0 < CONTACT_TOLERANCE or s0 >= total:
            break
    while c0 >= CONTACT_TOLERANCE and s1 - s0 > 1e-12 * total:
        middle = (s0 + s1) / 2
        state_after(path, duration * middle / total, new)
        following = footprint_clearance(new[0], new[1], new[2], discs, field)[0]
        if following <= 0.0:
            s1 = middle
        else:
            s0, c0 = middle, following
    fraction = min(s0 / total, 1.0 - 1e-15)
    state_after(path, duration * fraction, new)
    return min(lowest, 0.0), fraction, c0


@kernel(types.UniTuple(float64, 2)(HELD_PATH, float64, float64, float64, CONSTANT, MATRIX, MATRIX))
def _panel_costs(path, duration, start, width, field, samples, poses):
    """Return the integrals of the proximity cost and of the state cost over a panel of a path (Gauss rule).

    The panel is from a fraction `start` to `start` + `width`. `samples` and `poses` are overwritten; for the panel of
    width 1, `samples` are the states at its nodes.
    """
    discs, proximity, state_cost = path.discs, 0.0, 0.0
    has_arms = len(discs) > 1 or discs[0, 0] != 0.0
    for k in range(NODES):
        state = samples[k]
        if width < 1.0:
            state_after(path, duration * (start + SAMPLED_FRACTIONS[k] * width), state)
        state_cost += (8.0 if k == 1 else 5.0) * path.motion.state_cost(state, path.parameters)
        poses[k, 0], poses[k, 1] = state[0], state[1]
        if has_arms:
            poses[k, 2], poses[k, 3] = math.cos(state[2]), math.sin(state[2])
    for d in range(len(discs)):
        a, radius = discs[d, 0], discs[d, 1]
        if radius <= 0.0:
            continue
        first, second, third = proximity_values(
            poses[0, 0] + a * poses[0, 2],
            poses[0, 1] + a * poses[0, 3],
            poses[1, 0] + a * poses[1, 2],
            poses[1, 1] + a * poses[1, 3],
            poses[2, 0] + a * poses[2, 2],
            poses[2, 1] + a * poses[2, 3],
            radius,
            field,
        )
        proximity += 5.0 * first + 8.0 * second + 5.0 * third
    return proximity / 18.0 * width, state_cost / 18.0 * width


@kernel(types.UniTuple(float64, 2)(HELD_PATH, float64, CONSTANT, float64, float64, MATRIX, MATRIX))
def path_costs(path, duration, field, total, lowest, samples, poses):
    """Return the means of the proximity cost and of the state cost over a path, with the panels of `arc_proximity`.

    Args:
        path, duration, field, total: see `follow_path`.
        lowest: smallest clearance (m) along the path.
        samples (4, n): from `sample_path`; overwritten.
        poses (3, 4): overwritten.

    """
    panels = min(max(math.ceil(total / (PANEL_LENGTH * header_of(field).scale)), 1.0), MAX_PANELS)
    largest, proximity, state_cost = 1.0 / panels, 0.0, 0.0
    poses[:, 2:] = 0.0
    if lowest >= largest * total:
        for k in range(int(panels)):
            phi, cost = _panel_costs(path, duration, k * largest, largest, field, samples, poses)
            proximity, state_cost = proximity + phi, state_cost + cost
        return proximity, state_cost
    shortest = CONTACT * header_of(field).scale / total
    start, width = 0.0, largest
    whole, _ = _panel_costs(path, duration, start, width, field, samples, poses)
    while True:
        half = 0.5 * width
        first, cost = _panel_costs(path, duration, start, half, field, samples, poses)
        second, further = _panel_costs(path, duration, start + half, half, field, samples, poses)
        both = first + second
        if abs(both - whole) > PANEL_TOLERANCE * both and width > shortest:
            width, whole = half, first
            continue
        proximity, state_cost = proximity + both, state_cost + cost + further
        start += width
        if start >= 1.0 - ROUNDED_UP:
            return proximity, state_cost
        width = min(2.0 * width, largest, 1.0 - start)
        whole, _ = _panel_costs(path, duration, start, width, field, samples, poses)
