"""The local optima of a scenario: from paths by direct transcription and multiple shooting to certified extremals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import certify
from leapnav.experts.direct import DirectPath, discretise, optimise
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.lattice import TOLERATED_DEPTH, Place
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import Settings
from leapnav.experts.problem import OptimalControlProblem, Path

TOLERANCE = 1e-9
NEWTON_ITERATIONS, FIRST_ITERATIONS = 25, 14  # the first tries are on paths that can be refined
# Intervals of the refined direct path per segment of multiple shooting, and from how many refinements it is tried.
INTERVALS_PER_SEGMENT, FEWEST_SEGMENTS = 8, 8
REFINEMENTS = 3
# Two paths this near at all times (metres, and as much in radians) lead to the same extremal; two extremals are the
# same if their costs agree as well.
SAME_PATH, SAME_COST = 0.15, 1e-6
SHORT = 4.0  # m between start and goal; where it is less, paths nearer to each other are distinct
# The cost of a direct path is off by less than the first share, and that of a refined one by less than the second. Of
# 6,000 refined paths six were dearer than that beside their extremals, which were others than those near them.
DIRECT_ERROR, REFINED_ERROR = 0.01, 0.002
# How deep, in robot radii, an extremal may cut into an obstacle for a path near it that just touches to be thinkable.
SLIGHT = TOLERATED_DEPTH
# A path is in vain if it is this share as deep in an obstacle as one before it, so many robot radii from there at most.
AS_DEEP, SAME_PLACE = 0.5, 0.5
TOUCH = 0.1  # share of what is slight; what hardly touches shuts no place
MOST_WASTED = 1_000_000  # evaluations of the flow by Newton's method in vain, on the paths of one lattice
CLOSED = 1e-3  # sum of the violations of a direct path's constraints
COMPARED = np.linspace(0.0, 1.0, 65)


class Search:
    """The local optima found so far in a scenario.

    Args:
        work: evaluations of the flow that may go to what is dearer than the best path.

    """

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem, work: float = math.inf) -> None:
        self.scenario, self.problem, self.work = scenario, problem, work
        self.slight = SLIGHT * scenario.robot.radius
        self._same_path = SAME_PATH * min(1.0, math.dist(scenario.start[:2], scenario.goal[:2]) / SHORT)
        self.certified: list[Extremal] = []
        self.refused: list[Extremal] = []
        self._seen: list[np.ndarray] = []
        # Cost, problem and path of what Newton's method did not take to an extremal.
        self._stalled: list[tuple[float, OptimalControlProblem, DirectPath]] = []
        # The same, of what cuts deep into obstacles.
        self._deep: list[tuple[float, OptimalControlProblem, DirectPath]] = []
        self.wasted = 0
        self.shutting = True
        self._near = SAME_PLACE * scenario.robot.radius
        # Where paths that came to nothing cut deepest into obstacles.
        self.shut: list[Place] = []

    @property
    def best(self) -> Extremal:
        """The cheapest certified extremal."""
        return min(self.certified, key=lambda extremal: extremal.cost)

    def add(self, paths: Iterable[Path]) -> None:
        """Takes paths to local optima, the cheapest first."""
        solved = []
        for path in paths:
            problem = self.problem.with_winding_of(path.states)
            solved.append((problem, optimise(problem, discretise(path))))
        for problem, direct in sorted(solved, key=lambda entry: entry[1].cost):
            self.add_direct(problem, direct)

    def add_direct(self, problem: OptimalControlProblem, direct: DirectPath) -> None:
        """Takes a solution of the discretised problem to an extremal, unless that is known or of no interest."""
        best = self.best.cost if self.certified else np.inf
        if self._known(direct):
            self._widen(direct)
            return
        depths = clearances(direct.states, self.scenario.field)
        if direct.cost > (1 + DIRECT_ERROR) * best and (depths.min() <= 0 or self.work <= 0):
            return
        if self._in_vain(direct, depths):
            return
        if depths.min() < -2.0 * self.slight:  # neither it nor a path near it is of any use
            self._shut(direct, depths)
            self._deep.append((direct.cost, problem, direct))
            return
        # Where the cost is flat, paths to the same optimum are told from others by their refinement only.
        refined = optimise(problem, direct.refined())
        known = self._known(refined)
        self._seen += [_shape(path.times, path.states) for path in (direct, refined)]
        if known:
            self._widen(refined)
            return
        # Seen at twice as many points, a path may cut through a wall after all.
        depths = clearances(refined.states, self.scenario.field)
        dearer = refined.cost > (1 + REFINED_ERROR) * best
        if dearer and (depths.min() <= 0 or self.work <= 0):
            return
        if self._in_vain(refined, depths):
            return
        if depths.min() < -2.0 * self.slight:
            self._shut(refined, depths)
            self._deep.append((direct.cost, problem, direct))
            return
        # Where the limits hardly leave a way, direct paths may not close their gaps, but Newton sometimes does.
        closed = refined.gap < CLOSED
        trying = self.wasted < MOST_WASTED and (closed or not self.certified)
        extremal, work = self._extremal(problem, refined, depths.min() >= 0.0) if trying else (None, 0)
        if dearer:
            self.work -= work
        if extremal is None:
            self.wasted += work
            likely = closed and depths.min() >= -self.slight
            self._stalled.append((refined.cost if likely else np.inf, problem, refined))
            self._shut(refined, depths)
        elif not any(_same(extremal, other) for other in (*self.certified, *self.refused)):
            self._seen.append(_shape(extremal.times, extremal.states))
            (self.certified if extremal.success else self.refused).append(extremal)
            if extremal.status is Status.COLLISION:
                self._shut(refined, depths)

    def _extremal(
        self, problem: OptimalControlProblem, direct: DirectPath, clear: bool = True
    ) -> tuple[Extremal | None, int]:
        """Multiple shooting from a direct path, which is refined further as long as that fails, and its evaluations."""
        history, work = (), 0
        last = REFINEMENTS if clear else REFINEMENTS - 1  # what collides is worth less effort
        for refinement in range(last):
            if refinement > 0:
                direct = optimise(problem, direct.refined())
                for extremal in (*self.certified, *self.refused):
                    if self._alike(_shape(direct.times, direct.states), _shape(extremal.times, extremal.states)):
                        return extremal, work
            iterations = NEWTON_ITERATIONS if refinement == last - 1 else FIRST_ITERATIONS
            intervals = len(direct.controls)
            segments = max(round(intervals / (INTERVALS_PER_SEGMENT * 2**refinement)), FEWEST_SEGMENTS) * 2**refinement
            at = np.rint(np.linspace(0, intervals, segments + 1)).astype(int)
            times, nodes = direct.times[at], np.concatenate([direct.states[at], direct.costates[at]], axis=1)
            arrays = problem.arrays
            nodes[-1, :3] = np.where(arrays.free, nodes[-1, :3], arrays.goal)
            status, rows, evaluations = polish(problem, times, nodes, TOLERANCE, iterations)
            history += rows
            work += evaluations
            if status is Status.SUCCESS:
                settings = Settings(TOLERANCE, iterations)
                return confirm(problem, times, nodes, status, history, work, settings), work
        return None, work

    def _shut(self, path: DirectPath, depths: np.ndarray) -> None:
        """Shuts the place where a path cuts deepest into an obstacle, if it does so in earnest."""
        if self.shutting and depths.min() < -TOUCH * self.slight:
            x, y, _ = path.states[int(depths.argmin())].tolist()
            slight = depths.min() >= -self.slight
            near = [p for p in self.shut if math.hypot(x - p.x, y - p.y) <= 0.5 * self._near]
            if not any((p.clearance >= -self.slight) == slight for p in near):
                self.shut.append(Place(x, y, float(depths.min())))

    def _in_vain(self, path: DirectPath, depths: np.ndarray) -> bool:
        """Whether a path cuts into an obstacle where one that was looked at does: what is near is alike."""
        # One that cuts in slightly is a doubt, see `Optimum`, where only deeper ones have been looked at.
        slight = depths.min() >= -self.slight
        for place in self.shut:
            if slight and place.clearance < -self.slight:
                continue
            if (depths[self._at(path, place)] <= AS_DEEP * place.clearance).any():
                self._widen(path)
                return True
        return False

    def _widen(self, path: DirectPath) -> None:
        """Shuts more around the places to which a path came back from where the lattice was led around them."""
        self.shut = [replace(place, wide=place.wide or bool(self._at(path, place).any())) for place in self.shut]

    def _at(self, path: DirectPath, place: Place) -> np.ndarray:
        return np.hypot(path.states[:, 0] - place.x, path.states[:, 1] - place.y) < self._near

    def _known(self, direct: DirectPath) -> bool:
        shape = _shape(direct.times, direct.states)
        return any(self._alike(shape, other) for other in self._seen)

    def _alike(self, shape: np.ndarray, other: np.ndarray) -> bool:
        return bool(np.abs(shape - other).max() < self._same_path)

    @property
    def likeliest(self) -> Extremal:
        """Where nothing is certified: the cheapest that was refused, or that Newton's method did not take anywhere."""
        if self.refused:
            return min(self.refused, key=lambda extremal: extremal.cost)
        _, problem, direct = min(self._deep or self._stalled, key=lambda entry: entry[0])
        extremal = self._extremal(problem, optimise(problem, direct.refined()))[0] if self._deep else None
        return extremal or _stalled(problem, direct)

    def doubts(self, cost: float) -> tuple[Extremal, ...]:
        """Solutions found that are cheaper than `cost` and not certified; see `Optimum`."""
        refused = [extremal for extremal in self.refused if extremal.cost < cost and self._is_slight(extremal)]
        cheaper = [_stalled(*entry[1:]) for entry in self._stalled if entry[0] < cost * (1 - DIRECT_ERROR)]
        return (*refused, *filter(self._is_slight, cheaper))

    def _is_slight(self, extremal: Extremal) -> bool:
        """Whether a collision-free path that is about as cheap is thinkable: not where an extremal cuts deep."""
        clearance = extremal.certificate.clearance if extremal.certificate is not None else None
        return clearance is None or clearance >= -self.slight


def _stalled(problem: OptimalControlProblem, direct: DirectPath) -> Extremal:
    """What there is of a direct path that Newton's method did not take to an extremal."""
    nodes = np.concatenate([direct.states, direct.costates], axis=1)
    return certify(problem, direct.times, nodes, Status.STALLED)


def _shape(times: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Poses at fixed shares of the horizon, to compare paths."""
    at = COMPARED * times[-1]
    return np.stack([np.interp(at, times, column) for column in states[:, :3].T], axis=1)


def _same(extremal: Extremal, other: Extremal) -> bool:
    if abs(extremal.cost - other.cost) > SAME_COST * abs(other.cost):
        return False
    shapes = (_shape(e.times, e.states) for e in (extremal, other))
    return bool(np.abs(np.subtract(*shapes)).max() < SAME_PATH)
