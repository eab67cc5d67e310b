"""Evaluation of a stored extremal, and Newton's method from its remaining nodes (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64, void

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import MATRIX, VECTOR, tuple_of
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, END_CONDITION, FLOW, NewtonOptions
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.solvers.newton import CONVERGED, solve_nodes

FLOW_ACCURACY = 1e-8  # error tolerance of the integration between nodes
MIN_SEGMENT = 0.02  # s; a shorter first segment is merged with the next one
MAX_ITERATIONS = 8  # Newton steps; a state that needs more is usually closer to another solution


@kernel(int64(VECTOR, float64))
def segment_of(times, time):
    """The segment that contains a time."""
    return min(max(np.searchsorted(times, time, side="right") - 1, 0), len(times) - 2)


@kernel(void(FLOW, VECTOR, float64))
def continue_flow(flow, z, duration):
    """Integrate (q, lambda) in place for a duration (s) if it is positive; NaN if the flow diverges."""
    if duration > 0.0:
        success, _, _, _, _ = propagate(flow, z, np.empty((len(z), 0)), duration, FLOW_ACCURACY, 0.0, False)
        if not success:
            z[:] = np.nan


@kernel(VECTOR(FLOW, VECTOR, MATRIX, float64))
def follow(flow, times, nodes, time):
    """Integrate (q, lambda) to a time from the preceding node; NaN if the flow diverges."""
    k = segment_of(times, time)
    z = nodes[k].copy()
    continue_flow(flow, z, min(time, times[-1]) - times[k])
    return z


@kernel(MATRIX(FLOW, VECTOR, MATRIX, VECTOR))
def follow_all(flow, times, nodes, moments):
    """Integrate the states (K, n) to increasing times (K,); NaN where the flow diverges."""
    states = np.empty((len(moments), nodes.shape[1] // 2))
    last, now, z = -1, 0.0, nodes[0].copy()
    for row in range(len(moments)):
        k = segment_of(times, moments[row])
        if k != last:
            last, now = k, times[k]
            z[:] = nodes[k]
        end = min(moments[row], times[-1])
        continue_flow(flow, z, end - now)
        now = max(now, end)
        for i in range(states.shape[1]):
            states[row, i] = z[i]
    return states


@kernel(VECTOR(FLOW, CONTROL_FUNCTION, VECTOR, MATRIX, float64, int64))
def control_at(flow, control, times, nodes, time, m):
    """The optimal control (m,) at a time; NaN if the flow diverges."""
    z, u = follow(flow, times, nodes, time), np.empty(m)
    control(z, flow.data, u)
    if math.isnan(z[0]):  # limits of a control would replace NaN by a number
        u[:] = np.nan
    return u


@kernel(tuple_of(int64, VECTOR, MATRIX, VECTOR, MATRIX)(FLOW, VECTOR, MATRIX, VECTOR, float64, END_CONDITION, float64))
def advance(flow, times, nodes, state, time, end, tolerance):
    """Re-solve from a state at a time by Newton's method, with the remaining nodes as the initial guess.

    Returns (status, times, nodes, costs of the segments, initial nodes).
    """
    n = len(end.goal)
    k = min(max(np.searchsorted(times, time + 1e-9, side="right") - 1, 0), len(times) - 2)
    expected = follow(flow, times, nodes, time) if time > times[k] else nodes[k].copy()
    kept = k + 1
    if times[kept] - time < MIN_SEGMENT and kept < len(times) - 1:
        kept += 1
    count = 1 + len(times) - kept
    new_times, new_nodes, remaining = np.empty(count), np.empty((count, 2 * n)), np.empty(count)
    before = np.empty((count, 2 * n))
    for row in range(count):
        new_times[row] = time if row == 0 else times[kept + row - 1]
        remaining[row] = new_times[row] - time
        for i in range(2 * n):
            before[row, i] = expected[i] if row == 0 else nodes[kept + row - 1, i]
            new_nodes[row, i] = state[i] if row == 0 and i < n else before[row, i]
    costs, log = np.empty(count - 1), np.empty((MAX_ITERATIONS + 1, 3))
    options = NewtonOptions(tolerance, 0.1 * tolerance, MAX_ITERATIONS, True)
    code, _, _, _ = solve_nodes(flow, remaining, new_nodes, state, end, options, costs, log)
    if end.free_time and code == CONVERGED:  # the times left have been solved for, too
        for row in range(count):
            new_times[row] = time + remaining[row]
    return code, new_times, new_nodes, costs, before
