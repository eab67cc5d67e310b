"""The discretised problem of any robot: cost, constraints, and their second-order expansion (kernels).

Constant controls on each of N intervals; one step of the explicit midpoint rule per interval, with exact first and
second derivatives; the state cost is integrated by the trapezoidal rule.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import END_CONDITION, EndCondition
from leapnav.experts.problem.generated_dynamics import DERIVATIVES_FUNCTION, RATES_FUNCTION, STATE_COST_FUNCTION


class DiscreteProblem(NamedTuple):
    """The discretised problem of a system with n states and m controls.

    Attributes:
        h: (N,), durations of the intervals (s).
        end: conditions at the horizon.
        data: control weights (m,), lower and upper bounds (2m,) and so on, see `ExtremalFlow`.
        field: packed obstacle field.
        unit: factor of all costs.
        rates, derivatives, state_cost: see `leapnav.experts.problem.generated_dynamics`.

    """

    h: np.ndarray
    end: EndCondition
    data: np.ndarray
    field: np.ndarray
    unit: float
    rates: FunctionPointer
    derivatives: FunctionPointer
    state_cost: FunctionPointer


class Evaluation(NamedTuple):
    """What cost, constraints and expansion of a path have in common.

    Attributes:
        costs: (N + 1,), state cost.
        gradients: (N + 1, n), its gradient.
        hessians: (N + 1, n, n), its Hessian.
        middles: (N, n), states in the middle of the steps.
        ends: (N, n), states at the ends of the steps.

    """

    costs: np.ndarray
    gradients: np.ndarray
    hessians: np.ndarray
    middles: np.ndarray
    ends: np.ndarray


class Expansion(NamedTuple):
    """The second-order expansion about a path.

    Attributes:
        gradient: (N + 1, n), gradient of the weighted state cost.
        hessian: (N + 1, n, n), its Hessian.
        A: (N, n, n), derivatives of the next state with respect to the state.
        B: (N, n, m), derivatives of the next state with respect to the controls.
        defects: (N, n), violations of the dynamics.
        W: (N, n + m, n + m), Hessian of costates times dynamics in (q, u).

    """

    gradient: np.ndarray
    hessian: np.ndarray
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
    rates=RATES_FUNCTION,
    derivatives=DERIVATIVES_FUNCTION,
    state_cost=STATE_COST_FUNCTION,
)
EVALUATION = record_type(Evaluation, costs=VECTOR, gradients=MATRIX, hessians=CUBE, middles=MATRIX, ends=MATRIX)
EXPANSION = record_type(Expansion, gradient=MATRIX, hessian=CUBE, A=CUBE, B=CUBE, defects=MATRIX, W=CUBE)


@kernel(NOTHING(DISCRETE_PROBLEM, MATRIX, MATRIX, EVALUATION))
def evaluate(problem, q, u, evaluation):
    """Fill the evaluation of a path q (N + 1, n), u (N, m)."""
    n = q.shape[1]
    f = np.empty(n)
    for k in range(len(q)):
        evaluation.costs[k] = problem.state_cost(
            q[k], problem.data, problem.field, evaluation.gradients[k], evaluation.hessians[k]
        )
    for k in range(len(u)):
        h, middle, end = problem.h[k], evaluation.middles[k], evaluation.ends[k]
        problem.rates(q[k], u[k], problem.data, f)
        for i in range(n):
            middle[i] = q[k, i] + 0.5 * h * f[i]
        problem.rates(middle, u[k], problem.data, f)
        for i in range(n):
            end[i] = q[k, i] + h * f[i]


@kernel(float64(DISCRETE_PROBLEM, MATRIX, EVALUATION))
def discrete_cost(problem, u, evaluation):
    """Return J of an evaluated path with the controls u (N, m), times the unit."""
    h, data = problem.h, problem.data
    intervals, m = u.shape
    cost = 0.0
    for k in range(intervals + 1):
        weight = 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        cost += weight * evaluation.costs[k]
    for k in range(intervals):
        for j in range(m):
            cost += 0.5 * h[k] * data[j] * u[k, j] * u[k, j]
    return problem.unit * cost


@kernel(tuple_of(*[float64] * 3)(DISCRETE_PROBLEM, MATRIX, EVALUATION, MATRIX, VECTOR))
def violations(problem, q, evaluation, multipliers, end_multipliers):
    """Return sums over the constraint violations: absolute values, products with the multipliers, and squares."""
    h, goal, free = problem.h, problem.end.goal, problem.end.free
    intervals, n = len(h), q.shape[1]
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


@kernel(NOTHING(DISCRETE_PROBLEM, MATRIX, MATRIX, EVALUATION, MATRIX, EXPANSION))
def expand(problem, q, u, evaluation, costates, expansion):
    """Fill the second-order expansion about an evaluated path.

    The step is F(q, u) = q + h f(p, u) with the middle p = q + h / 2 f(q, u) and M = dp / d(q, u). The Hessian of
    lambda'F is h M' (lambda'f)_pp M, the mixed derivatives in (p, u) with M on one side, and the Hessian of mu'f at
    (q, u) with mu = h^2 / 2 f_p' lambda.
    """
    h, data, unit = problem.h, problem.data, problem.unit
    A, B, defects, W = expansion.A, expansion.B, expansion.defects, expansion.W
    intervals, m = u.shape
    n = q.shape[1]
    mu = np.empty(n)
    fq, fu, hqq, hqu = np.empty((n, n)), np.empty((n, m)), np.empty((n, n)), np.empty((n, m))
    gq, gu, gqq, gqu = np.empty((n, n)), np.empty((n, m)), np.empty((n, n)), np.empty((n, m))
    M, product = np.empty((n, n + m)), np.empty((n, n + m))
    for k in range(intervals + 1):
        weight = unit * 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        for i in range(n):
            expansion.gradient[k, i] = weight * evaluation.gradients[k, i]
            for j in range(n):
                expansion.hessian[k, i, j] = weight * evaluation.hessians[k, i, j]
    for k in range(intervals):
        step, middle, end, lam = h[k], evaluation.middles[k], evaluation.ends[k], costates[k + 1]
        problem.derivatives(middle, u[k], lam, data, fq, fu, hqq, hqu)
        for i in range(n):
            defects[k, i] = end[i] - q[k + 1, i]
            mu[i] = 0.0
            for r in range(n):
                mu[i] += fq[r, i] * lam[r]
            mu[i] *= 0.5 * step * step
        problem.derivatives(q[k], u[k], mu, data, gq, gu, gqq, gqu)
        for i in range(n):
            for c in range(n):
                M[i, c] = 0.5 * step * gq[i, c] + (1.0 if i == c else 0.0)
            for c in range(m):
                M[i, n + c] = 0.5 * step * gu[i, c]
        for i in range(n):
            for c in range(n + m):
                total, curved = 0.0, 0.0
                for r in range(n):
                    total += fq[i, r] * M[r, c]
                    curved += hqq[i, r] * M[r, c]
                product[i, c] = curved
                if c < n:
                    A[k, i, c] = step * total + (1.0 if i == c else 0.0)
                else:
                    B[k, i, c - n] = step * (total + fu[i, c - n])
        for a in range(n + m):
            for b in range(a, n + m):
                total = 0.0
                for r in range(n):
                    total += M[r, a] * product[r, b]
                    if b >= n:
                        total += M[r, a] * hqu[r, b - n]
                    if a >= n:
                        total += hqu[r, a - n] * M[r, b]
                total *= step
                if b < n:
                    total += gqq[a, b]
                elif a < n:
                    total += gqu[a, b - n]
                W[k, a, b] = W[k, b, a] = total
