"""Minimum time: the limit of small control weights, with bounded controls.

With the time weight 1 and the control weights r / u_max^2 the cost is the time plus a control cost of at most r m / 2
per second, so that the optimum for r takes at most 1 + r m / 2 times the minimum time. The controls are saturated
except during transitions whose duration decreases with r, and on singular arcs (A. E. Bryson and Y.-C. Ho, Applied
Optimal Control, 1975, sections 3.9 and 8.3).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_positive
from leapnav.experts.continuation import continuation
from leapnav.experts.control_weights import INTERVALS, continued, is_free, limit_of, next_extremal, transcribed
from leapnav.experts.optimum import Optimum, find_optimum
from leapnav.experts.problem.extremal import Extremal, SolveError
from leapnav.experts.problem.problem import OptimalControlProblem, as_problem
from leapnav.experts.search.structure import Piece, format_pieces, pieces_of
from leapnav.experts.solve import solve
from leapnav.experts.solvers.initial_paths import initial_paths
from leapnav.experts.solvers.piecewise import PiecewisePath, piecewise_paths

FIRST_WEIGHT, WEIGHT_FACTOR = 1.0, 0.25  # r of the first problem, and its factor from one problem to the next
START_ORDER = (2, 1, 0)  # problems in which paths of few pieces are solved first
MAX_PATHS = 4  # local optima that are followed
# Barrier weights (s per second) of hard limits: of the search, of a second search if the first one does not lead to the
# smallest control weights, and with the first control weights. From the weight at which the barrier is negligible,
# Newton's method stalled at smaller control weights in 3 of 9 tight parking tasks of a dynamic car. A search with 1
# misses the best path of one problem of dynobench, by 20 %; with 0.1, one parking task is not solved.
SEARCH_BARRIERS, FIRST_BARRIER = (0.3, 1.0), 1.0
# Duration of the transcription relative to that of the path: more time makes smooth transitions possible, but a robot
# that cannot slow down may not reach the goal in more time.
LENGTHENINGS = (1.02, 1.005, 1.0)
UNIT_LATTICE = (0.25, 1.0, 1.0)  # cell (m) and weights, which do not matter to whether a robot rotates in place
FAR = 10.0  # proximity scales; the proximity cost of more distant obstacles is negligible
SAME_TIME = 1e-5  # relative difference of the costs of ends that does not matter
SAME_COST = 1e-6  # relative; extremals whose costs agree to this are one, or mirror images
NEGLIGIBLE = 1e-6  # factor of the weights of a scenario
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
        pieces: straight lines, turns and contacts with obstacles; empty if the system has no position and heading.

    """

    extremal: Extremal
    horizon: float
    tolerance: float
    lower_bound: float
    switching_times: np.ndarray
    levels: np.ndarray
    pieces: tuple[Piece, ...]

    def __str__(self) -> str:
        """Return the time, its bounds and the pieces as text; without pieces, the controls between switching times."""
        lines = [f"time {self.horizon:.6g} s, at most {100 * self.tolerance:.2g} % above that of the limit"]
        if self.pieces:
            return "\n".join([*lines, format_pieces(self.pieces)])
        times = np.concatenate([[0.0], self.switching_times, [self.horizon]])
        for first, last, level in zip(times[:-1], times[1:], self.levels, strict=True):
            lines.append(f"{first:10.4f} to {last:10.4f} s: controls {', '.join(f'{value:g}' for value in level)}")
        return "\n".join(lines)


