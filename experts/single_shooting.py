"""Simple shooting: Newton's method on the initial costate, with the exact Jacobian of the sensitivity equations."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, njit, types

from leapnav.experts.integrator import FLOW, constant, propagate, vector
from leapnav.experts.linear import solve_dense

# Returned by the Newton kernels of this package; `extremal.Status` gives them words.
CONVERGED, STALLED, DIVERGED, SINGULAR, MAX_ITERATIONS = 0, 1, 2, 3, 4
SMALLEST_DAMPING = 1.0 / 64.0


@njit(
    types.Tuple((int64, int64, float64, float64, int64))(
        FLOW, vector, vector, vector, types.Array(boolean, 1, "C"), float64, constant, constant, float64, float64, int64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def shoot(flow, z, goal, z_end, free, duration, data, field, tolerance, accuracy, max_iterations):
    """Damped Newton on the costate in z = (q_0, lam_0), in place; z_end becomes the end of the extremal.

    `goal` holds q_f where `free` is False; where it is True the costate must vanish at the end (transversality).
    Returns (status, iterations, residual, cost, integration steps). Converged means max |residual| <= tolerance.
    """
    n = len(goal)
    S = np.empty((2 * n, n))
    jacobian = np.empty((n, n))
    rhs = np.empty(n)
    start = z.copy()
    best = z.copy()
    best_jacobian = np.empty((n, n))
    best_rhs = np.empty(n)
    best_norm, best_residual, cost, work = np.inf, np.inf, np.inf, 0
    damping = 1.0
    for iteration in range(max_iterations + 1):
        while True:
            trial = start.copy()
            S[:] = 0.0
            for i in range(n):
                S[n + i, i] = 1.0
            trial_cost, _, _, steps = propagate(flow, trial, S, duration, data, field, accuracy, 0.0, False)
            work += abs(steps)
            norm, residual = 0.0, 0.0
            if steps < 0:
                norm = np.inf
            else:
                for i in range(n):
                    row = n + i if free[i] else i
                    rhs[i] = -trial[row] if free[i] else goal[i] - trial[row]
                    norm += rhs[i] ** 2
                    residual = max(residual, abs(rhs[i]))
                    for j in range(n):
                        jacobian[i, j] = S[row, j]
            # Sufficient decrease of the residual norm; the first point has nothing to be compared with.
            if norm <= (1.0 - damping / 2.0) ** 2 * best_norm and norm < np.inf:
                break
            if iteration == 0:
                return DIVERGED, iteration, np.inf, np.inf, work
            damping /= 2.0
            if damping < SMALLEST_DAMPING:
                z[:] = best
                return (CONVERGED if best_residual <= tolerance else STALLED), iteration, best_residual, cost, work
            for i in range(n):
                start[n + i] = best[n + i] + damping * best_rhs[i]
        best[:] = start
        z_end[:] = trial
        best_norm, best_residual, cost = norm, residual, trial_cost
        best_jacobian[:] = jacobian
        best_rhs[:] = rhs
        if residual <= tolerance:
            z[:] = best
            return CONVERGED, iteration, residual, cost, work
        if not solve_dense(best_jacobian, best_rhs):
            z[:] = best
            return SINGULAR, iteration, residual, cost, work
        damping = min(1.0, 2.0 * damping)
        for i in range(n):
            start[n + i] = best[n + i] + damping * best_rhs[i]
    z[:] = best
    return MAX_ITERATIONS, max_iterations, best_residual, cost, work
