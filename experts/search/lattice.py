"""The lattice of the candidate search: a grid of cells and headings over a scenario, with its proximity cost.

The paths on it are found by `leapnav.experts.search.candidates`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from leapnav.envs.field.packing import with_weight
from leapnav.envs.field.sampling import PointGrid, sample_grid
from leapnav.envs.robots.footprints import arm_of, enclosed_radius
from leapnav.envs.robots.moves import ANGLES, HEADINGS, Moves
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.search.shortest_paths import Nodes, fill_poses

# Smallest and largest cell (m), and number of cells from start to goal: small enough for manoeuvres over a short
# distance. The obstacles are sampled at half of this resolution.
MIN_CELL, MAX_CELL, CELLS_PER_DISTANCE = 0.05, 0.2, 20
# Smallest spacing (m), and first and largest number of points per side of the grid that decides whether a path exists.
MIN_SPACING, FIRST_POINTS, MAX_POINTS = 0.02, 150, 5000
CROSS, SQUARE = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]]), np.ones((3, 3), dtype=int)  # neighbours of a point
MAX_CELLS = 250  # per side; larger arenas have larger cells
RELEVANT_DISTANCE = 12.0  # proximity scales, beyond which the proximity cost of an obstacle is negligible
MIN_TURN_LENGTH = 0.3  # smallest cost of 1 rad, as a distance in cells
SEED_ANGLE = math.radians(30)  # largest difference between the heading of a pose and that of a node next to it


class Lattice:
    """The lattice of one scenario.

    Args:
        scenario: the scenario.
        refinement: factor by which the cells are smaller than usual.
        max_cells: largest number of cells per side.
        whole: whether to cover all obstacles of a large arena, with large cells if necessary.
        strict: whether to exclude all points in obstacles. Otherwise those are included that may be next to a passage
            between the points, and paths may lead through passages that are slightly too narrow.

    Attributes:
        scenario, refinement: see above.
        cell: side of a cell (m).
        origin: position (m) of cell (0, 0).
        columns: number of cells in x.
        lines: number of cells in y.
        phi: (K, 2 columns - 1, 2 lines - 1), proximity cost on the half-cell grid, infinite where the robot cannot be;
            one layer for all headings, or one for each heading if the robot has a `footprint`.
        weight: proximity weight of phi.
        weights: weights of the squared speed and turn rate in the metric.
        moves: motion primitives of the robot.
        cropped: whether the lattice covers only a part of the arena.
        is_whole: whether it covers all obstacles of a large arena.

    """

    def __init__(
        self,
        scenario: Scenario,
        refinement: float = 1,
        *,
        max_cells: int = MAX_CELLS,
        whole: bool = False,
        strict: bool = False,
    ) -> None:
        self.scenario, self.refinement, self.is_whole = scenario, refinement, whole
        robot = scenario.robot
        x_min, y_min, x_max, y_max = scenario.arena
        distance = math.dist(scenario.start[:2], scenario.goal[:2])
        cell = min(max(distance / CELLS_PER_DISTANCE, MIN_CELL), MAX_CELL, robot.max_lattice_cell()) / refinement
        x, y, _ = scenario.start
        if not whole:  # limits the search to the surroundings of start and goal, so that the cells stay small
            half = max(cell * max_cells / 2, 0.75 * distance)
            middle = (x + scenario.goal[0]) / 2, (y + scenario.goal[1]) / 2
            low, high = np.subtract(middle, half), np.add(middle, half)
        else:
            low, high = _occupied(scenario)
        x_min, y_min = np.maximum((x_min, y_min), low).tolist()
        x_max, y_max = np.minimum((x_max, y_max), high).tolist()
        self.cropped = not whole and (x_min, y_min, x_max, y_max) != tuple(scenario.arena)
        self.cell = max(cell, (x_max - x_min) / max_cells, (y_max - y_min) / max_cells)
        speed_weight, turn_weight = robot.metric(scenario.cost)
        # If rotation had almost no cost, all headings of a cell would be equivalent, and the search would not end.
        turn_weight = max(turn_weight, speed_weight * (MIN_TURN_LENGTH * self.cell) ** 2)
        self.weights = speed_weight, turn_weight
        self.moves: Moves = robot.lattice_moves(self.cell, speed_weight, turn_weight)
        border = self.moves.border
        # The start is a lattice point.
        left, below = int((x - x_min) / self.cell) + border, int((y - y_min) / self.cell) + border
        right, above = int((x_max - x) / self.cell) + border, int((y_max - y) / self.cell) + border
        self.origin = (x - left * self.cell, y - below * self.cell)
        self.columns, self.lines = left + right + 1, below + above + 1
        band = max(RELEVANT_DISTANCE * scenario.cost.proximity_scale, 0.1)
        # A passage that just admits the robot may lie between the points, half a diagonal of their squares away.
        depth = 0.0 if strict else -math.sqrt(0.5) * self.cell / 2
        if not strict and not self.moves.rotating:  # on an arc, the heading is up to half a step from that of a node
            depth -= arm_of(scenario.outline) * math.pi / HEADINGS
        self.weight = scenario.cost.proximity_weight
        field = with_weight(scenario.field, 1.0)
        grid = PointGrid(*self.origin, self.cell / 2, 2 * self.columns - 1, 2 * self.lines - 1)
        outside = np.zeros((grid.columns, grid.lines), dtype=bool)
        for side in (np.s_[: 2 * border], np.s_[-2 * border :]):
            outside[side] = outside[:, side] = True
        layers = []
        for heading in ANGLES if scenario.robot.footprint is not None else ANGLES[:1]:
            total = np.zeros(outside.shape)
            for *row, joint in scenario.outline.tolist():
                if joint:  # the angle is not known
                    continue
                phi, clearance = sample_grid(field, tuple(row), float(heading), grid, band)
                phi[clearance < depth] = np.inf
                total += phi
            total[outside] = np.inf
            layers.append(total)
        self._unit = np.stack(layers)
        self.phi = _weighted(self._unit, self.weight)

    def with_weight(self, weight: float) -> Lattice:
        """Return the lattice with another proximity weight."""
        lattice = copy(self)
        lattice.weight, lattice.phi = weight, _weighted(self._unit, weight)
        return lattice

    def metric_lengths(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return length in the metric of the weights, and Phi at the midpoint, of each step of a path (N, 3)."""
        speed_weight, turn_weight = self.scenario.robot.metric(self.scenario.cost)
        step = poses[1:] - poses[:-1]
        lengths = np.sqrt(speed_weight * (step[:, 0] ** 2 + step[:, 1] ** 2) + turn_weight * step[:, 2] ** 2)
        at = np.rint((poses[1:, :2] + poses[:-1, :2] - 2 * np.array(self.origin)) / self.cell).astype(int)
        layer: np.ndarray | int = 0
        if len(self.phi) > 1:
            layer = np.abs((ANGLES - poses[:-1, 2, None] + np.pi) % (2 * np.pi) - np.pi).argmin(axis=1)
        phi = self.phi[layer, at[:, 0], at[:, 1]]
        return lengths, np.where(np.isfinite(phi), phi, 0.0)

    def nodes_around(self, x: float, y: float, heading: float | None, speed: np.ndarray) -> Nodes:
        """Return the nodes around a pose, with the costs to reach them from it.

        Args:
            x: position (m).
            y: position (m).
            heading: heading (rad); None for all headings.
            speed: sqrt(2 (E + Phi)) on the half-cell grid, minimum over the headings.

        """
        speed_weight, turn_weight = self.scenario.robot.metric(self.scenario.cost)
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
                lengths = np.sqrt(speed_weight * shift**2 + turn_weight * turns[headings] ** 2)
                costs.append(lengths * speed[2 * i, 2 * j])
        if not nodes:
            return Nodes(np.empty(0, dtype=np.int64), np.empty(0))
        return Nodes(np.concatenate(nodes), np.concatenate(costs))

    def poses(self, path: np.ndarray) -> np.ndarray:
        """Return the poses (N + 2, 3) from start to goal along nodes (N,)."""
        poses = np.empty((len(path) + 2, 3))
        poses[0] = self.scenario.start
        fill_poses(path, self.lines, *self.origin, self.cell, poses)
        x, y, heading = self.scenario.goal
        last = float(poses[-2, 2])
        poses[-1] = x, y, last if heading is None else last + math.remainder(heading - last, math.tau)
        return poses


