"""Multiple shooting: Newton's method on (q, lam) at all nodes, with a banded matrix solved in O(segments)."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, njit, types

from leapnav.experts.integrator import FLOW, constant, matrix, propagate, vector
from leapnav.experts.linear import solve_banded
from leapnav.experts.single_shooting import CONVERGED, DIVERGED, MAX_ITERATIONS, SINGULAR, SMALLEST_DAMPING, STALLED

flags = types.Array(boolean, 1, "C")


@njit(
    types.Tuple((float64, float64, int64))(
        FLOW, vector, matrix, vector, vector, flags, constant, constant, float64, matrix, vector, vector, vector
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _residual(flow, times, Z, start, goal, free, data, field, accuracy, rows, rhs, costs, steps_hint):
    """Fills the Newton system at Z and returns (norm^2, largest residual, work); the norm is infinite if it diverged.

    Row order: n start conditions, 2n continuity conditions per segment, n end conditions; the band's half-width is
    then 3n - 1 with the unknowns in order of time.
    """
    n = len(goal)
    size = 2 * n
    half = 3 * n - 1
    segments = len(times) - 1
    rows[:] = 0.0
    z = np.empty(size)
    S = np.empty((size, size))
    work = 0
    for i in range(n):
        rows[i, half] = 1.0
        rhs[i] = start[i] - Z[0, i]
    for k in range(segments):
        z[:] = Z[k]
        S[:] = 0.0
        for i in range(size):
            S[i, i] = 1.0
        cost, _, hint, steps = propagate(
            flow, z, S, times[k + 1] - times[k], data, field, accuracy, steps_hint[k], False
        )
        if steps < 0:
            return np.inf, np.inf, work
        work += steps
        costs[k] = cost
        steps_hint[k] = hint
        for i in range(size):
            row = n + size * k + i
            rhs[row] = Z[k + 1, i] - z[i]
            for j in range(size):
                rows[row, size * k + j - row + half] = S[i, j]
            rows[row, size * (k + 1) + i - row + half] = -1.0
    for i in range(n):
        row = n + size * segments + i
        column = size * segments + (n + i if free[i] else i)
        rows[row, column - row + half] = 1.0
        rhs[row] = -Z[segments, n + i] if free[i] else goal[i] - Z[segments, i]
    norm, largest = 0.0, 0.0
    for value in rhs:
        norm += value * value
        largest = max(largest, abs(value))
    return norm, largest, work


@njit(
    types.Tuple((int64, int64, float64, int64))(
        FLOW, vector, matrix, vector, vector, flags, constant, constant, float64, float64, int64, vector, matrix
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def newton(flow, times, Z, start, goal, free, data, field, tolerance, accuracy, max_iterations, costs, log):
    """Damped Newton on the nodes Z (segments + 1, 2n), in place; `costs` (segments,) becomes the cost of each segment.

    `log` (max_iterations + 1, 3) receives residual, cost and damping of each iterate. The integrator is as accurate as
    the current residual deserves, and `accuracy` at the end. A residual of ten times the tolerance is accepted where no
    step decreases it (the certificate has the last word). Returns (status, iterations, residual, steps).
    """
    n = len(goal)
    segments = len(times) - 1
    unknowns = 2 * n * (segments + 1)
    half = 3 * n - 1
    rows = np.empty((unknowns, 3 * half + 1))
    rhs = np.empty(unknowns)
    hint = np.zeros(segments)
    trial_hint = np.zeros(segments)
    trial_costs = np.empty(segments)
    trial = Z.copy()
    current = max(accuracy, 1e-7)
    norm, residual, work = _residual(flow, times, Z, start, goal, free, data, field, current, rows, rhs, costs, hint)
    if norm == np.inf:
        return DIVERGED, 0, np.inf, work
    damping = 1.0
    for iteration in range(max_iterations + 1):
        log[iteration, 0] = residual
        log[iteration, 1] = costs.sum()
        log[iteration, 2] = damping
        if residual <= tolerance and current <= accuracy:
            return CONVERGED, iteration, residual, work
        if residual < 1e-3 and current > accuracy:
            current = accuracy
            norm, residual, more = _residual(
                flow, times, Z, start, goal, free, data, field, current, rows, rhs, costs, hint
            )
            work += more
            if residual <= tolerance:
                log[iteration, 0] = residual
                return CONVERGED, iteration, residual, work
        if iteration == max_iterations:
            break
        if not solve_banded(rows, rhs, half):
            return SINGULAR, iteration, residual, work
        step = rhs.copy()
        damping = min(1.0, 2.0 * damping)
        while True:
            for k in range(segments + 1):
                for i in range(2 * n):
                    trial[k, i] = Z[k, i] + damping * step[2 * n * k + i]
            trial_hint[:] = hint
            trial_norm, trial_residual, more = _residual(
                flow, times, trial, start, goal, free, data, field, current, rows, rhs, trial_costs, trial_hint
            )
            work += more
            if trial_norm <= (1.0 - damping / 4.0) ** 2 * norm:
                break
            # At the level of the integration errors no step decreases the residual any more.
            if residual <= 10.0 * tolerance:
                return CONVERGED, iteration, residual, work
            damping /= 2.0
            if damping < SMALLEST_DAMPING:
                return STALLED, iteration, residual, work
        Z[:] = trial
        hint[:] = trial_hint
        costs[:] = trial_costs
        norm, residual = trial_norm, trial_residual
    return MAX_ITERATIONS, max_iterations, residual, work
