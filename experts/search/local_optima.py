"""Collection of the local optima of a scenario: from candidate paths to certified extremals.

Direct transcription takes a candidate to a local optimum of the discretised problem. If that is not a duplicate of an
earlier one, it is refined and solved by multiple shooting.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes.clearance import footprint_clearances
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Iteration, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.lattice import TOLERATED_DEPTH, Place
from leapnav.experts.search.lifting import Lifting
from leapnav.experts.solvers.multiple_shooting import confirm, polish
from leapnav.experts.solvers.nodes import SolverOptions
from leapnav.experts.transcription.direct import MAX_ITERATIONS, DirectPath, discretise, optimise

TOLERANCE = 1e-9
COARSE_TOLERANCE = 1e-5  # of the fixed-horizon stage, whose result is the guess of the free-horizon stage
# Newton iterations of the last attempt, and of the attempts before it, after which the path is refined.
NEWTON_ITERATIONS, FIRST_ITERATIONS, EXPENSIVE_ITERATIONS = 25, 14, 10
# Intervals of the refined direct path per segment of multiple shooting, smallest number of segments, and attempts.
INTERVALS_PER_SEGMENT, MIN_SEGMENTS = 8, 8
MAX_ATTEMPTS = 3
# A long refined path: number of intervals above which it is one, attempts that it omits, and intervals per segment.
LONG_PATH, SKIPPED_ATTEMPTS, INTERVALS_PER_SEGMENT_OF_LONG_PATH = 2048, 2, 3
# Two paths are duplicates if they stay within this distance of each other (m, and rad for the heading) ...
DUPLICATE_DISTANCE = 0.15
# ... and two extremals are duplicates if, in addition, their costs agree to this relative tolerance.
DUPLICATE_COST_TOLERANCE = 1e-6
SHORT_DISTANCE = 4.0  # m from start to goal; below it, the distance of duplicates is reduced in proportion
# Relative error of the cost of a direct path, and of a refined direct path. Among 6,000 refined paths, six exceeded the
# cost of their extremal by more; these were different extremals from the closest ones.
DIRECT_ERROR, REFINED_ERROR = 0.01, 0.002
UNCONVERGED_FACTOR = 10.0  # factor of these errors for a path whose iteration has not converged
FAILURE_WEIGHT = 4  # evaluations for an expensive path without an extremal count this many times in the budget
# Free horizon: factor and largest number of lengthenings of a path that the limits make infeasible, largest number of
# changes of the horizon, and the change after which there is no other.
LENGTHENING, MAX_LENGTHENED, MAX_RESCALED, SMALL_CHANGE = 1.25, 3, 4, 0.1
LIMIT_TOLERANCE = 1e-3  # relative; a control is at its limit within this tolerance
# Depth in an obstacle (robot radii) up to which a collision-free path of similar cost may exist close to an extremal.
MAX_SLIGHT_DEPTH = TOLERATED_DEPTH
# A path repeats a failure if it reaches this fraction of the failed path's depth, within this distance (robot radii).
SIMILAR_DEPTH, SAME_PLACE = 0.5, 0.5
MIN_CLOSED_DEPTH = 0.1  # fraction of a slight depth; a place is closed only if the path is deeper there
# Depth (robot radii) of a refined path in an obstacle from which its extremal is in collision, too. The clearances of
# 270 such pairs among dense obstacles increased by 0.023 at most.
COLLIDING_DEPTH = 0.05
MAX_COLLIDING = 4  # places at which the extremal of the cheapest of these paths is computed
MAX_FAILED_EVALUATIONS = 1_000_000  # evaluations of the flow in failed Newton iterations per lattice
MAX_VIOLATION = 1e-3  # sum of the constraint violations of a direct path
COMPARED_FRACTIONS = np.linspace(0.0, 1.0, 65)  # of the horizon, at which paths are compared


class _Failure(NamedTuple):
    """A direct path without a certified extremal."""

    cost: float
    problem: OptimalControlProblem
    path: DirectPath


class LocalOptima:
    """The local optima found so far in a scenario.

    Args:
        scenario: the scenario.
        problem: its optimal control problem.
        budget: evaluations of the flow that may be spent on paths that cost more than the best extremal.

    Attributes:
        certified: certified extremals.
        refused: extremals whose certificate does not hold.
        is_in_time: whether a direct path has met the limits of the robot, perhaps in collision.
        closed_places: places at which unsuccessful paths were deepest in an obstacle.

    """

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem, budget: float = math.inf) -> None:
        self.scenario, self.problem, self._budget = scenario, problem, budget
        self._radius = radius = float(scenario.discs[:, 1].min())
        self._slight_depth = MAX_SLIGHT_DEPTH * radius
        self._lift = Lifting(scenario, problem)
        self._limits = np.array(scenario.robot.limits())
        self._duplicate_distance = DUPLICATE_DISTANCE * min(
            1.0, math.dist(scenario.start[:2], scenario.goal[:2]) / SHORT_DISTANCE
        )
        self._wound: dict[tuple[float | None, ...], OptimalControlProblem] = {}  # by the goal
        self.certified: list[Extremal] = []
        self.refused: list[Extremal] = []
        self.is_in_time = False
        self._seen: list[np.ndarray] = []
        # Paths from which Newton's method did not converge, and paths deep in an obstacle.
        self._stalled: list[_Failure] = []
        self._deep: list[_Failure] = []
        self._colliding: list[_Failure] = []  # refined paths in collision, whose extremals are computed at the end
        self._failed_evaluations = 0
        self._closing = True
        self._place_radius = SAME_PLACE * radius
        self.closed_places: list[Place] = []

    def reset_failure_budget(self) -> None:
        """Reset the count of evaluations in failed Newton iterations, for the candidates of another lattice."""
        self._failed_evaluations = 0

    def reopen_places(self) -> None:
        """Open all closed places and close no more, because the only path may pass close to one of them."""
        self.closed_places, self._closing = [], False

    @property
    def best(self) -> Extremal:
        """The certified extremal of minimum cost."""
        return min(self.certified, key=lambda extremal: extremal.cost)

    def add(self, paths: Iterable[Trajectory]) -> None:
        """Compute the local optima of candidate paths, in order of the cost of their direct paths."""
        self.solve(self.transcribe(paths))

    def transcribe(self, paths: Iterable[Trajectory]) -> list[tuple[OptimalControlProblem, DirectPath]]:
        """Return the direct paths of candidate paths, with their problems."""
        found = []
        for path in paths:
            lifted = self._lift(path)
            if lifted is not None:
                goal = self.problem.wound_goal(lifted.states)
                if goal not in self._wound:
                    self._wound[goal] = self.problem.with_winding_of(lifted.states)
                problem = self._wound[goal]
                found.append((problem, self._optimise(problem, discretise(problem, lifted))))
        return found

    def solve(self, transcribed: Sequence[tuple[OptimalControlProblem, DirectPath]]) -> None:
        """Compute the extremals of direct paths, in order of their costs."""
        for problem, direct in sorted(transcribed, key=lambda entry: entry[1].cost):
            self.add_direct(problem, direct)

    def lowest_cost(self, transcribed: Sequence[tuple[OptimalControlProblem, DirectPath]]) -> float:
        """Return the lowest cost of the certified extremals and of direct paths that are likely to lead to one."""
        costs = [extremal.cost for extremal in self.certified]
        for _, path in transcribed:
            if path.converged and path.violation < MAX_VIOLATION and self._clearances(path).min() > 0.0:
                costs.append(path.cost)
        return min(costs, default=math.inf)

    def _optimise(self, problem: OptimalControlProblem, guess: DirectPath) -> DirectPath:
        """Return the local optimum of the discretised problem; a free horizon is lengthened if the limits need it."""
        is_expensive = math.isfinite(guess.cost) and self._is_expensive(guess, DIRECT_ERROR)
        iterations = EXPENSIVE_ITERATIONS if is_expensive else MAX_ITERATIONS
        scale = self.scenario.cost.speed_weight
        path = optimise(problem, guess, iterations, scale)
        if problem.horizon is None:
            for _ in range(MAX_LENGTHENED):
                # Otherwise more time would not help: the path is feasible, or the descent is slow.
                if (path.converged and path.violation < MAX_VIOLATION) or not self._is_limited(path):
                    break
                guess = guess.scaled(LENGTHENING)
                path = optimise(problem, guess, iterations, scale)
        self.is_in_time = self.is_in_time or (path.converged and path.violation < MAX_VIOLATION)
        return path

    def _is_limited(self, path: DirectPath) -> bool:
        """Return whether controls are at their limits somewhere on a path."""
        return bool((np.abs(path.controls) > (1.0 - LIMIT_TOLERANCE) * self._limits).any())

    def refine(self, problem: OptimalControlProblem, direct: DirectPath) -> DirectPath:
        """Return the optimum on halved intervals; a free horizon is changed until the cost is almost stationary."""
        refined = direct.refined()
        if problem.horizon is not None or not direct.converged:
            return self._optimise(problem, refined)
        for _ in range(MAX_RESCALED):
            factor = direct.time_factor(problem)
            refined = self._optimise(problem, refined.scaled(factor))
            if not refined.converged or abs(factor - 1.0) < SMALL_CHANGE:
                break
            direct = refined
        return refined

    def add_direct(self, problem: OptimalControlProblem, direct: DirectPath) -> None:
        """Compute the extremal of a direct path, unless the path is a duplicate or unlikely to lead to a useful one."""
        shape = _shape(direct.times, direct.states)
        if self._is_seen(shape):
            self._widen_places(direct)
            return
        if self._is_discarded(problem, direct, direct, DIRECT_ERROR):
            return
        # Where the cost is flat, duplicates of an optimum are recognised only after refinement.
        refined = self.refine(problem, direct)
        refined_shape = _shape(refined.times, refined.states)
        is_duplicate = self._is_seen(refined_shape)
        self._seen += [shape, refined_shape]
        if is_duplicate:
            self._widen_places(refined)
            return
        # The refined path has twice as many points, which may show that it passes through a wall.
        if not self._is_discarded(problem, refined, direct, REFINED_ERROR):
            self._solve(problem, refined)

    def _is_discarded(
        self, problem: OptimalControlProblem, path: DirectPath, original: DirectPath, error: float
    ) -> bool:
        """Return whether a path is not worth solving; a path deep in an obstacle is stored as a failure.

        Args:
            problem: the problem of the path.
            path: the path, `original` or its refinement.
            original: the direct path before refinement.
            error: relative error of the cost of `path`.

        """
        clearance = self._clearances(path)
        is_expensive = self._is_expensive(path, error if path.converged else UNCONVERGED_FACTOR * error)
        if is_expensive and (clearance.min() <= 0 or self._budget <= 0 or not path.converged):
            return True
        if self._repeats_failure(path, clearance):
            return True
        if clearance.min() < -2.0 * self._slight_depth:
            self._close_place(path, clearance)
            self._deep.append(_Failure(original.cost, problem, original))
            return True
        return False

    def _solve(self, problem: OptimalControlProblem, refined: DirectPath) -> None:
        """Compute and store the extremal of a refined path, or store the path as a failure."""
        clearance = self._clearances(refined)
        # At tight limits a direct path may violate its constraints, but Newton's method sometimes converges from it.
        is_feasible = refined.violation < MAX_VIOLATION
        if refined.converged and is_feasible and clearance.min() < -COLLIDING_DEPTH * self._radius:
            self._colliding.append(_Failure(refined.cost, problem, refined))
            self._close_place(refined, clearance)
            return
        is_expensive = self._is_expensive(refined, REFINED_ERROR)
        extremal, evaluations = None, 0
        if self._failed_evaluations < MAX_FAILED_EVALUATIONS and (is_feasible or not self.certified):
            extremal, evaluations = self._extremal(problem, refined, clearance.min() >= 0.0)
        if is_expensive:
            self._budget -= evaluations if extremal is not None else FAILURE_WEIGHT * evaluations
        if extremal is None:
            self._failed_evaluations += evaluations
            is_doubt = is_feasible and clearance.min() >= -self._slight_depth
            self._stalled.append(_Failure(refined.cost if is_doubt else np.inf, problem, refined))
            self._close_place(refined, clearance)
        elif not self._is_known(extremal):
            self._seen.append(_shape(extremal.times, extremal.states))
            (self.certified if extremal.success else self.refused).append(extremal)
            if extremal.status is Status.COLLISION:
                self._close_place(refined, clearance)

    def _extremal(
        self, problem: OptimalControlProblem, direct: DirectPath, is_clear: bool = True
    ) -> tuple[Extremal | None, int]:
        """Apply multiple shooting to a direct path, and refine the path as long as that fails.

        Returns the extremal, or None, and the number of evaluations of the flow.
        """
        history: tuple[Iteration, ...] = ()
        total = 0
        n_attempts = MAX_ATTEMPTS if is_clear else MAX_ATTEMPTS - 1  # less effort for a path in collision
        is_expensive = self._is_expensive(direct, REFINED_ERROR)
        if is_expensive:  # not the optimum
            n_attempts = 1
        # On a long path, some place is too coarse for the first attempts.
        first = SKIPPED_ATTEMPTS if len(direct.controls) > LONG_PATH else 0
        for attempt in range(n_attempts + first):
            if attempt > 0:
                direct = self._optimise(problem, direct.refined())
                for extremal in (*self.certified, *self.refused):
                    if self._is_close(_shape(direct.times, direct.states), _shape(extremal.times, extremal.states)):
                        return extremal, total
            if attempt < first:
                continue
            iterations = NEWTON_ITERATIONS if attempt == n_attempts + first - 1 else FIRST_ITERATIONS
            iterations = EXPENSIVE_ITERATIONS if is_expensive else iterations
            times, nodes = _shooting_nodes(problem, direct, 2**attempt)
            status, rows, evaluations = _polish(problem, times, nodes, iterations)
            history += rows
            total += evaluations
            if status is Status.SUCCESS:
                options = SolverOptions(TOLERANCE, iterations)
                found = confirm(problem, times, nodes, status, history, total, options)
                if len(found.times):  # otherwise re-integration diverged
                    return found, total
        return None, total

    def _clearances(self, path: DirectPath) -> np.ndarray:
        """Return the clearance (m) at each point of a path."""
        return footprint_clearances(path.states, self.scenario.discs, self.scenario.field)

    def _is_expensive(self, path: DirectPath, error: float) -> bool:
        """Return whether a path costs more than the best extremal by more than the relative error of its cost."""
        best = self.best.cost if self.certified else np.inf
        return path.cost > (1 + error) * best

    def _close_place(self, path: DirectPath, clearance: np.ndarray) -> None:
        """Close the place where a path is deepest in an obstacle, unless it is closed or the depth is negligible."""
        if self._closing and clearance.min() < -MIN_CLOSED_DEPTH * self._slight_depth:
            x, y = path.states[int(clearance.argmin()), :2].tolist()
            is_slight = clearance.min() >= -self._slight_depth
            close = [p for p in self.closed_places if math.hypot(x - p.x, y - p.y) <= 0.5 * self._place_radius]
            if not any((p.clearance >= -self._slight_depth) == is_slight for p in close):
                self.closed_places.append(Place(x, y, float(clearance.min())))

    def _repeats_failure(self, path: DirectPath, clearance: np.ndarray) -> bool:
        """Return whether a path is in an obstacle at a closed place, where a similar path was unsuccessful."""
        # A slight depth is a possible doubt, see `Optimum`, unless a path of slight depth failed at the same place.
        is_slight = clearance.min() >= -self._slight_depth
        for place in self.closed_places:
            if is_slight and place.clearance < -self._slight_depth:
                continue
            if (clearance[self._is_at(path, place)] <= SIMILAR_DEPTH * place.clearance).any():
                self._widen_places(path)
                return True
        return False

    def _widen_places(self, path: DirectPath) -> None:
        """Widen the closed places on a path: the lattice avoided them, but the optimisation led back to them."""
        self.closed_places = [
            replace(place, wide=place.wide or bool(self._is_at(path, place).any())) for place in self.closed_places
        ]

    def _is_at(self, path: DirectPath, place: Place) -> np.ndarray:
        """Return which points of a path are at a place."""
        return np.hypot(path.states[:, 0] - place.x, path.states[:, 1] - place.y) < self._place_radius

    def _is_seen(self, shape: np.ndarray) -> bool:
        """Return whether a path, given by its `_shape`, is a duplicate of an earlier one."""
        return any(self._is_close(shape, other) for other in self._seen)

    def _is_known(self, extremal: Extremal) -> bool:
        """Return whether an extremal is a duplicate of an earlier one."""
        shape = _shape(extremal.times, extremal.states)
        for other in (*self.certified, *self.refused):
            is_same_cost = abs(extremal.cost - other.cost) <= DUPLICATE_COST_TOLERANCE * abs(other.cost)
            if is_same_cost and self._is_close(shape, _shape(other.times, other.states)):
                return True
        return False

    def _is_close(self, shape: np.ndarray, other: np.ndarray) -> bool:
        return bool(np.abs(shape - other).max() < self._duplicate_distance)

    @property
    def best_failure(self) -> Extremal:
        """The most informative failure, if nothing is certified: an extremal of minimum cost, or a stalled path."""
        if self.refused:
            return min(self.refused, key=lambda extremal: extremal.cost)
        _, problem, direct = min(self._deep or self._stalled, key=lambda failure: failure.cost)
        extremal = self._extremal(problem, self._optimise(problem, direct.refined()))[0] if self._deep else None
        return extremal or _stalled(problem, direct)

    def doubts(self, cost: float) -> tuple[Extremal, ...]:
        """Return the solutions that cost less than `cost` and are not certified; see `Optimum`."""
        refused = [extremal for extremal in self.refused if extremal.cost < cost and self._is_slight(extremal)]
        cheaper = [failure for failure in self._stalled if failure.cost < cost * (1 - DIRECT_ERROR)]
        stalled = [_stalled(failure.problem, failure.path) for failure in cheaper]
        return (*refused, *filter(self._is_slight, stalled))

    def solve_colliding(self) -> None:
        """Compute the extremals of paths in collision that cost less than the best extremal, at different places.

        Without a certified extremal, the one of minimum cost is computed.
        """
        if self.certified:
            cost, max_depth = self.best.cost, self._slight_depth + COLLIDING_DEPTH * self._radius
        else:
            cost, max_depth = min((failure.cost for failure in self._colliding), default=math.inf), math.inf
        solved: list[np.ndarray] = []
        for _, problem, path in sorted(self._colliding, key=lambda failure: failure.cost):
            if len(solved) == MAX_COLLIDING:
                break
            clearance = self._clearances(path)
            place = path.states[int(clearance.argmin()), :2]
            if path.cost > (1 + REFINED_ERROR) * cost or clearance.min() < -max_depth:
                continue
            if any(math.dist(place, other) <= self._place_radius for other in solved):
                continue
            solved.append(place)
            extremal, _ = self._extremal(problem, path, is_clear=False)
            if extremal is None:
                self._stalled.append(_Failure(path.cost, problem, path))
            elif not self._is_known(extremal):
                (self.certified if extremal.success else self.refused).append(extremal)
        self._colliding = []

    def _is_slight(self, extremal: Extremal) -> bool:
        """Return whether a collision-free path of similar cost is possible close to an extremal."""
        clearance = extremal.certificate.clearance if extremal.certificate is not None else None
        return clearance is None or clearance >= -self._slight_depth


def _polish(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, iterations: int
) -> tuple[Status, tuple[Iteration, ...], int]:
    """Apply Newton's method, with a free horizon if necessary in two stages, of which the first keeps the times."""
    first_times, first = times.copy(), nodes.copy()
    status, rows, evaluations = polish(problem, times, nodes, TOLERANCE, iterations)
    if status is Status.SUCCESS or problem.horizon is not None:
        return status, rows, evaluations
    times[:] = first_times
    fixed = problem.with_horizon(float(times[-1]))
    status, more, count = polish(fixed, times, first, COARSE_TOLERANCE, iterations)
    rows, evaluations = rows + more, evaluations + count
    if status is Status.SUCCESS:
        nodes[:] = first
        status, more, count = polish(problem, times, nodes, TOLERANCE, iterations)
        rows, evaluations = rows + more, evaluations + count
    return status, rows, evaluations


