"""Global search for candidate paths: shortest paths over (x, y, heading) in the metric that the problem itself defines.

On an extremal of the driftless robot H = -E is constant, so |u|_R = sqrt(2 (E + Phi)), and the optimum is a shortest
path for ds = sqrt(2 (E + Phi)) sqrt(r_v ds_xy^2 + r_w dtheta^2) (Maupertuis' principle); E follows from the horizon,
T = integral of ds / (2 (E + Phi)). The search therefore knows about reversing, cusps, windings of the heading and the
allocation of time together. Shortest paths in the plane, for which turning is free, bound those on the lattice from
below and so direct one tree from the goal, whose costs then direct one from the start. Where the trees share an edge,
the path through it is locally shortest; the cheapest such paths that are distinct are the candidates.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

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
FINEST_SPACING, MOST_POINTS = 0.02, 600  # of the grid on which it is seen whether there is a way at all (m, per side)
MOST_CELLS = 250  # per side; larger arenas get larger cells
# How far inside an obstacle, in robot radii, a lattice point may lie: a gap that the robot just passes can lie between
# two points, but no wall is thinner than the robot.
TOLERATED_DEPTH = 0.4
FELT = 12.0  # proximity scales; farther obstacles change the order of paths by less than a millionth
TURNING = 1.2  # how much longer a path is than the shortest one in the plane, at first; corrected if far off
LARGEST_CORRECTION = 0.5  # of log E: the order of candidates hardly depends on it
LEAST_ENERGY = 1e-4
CHEAPEST_TURN = 0.3  # cells driven for what a radian costs
SLOWEST = 0.3  # least E of a path, relative to what it has where Phi is small
LATTICE_ERROR = 1.07  # see `explains`; 1.067 was the largest in 200 scenarios
SEED_ANGLE = math.radians(30)
Pose = tuple[float, float, float | None]


@dataclass(frozen=True)
class Candidate:
    """A path of poses, not yet feasible: times (N,), poses (N, 3) with unwrapped headings, and its lattice cost."""

    times: np.ndarray
    poses: np.ndarray
    cost: float


@dataclass(frozen=True)
class Place:
    """Where the robot does not get through (m), the clearance (m) of a path there, and whether to keep well clear."""

    x: float
    y: float
    clearance: float
    wide: bool = False


class Tree(NamedTuple):
    """Cost of each node from the root, and its predecessor (-1: none)."""

    cost: np.ndarray
    parent: np.ndarray


class Found(NamedTuple):
    """A finished search: its trees, the nodes where they meet in order of cost, and the paths yielded so far."""

    ahead: Tree
    behind: Tree
    nodes: np.ndarray
    paths: list[np.ndarray]


class Lattice:
    """The search of one scenario. `candidates` yields paths in order of promise.

    Args:
        refinement: how many times finer than usual the cells are.
        margin: smallest clearance (m) of the lattice's points; None tolerates a little depth, see TOLERATED_DEPTH.
        reach: paths this many times as dear as the first, and a metre more, are not worth a look.
        whole: cover all of a large arena, with large cells.

    """

    # Nodes this near (cells, heading steps) to a path already taken belong to it.
    SAME_CELLS, SAME_HEADINGS = 2, 3
    # Beyond so many cells a path leads elsewhere.
    ELSEWHERE_CELLS = 4

    def __init__(
        self,
        scenario: Scenario,
        refinement: int = 1,
        margin: float | None = None,
        reach: float = 1.3,
        whole: bool = False,
    ) -> None:
        self.scenario, self.reach = scenario, reach
        depth = -TOLERATED_DEPTH * scenario.robot.radius if margin is None else margin
        x_min, y_min, x_max, y_max = scenario.arena
        distance = math.dist(scenario.start[:2], scenario.goal[:2])
        cell = min(max(distance / CELLS_ON_THE_WAY, SMALLEST_CELL), LARGEST_CELL) / refinement
        x, y, _ = scenario.start
        if not whole:  # far from start and goal a large arena need not be searched, and cells stay small
            half = max(cell * MOST_CELLS / 2, 0.75 * distance)
            middle = (x + scenario.goal[0]) / 2, (y + scenario.goal[1]) / 2
            x_min, x_max = max(x_min, middle[0] - half), min(x_max, middle[0] + half)
            y_min, y_max = max(y_min, middle[1] - half), min(y_max, middle[1] + half)
        self.cropped = (x_min, y_min, x_max, y_max) != tuple(scenario.arena)
        self.cell = max(cell, (x_max - x_min) / MOST_CELLS, (y_max - y_min) / MOST_CELLS)
        # The start is a lattice point.
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
        self._found: Found | None = None

    def without(self, places: Sequence[Place]) -> Lattice:
        """The same with some places shut to it, about as far around as a gap that is only tolerated is wide."""
        if not places:
            return self
        lattice = copy(self)
        lattice.phi, lattice._found = self.phi.copy(), None
        spacing = self.cell / 2
        ends = np.array([self.scenario.start[:2], self.scenario.goal[:2]])
        x, y = (self.origin[axis] + spacing * np.arange(count) for axis, count in enumerate(self.phi.shape))
        for place in places:
            radius = TOLERATED_DEPTH * self.scenario.robot.radius + spacing
            if place.wide:  # the middle of a gap next to it is farther away than this
                radius = max(radius, 2.0 * self.scenario.robot.radius)
            if np.hypot(*(ends - (place.x, place.y)).T).min() <= radius + 2 * self.cell:
                continue  # there every path leads
            columns, lines = np.abs(x - place.x) <= radius, np.abs(y - place.y) <= radius
            near = np.hypot(x[columns, None] - place.x, y[lines] - place.y) <= radius
            shut = np.ix_(columns, lines)
            lattice.phi[shut] = np.where(near, np.inf, lattice.phi[shut])
        return lattice

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
        nodes = meeting_nodes(ahead.parent, behind.parent, ahead.cost, behind.cost, limit)
        if len(nodes) == 0:
            return
        lengths, phi = self._pieces(self._poses(path_through(nodes[0], ahead.parent, behind.parent)))
        horizon = self.scenario.horizon
        # Through a gap that is only tolerated Phi alone may drive the path, at no E: the metric would know no distance.
        energy = max(energy_of(lengths, phi, horizon), SLOWEST * 0.5 * (float(lengths.sum()) / horizon) ** 2)
        if abs(math.log(energy / self.energy)) > LARGEST_CORRECTION:
            self.energy = energy
            ahead, behind, limit = self._trees(start, goal)
            nodes = meeting_nodes(ahead.parent, behind.parent, ahead.cost, behind.cost, limit)
        self._found = Found(ahead, behind, nodes, [])
        yield from self._distinct(self.SAME_CELLS, self.SAME_HEADINGS)

    def elsewhere(self) -> Iterator[Candidate]:
        """Those of the paths not yet yielded by `candidates` that leave all that were by nearly a metre, somewhere.

        They pass obstacles on other sides, mostly, and are dearer.
        """
        if self._found is not None:
            yield from self._distinct(self.ELSEWHERE_CELLS, HEADINGS // 2)

    def _distinct(self, cells: int, headings: int) -> Iterator[Candidate]:
        """Paths through nodes that are farther than this from all paths before."""
        assert self._found is not None
        ahead, behind, nodes, paths = self._found
        taken = np.zeros(self.columns * self.lines * HEADINGS, dtype=bool)
        for path in paths:
            mark(taken, path, self.lines, cells, headings)
        for node in nodes:
            if not taken[node]:
                path = path_through(node, ahead.parent, behind.parent)
                mark(taken, path, self.lines, cells, headings)
                paths.append(path)
                yield self._candidate(path, float(ahead.cost[node] + behind.cost[node]))

    def random_candidates(self, count: int, rng: np.random.Generator) -> Iterator[Candidate]:
        """Shortest paths through random nodes, so by detours; none if the goal cannot be reached."""
        self.energy = self._first_energy()
        if self.energy == 0.0:
            return
        ahead, behind, _ = self._trees(self.scenario.start, self.scenario.goal)
        through = ahead.cost + behind.cost
        for node in rng.choice(np.flatnonzero(np.isfinite(through)), count):
            yield self._candidate(path_through(node, ahead.parent, behind.parent), float(through[node]))

    def explains(self, cost: float, first: float, last: float) -> bool:
        """Whether no path but those from the `first` to the `last` candidate's cost can be expected to beat J = `cost`.

        For any E, a path of length D in the metric has J >= D - E T, with equality for an extremal of that E. Lattice
        paths are a little longer than the extremals near them, by LATTICE_ERROR at most in hundreds of scenarios, and
        rarely shorter; so either the first candidate is near the best path, or the last one must be too long.
        """
        length = cost + self.energy * self.scenario.horizon
        return first >= length / LATTICE_ERROR or last >= length * LATTICE_ERROR

    def _first_energy(self) -> float:
        """E of a path somewhat longer than the shortest one in the plane; 0 if there is none."""
        weight, horizon = self.scenario.cost.speed_weight, self.scenario.horizon
        start, goal = self.scenario.start, self.scenario.goal
        energy = max(0.5 * weight * (math.dist(start[:2], goal[:2]) / horizon) ** 2, LEAST_ENERGY)
        for _ in range(3):
            speed = np.sqrt(2.0 * (energy + self.phi))
            cost = self._plane_costs(self._seeds(*start, speed)[0], speed)
            targets = self._seeds(*goal, speed)[0] // HEADINGS
            shortest = float(cost[targets].min()) if len(targets) else math.inf
            if not math.isfinite(shortest):
                return 0.0
            # As if Phi were small, which it is compared with an E that is no longer the straight line's.
            length = TURNING * shortest / math.sqrt(2.0 * energy)
            before, energy = energy, max(0.5 * (length / horizon) ** 2, LEAST_ENERGY)
            if abs(math.log(energy / before)) < LARGEST_CORRECTION:
                break
        return energy

    def _plane_costs(self, seeds: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Costs of the cells from those of the seeds if turning were free."""
        cells = np.unique(seeds // HEADINGS)
        return plane_costs(speed, cells, np.zeros(len(cells)), self.cell, self.scenario.cost.speed_weight)

    def _trees(self, start: Pose, goal: Pose) -> tuple[Tree, Tree, float]:
        """The trees from the start and from the goal, and the cost of the dearest path."""
        speed_weight, turn_weight = self.scenario.cost.speed_weight, self.scenario.cost.turn_weight
        # A turn for next to nothing would make all headings of a cell one, and the search endless.
        weights = speed_weight, max(turn_weight, speed_weight * (CHEAPEST_TURN * self.cell) ** 2)
        speed = np.sqrt(2.0 * (self.energy + self.phi))
        seeds, ends = self._seeds(*start, speed), self._seeds(*goal, speed)
        bound = self._plane_costs(seeds[0], speed)
        parameters = self.cell, *weights, self.reach, self.slack
        cost_behind, behind, limit = tree(speed, *ends, *seeds, bound, False, *parameters, np.inf)
        cost_ahead, ahead, _ = tree(speed, *seeds, *ends, cost_behind, True, *parameters, limit)
        return Tree(cost_ahead, ahead), Tree(cost_behind, behind), limit

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


def is_connected(scenario: Scenario) -> bool:
    """Whether a way from start to goal exists that touches nothing, as far as a fine grid can tell.

    The robot is a disc that can turn on the spot, so it gets wherever its centre can.
    """
    x_min, y_min, x_max, y_max = scenario.arena
    spacing = max(FINEST_SPACING, (x_max - x_min) / MOST_POINTS, (y_max - y_min) / MOST_POINTS)
    connected = False
    for x, y, _ in (scenario.start, scenario.goal):
        # Each pose on the grid in turn: where two points are near, the nearest one may lie in an obstacle.
        left, below = int((x - x_min) / spacing), int((y - y_min) / spacing)
        columns, lines = left + int((x_max - x) / spacing) + 1, below + int((y_max - y) / spacing) + 1
        origin = x - left * spacing, y - below * spacing
        free = sample_grid(scenario.field, *origin, spacing, columns, lines, spacing)[1] > 0
        other = scenario.goal if (x, y) == scenario.start[:2] else scenario.start
        at = min(max(round((other[0] - origin[0]) / spacing), 0), columns - 1)
        up = min(max(round((other[1] - origin[1]) / spacing), 0), lines - 1)
        # Half a millimetre off a wall, say, a pose may have no free neighbour on the grid.
        for i, j in ((left, below), (at, up)):
            free[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = True
        regions = np.empty(free.shape, dtype=np.int32)
        label(free, structure=np.ones((3, 3)), output=regions)
        connected = connected or bool(regions[left, below] == regions[at, up])
    return connected
