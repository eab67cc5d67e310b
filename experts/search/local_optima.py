"""The local optima of a scenario: from candidate paths to certified extremals.

Each candidate path goes through the same steps, and ends in one `Verdict`:

1. Direct transcription with a relaxed barrier, which moves a path that cuts into obstacles out of them. A path that
   remains in an obstacle is given up, and one that comes close to an earlier one is a duplicate.
2. Direct transcription with the barrier itself, and again on halved intervals. Duplicates of earlier paths, and paths
   that cost more than the best extremal, end here.
3. Multiple shooting and its certificate.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from leapnav.envs.field.clearance import footprint_clearances, path_clearance
from leapnav.envs.robots import Box
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.hard_limits import LARGEST_REDUCTION, SEARCH_WEIGHT, expected_limit, softened, without_barrier
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Iteration, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.lifting import Lifting
from leapnav.experts.search.path_class import SeenPaths, shape_of
from leapnav.experts.solvers.multiple_shooting import confirm, polish_in_stages
from leapnav.experts.solvers.nodes import SolverOptions
from leapnav.experts.transcription.adaptive import INTERVALS_PER_SEGMENT, settled_attempts
from leapnav.experts.transcription.descent import KnownPaths
from leapnav.experts.transcription.direct import MAX_VIOLATION, RELAXED_DISTANCE, DirectPath, discretise, optimise

TOLERANCE = 1e-9
# Newton steps of a candidate, and of a manoeuvre, whose Hamiltonian changes abruptly at contacts.
# With 14 for candidates, 1.4 times as many evaluations in 93 difficult scenarios; with 25 about the same.
NEWTON_ITERATIONS, MANOEUVRE_ITERATIONS = 20, 60
MIN_SEGMENTS = 8  # of multiple shooting from a refined direct path
FINER_ATTEMPTS = 2  # on halved and quartered intervals, where the first attempt fails
UNCONFIRMED = Status.NOT_CERTIFIED, Status.STALLED, Status.MAX_ITERATIONS  # of a solution that is not accurate enough
# A long path, some place of which is too coarse: number of intervals above which it is one, further refinements, and
# then intervals per segment.
LONG_PATH, REFINEMENTS_OF_LONG_PATH, INTERVALS_PER_SEGMENT_OF_LONG_PATH = 2048, 2, 3
# Two paths are duplicates if they stay within this distance of each other (m, and rad for the heading) ...
DUPLICATE_DISTANCE = 0.15
# Fraction of this distance within which a descent ends close to an earlier result. Of two paths within the distance,
# the one that costs less is kept; with the fraction 1 it would be lost in 1 of 32 scenarios of the car.
KNOWN_FRACTION = 1 / 3
# ... and two extremals are duplicates if, in addition, their costs agree to this relative tolerance.
DUPLICATE_COST_TOLERANCE = 1e-6
SHORT_DISTANCE = 4.0  # m from start to goal; below it, the distance of duplicates is reduced in proportion
# Relative error of the cost of a direct path, and of a refined direct path. Among 6,000 refined paths, six exceeded the
# cost of their extremal by more; these were different extremals from the closest ones.
DIRECT_ERROR, REFINED_ERROR = 0.01, 0.002
# Free horizon: factor and largest number of lengthenings of a path that the limits make infeasible. Without them, 11 of
# 93 difficult optima are not found.
LENGTHENING, MAX_LENGTHENED = 1.25, 3
LIMIT_TOLERANCE = 1e-3  # relative; a control is at its limit within this tolerance
RELAXED_WEIGHT = 2.0  # proximity weight of the relaxed barrier, at least, in units of E
# Of a path that is still in collision with the relaxed barrier: distances (proximity scales), see `optimise`.
STEEPER_DISTANCES = (0.05, 0.005)
# Depth (robot radii) in an obstacle at which a path of the relaxed transcription is given up. The points of a coarse
# path may be this deep although the extremal is not.
COLLISION_DEPTH = 0.2
# Longest step of a refined path relative to clearance + proximity scale, and largest number of parts of an interval.
# With 0.5, 1.06 times as many evaluations, and Newton's method stalls on a path of 350 m through doors of 1 m.
RESOLUTION, MAX_PIECES = 0.25, 64
# Factor of the proximity scale in this for a rectangle, whose corners turn the direction of the distance abruptly. With
# 1, a rectangle does not pass a gap that is 4 % wider; with 0.05, the search there takes three times as long.
CORNER_RESOLUTION = 0.2


class Outcome(Enum):
    """What became of a candidate path."""

    CERTIFIED = "a certified extremal"
    REFUSED = "an extremal whose certificate does not hold"
    STALLED = "Newton's method did not converge"
    COLLISION = "the path remains in an obstacle"
    EXPENSIVE = "the path costs more than the best extremal"
    DUPLICATE = "the path is a duplicate of an earlier one"


class Verdict(NamedTuple):
    """The end of a candidate path.

    Attributes:
        outcome: what became of it.
        problem: its problem, with the winding of the path.
        path: the last direct path.
        extremal: the extremal, if there is one.
        limit: of a certified extremal, the cost that is expected without the barrier.

    """

    outcome: Outcome
    problem: OptimalControlProblem
    path: DirectPath
    extremal: Extremal | None = None
    limit: float = math.inf

    @property
    def cost(self) -> float:
        """J of the extremal or of the direct path."""
        return self.path.cost if self.extremal is None else self.extremal.cost

    def as_extremal(self) -> Extremal:
        """Return the extremal; without one, the direct path as an extremal with the status STALLED."""
        if self.extremal is not None:
            return self.extremal
        nodes = np.concatenate([self.path.states, self.path.costates], axis=1)
        return certify(self.problem, self.path.times, nodes, Status.STALLED)


class LocalOptima:
    """The local optima found so far in a scenario.

    Args:
        scenario: the scenario.
        problem: its optimal control problem. If its proximity weight is small, the local optima are those of the
            problem with a barrier weight, see `softened`.
        energy: E of the shortest paths of the lattice, see `leapnav.experts.search.candidates`.
        budget: evaluations of the flow that may be spent on paths that cost more than the best extremal.
        sharpness: factor by which the intervals near obstacles are shorter than usual.

    Attributes:
        verdicts: the ends of all candidate paths.

    """

    def __init__(
        self,
        scenario: Scenario,
        problem: OptimalControlProblem,
        energy: float,
        budget: float = math.inf,
        sharpness: float = 1.0,
    ) -> None:
        self.scenario, self.problem = scenario, softened(problem, energy, SEARCH_WEIGHT)
        self.verdicts: list[Verdict] = []
        self._energy, self._relaxed_weight, self._budget = energy, RELAXED_WEIGHT * energy, budget
        self._radius = float(scenario.outline[:, 2:4].sum(axis=1).min())  # of the smallest disc inside
        has_corners = isinstance(scenario.robot.footprint, Box)
        self._scale = scenario.cost.proximity_scale * (CORNER_RESOLUTION if has_corners else 1.0) / sharpness
        self._lift = Lifting(scenario, self.problem, self._relaxed_weight)
        self._bounds = scenario.robot.control_bounds()
        self._wound: dict[tuple[float | None, ...], OptimalControlProblem] = {}  # by the goal
        self._found: list[tuple[Extremal, np.ndarray]] = []  # the distinct extremals, with their shapes
        distance = DUPLICATE_DISTANCE * min(1.0, math.dist(scenario.start[:2], scenario.goal[:2]) / SHORT_DISTANCE)
        self._seen = SeenPaths(distance)
        self._relaxed = SeenPaths(KNOWN_FRACTION * distance)  # local optima with the relaxed barrier
        self._lowest_settled = math.inf  # lowest cost of a path that was retried on adaptive meshes

    @property
    def certified(self) -> list[Extremal]:
        """The certified extremals."""
        return [v.extremal for v in self.verdicts if v.outcome is Outcome.CERTIFIED and v.extremal is not None]

    @property
    def best(self) -> Extremal:
        """The certified extremal of minimum cost."""
        return min(self.certified, key=lambda extremal: extremal.cost)

    @property
    def best_failure(self) -> Extremal | None:
        """The most informative failure: the one of minimum cost among the extremals, or else among the paths."""
        for outcome in (Outcome.REFUSED, Outcome.STALLED, Outcome.COLLISION):
            failed = [verdict for verdict in self.verdicts if verdict.outcome is outcome]
            if failed:
                return min(failed, key=lambda verdict: verdict.cost).as_extremal()
        return None

    def doubts(self, cost: float) -> tuple[Extremal, ...]:
        """Return the solutions that cost less than `cost` and are not certified; see `Optimum`."""
        failed = [verdict for verdict in self.verdicts if verdict.outcome in (Outcome.REFUSED, Outcome.STALLED)]
        errors = {Outcome.REFUSED: 0.0, Outcome.STALLED: DIRECT_ERROR}
        return tuple(
            verdict.as_extremal()
            for verdict in failed
            if verdict.cost < cost * (1 - errors[verdict.outcome]) and verdict.path.violation < MAX_VIOLATION
        )

    def add(self, paths: Iterable[Trajectory]) -> None:
        """Compute the local optima of candidate paths, in order of the cost of their direct paths."""
        self.solve(self.transcribe(paths))

    def transcribe(self, paths: Iterable[Trajectory]) -> list[tuple[OptimalControlProblem, DirectPath]]:
        """Return the direct paths of candidate paths, with their problems, without those in collision."""
        found = []
        for path in paths:
            lifted = self._lift(path)
            if lifted is not None:
                problem, relaxed = self._relax(lifted)
                if relaxed.known:
                    self.verdicts.append(Verdict(Outcome.DUPLICATE, problem, relaxed))
                elif self._clearance(relaxed) < -COLLISION_DEPTH * self._radius:
                    self.verdicts.append(Verdict(Outcome.COLLISION, problem, relaxed))
                else:
                    if relaxed.converged:
                        self._relaxed.add(shape_of(relaxed.times, relaxed.states))
                    found.append((problem, self._tighten(problem, relaxed)))
        return found

    def transcribe_one(self, path: Trajectory) -> tuple[OptimalControlProblem, DirectPath]:
        """Return the direct path of the first candidate path, also if it is in collision."""
        lifted = self._lift(path)
        assert lifted is not None  # only duplicates are not lifted
        problem, relaxed = self._relax(lifted)
        return problem, self._tighten(problem, relaxed)

    def _relax(self, path: Trajectory) -> tuple[OptimalControlProblem, DirectPath]:
        """Return the direct path of a path with the relaxed barrier, with its problem."""
        problem = self._with_winding(path.states)
        # With a free horizon, paths of the same shape may differ in their durations.
        known = None if problem.horizon is None else self._relaxed.known
        relaxed = self._optimise(problem, discretise(problem, path), RELAXED_DISTANCE, known)
        return problem, relaxed

    def _with_winding(self, states: np.ndarray) -> OptimalControlProblem:
        """Return the problem with the winding of a path."""
        goal = self.problem.wound_goal(states)
        if goal not in self._wound:
            self._wound[goal] = self.problem.with_winding_of(states)
        return self._wound[goal]

    def _tighten(self, problem: OptimalControlProblem, relaxed: DirectPath) -> DirectPath:
        """Return the direct path with the barrier itself, unless the refinement makes this step."""
        cleared = self._clear(problem, relaxed)
        return self._optimise(problem, cleared) if problem.proximity_weight < self._relaxed_weight else cleared

    def _clear(self, problem: OptimalControlProblem, path: DirectPath) -> DirectPath:
        """Return a path that is in collision, perhaps between its points, after descents with steeper barriers."""
        for distance in STEEPER_DISTANCES:
            if self._clearance(path) > 0.0:
                break
            path = self._optimise(problem, path, distance)
        return path

    def solve(self, transcribed: Sequence[tuple[OptimalControlProblem, DirectPath]]) -> None:
        """Compute the extremals of direct paths, in order of their costs."""
        for problem, direct in sorted(transcribed, key=lambda entry: entry[1].cost):
            self.verdicts.append(self._judge(problem, direct))
        self._retry(self.verdicts[len(self.verdicts) - len(transcribed) :])

    def lowest_cost(self, transcribed: Sequence[tuple[OptimalControlProblem, DirectPath]]) -> float:
        """Return the lowest cost of the certified extremals and of direct paths that are likely to lead to one."""
        costs = [extremal.cost for extremal in self.certified]
        for _, path in transcribed:
            if path.converged and path.violation < MAX_VIOLATION and self._clearance(path) > 0.0:
                costs.append(path.cost)
        return min(costs, default=math.inf)

    def add_manoeuvres(self, guesses: Iterable[DirectPath]) -> bool:
        """Compute the local optima of paths free of contact, on adaptive meshes; return whether there are any."""
        pairs = [(self._with_winding(guess.states), guess) for guess in guesses]
        found = [self._add_extremal(*pair, settled_attempts(*pair, self._energy)) for pair in pairs]
        return any(found)

    def _add_extremal(
        self, problem: OptimalControlProblem, path: DirectPath, attempts: Iterable[tuple[int, DirectPath]]
    ) -> bool:
        """Compute the extremal of a path in several attempts, and return whether it is certified."""
        extremal, _ = self._extremal(problem, attempts, max_iterations=MANOEUVRE_ITERATIONS)
        if extremal is not None:
            self.verdicts.append(self._verdict(problem, path, extremal))
        return extremal is not None and extremal.success

    def _retry(self, last: Sequence[Verdict]) -> None:
        """Retry paths at which Newton's method stalled: all until one is certified, then the cheapest one."""
        for verdict in sorted(filter(self._is_retried, last), key=lambda verdict: verdict.cost):
            if not self.certified:
                self._add_extremal(verdict.problem, verdict.path, self._finer(verdict.problem, verdict.path))
        best = min(filter(self._is_retried, self.verdicts), key=lambda verdict: verdict.cost, default=None)
        if self.certified and best is not None and not self._is_expensive(best.path, -DIRECT_ERROR):
            self._lowest_settled = best.cost
            settled = settled_attempts(best.problem, best.path, self._energy)
            self._add_extremal(best.problem, best.path, itertools.chain(self._finer(best.problem, best.path), settled))

    def _is_retried(self, verdict: Verdict) -> bool:
        is_new = verdict.outcome is Outcome.STALLED and verdict.cost < self._lowest_settled
        return is_new and self._clearance(verdict.path) > 0.0

    def _finer(self, problem: OptimalControlProblem, path: DirectPath) -> Iterator[tuple[int, DirectPath]]:
        """Yield numbers of segments of multiple shooting, each with the path on shorter intervals."""
        for _ in range(FINER_ATTEMPTS):
            path = self._optimise(problem, path.refined())
            yield _segments(path), path

    def refine(self, problem: OptimalControlProblem, direct: DirectPath) -> DirectPath:
        """Return the optimum on shorter intervals, of a free horizon with a better duration."""
        refined = direct.refined(self._pieces(direct))
        if problem.horizon is None and direct.converged:
            refined = refined.scaled(direct.time_factor(problem))
        return self._optimise(problem, self._clear(problem, refined))

    def _optimise(
        self,
        problem: OptimalControlProblem,
        guess: DirectPath,
        relaxed_distance: float | None = None,
        known: KnownPaths | None = None,
    ) -> DirectPath:
        """Return the local optimum of the discretised problem; a free horizon is lengthened if the limits need it."""
        weight = None if relaxed_distance is None else self._relaxed_weight
        path = optimise(problem, guess, relaxed_weight=weight, relaxed_distance=relaxed_distance, known=known)
        if problem.horizon is None:
            for _ in range(MAX_LENGTHENED):
                # Otherwise more time would not help: the path is feasible, or the descent is slow.
                if (path.converged and path.violation < MAX_VIOLATION) or not self._is_limited(path):
                    break
                guess = guess.scaled(LENGTHENING)
                path = optimise(problem, guess, relaxed_weight=weight, relaxed_distance=relaxed_distance)
        return path

    def _is_limited(self, path: DirectPath) -> bool:
        """Return whether controls are at their limits somewhere on a path."""
        slack = LIMIT_TOLERANCE * np.abs(self._bounds).max(axis=1)
        return bool(((path.controls < self._bounds[:, 0] + slack) | (path.controls > self._bounds[:, 1] - slack)).any())

    def _judge(self, problem: OptimalControlProblem, direct: DirectPath) -> Verdict:
        """Compute the extremal of a direct path, unless the path is a duplicate or unlikely to lead to a useful one."""
        shape = shape_of(direct.times, direct.states)
        if self._seen.contain(shape):
            return Verdict(Outcome.DUPLICATE, problem, direct)
        if self._is_discarded(direct, DIRECT_ERROR):
            return Verdict(Outcome.EXPENSIVE, problem, direct)
        # Where the cost is flat, duplicates of an optimum are recognised only after refinement.
        refined = self.refine(problem, direct)
        refined_shape = shape_of(refined.times, refined.states)
        is_duplicate = self._seen.contain(refined_shape)
        self._seen.add(shape, refined_shape)
        if is_duplicate:
            return Verdict(Outcome.DUPLICATE, problem, refined)
        if self._is_discarded(refined, REFINED_ERROR):
            return Verdict(Outcome.EXPENSIVE, problem, refined)
        if self._clearance(refined) <= 0.0:
            return Verdict(Outcome.COLLISION, problem, refined)
        return self._solve(problem, refined)

    def _is_discarded(self, path: DirectPath, error: float) -> bool:
        """Return whether a path is not worth solving; `error` is the relative error of its cost."""
        if not self._is_expensive(path, error):
            return False
        return not path.converged or self._budget <= 0 or self._clearance(path) <= 0

    def _solve(self, problem: OptimalControlProblem, refined: DirectPath) -> Verdict:
        """Compute the extremal of a refined path."""
        # At tight limits a direct path may violate its constraints, but Newton's method sometimes converges from it.
        is_feasible = refined.violation < MAX_VIOLATION
        is_expensive = self._is_expensive(refined, REFINED_ERROR)
        extremal, evaluations = None, 0
        if is_feasible or not self.certified:
            for _ in range(REFINEMENTS_OF_LONG_PATH if len(refined.controls) > LONG_PATH else 0):
                refined = self._optimise(problem, refined.refined())
            extremal, evaluations = self._extremal(problem, [(_segments(refined), refined)], self._found)
        if is_expensive:
            self._budget -= evaluations
        return self._verdict(problem, refined, extremal)

    def _verdict(self, problem: OptimalControlProblem, path: DirectPath, extremal: Extremal | None) -> Verdict:
        """Return the end of a path with its extremal."""
        if extremal is None:
            return Verdict(Outcome.STALLED, problem, path)
        shape = shape_of(extremal.times, extremal.states)
        if self._is_known(extremal, shape):
            return Verdict(Outcome.DUPLICATE, problem, path, extremal)
        self._found.append((extremal, shape))
        self._seen.add(shape)
        if not extremal.success:
            return Verdict(Outcome.REFUSED, problem, path, extremal)
        return Verdict(Outcome.CERTIFIED, problem, path, extremal, expected_limit(without_barrier(extremal)))

    def _extremal(
        self,
        problem: OptimalControlProblem,
        attempts: Iterable[tuple[int, DirectPath]],
        known: Sequence[tuple[Extremal, np.ndarray]] = (),
        max_iterations: int = NEWTON_ITERATIONS,
    ) -> tuple[Extremal | None, int]:
        """Apply multiple shooting in several attempts, until one succeeds or a path is close to a known extremal.

        Returns the extremal, or None, and the number of evaluations of the flow.
        """
        history: tuple[Iteration, ...] = ()
        total, refused = 0, None
        for segments, direct in attempts:
            for extremal, shape in known:
                if self._seen.are_close(shape_of(direct.times, direct.states), shape):
                    return extremal, total
            times, nodes = direct.nodes(problem, segments)
            status, rows, evaluations = polish_in_stages(problem, times, nodes, TOLERANCE, max_iterations)
            history += rows
            total += evaluations
            if status is Status.SUCCESS:
                options = SolverOptions(TOLERANCE, max_iterations)
                found = confirm(problem, times, nodes, status, history, total, options)
                if found.status in UNCONFIRMED:  # on shorter segments, integration errors grow less
                    refused = found
                elif len(found.times):  # otherwise re-integration diverged
                    return found, total
        return refused, total

    def _pieces(self, path: DirectPath) -> np.ndarray:
        """Return the numbers of parts (N,), at least 2, into which the intervals of a path are divided.

        In a narrow passage, where the proximity cost is high, a path can be so fast that it crosses the passage within
        one interval. The intervals there are divided into steps that resolve the proximity cost.
        """
        middles = 0.5 * (path.states[1:] + path.states[:-1])
        clearance = footprint_clearances(middles, self.scenario.outline, self.scenario.field)
        steps = np.hypot(*np.diff(path.states[:, :2], axis=0).T)
        resolved = RESOLUTION * (np.maximum(clearance, 0.0) + self._scale)
        return np.ceil(steps / resolved).astype(int).clip(2, MAX_PIECES)

    def _clearance(self, path: DirectPath) -> float:
        """Return the smallest clearance (m) along a path."""
        return path_clearance(path.states, self.scenario.outline, self.scenario.field)

    def _is_expensive(self, path: DirectPath, error: float) -> bool:
        """Return whether a path costs more than the best extremal, apart from the relative error of its cost.

        With a barrier weight, the costs in the limit are compared: the expected one of the extremal, and the lowest
        possible one of the path.
        """
        best = min((verdict.limit for verdict in self.verdicts), default=math.inf)
        if best == math.inf:
            return False
        cost = path.cost
        if self.problem.barrier_weight > 0.0:
            barrier = float(np.trapezoid(self.problem.barrier_cost(path.states), path.times))
            cost -= LARGEST_REDUCTION * barrier
        return cost > (1 + error) * best

    def _is_known(self, extremal: Extremal, shape: np.ndarray) -> bool:
        """Return whether an extremal is a duplicate of an earlier one."""
        for other, other_shape in self._found:
            is_same_cost = abs(extremal.cost - other.cost) <= DUPLICATE_COST_TOLERANCE * abs(other.cost)
            if is_same_cost and self._seen.are_close(shape, other_shape):
                return True
        return False


def _segments(path: DirectPath) -> int:
    """Return the number of segments of multiple shooting from a path."""
    intervals, is_long = len(path.controls), len(path.controls) > LONG_PATH * 2**REFINEMENTS_OF_LONG_PATH
    length = INTERVALS_PER_SEGMENT_OF_LONG_PATH if is_long else INTERVALS_PER_SEGMENT
    return max(round(intervals / length), MIN_SEGMENTS)
