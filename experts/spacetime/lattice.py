"""Shortest paths over position and time on a grid, by dynamic programming over layers of time (kernels).

In each layer the robot is in a cell of the arena, and moves to a nearby cell in the next one, or waits. A move costs
1/2 w |d|^2 / dt for its length d, and the proximity cost where it ends. Forward from the start and backward from the
goal, all cells of all layers together give the cheapest path through each cell at each time. Paths differ by the side
on which they pass each obstacle as it moves, which includes the order: before or behind it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, int32, int64

from leapnav.envs.field.barrier import CONTACT, barrier
from leapnav.envs.field.clearance import obstacle_distance
from leapnav.envs.field.distance import part_geometry
from leapnav.envs.field.layout import displacement_of, header_of, parts_in
from leapnav.envs.field.proximity import footprint_value
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, CUBE, INTEGERS, MATRIX, NOTHING, VECTOR
from leapnav.envs.scenarios.scenario import Scenario

# Side of a cell (m), unless the arena is larger than MAX_CELLS cells. In 140 scenarios of `crowd`, 1 optimum is missed,
# compared with 400 candidates; with 0.25 m, 4, in 0.74 of the time.
CELL = 1 / 6
MAX_CELLS = 64  # cells per side
MIN_LAYERS, MAX_LAYERS = 40, 160
MAX_SPEED_FACTOR = 4.0  # largest speed of a move, in units of the mean speed of a long path
REACH = 3  # cells that a move at the largest speed is long, if the number of layers permits
NEAR = 10.0  # scales; a moving obstacle costs nothing at a larger distance
MAX_DEPTH = 0.5  # cells by which the centre of a cell may be too close to an obstacle
# Factors of the crossings of an obstacle in a signature, so that different crossings have different sums.
SQUARE, LINEAR = 1 << 20, 7919

INDEX_CUBE, CROSSINGS = int32[:, :, ::1], int64[:, :, ::1]


class SpaceTimeGrid(NamedTuple):
    """Cells of an arena in layers of time.

    Attributes:
        x0, y0: centre of the first cell (m).
        cell: side of a cell (m).
        columns, lines: number of cells.
        step: s between two layers.
        layers: number of steps.
        reach: largest length of a move (cells).

    """

    x0: float
    y0: float
    cell: float
    columns: int
    lines: int
    step: float
    layers: int
    reach: int


def grid_of(scenario: Scenario, horizon: float) -> SpaceTimeGrid:
    """Return the grid of a scenario for a horizon (s)."""
    x_min, y_min, x_max, y_max = scenario.arena
    cell = max(CELL, (x_max - x_min) / MAX_CELLS, (y_max - y_min) / MAX_CELLS)
    columns, lines = (max(round((high - low) / cell), 1) for low, high in ((x_min, x_max), (y_min, y_max)))
    x0 = 0.5 * (x_min + x_max - (columns - 1) * cell)
    y0 = 0.5 * (y_min + y_max - (lines - 1) * cell)
    distance = np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2]))
    mean = max(distance, 0.5 * (x_max - x_min + y_max - y_min)) / horizon  # the path may lead through several rooms
    fastest = min(scenario.robot.speed_limits()[0], MAX_SPEED_FACTOR * mean) * horizon / cell  # cells
    layers = int(np.clip(np.ceil(fastest / REACH), MIN_LAYERS, MAX_LAYERS))
    reach = min(max(int(np.ceil(fastest / layers)), 1), 2 * REACH)
    return SpaceTimeGrid(x0, y0, cell, columns, lines, horizon / layers, layers, reach)


@kernel(NOTHING(CONSTANT, CONSTANT, CONSTANT_MATRIX, VECTOR, CUBE))
def sample_layers(field, at_rest, outline, places, costs):
    """Fill costs (layers + 1, columns, lines) with the proximity cost of a step; infinite in obstacles.

    Args:
        field: packed obstacle field.
        at_rest: the same without moving parts.
        outline (K, 5): of the robot, with its heading at 0. Its rectangles are discs for moving parts.
        places (5,): x0, y0, cell (m), step (s), and the robot's radius (m).
        costs: overwritten.

    """
    header, parts = header_of(field), parts_in(field)
    x0, y0, cell, step, radius = places[0], places[1], places[2], places[3], places[4]
    deepest = radius - MAX_DEPTH * cell
    touching = header.weight / math.expm1(CONTACT)  # at least, in contact
    layers, columns, lines = costs.shape
    q = np.zeros(3)
    for i in range(columns):
        for j in range(lines):
            q[0], q[1] = x0 + i * cell, y0 + j * cell
            cost = footprint_value(q, outline, at_rest)
            if cost >= touching and obstacle_distance(q[0], q[1], 0.0, at_rest)[0] < deepest:
                cost = np.inf
            costs[0, i, j] = step * cost
    for k in range(1, layers):
        costs[k] = costs[0]
    for number in range(header.parts - header.moving, header.parts):
        part = parts[number]
        reach = part.rim + header.extent + header.radius + NEAR * header.scale
        for k in range(layers):
            moved_x, moved_y = displacement_of(field, part, k * step)
            middle_x, middle_y = (part.x + moved_x - x0) / cell, (part.y + moved_y - y0) / cell
            # Limited before the conversion to integers, since an obstacle may be anywhere.
            left, right = max(middle_x - reach / cell, 0.0), min(middle_x + reach / cell + 1.0, float(columns))
            low, high = max(middle_y - reach / cell, 0.0), min(middle_y + reach / cell + 1.0, float(lines))
            for i in range(int(left), int(max(right, 0.0))):
                for j in range(int(low), int(max(high, 0.0))):
                    x, y = x0 + i * cell - moved_x, y0 + j * cell - moved_y
                    if part_geometry(x, y, 0.0, field, part)[0] < deepest:
                        costs[k, i, j] = np.inf
                    for row in range(len(outline)):
                        middle = (outline[row, 0] + outline[row, 1]) / 2.0
                        rim = outline[row, 2] + outline[row, 3]
                        distance = part_geometry(x + middle, y, rim, field, part)[0]
                        value = barrier(distance / header.scale, header.least_distance)[0]
                        costs[k, i, j] += step * header.weight * value


@kernel(int64(float64, float64, float64, float64), forceinline=True)
def crossing(x, y, to_x, to_y):
    """Return 1 if a step relative to an obstacle crosses the ray above it from left to right, -1 from right to left."""
    if (x < 0.0) == (to_x < 0.0):
        return 0
    height = y + (to_y - y) * (x / (x - to_x))
    if height <= 0.0:
        return 0
    return 1 if x < 0.0 else -1


@kernel(NOTHING(CUBE, INTEGERS, float64, CUBE, INDEX_CUBE))
def spread(costs, start, weight, values, parents):
    """Compute the cheapest path from a cell in the first layer to each cell of each layer.

    The square of a distance is a sum over the two axes, so that the minimum is taken along one after the other.

    Args:
        costs (layers + 1, columns, lines): of the cells, for the time of a step; the first axis may be reversed.
        start (3,): column and line, and the largest move along an axis (cells).
        weight: cost of a move of one cell; that of longer moves grows with the square of their length.
        values (layers + 1, columns, lines): overwritten by the costs of the paths.
        parents: overwritten by the number of the cell before, in the layer; meaningless where there is no path.

    """
    layers, columns, lines = costs.shape
    reach = start[2]
    origins = np.zeros((columns, lines), np.int32)
    partial = np.empty((columns, lines))
    shifts = np.zeros(lines, np.int32)
    values[0] = np.inf
    values[0, start[0], start[1]] = 0.0
    for k in range(1, layers):
        partial[:] = values[k - 1]
        for i in range(columns):
            for j in range(lines):
                origins[i, j] = i
            for a in range(max(i - reach, 0), min(i + reach + 1, columns)):
                move = weight * (a - i) * (a - i)
                for j in range(lines):
                    value = values[k - 1, a, j] + move
                    is_less = value < partial[i, j]
                    partial[i, j] = value if is_less else partial[i, j]
                    origins[i, j] = a if is_less else origins[i, j]
        for i in range(columns):
            for j in range(lines):
                values[k, i, j] = partial[i, j]
                shifts[j] = 0
            for shift in range(-reach, reach + 1):
                move = weight * shift * shift
                for j in range(max(-shift, 0), min(lines - shift, lines)):
                    value = partial[i, j + shift] + move
                    is_less = value < values[k, i, j]
                    values[k, i, j] = value if is_less else values[k, i, j]
                    shifts[j] = shift if is_less else shifts[j]
            for j in range(lines):
                values[k, i, j] += costs[k, i, j]
                parents[k, i, j] = origins[i, j + shifts[j]] * lines + j + shifts[j]


@kernel(NOTHING(CUBE, float64, INDEX_CUBE, int64, MATRIX, CROSSINGS))
def add_crossings(totals, limit, parents, order, centres, signatures):
    """Add the signature of the cheapest path to each cell of each layer, see `crossing`.

    Args:
        totals (layers + 1, columns, lines): costs of the cheapest paths from the start to the goal through the cells.
        limit: the signatures of paths that cost more are not computed.
        parents: of the cells, in the layer before, or after it if the order is -1.
        order: 1 for the paths from the start, -1 for the paths from the goal.
        centres (layers + 1, 2 obstacles): positions of the obstacles (cells).
        signatures (layers + 1, columns, lines): those of the paths multiplied by the order are added.

    """
    layers, columns, lines = totals.shape
    found = np.zeros(totals.shape, np.int64)
    for number in range(1, layers):
        k = number if order > 0 else layers - 1 - number
        before = k - order
        for i in range(columns):
            for j in range(lines):
                if totals[k, i, j] <= limit:
                    a, b = parents[k, i, j] // lines, parents[k, i, j] % lines
                    signature = found[before, a, b]
                    for n in range(centres.shape[1] // 2):
                        crossed = crossing(
                            a - centres[before, 2 * n],
                            b - centres[before, 2 * n + 1],
                            i - centres[k, 2 * n],
                            j - centres[k, 2 * n + 1],
                        )
                        signature += crossed * (SQUARE * (n + 1) * (n + 1) + LINEAR * (n + 1))
                    found[k, i, j] = signature
                    signatures[k, i, j] += order * signature
