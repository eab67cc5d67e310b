"""Solution of one optimal control problem by one method."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any, Literal

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import (
    as_matrix,
    as_vector,
    check_at_least,
    check_choice,
    check_integer,
    check_positive,
)
from leapnav.experts.hard_limits import BARRIER_TOLERANCE, fitted_weight, follow_limit, softened
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.problem.certificate import failure
from leapnav.experts.problem.extremal import Extremal, SolveError, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory, as_problem
from leapnav.experts.search.initial_guess import initial_guess
from leapnav.experts.solvers.collocation import collocation
from leapnav.experts.solvers.initial_paths import first_barrier_weight, initial_paths
from leapnav.experts.solvers.leapfrog import leapfrog
from leapnav.experts.solvers.multiple_shooting import multiple_shooting
from leapnav.experts.solvers.nodes import SolverOptions, path_of
from leapnav.experts.solvers.single_shooting import single_shooting
from leapnav.experts.spacetime.clock import with_clock
from leapnav.experts.transcription.direct import mean_running_cost

Method = Literal["single_shooting", "multiple_shooting", "leapfrog", "collocation"]
Solver = Callable[[OptimalControlProblem, Trajectory, SolverOptions], Extremal]
METHODS: dict[str, Solver] = {
    "single_shooting": single_shooting,
    "multiple_shooting": multiple_shooting,
    "leapfrog": leapfrog,
    "collocation": collocation,
}
# The methods of each option that not all have.
OPTIONS = {
    "segments": ("multiple_shooting", "leapfrog", "collocation"),
    "polish": ("leapfrog", "collocation"),
    "update": ("leapfrog",),
    "order": ("leapfrog",),
}
# Without a guess, at most this number of initial paths is solved, until one costs more than the best extremal by this
# fraction. If all local optima are wanted, all paths are solved until one costs more by the last fraction: the rotation
# of a unicycle by another turn costs ten times as much.
MAX_INITIAL_PATHS, SIMILAR_COST, REACH = 4, 0.05, 19.0
# Searches for initial paths, if all local optima are wanted. With four, the second local optimum of the swing-up of the
# cart-pole (known_problems.json) is missed; 7 of 24 seeds find it.
SEEDS = 6
# Extremals are one if their costs and states agree to these fractions, of the cost and of the largest state.
SAME_COST, SAME_PATH = 1e-6, 1e-3
SAMPLES = 129  # of a path that is compared
# With hard limits, at most this number of first barrier weights is tried, each the last one times this factor.
MAX_FIRST_WEIGHTS, FIRST_WEIGHT_FACTOR = 3, 0.1
# If these fail, the horizon is halved at most this often, and then followed back with at least this fraction of the
# logarithm of the change per step.
MAX_HALVINGS, MIN_STEP = 12, 1 / 64
MIN_INTERVAL = 1e-9  # of the nodes on the way, in units of the horizon: steps of an extremal may end next to each other


def solve(
    problem: OptimalControlProblem | Scenario,
    method: Method = "multiple_shooting",
    guess: Trajectory | Extremal | None = None,
    tol: float = 1e-9,
    max_iterations: int = 60,
    segments: int | None = None,
    *,
    polish: bool | None = None,
    update: Literal["mean_time", "half_cost"] | None = None,
    order: Literal["sequential", "red_black"] | None = None,
    barrier_tolerance: float = BARRIER_TOLERANCE,
    raise_on_failure: bool = False,
) -> Extremal:
    """Solve the boundary value problem of the minimum principle for one certified extremal.

    The result is an extremal close to the guess, not necessarily the global optimum; see `find_optimum`.

    With hard limits (obstacles with the proximity weight 0, state bounds) or a small proximity weight, the method
    solves the problem with a barrier weight, and its extremal is followed to the limit, see
    `leapnav.experts.hard_limits`.
    A problem with a `barrier_weight` of its own is solved as it is.

    Args:
        problem: an optimal control problem, or a scenario.
        method: "multiple_shooting", "single_shooting", "leapfrog" or "collocation".
        guess: a path, whose costates are estimated from its motion if it has none, or an extremal, possibly of a
            problem with another horizon, goal or obstacle. Its duration is the guess of a free horizon. None: for a
            scenario the best path of the lattice search, improved by direct transcription; for a problem the cheapest
            of several local minima over piecewise constant controls, including neighbouring windings of the goal
            angles.
        tol: largest residual of the boundary and continuity conditions. The certificate requires 1e-8 in any case.
        max_iterations: maximum number of Newton steps.
        segments: number of shooting segments, of Leapfrog segments or of intervals of the first collocation mesh; not
            for single shooting. None derives it from the guess, and lets multiple shooting subdivide segments where
            necessary.
        polish: for Leapfrog and collocation: finish with multiple-shooting Newton steps, which is much faster; the
            default. False: Leapfrog removes nodes until one sub-problem spans the whole problem, and collocation
            iterates to `tol`.
        update: for Leapfrog: where a node is placed on the extremal of its sub-problem, at the "mean_time" of the
            neighbouring nodes (the default), or at the "half_cost".
        order: for Leapfrog: order of the nodes in a sweep, "sequential" (the default), or "red_black": first those with
            odd index, which are independent of each other, and then those with even index.
        barrier_tolerance: with hard limits, largest integral of the barrier as a fraction of the cost.
        raise_on_failure: raise an exception instead of returning a failure.

    Returns:
        An `Extremal` whose status is based on its certificate.

    Raises:
        ValueError, TypeError: an argument is invalid, or not one of the method; the message names it.
        SolveError: no success with `raise_on_failure`; the attribute `extremal` is the failed result.

    """
    options = _options(method, tol, max_iterations, segments, polish, update, order)
    check_positive("barrier_tolerance", barrier_tolerance)
    ocp = as_problem(problem)
    solver = METHODS[method]
    if guess is not None:
        ocp, path, options = _from_guess(ocp, guess, options)
        extremal = _solve_softened(solver, ocp, guess, path, options)
    elif ocp.horizon is None and ocp.starts_at_goal:
        extremal = failure(ocp, Status.ZERO_HORIZON)
    elif isinstance(problem, Scenario):
        found = initial_guess(problem, ocp)
        extremal = failure(ocp, Status.NO_PATH) if found is None else solver(*found, options)
    else:
        extremal = _without_guess(solver, ocp, options, barrier_tolerance)[0]
    is_followed = guess is None and not isinstance(problem, Scenario)  # by `_without_guess`
    if extremal.success and extremal.problem.barrier_weight > ocp.barrier_weight and not is_followed:
        extremal = follow_limit(extremal, ocp.proximity_weight, barrier_tolerance)
    if raise_on_failure and not extremal.success:
        raise SolveError(extremal, problem.name if isinstance(problem, Scenario) else "")
    return extremal


def _solve_softened(
    solver: Solver,
    problem: OptimalControlProblem,
    guess: Trajectory | Extremal,
    path: Trajectory,
    options: SolverOptions,
) -> Extremal:
    """Solve with the barrier weight that suits a guess: its own if it has one, or that of a first extremal."""
    if problem.barrier_weight > 0.0:
        return solver(problem, path, options)
    if isinstance(guess, Extremal) and guess.problem.barrier_weight > 0.0:
        weight = guess.problem.barrier_weight if problem.has_hard_limits else 0.0
        return solver(problem.with_barrier(weight), path, options)
    energy = mean_running_cost(problem, path)
    weight = fitted_weight(problem, path, energy) if problem.has_hard_limits else None
    if weight is not None:
        extremal = solver(problem.with_barrier(weight), path, options)
        if extremal.success:
            return extremal
    return solver(softened(problem, energy), path, options)


def local_optima(problem: OptimalControlProblem, barrier_tolerance: float = BARRIER_TOLERANCE) -> list[Extremal]:
    """Find local optima of a problem by multiple shooting from all initial paths.

    Args:
        problem: an optimal control problem.
        barrier_tolerance: with hard limits, largest integral of the barrier as a fraction of the cost.

    Returns:
        The distinct certified extremals in order of cost. If there are none, one failure.

    """
    if problem.horizon is None and problem.starts_at_goal:
        return [failure(problem, Status.ZERO_HORIZON)]
    distinct: list[Extremal] = []
    for extremal in _without_guess(multiple_shooting, problem, SolverOptions(), barrier_tolerance, best_only=False):
        if not any(_is_same(extremal, other) for other in distinct):
            distinct.append(extremal)
    return distinct


def _is_same(extremal: Extremal, other: Extremal) -> bool:
    """Return whether two extremals have the same cost and path; the paths of mirror images differ."""
    if abs(extremal.cost - other.cost) > SAME_COST * abs(other.cost):
        return False
    fractions, n = np.linspace(0.0, 1.0, SAMPLES), extremal.problem.system.n
    states, others = (one.interpolate(fractions * one.horizon)[:, :n] for one in (extremal, other))
    return bool(np.abs(states - others).max() <= SAME_PATH * (1.0 + np.abs(others).max()))


def _without_guess(
    solver: Solver, problem: OptimalControlProblem, options: SolverOptions, tolerance: float, best_only: bool = True
) -> list[Extremal]:
    """Return the certified extremals in order of cost, followed to the limit if there are hard limits; or one failure.

    A large weight can turn a saddle of the limit into a minimum, such as a straight beam between walls under a load
    that makes it buckle. On the way to the limit it becomes a saddle again. Then a smaller first weight is tried.

    Args:
        solver, problem, options: the method, the problem and the options.
        tolerance: largest integral of the barrier as a fraction of the cost.
        best_only: whether only initial paths of similar cost are solved, and only the best extremal is followed.

    """
    if not problem.has_hard_limits or problem.barrier_weight > 0.0:
        return _from_nothing(solver, problem, options, best_only)
    weight, failed = first_barrier_weight(problem), []
    for _ in range(MAX_FIRST_WEIGHTS):
        found = _from_nothing(solver, problem.with_barrier(weight), options, best_only)
        if found[0].success:
            followed = found[:1] if best_only else found
            found = [follow_limit(extremal, problem.proximity_weight, tolerance) for extremal in followed]
        reached = sorted((extremal for extremal in found if extremal.success), key=lambda extremal: extremal.cost)
        if reached:
            return reached
        failed += found[:1]
        if failed[-1].status not in (Status.STALLED, Status.CONJUGATE_POINT):
            break
        weight *= FIRST_WEIGHT_FACTOR
    return failed[:1]


def _from_nothing(
    solver: Solver, problem: OptimalControlProblem, options: SolverOptions, best_only: bool
) -> list[Extremal]:
    """Return the successes from initial paths in order of cost, or from the straight line or shorter horizons.

    If all fail, one failure is returned.
    """
    found, failed = _from_initial_paths(solver, problem, options, best_only)
    if found:
        return found
    line = problem.straight_line()
    failed.append(solver(problem.with_winding_of(line.states), line, options))
    if failed[-1].success:
        return failed[-1:]
    # A failure that converged is more informative.
    converged = [extremal for extremal in failed if _has_converged(extremal)]
    if not converged and problem.horizon is not None and options.segments is None:
        lengthened = _from_shorter_horizons(solver, problem, options)
        if lengthened is not None:
            return [lengthened]
    return (converged or failed)[:1]


def _has_converged(extremal: Extremal) -> bool:
    """Whether a failure is an extremal, but not certified."""
    certificate = extremal.certificate
    if extremal.status is Status.SINGULAR and certificate is not None:
        return max(certificate.residual, certificate.defect) <= certificate.TOLERANCE
    return extremal.status in (Status.CONJUGATE_POINT, Status.TIME_NOT_MINIMAL, Status.COLLISION)


def _from_initial_paths(
    solver: Solver, problem: OptimalControlProblem, options: SolverOptions, best_only: bool = True
) -> tuple[list[Extremal], list[Extremal]]:
    """Return the successes from the initial paths in order of cost, and the failures."""
    found: list[Extremal] = []
    failed: list[Extremal] = []
    paths = islice(initial_paths(problem), MAX_INITIAL_PATHS) if best_only else initial_paths(problem, range(SEEDS))
    reach = SIMILAR_COST if best_only else REACH
    for cost, wound, path in paths:
        lowest = min((one.cost for one in found), default=math.inf)
        if cost > lowest + reach * abs(lowest):
            break
        extremal = solver(wound, path, options)
        (found if extremal.success else failed).append(extremal)
    return sorted(found, key=lambda extremal: extremal.cost), failed


def _from_shorter_horizons(
    solver: Solver,
    problem: OptimalControlProblem,
    options: SolverOptions,
) -> Extremal | None:
    """The extremal that is followed from a shorter horizon, for which there is an initial path.

    Over a horizon that is much longer than the time scales of the system, the steps of an initial path are too long,
    and the flow is too sensitive for the nodes of a guess to be far from the solution.
    """
    horizon = problem.fixed_horizon
    for halvings in range(1, MAX_HALVINGS + 1):
        factor = 2.0**halvings
        found, _ = _from_initial_paths(solver, problem.with_horizon(horizon / factor), options)
        if found:
            break
    else:
        return None

    def lengthen(fraction: float, guess: Extremal) -> Extremal | None:
        longer = guess.problem.with_horizon(horizon * factor ** (fraction - 1.0))
        times = guess.times * (longer.fixed_horizon / guess.horizon)
        times[-1] = longer.fixed_horizon  # exactly
        distinct = np.concatenate([[True], np.diff(times)[1:] > MIN_INTERVAL * times[-1], [True]])
        path = Trajectory(times, guess.states, guess.costates)
        extremal = solver(longer, path, replace(options, mesh=times[distinct], subdivide=False))
        return extremal if extremal.success else None

    return step_halving(lengthen, found[0], min_step=MIN_STEP)


def _from_guess(
    problem: OptimalControlProblem, guess: Trajectory | Extremal, options: SolverOptions
) -> tuple[OptimalControlProblem, Trajectory, SolverOptions]:
    """Problem with the winding of the guess, initial path, and options."""
    if isinstance(guess, Extremal):
        path, options = path_of(problem, guess, options)
    elif isinstance(guess, Trajectory):
        path = _check_path(guess, problem)
    else:
        raise TypeError(f"guess: expected a Trajectory or an Extremal, got {type(guess).__name__}")
    return problem.with_winding_of(path.states), path, options


def _options(
    method: str, tol: float, max_iterations: int, segments: int | None, polish: bool | None, update: Any, order: Any
) -> SolverOptions:
    check_choice("method", method, METHODS)
    check_positive("tol", tol)
    check_at_least("max_iterations", max_iterations, 1)
    if segments is not None:
        segments = check_integer("segments", segments, 1)
    for name, value in (("segments", segments), ("polish", polish), ("update", update), ("order", order)):
        if value is not None and method not in OPTIONS[name]:
            raise ValueError(f"{name}: expected none for the method {method!r}, got {value!r}")
    polish, update, order = polish is not False, update or "mean_time", order or "sequential"
    check_choice("update", update, ("mean_time", "half_cost"))
    check_choice("order", order, ("sequential", "red_black"))
    return SolverOptions(tol, max_iterations, segments, None, segments is None, polish, update, order)


def _check_path(guess: Trajectory, problem: OptimalControlProblem) -> Trajectory:
    """The guess as arrays of floats."""
    n, guess = problem.system.n, with_clock(problem, guess)
    times = as_vector("guess.times", guess.times)
    states = as_matrix("guess.states", guess.states, len(times), n)
    costates = None if guess.costates is None else as_matrix("guess.costates", guess.costates, len(times), n)
    path = Trajectory(times, states, costates)
    if len(times) < 2 or not np.all(np.diff(times) > 0):
        raise ValueError("guess: its times must be an increasing array of at least two")
    horizon = problem.horizon_of(path)
    if abs(times[0]) > 1e-6 * horizon or abs(times[-1] - horizon) > 1e-6 * horizon:
        raise ValueError(f"guess: its times must run from 0 to {horizon:g}, not {times[0]:g} to {times[-1]:g}")
    return path
