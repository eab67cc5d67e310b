r"""The Hamilton-Jacobi inequality of a spline on the cells of a grid (kernels).

On a cell with centre heading theta_0 and half width tau in the heading, write e = theta - theta_0 and, in the frame
rotated by theta_0, A = cos(theta_0) S_x + sin(theta_0) S_y and B = cos(theta_0) S_y - sin(theta_0) S_x. Then

    |cos(theta) S_x + sin(theta) S_y| = |cos(e) A + sin(e) B| <= |A + e B| + (tan(tau) - tau) |B|.

A, B and S_theta are polynomials on the cell, so (A + e B, S_theta) is a convex combination of control points, in the
Bernstein basis of degree 3 in the heading and 2 in x and y. The left side of the inequality is convex in it and is
therefore at most its maximum over these 4 x 3 x 3 points, with the bound of |B| from its own 3 x 3 x 3 points. All are
linear functionals of the 27 coefficients around; `Functionals` tabulates them, for the cell and for the n x n squares
into which it is divided in x and y.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float32, float64, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, NOTHING, VECTOR, tuple_of
from leapnav.experts.proofs.cells import BLOCK, LAYOUT, MASKS, VALUES, Grid, gather
from leapnav.experts.proofs.running_cost import COST

N_COEFFICIENTS, N_POINTS, N_LATERAL = 27, 36, 27  # N_LATERAL: control points of B
ROUNDING = 1e-14  # rounding error of a functional, relative to the sum of the magnitudes of its terms: 90 units


class Functionals(NamedTuple):
    """Control points as linear functionals of 27 coefficients, for each heading of a grid.

    Attributes:
        matrices (headings, 1 + n n, 27, 99): columns 0 to 35 are (A + e B) / sqrt(r_v), 36 to 71 S_theta / sqrt(r_w),
            and 72 to 98 B / sqrt(r_v); index 0 for the cell, 1 + a n + b for the square (a, b).
        excess: tan(tau) - tau, rounded up.
        rounding: bound of the rounding error of a control point, per unit of the largest coefficient.

    """

    matrices: np.ndarray
    excess: float
    rounding: float


TABLE = types.Array(float64, 4, "C")
FUNCTIONALS = record_type(Functionals, matrices=TABLE, excess=float64, rounding=float64)


def functionals(grid: Grid, metric: tuple[float, float], n: int) -> Functionals:
    """Return the functionals for a metric (r_v, r_w) and n x n squares."""
    tau = grid.angle / 2
    headings = (np.arange(grid.headings) + 0.5) * grid.angle
    cos, sin = np.cos(headings)[:, None, None, None], np.sin(headings)[:, None, None, None]
    value, slope = _basis(0.0, 1.0)
    parts = [_basis(a / n, (a + 1) / n) for a in range(n)]
    pairs = [((value, slope),) * 2, *((first, second) for first in parts for second in parts)]
    # S_theta of degree 1 in the heading, written with degree 3.
    first, last = slope[0] / grid.angle, slope[2] / grid.angle
    turning = (first, (2 * first + last) / 3, (first + 2 * last) / 3, last)
    matrices = np.empty((grid.headings, len(pairs), N_COEFFICIENTS, 2 * N_POINTS + N_LATERAL))
    for index, ((x_value, x_slope), (y_value, y_slope)) in enumerate(pairs):
        s_x = np.einsum("qk,ai,dj->qadkij", value, x_slope / grid.spacing, y_value).reshape(3, 9, N_COEFFICIENTS)
        s_y = np.einsum("qk,ai,dj->qadkij", value, x_value, y_slope / grid.spacing).reshape(3, 9, N_COEFFICIENTS)
        a, b = cos * s_x + sin * s_y, cos * s_y - sin * s_x  # (headings, 3, 9, 27)
        # The product of e, of degree 1, and B, of degree 2.
        forward = (
            a[:, 0] - tau * b[:, 0],
            (a[:, 0] + 2 * a[:, 1] + tau * (b[:, 0] - 2 * b[:, 1])) / 3,
            (2 * a[:, 1] + a[:, 2] + tau * (2 * b[:, 1] - b[:, 2])) / 3,
            a[:, 2] + tau * b[:, 2],
        )
        turn = [np.einsum("k,ai,dj->adkij", row, x_value, y_value).reshape(9, N_COEFFICIENTS) for row in turning]
        matrix = matrices[:, index]
        matrix[:, :, :N_POINTS] = np.concatenate(forward, axis=1).transpose(0, 2, 1) / math.sqrt(metric[0])
        matrix[:, :, N_POINTS : 2 * N_POINTS] = np.concatenate(turn).T / math.sqrt(metric[1])
        lateral = b.reshape(grid.headings, N_LATERAL, N_COEFFICIENTS)
        matrix[:, :, 2 * N_POINTS :] = lateral.transpose(0, 2, 1) / math.sqrt(metric[0])
    largest = float(np.abs(matrices).sum(axis=2).max())
    return Functionals(matrices, (math.tan(tau) - tau) * (1 + 1e-9), ROUNDING * largest)


def _basis(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Control points of the value and of the slope on a part of the unit cell, per coefficient before, at and after it.

    The slope, of degree 1, is written with degree 2.
    """
    cell = np.array([[0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 0.5]])
    blossom = [
        ((1 - s) * (1 - t), (1 - s) * t + s * (1 - t), s * t) for s, t in ((low, low), (low, high), (high, high))
    ]
    value = np.array(blossom) @ cell
    first, last = 2 * (value[1] - value[0]) / (high - low), 2 * (value[2] - value[1]) / (high - low)
    return value, np.array([first, (first + last) / 2, last])


