"""Multiple shooting: Newton's method on (q, lam) at all nodes, with a banded matrix solved in O(segments)."""

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
from leapnav.experts.linear import solve_banded
from leapnav.experts.nodes import Settings, default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.single_shooting import LOOSEST, MARGIN, SAFETY, SMALLEST_DAMPING, STEEPEST

flags = types.Array(boolean, 1, "C")
# Newton's method goes on to a residual this much below the one asked for, so that H is constant to about as much; one
# that it cannot lower any further may be as large. The integrator is more accurate than that.
ACCURACY = 0.1
# Sensitivities grow along a segment; where by more than this, Newton's method loses half its digits.
LARGEST_GROWTH = 1e4
REFINEMENTS, MOST_SEGMENTS = 6, 20_000


def multiple_shooting(problem: OptimalControlProblem, path: Path, settings: Settings) -> Extremal:
    """Newton's method on states and costates at all nodes.

    If it fails, segments over which the flow is too sensitive, or all of them if none is, are divided, and it is tried
    again from the same path.
    """
    times, nodes = start_nodes(problem, path, settings.segments or default_segments(path))
    status, history, work = polish(problem, times, nodes, settings.tol, settings.max_iterations)
    for _ in range(REFINEMENTS):
        if status is Status.SUCCESS or settings.segments is not None:
            break
        times, evaluations = _refine(problem, path, times)
        work += evaluations
        if len(times) > MOST_SEGMENTS:
            break
        times, nodes = start_nodes(problem, path, times)
        status, rows, evaluations = polish(problem, times, nodes, settings.tol, settings.max_iterations)
        history += rows
        work += evaluations
    return confirm(problem, times, nodes, status, history, work, settings)


def confirm(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    status: Status,
    history: tuple[Iteration, ...],
    work: int,
    settings: Settings,
) -> Extremal:
    """Certifies polished nodes; where re-integration does not confirm a residual that was only foreseen, goes on."""
    extremal = certify(problem, times, nodes, status, history, work)
    if extremal.status is not Status.NOT_CERTIFIED:
        return extremal
    status, rows, more = polish(problem, times, nodes, settings.tol, settings.max_iterations, foresee=False)
    return certify(problem, times, nodes, status, history + rows, work + more)


def polish(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    tol: float,
    max_iterations: int,
    foresee: bool = True,
) -> tuple[Status, tuple[Iteration, ...], int]:
    """Multiple-shooting Newton on the nodes, in place: (status, a row per iterate, evaluations of the flow).

    With `foresee` the last iterate is not evaluated where quadratic convergence tells its residual.
    """
    arrays = problem.arrays
    costs = np.empty(len(times) - 1)
    log = np.zeros((max_iterations + 1, 3))
    code, iterations, _, work = newton(
        arrays.flow,
        times,
        nodes,
        arrays.start,
        arrays.goal,
        arrays.free,
        arrays.data,
        arrays.field,
        MARGIN * tol,
        MARGIN * tol * ACCURACY,
        max_iterations,
        foresee,
        costs,
        log,
    )
    rows = tuple(Iteration("newton", len(costs), row[1], row[0]) for row in log[: iterations + 1].tolist())
    return KERNEL_STATUS[code], rows, work


def _refine(problem: OptimalControlProblem, path: Path, times: np.ndarray) -> tuple[np.ndarray, int]:
    """More nodes: where the flow from the path's own nodes is too sensitive, else twice as many."""
    arrays = problem.arrays
    times, nodes = start_nodes(problem, path, times)
    growth = np.empty(len(times) - 1)
    work = _growth(arrays.flow, times, nodes, arrays.data, arrays.field, growth)
    # Growth is exponential in time, so its logarithm says how many pieces are needed; a diverged flow says nothing.
    with np.errstate(divide="ignore"):
        pieces = np.where(np.isfinite(growth), np.ceil(np.log(growth) / np.log(LARGEST_GROWTH)), 4).clip(1, 8)
    pieces = pieces.astype(int)
    if pieces.max() == 1:
        pieces[:] = 2
    first = np.repeat(times[:-1], pieces)
    number = np.concatenate([np.arange(count) for count in pieces])
    return np.append(first + number * np.repeat(np.diff(times) / pieces, pieces), times[-1]), work


