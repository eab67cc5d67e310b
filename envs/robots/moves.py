"""Motion primitives on a lattice of cells and headings, from which candidate paths of a robot are composed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

# 16 headings whose directions are exact lattice vectors, so a straight move stays exactly on its line.
_QUADRANT = np.array([(1, 0), (2, 1), (1, 1), (1, 2)], dtype=np.int64)
_QUARTER_TURN = np.array([(0, 1), (-1, 0)], dtype=np.int64)
DIRECTIONS = np.concatenate([_QUADRANT @ np.linalg.matrix_power(_QUARTER_TURN, k) for k in range(4)])
ANGLES = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) % (2 * np.pi)
HEADINGS = len(ANGLES)
SIMPSON = np.array([1.0, 4.0, 1.0])
N_MOVES_PER_MODE = 5  # of `rotating_moves`: those ahead, those backwards, and then the rotations


@dataclass(frozen=True, eq=False)
class Moves:
    """Motion primitives of a robot, the same number `count` from each heading.

    Attributes:
        targets: (HEADINGS, count, 3), int64: cells in x, cells in y, heading steps.
        points: (HEADINGS, count, P, 2), int64: offsets (half cells) of the points at which the speed of the metric is
            evaluated, from the start of the move to its end.
        rotating: whether these are all moves of `rotating_moves`.
        reversible: whether the reverse of each move is also one.
        weights: (HEADINGS, count, P), weights of these speeds: the length of the move, in the units of sqrt(cost * s),
            times the weights of Simpson's rule on each of its straight parts.

    """

    targets: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    rotating: bool = False
    reversible: bool = True

    def reverse(self) -> Moves:
        """Return the reverses of all moves, which lead from their ends to their starts."""
        if self.reversible:
            return self
        targets, points, weights = (np.empty_like(array) for array in (self.targets, self.points, self.weights))
        for heading in range(HEADINGS):
            for move, (dx, dy, change) in enumerate(self.targets[heading].tolist()):
                other = (heading + change) % HEADINGS
                targets[other, move] = -dx, -dy, -change
                points[other, move] = (self.points[heading, move] - (2 * dx, 2 * dy))[::-1]
                weights[other, move] = self.weights[heading, move, ::-1]
        targets.flags.writeable = False
        return Moves(targets, np.ascontiguousarray(points), weights, reversible=False)

    @property
    def border(self) -> int:
        """Largest number of cells that a move covers in x or y."""
        return int(np.abs(self.points).max() + 1) // 2


def driving_modes(speed: tuple[float, float]) -> tuple[Literal[1, -1], ...]:
    """Return the modes, 1 ahead and -1 backwards, that an interval of speeds contains."""
    return (*((1,) if speed[1] > 0 else ()), *((-1,) if speed[0] < 0 else ()))


def turn_angle(heading: int, change: int) -> float:
    """Return the angle (rad, not negative) of a change by heading steps."""
    turn = abs(float(ANGLES[(heading + change) % HEADINGS] - ANGLES[heading]))
    return min(turn, 2.0 * math.pi - turn)


def rotating_moves(
    cell: float, speed_weight: float, turn_weight: float, modes: Sequence[Literal[1, -1]] = (1, -1)
) -> Moves:
    """Return the moves of a robot that can rotate in place.

    Forward and backward: straight, or with one heading step to either side, along the old or the new heading. Each of
    these two is the reverse of the other, so the graph is symmetric. Then one heading step in place to either side.

    Args:
        cell: side of a cell (m).
        speed_weight: weight of the squared speed.
        turn_weight: weight of the squared turn rate.
        modes: 1 for moves ahead, -1 for moves backwards.

    """
    table = _rotating_table()
    chosen = [k for k in range(table[0].shape[1]) if len(modes) == 2 or not _is_in_mode(k, -modes[0])]
    targets, points, squares, turns = (np.ascontiguousarray(array[:, chosen]) for array in table)
    lengths = np.sqrt(speed_weight * squares * cell * cell + turn_weight * turns * turns)
    targets.flags.writeable = False
    weights = (lengths / 6.0)[:, :, None] * SIMPSON
    return Moves(targets, points, weights, rotating=len(modes) == 2, reversible=len(modes) == 2)


def _is_in_mode(move: int, mode: int) -> bool:
    """Return whether a row of `_rotating_table` is a move ahead (1) or backwards (-1)."""
    return move < 2 * N_MOVES_PER_MODE and (move < N_MOVES_PER_MODE) == (mode == 1)


@cache
def _rotating_table() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return targets, points, squared distances (cells) and angles (rad) of `rotating_moves`."""
    table = []
    for heading in range(HEADINGS):
        rows = []
        for mode in (1, -1):
            rows.append((*(mode * DIRECTIONS[heading]), 0))
            for change in (1, -1):
                rows.append((*(mode * DIRECTIONS[heading]), change))
                rows.append((*(mode * DIRECTIONS[(heading + change) % HEADINGS]), change))
        table.append([*rows, (0, 0, 1), (0, 0, -1)])
    targets = np.array(table, dtype=np.int64)
    turns = np.array([[turn_angle(k, change) for change in targets[k, :, 2].tolist()] for k in range(HEADINGS)])
    points = np.stack([0 * targets[:, :, :2], targets[:, :, :2], 2 * targets[:, :, :2]], axis=2)
    return targets, points, targets[:, :, 0] ** 2 + targets[:, :, 1] ** 2, turns


