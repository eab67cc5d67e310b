"""Adaptive Dormand-Prince 5(4) integration of the extremal flow with its sensitivities, as compiled kernels.

E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., table II.5.2. The seventh
stage of a step is the first of the next (FSAL). The step size follows the error of z alone, not of the sensitivities:
Newton's method only needs those to a few digits.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, njit, types

vector = float64[::1]
matrix = float64[:, ::1]
constant = types.Array(types.float64, 1, "C", readonly=True)

# flow(z, data, field, S, dz, dS) -> running cost; z = (q, lam) of length 2n, S and dS of shape (2n, columns).
# An explicit function type lets the kernels below be compiled once, cached on disk and used with every system.
FLOW_SIGNATURE = float64(vector, constant, constant, matrix, vector, matrix)
CONTROL_SIGNATURE = types.none(vector, constant, vector)
FLOW = types.FunctionType(FLOW_SIGNATURE)

A21 = 1 / 5
A31, A32 = 3 / 40, 9 / 40
A41, A42, A43 = 44 / 45, -56 / 15, 32 / 9
A51, A52, A53, A54 = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
A61, A62, A63, A64, A65 = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
B1, B3, B4, B5, B6 = 35 / 384, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
E1, E3, E4, E5, E6, E7 = 71 / 57600, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40

ORDER = 5
MAX_STEPS = 20_000
LIMIT = 1e8  # a state or costate beyond this has diverged
SMALLEST_STEP = 1e-13  # relative to the interval; below it rounding decides


@njit(
    types.Tuple((float64, float64, float64, int64))(
        FLOW, vector, matrix, float64, constant, constant, float64, float64, boolean
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def propagate(flow, z, S, duration, data, field, tolerance, first_step, once):
    """Advances z (2n,) and S (2n, columns) in place by `duration`, or by one accepted step if `once`.

    Returns (cost, time advanced, step to try next, steps). Steps are -1 if the flow diverged or the step size fell to
    rounding level.
    """
    size, columns = S.shape
    K = np.empty((7, size))
    KS = np.empty((7, size, columns))
    zt = np.empty(size)
    St = np.empty((size, columns))
    cost, elapsed, steps = 0.0, 0.0, 0
    h = duration if first_step <= 0.0 else first_step
    L1 = flow(z, data, field, S, K[0], KS[0])
    while elapsed < duration:
        wanted = h
        last = elapsed + h >= duration * (1 - 1e-14)
        if last:
            h = duration - elapsed
        for i in range(size):
            zt[i] = z[i] + h * (A21 * K[0, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (A21 * KS[0, i, c])
        flow(zt, data, field, St, K[1], KS[1])
        for i in range(size):
            zt[i] = z[i] + h * (A31 * K[0, i] + A32 * K[1, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (A31 * KS[0, i, c] + A32 * KS[1, i, c])
        L3 = flow(zt, data, field, St, K[2], KS[2])
        for i in range(size):
            zt[i] = z[i] + h * (A41 * K[0, i] + A42 * K[1, i] + A43 * K[2, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (A41 * KS[0, i, c] + A42 * KS[1, i, c] + A43 * KS[2, i, c])
        L4 = flow(zt, data, field, St, K[3], KS[3])
        for i in range(size):
            zt[i] = z[i] + h * (A51 * K[0, i] + A52 * K[1, i] + A53 * K[2, i] + A54 * K[3, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (A51 * KS[0, i, c] + A52 * KS[1, i, c] + A53 * KS[2, i, c] + A54 * KS[3, i, c])
        L5 = flow(zt, data, field, St, K[4], KS[4])
        for i in range(size):
            zt[i] = z[i] + h * (A61 * K[0, i] + A62 * K[1, i] + A63 * K[2, i] + A64 * K[3, i] + A65 * K[4, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (
                    A61 * KS[0, i, c] + A62 * KS[1, i, c] + A63 * KS[2, i, c] + A64 * KS[3, i, c] + A65 * KS[4, i, c]
                )
        L6 = flow(zt, data, field, St, K[5], KS[5])
        for i in range(size):
            zt[i] = z[i] + h * (B1 * K[0, i] + B3 * K[2, i] + B4 * K[3, i] + B5 * K[4, i] + B6 * K[5, i])
            for c in range(columns):
                St[i, c] = S[i, c] + h * (
                    B1 * KS[0, i, c] + B3 * KS[2, i, c] + B4 * KS[3, i, c] + B5 * KS[4, i, c] + B6 * KS[5, i, c]
                )
        L7 = flow(zt, data, field, St, K[6], KS[6])
        error, largest = 0.0, 0.0
        for i in range(size):
            slip = h * (E1 * K[0, i] + E3 * K[2, i] + E4 * K[3, i] + E5 * K[4, i] + E6 * K[5, i] + E7 * K[6, i])
            scale = tolerance * (1.0 + max(abs(z[i]), abs(zt[i])))
            error = max(error, abs(slip) / scale)
            largest = max(largest, abs(zt[i]))
            if not math.isfinite(zt[i]):
                error = np.inf
        steps += 1
        if steps > MAX_STEPS or h < SMALLEST_STEP * duration or (error <= 1.0 and largest > LIMIT):
            return cost, elapsed, h, -1
        # Elementary controller of order 5; an infinite error cuts the step to a fifth.
        following = h * min(5.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.2))
        if error <= 1.0:
            cost += h * (B1 * L1 + B3 * L3 + B4 * L4 + B5 * L5 + B6 * L6)
            L1 = L7
            for i in range(size):
                z[i] = zt[i]
                K[0, i] = K[6, i]
                for c in range(columns):
                    S[i, c] = St[i, c]
                    KS[0, i, c] = KS[6, i, c]
            elapsed = duration if last else elapsed + h
            if last:  # cut short by the end of the interval, so the wanted step was not refuted
                following = max(following, wanted)
            if once:
                return cost, elapsed, following, steps
        h = following
    return cost, elapsed, h, steps
