"""Sequential quadratic programming on the discretised problem (kernels)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import part_of
from leapnav.envs.kernels.types import CUBE, MATRIX, VECTOR, tuple_of
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.transcription.discrete_problem import (
    DISCRETE_PROBLEM,
    EVALUATION,
    EXPANSION,
    PATH,
    Path,
    discrete_cost,
    empty_evaluation,
    empty_expansion,
    evaluate,
    expand,
    violations,
)
from leapnav.experts.transcription.quadratic_model import MODEL, Regularisation, empty_model, end_multipliers
from leapnav.experts.transcription.riccati import BACKWARD_FUNCTION

# Of the Hessian, divided by the square of the horizon (s). Close to an obstacle, the barrier has more curvature than
# 1e7.
FIRST_SHIFT, MAX_SHIFT = 100.0, 1e13
# Penalties on the end conditions in the recursion and on all constraints in the line search, divided by the horizon.
# With a penalty of 300, full steps are rejected where the dynamics are strongly curved: 10 of 245 paths of the
# unicycle, 54 of 302 of the differential drive and 30 of 581 of the car do not converge; with 10, none, 23 of 300 and
# none.
END_PENALTY, PENALTY = 1e4, 10.0
# Step lengths that the line search tries: 1, 1/2, ..., along the dynamics and linearly. With 5 and a largest shift of
# 1e7, a first version of the adaptive descents solved 4 of 7 tight parking tasks, with these values 6.
MAX_STEP_LENGTHS = 10
MAX_ACTIVE_SETS = 8  # iterations per step that determine the controls at their limits
CONVERGED, NOT_CONVERGED, KNOWN = 0, 1, 2  # exit codes


class KnownPaths(NamedTuple):
    """Local optima near which a descent ends.

    Attributes:
        points: (K, P, 3), x, y (m) and heading (rad) of K paths at equal fractions of the horizon.
        distance: distance (m and rad) within which a path is close to a known one at all points.

    """

    points: np.ndarray
    distance: float


KNOWN_PATHS = record_type(KnownPaths, points=CUBE, distance=float64)


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


@kernel(boolean(DISCRETE_PROBLEM, PATH, EXPANSION, _STEP))
def _update_active_set(problem, path, expansion, step):
    """Hold controls that would leave their limits, release those that reduce the cost; return if any changed."""
    h, data, B, multipliers, u, held = problem.h, problem.data, expansion.B, step.multipliers, path.u, path.held
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


@kernel(boolean(DISCRETE_PROBLEM, PATH, EVALUATION, MODEL, _STEP, float64, boolean, PATH))
def _take_step(problem, path, found, model, step, damping, follows, moved):
    """Fill `moved` with the path after a fraction of a step.

    If it `follows` the dynamics, the path is the one to which the controls of the model along it lead, and violations
    of the dynamics shrink by the fraction. Otherwise the step is linear. Returns whether the path is finite.
    """
    data, q, u = problem.data, path.q, path.u
    intervals, m = u.shape
    n = q.shape[1]
    if not follows:
        for k in range(intervals + 1):
            for i in range(n):
                moved.q[k, i] = q[k, i] + damping * step.dq[k, i]
        for k in range(intervals):
            for j in range(m):
                moved.u[k, j] = min(max(u[k, j] + damping * step.du[k, j], data[m + j]), data[2 * m + j])
        return True
    for i in range(n):
        moved.q[0, i] = q[0, i]
    for k in range(intervals):
        for j in range(m):
            value = u[k, j] - damping * model.step[k, j]
            for i in range(n):
                value -= model.gain[k, j, i] * (moved.q[k, i] - q[k, i])
                value -= damping * model.end_gain[k, j, i] * step.nu[i]
            moved.u[k, j] = min(max(value, data[m + j]), data[2 * m + j])
        following = part_of(moved.q, (k + 1) * n, n)
        problem.step(part_of(moved.q, k * n, n), part_of(moved.u, k * m, m), problem.h[k], data, following)
        for i in range(n):
            following[i] -= (1.0 - damping) * (found.ends[k, i] - q[k + 1, i])
            if not abs(following[i]) < np.inf:
                return False
    return True


@kernel(boolean(KNOWN_PATHS, VECTOR, MATRIX))
def _is_known(known, times, q):
    """Return whether a path with states q at the times is close to a known path."""
    count, size, columns = known.points.shape
    if count == 0:
        return False
    points = interpolate(np.linspace(0.0, times[-1], size), times, q)
    for path in range(count):
        is_close = True
        for k in range(size):
            for i in range(columns):
                is_close = is_close and abs(points[k, i] - known.points[path, k, i]) < known.distance
            if not is_close:
                break
        if is_close:
            return True
    return False


@kernel(
    tuple_of(int64, float64, float64)(DISCRETE_PROBLEM, BACKWARD_FUNCTION, PATH, float64, int64, boolean, KNOWN_PATHS)
)
def descend(problem, backward, path, tolerance, max_iterations, alternates, known):
    """Apply sequential quadratic programming to a path, in place; without costates, they are zero.

    Linear steps are tried after those along the dynamics: at each length if it `alternates`, otherwise after all.

    Returns (exit code, cost times the unit, sum of the constraint violations).
    """
    intervals, m = path.u.shape
    n = path.q.shape[1]
    times = np.append(np.zeros(1), np.cumsum(problem.h))
    horizon = times[-1]
    first_shift, max_shift = FIRST_SHIFT / horizon**2, MAX_SHIFT / horizon**2
    expansion, model = empty_expansion(intervals, n, m), empty_model(intervals, n, m)
    step = _Step(np.zeros((intervals + 1, n)), np.zeros((intervals, m)), np.zeros((intervals + 1, n)), np.zeros(n))
    moved = Path(np.empty((intervals + 1, n)), np.empty((intervals, m)), path.costates, path.held)
    found, tried = empty_evaluation(intervals, n), empty_evaluation(intervals, n)
    is_cold_start = not path.costates.any()
    for k in range(intervals):
        for j in range(m):
            path.u[k, j] = min(max(path.u[k, j], problem.data[m + j]), problem.data[2 * m + j])
    evaluate(problem, path, found)
    current = discrete_cost(problem, path, found)
    shift, largest, cost, left, violation = 0.0, 0.0, np.inf, np.inf, np.inf
    for _ in range(max_iterations):
        expand(problem, path, found, expansion)
        for _ in range(MAX_ACTIVE_SETS):
            while not (
                backward(
                    problem,
                    path,
                    Regularisation(shift, END_PENALTY / horizon, is_cold_start),
                    found,
                    expansion,
                    model,
                )
                and end_multipliers(model.G, model.g, path.q[intervals], problem.end, step.nu)
            ):
                shift = max(4.0 * shift, first_shift)
                if not shift <= max_shift:
                    return NOT_CONVERGED, current, violations(problem, path, found, step.multipliers, step.nu)[0]
            largest = _forward(problem, expansion, model, step)
            if not _update_active_set(problem, path, expansion, step):
                break
        violation, weighted, squares = violations(problem, path, found, step.multipliers, step.nu)
        before = current + weighted + PENALTY / horizon * squares
        damping, descends = 1.0, False
        for trial in range(2 * MAX_STEP_LENGTHS):
            follows = trial % 2 == 0 if alternates else trial < MAX_STEP_LENGTHS
            damping = 0.5 ** (trial // 2 if alternates else trial % MAX_STEP_LENGTHS)
            if _take_step(problem, path, found, model, step, damping, follows, moved):
                evaluate(problem, moved, tried)
                cost = discrete_cost(problem, moved, tried)
                left, weighted, squares = violations(problem, moved, tried, step.multipliers, step.nu)
                descends = cost + weighted + PENALTY / horizon * squares <= before + 1e-9 * abs(before)
                if descends:
                    break
        if not descends:
            shift = max(8.0 * shift, first_shift)
            if shift > max_shift:
                return NOT_CONVERGED, current, violation
            continue
        current, violation = cost, left
        found, tried = tried, found
        path.q[:], path.u[:] = moved.q, moved.u
        fraction = 1.0 if is_cold_start else damping
        for k in range(intervals + 1):
            for i in range(n):
                path.costates[k, i] += fraction * (step.multipliers[k, i] - path.costates[k, i])
        if damping == 1.0 and largest < tolerance and shift <= first_shift:
            return CONVERGED, current, violation
        if _is_known(known, times, path.q):
            return KNOWN, current, violation
        is_cold_start = False
        if damping == 1.0:
            shift = 0.25 * shift if shift > 0.01 * first_shift else 0.0
        elif damping < 0.3:
            shift = max(4.0 * shift, first_shift)
    return NOT_CONVERGED, current, violation
