"""Damped Newton's method of multiple shooting (kernels). Single shooting has one segment.

It integrates only as accurately as the current residual requires, and may skip the evaluation of the last iterate,
whose residual is predicted from quadratic convergence.

A free final time is another unknown, with the equation that the Hamiltonian at the start is zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import END_CONDITION, FLOW, NEWTON_OPTIONS
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.linear import solve_banded
from leapnav.experts.numerics.shooting import NewtonSystem, linearise, set_identity

# Exit codes of the Newton kernels.
CONVERGED, STALLED, DIVERGED, SINGULAR, MAX_ITERATIONS = 0, 1, 2, 3, 4

MIN_DAMPING = 1.0 / 64.0
MIN_STEP_FACTOR = 0.25  # a step may not reduce a free final time to less than this fraction
COARSE_ACCURACY = 1e-4  # tolerance of the integrator far from the solution
MARGIN = 0.1  # the tolerance in the options is this fraction of the residual that the caller accepts
# A predicted residual must be below this fraction of the tolerance, assuming at least this constant of quadratic
# convergence: a single step that happens to converge fast is weak evidence.
PREDICTION_SAFETY, MIN_QUADRATIC_CONSTANT = 0.1, 100.0
# Tolerance of the integrator for the next iterate, relative to the cube of the residual. With 1e-4 times the square,
# 0.96 times as many evaluations, but where a solution is not isolated, its residual may stay too large.
CUBIC_ACCURACY = 0.01


@kernel(float64(float64, float64, float64))
def predicted_residual(residual, previous, damping):
    """Return the residual after the next full step by quadratic convergence, infinite if that cannot be assumed."""
    if damping < 1.0 or previous == 0.0:
        return np.inf
    return max(residual / previous**2, MIN_QUADRATIC_CONSTANT) * residual**2


@kernel(float64(float64, float64, int64))
def accuracy_slack(current, required, count):
    """Return how much the residual norm of `count` equations may rise when the integrator becomes more accurate."""
    return 100.0 * current * math.sqrt(count) if required < current < np.inf else 0.0


@kernel(boolean(float64, float64, float64, float64))
def is_sufficient_decrease(norm_squared, previous_squared, reduction, slack):
    """Return whether the residual norm has decreased by the fraction `reduction`, up to `slack`."""
    return norm_squared < np.inf and math.sqrt(norm_squared) <= (1.0 - reduction) * math.sqrt(previous_squared) + slack


@kernel(float64(float64, float64, float64))
def time_damping(step, duration, damping):
    """Return the damping that limits the reduction of a free final time by a step."""
    return damping if step >= 0.0 else min(damping, (1.0 - MIN_STEP_FACTOR) * duration / -step)


@kernel(NOTHING(MATRIX, MATRIX, VECTOR, float64))
def _move(Z, moved, step, damping):
    """Compute moved = Z + damping * step; the step may have further entries for each node."""
    size, stride = Z.shape[1], len(step) // len(Z)
    for k in range(len(Z)):
        for i in range(size):
            moved[k, i] = Z[k, i] + damping * step[stride * k + i]


@kernel(boolean(MATRIX, VECTOR, VECTOR, int64, float64))
def _is_contracting(matrix, rhs, step, half, reduction):
    """Return whether the simplified Newton correction of a trial point is shorter than the step by a fraction.

    This natural monotonicity test (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.3) does not change
    if the equations are scaled or combined. In a narrow passage, the residual may have to increase along the only
    steps that lead to the solution: a motion along the path hardly changes the cost, and the equations are sensitive.
    """
    correction = rhs.copy()
    if not solve_banded(matrix.copy(), correction, half):
        return False
    return np.sqrt((correction**2).sum()) <= (1.0 - reduction) * np.sqrt((step**2).sum())


@kernel(
    tuple_of(int64, int64, float64, int64)(FLOW, VECTOR, MATRIX, VECTOR, END_CONDITION, NEWTON_OPTIONS, VECTOR, MATRIX)
)
def solve_nodes(flow, times, Z, start, end, options, costs, log):
    """Apply damped Newton's method to the nodes Z (segments + 1, 2n), in place, and fill the segments' `costs`.

    A free final time changes all times in proportion, in place. `log` (max_iterations + 1, 3) receives residual, cost
    and damping of each iterate, except for a last iterate whose residual is predicted. Returns (exit code,
    iterations, residual, evaluations).
    """
    tolerance, accuracy = options.tolerance, options.accuracy
    n = len(end.goal)
    segments = len(times) - 1
    extra = 1 if end.free_time else 0
    unknowns = (2 * n + extra) * (segments + 1)
    half = 3 * n - 1 + 2 * extra
    step = np.empty(unknowns)
    rows, rhs = np.empty((unknowns, 3 * half + 1)), np.empty(unknowns)
    matrix = np.empty((unknowns, 3 * half + 1))
    system = NewtonSystem(rows, rhs, costs, np.zeros(segments))
    tried = NewtonSystem(rows, rhs, np.empty(segments), np.zeros(segments))
    trial = np.empty((segments + 1, 2 * n))
    current = max(accuracy, COARSE_ACCURACY) if options.adaptive else accuracy
    norm, residual, evaluations = linearise(flow, times, 1.0, Z, start, end, current, system)
    if norm == np.inf:
        return DIVERGED, 0, np.inf, evaluations
    damping, previous = 1.0, 0.0
    for iteration in range(options.max_iterations + 1):
        if residual <= tolerance and current > accuracy:
            # A guess that is a solution is evaluated again, without a step: the matrix may be singular.
            current = accuracy
            norm, residual, count = linearise(flow, times, 1.0, Z, start, end, current, system)
            evaluations += count
        log[iteration, 0] = residual
        log[iteration, 1] = costs.sum()
        log[iteration, 2] = damping
        if residual <= tolerance and current <= accuracy:
            return CONVERGED, iteration, residual, evaluations
        if iteration == options.max_iterations:
            break
        matrix[:] = rows
        if not solve_banded(rows, rhs, half):
            return SINGULAR, iteration, residual, evaluations
        for i in range(unknowns):
            step[i] = rhs[i]
        prediction = predicted_residual(residual, previous, damping)
        if options.adaptive and prediction <= PREDICTION_SAFETY * tolerance and current <= accuracy:
            _move(Z, Z, step, 1.0)
            if end.free_time:
                times *= 1.0 + step[2 * n]
            return CONVERGED, iteration, prediction, evaluations
        required = min(current, max(accuracy, CUBIC_ACCURACY * residual**3))
        damping = min(1.0, 2.0 * damping)
        if end.free_time:
            damping = time_damping(step[2 * n], 1.0, damping)
        factor = 1.0
        while True:
            _move(Z, trial, step, damping)
            if end.free_time:
                factor = 1.0 + damping * step[2 * n]
            for k in range(segments):
                tried.hints[k] = system.hints[k]
            trial_norm, trial_residual, count = linearise(flow, times, factor, trial, start, end, required, tried)
            evaluations += count
            slack = accuracy_slack(current, required, unknowns)
            if is_sufficient_decrease(trial_norm, norm, damping / 2.0, slack):
                break
            # With one segment, this test would accept a step after which the method stalls: from a guess of the costate
            # that is solved otherwise, in the problem `se2-far` of the tests.
            if segments > 1 and trial_norm < np.inf and _is_contracting(matrix, rhs, step, half, damping / 4.0):
                break
            damping /= 2.0
            if damping < MIN_DAMPING:
                return STALLED, iteration, residual, evaluations
        for k in range(segments):
            system.hints[k] = tried.hints[k]
            costs[k] = tried.costs[k]
        for k in range(segments + 1):
            for i in range(2 * n):
                Z[k, i] = trial[k, i]
        if end.free_time:
            times *= factor
        previous = residual
        norm, residual, current = trial_norm, trial_residual, required
    return MAX_ITERATIONS, options.max_iterations, residual, evaluations


@kernel(tuple_of(int64, float64, int64)(FLOW, VECTOR, END_CONDITION, float64, NEWTON_OPTIONS, VECTOR))
def solve_arc(flow, z, end, duration, options, z_end):
    """Solve for the extremal from z = (q, lam), in place, in a fixed time; z_end becomes its end.

    Returns (exit code, cost, evaluations).
    """
    n = len(z) // 2
    times, nodes, costs = np.array([0.0, duration]), np.empty((2, 2 * n)), np.empty(1)
    for i in range(2 * n):
        nodes[0, i] = z[i]
        nodes[1, i] = end.goal[i] if i < n and not end.free[i] else z[i]
    log = np.empty((options.max_iterations + 1, 3))
    code, _, _, evaluations = solve_nodes(flow, times, nodes, z[:n].copy(), end, options, costs, log)
    for i in range(2 * n):
        z[i], z_end[i] = nodes[0, i], nodes[1, i]
    return code, costs[0], evaluations


@kernel(int64(FLOW, VECTOR, MATRIX, VECTOR))
def segment_growth(flow, times, Z, growth):
    """Fill `growth` (segments,) with the largest sensitivity over each segment, infinite if the flow diverged.

    Returns the number of evaluations of the flow.
    """
    size = Z.shape[1]
    S = np.empty((size, size))
    z = np.empty(size)
    evaluations = 0
    for k in range(len(times) - 1):
        for i in range(size):
            z[i] = Z[k, i]
        set_identity(S, 0)
        success, _, _, _, count = propagate(flow, z, S, times[k + 1] - times[k], COARSE_ACCURACY, 0.0, False)
        evaluations += count
        largest = 0.0
        for i in range(size):
            for j in range(size):
                largest = max(largest, abs(S[i, j]))
        growth[k] = largest if success else np.inf
    return evaluations
