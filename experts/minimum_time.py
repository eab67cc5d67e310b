"""Minimum time: the limit of small control weights, with bounded controls.

With the time weight 1 and the control weights r / u_max^2 the cost is the time plus at most r m / 2 per second, so that
the optimum for r takes at most 1 + r m / 2 times the minimum time. The controls are saturated except during transitions
whose duration decreases with r, and on singular arcs (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975,
sections 3.9 and 8.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_positive
from leapnav.experts.continuation import continuation
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
        horizon: its duration (s), an upper bound of the minimum time. It exceeds the minimum by more than the tolerance
            if the continuation stopped early, because no method solved a problem with smaller weights.
        lower_bound: a lower bound of the minimum time (s), if the extremal is the global optimum for its control
            weights; NaN with a state cost or obstacles, for which no such bound is known.
        switching_times: (S,), times (s) at which a control changes between its lower bound, 0 and its upper bound.
        levels: (S + 1, m), the controls between these times: the bound that is closest, or 0.

    """

    extremal: Extremal
    horizon: float
    lower_bound: float
    switching_times: np.ndarray
    levels: np.ndarray


def minimum_time(task: OptimalControlProblem | Scenario, tol: float = 1e-3) -> MinimumTime:
    """Find a path of minimum time with bounded controls, by continuation to small control weights.

    The horizon, the control weights and the time weight of the task are ignored. A state cost and the proximity cost of
    obstacles are kept: the cost is the time plus their integral.

    Args:
        task: a problem with control bounds, or a scenario.
        tol: the duration exceeds the minimum time by at most this fraction, in (0, 1).

    Returns:
        The path, and when its controls switch.

    Raises:
        TypeError: the task is neither a problem nor a scenario.
        ValueError: a control has no finite bounds, or `tol` is invalid.
        SolveError: no path was found; the attribute `extremal` is the failed result.

    """
    check_positive("tol", tol)
    if not tol < 1:
        raise ValueError(f"tol: expected a number below 1, got {tol!r}")
    problem = as_problem(task)
    bounds = np.array(problem.control_bounds if problem.control_bounds is not None else [(-np.inf, np.inf)])
    if not np.isfinite(bounds).all():
        raise ValueError(f"control_bounds: expected finite numbers, got {problem.control_bounds!r}")
    weights = list(_weights(tol, len(bounds)))
    problems = [_with_weight(problem, bounds, weight) for weight in weights]
    starts = _first(task, problems[0])
    found = [_follow(problems, start) for start in starts if start.success]
    ends = [(path[-1], weights[len(path) - 1]) for path in found if path]
    if not ends:
        raise SolveError(starts[0], task.name if isinstance(task, Scenario) else "")
    best, weight = min(ends, key=lambda end: end[0].cost)
    has_state_cost = problem.field is not None or problem.state_cost != 0
    lower_bound = np.nan if has_state_cost else best.cost / (1.0 + 0.5 * len(bounds) * weight)
    return MinimumTime(best, best.horizon, lower_bound, *switching_structure(best, bounds))


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


def _first(task: OptimalControlProblem | Scenario, problem: OptimalControlProblem) -> Sequence[Extremal]:
    """Return the extremals of the first problem that are followed; a failure if there are none."""
    if not isinstance(task, Scenario):
        starts = islice(initial_paths(problem), MAX_PATHS)
        found = [solve(wound, "multiple_shooting", guess=path) for wound, path in starts]
        return [extremal for extremal in found if extremal.success] or [solve(problem)]
    free = task.model_copy(update={"horizon": None, "cost": task.cost.model_copy(update={"time_weight": 1.0})})
    optimum = find_optimum(free)
    return [optimum, *optimum.alternatives][:MAX_PATHS]


def _follow(problems: Sequence[OptimalControlProblem], start: Extremal) -> list[Extremal]:
    """Return the extremals of the problems up to the first failure of all methods, with the winding of the first."""
    remaining = [replace(problem, goal=start.problem.goal) for problem in problems]
    path: list[Extremal] = []
    for method in METHODS:
        solved = continuation(remaining, method, guess=path[-1] if path else start)
        path += [extremal for extremal in solved if extremal.success]
        remaining = remaining[sum(extremal.success for extremal in solved) :]
        if not remaining:
            break
    return path


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
    starts = np.append(0, np.flatnonzero((np.diff(nearest, axis=0) != 0).any(axis=1)) + 1)
    lengths = np.diff(np.append(starts, POINTS))
    starts = starts[lengths >= MIN_PIECE * POINTS]
    kept = nearest[starts + np.minimum(lengths[lengths >= MIN_PIECE * POINTS] // 2, POINTS - 1 - starts)]
    changed = np.append(True, (np.diff(kept, axis=0) != 0).any(axis=1))
    starts, kept = starts[changed], kept[changed]
    return times[starts[1:]], np.take_along_axis(levels[None], kept[:, :, None], axis=2)[:, :, 0]
