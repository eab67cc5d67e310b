"""Cyclic projections of a spline onto the inequality (kernels). A proof does not rely on them.

A control point p of a cell is an affine function of 27 coefficients, and |p| <= n is required. If it is violated, the
coefficients move by the smallest change after which p lies in the half-plane p . p_0 <= n |p_0|, where p_0 is the
present p. Each of these sets contains the splines that satisfy the inequality, so no projection
increases the distance to any of those (Fejer monotonicity; Bauschke and Borwein, SIAM Review 38, 1996). A cell is
visited again only if a coefficient around it has changed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float32, float64, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, NOTHING, tuple_of
from leapnav.experts.proofs.cells import BLOCK, LAYOUT, MASKS, VALUES, gather, scatter
from leapnav.experts.proofs.inequality import N_COEFFICIENTS, N_POINTS, Functionals
from leapnav.experts.proofs.running_cost import COST

MAX_PROJECTIONS = 3  # of a cell per visit
OVERSHOOT = 1.3  # of a projection; below 2, Fejer monotonicity holds
INSIDE = 0.9995  # fraction of the radius to which a control point moves
FLAT = 0.004  # largest relative difference of E + Phi between the squares of a cell that is not divided


class Constraints(NamedTuple):
    """The inequality in single precision.

    Attributes:
        matrices (headings, 1 + n n, 27, 72): see `Functionals`; without those of B.
        flat (columns, lines): cells that are not divided into squares.
        energy: E.
        tolerance: ratio above which a control point is moved.

    """

    matrices: np.ndarray
    flat: np.ndarray
    energy: float
    tolerance: float


SINGLE = types.Array(float32, 1, "C")
CONSTRAINTS = record_type(
    Constraints,
    matrices=types.Array(float32, 4, "C"),
    flat=types.Array(types.boolean, 2, "C"),
    energy=float64,
    tolerance=float64,
)


def make_constraints(table: Functionals, squares: np.ndarray, energy: float, tolerance: float) -> Constraints:
    """Return the inequality from the functionals and the bounds of Phi on the squares (columns, lines, n, n)."""
    matrices = np.ascontiguousarray(table.matrices[..., : 2 * N_POINTS], dtype=np.float32)
    low, high = squares.min(axis=(2, 3)), squares.max(axis=(2, 3))  # NaN if a square is blocked
    flat = high - low < FLAT * (energy + low)
    return Constraints(matrices, np.ascontiguousarray(flat), energy, tolerance)


@kernel(NOTHING(CUBE, int64, int64, int64, SINGLE))
def _take(local, k, i, j, around):
    """Copy the 27 coefficients around a cell, relative to that of the cell."""
    index, middle = 0, local[k, i, j]
    for a in range(k - 1, k + 2):
        for b in range(i - 1, i + 2):
            for c in range(j - 1, j + 2):
                around[index] = local[a, b, c] - middle
                index += 1


@kernel(tuple_of(int64, float64)(float32[:, ::1], SINGLE, SINGLE), fastmath=True)
def _largest(matrix, around, points):
    """Index and square of the largest control point; fills `points` (72,)."""
    for r in range(2 * N_POINTS):
        points[r] = 0.0
    for q in range(0, N_COEFFICIENTS, 3):
        x, y, z = around[q], around[q + 1], around[q + 2]
        for r in range(2 * N_POINTS):
            points[r] += matrix[q, r] * x + matrix[q + 1, r] * y + matrix[q + 2, r] * z
    largest, found = float32(0.0), 0
    for r in range(N_POINTS):
        square = points[r] * points[r] + points[N_POINTS + r] * points[N_POINTS + r]
        if square > largest:
            largest, found = square, r
    return found, float64(largest)


@kernel(NOTHING(CUBE, int64, int64, int64, float32[:, ::1], SINGLE, int64, float64))
def _project(local, k, i, j, matrix, points, point, radius):
    """Move the coefficients around a cell so that a control point moves towards a radius."""
    length = math.sqrt(points[point] ** 2 + points[N_POINTS + point] ** 2)
    forward, turn, norm = points[point] / length, points[N_POINTS + point] / length, 0.0
    for q in range(N_COEFFICIENTS):
        norm += (forward * matrix[q, point] + turn * matrix[q, N_POINTS + point]) ** 2
    step, q = OVERSHOOT * (radius - length) / norm, 0
    for a in range(k - 1, k + 2):
        for b in range(i - 1, i + 2):
            for c in range(j - 1, j + 2):
                local[a, b, c] += step * (forward * matrix[q, point] + turn * matrix[q, N_POINTS + point])
                q += 1


@kernel(NOTHING(LAYOUT, MASKS, int64, int64, int64, MASKS))
def _mark_around(layout, mask, k, i, j, pending):
    """Mark the cells of the set within two cells of cell (k, i, j)."""
    n_k, n_i, n_j = layout.slots.shape
    for a in range(k - 2, k + 3):
        a = a % (n_k * BLOCK)
        for b in range(max(i - 2, 0), min(i + 3, n_i * BLOCK)):
            for c in range(max(j - 2, 0), min(j + 3, n_j * BLOCK)):
                slot = layout.slots[a // BLOCK, b // BLOCK, c // BLOCK]
                if slot >= 0 and mask[slot, a % BLOCK, b % BLOCK, c % BLOCK]:
                    pending[slot, a % BLOCK, b % BLOCK, c % BLOCK] = True


@kernel(int64(VALUES, LAYOUT, MASKS, MASKS, COST, CONSTRAINTS))
def project_once(values, layout, mask, pending, cost, constraints):
    """Visit the pending cells once, and return the number of projections.

    Args:
        values (m, 8, 8, 8): coefficients, changed in place.
        layout, mask: the set of cells on which the inequality is required.
        pending (m, 8, 8, 8): cells to visit; those around changed coefficients are added.
        cost: lower bounds of Phi.
        constraints: the inequality.

    """
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    around, points = np.empty(N_COEFFICIENTS, dtype=np.float32), np.empty(2 * N_POINTS, dtype=np.float32)
    n = cost.squares.shape[2]
    energy, allowed = constraints.energy, constraints.tolerance**2
    count = 0
    for block in range(len(mask)):
        if not pending[block].any():
            continue
        gather(values, layout, block, local)
        k0, i0, j0 = (layout.blocks[block, 0] * BLOCK, layout.blocks[block, 1] * BLOCK, layout.blocks[block, 2] * BLOCK)
        changed = False
        for k in range(BLOCK):
            matrices = constraints.matrices[k0 + k]
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if not pending[block, k, i, j]:
                        continue
                    pending[block, k, i, j] = False
                    before = count
                    for _ in range(MAX_PROJECTIONS):
                        _take(local, k + 1, i + 1, j + 1, around)
                        point, whole = _largest(matrices[0], around, points)
                        right = 2.0 * (energy + cost.lowest[i0 + i, j0 + j])
                        if whole <= allowed * right:
                            break
                        part, worst = 0, whole / right
                        if not constraints.flat[i0 + i, j0 + j]:
                            worst = 0.0
                            for index in range(n * n):
                                phi = cost.squares[i0 + i, j0 + j, index // n, index % n]
                                bound = 2.0 * (energy + phi)
                                if math.isnan(phi) or whole <= max(worst, allowed) * bound:
                                    continue
                                found, square = _largest(matrices[1 + index], around, points)
                                if square > worst * bound:
                                    part, point, worst, right = 1 + index, found, square / bound, bound
                            if worst <= allowed:
                                break
                            _largest(matrices[part], around, points)
                        _project(local, k + 1, i + 1, j + 1, matrices[part], points, point, INSIDE * math.sqrt(right))
                        count += 1
                    if count > before:
                        changed = True
                        _mark_around(layout, mask, k0 + k, i0 + i, j0 + j, pending)
        if changed:
            scatter(local, layout, block, values)
    return count