def minimum_time(problem: OptimalControlProblem | Scenario, tol: float = 1e-3) -> MinimumTime:
    """Find a path of minimum time with bounded controls, by continuation to small control weights.

    The horizon, the control weights and the time weight of the problem are ignored. The state cost of a problem and the
    proximity cost of obstacles are kept: the cost is the time plus their integral. For a scenario with hard obstacles
    it is the time, since the state cost of a robot model, such as that of the speed, is made negligible.

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
    ocp = as_problem(_without_motion_cost(problem) if isinstance(problem, Scenario) else problem)
    bounds = np.array(ocp.control_bounds if ocp.control_bounds is not None else [(-np.inf, np.inf)])
    if not np.isfinite(bounds).all():
        raise ValueError(f"control_bounds: expected finite numbers, got {ocp.control_bounds!r}")
    weights = list(_weights(tol, len(bounds)))
    problems = [_with_weight(ocp, bounds, weight) for weight in weights]
    has_state_cost = _has_state_cost(ocp)
    ends = _ends(problem, problems, tol)
    if not ends[0].solved:
        raise SolveError(ends[0].limit, problem.name if isinstance(problem, Scenario) else "")
    lowest = min(map(_limit_cost, ends))
    # Of equal paths, the one with the smallest control weights.
    best = max((end for end in ends if _limit_cost(end) <= lowest * (1.0 + SAME_TIME)), key=lambda end: end.solved)
    best = _finish(best, problems)
    tolerance = 0.5 * len(bounds) * weights[best.solved - 1]
    extremal = best.limit
    lower_bound = np.nan if has_state_cost else extremal.cost / (1.0 + tolerance)
    structure = switching_structure(extremal, bounds)
    return MinimumTime(extremal, extremal.horizon, tolerance, lower_bound, *structure, pieces_of(extremal))


class _Start(NamedTuple):
    """An extremal from which a continuation starts, and the number of problems that it need not solve any more."""

    extremal: Extremal
    solved: int


class _End(NamedTuple):
    """The end of a continuation.

    Attributes:
        extremal: the extremal of the last of the solved problems, or the failure of the first.
        solved: their number.
        limit: with hard limits, the extremal close to their limit; otherwise `extremal`.

    """

    extremal: Extremal
    solved: int
    limit: Extremal


def _ends(given: OptimalControlProblem | Scenario, problems: Sequence[OptimalControlProblem], tol: float) -> list[_End]:
    """Return the ends of the continuations from several extremals; a failure if there is none."""
    found: list[_End] = []
    failed: Extremal | None = None

    def follow(starts: Sequence[_Start], thorough: bool = False) -> None:
        nonlocal failed
        reached: list[_Start] = []
        followed: list[_Start] = []
        for start in sorted(starts, key=lambda start: _lowest_limit(start.extremal)):
            # Of equal extremals, or mirror images, another one is followed if the first one is lost on the way.
            is_new = not any(_is_same(start, one) for one in followed)
            if any(_is_same(start, one) for one in reached) or (is_new and len(followed) == MAX_PATHS):
                continue
            followed += [start] if is_new else []
            end = _follow(start, problems, min(map(_limit_cost, found), default=math.inf), thorough)
            if end.solved == len(problems):
                reached.append(start)
            if end.solved:
                found.append(end)
            else:
                failed = failed or end.extremal

    if isinstance(given, Scenario):
        weight = given.cost.proximity_weight
        optimum = find_optimum(_with_free_horizon(given, weight or SEARCH_BARRIERS[0]))
        follow(_starts_of(optimum))
        if weight == 0.0 and not any(end.solved == len(problems) for end in found):
            follow(_starts_of(find_optimum(_with_free_horizon(given, SEARCH_BARRIERS[1]))))
        # The lattice is accurate for a robot that rotates in place, and paths of few pieces ignore obstacles.
        if not found or (not given.robot.lattice_moves(*UNIT_LATTICE).rotating and _is_far(optimum, given)):
            best = min(map(_limit_cost, found), default=math.inf)
            follow(_from_pieces(problems, best * (1.0 - tol)))
        if not found:
            follow(_starts_of(optimum), thorough=True)
    else:
        follow(_starts(problems))
    if not found:
        failed = failed or solve(problems[0])
        found.append(_End(failed, 0, failed))
    return found


def _is_far(extremal: Extremal, scenario: Scenario) -> bool:
    """Return whether an extremal is far from all obstacles."""
    clearance = None if extremal.certificate is None else extremal.certificate.clearance
    return clearance is not None and clearance > FAR * scenario.cost.proximity_scale


def _without_motion_cost(scenario: Scenario) -> Scenario:
    """Return the scenario with negligible weights of the speed and the turn rate, which are states of some robots."""
    weights = {name: NEGLIGIBLE * getattr(scenario.cost, name) for name in scenario.robot.cost_fields}
    return scenario.model_copy(update={"cost": scenario.cost.model_copy(update=weights)})


def _with_free_horizon(scenario: Scenario, weight: float) -> Scenario:
    """Return the scenario with a free horizon, the time weight 1 and a proximity weight."""
    cost = scenario.cost.model_copy(update={"time_weight": 1.0, "proximity_weight": weight})
    return scenario.model_copy(update={"horizon": None, "cost": cost})


def _starts_of(optimum: Optimum) -> list[_Start]:
    """Return the best local optima of a scenario, from which continuations start."""
    return [_Start(extremal, 0) for extremal in [optimum, *optimum.alternatives][:MAX_PATHS]]


def _limit_cost(end: _End) -> float:
    """Return the time, or with a state cost the time plus its integral.

    Then the durations alone do not rank the paths, and the control costs have different weights.
    """
    extremal = end.limit
    return _cost_without_controls(extremal) if _has_state_cost(extremal.problem) else extremal.horizon


def _has_state_cost(problem: OptimalControlProblem) -> bool:
    """Return whether the cost of a problem contains more than the time and the controls."""
    return problem.field is not None or problem.state_cost != 0 or problem.has_hard_limits


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


def _starts(problems: Sequence[OptimalControlProblem]) -> list[_Start]:
    """Return extremals from which the continuations start."""
    starts = _from_pieces(problems)
    if not starts or _has_state_cost(problems[0]):
        for _, wound, path in islice(initial_paths(problems[0]), MAX_PATHS):
            extremal = solve(wound, "multiple_shooting", guess=path)
            starts += [_Start(extremal, 1)] if extremal.success else []
    return starts


def _from_pieces(problems: Sequence[OptimalControlProblem], max_time: float = math.inf) -> list[_Start]:
    """Return the extremals close to paths of few pieces that take at most a given time (s)."""
    paths = [path for path in piecewise_paths(problems[0]) if path.time < max_time]
    return [start for path in paths if (start := _first(path, problems)) is not None]


def _is_same(start: _Start, other: _Start) -> bool:
    """Return whether two extremals of the same control weights are one, or mirror images."""
    difference = abs(start.extremal.cost - other.extremal.cost)
    return start.solved == other.solved and difference <= SAME_COST * abs(other.extremal.cost)


def _first(path: PiecewisePath, problems: Sequence[OptimalControlProblem]) -> _Start | None:
    """Return the first extremal close to a path of few pieces, and the number of problems before the next one."""
    for index in START_ORDER:
        if index >= len(problems):
            continue
        for lengthening in LENGTHENINGS:
            direct = path.path(INTERVALS, lengthening)
            if not is_free(problems[0], direct.states):
                return None
            extremal = transcribed(problems[index].with_winding_of(direct.states), direct)
            if extremal is not None:
                return _Start(extremal, index + 1)
    return None


def _follow(start: _Start, problems: Sequence[OptimalControlProblem], best: float, thorough: bool) -> _End:
    """Solve the remaining problems one after the other, up to the first that no method solves.

    They have the winding of the start and, with hard limits, its barrier weight, which decreases with the square root
    of the control weights: smooth controls need distance from the obstacles. The continuation ends early, without a
    solved problem, if its limit costs more than `best`. With `thorough`, the first problem may take minutes.
    """
    extremal, count = start
    if not extremal.success:
        return _End(extremal, 0, extremal)
    failed, first = extremal, problems[max(count - 1, 0)].control_weight[0]
    barriers = [extremal.problem.barrier_weight]
    if count == 0 and problems[0].has_hard_limits:
        barriers = [FIRST_BARRIER, extremal.problem.proximity_weight]
    for problem in problems[count:]:
        if _lowest_limit(extremal) > best:
            return _End(extremal, 0, extremal)
        found, following = extremal, problem
        for barrier in barriers:
            decreased = barrier * math.sqrt(problem.control_weight[0] / first)
            following = replace(problem, goal=extremal.problem.goal, barrier_weight=decreased)
            found = next_extremal(extremal, following)
            if found.success:
                barriers = [barrier]
                break
        if not found.success and count == 0 and thorough:
            found = continuation([extremal.problem, following], guess=extremal)[-1]
        if not found.success:
            failed = found
            break
        extremal, count = found, count + 1
    return _End(extremal, count, limit_of(extremal)) if count else _End(failed, 0, failed)


def _finish(end: _End, problems: Sequence[OptimalControlProblem]) -> _End:
    """Solve further problems by collocation, from the last one that multiple shooting has solved."""
    extremal, count, _ = end
    for problem in problems[count:]:
        found = continued(extremal, replace(problem, goal=extremal.problem.goal), "collocation")
        if found is None:
            break
        extremal, count = found, count + 1
    return _End(extremal, count, limit_of(extremal)) if count > end.solved else end


def _lowest_limit(extremal: Extremal) -> float:
    """Return a lower bound of the cost in the limit of small control weights; 0 with hard limits.

    The derivative of the cost with respect to r is the control cost divided by r, which is at most m / 2 times the
    cost. A barrier reduces the cost as its weight decreases, too.
    """
    problem = extremal.problem
    if problem.has_hard_limits or problem.control_bounds is None:
        return 0.0
    largest = np.abs(np.array(problem.control_bounds)).max(axis=1) ** 2
    return extremal.cost * math.exp(-0.5 * float(np.array(problem.control_weight) @ largest))


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
