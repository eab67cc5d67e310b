"""An upwind solver of |grad_H S| = n on blocks of cells (kernels). A proof does not rely on its accuracy.

With steps h sqrt(r_v) along the heading and dtheta sqrt(r_w) in the heading, and the smaller values S_l and S_t of the
neighbours in these two directions, S solves (S - S_l)^2 / step_l^2 + (S - S_t)^2 / step_t^2 = n^2, by Gauss-Seidel
sweeps in alternating order over the block whose surroundings changed to the lowest value (the heap cell method of
Chacon and Vladimirsky, SIAM J. Sci. Comput. 34, 2012). `correct` reduces n where central differences of S are too
large, so that a repeated solution is accurate to second order where S is smooth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, int32, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, MATRIX, NOTHING
from leapnav.experts.proofs.cells import BLOCK, EMPTY, LAYOUT, MASKS, VALUES, Grid, Layout, gather

MAX_VISITS = 60  # of a block, on average
PASSES = 3  # over all blocks after a correction
IDLE = 2  # sweeps without a change after which a block is left
MIN_FACTOR, POWER = 0.8, 0.8  # of the correction


class Medium(NamedTuple):
    """The equation on a grid.

    Attributes:
        slowness (columns, lines): n.
        directions (headings, 2): cosine and sine of the headings.
        forward, turn: step_l = h sqrt(r_v) and step_t = dtheta sqrt(r_w).

    """

    slowness: np.ndarray
    directions: np.ndarray
    forward: float
    turn: float


MEDIUM = record_type(Medium, slowness=MATRIX, directions=MATRIX, forward=float64, turn=float64)


def make_medium(grid: Grid, metric: tuple[float, float], slowness: np.ndarray) -> Medium:
    """Return the equation for a metric (r_v, r_w)."""
    headings = (np.arange(grid.headings) + 0.5) * grid.angle
    directions = np.column_stack([np.cos(headings), np.sin(headings)])
    steps = grid.spacing * math.sqrt(metric[0]), grid.angle * math.sqrt(metric[1])
    return Medium(np.ascontiguousarray(slowness), directions, *steps)


def solve_eikonal(
    values: np.ndarray, locked: np.ndarray, layout: Layout, medium: Medium, *, corrections: int, tolerance: float
) -> None:
    """Solve the equation in place.

    Args:
        values (m, 8, 8, 8): EMPTY, except for the locked cells.
        locked (m, 8, 8, 8): cells with a given value.
        layout: the blocks.
        medium: the equation.
        corrections: number of corrections.
        tolerance: change of a value below which a block's neighbours are not visited again.

    """
    factor = np.ones_like(values)
    relax(values, factor, locked, layout, medium, tolerance)
    for _ in range(corrections):
        correct(values, factor, layout, medium)
        for _ in range(PASSES):
            repeat(values, factor, locked, layout, medium, tolerance)


_BLOCK_VALUES = types.Array(float32, 3, "C")
_BLOCK_MASK = types.Array(boolean, 3, "C")


_POSITION = types.Array(int32, 1, "C")


@kernel(
    boolean(CUBE, _BLOCK_VALUES, _BLOCK_MASK, MEDIUM, _POSITION, int64, float64, boolean),
    fastmath=True,
)
def _sweep(local, factor, locked, medium, block, sweep, tolerance, assign):
    """One Gauss-Seidel sweep over a block in one of 8 orders; return whether a value changed by the tolerance."""
    k0, i0, j0 = block[0] * BLOCK, block[1] * BLOCK, block[2] * BLOCK
    down_k, down_i, down_j = sweep % 2 == 1, sweep // 2 % 2 == 1, sweep >= 4
    changed = False
    weight_l, weight_t = 1.0 / medium.forward**2, 1.0 / medium.turn**2
    for kk in range(BLOCK):
        k = BLOCK - 1 - kk if down_k else kk
        cos, sin = medium.directions[k0 + k, 0], medium.directions[k0 + k, 1]
        di, dj = (0 if cos >= 0.0 else -1), (0 if sin >= 0.0 else -1)
        fi, fj = cos - di, sin - dj  # bilinear weights at the point one spacing ahead
        w00, w10, w01, w11 = (1.0 - fi) * (1.0 - fj), fi * (1.0 - fj), (1.0 - fi) * fj, fi * fj
        for ii in range(BLOCK):
            i = BLOCK - 1 - ii if down_i else ii
            for jj in range(BLOCK):
                j = BLOCK - 1 - jj if down_j else jj
                if locked[k, i, j]:
                    continue
                a, b, c = k + 1, i + 1 + di, j + 1 + dj
                ahead = (
                    w00 * local[a, b, c]
                    + w10 * local[a, b + 1, c]
                    + w01 * local[a, b, c + 1]
                    + w11 * local[a, b + 1, c + 1]
                )
                b, c = i + 1 - di, j + 1 - dj
                behind = (
                    w00 * local[a, b, c]
                    + w10 * local[a, b - 1, c]
                    + w01 * local[a, b, c - 1]
                    + w11 * local[a, b - 1, c - 1]
                )
                along = min(ahead, behind)
                across = min(local[a + 1, i + 1, j + 1], local[a - 1, i + 1, j + 1])
                present = local[a, i + 1, j + 1]
                if not assign and min(along, across) >= present:
                    continue
                n = medium.slowness[i0 + i, j0 + j] * factor[k, i, j]
                value = min(along + n * medium.forward, across + n * medium.turn)
                difference = across - along
                square = n * n * (weight_l + weight_t) - weight_l * weight_t * difference * difference
                if square > 0.0:
                    both = (along * weight_l + across * weight_t + math.sqrt(square)) / (weight_l + weight_t)
                    if both > along and both > across:
                        value = min(value, both)
                if assign or value < present:
                    changed = changed or abs(present - value) > tolerance
                    local[a, i + 1, j + 1] = value
    return changed


@kernel(NOTHING(CUBE, _BLOCK_VALUES, _BLOCK_MASK, MEDIUM, _POSITION, float64, boolean))
def _sweep_block(local, factor, locked, medium, block, tolerance, assign):
    """Sweep over a block until nothing changes, at most once in each of 8 orders."""
    idle = 0
    for sweep in range(8):
        idle = 0 if _sweep(local, factor, locked, medium, block, sweep, tolerance, assign) else idle + 1
        if idle == IDLE:
            break


@kernel(float64(CUBE, _BLOCK_VALUES, float64))
def _store(local, values, tolerance):
    """Copy a block back; return the lowest value that decreased by more than the tolerance, or infinity."""
    lowest = np.inf
    for k in range(BLOCK):
        for i in range(BLOCK):
            for j in range(BLOCK):
                value = float32(local[k + 1, i + 1, j + 1])
                if values[k, i, j] - value > tolerance:
                    lowest = min(lowest, value)
                values[k, i, j] = value
    return lowest


@kernel(NOTHING(VALUES, VALUES, MASKS, LAYOUT, MEDIUM, float64))
def relax(values, factor, locked, layout, medium, tolerance):
    """Visit blocks, that whose surroundings changed to the lowest value first, until nothing changes.

    Args:
        values: the solution; it only decreases.
        factor: factor of n in each cell.
        locked: cells that are not changed.
        layout, medium, tolerance: see `solve_eikonal`.

    """
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    keys = np.full(len(values), np.inf)  # lowest value to which the surroundings changed since the last visit
    n_k, n_i, n_j = layout.slots.shape
    for b in range(len(values)):
        if locked[b].any():
            keys[b] = values[b].min()
    for _ in range(MAX_VISITS * len(values)):
        b = np.argmin(keys)
        if keys[b] == np.inf:
            break
        keys[b] = np.inf
        gather(values, layout, b, local)
        _sweep_block(local, factor[b], locked[b], medium, layout.blocks[b], tolerance, False)
        lowest = _store(local, values[b], tolerance)
        if lowest == np.inf:
            continue
        k0, i0, j0 = layout.blocks[b, 0], layout.blocks[b, 1], layout.blocks[b, 2]
        for dk in range(-1, 2):
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    if 0 <= i0 + di < n_i and 0 <= j0 + dj < n_j:
                        slot = layout.slots[(k0 + dk) % n_k, i0 + di, j0 + dj]
                        if slot >= 0 and slot != b:
                            keys[slot] = min(keys[slot], lowest)


@kernel(NOTHING(VALUES, VALUES, MASKS, LAYOUT, MEDIUM, float64))
def repeat(values, factor, locked, layout, medium, tolerance):
    """Visit each block once in the order of their values, which may also increase; see `relax`."""
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    keys = np.empty(len(values))
    for b in range(len(values)):
        keys[b] = values[b].min()
    for b in np.argsort(keys):
        gather(values, layout, b, local)
        _sweep_block(local, factor[b], locked[b], medium, layout.blocks[b], tolerance, True)
        _store(local, values[b], tolerance)


@kernel(NOTHING(VALUES, VALUES, LAYOUT, MEDIUM))
def correct(values, factor, layout, medium):
    """Adapt the factor of n to the ratio of the gradient, by central differences, to n."""
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    for block in range(len(values)):
        gather(values, layout, block, local)
        for k in range(BLOCK):
            heading = layout.blocks[block, 0] * BLOCK + k
            cos, sin = medium.directions[heading, 0], medium.directions[heading, 1]
            for i in range(BLOCK):
                for j in range(BLOCK):
                    a, b, c = k + 1, i + 1, j + 1
                    highest = max(
                        max(max(local[a, b + 1, c], local[a, b - 1, c]), max(local[a, b, c + 1], local[a, b, c - 1])),
                        max(local[a + 1, b, c], local[a - 1, b, c]),
                    )
                    if highest > 0.9 * EMPTY:
                        continue
                    s_x, s_y = local[a, b + 1, c] - local[a, b - 1, c], local[a, b, c + 1] - local[a, b, c - 1]
                    forward = (cos * s_x + sin * s_y) / (2.0 * medium.forward)
                    turn = (local[a + 1, b, c] - local[a - 1, b, c]) / (2.0 * medium.turn)
                    n = medium.slowness[layout.blocks[block, 1] * BLOCK + i, layout.blocks[block, 2] * BLOCK + j]
                    ratio = min(max(math.hypot(forward, turn) / n, 0.7), 1.3)
                    factor[block, k, i, j] = min(max(factor[block, k, i, j] * ratio**-POWER, MIN_FACTOR), 1.0)
