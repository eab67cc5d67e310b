"""Single shooting: Newton's method on the initial costate, with the exact Jacobian from the sensitivity equations."""

from __future__ import annotations

import numpy as np

from leapnav.experts.numerics.flow import EndCondition, NewtonOptions
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Iteration, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.newton import CONVERGED, MARGIN, solve_costate
from leapnav.experts.solvers.nodes import SolverOptions, default_segments, start_nodes
from leapnav.experts.solvers.outcome import KERNEL_STATUS

# Fraction of the horizon over which the continuation improves a guess, and its first and smallest step, as fractions of
# that.
CONTINUED_FRACTION, FIRST_STEP, MIN_STEP = 7 / 8, 1 / 7, 1 / 112
CONTINUATION_TOLERANCE = 1e-7
MIN_ACCURACY = 1e-13  # smallest tolerance of the integrator, close to rounding level


def single_shooting(problem: OptimalControlProblem, path: Trajectory, options: SolverOptions) -> Extremal:
    """Solve by Newton's method on the initial costate.

    If the guess is too poor for the whole horizon, it is first improved by continuation in the horizon, with points of
    the path as goals.
    """
    nodes = start_nodes(problem, path, options.segments or default_segments(path))[1]
    duration = problem.horizon_of(path)
    z, end, time, status, history, evaluations = _shoot(problem, nodes[0], duration, options)
    if status is not Status.SUCCESS:
        improved, count = _continue_in_horizon(problem, path, nodes[0], options)
        evaluations += count
        if improved is not None:
            second, second_end, second_time, status, rows, count = _shoot(problem, improved, duration, options)
            history += rows
            evaluations += count
            if status is Status.SUCCESS:
                z, end, time = second, second_end, second_time
    return certify(problem, np.array([0.0, time]), np.stack([z, end]), status, history, evaluations)


def _shoot(
    problem: OptimalControlProblem, guess: np.ndarray, duration: float, options: SolverOptions
) -> tuple[np.ndarray, np.ndarray, float, Status, tuple[Iteration, ...], int]:
    """Return start and end (2n,) of the extremal from a guess of the start and the duration (s).

    They are followed by the duration, status, history and evaluations.
    """
    arrays = problem.arrays
    z, z_end, time = guess.copy(), guess.copy(), np.array([duration])
    log = np.zeros((options.max_iterations + 1, 2))
    # The integration errors of all steps accumulate over the whole horizon.
    accuracy = max(options.tol * 1e-5, MIN_ACCURACY)
    newton = NewtonOptions(MARGIN * options.tol, accuracy, options.max_iterations)
    code, iterations, residual, _, evaluations = solve_costate(arrays.flow, z, arrays.end, time, newton, z_end, log)
    history = tuple(Iteration("newton", 1, row[1], row[0]) for row in log[: iterations + 1].tolist())
    status = Status.SUCCESS if residual <= options.tol else KERNEL_STATUS[code]
    return z, z_end, float(time[0]), status, history, evaluations


def _continue_in_horizon(
    problem: OptimalControlProblem, path: Trajectory, guess: np.ndarray, options: SolverOptions
) -> tuple[np.ndarray | None, int]:
    """Return the start (2n,) of an extremal to a late point of the path, or None, and the evaluations of the flow."""
    arrays, n, horizon = problem.arrays, problem.system.n, problem.horizon_of(path)
    log = np.empty((options.max_iterations + 1, 2))
    fixed = np.zeros(n, dtype=bool)
    newton = NewtonOptions(CONTINUATION_TOLERANCE, CONTINUATION_TOLERANCE * 1e-3, options.max_iterations)
    evaluations = 0

    def shoot_to(fraction: float, z: np.ndarray) -> np.ndarray | None:
        nonlocal evaluations
        trial, z_end, time = z.copy(), z.copy(), CONTINUED_FRACTION * fraction * horizon
        end = EndCondition(path.resample(np.array([time])).states[0], fixed, False)
        code, _, _, _, count = solve_costate(arrays.flow, trial, end, np.array([time]), newton, z_end, log)
        evaluations += count
        return trial if code == CONVERGED else None

    found = step_halving(shoot_to, guess, first_step=FIRST_STEP, max_step=FIRST_STEP, min_step=MIN_STEP)
    return found, evaluations