@kernel(float64(CUBE, int64, int64, int64, VECTOR))
def take(local, k, i, j, around):
    """Copy the 27 coefficients around a cell, relative to that of the cell.

    Returns the largest magnitude, infinity if a coefficient is not finite.
    """
    index, largest, middle = 0, 0.0, local[k, i, j]
    for a in range(k - 1, k + 2):
        for b in range(i - 1, i + 2):
            for c in range(j - 1, j + 2):
                around[index] = local[a, b, c] - middle
                if not abs(around[index]) <= largest:  # also if it is NaN, which `max` would ignore
                    largest = abs(around[index]) if math.isfinite(around[index]) else np.inf
                index += 1
    return largest


MATRICES = types.Array(float64, 2, "C")


# Flags that let the compiler reorder sums, but not assume that there is no NaN or infinity: the checker tests for them.
IEEE_SPECIAL_VALUES = {"contract", "reassoc", "nsz"}


@kernel(NOTHING(MATRICES, VECTOR, VECTOR), fastmath=IEEE_SPECIAL_VALUES)
def evaluate(matrix, around, points):
    """Control points (99,) from the coefficients around a cell (27,)."""
    for r in range(2 * N_POINTS + N_LATERAL):
        points[r] = 0.0
    for q in range(0, N_COEFFICIENTS, 3):  # three at a time, which halves the time
        x, y, z = around[q], around[q + 1], around[q + 2]
        for r in range(2 * N_POINTS + N_LATERAL):
            points[r] += matrix[q, r] * x + matrix[q + 1, r] * y + matrix[q + 2, r] * z


@kernel(float64(VECTOR, float64, float64))
def largest_square(points, excess, error):
    """Upper bound of the left side of the inequality from control points with an error of at most `error`.

    It is infinite if the error is not finite.
    """
    if not error < np.inf:
        return np.inf
    lateral = 0.0
    for r in range(2 * N_POINTS, 2 * N_POINTS + N_LATERAL):
        lateral = max(lateral, abs(points[r]))
    margin = error + excess * (lateral + error)
    largest = 0.0
    for r in range(N_POINTS):
        forward, turn = abs(points[r]) + margin, abs(points[N_POINTS + r]) + error
        largest = max(largest, forward * forward + turn * turn)
    return largest * (1.0 + 1e-14)


@kernel(tuple_of(int64, float64)(VALUES, LAYOUT, MASKS, COST, FUNCTIONALS, float64, float64, float32[:, :, :, ::1]))
def gradient_ratios(values, layout, mask, cost, functionals, energy, enough, ratios):
    """Upper bounds of |grad_H S| / sqrt(2 (E + Phi)) on the cells of a set.

    Args:
        values (m, 8, 8, 8): coefficients of the spline S.
        layout, mask: the set of cells.
        cost: lower bounds of Phi.
        functionals: the control points.
        energy: E.
        enough: where the bound from the cell as a whole is at most this, it is not improved for a cell or a square.
        ratios (m, 8, 8, 8): the result, 0 for other cells.

    Returns:
        The number of cells that were divided, and the largest ratio.

    """
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    around, points = np.empty(N_COEFFICIENTS), np.empty(2 * N_POINTS + N_LATERAL)
    n = cost.squares.shape[2]
    divided, worst = 0, 0.0
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        gather(values, layout, b, local)
        k0, i0, j0 = (layout.blocks[b, 0] * BLOCK, layout.blocks[b, 1] * BLOCK, layout.blocks[b, 2] * BLOCK)
        for k in range(BLOCK):
            matrices = functionals.matrices[k0 + k]
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if not mask[b, k, i, j]:
                        continue
                    lowest = cost.lowest[i0 + i, j0 + j]
                    error = functionals.rounding * take(local, k + 1, i + 1, j + 1, around)
                    evaluate(matrices[0], around, points)
                    whole = largest_square(points, functionals.excess, error)
                    square = whole / (2.0 * (energy + lowest))
                    if square > enough * enough and n > 1:
                        square = 0.0
                        divided += 1
                        for part in range(n * n):
                            phi = cost.squares[i0 + i, j0 + j, part // n, part % n]
                            if math.isnan(phi):  # no collision-free point
                                continue
                            right = 2.0 * (energy + phi)
                            if whole <= max(square, enough * enough) * right:
                                square = max(square, whole / right)
                                continue
                            evaluate(matrices[1 + part], around, points)
                            square = max(square, largest_square(points, functionals.excess, error) / right)
                    # Rounded up to single precision.
                    ratios[b, k, i, j] = math.sqrt(square) * (1.0 + 1e-6)
                    if not math.sqrt(square) <= worst:  # also if it is not a number
                        worst = math.sqrt(square)
    return divided, worst
