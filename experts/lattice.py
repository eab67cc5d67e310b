"""Global search for candidate paths: Dijkstra over (x, y, heading) in the metric that the problem itself defines.

On an extremal of the driftless robot H = -E is constant, so |u|_R = sqrt(2 (E + Phi)), and the optimum is a shortest
path for ds = sqrt(2 (E + Phi)) sqrt(r_v ds_xy^2 + r_w dtheta^2) (Maupertuis' principle); E follows from the horizon,
T = integral of ds / (2 (E + Phi)). The search therefore knows about reversing, cusps, windings of the heading and the
allocation of time together. One tree grows from the start and one from the goal; their sum at a node is the cost of the
best path through it, and taking nodes in that order, away from paths already taken, yields distinct candidates.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import boolean, float64, int32, int64, njit, types

from leapnav.envs.obstacles import clearance, proximity
from leapnav.envs.scenario import Scenario
from leapnav.experts.integrator import constant, matrix, vector

# 16 headings whose directions are exact lattice vectors, so a straight move never drifts off its line.
_QUADRANT = np.array([(1, 0), (2, 1), (1, 1), (1, 2)], dtype=np.int64)
_QUARTER_TURN = np.array([(0, 1), (-1, 0)], dtype=np.int64)
DIRECTIONS = np.concatenate([_QUADRANT @ np.linalg.matrix_power(_QUARTER_TURN, k) for k in range(4)])
ANGLES = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) % (2 * np.pi)
HEADINGS = len(ANGLES)
# The cell (m) is small enough to manoeuvre over a short way; half of it is the resolution at which obstacles are seen.
SMALLEST_CELL, LARGEST_CELL, CELLS_ON_THE_WAY = 0.05, 0.2, 20
MOST_CELLS = 250  # per side; larger arenas get larger cells
# How far inside an obstacle, in robot radii, a lattice point may lie: a gap that the robot just passes can lie between
# two points, but no wall is thinner than the robot.
TOLERATED_DEPTH = 0.4
MOVES = 12  # per node, see `_move`
ENERGY_CORRECTIONS, ENERGY_TOLERANCE = 2, 0.3  # the latter of log E: the order of candidates hardly depends on it
Pose = tuple[float, float, float | None]


@dataclass(frozen=True)
class Candidate:
    """A path of poses, not yet feasible: times (N,), poses (N, 3) with unwrapped headings, and its lattice cost."""

    times: np.ndarray
    poses: np.ndarray
    cost: float


@njit(types.UniTuple(int64, 4)(int64, int64), cache=True, nogil=True)
def _move(heading, number):
    """Move `number` from a heading: (cells x, cells y, heading change, gear).

    0-4 forwards, 5-9 backwards: straight, or one heading step to either side along the old or the new heading (each
    the other's reverse, so the graph is symmetric). 10-11: turn on the spot.
    """
    if number >= 10:
        return 0, 0, 2 * (number - 10) - 1, 0
    gear = 1 if number < 5 else -1
    kind = number % 5
    change = 0 if kind == 0 else (1 if kind % 2 == 1 else -1)
    along = (heading + change) % HEADINGS if kind >= 3 else heading
    return gear * DIRECTIONS[along, 0], gear * DIRECTIONS[along, 1], change, gear


@njit(types.Tuple((matrix, matrix))(constant, float64, float64, float64, int64, int64), cache=True, nogil=True)
def _sample_field(field, x0, y0, spacing, columns, rows):
    """Phi and clearance on a regular grid of points."""
    phi = np.empty((columns, rows))
    free = np.empty((columns, rows))
    for i in range(columns):
        for j in range(rows):
            x, y = x0 + i * spacing, y0 + j * spacing
            phi[i, j] = proximity(x, y, field)[0]
            free[i, j] = clearance(x, y, field)[0]
    return phi, free


@njit(
    types.Tuple((vector, int32[::1]))(
        matrix, matrix, int64[::1], vector, int64[::1], float64, float64, float64, float64, float64, float64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _dijkstra(speed, free, seeds, seed_costs, targets, cell, speed_weight, turn_weight, reach, slack, margin):
    """Cost to every node (nx * ny * HEADINGS) and its predecessor, from the seeds out.

    `speed` = sqrt(2 (E + Phi)) and `free` = clearance on the half-cell grid. Stops beyond `reach` times the cost of the
    first target, and `slack` more. `margin` (m) is the smallest clearance of a point.
    """
    nx, ny = (speed.shape[0] + 1) // 2, (speed.shape[1] + 1) // 2
    cost = np.full(nx * ny * HEADINGS, np.inf)
    parent = np.full(nx * ny * HEADINGS, -1, dtype=np.int32)
    done = np.zeros(nx * ny * HEADINGS, dtype=np.bool_)
    is_target = np.zeros(nx * ny * HEADINGS, dtype=np.bool_)
    for target in targets:
        is_target[target] = True
    lengths = np.empty((HEADINGS, MOVES))
    for k in range(HEADINGS):
        for number in range(MOVES):
            dx, dy, change, _ = _move(k, number)
            turn = abs(ANGLES[(k + change) % HEADINGS] - ANGLES[k])
            turn = min(turn, 2 * math.pi - turn)
            lengths[k, number] = math.sqrt(speed_weight * (dx * dx + dy * dy) * cell * cell + turn_weight * turn * turn)
    queue = [(0.0, 0)]
    queue.pop()
    for k in range(len(seeds)):
        if seed_costs[k] < cost[seeds[k]]:
            cost[seeds[k]] = seed_costs[k]
            heapq.heappush(queue, (seed_costs[k], seeds[k]))
    limit = np.inf
    while len(queue) > 0:
        key, node = heapq.heappop(queue)
        if done[node]:
            continue
        if key > limit:
            break
        done[node] = True
        if is_target[node] and limit == np.inf:
            # A metre more than a multiple of the best: manoeuvres around a goal near by are long compared with it.
            limit = reach * key + slack
        k = node % HEADINGS
        j = (node // HEADINGS) % ny
        i = node // (HEADINGS * ny)
        for number in range(MOVES):
            dx, dy, change, _ = _move(k, number)
            a, b = i + dx, j + dy
            if a < 0 or b < 0 or a >= nx or b >= ny:
                continue
            following = (a * ny + b) * HEADINGS + (k + change) % HEADINGS
            if done[following]:
                continue
            middle_x, middle_y = 2 * i + dx, 2 * j + dy
            if free[2 * a, 2 * b] < margin or free[middle_x, middle_y] < margin:
                continue
            mean = (speed[2 * i, 2 * j] + 4.0 * speed[middle_x, middle_y] + speed[2 * a, 2 * b]) / 6.0
            total = key + lengths[k, number] * mean
            if total < cost[following]:
                cost[following] = total
                parent[following] = node
                heapq.heappush(queue, (total, following))
    for node in range(len(cost)):
        if not done[node]:
            cost[node] = np.inf
    return cost, parent


@njit(boolean(boolean[:, :, ::1], int64, int64, int64, int64, int64), cache=True, nogil=True)
def _mark(taken, i, j, k, cells, headings):
    """Marks the nodes around one: within `cells` in x and y and `headings` steps of heading."""
    nx, ny, _ = taken.shape
    for a in range(max(0, i - cells), min(nx, i + cells + 1)):
        for b in range(max(0, j - cells), min(ny, j + cells + 1)):
            for c in range(-headings, headings + 1):
                taken[a, b, (k + c) % HEADINGS] = True
    return True


class Lattice:
    """The search of one scenario. `candidates` yields paths in order of promise.

    Args:
        refinement: how many times finer than usual the cells are.
        margin: smallest clearance (m) of the lattice's points; None tolerates a little depth, see TOLERATED_DEPTH.

    """

    # Nodes this near (cells, heading steps) to a path already taken belong to it.
    SAME_CELLS, SAME_HEADINGS = 2, 3
    # Candidates this much dearer than the first, in the lattice's own cost, are not worth a look.
    REACH = 1.6

    def __init__(self, scenario: Scenario, refinement: int = 1, margin: float | None = None) -> None:
        self.scenario = scenario
        self.margin = -TOLERATED_DEPTH * scenario.robot.radius if margin is None else margin
        x_min, y_min, x_max, y_max = scenario.arena
        distance = math.dist(scenario.start[:2], scenario.goal[:2])
        cell = min(max(distance / CELLS_ON_THE_WAY, SMALLEST_CELL), LARGEST_CELL) / refinement
        self.cell = max(cell, (x_max - x_min) / MOST_CELLS, (y_max - y_min) / MOST_CELLS)
        # The start is a lattice point.
        x, y, _ = scenario.start
        left, below = int((x - x_min) / self.cell), int((y - y_min) / self.cell)
        right, above = int((x_max - x) / self.cell), int((y_max - y) / self.cell)
        self.origin = (x - left * self.cell, y - below * self.cell)
        self.shape = (left + right + 1, below + above + 1)
        self.phi, self.free = _sample_field(
            scenario.field, *self.origin, self.cell / 2, 2 * self.shape[0] - 1, 2 * self.shape[1] - 1
        )
        self.energy = self._first_energy()

    def _first_energy(self) -> float:
        (x0, y0, theta0), (x1, y1, theta1) = self.scenario.start, self.scenario.goal
        cost = self.scenario.cost
        turn = 0.0 if theta1 is None else math.remainder(theta1 - theta0, 2 * math.pi)
        # Paths are longer than the straight line; the search corrects this.
        length = 1.3 * math.sqrt(cost.speed_weight * math.hypot(x1 - x0, y1 - y0) ** 2 + cost.turn_weight * turn**2)
        return max(0.5 * (length / self.scenario.horizon) ** 2, 1e-4)

    @property
    def slack(self) -> float:
        """Cost of a metre in the open, at the current energy."""
        return math.sqrt(2 * self.energy * self.scenario.cost.speed_weight)

    def _seeds(self, x: float, y: float, heading: float | None, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes around a pose and the cost to reach them from it."""
        cost = self.scenario.cost
        fi, fj = (x - self.origin[0]) / self.cell, (y - self.origin[1]) / self.cell
        nodes, costs = [], []
        for i in range(math.floor(fi), math.floor(fi) + 2):
            for j in range(math.floor(fj), math.floor(fj) + 2):
                if not (0 <= i < self.shape[0] and 0 <= j < self.shape[1]):
                    continue
                shift = self.cell * math.hypot(i - fi, j - fj)
                for k, angle in enumerate(ANGLES):
                    turn = 0.0 if heading is None else abs(math.remainder(angle - heading, 2 * math.pi))
                    if turn > math.radians(30):
                        continue
                    nodes.append((i * self.shape[1] + j) * HEADINGS + k)
                    length = math.sqrt(cost.speed_weight * shift**2 + cost.turn_weight * turn**2)
                    costs.append(length * float(speed[2 * i, 2 * j]))
        return np.array(nodes, dtype=np.int64), np.array(costs)

    def candidates(self) -> Iterator[Candidate]:
        """Distinct paths, cheapest first; none if the goal cannot be reached."""
        no_parent = np.full(self.shape[0] * self.shape[1] * HEADINGS, -1, dtype=np.int32)
        ahead, parents_ahead, at_goal = self._tree(self.scenario.start, self.scenario.goal)
        for _ in range(ENERGY_CORRECTIONS):
            if at_goal is None:
                return
            energy = self._energy(self._path(parents_ahead, no_parent, at_goal))
            if abs(math.log(energy / self.energy)) < ENERGY_TOLERANCE:
                break
            self.energy = energy
            ahead, parents_ahead, at_goal = self._tree(self.scenario.start, self.scenario.goal)
        behind, parents_behind, _ = self._tree(self.scenario.goal, self.scenario.start)
        through = ahead + behind
        order = np.argsort(through)
        order = order[: np.searchsorted(through[order], self.REACH * through[order[0]] + self.slack)]
        taken = np.zeros((*self.shape, HEADINGS), dtype=bool)
        flat = taken.ravel()
        for node in order:
            if flat[node]:
                continue
            path = self._path(parents_ahead, parents_behind, int(node))
            for i, j, k in path[0]:
                _mark(taken, i, j, k, self.SAME_CELLS, self.SAME_HEADINGS)
            yield self._candidate(path, float(through[node]))

    def _tree(self, root: Pose, target: Pose) -> tuple[np.ndarray, np.ndarray, int | None]:
        """Cost and predecessor of every node from one pose out, and the best node at the other (None: unreached)."""
        cost = self.scenario.cost
        speed = np.sqrt(2.0 * (self.energy + self.phi))
        seeds, seed_costs = self._seeds(*root, speed)
        ends, end_costs = self._seeds(*target, speed)
        costs, parents = _dijkstra(
            speed,
            self.free,
            seeds,
            seed_costs,
            ends,
            self.cell,
            cost.speed_weight,
            cost.turn_weight,
            self.REACH,
            self.slack,
            self.margin,
        )
        totals = costs[ends] + end_costs
        best = int(np.argmin(totals))
        return costs, parents, int(ends[best]) if np.isfinite(totals[best]) else None

    def _path(self, ahead: np.ndarray, behind: np.ndarray, node: int) -> tuple[np.ndarray, np.ndarray]:
        """The path through a node: lattice indices (N, 3) and poses (N + 2, 3) from start to goal."""
        nodes = [node]
        while ahead[nodes[-1]] >= 0:
            nodes.append(int(ahead[nodes[-1]]))
        nodes.reverse()
        while behind[nodes[-1]] >= 0:
            nodes.append(int(behind[nodes[-1]]))
        index = np.stack(np.unravel_index(nodes, (*self.shape, HEADINGS)), axis=1)
        start, goal = self.scenario.start, self.scenario.goal
        poses = np.empty((len(nodes) + 2, 3))
        poses[0] = start
        poses[1:-1, 0] = self.origin[0] + self.cell * index[:, 0]
        poses[1:-1, 1] = self.origin[1] + self.cell * index[:, 1]
        poses[1:-1, 2] = ANGLES[index[:, 2]]
        poses[-1] = (goal[0], goal[1], poses[-2, 2] if goal[2] is None else goal[2])
        poses[:, 2] = np.unwrap(poses[:, 2])
        return index, poses

    def _segments(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Length in the weights' metric, and Phi at the middle, of each piece of a path."""
        cost = self.scenario.cost
        step = np.diff(poses, axis=0)
        length = np.sqrt(cost.speed_weight * (step[:, 0] ** 2 + step[:, 1] ** 2) + cost.turn_weight * step[:, 2] ** 2)
        middle = (poses[1:] + poses[:-1]) / 2
        phi = np.array([proximity(x, y, self.scenario.field)[0] for x, y, _ in middle])
        return length, phi

    def _energy(self, path: tuple[np.ndarray, np.ndarray]) -> float:
        """E such that the path takes the horizon, by bisection on log E."""
        length, phi = self._segments(path[1])
        low, high = 1e-6, 1e4
        for _ in range(40):
            middle = math.sqrt(low * high)
            duration = float(np.sum(length / np.sqrt(2 * (middle + phi))))
            low, high = (middle, high) if duration > self.scenario.horizon else (low, middle)
        return math.sqrt(low * high)

    def _candidate(self, path: tuple[np.ndarray, np.ndarray], cost: float) -> Candidate:
        length, phi = self._segments(path[1])
        # A path of no length (the goal is the start) still takes time: spread it evenly.
        durations = np.maximum(length, 1e-9) / np.sqrt(2 * (self._energy(path) + phi))
        times = np.concatenate([[0.0], np.cumsum(durations)])
        return Candidate(times * (self.scenario.horizon / times[-1]), path[1], cost)
