"""Solvers of small linear systems (kernels): dense and banded.

BLAS does not speed up systems of this size, and its threads make them up to 100 times slower if other processes use the
cores.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import MATRIX, NOTHING, VECTOR

MIN_PIVOT = 1e-14  # rounding level, relative to the entries of the matrix


@kernel(float64(MATRIX, boolean, float64))
def eliminate(A, pivoting, min_pivot):
    """Reduce A to upper triangular form in place by Gaussian elimination, optionally with partial pivoting.

    Right-hand sides are further columns of A. Returns the sign of the row permutation, or 0 if a pivot is not larger
    than `min_pivot` in magnitude.
    """
    n = len(A)
    sign = 1.0
    for k in range(n):
        pivot = k
        if pivoting:
            for i in range(k + 1, n):
                if abs(A[i, k]) > abs(A[pivot, k]):
                    pivot = i
        if not abs(A[pivot, k]) > min_pivot:
            return 0.0
        if pivot != k:
            sign = -sign
            for j in range(k, A.shape[1]):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, A.shape[1]):
                    A[i, j] -= factor * A[k, j]
    return sign


@kernel(NOTHING(MATRIX, VECTOR))
def substitute(A, x):
    """Compute the solution x by back substitution, after `eliminate` reduced A with its right-hand side."""
    n = len(x)
    for k in range(n - 1, -1, -1):
        x[k] = A[k, n]
        for j in range(k + 1, n):
            x[k] -= A[k, j] * x[j]
        x[k] /= A[k, k]


@kernel(boolean(MATRIX, VECTOR, int64))
def solve_banded(rows, b, half):
    """Replace b by the solution of a banded system, by Gaussian elimination with partial pivoting; False if singular.

    A pivot counts as zero at rounding level relative to the smallest row: in the equations of shooting, the magnitudes
    of the rows differ by the growth over a segment, and the largest entry would hide the pivots of the others.

    The matrix is changed in place. `rows[i, j - i + half]` is its entry in row i and column j, with |i - j| <= half.
    Partial pivoting fills up to `half` more columns on the right, so `rows` has 3 half + 1 columns. The cost is
    O(n half^2).
    """
    n = len(b)
    width = 3 * half + 1
    smallest = np.inf  # of the largest entries of the rows
    for i in range(n):
        largest = 0.0
        for j in range(max(half - i, 0), min(2 * half, n - 1 - i + half) + 1):
            largest = max(largest, abs(rows[i, j]))
        smallest = min(smallest, largest)
    min_pivot = MIN_PIVOT * smallest
    for k in range(n):
        last = min(k + half, n - 1)
        pivot = k
        for i in range(k + 1, last + 1):
            if abs(rows[i, k - i + half]) > abs(rows[pivot, k - pivot + half]):
                pivot = i
        if not abs(rows[pivot, k - pivot + half]) > min_pivot:
            return False
        right = min(k + 2 * half, n - 1)
        if pivot != k:
            for j in range(k, right + 1):
                a, c = j - k + half, j - pivot + half
                other = rows[pivot, c] if c < width else 0.0
                if c < width:
                    rows[pivot, c] = rows[k, a]
                rows[k, a] = other
            b[k], b[pivot] = b[pivot], b[k]
        for i in range(k + 1, last + 1):
            factor = rows[i, k - i + half] / rows[k, half]
            if factor != 0.0:
                for j in range(k + 1, right + 1):
                    rows[i, j - i + half] -= factor * rows[k, j - k + half]
                b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, min(k + 2 * half, n - 1) + 1):
            b[k] -= rows[k, j - k + half] * b[j]
        b[k] /= rows[k, half]
    return True
