"""Lower bounds of the running cost E + Phi on the cells of a grid (kernel).

Each term of Phi is the proximity weight times exp(-(d - radius) / scale) with a distance d that is Lipschitz continuous
with constant 1. So log Phi is Lipschitz continuous with constant 1 / scale, and on a square with centre p and half
diagonal e, Phi >= Phi(p) exp(-e / scale). The clearance is Lipschitz continuous with constant 1, too: a square whose
centre has a clearance below -e contains no point that a collision-free path can reach.

Squares are smaller than cells where obstacles are near: each cell is divided into n x n of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes.clearance import clearance
from leapnav.envs.shapes.proximity import disc_proximity
from leapnav.experts.proofs.cells import Grid

ROUNDING = 1e-9  # subtracted from Phi and from the clearance: 1000 times their rounding errors and neglected terms
SQUARE = 1 / 8  # width of a square, in proximity scales, that is small enough
MAX_PHI = 1e30  # larger values, which overflow single precision, are replaced by the bound 0
MAX_SQUARES = 4  # squares per axis of a cell


class RunningCost(NamedTuple):
    """Lower bounds of Phi above each column (x, y) of cells.

    Attributes:
        centre (columns, lines): Phi at the centre, not a bound.
        clearance (columns, lines): clearance at the centre (m), not a bound.
        lowest (columns, lines): lower bound over the cell's collision-free squares, infinite if there are none.
        squares (columns, lines, n, n): lower bound over each square, NaN if it contains no collision-free point.

    """

    centre: np.ndarray
    clearance: np.ndarray
    lowest: np.ndarray
    squares: np.ndarray


FLOATS = float32[:, :, :, ::1]
COST = record_type(RunningCost, centre=MATRIX, clearance=MATRIX, lowest=MATRIX, squares=FLOATS)


def running_cost(scenario: Scenario, grid: Grid, needed: np.ndarray) -> RunningCost:
    """Return the bounds above the columns that a mask (columns, lines) selects; the others count as blocked."""
    width = SQUARE * scenario.cost.proximity_scale
    n = min(max(1, round(grid.spacing / width)), MAX_SQUARES)
    shape = (grid.columns, grid.lines)
    cost = RunningCost(
        np.zeros(shape), np.full(shape, -np.inf), np.full(shape, np.inf), np.full((*shape, n, n), np.nan, np.float32)
    )
    _bound(scenario.field, grid.x, grid.y, grid.spacing, needed, cost)
    return cost


@kernel(NOTHING(CONSTANT, float64, float64, float64, types.Array(boolean, 2, "C"), COST))
def _bound(field, x, y, spacing, needed, cost):
    """Fill the bounds of a grid whose first corner is (x, y)."""
    n = cost.squares.shape[2]
    reach = 0.5 * math.sqrt(2.0) * spacing / n
    factor = math.exp(-reach / field[1])
    for i in range(needed.shape[0]):
        for j in range(needed.shape[1]):
            if not needed[i, j]:
                continue
            cx, cy = x + (i + 0.5) * spacing, y + (j + 0.5) * spacing
            middle = clearance(cx, cy, field)[0]
            cost.clearance[i, j] = middle
            cost.centre[i, j] = disc_proximity(cx, cy, field[2], field)[0]
            if middle < -spacing:
                continue
            for a in range(n):
                for b in range(n):
                    px, py = cx + ((a + 0.5) / n - 0.5) * spacing, cy + ((b + 0.5) / n - 0.5) * spacing
                    if middle < spacing and clearance(px, py, field)[0] + reach < -ROUNDING:
                        continue
                    value = disc_proximity(px, py, field[2], field)[0] * factor - ROUNDING
                    if not value < MAX_PHI:  # also if it is not a number, deep in an obstacle
                        value = 0.0
                    # Rounded down to single precision.
                    cost.squares[i, j, a, b] = max(value * (1.0 - 1e-6), 0.0)
                    cost.lowest[i, j] = min(cost.lowest[i, j], max(value * (1.0 - 1e-6), 0.0))
