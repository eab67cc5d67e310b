"""The discretised problem: cost, constraints, and their second-order expansion (kernels).

The controls are constant on each of N intervals. An interval is one step of the dynamics (STEP_SIGNATURE), and the
state cost is integrated by the trapezoidal rule.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import FunctionPointer, matrix_of, part_of
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING, SIGNS, VECTOR, tuple_of
from leapnav.experts.numerics.flow import (
    END_CONDITION,
    STATE_COST_FUNCTION,
    STEP_DERIVATIVES_FUNCTION,
    STEP_FUNCTION,
    EndCondition,
)


class DiscreteProblem(NamedTuple):
    """The discretised problem of a system with n states and m controls.

    Attributes:
        h: (N,), durations of the intervals (s).
        end: conditions at the horizon.
        data: control weights (m,), lower and upper bounds (2m,) and so on, see `ExtremalFlow`.
        field: packed obstacle field.
        unit: factor of all costs.
        step, step_derivatives, state_cost: see `leapnav.experts.numerics.flow`.

    """

    h: np.ndarray
    end: EndCondition
    data: np.ndarray
    field: np.ndarray
    unit: float
    step: FunctionPointer
    step_derivatives: FunctionPointer
    state_cost: FunctionPointer


class Path(NamedTuple):
    """A path of N intervals.

    Attributes:
        q: (N + 1, n), states.
        u: (N, m), controls, constant on each interval.
        costates: (N + 1, n), times the unit of the problem.
        held: (N, m), signs of the limits at which controls are held, or 0.

    """

    q: np.ndarray
    u: np.ndarray
    costates: np.ndarray
    held: np.ndarray


class Evaluation(NamedTuple):
    """What cost, constraints and expansion of a path have in common.

    Attributes:
        costs: (N + 1,), state cost.
        gradients: (N + 1, n), its gradient.
        hessians: (N + 1, n, n), its Hessian.
        ends: (N, n), states at the ends of the steps.

    """

    costs: np.ndarray
    gradients: np.ndarray
    hessians: np.ndarray
    ends: np.ndarray


class Expansion(NamedTuple):
    """The second-order expansion of the dynamics about a path.

    Attributes:
        A: (N, n, n), derivatives of the next state with respect to the state.
        B: (N, n, m), derivatives of the next state with respect to the controls.
        defects: (N, n), violations of the dynamics.
        W: (N, n + m, n + m), Hessian of costates times dynamics in (q, u).

    """

    A: np.ndarray
    B: np.ndarray
    defects: np.ndarray
    W: np.ndarray


DISCRETE_PROBLEM = record_type(
    DiscreteProblem,
    h=VECTOR,
    end=END_CONDITION,
    data=CONSTANT,
    field=CONSTANT,
    unit=float64,
    step=STEP_FUNCTION,
    step_derivatives=STEP_DERIVATIVES_FUNCTION,
    state_cost=STATE_COST_FUNCTION,
)
PATH = record_type(Path, q=MATRIX, u=MATRIX, costates=MATRIX, held=SIGNS)
EVALUATION = record_type(Evaluation, costs=VECTOR, gradients=MATRIX, hessians=CUBE, ends=MATRIX)
EXPANSION = record_type(Expansion, A=CUBE, B=CUBE, defects=MATRIX, W=CUBE)


@kernel(EVALUATION(int64, int64))
def empty_evaluation(intervals, n):
    """Return an evaluation of a path to be filled."""
    return Evaluation(
        np.empty(intervals + 1),
        np.empty((intervals + 1, n)),
        np.empty((intervals + 1, n, n)),
        np.empty((intervals, n)),
    )


@kernel(EXPANSION(int64, int64, int64))
def empty_expansion(intervals, n, m):
    """Return an expansion about a path to be filled."""
    return Expansion(
        np.empty((intervals, n, n)),
        np.empty((intervals, n, m)),
        np.empty((intervals, n)),
        np.empty((intervals, n + m, n + m)),
    )


@kernel(float64(VECTOR, int64))
def node_weight(h, k):
    """Return the weight (s) of a node in the trapezoidal rule, in intervals of the durations h."""
    return 0.5 * ((h[k] if k < len(h) else 0.0) + (h[k - 1] if k > 0 else 0.0))


@kernel(boolean(STEP_FUNCTION, CONSTANT, VECTOR, MATRIX, MATRIX))
def roll_out(step, data, times, u, q):
    """Fill the states q (N + 1, n) that follow q[0] with controls u (N, m); return whether they are finite."""
    intervals, m = u.shape
    n = q.shape[1]
    for k in range(intervals):
        following = part_of(q, (k + 1) * n, n)
        step(part_of(q, k * n, n), part_of(u, k * m, m), times[k + 1] - times[k], data, following)
        for i in range(n):
            if not abs(following[i]) < np.inf:
                return False
    return True


@kernel(NOTHING(DISCRETE_PROBLEM, PATH, EVALUATION))
def evaluate(problem, path, evaluation):
    """Fill the evaluation of a path."""
    q, u = path.q, path.u
    intervals, m = u.shape
    n = q.shape[1]
    for k in range(intervals + 1):
        gradient, hessian = part_of(evaluation.gradients, k * n, n), matrix_of(evaluation.hessians, k * n * n, n, n)
        evaluation.costs[k] = problem.state_cost(part_of(q, k * n, n), problem.data, problem.field, gradient, hessian)
    for k in range(intervals):
        end = part_of(evaluation.ends, k * n, n)
        problem.step(part_of(q, k * n, n), part_of(u, k * m, m), problem.h[k], problem.data, end)


@kernel(float64(DISCRETE_PROBLEM, PATH, EVALUATION))
def discrete_cost(problem, path, evaluation):
    """Return J of an evaluated path, times the unit."""
    h, data, u = problem.h, problem.data, path.u
    intervals, m = u.shape
    cost = 0.0
    for k in range(intervals + 1):
        cost += node_weight(h, k) * evaluation.costs[k]
    for k in range(intervals):
        for j in range(m):
            cost += 0.5 * h[k] * data[j] * u[k, j] * u[k, j]
    return problem.unit * cost


@kernel(tuple_of(*[float64] * 3)(DISCRETE_PROBLEM, PATH, EVALUATION, MATRIX, VECTOR))
def violations(problem, path, evaluation, multipliers, end_multipliers):
    """Return sums over the constraint violations: absolute values, products with the multipliers, and squares."""
    q, goal, free = path.q, problem.end.goal, problem.end.free
    intervals, n = len(problem.h), q.shape[1]
    violation, weighted, squares = 0.0, 0.0, 0.0
    for k in range(intervals):
        for i in range(n):
            defect = evaluation.ends[k, i] - q[k + 1, i]
            violation += abs(defect)
            squares += defect * defect
            weighted += multipliers[k + 1, i] * defect
    for i in range(n):
        if not free[i]:
            end_error = q[intervals, i] - goal[i]
            violation += abs(end_error)
            squares += end_error * end_error
            weighted += end_multipliers[i] * end_error
    return violation, weighted, squares


@kernel(NOTHING(DISCRETE_PROBLEM, PATH, EVALUATION, EXPANSION))
def expand(problem, path, evaluation, expansion):
    """Fill the second-order expansion of the dynamics about an evaluated path."""
    q, u = path.q, path.u
    intervals, m = u.shape
    n = q.shape[1]
    size = n + m
    for k in range(intervals):
        problem.step_derivatives(
            part_of(q, k * n, n),
            part_of(u, k * m, m),
            problem.h[k],
            part_of(path.costates, (k + 1) * n, n),
            problem.data,
            matrix_of(expansion.A, k * n * n, n, n),
            matrix_of(expansion.B, k * n * m, n, m),
            matrix_of(expansion.W, k * size * size, size, size),
        )
        for i in range(n):
            expansion.defects[k, i] = evaluation.ends[k, i] - q[k + 1, i]
