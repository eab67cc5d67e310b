"""Orthonormal frames of the sensitivities along an extremal, and their transport backwards in time (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CUBE, MATRIX, NOTHING, VECTOR
from leapnav.experts.numerics.flow import FLOW
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.linear import eliminate

SENSITIVITY_ACCURACY = 1e-6  # integrator tolerance for the sensitivities
MIN_DETERMINANT = 1e-9  # below this, rounding decides the sign of a determinant
NO_CHANGE, DIVERGED = -1, -2  # results of `carry_back` other than the index of a step


@kernel(float64(MATRIX, int64))
def orthonormalise(S, clock):
    """Orthonormalise the columns of S (2n, n) by modified Gram-Schmidt; return the determinant of the upper block.

    In the row `clock` of the block, that of a state which no control changes, is that of its costate; -1 for no state.
    """
    size, n = S.shape
    for j in range(n):
        for i in range(j):
            dot = 0.0
            for r in range(size):
                dot += S[r, i] * S[r, j]
            for r in range(size):
                S[r, j] -= dot * S[r, i]
        norm = 0.0
        for r in range(size):
            norm += S[r, j] ** 2
        norm = math.sqrt(norm)
        for r in range(size):
            S[r, j] /= norm
    block = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            block[i, j] = S[n + i if i == clock else i, j]
    determinant = eliminate(block, True, 0.0)
    for k in range(n):
        determinant *= block[k, k]
    return determinant


@kernel(NOTHING(MATRIX, MATRIX))
def pull_back(S, basis):
    """Replace `basis` (2n, n) by S^-1 basis for a symplectic S = [[A, B], [C, D]], S^-1 = [[D', -B'], [-C', A']]."""
    size, n = basis.shape
    pulled = np.empty((size, n))
    for i in range(n):
        for j in range(n):
            upper, lower = 0.0, 0.0
            for r in range(n):
                upper += S[n + r, n + i] * basis[r, j] - S[r, n + i] * basis[n + r, j]
                lower += S[r, i] * basis[n + r, j] - S[n + r, i] * basis[r, j]
            pulled[i, j], pulled[n + i, j] = upper, lower
    for i in range(size):
        for j in range(n):
            basis[i, j] = pulled[i, j]


@kernel(int64(FLOW, VECTOR, MATRIX, CUBE, VECTOR))
def carry_back(flow, times, z, frames, determinants):
    """Transport frames[0] (2n, n), given at the last time, backwards until its determinant changes sign.

    Fills the orthonormal `frames` (N, 2n, n) and the `determinants` (N,) of their upper blocks, in the order of
    decreasing time. Returns the index of the step with the sign change, NO_CHANGE, or DIVERGED if the sensitivities
    cannot be integrated.
    """
    last = len(times) - 1
    size = z.shape[1]
    sign = 0.0
    S = np.empty((size, size))
    for k in range(last):
        early = last - k - 1
        state = z[early].copy()
        for i in range(size):
            for j in range(size):
                S[i, j] = 1.0 if i == j else 0.0
        duration = times[early + 1] - times[early]
        success, _, _, _, _ = propagate(flow, state, S, duration, SENSITIVITY_ACCURACY, 0.0, False)
        if not success:
            return DIVERGED
        for i in range(size):
            for j in range(frames.shape[2]):
                frames[k + 1, i, j] = frames[k, i, j]
        pull_back(S, frames[k + 1])
        determinants[k + 1] = orthonormalise(frames[k + 1], -1)
        if abs(determinants[k + 1]) > MIN_DETERMINANT:
            if sign * determinants[k + 1] < 0.0:
                return k
            sign = math.copysign(1.0, determinants[k + 1])
    return NO_CHANGE
