"""Global search for candidate paths: shortest paths over (x, y, heading) in the metric that the problem itself defines.

On an extremal of the driftless robot H = -E is constant, so |u|_R = sqrt(2 (E + Phi)), and the optimum is a shortest
path for ds = sqrt(2 (E + Phi)) sqrt(r_v ds_xy^2 + r_w dtheta^2) (Maupertuis' principle); E follows from the horizon,
T = integral of ds / (2 (E + Phi)). The search therefore knows about reversing, cusps, windings of the heading and the
allocation of time together. Shortest paths in the plane, for which turning is free, bound those on the lattice from
below and so direct one tree from the goal, whose costs then direct one from the start. Where the trees share an edge the
path through it is locally shortest; the cheapest such paths that are distinct are the candidates.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from leapnav.envs.obstacles import sample_grid
from leapnav.envs.scenario import Scenario
from leapnav.experts.shortest_paths import (
    ANGLES,
    BORDER,
    HEADINGS,
    energy_of,
    mark,
    meeting_nodes,
    path_through,
    plane_costs,
    tree,
)

# The cell (m) is small enough to manoeuvre over a short way; half of it is the resolution at which obstacles are seen.
SMALLEST_CELL, LARGEST_CELL, CELLS_ON_THE_WAY = 0.05, 0.2, 20
MOST_CELLS = 250  # per side; larger arenas get larger cells
# How far inside an obstacle, in robot radii, a lattice point may lie: a gap that the robot just passes can lie between
# two points, but no wall is thinner than the robot.
TOLERATED_DEPTH = 0.4
FELT = 12.0  # proximity scales; farther obstacles change the order of paths by less than a millionth
TURNING = 1.2  # how much longer a path is than the shortest one in the plane, at first; corrected if far off
LARGEST_CORRECTION = 0.5  # of log E: the order of candidates hardly depends on it
SEED_ANGLE = math.radians(30)
Pose = tuple[float, float, float | None]


@dataclass(frozen=True)
class Candidate:
    """A path of poses, not yet feasible: times (N,), poses (N, 3) with unwrapped headings, and its lattice cost."""

    times: np.ndarray
    poses: np.ndarray
    cost: float


class Lattice:
    """The search of one scenario. `candidates` yields paths in order of promise.

    Args:
        refinement: how many times finer than usual the cells are.
        margin: smallest clearance (m) of the lattice's points; None tolerates a little depth, see TOLERATED_DEPTH.
        reach: paths this many times as dear as the first, and a metre more, are not worth a look.

    """

    # Nodes this near (cells, heading steps) to a path already taken belong to it.
    SAME_CELLS, SAME_HEADINGS = 2, 3

    def __init__(
        self, scenario: Scenario, refinement: int = 1, margin: float | None = None, reach: float = 1.3
    ) -> None:
        self.scenario, self.reach = scenario, reach
        depth = -TOLERATED_DEPTH * scenario.robot.radius if margin is None else margin
        x_min, y_min, x_max, y_max = scenario.arena
        distance = math.dist(scenario.start[:2], scenario.goal[:2])
        cell = min(max(distance / CELLS_ON_THE_WAY, SMALLEST_CELL), LARGEST_CELL) / refinement
        self.cell = max(cell, (x_max - x_min) / MOST_CELLS, (y_max - y_min) / MOST_CELLS)
        # The start is a lattice point.
        x, y, _ = scenario.start
        left, below = int((x - x_min) / self.cell) + BORDER, int((y - y_min) / self.cell) + BORDER
        right, above = int((x_max - x) / self.cell) + BORDER, int((y_max - y) / self.cell) + BORDER
        self.origin = (x - left * self.cell, y - below * self.cell)
        self.columns, self.lines = left + right + 1, below + above + 1
        band = max(FELT * scenario.cost.proximity_scale, 2.0 * depth, 0.1)
        phi, clearance = sample_grid(
            scenario.field, *self.origin, self.cell / 2, 2 * self.columns - 1, 2 * self.lines - 1, band
        )
        phi[clearance < depth] = np.inf
        for side in (np.s_[: 2 * BORDER], np.s_[-2 * BORDER :]):
            phi[side] = phi[:, side] = np.inf
        self.phi = phi
        self.energy = 0.0

    @property
    def slack(self) -> float:
        """Cost of a metre in the open, at the current energy: manoeuvres are long compared with a goal near by."""
        return math.sqrt(2 * self.energy * self.scenario.cost.speed_weight)

    def candidates(self) -> Iterator[Candidate]:
        """Distinct paths, cheapest first; none if the goal cannot be reached."""
        start, goal = self.scenario.start, self.scenario.goal
        self.energy = self._first_energy()
        if self.energy == 0.0:
            return
        ahead, behind, limit = self._trees(start, goal)
        best = meeting_nodes(ahead[1], behind[1], ahead[0], behind[0], limit)[:1]
        if len(best) == 0:
            return
        lengths, phi = self._pieces(self._poses(path_through(best[0], ahead[1], behind[1])))
        energy = energy_of(lengths, phi, self.scenario.horizon)
        if abs(math.log(energy / self.energy)) > LARGEST_CORRECTION:
            self.energy = energy
            ahead, behind, limit = self._trees(start, goal)
        taken = np.zeros(self.columns * self.lines * HEADINGS, dtype=bool)
        for node in meeting_nodes(ahead[1], behind[1], ahead[0], behind[0], limit):
            if not taken[node]:
                path = path_through(node, ahead[1], behind[1])
                mark(taken, path, self.lines, self.SAME_CELLS, self.SAME_HEADINGS)
                yield self._candidate(path, float(ahead[0][node] + behind[0][node]))

    def _first_energy(self) -> float:
        """E of a path somewhat longer than the shortest one in the plane; 0 if there is none."""
        weight, horizon = self.scenario.cost.speed_weight, self.scenario.horizon
        distance = math.dist(self.scenario.start[:2], self.scenario.goal[:2])
        # Any E finds a short path, whose length then gives a better one.
        energy = max(0.5 * weight * (distance / horizon) ** 2, 1e-4)
        speed = np.sqrt(2.0 * (energy + self.phi))
        seeds = np.unique(self._seeds(*self.scenario.start, speed)[0] // HEADINGS)
        targets = np.unique(self._seeds(*self.scenario.goal, speed)[0] // HEADINGS)
        if len(seeds) == 0 or len(targets) == 0:
            return 0.0
        cost = plane_costs(speed, seeds, np.zeros(len(seeds)), self.cell, weight)[targets].min()
        if not np.isfinite(cost):
            return 0.0
        length = TURNING * float(cost) / math.sqrt(2.0 * energy)
        return max(0.5 * (length / horizon) ** 2, 1e-4)

    def _trees(
        self, start: Pose, goal: Pose
    ) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], float]:
        """Costs and predecessors of the nodes from the start and from the goal, and the cost of the dearest path."""
        weights = self.scenario.cost.speed_weight, self.scenario.cost.turn_weight
        speed = np.sqrt(2.0 * (self.energy + self.phi))
        seeds, seed_costs = self._seeds(*start, speed)
        ends, end_costs = self._seeds(*goal, speed)
        bound = plane_costs(speed, np.unique(seeds // HEADINGS), np.zeros(len(np.unique(seeds // HEADINGS))), self.cell, weights[0])
        arguments = (self.cell, *weights, self.reach, self.slack)
        cost_behind, behind, limit = tree(
            speed, ends, end_costs, seeds, seed_costs, bound, False, *arguments, np.inf
        )
        cost_ahead, ahead, _ = tree(
            speed, seeds, seed_costs, ends, end_costs, cost_behind, True, *arguments, limit
        )
        return (cost_ahead, ahead), (cost_behind, behind), limit

    def _seeds(self, x: float, y: float, heading: float | None, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes around a pose and the cost to reach them from it."""
        cost = self.scenario.cost
        fi, fj = (x - self.origin[0]) / self.cell, (y - self.origin[1]) / self.cell
        nodes, costs = [], []
        turns = np.zeros(HEADINGS) if heading is None else np.abs((ANGLES - heading + np.pi) % (2 * np.pi) - np.pi)
        headings = np.flatnonzero(turns <= SEED_ANGLE)
        for i in range(math.floor(fi), math.floor(fi) + 2):
            for j in range(math.floor(fj), math.floor(fj) + 2):
                if not (0 <= i < self.columns and 0 <= j < self.lines and np.isfinite(speed[2 * i, 2 * j])):
                    continue
                shift = self.cell * math.hypot(i - fi, j - fj)
                nodes.append((i * self.lines + j) * HEADINGS + headings)
                lengths = np.sqrt(cost.speed_weight * shift**2 + cost.turn_weight * turns[headings] ** 2)
                costs.append(lengths * speed[2 * i, 2 * j])
        if not nodes:
            return np.empty(0, dtype=np.int64), np.empty(0)
        return np.concatenate(nodes), np.concatenate(costs)

    def _poses(self, path: np.ndarray) -> np.ndarray:
        """Poses (N + 2, 3) from start to goal along nodes (N,)."""
        start, goal = self.scenario.start, self.scenario.goal
        poses = np.empty((len(path) + 2, 3))
        poses[0] = start
        poses[1:-1, 0] = self.origin[0] + self.cell * (path // (self.lines * HEADINGS))
        poses[1:-1, 1] = self.origin[1] + self.cell * (path // HEADINGS % self.lines)
        poses[1:-1, 2] = ANGLES[path % HEADINGS]
        poses[-1] = (goal[0], goal[1], poses[-2, 2] if goal[2] is None else goal[2])
        poses[:, 2] = np.unwrap(poses[:, 2])
        return poses

    def _pieces(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Length in the weights' metric, and Phi at the middle, of each piece of a path."""
        cost = self.scenario.cost
        step = np.diff(poses, axis=0)
        lengths = np.sqrt(cost.speed_weight * (step[:, 0] ** 2 + step[:, 1] ** 2) + cost.turn_weight * step[:, 2] ** 2)
        at = np.rint((poses[1:, :2] + poses[:-1, :2] - 2 * np.array(self.origin)) / self.cell).astype(int)
        phi = self.phi[at[:, 0], at[:, 1]]
        return lengths, np.where(np.isfinite(phi), phi, 0.0)

    def _candidate(self, path: np.ndarray, cost: float) -> Candidate:
        poses = self._poses(path)
        lengths, phi = self._pieces(poses)
        # A path of no length (the goal is the start) still takes time: spread it evenly.
        lengths = np.maximum(lengths, 1e-9)
        durations = lengths / np.sqrt(2 * (energy_of(lengths, phi, self.scenario.horizon) + phi))
        times = np.concatenate([[0.0], np.cumsum(durations)])
        return Candidate(times * (self.scenario.horizon / times[-1]), poses, cost)
