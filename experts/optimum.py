"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import certify, failure
from leapnav.experts.extremal import Extremal, Iteration, Status
from leapnav.experts.lattice import Lattice
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.solve import connect, default_segments, polish, start_nodes, sweep

TOLERANCE = 1e-9
NEWTON_ITERATIONS = 40
# Three sweeps leave a path within a few per cent of its local optimum; what is dearer by more cannot become the best.
SCREENING_MARGIN = 1.25
SWEEPS, MORE_SWEEPS = 3, 8
MOST_ROUNDS = 8
# Two paths this near at all times (metres, and as much in radians) lead to the same extremal.
SAME_PATH = 0.15


@dataclass
class _Attempt:
    """A candidate on its way: the swept nodes and what they cost."""

    problem: OptimalControlProblem
    times: np.ndarray
    nodes: np.ndarray
    costs: np.ndarray
    history: list[Iteration]
    work: int

    @property
    def cost(self) -> float:
        return float(self.costs.sum())


def find_optimum(scenario: Scenario, candidates: int = 8) -> Extremal:
    """The reference of a scenario: the cheapest certified extremal among many.

    A search over position and heading in the problem's own metric proposes distinct paths (obstacles passed on either
    side, forwards, backwards, with cusps, other windings of the heading); Leapfrog sweeps and multiple-shooting Newton
    turn the promising ones into extremals; the cheapest whose certificate holds is returned.

    Args:
        candidates: how many distinct paths to try at once; more are tried only as long as none of them is certified.

    Returns:
        An `Extremal`; if none is certified, the cheapest failure, or one with status NO_PATH.

    Raises:
        ValueError: candidates < 1.

    """
    if candidates < 1:
        raise ValueError(f"candidates: expected at least 1, got {candidates!r}")
    problem = OptimalControlProblem.from_scenario(scenario)
    paths = Lattice(scenario).candidates()
    failed: list[Extremal] = []
    for _ in range(MOST_ROUNDS):
        batch = [Path(c.times, c.poses) for c in islice(paths, candidates)]
        if not batch:
            break
        for extremal in _extremals(problem, batch, scenario):
            if extremal.success:
                return extremal
            failed.append(extremal)
    return min(failed, key=lambda extremal: extremal.cost, default=failure(problem, Status.NO_PATH))


def _extremals(problem: OptimalControlProblem, paths: list[Path], scenario: Scenario) -> Iterator[Extremal]:
    """Extremals of the promising paths, cheapest first; a failure if there is none."""
    attempts = sorted((_sweep(problem, path) for path in paths), key=lambda attempt: attempt.cost)
    polished: list[tuple[float, _Attempt]] = []

    def promising(attempt: _Attempt) -> bool:
        best = min((cost for cost, _ in polished), default=np.inf)
        return attempt.cost <= SCREENING_MARGIN * best and not any(_same(attempt, other) for _, other in polished)

    stalled = [a for a in attempts if promising(a) and not _polish(a, scenario, polished)]
    for attempt in stalled:
        if promising(attempt):  # more sweeps: nearer to the extremal, or onto another one
            rows, work = sweep(attempt.problem, attempt.times, attempt.nodes, attempt.costs, MORE_SWEEPS)
            attempt.history += rows
            attempt.work += work
            _polish(attempt, scenario, polished)
    for _, attempt in sorted(polished, key=lambda pair: pair[0]):
        yield certify(
            attempt.problem, attempt.times, attempt.nodes, Status.SUCCESS, tuple(attempt.history), attempt.work
        )
    if not polished:
        yield failure(problem, Status.STALLED, tuple(attempts[0].history), sum(attempt.work for attempt in attempts))


def _sweep(problem: OptimalControlProblem, path: Path) -> _Attempt:
    problem = problem.with_winding_of(path.states)
    times, nodes = start_nodes(problem, path, default_segments(path))
    costs = connect(problem, times, nodes)
    rows, work = sweep(problem, times, nodes, costs, SWEEPS)
    return _Attempt(problem, times, nodes, costs, rows, work)


def _polish(attempt: _Attempt, scenario: Scenario, polished: list[tuple[float, _Attempt]]) -> bool:
    """Newton on an attempt's nodes; a solution that is clear of the obstacles at its nodes joins `polished`."""
    nodes = attempt.nodes.copy()
    status, rows, work = polish(attempt.problem, attempt.times, nodes, TOLERANCE, NEWTON_ITERATIONS)
    attempt.history += rows
    attempt.work += work
    if status is not Status.SUCCESS:
        return False
    if clearances(nodes, scenario.field).min() > 0:
        attempt.nodes = nodes
        polished.append((rows[-1].cost, attempt))
    return True


def _same(attempt: _Attempt, other: _Attempt) -> bool:
    times = other.times
    mine = np.stack([np.interp(times, attempt.times, column) for column in attempt.nodes[:, :3].T], axis=1)
    return float(np.abs(mine - other.nodes[:, :3]).max()) < SAME_PATH
