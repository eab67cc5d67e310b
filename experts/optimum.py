"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np

from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import failure
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.feasible_path import FeasiblePath
from leapnav.experts.lattice import Lattice
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import Settings, default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem, Path

TOLERANCE = 1e-9
NEWTON_ITERATIONS = 40
# A swept path dearer than the best extremal by more than this is not polished. That is no bound (polishing can save
# more, 27 % was seen), but on 300 clutter scenarios it lost nothing against polishing everything.
SCREENING_MARGIN = 1.25
SWEEPS, MORE_SWEEPS = 3, 8
# Sweeps need no accuracy beyond what the next sweep changes; Newton's method polishes the result.
SWEEP_TOLERANCE = 1e-4
MOST_ROUNDS = 3
# Refinement and margin (m) of one lattice after the other, as long as nothing is certified: all candidates may lead
# through a gap in which the optimum grazes, which a margin shuts, and a gap or a short way may need smaller cells.
LATTICES = ((1, None), (1, 0.05), (2, None), (2, 0.05))
# Two paths this near at all times (metres, and as much in radians) lead to the same extremal.
SAME_PATH = 0.15


@dataclass
class _Attempt:
    """A candidate on its way: the swept path, and the extremal's nodes once Newton's method has found them."""

    track: FeasiblePath
    solution: np.ndarray | None = None

    @property
    def cost(self) -> float:
        return self.track.cost

    @property
    def nodes(self) -> np.ndarray:
        return self.track.nodes if self.solution is None else self.solution

    def certify(self, converged: Status) -> Extremal:
        track = self.track
        settings = Settings(TOLERANCE, NEWTON_ITERATIONS)
        history = tuple(track.history)
        return confirm(track.problem, track.times, self.nodes, converged, history, track.work, settings)


def find_optimum(scenario: Scenario, candidates: int = 8) -> Extremal:
    """The reference of a scenario: the cheapest certified extremal among many.

    A search over position and heading in the problem's own metric proposes distinct paths (obstacles passed on either
    side, forwards, backwards, with cusps, other windings of the heading); Leapfrog sweeps and multiple-shooting Newton
    turn the promising ones into extremals; the cheapest whose certificate holds is returned.

    Args:
        candidates: how many distinct paths to try at once; more are tried only as long as none of them is certified.

    Returns:
        An `Extremal`; if none is certified, a failure whose status says why.

    Raises:
        ValueError: candidates < 1.

    """
    if candidates < 1:
        raise ValueError(f"candidates: expected at least 1, got {candidates!r}")
    problem = OptimalControlProblem.from_scenario(scenario)
    if np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2])) > scenario.robot.max_speed * scenario.horizon:
        return failure(problem, Status.HORIZON_TOO_SHORT)
    search = _Search(scenario)
    shortest_time = np.inf
    for refinement, margin in LATTICES:
        paths = Lattice(scenario, refinement, margin).candidates()
        for _ in range(MOST_ROUNDS):
            batch = [Path(c.times, c.poses) for c in islice(paths, candidates)]
            if not batch:
                break
            shortest_time = min(shortest_time, *(_shortest_time(path, scenario) for path in batch))
            search.add([_sweep(problem, path) for path in batch])
            if search.best is not None:
                return search.best
    if shortest_time == np.inf:
        return failure(problem, Status.NO_PATH)
    if shortest_time > scenario.horizon:
        return failure(problem, Status.HORIZON_TOO_SHORT)
    return search.failure()


class _Search:
    """The extremals found so far in a scenario, and the best of them whose certificate holds."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.best: Extremal | None = None
        self._solved: list[_Attempt] = []
        self._stalled: list[_Attempt] = []
        self._refused: list[Extremal] = []

    def add(self, attempts: list[_Attempt]) -> None:
        """Polishes what is promising, the cheapest first."""
        attempts = sorted(attempts, key=lambda attempt: attempt.cost)
        stalled = [attempt for attempt in attempts if self._promising(attempt) and not self._polish(attempt)]
        for attempt in stalled:
            if self._promising(attempt):  # more sweeps: nearer to the extremal, or onto another one
                for _ in range(MORE_SWEEPS):
                    attempt.track.sweep()
                if not self._polish(attempt):
                    self._stalled.append(attempt)

    def failure(self) -> Extremal:
        """What to return if nothing was certified: the cheapest extremal that was refused, or what stalled."""
        if self._refused:
            return min(self._refused, key=lambda extremal: extremal.cost)
        collided = [a for a in self._solved if clearances(a.nodes, self.scenario.field).min() <= 0]
        attempts = sorted(collided or self._stalled, key=lambda attempt: attempt.cost)
        converged = Status.SUCCESS if collided else Status.STALLED
        return attempts[0].certify(converged)

    def _promising(self, attempt: _Attempt) -> bool:
        bound = np.inf if self.best is None else SCREENING_MARGIN * self.best.cost
        return attempt.cost <= bound and not any(_same(attempt, other) for other in self._solved)

    def _polish(self, attempt: _Attempt) -> bool:
        """Newton on an attempt's nodes; False if it does not converge."""
        track, nodes = attempt.track, attempt.track.nodes.copy()
        status, rows, work = polish(track.problem, track.times, nodes, TOLERANCE, NEWTON_ITERATIONS)
        track.history += rows
        track.work += work
        if status is not Status.SUCCESS:
            return False
        attempt.solution = nodes
        self._solved.append(attempt)
        clear = clearances(nodes, self.scenario.field).min() > 0
        if clear and (self.best is None or rows[-1].cost < self.best.cost):
            extremal = attempt.certify(Status.SUCCESS)
            if extremal.success:
                self.best = extremal
            else:
                self._refused.append(extremal)
        return True


def _shortest_time(path: Path, scenario: Scenario) -> float:
    """How long (s) a path takes at the robot's limits."""
    step = np.abs(np.diff(path.states, axis=0))
    driving = np.hypot(step[:, 0], step[:, 1]) / scenario.robot.max_speed
    return float(np.maximum(driving, step[:, 2] / scenario.robot.max_turn_rate).sum())


def _sweep(problem: OptimalControlProblem, path: Path) -> _Attempt:
    problem = problem.with_winding_of(path.states)
    track = FeasiblePath(problem, *start_nodes(problem, path, default_segments(path)), SWEEP_TOLERANCE, SWEEP_TOLERANCE)
    for _ in range(SWEEPS):
        track.sweep()
    return _Attempt(track)


def _same(attempt: _Attempt, other: _Attempt) -> bool:
    times = other.track.times
    mine = np.stack([np.interp(times, attempt.track.times, column) for column in attempt.nodes[:, :3].T], axis=1)
    return float(np.abs(mine - other.nodes[:, :3]).max()) < SAME_PATH