ROTATING_MOVES = _rotating_table()[0]
ROTATING_MOVES.flags.writeable = False


def curved_moves(
    cell: float,
    speed_weight: float,
    turn_weight: float,
    radii: tuple[float, float],
    modes: Sequence[Literal[1, -1]] = (1, -1),
) -> Moves:
    """Return the moves of a robot with a minimum turning radius.

    Forward and backward: straight, or along the old and then along the new heading, both about so far that an arc of
    the radius fits into the corner between them. The legs are rounded to whole cells, since the mean radius of several
    turns should be right; rounded up, a half turn would not fit between walls where one is possible.

    Args:
        cell: side of a cell (m).
        speed_weight: weight of the squared speed.
        turn_weight: weight of the squared turn rate.
        radii: minimum turning radii (m) of anticlockwise and clockwise rotations.
        modes: 1 for moves ahead, -1 for moves backwards.

    """
    rows_of: list[list[list[tuple[int, int]]]] = []
    changes = [change for change in (0, 1, -1) for _ in modes]
    for heading in range(HEADINGS):
        rows = []
        for change in (0, 1, -1):
            for mode in modes:
                path = [tuple((mode * DIRECTIONS[heading]).tolist())]
                if change:
                    leg = radii[0 if change > 0 else 1] * math.tan(turn_angle(heading, change) / 2.0)
                    path = []
                    for k in (heading, (heading + change) % HEADINGS):
                        count = max(1, round(leg / (cell * math.hypot(*DIRECTIONS[k]))))
                        path += [tuple((mode * DIRECTIONS[k]).tolist())] * count
                rows.append(path)
        rows_of.append(rows)
    n_steps = max(len(path) for rows in rows_of for path in rows)
    shape = (HEADINGS, len(changes))
    targets = np.zeros((*shape, 3), dtype=np.int64)
    points, weights = np.zeros((*shape, 2 * n_steps + 1, 2), dtype=np.int64), np.zeros((*shape, 2 * n_steps + 1))
    for heading in range(HEADINGS):
        for move, (path, change) in enumerate(zip(rows_of[heading], changes, strict=True)):
            lengths = math.sqrt(speed_weight) * cell * np.hypot(*np.array(path).T)
            turn = math.sqrt(turn_weight) * turn_angle(heading, change)
            lengths *= math.hypot(lengths.sum(), turn) / lengths.sum()
            corners = np.concatenate([[(0, 0)], np.cumsum(path, axis=0)])
            targets[heading, move] = (*corners[-1], change)
            # The points after the end of a shorter move have no weight.
            points[heading, move] = 2 * corners[-1]
            points[heading, move, : 2 * len(path) + 1 : 2] = 2 * corners
            points[heading, move, 1 : 2 * len(path) : 2] = corners[:-1] + corners[1:]
            for k, length in enumerate(lengths.tolist()):
                weights[heading, move, 2 * k : 2 * k + 3] += length / 6.0 * SIMPSON
    targets.flags.writeable = False
    return Moves(targets, points, weights, reversible=len(modes) == 2 and radii[0] == radii[1])