@njit(
    int64(FLOW, vector, matrix, constant, constant, vector),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _growth(flow, times, Z, data, field, growth):
    """Fills `growth` (segments,) with the largest sensitivity over each segment, infinite where the flow diverged."""
    size = Z.shape[1]
    S = np.empty((size, size))
    work = 0
    for k in range(len(times) - 1):
        z = Z[k].copy()
        S[:] = 0.0
        for i in range(size):
            S[i, i] = 1.0
        _, _, _, evaluations = propagate(flow, z, S, times[k + 1] - times[k], data, field, LOOSEST, 0.0, False)
        work += abs(evaluations)
        growth[k] = np.abs(S).max() if evaluations > 0 else np.inf
    return work


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
        work += abs(steps)
        if steps < 0:
            return np.inf, np.inf, work
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
        FLOW,
        vector,
        matrix,
        vector,
        vector,
        flags,
        constant,
        constant,
        float64,
        float64,
        int64,
        boolean,
        vector,
        matrix,
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def newton(flow, times, Z, start, goal, free, data, field, tolerance, accuracy, max_iterations, foresee, costs, log):
    """Damped Newton on the nodes Z (segments + 1, 2n), in place; `costs` (segments,) becomes the cost of each segment.

    `log` (max_iterations + 1, 3) receives residual, cost and damping of each iterate but a last one whose residual is
    foreseen. The integrator is as accurate as the current residual deserves, and `accuracy` at the end. A residual of
    tolerance / MARGIN is accepted where no step decreases it (the certificate has the last word). Returns (status,
    iterations, residual, evaluations).
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
    current = max(accuracy, LOOSEST)
    norm, residual, work = _residual(flow, times, Z, start, goal, free, data, field, current, rows, rhs, costs, hint)
    if norm == np.inf:
        return DIVERGED, 0, np.inf, work
    damping, before = 1.0, 0.0
    for iteration in range(max_iterations + 1):
        log[iteration, 0] = residual
        log[iteration, 1] = costs.sum()
        log[iteration, 2] = damping
        if residual <= tolerance and current > accuracy:  # a guess that is a solution already, maybe a degenerate one
            current = accuracy
            norm, residual, more = _residual(
                flow, times, Z, start, goal, free, data, field, current, rows, rhs, costs, hint
            )
            work += more
            log[iteration, 0] = residual
        if residual <= tolerance and current <= accuracy:
            return CONVERGED, iteration, residual, work
        if iteration == max_iterations:
            break
        if not solve_banded(rows, rhs, half):
            return SINGULAR, iteration, residual, work
        step = rhs.copy()
        # What convergence of order two makes of the residual; the certificate integrates the result in any case.
        following = max(residual / before**2, STEEPEST) * residual**2 if damping == 1.0 and before > 0.0 else np.inf
        if foresee and following <= SAFETY * tolerance and current <= accuracy:
            for k in range(segments + 1):
                for i in range(2 * n):
                    Z[k, i] += step[2 * n * k + i]
            return CONVERGED, iteration, following, work
        # An error of the integrator here is what remains of the residual in the end.
        wanted = accuracy if residual < 1e-2 else min(current, max(accuracy, 0.01 * residual**3))
        damping = min(1.0, 2.0 * damping)
        while True:
            for k in range(segments + 1):
                for i in range(2 * n):
                    trial[k, i] = Z[k, i] + damping * step[2 * n * k + i]
            trial_hint[:] = hint
            trial_norm, trial_residual, more = _residual(
                flow, times, trial, start, goal, free, data, field, wanted, rows, rhs, trial_costs, trial_hint
            )
            work += more
            # A better integrator sees errors that the one before did not.
            slack = 100.0 * current * math.sqrt(unknowns) if wanted < current else 0.0
            if math.sqrt(trial_norm) <= (1.0 - damping / 4.0) * math.sqrt(norm) + slack:
                break
            # At the level of the integration errors no step decreases the residual any more.
            if residual <= tolerance / MARGIN and current <= accuracy:
                return CONVERGED, iteration, residual, work
            damping /= 2.0
            if damping < SMALLEST_DAMPING:
                return STALLED, iteration, residual, work
        Z[:] = trial
        hint[:] = trial_hint
        costs[:] = trial_costs
        before = residual
        norm, residual, current = trial_norm, trial_residual, wanted
    return MAX_ITERATIONS, max_iterations, residual, work
