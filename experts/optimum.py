"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any

import numpy as np

from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import certify, failure
from leapnav.experts.direct import DirectPath, discretise, optimise
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.lattice import TOLERATED_DEPTH, Lattice, Place, is_connected
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import Settings
from leapnav.experts.path_class import Mode, Side, driving_modes, heading_winding, path_sides
from leapnav.experts.problem import OptimalControlProblem, Path

TOLERANCE = 1e-9
NEWTON_ITERATIONS, FIRST_ITERATIONS = 25, 14  # the first tries are on paths that can be refined
# Intervals of the refined direct path per segment of multiple shooting, and from how many refinements it is tried.
INTERVALS_PER_SEGMENT, FEWEST_SEGMENTS = 8, 8
REFINEMENTS = 3
ELSEWHERE = 4  # paths by other ways, which cost little more time and are the more interesting alternatives
MOST_ROUNDS = 4
# Refinement, margin (m) and extent of one lattice after the other, as long as nothing is certified or a better path may
# have been missed: all candidates may lead through a gap that is too narrow or in which the optimum grazes, which a
# margin shuts, and a gap or a short way may need smaller cells. The last one covers all of an arena that is too large
# for the others.
LATTICES = ((1, None, False), (1, 0.05, False), (2, None, False), (2, 0.05, False), (1, None, True))
# Two paths this near at all times (metres, and as much in radians) lead to the same extremal; two extremals are the
# same if their costs agree as well.
SAME_PATH, SAME_COST = 0.15, 1e-6
SHORT = 4.0  # m between start and goal; where it is less, paths nearer to each other are distinct
# The cost of a direct path is off by less than this share, so what is dearer by more needs no look.
DIRECT_ERROR = 0.01
# How deep, in robot radii, an extremal may cut into an obstacle for a path near it that just touches to be thinkable.
SLIGHT = TOLERATED_DEPTH
# A path is in vain if it is this share as deep in an obstacle as one before it, so many robot radii from there at most.
AS_DEEP, SAME_PLACE = 0.5, 0.5
TOUCH = 0.1  # share of what is slight; what hardly touches shuts no place
MOST_WASTED = 1_000_000  # evaluations of the flow by Newton's method in vain, on the paths of one lattice
CLOSED = 1e-3  # sum of the violations of a direct path's constraints
COMPARED = np.linspace(0.0, 1.0, 65)


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Extremal):
    """A local optimum of a scenario; what `find_optimum` returns is the best one, and knows the others.

    Attributes:
        alternatives: the other distinct local optima found, certified, in order of cost (theirs are empty).
        doubts: solutions found that are cheaper than this one but not certified: their status is COLLISION for those
            that cut into an obstacle by up to 0.4 of the robot's radius (a path that just touches may then be cheaper
            than this optimum), or says why there is no certificate. Extremals that cut deeper are no doubts: where the
            proximity cost is worth its name, no path near them is both clear and cheap.

    """

    alternatives: tuple[Optimum, ...] = ()
    doubts: tuple[Extremal, ...] = ()

    @property
    def path_class(self) -> tuple[Side, ...]:
        """On which side of the path each obstacle lies, in the scenario's order."""
        times = np.linspace(0.0, self.problem.horizon, 513)
        assert self.problem.field is not None
        return path_sides(self.interpolate(times)[:, :2], self.problem.field)

    @property
    def driving_modes(self) -> tuple[Mode, ...]:
        """Forwards and backwards, in turn."""
        return driving_modes(self.times, self.controls[:, 0])

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, lists and numbers, with the alternatives and their path classes."""
        described = {}
        if len(self.times):
            described = {
                "path_class": list(self.path_class),
                "driving_modes": list(self.driving_modes),
                "heading_winding": self.heading_winding,
            }
        return {
            **super().to_dict(),
            **described,
            "alternatives": [alternative.to_dict() for alternative in self.alternatives],
            "doubts": [doubt.to_dict() for doubt in self.doubts],
        }

    @property
    def heading_winding(self) -> int:
        """Full turns of the heading beyond the smaller angle between start and goal; positive: counter-clockwise."""
        return heading_winding(self.states[:, 2])


def find_optimum(scenario: Scenario, candidates: int = 12, *, thorough: bool = True) -> Optimum:
    """The reference of a scenario: the cheapest certified extremal among many.

    A search over position and heading in the problem's own metric proposes distinct paths (obstacles passed on either
    side, forwards, backwards, with cusps, other windings of the heading); direct transcription takes each to a local
    optimum and shows which are the same; multiple-shooting Newton turns those into extremals; the cheapest whose
    certificate holds is returned, with the others as `alternatives`.

    Args:
        candidates: how many distinct paths to try at once; more are tried only as long as none of them is certified, or
            a better one may have been missed.
        thorough: False tries no more than these. Mostly the best path is among them, and where there is none this says
            so fifty times sooner; but it may miss the only one, and a status of failure is then a guess.

    Returns:
        An `Optimum`; if nothing is certified, a failure whose status says why.

    Raises:
        ValueError: candidates < 1.

    """
    if candidates < 1:
        raise ValueError(f"candidates: expected at least 1, got {candidates!r}")
    problem = OptimalControlProblem.from_scenario(scenario)
    if np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2])) > scenario.robot.max_speed * scenario.horizon:
        return as_optimum(failure(problem, Status.HORIZON_TOO_SHORT))
    search = Search(scenario, problem)
    failed = _search(search, candidates, thorough)
    if not search.certified and search.shut:  # the only way may lead close by a place that was shut
        search.shut, search.shutting = [], False
        failed = _search(search, candidates, thorough)
    return search.result() if failed is None else as_optimum(failure(problem, failed))


def _search(search: Search, candidates: int, thorough: bool) -> Status | None:
    """Lattice after lattice, until the best path can be told to be found; why there is none, or None."""
    scenario = search.scenario
    shortest_time, cropped = np.inf, False
    for refinement, margin, whole in LATTICES[: None if thorough else 1]:
        lattice = Lattice(scenario, refinement, margin, whole=whole).without(search.shut)
        if whole and (search.certified or not cropped):
            break
        cropped = cropped or lattice.cropped
        paths = lattice.candidates()
        first, search.wasted, shut = None, 0, search.shut.copy()
        for _ in range(MOST_ROUNDS):
            batch = list(islice(paths, candidates))
            if not batch:
                break
            first = first or batch[0]
            shortest_time = min(shortest_time, *(_shortest_time(c.poses, scenario) for c in batch))
            search.add(Path(c.times, c.poses) for c in batch)
            if not thorough:
                break
            # A margin shuts ways that may be better.
            if search.certified and margin is None and lattice.explains(search.best.cost, first.cost, batch[-1].cost):
                search.add(Path(c.times, c.poses) for c in islice(lattice.elsewhere(), ELSEWHERE))
                return None
            if search.shut != shut:  # many combinations of detours elsewhere would lead through the same gap
                shut = search.shut.copy()
                lattice = lattice.without(search.shut)
                paths, first = lattice.candidates(), None
        # Looked at when it is in doubt: lattice paths may lead through gaps that are a little too narrow.
        if thorough and not search.certified and not is_connected(scenario):
            return Status.NO_PATH
    if search.certified:
        return None
    if shortest_time == np.inf:
        return Status.NO_PATH
    return Status.HORIZON_TOO_SHORT if shortest_time > scenario.horizon else None


class Search:
    """The local optima found so far in a scenario."""

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem) -> None:
        self.scenario, self.problem = scenario, problem
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
        if direct.cost > (1 + DIRECT_ERROR) * best and depths.min() <= 0:
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

    def result(self) -> Optimum:
        """The best extremal with the others, or, if none is certified, the cheapest that was refused or stalled."""
        if not self.certified:
            if self.refused:
                return as_optimum(min(self.refused, key=lambda extremal: extremal.cost))
            _, problem, direct = min(self._deep or self._stalled, key=lambda entry: entry[0])
            extremal = self._extremal(problem, optimise(problem, direct.refined()))[0] if self._deep else None
            return as_optimum(extremal or _stalled(problem, direct))
        best, *others = sorted(self.certified, key=lambda extremal: extremal.cost)
        alternatives = tuple(map(as_optimum, others))
        return replace(as_optimum(best), alternatives=alternatives, doubts=self.doubts(best.cost))

    def doubts(self, cost: float) -> tuple[Extremal, ...]:
        """Solutions found that are cheaper than `cost` and not certified; see `Optimum`."""
        refused = [extremal for extremal in self.refused if extremal.cost < cost and self._is_slight(extremal)]
        cheaper = [_stalled(*entry[1:]) for entry in self._stalled if entry[0] < cost * (1 - DIRECT_ERROR)]
        return (*refused, *filter(self._is_slight, cheaper))

    def _is_slight(self, extremal: Extremal) -> bool:
        """Whether a collision-free path that is about as cheap is thinkable: not where an extremal cuts deep."""
        clearance = extremal.certificate.clearance if extremal.certificate is not None else None
        return clearance is None or clearance >= -self.slight


def as_optimum(extremal: Extremal) -> Optimum:
    """The extremal as an `Optimum` without alternatives."""
    return Optimum(**{field.name: getattr(extremal, field.name) for field in fields(Extremal)})


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


def _shortest_time(poses: np.ndarray, scenario: Scenario) -> float:
    """How long (s) a path takes at the robot's limits."""
    step = np.abs(np.diff(poses, axis=0))
    driving = np.hypot(step[:, 0], step[:, 1]) / scenario.robot.max_speed
    return float(np.maximum(driving, step[:, 2] / scenario.robot.max_turn_rate).sum())
