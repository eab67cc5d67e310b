"""Linear systems as compiled kernels: small dense and banded ones with partial pivoting, and positive definite ones.

Systems this small gain nothing from a BLAS, and its threads make them a hundred times slower where another process
keeps the cores busy.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, int64

from leapnav.envs.compiling import njit
from leapnav.experts.integrator import matrix, vector

SMALLEST_PIVOT = 1e-14  # relative to the largest entry: rounding


@njit(boolean(matrix, vector), cache=True, error_model="numpy", nogil=True)
def solve_dense(A, b):
    """Gaussian elimination with partial pivoting, in place: b becomes the solution. False if A is singular."""
    n = len(b)
    largest = np.abs(A).max()
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        if not abs(A[pivot, k]) > SMALLEST_PIVOT * largest:
            return False
        if pivot != k:
            for j in range(k, n):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            b[k], b[pivot] = b[pivot], b[k]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
                b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]
    return True


@njit(boolean(matrix, vector, int64), cache=True, error_model="numpy", nogil=True)
def solve_banded(rows, b, half):
    """Gaussian elimination with partial pivoting of a banded system, in place. False if it is singular.

    The entry of row i and column j stands in `rows[i, j - i + half]`; `half` bounds |i - j|, and partial pivoting fills
    up to `half` more columns on the right, so rows has 3 half + 1 columns. Work: O(n half^2).
    """
    n = len(b)
    width = 3 * half + 1
    for k in range(n):
        last = min(k + half, n - 1)
        pivot = k
        for i in range(k + 1, last + 1):
            if abs(rows[i, k - i + half]) > abs(rows[pivot, k - pivot + half]):
                pivot = i
        if not abs(rows[pivot, k - pivot + half]) > 1e-14:
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


@njit(boolean(matrix, matrix), cache=True, error_model="numpy", nogil=True)
def solve_positive(A, B):
    """Cholesky factorisation of A (n, n), of which the upper half is read, in place: B (n, k) becomes A^-1 B.

    False if A is not positive definite.
    """
    n, width = B.shape
    for k in range(n):
        if not A[k, k] > 0.0:
            return False
        A[k, k] = math.sqrt(A[k, k])
        inverse = 1.0 / A[k, k]
        for j in range(k + 1, n):
            A[k, j] *= inverse
        for i in range(k + 1, n):
            factor = A[k, i]
            if factor != 0.0:
                for j in range(i, n):
                    A[i, j] -= factor * A[k, j]
    for k in range(n):
        for c in range(width):
            B[k, c] /= A[k, k]
        for i in range(k + 1, n):
            for c in range(width):
                B[i, c] -= A[k, i] * B[k, c]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            for c in range(width):
                B[k, c] -= A[k, j] * B[j, c]
        for c in range(width):
            B[k, c] /= A[k, k]
    return True
