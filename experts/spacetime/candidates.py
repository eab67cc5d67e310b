"""Candidate paths among moving obstacles: the cheapest path over position and time of each path class."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice, product

import numpy as np

from leapnav.envs.field.packing import field_parts, obstacle_centres, replace_parts
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import Trajectory
from leapnav.experts.spacetime.lattice import add_crossings, grid_of, sample_layers, spread

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
SIMILAR = 1.5  # m within which two paths of a class are similar


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
            values, parents = np.empty_like(costs), np.empty(costs.shape, np.int32)
            layers = np.ascontiguousarray(costs[::order])
            spread(layers, np.array([*cell, grid.reach]), weight, values, parents)
            found.append([np.ascontiguousarray(array[::order]) for array in (values, parents)])
        (before, self._parents), (after, self._children) = found
        self._totals = before + after - np.where(np.isfinite(costs), costs, 0.0)
        self.cheapest = float(self._totals.min())
        limit = self.cheapest * (1.0 + MAX_EXCESS)
        self._signatures = np.zeros(costs.shape, np.int64)
        for parents, order in ((self._parents, 1), (self._children, -1)):
            add_crossings(self._totals, limit, parents, order, centres, self._signatures)
        turn_weight = scenario.robot.metric(scenario.cost)[1]
        power = self.cheapest / horizon if self.cheapest < math.inf else 0.0
        self._turn_cost = TURN_SHARE * math.sqrt(2.0 * turn_weight * power)

    def candidates(self, classes: int = MAX_CLASSES, count: int = MAX_CANDIDATES) -> list[Trajectory]:
        """Return the paths that probably cost least: the cheapest one of each class in its driving modes.

        Args:
            classes: largest number of path classes.
            count: largest number of paths.

        """
        found: list[tuple[float, Callable[[], Trajectory]]] = []
        for cost, positions in islice(self._local_minima(), classes):
            found += [(cost + self._turn_cost * turn, path) for turn, path in self._lifted(positions)]
        found.sort(key=lambda entry: entry[0])
        return [path() for _, path in found[:count]]

    def _local_minima(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the costs and the positions of the cheapest path of each class, and of others that are local minima.

        These are cheaper than the paths through the cells beside them, and differ in where and when the robot waits.
        """
        totals, signatures = self._totals, self._signatures
        within = totals <= self.cheapest * (1.0 + MAX_EXCESS)  # and cheaper than the cells beside them of their class
        lowest = within.copy()
        for first, second in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :, 1:], np.s_[:, :, :-1])):
            for one, other in ((first, second), (second, first)):
                is_less = totals[one] <= totals[other]
                lowest[one] &= is_less
                within[one] &= is_less | (signatures[one] != signatures[other])
        nodes = np.flatnonzero(within)
        nodes = nodes[np.argsort(totals.ravel()[nodes], kind="stable")]
        of_nodes = (array.ravel()[nodes].tolist() for array in (totals, signatures, lowest))
        known: dict[int, list[list[int]]] = {}  # cells of the paths, by class
        for node, cost, signature, is_lowest in zip(nodes.tolist(), *of_nodes, strict=True):
            layer, cell = divmod(node, totals[0].size)
            paths = known.setdefault(signature, [])
            if not paths or (is_lowest and not any(self._are_close(path[layer], cell) for path in paths)):
                cells = self._cells(node)
                paths.append(cells.tolist())
                yield cost, self._smoothed(cells)

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
            modes = self._lifted(self._smoothed(self._cells(node)))
            found.append(modes[rng.integers(len(modes))][1]())
        return found

    def _cells(self, node: int) -> np.ndarray:
        """Return the cells (layers + 1,) of the cheapest path through a cell of a layer."""
        grid = self._grid
        layer, cell = divmod(node, grid.columns * grid.lines)
        cells = np.empty(grid.layers + 1, np.int64)
        cells[layer] = cell
        for k in range(layer, 0, -1):
            cells[k - 1] = self._parents[k].ravel()[cells[k]]
        for k in range(layer, grid.layers):
            cells[k + 1] = self._children[k].ravel()[cells[k]]
        return cells

    def _are_close(self, cell: int, other: int) -> bool:
        """Return whether two cells are close to each other."""
        (column, line), (other_column, other_line) = divmod(cell, self._grid.lines), divmod(other, self._grid.lines)
        return self._grid.cell * max(abs(column - other_column), abs(line - other_line)) < SIMILAR

    def _smoothed(self, cells: np.ndarray) -> np.ndarray:
        """Return the positions (layers + 1, 2) (m) of a path through cells."""
        grid = self._grid
        positions = np.stack(np.divmod(cells, grid.lines), axis=1) * grid.cell + (grid.x0, grid.y0)
        positions[0], positions[-1] = self._scenario.start[:2], self._scenario.goal[:2]
        for _ in range(2):  # the steps of a grid have few directions
            positions[1:-1] = 0.25 * positions[:-2] + 0.5 * positions[1:-1] + 0.25 * positions[2:]
        return positions

    def _lifted(self, positions: np.ndarray) -> list[tuple[float, Callable[[], Trajectory]]]:
        """Return the turns (rad) besides those of the path in its driving modes, each with a function of its poses.

        The headings are along the path or against it, and change once at most. The robot turns at the start and at the
        goal, to the one or to the other side.
        """
        times = np.linspace(0.0, self.horizon, len(positions))
        rates = np.gradient(positions, times, axis=0)
        speeds = np.hypot(*rates.T)
        moves = speeds > SLOW * speeds.mean()
        start, goal = self._scenario.start[2], self._scenario.goal[2]
        if not moves.any():
            headings = np.linspace(start, start if goal is None else goal, len(times))
            return [(0.0, partial(_with_headings, times, positions, headings))]
        along = np.interp(times, times[moves], np.unwrap(np.arctan2(rates[moves, 1], rates[moves, 0])))
        fractions = np.cumsum(np.append(0.0, np.hypot(*np.diff(positions, axis=0).T)))
        fractions /= fractions[-1]
        found = []
        for first, last in product((0.0, np.pi), repeat=2):
            after = [0.0] if goal is None else _turns(along[-1] + last, goal)
            for turns in product(_turns(start, along[0] + first), after):
                for cusp in (0.0,) if first == last else CUSPS:
                    headings = along + np.where(fractions < cusp, first, last)
                    turn = abs(turns[0]) + abs(turns[1]) + abs(last - first)
                    found.append((turn, partial(_with_headings, times, positions, headings, (start, *turns))))
        return found


def _with_headings(
    times: np.ndarray, positions: np.ndarray, headings: np.ndarray, ends: tuple[float, float, float] | None = None
) -> Trajectory:
    """Return the poses (N, 3) at positions with headings (N,) up to a multiple of 2 pi.

    Args:
        times, positions, headings: of the path.
        ends: the first heading, and the turns after it and at the last pose (rad); None for those of the path.

    """
    poses = np.column_stack([positions, headings])
    if ends is not None:
        start, before, after = ends
        poses[:, 2] += start + before - headings[0]
        poses[0, 2] = start
        poses[-1, 2] += after
    return Trajectory(times, poses)


def _turns(heading: float, other: float) -> list[float]:
    """Return the turns (rad) from a heading to another one, to both sides if they are similar."""
    turn = math.remainder(other - heading, 2 * math.pi)
    return [turn, turn - math.copysign(2 * math.pi, turn)] if abs(turn) > BOTH_SIDES else [turn]
