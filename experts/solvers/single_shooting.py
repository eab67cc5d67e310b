"""Single shooting: Newton's method on the initial costate, with the exact Jacobian from the sensitivity equations."""

from __future__ import annotations

import numpy as np

from leapnav.experts.numerics.flow import EndCondition, NewtonOptions
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.multiple_shooting import confirm, polish
from leapnav.experts.solvers.newton import CONVERGED, solve_arc
from leapnav.experts.solvers.nodes import SolverOptions, first_mesh, start_nodes

# Fraction of the horizon over which the continuation improves a guess, and its first and smallest step, as fractions of
# that.
CONTINUED_FRACTION, FIRST_STEP, MIN_STEP = 7 / 8, 1 / 7, 1 / 112
CONTINUATION_TOLERANCE = 1e-7


def single_shooting(problem: OptimalControlProblem, path: Trajectory, options: SolverOptions) -> Extremal:
    """Solve by Newton's method on the initial costate: multiple shooting with one segment.

    If the guess is too poor for the whole horizon, it is first improved by continuation in the horizon, with points of
    the path as goals.
    """
    guess = start_nodes(problem, path, first_mesh(path, options))[1][0]
    times, nodes = segment(problem, guess, problem.horizon_of(path))
    status, history, evaluations = polish(problem, times, nodes, options.tol, options.max_iterations)
    if status is not Status.SUCCESS:
        improved, count = _continue_in_horizon(problem, path, guess, options)
        evaluations += count
        if improved is not None:
            second_times, second = segment(problem, improved, problem.horizon_of(path))
            status, rows, count = polish(problem, second_times, second, options.tol, options.max_iterations)
            history += rows
            evaluations += count
            if status is Status.SUCCESS:
                times, nodes = second_times, second
    return confirm(problem, times, nodes, status, history, evaluations, options)


def segment(problem: OptimalControlProblem, guess: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times (2,) and nodes (2, 2n) of one segment from a guess of its start (2n,)."""
    arrays, nodes = problem.arrays, np.stack([guess, guess])
    nodes[1, : problem.system.n] = np.where(arrays.free, guess[: problem.system.n], arrays.goal)
    return np.array([0.0, duration]), nodes


def _continue_in_horizon(
    problem: OptimalControlProblem, path: Trajectory, guess: np.ndarray, options: SolverOptions
) -> tuple[np.ndarray | None, int]:
    """Return the start (2n,) of an extremal to a late point of the path, or None, and the evaluations of the flow."""
    flow, n, horizon = problem.arrays.flow, problem.system.n, problem.horizon_of(path)
    fixed = np.zeros(n, dtype=bool)
    newton = NewtonOptions(CONTINUATION_TOLERANCE, CONTINUATION_TOLERANCE * 1e-3, options.max_iterations)
    evaluations = 0

    def shoot_to(fraction: float, z: np.ndarray) -> np.ndarray | None:
        nonlocal evaluations
        trial, time = z.copy(), CONTINUED_FRACTION * fraction * horizon
        end = EndCondition(path.resample(np.array([time])).states[0], fixed, False)
        code, _, count = solve_arc(flow, trial, end, time, newton, z.copy())
        evaluations += count
        return trial if code == CONVERGED else None

    found = step_halving(shoot_to, guess, first_step=FIRST_STEP, max_step=FIRST_STEP, min_step=MIN_STEP)
    return found, evaluations
