"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from itertools import islice

import numpy as np

from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import failure
from leapnav.experts.direct import DirectPath, discretise, optimise
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.lattice import Lattice
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import Settings
from leapnav.experts.path_class import Mode, Side, driving_modes, heading_winding, path_sides
from leapnav.experts.problem import OptimalControlProblem, Path

TOLERANCE = 1e-9
NEWTON_ITERATIONS = 40
# Intervals of the direct path per segment of multiple shooting, and how often the intervals are halved: once always,
# more often as long as Newton's method does not converge from there.
INTERVALS_PER_SEGMENT, FEWEST_SEGMENTS = 8, 8
REFINEMENTS = 4
MOST_ROUNDS = 3
# Refinement and margin (m) of one lattice after the other, as long as nothing is certified: all candidates may lead
# through a gap in which the optimum grazes, which a margin shuts, and a gap or a short way may need smaller cells.
LATTICES = ((1, None), (1, 0.05), (2, None), (2, 0.05))
# Two paths this near at all times (metres, and as much in radians) lead to the same extremal; two extremals are the
# same if their costs agree as well.
SAME_PATH, SAME_COST = 0.15, 1e-6
# The cost of a direct path is off by less than this share, so what is dearer by more needs no look.
DIRECT_ERROR = 0.01
# How deep (m) an extremal may cut into an obstacle for a path along it that just touches to be thinkable.
SLIGHT = 0.1
COMPARED = np.linspace(0.0, 1.0, 65)


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Extremal):
    """A local optimum of a scenario; what `find_optimum` returns is the best one, and knows the others.

    Attributes:
        alternatives: the other distinct local optima found, certified, in order of cost (theirs are empty).
        touching: extremals found that are cheaper than this one, but cut into an obstacle by up to 0.1 m. If there are
            any, a path may exist that just touches and is cheaper than this optimum, which then is no safe reference.

    """

    alternatives: tuple[Optimum, ...] = ()
    touching: tuple[Extremal, ...] = ()

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

    @property
    def heading_winding(self) -> int:
        """Full turns of the heading beyond the smaller angle between start and goal; positive: counter-clockwise."""
        return heading_winding(self.states[:, 2])


def find_optimum(scenario: Scenario, candidates: int = 12) -> Optimum:
    """The reference of a scenario: the cheapest certified extremal among many.

    A search over position and heading in the problem's own metric proposes distinct paths (obstacles passed on either
    side, forwards, backwards, with cusps, other windings of the heading); direct transcription takes each to a local
    optimum and shows which are the same; multiple-shooting Newton turns those into extremals; the cheapest whose
    certificate holds is returned, with the others as `alternatives`.

    Args:
        candidates: how many distinct paths to try at once; more are tried only as long as none of them is certified.

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
    shortest_time = np.inf
    for refinement, margin in LATTICES:
        paths = Lattice(scenario, refinement, margin).candidates()
        for _ in range(MOST_ROUNDS):
            batch = [Path(c.times, c.poses) for c in islice(paths, candidates)]
            if not batch:
                break
            shortest_time = min(shortest_time, *(_shortest_time(path, scenario) for path in batch))
            search.add(batch)
            if search.certified:
                return search.result()
    if shortest_time == np.inf:
        return as_optimum(failure(problem, Status.NO_PATH))
    if shortest_time > scenario.horizon:
        return as_optimum(failure(problem, Status.HORIZON_TOO_SHORT))
    return search.result()


class Search:
    """The local optima found so far in a scenario."""

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem) -> None:
        self.scenario, self.problem = scenario, problem
        self.certified: list[Extremal] = []
        self.refused: list[Extremal] = []
        self._seen: list[np.ndarray] = []
        self._stalled: list[Extremal] = []

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
        shape = _shape(direct.times, direct.states)
        if any(np.abs(shape - other).max() < SAME_PATH for other in self._seen):
            return
        best = min((extremal.cost for extremal in self.certified), default=np.inf)
        collides = clearances(direct.states, self.scenario.field).min() <= 0
        if collides and direct.cost > (1 + DIRECT_ERROR) * best:
            return
        self._seen.append(shape)
        extremal = _extremal(problem, direct)
        if any(_same(extremal, other) for other in (*self.certified, *self.refused)):
            return
        if extremal.success:
            self.certified.append(extremal)
        elif extremal.status in (Status.COLLISION, Status.CONJUGATE_POINT, Status.NOT_CERTIFIED):
            self.refused.append(extremal)
        else:
            self._stalled.append(extremal)

    def result(self) -> Optimum:
        """The best extremal with the others, or, if none is certified, the cheapest that was refused or that stalled."""
        if not self.certified:
            return as_optimum(min(self.refused or self._stalled, key=lambda extremal: extremal.cost))
        best, *others = sorted(self.certified, key=lambda extremal: extremal.cost)
        touching = [
            extremal
            for extremal in self.refused
            if extremal.cost < best.cost
            and extremal.certificate is not None
            and extremal.certificate.clearance is not None
            and -SLIGHT <= extremal.certificate.clearance <= 0
        ]
        return replace(as_optimum(best), alternatives=tuple(map(as_optimum, others)), touching=tuple(touching))


def as_optimum(extremal: Extremal) -> Optimum:
    """The extremal as an `Optimum` without alternatives."""
    return Optimum(**{field.name: getattr(extremal, field.name) for field in fields(Extremal)})


def _extremal(problem: OptimalControlProblem, direct: DirectPath) -> Extremal:
    """Multiple shooting from a direct path, refined as often as it needs."""
    history, work = (), 0
    settings = Settings(TOLERANCE, NEWTON_ITERATIONS)
    for refinement in range(1, REFINEMENTS + 1):
        direct = optimise(problem, direct.refined())
        intervals = len(direct.controls)
        segments = max(round(intervals / (INTERVALS_PER_SEGMENT * 2 ** (refinement - 1))), FEWEST_SEGMENTS)
        at = np.rint(np.linspace(0, intervals, segments * 2 ** (refinement - 1) + 1)).astype(int)
        times, nodes = direct.times[at], np.concatenate([direct.states[at], direct.costates[at]], axis=1)
        arrays = problem.arrays
        nodes[-1, :3] = np.where(arrays.free, nodes[-1, :3], arrays.goal)
        status, rows, evaluations = polish(problem, times, nodes, TOLERANCE, NEWTON_ITERATIONS)
        history += rows
        work += evaluations
        if status is Status.SUCCESS or refinement == REFINEMENTS:
            break
    return confirm(problem, times, nodes, status, history, work, settings)


def _shape(times: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Poses at fixed shares of the horizon, to compare paths."""
    at = COMPARED * times[-1]
    return np.stack([np.interp(at, times, column) for column in states[:, :3].T], axis=1)


def _same(extremal: Extremal, other: Extremal) -> bool:
    if abs(extremal.cost - other.cost) > SAME_COST * abs(other.cost):
        return False
    shapes = (_shape(e.times, e.states) for e in (extremal, other))
    return bool(np.abs(np.subtract(*shapes)).max() < SAME_PATH)


def _shortest_time(path: Path, scenario: Scenario) -> float:
    """How long (s) a path takes at the robot's limits."""
    step = np.abs(np.diff(path.states, axis=0))
    driving = np.hypot(step[:, 0], step[:, 1]) / scenario.robot.max_speed
    return float(np.maximum(driving, step[:, 2] / scenario.robot.max_turn_rate).sum())
