"""Minimum time: the limit of small control weights, with bounded controls.

With the time weight 1 and the control weights r / u_max^2 the cost is the time plus a control cost of at most r m / 2
per second, so that the optimum for r takes at most 1 + r m / 2 times the minimum time. The controls are saturated
except during transitions whose duration decreases with r, and on singular arcs (A. E. Bryson and Y.-C. Ho, Applied
Optimal Control, 1975, sections 3.9 and 8.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_positive
from leapnav.experts.continuation import continuation
from leapnav.experts.hard_limits import follow_limit, without_barrier
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem.extremal import Extremal, SolveError
from leapnav.experts.problem.problem import OptimalControlProblem, as_problem
from leapnav.experts.solve import Method, solve
from leapnav.experts.solvers.initial_paths import initial_paths

FIRST_WEIGHT, WEIGHT_FACTOR = 1.0, 0.25  # r of the first problem, and its factor from one problem to the next
MAX_PATHS = 4  # local optima that are followed
METHODS: tuple[Method, ...] = ("multiple_shooting", "collocation")  # in this order; the others fail where these do
POINTS = 4001  # at which the controls are examined
MIN_PIECE = 0.01  # fraction of the time; shorter pieces are transitions


@dataclass(frozen=True, eq=False)
class MinimumTime:
    """The result of `minimum_time`.

    Attributes:
        extremal: the extremal for the smallest control weights.
        horizon: its duration (s), an upper bound of the minimum time.
        tolerance: the duration exceeds the minimum by at most this fraction, if the extremal is the global optimum for
            its control weights. It is larger than the requested one if no method solved a problem with smaller weights.
        lower_bound: a lower bound of the minimum time (s) under the same condition; NaN with a state cost, state bounds
            or obstacles, for which no such bound is known.
        switching_times: (S,), times (s) at which a control changes between its lower bound, 0 and its upper bound.
        levels: (S + 1, m), the controls between these times: the bound that is closest, or 0.

    """

    extremal: Extremal
    horizon: float
    tolerance: float
    lower_bound: float
    switching_times: np.ndarray
    levels: np.ndarray


def minimum_time(problem: OptimalControlProblem | Scenario, tol: float = 1e-3) -> MinimumTime:
    """Find a path of minimum time with bounded controls, by continuation to small control weights.

    The horizon, the control weights and the time weight of the problem are ignored. A state cost and the proximity cost
    of obstacles are kept: the cost is the time plus their integral. With hard limits it is the time.

    Args:
        problem: a problem with control bounds, or a scenario.
        tol: the control weights decrease until the duration exceeds the minimum time by at most this fraction, in
            (0, 1). `MinimumTime.tolerance` is the fraction that was reached.

    Returns:
        The path, and when its controls switch.

    Raises:
        TypeError: it is neither a problem nor a scenario.
        ValueError: a control has no finite bounds, or `tol` is invalid.
        SolveError: no path was found; the attribute `extremal` is the failed result.

    """
    check_positive("tol", tol)
    if not tol < 1:
        raise ValueError(f"tol: expected a number below 1, got {tol!r}")
    ocp = as_problem(problem)
    bounds = np.array(ocp.control_bounds if ocp.control_bounds is not None else [(-np.inf, np.inf)])
    if not np.isfinite(bounds).all():
        raise ValueError(f"control_bounds: expected finite numbers, got {ocp.control_bounds!r}")
    weights = list(_weights(tol, len(bounds)))
    problems = [_with_weight(ocp, bounds, weight) for weight in weights]
    followed = [_follow(start, problems) for start in _first(problem, problems[0])]
    ends = [end for end in followed if end.solved]
    if not ends:
        raise SolveError(followed[0].extremal, problem.name if isinstance(problem, Scenario) else "")
    has_state_cost = ocp.field is not None or ocp.state_cost != 0 or ocp.has_hard_limits
    if has_state_cost:  # the durations alone do not rank the paths, and the control costs have different weights
        best = min(ends, key=lambda end: _cost_without_controls(end.extremal))
    else:
        best = min(ends, key=lambda end: end.extremal.horizon)
    tolerance = 0.5 * len(bounds) * weights[best.solved - 1]
    lower_bound = np.nan if has_state_cost else best.extremal.cost / (1.0 + tolerance)
    structure = switching_structure(best.extremal, bounds)
    return MinimumTime(best.extremal, best.extremal.horizon, tolerance, lower_bound, *structure)


class _End(NamedTuple):
    """The end of a continuation: the extremal of the last of the `solved` problems, or the failure of the first."""

    extremal: Extremal
    solved: int


def _cost_without_controls(extremal: Extremal) -> float:
    """Return the time plus the integral of the state cost and the proximity cost."""
    times = np.linspace(0.0, extremal.horizon, POINTS)
    rates = 0.5 * extremal.evaluate(times)[1] ** 2 @ np.array(extremal.problem.control_weight)
    return extremal.cost - float(np.trapezoid(rates, times))


def _weights(tol: float, m: int) -> Iterator[float]:
    """Yield r of each problem; the last one gives the tolerance."""
    weight, last = FIRST_WEIGHT, 2.0 * tol / m
    while weight > last:
        yield weight
        weight *= WEIGHT_FACTOR
    yield last


def _with_weight(problem: OptimalControlProblem, bounds: np.ndarray, weight: float) -> OptimalControlProblem:
    """Return the problem with a free horizon and control weights of at most `weight` / 2 per second and control."""
    control_weight = tuple((weight / np.abs(bounds).max(axis=1) ** 2).tolist())
    return replace(problem, horizon=None, time_weight=1.0, control_weight=control_weight)


def _first(given: OptimalControlProblem | Scenario, problem: OptimalControlProblem) -> Sequence[Extremal]:
    """Return the extremals from which the continuations start, or a failure; those of a scenario have its weights."""
    if not isinstance(given, Scenario):
        starts = islice(initial_paths(problem), MAX_PATHS)
        found = [solve(wound, "multiple_shooting", guess=path) for wound, path in starts]
        return [extremal for extremal in found if extremal.success] or [solve(problem)]
    free = given.model_copy(update={"horizon": None, "cost": given.cost.model_copy(update={"time_weight": 1.0})})
    optimum = find_optimum(free)
    return [optimum, *optimum.alternatives][:MAX_PATHS]


def _follow(start: Extremal, problems: Sequence[OptimalControlProblem]) -> _End:
    """Solve the problems one after the other, up to the first that no method solves, with the winding of the start.

    With hard limits, all have the barrier weight of the start.
    """
    if not start.success:
        return _End(start, 0)
    barrier = start.problem.barrier_weight
    remaining = [replace(problem, goal=start.problem.goal, barrier_weight=barrier) for problem in problems]
    extremal, failed = start, start
    for method in METHODS:
        # The problem of the guess is the first of the sequence, so that the step control applies to the second.
        _, *found = continuation([extremal.problem, *remaining], method, guess=extremal)
        solved = [one for one in found if one.success]
        extremal, failed = (solved or [extremal])[-1], (found or [start])[-1]
        remaining = remaining[len(solved) :]
        if not remaining:
            break
    count = len(problems) - len(remaining)
    return _End(_limit(extremal) if count else failed, count)


def _limit(extremal: Extremal) -> Extremal:
    """Return the extremal close to the limit of hard limits; with the barrier that it has if that is not reached."""
    limit = follow_limit(extremal)
    return limit if limit.success else without_barrier(extremal)


def switching_structure(extremal: Extremal, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the switching times (S,) (s) and the levels (S + 1, m) of the controls of an extremal.

    Args:
        extremal: the extremal.
        bounds: (m, 2), the lower and upper bounds of the controls.

    """
    times = np.linspace(0.0, extremal.horizon, POINTS)
    controls = extremal.evaluate(times)[1]
    levels = np.stack([bounds[:, 0], np.clip(0.0, bounds[:, 0], bounds[:, 1]), bounds[:, 1]], axis=1)
    nearest = np.abs(controls[:, :, None] - levels[None]).argmin(axis=2)
    first = np.append(0, np.flatnonzero((np.diff(nearest, axis=0) != 0).any(axis=1)) + 1)
    last = np.append(first[1:], POINTS) - 1
    lengths = last - first + 1
    long = lengths >= min(MIN_PIECE * POINTS, lengths.max())
    first, last = first[long], last[long]
    # Pieces on both sides of a transition may be the same.
    starts = np.append(True, (nearest[first[1:]] != nearest[first[:-1]]).any(axis=1))
    ends = np.append(starts[1:], True)
    switching_times = 0.5 * (times[last[ends][:-1]] + times[first[starts][1:]])
    chosen = nearest[first[starts]]
    return switching_times, np.take_along_axis(levels[None], chosen[:, :, None], axis=2)[:, :, 0]
