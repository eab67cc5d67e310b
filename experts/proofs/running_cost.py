"""Lower bounds of the running cost E + Phi on the cells of a grid (kernel).

Phi is the weight k times a sum of b(d / scale), with b(s) = 1 / (exp(s) - 1) and distances d that are Lipschitz
continuous with constant 1. On a square with half diagonal e let r = e / scale. A term that is b_i at the centre is at
least 1 / ((1 + 1 / b_i) exp(r) - 1) = g(b_i), with

    g(B) = B / (exp(r) + (exp(r) - 1) B).

g is concave with g(0) = 0, hence subadditive: all terms together are at least g(B) with their sum B at the centre.
Below the distance c, `CONTACT`, the kernels replace b by its second-order Taylor polynomial at c. From 0 to c it is at
most b(s), since the third derivative of b is negative, and wherever s < c it is at least b(c). So

    Phi >= k min(g(B), b(c))

at the collision-free points of a square; min(g, b(c)) is subadditive, too. A term whose obstacle contains the centre is
covered, since it is at least b(r) > g(B) or at least b(c). With k = 0 the bound is 0.

The clearance is Lipschitz continuous with constant 1, too: a square whose centre has a clearance below -e contains no
point that a collision-free path can reach.

Squares are smaller than cells where obstacles are near: each cell is divided into n x n of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, types

from leapnav.envs.field.barrier import CONTACT, barrier
from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.layout import header_of
from leapnav.envs.field.packing import with_weight
from leapnav.envs.field.proximity import proximity_value
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.proofs.cells import GEOMETRY, Grid

ROUNDING = 1e-9  # m, added to e: 1000 times the rounding errors of distances
RELATIVE_ROUNDING = 1e-6  # of a bound: 10 times that of single precision
ABSOLUTE_ROUNDING = 1e-14  # of the barrier of each shape, 10 times the measured one
SQUARE = 1 / 8  # width of a square, in proximity scales, that is small enough
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
    # With the weight 1, the proximity cost is the sum B.
    field, weight = with_weight(scenario.field, 1.0), scenario.cost.proximity_weight
    _bound(field, weight, grid.geometry, needed, cost)
    return cost


@kernel(NOTHING(CONSTANT, float64, GEOMETRY, types.Array(boolean, 2, "C"), COST))
def _bound(field, weight, geometry, needed, cost):
    """Fill the bounds of a grid for a proximity weight; that of the field is 1."""
    n, spacing = cost.squares.shape[2], geometry.spacing
    reach = 0.5 * math.sqrt(2.0) * spacing / n + ROUNDING
    header = header_of(field)
    growth = math.exp(reach / header.scale)
    highest = barrier(CONTACT, CONTACT)[0]
    for i in range(needed.shape[0]):
        for j in range(needed.shape[1]):
            if not needed[i, j]:
                continue
            cx, cy = geometry.x + (i + 0.5) * spacing, geometry.y + (j + 0.5) * spacing
            middle = clearance(cx, cy, field)[0]
            cost.clearance[i, j] = middle
            cost.centre[i, j] = weight * proximity_value(cx, cy, header.radius, field)
            if middle < -spacing:
                continue
            for a in range(n):
                for b in range(n):
                    px, py = cx + ((a + 0.5) / n - 0.5) * spacing, cy + ((b + 0.5) / n - 0.5) * spacing
                    if middle < spacing and clearance(px, py, field)[0] + reach < 0.0:
                        continue
                    total = proximity_value(px, py, header.radius, field) - ABSOLUTE_ROUNDING * (4 + header.parts)
                    value = 0.0
                    if 0.0 < total < np.inf:  # otherwise far away, or deep in an obstacle where the barrier overflows
                        bound = min(1.0 / (growth / total + (growth - 1.0)), highest)
                        value = weight * bound * (1.0 - RELATIVE_ROUNDING)
                    cost.squares[i, j, a, b] = value
                    cost.lowest[i, j] = min(cost.lowest[i, j], value)
