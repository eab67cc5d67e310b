"""Sequential quadratic programming on the discretised problem of any robot (kernels).

`leapnav.experts.transcription.arcs_descent` is the same for the unicycle, whose steps are exact arcs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import MATRIX, SIGNS, VECTOR, tuple_of
from leapnav.experts.transcription.midpoint import (
    DISCRETE_PROBLEM,
    EVALUATION,
    EXPANSION,
    Evaluation,
    Expansion,
    discrete_cost,
    evaluate,
    expand,
    violations,
)
from leapnav.experts.transcription.quadratic_model import MODEL, Model, Regularisation, end_multipliers
from leapnav.experts.transcription.riccati import backward

FIRST_SHIFT, MAX_SHIFT = 100.0, 1e7  # of the Hessian, divided by the square of the horizon (s)
# Penalties on the end conditions in the recursion and on all constraints in the line search, divided by the horizon.
# With the penalty of `arcs_descent`, full steps are rejected where the dynamics are strongly curved, and 3 % of the
# paths of a car do not converge; with this one, 0.5 %.
END_PENALTY, PENALTY = 1e4, 10.0
MAX_STEP_LENGTHS = 5  # step lengths that the line search tries: 1, 1/2, ...
MAX_ACTIVE_SETS = 8  # iterations per step that determine the controls at their limits


class _Step(NamedTuple):
    """A step of the iteration.

    Attributes:
        dq: (N + 1, n), changes of the states.
        du: (N, m), changes of the controls.
        multipliers: (N + 1, n), multipliers of the dynamics, which are the new costates.
        nu: (n,), multipliers of the end conditions.

    """

    dq: np.ndarray
    du: np.ndarray
    multipliers: np.ndarray
    nu: np.ndarray


_STEP = record_type(_Step, dq=MATRIX, du=MATRIX, multipliers=MATRIX, nu=VECTOR)


@kernel(float64(DISCRETE_PROBLEM, EXPANSION, MODEL, _STEP))
def _forward(problem, expansion, model, step):
    """Compute the step that minimises the model; return its largest change of a state."""
    h, A, B, defects = problem.h, expansion.A, expansion.B, expansion.defects
    dq, du, multipliers, nu = step.dq, step.du, step.multipliers, step.nu
    largest = 0.0
    n, m = dq.shape[1], du.shape[1]
    for k in range(len(h)):
        for j in range(m):
            du[k, j] = -model.step[k, j]
            for i in range(n):
                du[k, j] -= model.gain[k, j, i] * dq[k, i] + model.end_gain[k, j, i] * nu[i]
        for i in range(n):
            dq[k + 1, i] = defects[k, i]
            for r in range(n):
                dq[k + 1, i] += A[k, i, r] * dq[k, r]
            for j in range(m):
                dq[k + 1, i] += B[k, i, j] * du[k, j]
            largest = max(largest, abs(dq[k + 1, i]))
    for k in range(len(h) + 1):
        for i in range(n):
            multipliers[k, i] = model.p[k, i]
            for j in range(n):
                multipliers[k, i] += model.P[k, i, j] * dq[k, j] + model.F[k, i, j] * nu[j]
    return largest


@kernel(boolean(DISCRETE_PROBLEM, MATRIX, EXPANSION, _STEP, SIGNS))
def _update_active_set(problem, u, expansion, step, held):
    """Hold controls that would leave their limits, release those that reduce the cost; return if any changed."""
    h, data, B, multipliers = problem.h, problem.data, expansion.B, step.multipliers
    n, m = multipliers.shape[1], u.shape[1]
    changed = False
    for k in range(len(h)):
        for j in range(m):
            value, low, high = u[k, j] + step.du[k, j], data[m + j], data[2 * m + j]
            if held[k, j] != 0:
                slope = problem.unit * h[k] * data[j] * value
                for i in range(n):
                    slope += B[k, i, j] * multipliers[k + 1, i]
                if held[k, j] * slope > 0.0:  # moving away from the limit reduces the cost
                    held[k, j], changed = 0, True
            elif value > high + 1e-9 * abs(high):
                held[k, j], changed = 1, True
            elif value < low - 1e-9 * abs(low):
                held[k, j], changed = -1, True
    return changed


@kernel(EVALUATION(int64, int64))
def _empty_evaluation(intervals, n):
    return Evaluation(
        np.empty(intervals + 1),
        np.empty((intervals + 1, n)),
        np.empty((intervals + 1, n, n)),
        np.empty((intervals, n)),
        np.empty((intervals, n)),
    )


@kernel(tuple_of(boolean, float64, float64)(DISCRETE_PROBLEM, MATRIX, MATRIX, MATRIX, float64, int64))
def descend(problem, q, u, costates, tolerance, max_iterations):
    """Apply sequential quadratic programming to states (N + 1, n), controls (N, m) and costates (N + 1, n), in place.

    The costates are multiplied by the unit of the problem. Returns (converged, cost times the unit, sum of the
    constraint violations).
    """
    h, data = problem.h, problem.data
    intervals, m = u.shape
    n = q.shape[1]
    horizon = h.sum()
    first_shift, max_shift = FIRST_SHIFT / horizon**2, MAX_SHIFT / horizon**2
    expansion = Expansion(
        np.empty((intervals + 1, n)),
        np.empty((intervals + 1, n, n)),
        np.empty((intervals, n, n)),
        np.empty((intervals, n, m)),
        np.empty((intervals, n)),
        np.empty((intervals, n + m, n + m)),
    )
    model = Model(
        np.empty((intervals + 1, n, n)),
        np.empty((intervals + 1, n)),
        np.empty((intervals + 1, n, n)),
        np.empty((intervals, m)),
        np.empty((intervals, m, n)),
        np.empty((intervals, m, n)),
        np.empty((n, n)),
        np.empty(n),
    )
    step = _Step(np.zeros((intervals + 1, n)), np.empty((intervals, m)), np.zeros((intervals + 1, n)), np.zeros(n))
    dq, du, multipliers, nu = step.dq, step.du, step.multipliers, step.nu
    new_q, new_u = np.empty((intervals + 1, n)), np.empty((intervals, m))
    found, tried = _empty_evaluation(intervals, n), _empty_evaluation(intervals, n)
    held = np.zeros((intervals, m), dtype=np.int8)
    for k in range(intervals):
        for j in range(m):
            u[k, j] = min(max(u[k, j], data[m + j]), data[2 * m + j])
    is_cold_start = True  # without costates
    for k in range(intervals + 1):
        for i in range(n):
            is_cold_start = is_cold_start and costates[k, i] == 0.0
    evaluate(problem, q, u, found)
    current = discrete_cost(problem, u, found)
    shift, largest, cost, violation = 0.0, 0.0, np.inf, np.inf
    for _ in range(max_iterations):
        expand(problem, q, u, found, costates, expansion)
        for _ in range(MAX_ACTIVE_SETS):
            while not (
                backward(
                    problem,
                    u,
                    held,
                    q[intervals],
                    Regularisation(shift, END_PENALTY / horizon, is_cold_start),
                    expansion,
                    model,
                )
                and end_multipliers(model.G, model.g, q[intervals], problem.end, nu)
            ):
                shift = max(4.0 * shift, first_shift)
                if not shift <= max_shift:
                    return False, current, violations(problem, q, found, multipliers, nu)[0]
            largest = _forward(problem, expansion, model, step)
            if not _update_active_set(problem, u, expansion, step, held):
                break
        _, weighted, squares = violations(problem, q, found, multipliers, nu)
        before = current + weighted + PENALTY / horizon * squares
        damping, descends = 1.0, False
        cost, violation = np.inf, np.inf
        for _ in range(MAX_STEP_LENGTHS):
            for k in range(intervals + 1):
                for i in range(n):
                    new_q[k, i] = q[k, i] + damping * dq[k, i]
            for k in range(intervals):
                for j in range(m):
                    new_u[k, j] = min(max(u[k, j] + damping * du[k, j], data[m + j]), data[2 * m + j])
            evaluate(problem, new_q, new_u, tried)
            cost = discrete_cost(problem, new_u, tried)
            violation, weighted, squares = violations(problem, new_q, tried, multipliers, nu)
            descends = cost + weighted + PENALTY / horizon * squares <= before + 1e-9 * abs(before)
            if descends:
                break
            damping *= 0.5
        if not descends:
            shift = max(8.0 * shift, first_shift)
            if shift > max_shift:
                return False, cost, violation
            continue
        current = cost
        found, tried = tried, found
        fraction = 1.0 if is_cold_start else damping
        for k in range(intervals + 1):
            for i in range(n):
                q[k, i] = new_q[k, i]
                costates[k, i] += fraction * (multipliers[k, i] - costates[k, i])
        for k in range(intervals):
            for j in range(m):
                u[k, j] = new_u[k, j]
        if damping == 1.0 and largest < tolerance and shift <= first_shift:
            return True, cost, violation
        is_cold_start = False
        if damping == 1.0:
            shift = 0.25 * shift if shift > 0.01 * first_shift else 0.0
        elif damping < 0.3:
            shift = max(4.0 * shift, first_shift)
    return False, cost, violation