def _weighted(unit: np.ndarray, weight: float) -> np.ndarray:
    """Return the proximity cost of a weight from that of the weight 1, infinite where the robot cannot be."""
    return weight * unit if weight > 0.0 else np.where(np.isfinite(unit), 0.0, np.inf)


def is_connected(scenario: Scenario) -> bool:
    """Return whether a collision-free path may exist from start to goal.

    A path of the robot is also one of a disc around (x, y) in its footprint, which can rotate in place, so that only
    the position matters. The squares around the points of a grid contain a path of the disc only if the clearance is
    above minus half of their diagonal, so that False is certain if such squares do not connect start and goal. True is
    certain if points with positive clearance do. Otherwise the grid is refined; passages that differ from the disc by
    less than MIN_SPACING are closed.
    """
    radius = enclosed_radius(scenario.outline)
    if radius <= 0:  # the outline does not contain (x, y), which may lie in an obstacle
        return True
    low, high = _occupied(scenario)
    side = float((high - low).max())
    spacing = max(MIN_SPACING, side / FIRST_POINTS)
    while True:
        # The grid is aligned with the start and then with the goal, because the point closest to a pose that is not on
        # the grid may be inside an obstacle.
        for pose, other in ((scenario.start, scenario.goal), (scenario.goal, scenario.start)):
            at = _AlignedGrid.around(pose, low, high, spacing)
            clearance = sample_grid(scenario.field, (0.0, 0.0, 0.0, radius), 0.0, at.points, 2.0 * spacing)[1]
            ends = (at.first, at.cell_of(other))
            if not _joins(clearance > -math.sqrt(0.5) * spacing, ends, structure=CROSS):
                return False
            free = clearance > 0
            for i, j in ends:  # a pose very close to a wall may have no free neighbour on the grid
                free[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = True
            if _joins(free, ends, structure=SQUARE):
                return True
        if spacing <= MIN_SPACING:
            return False
        if side > MAX_POINTS * spacing / 2:
            return True
        spacing = max(MIN_SPACING, spacing / 2)


class _AlignedGrid(NamedTuple):
    """A grid of points, one of which is a given position, with the index of that point."""

    points: PointGrid
    first: tuple[int, int]

    @classmethod
    def around(cls, pose: Sequence[float | None], low: np.ndarray, high: np.ndarray, spacing: float) -> _AlignedGrid:
        """Return the grid from `low` to `high` (m) that contains the position of a pose."""
        at = np.array(pose[:2], dtype=float)
        before, after = (np.ceil(gap / spacing).astype(int) for gap in (at - low, high - at))
        columns, lines = (before + after + 1).tolist()
        i, j = before.tolist()
        x, y = (at - before * spacing).tolist()
        return cls(PointGrid(x, y, spacing, columns, lines), (i, j))

    def cell_of(self, pose: Sequence[float | None]) -> tuple[int, int]:
        """Return the index of the point closest to the position of a pose."""
        grid = self.points
        at = np.rint((np.array(pose[:2], dtype=float) - (grid.x0, grid.y0)) / grid.spacing).astype(int)
        i, j = np.clip(at, 0, (grid.columns - 1, grid.lines - 1)).tolist()
        return i, j


def _joins(free: np.ndarray, ends: tuple[tuple[int, int], tuple[int, int]], structure: np.ndarray) -> bool:
    """Return whether two points are in the same region of free points."""
    regions = np.empty(free.shape, dtype=np.int32)
    label(free, structure=structure, output=regions)
    first, second = regions[ends[0]], regions[ends[1]]
    return bool(first == second) and first > 0


def _occupied(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) of the part of the arena that contains all obstacles and poses, with a margin around it.

    Outside of it there is nothing to avoid, and no shortest path leaves it.
    """
    outlines = [part.outline() for obstacle in scenario.obstacles for part in obstacle.shape.parts()]
    points = np.concatenate([*outlines, [scenario.start[:2], scenario.goal[:2]]])
    margin = RELEVANT_DISTANCE * scenario.cost.proximity_scale + 2.0 * (
        arm_of(scenario.outline) + float(scenario.outline[:, 3].max())
    )
    x_min, y_min, x_max, y_max = scenario.arena
    low = np.maximum(points.min(axis=0) - margin, (x_min, y_min))
    high = np.minimum(points.max(axis=0) + margin, (x_max, y_max))
    return low, high
