"""Candidate paths among moving obstacles: the cheapest path over position and time of each path class."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from leapnav.envs.field.packing import field_parts, obstacle_centres, replace_parts
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import Trajectory
from leapnav.experts.spacetime.lattice import grid_of, sample_layers, spread

# Largest numbers of path classes and of candidates. Of 40 scenarios of each family with moving obstacles, 2 optima are
# missed, compared with 400 candidates; with 16 classes and 32 candidates the same, in 1.3 times the time.
MAX_CLASSES, MAX_CANDIDATES = 24, 20
# Cost of a turn, as a fraction of that at the mean power of the cheapest path. In each family with moving obstacles,
# 95 % of 40 to 60 scenarios have their optimum among the first 8 candidates; with 0, among the first 44.
TURN_SHARE = 0.35
MAX_EXCESS = 1.0  # relative to the cheapest path, of a class
SLOW = 0.2  # fraction of the mean speed below which a path has no direction
CUSPS = 0.15, 0.5, 0.85  # fractions of the path at which the driving direction may change
BOTH_SIDES = math.pi / 2  # rad, of a turn above which the turn to the other side is considered, too
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
        at_rest = replace_parts(field, [part for part in field_parts(field) if not len(part.knots)])
        places = np.array([grid.x0, grid.y0, grid.cell, grid.step, radius])
        sample_layers(field, at_rest, scenario.outline, places, costs)
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
            layers, ordered = np.ascontiguousarray(costs[::order]), np.ascontiguousarray(centres[::order])
            values, parents = np.empty_like(costs), np.empty(costs.size, np.int64)
            signatures = np.empty(costs.size, np.int64)
            spread(layers, np.array([*cell, grid.reach]), weight, values, parents, ordered, signatures)
            shape = costs.shape
            found.append([array.reshape(shape)[::order] for array in (values, parents, signatures)])
        (self._before, self._parents, signed), (self._after, self._children, unsigned) = found
        self._totals = self._before + self._after - np.where(np.isfinite(costs), costs, 0.0)
        self._signatures = signed - unsigned
        self.cheapest = float(self._totals.min())
        turn_weight = scenario.robot.metric(scenario.cost)[1]
        power = self.cheapest / horizon if self.cheapest < math.inf else 0.0
        self._turn_cost = TURN_SHARE * math.sqrt(2.0 * turn_weight * power)

    def candidates(self, classes: int = MAX_CLASSES, count: int = MAX_CANDIDATES) -> list[Trajectory]:
        """Return the paths that probably cost least: the cheapest one of each class in its driving modes.

        Args:
            classes: largest number of path classes.
            count: largest number of paths.

        """
        totals = self._totals
        order = np.argsort(totals, axis=None, kind="stable")
        flat, signatures = totals.ravel()[order], self._signatures.ravel()[order]
        end = int(np.searchsorted(flat, self.cheapest * (1.0 + MAX_EXCESS)))
        _, first = np.unique(signatures[:end], return_index=True)
        found: list[tuple[float, Trajectory]] = []
        for index in np.sort(first)[:classes].tolist():
            modes = self._lifted(self._positions(int(order[index])))
            found += [(float(flat[index]) + self._turn_cost * turn, path) for turn, path in modes]
        found.sort(key=lambda entry: entry[0])
        return [path for _, path in found[:count]]

    def random_candidates(self, count: int, reach: float, rng: np.random.Generator) -> list[Trajectory]:
        """Return the cheapest paths through random cells, in random driving modes.

        Args:
            count: number of paths.
            reach: largest cost of a path, relative to the cheapest one.
            rng: generator of the cells and of the modes.

        """
        nodes = np.flatnonzero(self._totals <= reach * self.cheapest)
        found = []
        for node in rng.choice(nodes, count).tolist():
            modes = self._lifted(self._positions(node))
            found.append(modes[rng.integers(len(modes))][1])
        return found

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

    def _lifted(self, positions: np.ndarray) -> list[tuple[float, Trajectory]]:
        """Return the path in its driving modes, as poses (N, 3), each with the turns (rad) besides those of the path.

        The headings are along the path or against it, and change once at most. The robot turns at the start and at the
        goal, to the one or to the other side.
        """
        times = np.linspace(0.0, self.horizon, len(positions))
        rates = np.gradient(positions, times, axis=0)
        speeds = np.hypot(*rates.T)
        moves = speeds > SLOW * speeds.mean()
        start, goal = self._scenario.start[2], self._scenario.goal[2]
        if not moves.any():
            ends = np.linspace(start, start if goal is None else goal, len(times))
            return [(0.0, Trajectory(times, np.column_stack([positions, ends])))]
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
                    turn = abs(before) + abs(after) + abs(last - first)
                    found.append((turn, Trajectory(times, states)))
        return found


def _turns(heading: float, other: float) -> list[float]:
    """Return the turns (rad) from a heading to another one, to both sides if they are similar."""
    turn = math.remainder(other - heading, 2 * math.pi)
    return [turn, turn - math.copysign(2 * math.pi, turn)] if abs(turn) > BOTH_SIDES else [turn]
