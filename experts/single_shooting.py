"""Simple shooting: Newton's method on the initial costate, with the exact Jacobian of the sensitivity equations."""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.experts.certificate import certify
from leapnav.experts.extremal import (
    CONVERGED,
    DIVERGED,
    KERNEL_STATUS,
    MAX_ITERATIONS,
    SINGULAR,
    STALLED,
    Extremal,
    Iteration,
    Status,
)
from leapnav.experts.integrator import FLOW, constant, matrix, propagate, vector
from leapnav.experts.linear import solve_dense
from leapnav.experts.nodes import Settings, default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem, Path

SMALLEST_DAMPING = 1.0 / 64.0
# Newton's method goes on to a residual this much below the one asked for, which may remain where it cannot.
MARGIN = 0.1
FIRST_PARTS, MOST_PARTS = 8, 128  # of the horizon, by which the march advances
MARCHING_TOLERANCE = 1e-7
# A foreseen residual must be this much below the tolerance, with at least so large a constant of the quadratic term:
# one step that happens to go well proves little.
SAFETY, STEEPEST = 0.1, 100.0
SMALLEST_TOLERANCE = 1e-13  # of the integrator, near rounding
LOOSEST = 1e-4  # of the integrator, far from the solution


def single_shooting(problem: OptimalControlProblem, path: Path, settings: Settings) -> Extremal:
    """Newton's method on the initial costate.

    Where the guess is too far off for the whole horizon, it is improved over a growing part of it first, with points of
    the path for goals.
    """
    nodes = start_nodes(problem, path, settings.segments or default_segments(path))[1]
    z, end, status, history, work = _shoot(problem, nodes[0], settings)
    if status is not Status.SUCCESS:
        costate, evaluations = _march(problem, path, nodes[0], settings)
        work += evaluations
        if costate is not None:
            second, second_end, status, rows, evaluations = _shoot(problem, costate, settings)
            history += rows
            work += evaluations
            if status is Status.SUCCESS:
                z, end = second, second_end
    return certify(problem, np.array([0.0, problem.horizon]), np.stack([z, end]), status, history, work)


def _shoot(
    problem: OptimalControlProblem, guess: np.ndarray, settings: Settings
) -> tuple[np.ndarray, np.ndarray, Status, tuple[Iteration, ...], int]:
    """Start and end of the extremal from a guess (2n,) of the start, with status, history and evaluations."""
    arrays = problem.arrays
    z, end = guess.copy(), guess.copy()
    log = np.zeros((settings.max_iterations + 1, 2))
    code, iterations, residual, _, work = shoot(
        arrays.flow,
        z,
        arrays.goal,
        end,
        arrays.free,
        problem.horizon,
        arrays.data,
        arrays.field,
        MARGIN * settings.tol,
        # Over the whole horizon the integration errors of all steps add up and grow.
        max(settings.tol * 1e-5, SMALLEST_TOLERANCE),
        settings.max_iterations,
        log,
    )
    history = tuple(Iteration("newton", 1, row[1], row[0]) for row in log[: iterations + 1].tolist())
    return z, end, Status.SUCCESS if residual <= settings.tol else KERNEL_STATUS[code], history, work


def _march(
    problem: OptimalControlProblem, path: Path, guess: np.ndarray, settings: Settings
) -> tuple[np.ndarray | None, int]:
    """The start (2n,) of an extremal that follows the path nearly to the horizon, None if there is none."""
    arrays, n, horizon = problem.arrays, problem.system.n, problem.horizon
    log = np.empty((settings.max_iterations + 1, 2))
    fixed = np.zeros(n, dtype=bool)
    reached, step, work = 0.0, horizon / FIRST_PARTS, 0
    z, end = guess.copy(), guess.copy()
    while reached < horizon * (1 - 1 / FIRST_PARTS):
        to = min(reached + step, horizon * (1 - 0.5 / FIRST_PARTS))
        trial = z.copy()
        goal = path.resample(np.array([to])).states[0]
        arguments = (goal, end, fixed, to, arrays.data, arrays.field, MARCHING_TOLERANCE, MARCHING_TOLERANCE * 1e-3)
        code, _, _, _, evaluations = shoot(arrays.flow, trial, *arguments, settings.max_iterations, log)
        work += abs(evaluations)
        if code == CONVERGED:
            z, reached = trial, to
            step = min(2.0 * step, horizon / FIRST_PARTS)
        else:
            step /= 2.0
            if step < horizon / MOST_PARTS:
                return None, work
    return z, work


