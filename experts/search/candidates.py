"""Candidate paths of a scenario: shortest paths over (x, y, heading) in the Jacobi metric of the problem.

On an extremal of the driftless robot H = c - E is constant, so |u|_R = sqrt(2 (E + Phi)), and the optimum is a shortest
path for ds = sqrt(2 (E + Phi)) sqrt(r_v ds_xy^2 + r_w dtheta^2) (Maupertuis' principle). E follows from the horizon,
T = integral of ds / (2 (E + Phi)); if the horizon is free, E is the time weight c. The search therefore covers
reversing, cusps, windings of the heading and the allocation of time. Costs of shortest paths in the plane, for which
rotation is free, are lower bounds of the costs on the lattice, and guide an A* search from the goal, whose costs guide
a search from the start. A path through an edge that both trees have in common is locally shortest. The cheapest
distinct paths of this kind are the candidates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from leapnav.envs.robots.moves import HEADINGS
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.shortest_paths import (
    Limits,
    Metric,
    Nodes,
    energy_of,
    mark,
    meeting_nodes,
    path_through,
    plane_costs,
    tree,
)

REACH = 1.3  # largest cost of a candidate relative to the cheapest, apart from the cost of 1 m
TURNING_FACTOR = 1.2  # initial estimate of the length of a path relative to the shortest path in the plane
MAX_LOG_ENERGY_ERROR = 0.5  # error of log E above which E is corrected; the order of candidates hardly depends on E
MIN_ENERGY = 1e-4
MIN_ENERGY_FRACTION = 0.3  # smallest E of a path, relative to its E for a small Phi
LATTICE_ERROR = 1.07  # relative length error of lattice paths, see `suffices`; at most 1.067 in 200 scenarios
LIMIT_MARGIN = 1.05  # duration of a step relative to the shortest, at least; the limits leave no freedom at 1
# Fraction of the excess cost, see REACH, up to which a partial search looks for candidates first. It contains all
# candidates that may lead to the optimum of most scenarios (see `suffices`), and takes 2/5 of the time.
PARTIAL = 0.2
DUPLICATE_CELLS, DUPLICATE_HEADINGS = 2, 3
# The same for `take_elsewhere`, whose paths differ by more.
DISTINCT_CELLS, DISTINCT_HEADINGS = 4, HEADINGS // 2


@dataclass(frozen=True, eq=False)
class Candidate:
    """A path of poses, which need not be feasible.

    Attributes:
        times: (N,), s.
        poses: (N, 3), x, y (m) and unwrapped heading (rad).
        cost: length in the metric of the lattice.
        nodes: (N - 2,), nodes of the lattice.

    """

    times: np.ndarray
    poses: np.ndarray
    cost: float
    nodes: np.ndarray


class Tree(NamedTuple):
    """A tree of shortest paths.

    Attributes:
        cost: cost of each node from the root.
        parent: predecessor of each node; -1 if it has none.

    """

    cost: np.ndarray
    parent: np.ndarray


class CandidateSearch:
    """Search of a lattice for candidate paths.

    Args:
        lattice: the lattice.
        reach: largest cost of a candidate relative to the cheapest, see REACH.
        energy: initial estimate of E; None for that of `first_energy`.
        partial: whether to search first for candidates that cost little more than the cheapest, and for others only
            when they are needed. The candidates are the same.

    Attributes:
        lattice: the lattice.
        energy: E of the metric; 0 if there is no path.
        limit: cost up to which candidates are known; a partial search is extended to find others.
        taken: candidates that `take` has returned.

    """

    # Nodes within this distance (cells, heading steps) of a candidate belong to it.
    _cells, _headings = DUPLICATE_CELLS, DUPLICATE_HEADINGS

    def __init__(
        self, lattice: Lattice, reach: float = REACH, *, partial: bool = False, energy: float | None = None
    ) -> None:
        self.lattice, self._reach = lattice, reach
        self._fraction = PARTIAL if partial else 1.0
        self.limit = math.inf
        self.taken: list[Candidate] = []
        self._marked: np.ndarray | None = None
        self._from_start = self._to_goal = Tree(np.empty(0), np.empty(0, dtype=np.int32))
        self._meetings = np.empty(0, dtype=np.int64)
        self.energy: float = first_energy(lattice) if energy is None else energy
        if self.energy == 0.0:
            return
        self._grow()
        if len(self._meetings) == 0:
            return
        nodes = path_through(self._meetings[0], self._from_start.parent, self._to_goal.parent)
        lengths, phi = lattice.metric_lengths(self._poses(nodes))
        horizon = lattice.scenario.horizon
        if horizon is None:
            return
        # Phi is large in a passage that is narrower than the robot, so the horizon alone may give E = 0, for which the
        # metric is degenerate.
        corrected = max(
            energy_of(lengths, phi, horizon), MIN_ENERGY_FRACTION * 0.5 * (float(lengths.sum()) / horizon) ** 2
        )
        if abs(math.log(corrected / self.energy)) > MAX_LOG_ENERGY_ERROR:
            self.energy = corrected
            self._grow()

    @property
    def cheapest(self) -> float:
        """Cost of the shortest path of the lattice; infinite if there is none."""
        if len(self._meetings) == 0:
            return math.inf
        return float(self._from_start.cost[self._meetings[0]] + self._to_goal.cost[self._meetings[0]])

    @property
    def slack(self) -> float:
        """Cost of 1 m where Phi is zero; it admits manoeuvres, which are long compared with a short distance."""
        return math.sqrt(2 * self.energy * self.lattice.weights[0])

    def candidates(self) -> Iterator[Candidate]:
        """Yield distinct paths in order of cost; none if the goal cannot be reached."""
        return self._distinct(self._mark_all(()), self._cells, self._headings)

    def take(self, count: int, max_cost: float = math.inf) -> list[Candidate]:
        """Return the next distinct paths in order of cost: at most `count`, with at most a given cost."""
        if self._marked is None:
            self._marked = self._mark_all(())
        following = self._distinct(self._marked, self._cells, self._headings, max_cost)
        found = list(islice(following, count))
        self.taken += found
        return found

    def take_elsewhere(self, count: int) -> list[Candidate]:
        """Return paths that are somewhere at least 0.8 m (4 cells of 0.2 m) away from those `taken` and each other.

        Most of them pass obstacles on other sides, and cost more.
        """
        marked = self._mark_all(self.taken, DISTINCT_CELLS, DISTINCT_HEADINGS)
        return list(islice(self._distinct(marked, DISTINCT_CELLS, DISTINCT_HEADINGS), count))

    def random_candidates(self, count: int, rng: np.random.Generator) -> Iterator[Candidate]:
        """Yield shortest paths through random nodes; none if the goal cannot be reached."""
        if self.energy == 0.0:
            return
        through = self._from_start.cost + self._to_goal.cost
        for node in rng.choice(np.flatnonzero(np.isfinite(through)), count):
            yield self._candidate(int(node))

    def suffices(self, cost: float, last: float) -> bool:
        """Return whether further candidates are unlikely to lead to a cheaper extremal.

        For any E, a path of length D in the metric has J >= D - (E - c) T with the time weight c, and equality for an
        extremal of that E. Lattice paths are slightly longer than the extremals close to them, at most by the factor
        LATTICE_ERROR in hundreds of scenarios, and rarely shorter. So no more candidates are needed if the first one is
        about as short as the best extremal, or if the others are too long to be close to a cheaper extremal.

        Args:
            cost: J of the best extremal.
            last: cost up to which all candidates are taken.

        """
        return self.taken[0].cost >= self._length(cost) / LATTICE_ERROR or last >= self.max_cost(cost)

    def max_cost(self, cost: float) -> float:
        """Return the cost of a candidate from which it is too long for an extremal of a given J; see `suffices`."""
        return self._length(cost) * LATTICE_ERROR

    def _length(self, cost: float) -> float:
        """Return the length in the metric of an extremal of a given J, at most."""
        scenario = self.lattice.scenario
        # J contains the cost of time: c T, with c = E if the horizon is free.
        rest = 0.0 if scenario.horizon is None else (self.energy - scenario.cost.time_weight) * scenario.horizon
        return cost + rest

    def _distinct(
        self, marked: np.ndarray, cells: int, headings: int, max_cost: float = math.inf
    ) -> Iterator[Candidate]:
        """Yield paths of at most a given cost through nodes that are not `marked`, and mark those around each."""
        while True:
            start = 0
            while start < len(self._meetings):
                free = ~marked[self._meetings[start:]]
                start += int(free.argmax())
                node = int(self._meetings[start])
                if marked[node] or self._from_start.cost[node] + self._to_goal.cost[node] > max_cost:
                    break
                candidate = self._candidate(node)
                self._mark(marked, candidate.nodes, cells, headings)
                yield candidate
            if self._fraction == 1.0 or self.limit >= max_cost:
                return
            self._fraction = 1.0
            self._grow()

    def _mark_all(self, candidates: Iterable[Candidate], cells: int = 0, headings: int = 0) -> np.ndarray:
        """Return an array with marks at the nodes within the given distance of candidates."""
        marked = np.zeros(len(self._from_start.cost), dtype=bool)
        for candidate in candidates:
            self._mark(marked, candidate.nodes, cells, headings)
        return marked

    def _grow(self) -> None:
        """Compute the trees from the start and from the goal, and the nodes at which they meet, in order of cost."""
        scenario, metric = self.lattice.scenario, metric_of(self.lattice, self.energy)
        seeds = self.lattice.nodes_around(*scenario.start, metric.plane)
        ends = self.lattice.nodes_around(*scenario.goal, metric.plane)
        bound = cell_costs(metric, seeds)
        fraction = self._fraction
        limits = Limits(1.0 + fraction * (self._reach - 1.0), fraction * self.slack, math.inf)
        moves = self.lattice.moves.reverse()
        back = metric._replace(targets=moves.targets, points=moves.points, weights=moves.weights)
        cost_behind, behind, limit = tree(back, ends, seeds, bound, False, limits)
        cost_ahead, ahead, _ = tree(metric, seeds, ends, cost_behind, True, limits._replace(limit=limit))
        self._from_start, self._to_goal = Tree(cost_ahead, ahead), Tree(cost_behind, behind)
        # Without a path the limit is infinite, and so are the costs.
        self._meetings = self._meet(limit) if limit < math.inf else np.empty(0, dtype=np.int64)
        self.limit = limit

    def _meet(self, limit: float) -> np.ndarray:
        """Return the nodes at which the trees meet, in order of the cost of the path through them, up to a limit."""
        to_goal, from_start = self._to_goal, self._from_start
        nodes, costs = meeting_nodes(from_start.parent, to_goal.parent, from_start.cost, to_goal.cost, limit)
        return nodes[np.argsort(costs, kind="stable")]  # the same order on every processor

    def _poses(self, nodes: np.ndarray) -> np.ndarray:
        """Return the poses (N + 2, 3) along nodes (N,)."""
        return self.lattice.poses(nodes)

    def _mark(self, marked: np.ndarray, nodes: np.ndarray, cells: int, headings: int) -> None:
        """Mark the nodes within a distance of a path."""
        mark(marked, nodes, self.lattice.lines, cells, headings)

    def _candidate(self, node: int) -> Candidate:
        """Return the path through a node."""
        nodes = path_through(node, self._from_start.parent, self._to_goal.parent)
        poses, horizon = self._poses(nodes), self.lattice.scenario.horizon
        lengths, phi = self.lattice.metric_lengths(poses)
        # The time of a path of length zero (the goal is the start) is distributed evenly.
        lengths = np.maximum(lengths, 1e-9)
        energy = self.energy if horizon is None else energy_of(lengths, phi, horizon)
        durations = lengths / np.sqrt(2 * (energy + phi))
        if horizon is None:
            durations = np.maximum(durations, LIMIT_MARGIN * shortest_durations(poses, self.lattice.scenario))
        times = np.concatenate([[0.0], np.cumsum(durations)])
        cost = float(self._from_start.cost[node] + self._to_goal.cost[node])
        return Candidate(times if horizon is None else times * (horizon / times[-1]), poses, cost, nodes)


def first_energy(lattice: Lattice) -> float:
    """Estimate E from the shortest path in the plane; 0 if there is none."""
    scenario = lattice.scenario
    weight, horizon = lattice.weights[0], scenario.horizon
    start, goal = scenario.start, scenario.goal
    if horizon is None:
        return scenario.cost.time_weight if math.isfinite(_plane_distance(lattice, scenario.cost.time_weight)) else 0.0
    energy = max(0.5 * weight * (math.dist(start[:2], goal[:2]) / horizon) ** 2, MIN_ENERGY)
    for _ in range(3):
        shortest = _plane_distance(lattice, energy)
        if not math.isfinite(shortest):
            return 0.0
        # Assumes that Phi is small compared with E, which holds once E is larger than that of the straight line.
        length = TURNING_FACTOR * shortest / math.sqrt(2.0 * energy)
        before, energy = energy, max(0.5 * (length / horizon) ** 2, MIN_ENERGY)
        if abs(math.log(energy / before)) < MAX_LOG_ENERGY_ERROR:
            break
    return energy


def _plane_distance(lattice: Lattice, energy: float) -> float:
    """Return the cost of the shortest path if rotation were free; infinite if there is none."""
    scenario, metric = lattice.scenario, metric_of(lattice, energy)
    cost = cell_costs(metric, lattice.nodes_around(*scenario.start, metric.plane))
    targets = lattice.nodes_around(*scenario.goal, metric.plane).nodes // HEADINGS
    return float(cost[targets].min()) if len(targets) else math.inf


def metric_of(lattice: Lattice, energy: float) -> Metric:
    """Return the metric of a lattice for a given E."""
    speed, moves = np.sqrt(2.0 * (energy + lattice.phi)), lattice.moves
    robot, unit = lattice.scenario.robot, math.sqrt(lattice.weights[0])
    slowest, fastest = unit * robot.slowest_speed(), unit * robot.speed_limits()[0]
    if lattice.scenario.horizon is None and (slowest > 0.0 or fastest < math.inf):
        # At a speed limit v beyond which the optimal speed would be, a path costs (c + Phi) / v + r_v v / 2 per m.
        limited = np.clip(speed, slowest, fastest)
        speed = np.where(speed != limited, 0.5 * (speed**2 / limited + limited), speed)
    plane = speed[0] if len(speed) == 1 else speed.min(axis=0)
    return Metric(speed, plane, lattice.cell, *lattice.weights, moves.targets, moves.points, moves.weights)


def shortest_durations(poses: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the durations (N - 1,) (s) of the steps of a path (N, 3) at the limits of the robot."""
    step, robot = np.diff(poses, axis=0), scenario.robot
    low, high = robot.turn_rates()
    turning = np.where(step[:, 2] < 0, step[:, 2] / low, step[:, 2] / high)
    return np.maximum(np.hypot(step[:, 0], step[:, 1]) / robot.speed_limits()[0], turning)


def cell_costs(metric: Metric, seeds: Nodes) -> np.ndarray:
    """Return the costs of the cells from those of the seeds if rotation were free."""
    cells = np.unique(seeds.nodes // HEADINGS)
    return plane_costs(metric, Nodes(cells, np.zeros(len(cells))))
