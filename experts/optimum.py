"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

from dataclasses import dataclass

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
        candidates: how many distinct paths to try.

    Returns:
        An `Extremal`; if none is certified, the cheapest failure, or one with status NO_PATH.

    Raises:
        ValueError: candidates < 1.
    """
    if candidates < 1:
        raise ValueError(f"candidates: expected at least 1, got {candidates!r}")
    problem = OptimalControlProblem.from_scenario(scenario)
    paths = [Path(c.times, c.poses) for c in Lattice(scenario).candidates(candidates)]
    if not paths:
        return failure(problem, Status.NO_PATH)
    attempts = sorted((_sweep(problem, path) for path in paths), key=lambda attempt: attempt.cost)
    polished: list[tuple[float, _Attempt]] = []
    stalled: list[_Attempt] = []
    for attempt in attempts:
        best = min((cost for cost, _ in polished), default=np.inf)
        if attempt.cost > SCREENING_MARGIN * best or any(_same(attempt, other) for _, other in polished):
            continue
        if not _polish(attempt, scenario, polished):
            stalled.append(attempt)
    for attempt in stalled:
        best = min((cost for cost, _ in polished), default=np.inf)
        if attempt.cost > SCREENING_MARGIN * best or any(_same(attempt, other) for _, other in polished):
            continue
        # Nearer to the extremal, or onto another one.
        rows, work = sweep(attempt.problem, attempt.times, attempt.nodes, attempt.costs, 8)
        attempt.history += rows
        attempt.work += work
        _polish(attempt, scenario, polished)
    worst: Extremal | None = None
    for _, attempt in sorted(polished, key=lambda pair: pair[0]):
        extremal = certify(
            attempt.problem, attempt.times, attempt.nodes, Status.SUCCESS, tuple(attempt.history), attempt.work
        )
        if extremal.success:
            return extremal
        worst = worst or extremal
    return worst or failure(problem, Status.STALLED, tuple(attempts[0].history))


def _sweep(problem: OptimalControlProblem, path: Path) -> _Attempt:
    problem = problem.with_winding_of(path.states)
    times, nodes = start_nodes(problem, path, default_segments(path))
    costs = connect(problem, times, nodes)
    rows, work = sweep(problem, times, nodes, costs, 3)
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
