"""Candidate paths among moving obstacles: the cheapest path over position and time of each path class."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from leapnav.envs.field.packing import obstacle_centres
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import Trajectory
from leapnav.experts.spacetime.lattice import grid_of, sample_layers, spread

MAX_CLASSES = 8  # path classes of which the cheapest path is a candidate
MAX_EXCESS = 1.0  # relative to the cheapest path, of a class
SLOW = 0.2  # fraction of the mean speed below which a path has no direction
CUSPS = 0.15, 0.5, 0.85  # fractions of the path at which the driving direction may change
BOTH_SIDES = math.pi / 2  # rad, of a turn above which the turn to the other side is considered, too
# Driving modes of a path, and the turns (rad) that they have more than the best one. Of 50 static scenarios each, 1, 1
# and 2 optima of `open`, `clutter` and `polygons` are missed; with 0.7 pi, 5, 6 and 5.
MAX_MODES, MAX_TURN = 6, math.pi
OFFSET = 1e-6  # cells


class SpaceTimeSearch:
    """The cheapest path of each class over position and time.

    Args:
        scenario: the scenario.
        field: its packed field, with the proximity weight of the search.
        horizon: time in which the robot goes from start to goal (s).

    Attributes:
        horizon: s.
        cheapest: cost of the cheapest path; infinite if there is none.

    """

    def __init__(self, scenario: Scenario, field: np.ndarray, horizon: float) -> None:
        self._scenario, self.horizon = scenario, horizon
        self._grid = grid = grid_of(scenario, horizon)
        costs = np.empty((grid.layers + 1, grid.columns, grid.lines))
        radius = float(scenario.outline[:, 2:4].sum(axis=1).min())
        sample_layers(field, scenario.outline, np.array([grid.x0, grid.y0, grid.cell, grid.step, radius]), costs)
        speed_weight = scenario.robot.metric(scenario.cost)[0]
        weight = 0.5 * speed_weight * grid.cell**2 / grid.step
        times = grid.step * np.arange(grid.layers + 1)
        # Not the centres of cells, so that no path passes exactly above or below an obstacle.
        centres = (obstacle_centres(field, times) - (grid.x0, grid.y0)) / grid.cell + OFFSET
        centres = centres.reshape(len(times), -1)
        found = []
        for pose, order in ((scenario.start, 1), (scenario.goal, -1)):
            cell = [round((pose[0] - grid.x0) / grid.cell), round((pose[1] - grid.y0) / grid.cell)]
            cell = np.clip(cell, 0, [grid.columns - 1, grid.lines - 1]).tolist()
            layers, places = np.ascontiguousarray(costs[::order]), np.ascontiguousarray(centres[::order])
            values, parents = np.empty_like(costs), np.empty(costs.size, np.int64)
            signatures = np.empty(costs.size, np.int64)
            spread(layers, np.array([*cell, grid.reach]), weight, values, parents, places, signatures)
            shape = costs.shape
            found.append([array.reshape(shape)[::order] for array in (values, parents, signatures)])
        (self._before, self._parents, signed), (self._after, self._children, unsigned) = found
        self._totals = self._before + self._after - np.where(np.isfinite(costs), costs, 0.0)
        self._signatures = signed - unsigned
        self.cheapest = float(self._totals.min())

    def candidates(self) -> Iterator[Trajectory]:
        """Yield the cheapest path of each class in order of cost, in the best driving modes."""
        totals = self._totals
        order = np.argsort(totals, axis=None, kind="stable")
        flat, signatures = totals.ravel()[order], self._signatures.ravel()[order]
        count = int(np.searchsorted(flat, self.cheapest * (1.0 + MAX_EXCESS)))
        _, first = np.unique(signatures[:count], return_index=True)
        for index in np.sort(first)[:MAX_CLASSES].tolist():
            positions = self._positions(int(order[index]))
            yield from self._lifted(positions)

    def _positions(self, node: int) -> np.ndarray:
        """Return the positions (layers + 1, 2) (m) of the cheapest path through a cell of a layer."""
        grid, size = self._grid, self._grid.columns * self._grid.lines
        layer, cell = divmod(node, size)
        cells = np.empty(grid.layers + 1, np.int64)
        cells[layer] = cell
        for k in range(layer, 0, -1):
            cells[k - 1] = self._parents[k].ravel()[cells[k]]
        for k in range(layer, grid.layers):
            cells[k + 1] = self._children[k].ravel()[cells[k]]
        positions = np.stack(np.divmod(cells, grid.lines), axis=1) * grid.cell + (grid.x0, grid.y0)
        positions[0], positions[-1] = self._scenario.start[:2], self._scenario.goal[:2]
        for _ in range(2):  # the steps of a grid have few directions
            positions[1:-1] = 0.25 * positions[:-2] + 0.5 * positions[1:-1] + 0.25 * positions[2:]
        return positions

    def _lifted(self, positions: np.ndarray) -> list[Trajectory]:
        """Return the path in the best driving modes, as poses (N, 3).

        The headings are along the path or against it, and change once at most. The robot turns at the start and at the
        goal, to the one or to the other side. The modes with the smallest turns are the best.
        """
        times = np.linspace(0.0, self.horizon, len(positions))
        rates = np.gradient(positions, times, axis=0)
        speeds = np.hypot(*rates.T)
        moves = speeds > SLOW * speeds.mean()
        start, goal = self._scenario.start[2], self._scenario.goal[2]
        if not moves.any():
            ends = np.linspace(start, start if goal is None else goal, len(times))
            return [Trajectory(times, np.column_stack([positions, ends]))]
        along = np.interp(times, times[moves], np.unwrap(np.arctan2(rates[moves, 1], rates[moves, 0])))
        fractions = np.cumsum(np.append(0.0, np.hypot(*np.diff(positions, axis=0).T)))
        fractions /= fractions[-1]
        found = []
        for first, last in product((0.0, np.pi), repeat=2):
            for cusp in (0.0,) if first == last else CUSPS:
                headings = along + np.where(fractions < cusp, first, last)
                turns = [_turns(start, headings[0]), [0.0] if goal is None else _turns(headings[-1], goal)]
                for before, after in product(*turns):
                    poses = headings + (start + before - headings[0])
                    ends = np.concatenate([[start], poses[1:-1], [poses[-1] + after]])
                    states = np.column_stack([positions, ends])
                    found.append((abs(before) + abs(after), Trajectory(times, states)))
        found.sort(key=lambda entry: entry[0])
        return [path for turns, path in found[:MAX_MODES] if turns <= found[0][0] + MAX_TURN]


def _turns(heading: float, other: float) -> list[float]:
    """Return the turns (rad) from a heading to another one, to both sides if they are similar."""
    turn = math.remainder(other - heading, 2 * math.pi)
    return [turn, turn - math.copysign(2 * math.pi, turn)] if abs(turn) > BOTH_SIDES else [turn]
