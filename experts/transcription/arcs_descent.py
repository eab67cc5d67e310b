"""Sequential quadratic programming on the discretised problem (kernels)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import MATRIX, SIGNS, VECTOR, tuple_of
from leapnav.experts.transcription.arcs import (
    DISCRETE_PROBLEM,
    EXPANSION,
    Evaluation,
    Expansion,
    discrete_cost,
    evaluate,
    expand,
    violations,
)
from leapnav.experts.transcription.arcs_riccati import backward
from leapnav.experts.transcription.quadratic_model import MODEL, Model, Regularisation, end_multipliers

FIRST_SHIFT, MAX_SHIFT = 100.0, 1e7  # of the Hessian, divided by the square of the horizon (s)
# A path with more intervals is long. With 512, the barrier has more curvature than the largest shift in mazes of 500 m.
INTERVALS_OF_PART = 64
# Penalties on the end conditions in the recursion and on all constraints in the line search, divided by the horizon.
END_PENALTY, PENALTY = 1e4, 300.0
MAX_STEP_LENGTHS = 5  # step lengths that the line search tries: 1, 1/2, ...
MAX_ACTIVE_SETS = 8  # iterations per step that determine the controls at their limits


class _Step(NamedTuple):
    """A step of the iteration.

    Attributes:
        dq: (N + 1, 3), changes of the states.
        du: (N, 2), changes of the controls.
        multipliers: (N + 1, 3), multipliers of the dynamics, which are the new costates.
        nu: (3,), multipliers of the end conditions.

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
    for k in range(len(h)):
        for j in range(2):
            du[k, j] = -model.step[k, j]
            for i in range(3):
                du[k, j] -= model.gain[k, j, i] * dq[k, i] + model.end_gain[k, j, i] * nu[i]
        for i in range(2):
            dq[k + 1, i] = dq[k, i] + A[k, i] * dq[k, 2] + defects[k, i]
            dq[k + 1, i] += B[k, i, 0] * du[k, 0] + B[k, i, 1] * du[k, 1]
        dq[k + 1, 2] = dq[k, 2] + h[k] * du[k, 1] + defects[k, 2]
        largest = max(largest, abs(dq[k + 1, 0]), abs(dq[k + 1, 1]), abs(dq[k + 1, 2]))
    for k in range(len(h) + 1):
        for i in range(3):
            multipliers[k, i] = model.p[k, i]
            for j in range(3):
                multipliers[k, i] += model.P[k, i, j] * dq[k, j] + model.F[k, i, j] * nu[j]
    return largest


@kernel(boolean(DISCRETE_PROBLEM, MATRIX, EXPANSION, _STEP, SIGNS))
def _update_active_set(problem, u, expansion, step, held):
    """Hold controls that would leave their limits, release those that reduce the cost; return if any changed."""
    h, limits, B, multipliers = problem.h, problem.limits, expansion.B, step.multipliers
    changed = False
    for k in range(len(h)):
        for j in range(2):
            weight = h[k] if j == 0 else h[k] * problem.turn_weight
            value = u[k, j] + step.du[k, j]
            if held[k, j] != 0:
                slope = weight * value + B[k, 0, j] * multipliers[k + 1, 0] + B[k, 1, j] * multipliers[k + 1, 1]
                slope += h[k] * multipliers[k + 1, 2] if j == 1 else 0.0
                if held[k, j] * slope > 0.0:  # moving away from the limit reduces the cost
                    held[k, j], changed = 0, True
            elif abs(value) > limits[j] * (1.0 + 1e-9):
                held[k, j], changed = (1 if value > 0.0 else -1), True
    return changed


@kernel(tuple_of(boolean, float64, float64)(DISCRETE_PROBLEM, MATRIX, MATRIX, MATRIX, float64, int64))
def descend(problem, q, u, costates, tolerance, max_iterations):
    """Apply sequential quadratic programming to states (N + 1, 3), controls (N, 2) and costates (N + 1, 3), in place.

    Returns (converged, cost in units of the speed weight, sum of the constraint violations).
    """
    h, limits = problem.h, problem.limits
    intervals = len(h)
    horizon = h.sum()
    # The curvature that the shift must exceed is that of a part of a long path.
    part = horizon * min(1.0, INTERVALS_OF_PART / intervals)
    first_shift, max_shift = FIRST_SHIFT / horizon**2, MAX_SHIFT / part**2
    expansion = Expansion(
        np.empty((intervals + 1, 5)),
        np.empty((intervals, 2)),
        np.empty((intervals, 2, 2)),
        np.empty((intervals, 3)),
        np.empty((intervals, 3, 3)),
    )
    model = Model(
        np.empty((intervals + 1, 3, 3)),
        np.empty((intervals + 1, 3)),
        np.empty((intervals + 1, 3, 3)),
        np.empty((intervals, 2)),
        np.empty((intervals, 2, 3)),
        np.empty((intervals, 2, 3)),
        np.empty((3, 3)),
        np.empty(3),
    )
    step = _Step(np.zeros((intervals + 1, 3)), np.empty((intervals, 2)), np.zeros((intervals + 1, 3)), np.zeros(3))
    dq, du, multipliers, nu = step.dq, step.du, step.multipliers, step.nu
    new_q, new_u = np.empty((intervals + 1, 3)), np.empty((intervals, 2))
    found = Evaluation(np.empty((intervals + 1, 6)), np.empty((intervals, 5)))
    tried = Evaluation(np.empty((intervals + 1, 6)), np.empty((intervals, 5)))
    held = np.zeros((intervals, 2), dtype=np.int8)
    for k in range(intervals):
        for j in range(2):
            u[k, j] = min(max(u[k, j], -limits[j]), limits[j])
    is_cold_start = True  # without costates
    for k in range(intervals + 1):
        for i in range(3):
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
                    return False, current, violations(problem, q, u, found, multipliers, nu)[0]
            largest = _forward(problem, expansion, model, step)
            if not _update_active_set(problem, u, expansion, step, held):
                break
        _, weighted, squares = violations(problem, q, u, found, multipliers, nu)
        before = current + weighted + PENALTY / horizon * squares
        damping, descends = 1.0, False
        cost, violation = np.inf, np.inf
        for _ in range(MAX_STEP_LENGTHS):
            for k in range(intervals + 1):
                for i in range(3):
                    new_q[k, i] = q[k, i] + damping * dq[k, i]
            for k in range(intervals):
                for j in range(2):
                    new_u[k, j] = min(max(u[k, j] + damping * du[k, j], -limits[j]), limits[j])
            evaluate(problem, new_q, new_u, tried)
            cost = discrete_cost(problem, new_u, tried)
            violation, weighted, squares = violations(problem, new_q, new_u, tried, multipliers, nu)
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
            for i in range(3):
                q[k, i] = new_q[k, i]
                costates[k, i] += fraction * (multipliers[k, i] - costates[k, i])
        for k in range(intervals):
            for j in range(2):
                u[k, j] = new_u[k, j]
        if damping == 1.0 and largest < tolerance and shift <= first_shift:
            return True, cost, violation
        is_cold_start = False
        if damping == 1.0:
            shift = 0.25 * shift if shift > 0.01 * first_shift else 0.0
        elif damping < 0.3:
            shift = max(4.0 * shift, first_shift)
    return False, cost, violation
