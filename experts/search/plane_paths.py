"""Candidate paths across a large arena: shortest paths in the plane.

Across a large arena, the cells of the lattice over position and heading would be larger than the passages. The robot's
heading matters little there: a shortest path in the plane, driven forwards or backwards along its tangent, is a good
initial guess, and a grid of positions may have many more cells.
"""

from __future__ import annotations

import numpy as np

from leapnav.envs.robots.moves import HEADINGS
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.search.candidates import CandidateSearch, Tree, cell_costs, metric_of
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.shortest_paths import plane_parents

# Cells per side. With a `footprint`, the speeds of 16 headings are stored.
MAX_CELLS, MAX_CELLS_OF_HEADINGS = 1024, 384
DISTINCT_DISTANCE = 2.0  # m, by which the paths differ somewhere


def plane_lattice(scenario: Scenario) -> Lattice:
    """Return the lattice of a whole arena for `PlaneSearch`."""
    cells = MAX_CELLS if scenario.robot.footprint is None else MAX_CELLS_OF_HEADINGS
    return Lattice(scenario, max_cells=cells, whole=True)


class PlaneSearch(CandidateSearch):
    """Search of the positions of a lattice for candidate paths, whose nodes are cells without a heading."""

    def __init__(self, lattice: Lattice, *, energy: float | None = None) -> None:
        self._cells, self._headings = max(round(DISTINCT_DISTANCE / lattice.cell), 1), 0
        super().__init__(lattice, energy=energy)

    def _grow(self) -> None:
        scenario, metric = self.lattice.scenario, metric_of(self.lattice, self.energy)
        trees = []
        for pose in (scenario.start, scenario.goal):
            cost = cell_costs(metric, self.lattice.nodes_around(*pose, metric.plane))
            trees.append(Tree(cost, plane_parents(metric, cost)))
        self._from_start, self._to_goal = trees
        limit = self._reach * float((trees[0].cost + trees[1].cost).min()) + self.slack
        self._meetings = self._meet(limit)

    def _poses(self, nodes: np.ndarray) -> np.ndarray:
        poses = self.lattice.poses(nodes * HEADINGS)
        if len(poses) < 4:
            return poses
        step = poses[2:, :2] - poses[:-2, :2]
        headings = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        goal = self.lattice.scenario.goal[2]
        ends = ((headings[0], poses[0, 2]), *(((headings[-1], goal),) if goal is not None else ()))
        turns = [abs((a - b + np.pi) % (2 * np.pi) - np.pi) for a, b in ends]
        if sum(turns) > len(turns) * np.pi / 2:  # less rotation if the robot drives backwards
            headings += np.pi
        poses[1:-1, 2] = headings
        poses[-1, 2] = headings[-1] if goal is None else goal
        poses[:, 2] = np.unwrap(poses[:, 2])
        return poses

    def _mark(self, marked: np.ndarray, nodes: np.ndarray, cells: int, headings: int) -> None:
        del headings  # the cells have none
        grid = marked.reshape(self.lattice.columns, self.lattice.lines)
        for i, j in zip(*np.divmod(nodes, self.lattice.lines), strict=True):
            grid[max(i - cells, 0) : i + cells + 1, max(j - cells, 0) : j + cells + 1] = True