def _shooting_nodes(
    problem: OptimalControlProblem, direct: DirectPath, refinement: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and nodes for multiple shooting, chosen from the points of a direct path.

    Args:
        problem: the problem.
        direct: the path.
        refinement: number of its intervals per interval of the first attempt.

    """
    intervals = len(direct.controls)
    per_segment = INTERVALS_PER_SEGMENT if intervals <= LONG_PATH * refinement else INTERVALS_PER_SEGMENT_OF_LONG_PATH
    segments = max(round(intervals / (per_segment * refinement)), MIN_SEGMENTS) * refinement
    at = np.rint(np.linspace(0, intervals, segments + 1)).astype(int)
    times, nodes = direct.times[at], np.concatenate([direct.states[at], direct.costates[at]], axis=1)
    arrays = problem.arrays
    n = problem.system.n
    nodes[-1, :n] = np.where(arrays.free, nodes[-1, :n], arrays.goal)
    return times, nodes


def _stalled(problem: OptimalControlProblem, direct: DirectPath) -> Extremal:
    """Return a direct path from which Newton's method did not converge, as an extremal with status STALLED."""
    nodes = np.concatenate([direct.states, direct.costates], axis=1)
    return certify(problem, direct.times, nodes, Status.STALLED)


def _shape(times: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the poses of a path at fixed fractions of the horizon, to compare it with others."""
    return interpolate(COMPARED_FRACTIONS * times[-1], times, np.ascontiguousarray(states[:, :3]))