@njit(
    types.Tuple((int64, int64, float64, float64, int64))(
        FLOW,
        vector,
        vector,
        vector,
        types.Array(boolean, 1, "C"),
        float64,
        constant,
        constant,
        float64,
        float64,
        int64,
        matrix,
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def shoot(flow, z, goal, z_end, free, duration, data, field, tolerance, accuracy, max_iterations, log):
    """Damped Newton on the costate in z = (q_0, lam_0), in place; z_end becomes the end of the extremal.

    `goal` holds q_f where `free` is False; where it is True the costate must vanish at the end (transversality).
    `log` (max_iterations + 1, 2) receives residual and cost of each iterate but a last one whose residual is foreseen;
    its cost is that of the one before with the gradient's correction. Returns (status, iterations, residual,
    cost, evaluations of the flow). Converged means max |residual| <= tolerance.
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
    damping, hint = 1.0, 0.0
    current, wanted = np.inf, max(accuracy, LOOSEST)
    for iteration in range(max_iterations + 1):
        while True:
            trial = start.copy()
            S[:] = 0.0
            for i in range(n):
                S[n + i, i] = 1.0
            trial_cost, _, following, steps = propagate(flow, trial, S, duration, data, field, wanted, hint, False)
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
            # Sufficient decrease of the residual norm; the first point has nothing to be compared with. A better
            # integrator sees errors that the one before did not.
            slack = 100.0 * current * math.sqrt(n) if wanted < current < np.inf else 0.0
            if math.sqrt(norm) <= (1.0 - damping / 2.0) * math.sqrt(best_norm) + slack and norm < np.inf:
                break
            if iteration == 0:
                log[0] = np.inf
                return DIVERGED, iteration, np.inf, np.inf, work
            damping /= 2.0
            if damping < SMALLEST_DAMPING:
                z[:] = best
                # The last row belongs to an iterate that was not reached.
                return STALLED, iteration - 1, best_residual, cost, work
            for i in range(n):
                start[n + i] = best[n + i] + damping * best_rhs[i]
        previous = best_residual
        best[:] = start
        z_end[:] = trial
        best_norm, best_residual, cost, current = norm, residual, trial_cost, wanted
        hint = following
        log[iteration, 0] = residual
        log[iteration, 1] = cost
        best_jacobian[:] = jacobian
        best_rhs[:] = rhs
        if residual <= tolerance and current <= accuracy:
            z[:] = best
            return CONVERGED, iteration, residual, cost, work
        if residual <= tolerance:  # a guess that is a solution already, maybe a degenerate one: only looked at again
            wanted = accuracy
            continue
        # An error of the integrator here is what remains of the residual in the end.
        wanted = min(current, max(accuracy, 0.01 * residual**3))
        if not solve_dense(best_jacobian, best_rhs):
            z[:] = best
            return SINGULAR, iteration, residual, cost, work
        # What convergence of order two makes of the residual.
        foreseen = max(residual / previous**2, STEEPEST) * residual**2 if damping == 1.0 else np.inf
        if foreseen <= SAFETY * tolerance and current <= accuracy:
            z[:] = best
            for i in range(n):
                z[n + i] += best_rhs[i]
                # dJ*/dq_f = -lambda(T); a free component's costate is as small as the residual.
                if not free[i]:
                    cost -= trial[n + i] * (goal[i] - trial[i])
            for i in range(2 * n):
                for j in range(n):
                    z_end[i] += S[i, j] * best_rhs[j]
            return CONVERGED, iteration, foreseen, cost, work
        damping = min(1.0, 2.0 * damping)
        for i in range(n):
            start[n + i] = best[n + i] + damping * best_rhs[i]
    z[:] = best
    return MAX_ITERATIONS, max_iterations, best_residual, cost, work
