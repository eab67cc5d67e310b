"""Adaptive Dormand-Prince 8(5,3) integration of the extremal flow with its sensitivities, as compiled kernels.

E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., section II.5 and the code
DOP853, whose coefficients are scipy's (`scipy.integrate.DOP853`). Order 8 pays here because extremals are wanted to
1e-9 and better: at that accuracy a step of 12 evaluations replaces ten of Dormand and Prince's 5(4) pair. The last
stage of a step is the first of the next. The step size follows the error of z alone, not of the sensitivities: Newton's
method only needs those to a few digits.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, types
from scipy.integrate import DOP853

from leapnav.envs.compiling import njit

vector = float64[::1]
matrix = float64[:, ::1]
cube = float64[:, :, ::1]
constant = types.Array(types.float64, 1, "C", readonly=True)

# flow(z, data, field, S, dz, dS) -> running cost; z = (q, lam) of length 2n, S and dS of shape (2n, columns).
# An explicit function type lets the kernels below be compiled once, cached on disk and used with every system.
FLOW_SIGNATURE = float64(vector, constant, constant, matrix, vector, matrix)
CONTROL_SIGNATURE = types.none(vector, constant, vector)
FLOW = types.FunctionType(FLOW_SIGNATURE)
CONTROL = types.FunctionType(CONTROL_SIGNATURE)

STAGES = 12
ORDER = 8
A = np.ascontiguousarray(np.vstack([DOP853.A, DOP853.B]))  # row 12 is the step itself, where the last stage lies
WEIGHTS = np.ascontiguousarray(DOP853.B)
ERROR_3, ERROR_5 = np.ascontiguousarray(DOP853.E3), np.ascontiguousarray(DOP853.E5)
EXTRA_A, DENSE = np.ascontiguousarray(DOP853.A_EXTRA), np.ascontiguousarray(DOP853.D)
EXTRA_STAGES = len(EXTRA_A)
DENSE_TERMS = 3 + len(DENSE)  # of the interpolant of order 7

MAX_STEPS = 10_000
LIMIT = 1e14  # a state or costate beyond this has diverged
SMALLEST_STEP = 1e-13  # relative to the interval; below it rounding decides


@njit(
    types.UniTuple(float64, 2)(
        FLOW, vector, vector, matrix, vector, int64, int64, float64, float64, float64, constant, constant, float64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def step(flow, y, new, K, L, size, columns, h, tolerance, rough, data, field, first_running):
    """One step of length h from y = (z, S) to `new`, both flat: (cost, error relative to the tolerance).

    K (stages + 1 + extra, len(y)) holds the slopes, its first row given, and L the running costs. The error is that of
    z, and with `rough` > 0 also that of S, to this tolerance. One above 1 is to be rejected; it is infinite where the
    flow left the numbers.
    """
    length = len(y)
    L[0] = first_running
    for s in range(1, STAGES + 1):
        for e in range(length):
            new[e] = 0.0
        for j in range(s):
            a = A[s, j]
            if a != 0.0:
                for e in range(length):
                    new[e] += a * K[j, e]
        for e in range(length):
            new[e] = y[e] + h * new[e]
        slope = K[s]
        L[s] = flow(
            new[:size],
            data,
            field,
            new[size:].reshape((size, columns)),
            slope[:size],
            slope[size:].reshape((size, columns)),
        )
    cost = 0.0
    for s in range(STAGES):
        cost += WEIGHTS[s] * L[s]
    fifth, third = 0.0, 0.0
    for i in range(length if rough > 0.0 else size):
        e5, e3 = 0.0, 0.0
        for s in range(STAGES + 1):
            e5 += ERROR_5[s] * K[s, i]
            e3 += ERROR_3[s] * K[s, i]
        scale = (tolerance if i < size else rough) * (1.0 + max(abs(y[i]), abs(new[i])))
        fifth += (e5 / scale) ** 2
        third += (e3 / scale) ** 2
    if not math.isfinite(fifth + third):
        return h * cost, np.inf
    if fifth == 0.0 and third == 0.0:
        return h * cost, 0.0
    return h * cost, h * fifth / math.sqrt((fifth + 0.01 * third) * size)


@njit(float64(float64, float64), cache=True, error_model="numpy", nogil=True)
def next_step(h, error):
    """Elementary controller of order 8; an infinite error cuts the step to a fifth."""
    return h * min(6.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.125))


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

    Returns (cost, time advanced, step to try next, evaluations of the flow). Evaluations are negative if the flow
    diverged or the step size fell to rounding level.
    """
    size, columns = S.shape
    length = size * (1 + columns)
    y, new = np.empty(length), np.empty(length)
    K = np.empty((STAGES + 1, length))
    L = np.empty(STAGES + 1)
    y[:size] = z
    y[size:] = S.reshape(size * columns)
    cost, elapsed, evaluations = 0.0, 0.0, 1
    h = duration if first_step <= 0.0 else first_step
    slope = K[0]
    running = flow(z, data, field, S, slope[:size], slope[size:].reshape((size, columns)))
    failed = False
    while elapsed < duration:
        wanted = h
        last = elapsed + h >= duration * (1 - 1e-14)
        if last:
            h = duration - elapsed
        part, error = step(flow, y, new, K, L, size, columns, h, tolerance, 0.0, data, field, running)
        evaluations += STAGES
        following = next_step(h, error)
        if error <= 1.0:
            cost += part
            running = L[STAGES]
            y, new = new, y
            K[0] = K[STAGES]
            for i in range(size):
                failed = failed or not abs(y[i]) < LIMIT
            elapsed = duration if last else elapsed + h
            if last:  # cut short by the end of the interval, so the wanted step was not refuted
                following = max(following, wanted)
        h = following
        failed = failed or evaluations > STAGES * MAX_STEPS or h < SMALLEST_STEP * duration
        if failed or (once and error <= 1.0):
            break
    z[:] = y[:size]
    S[:] = y[size:].reshape((size, columns))
    return cost, elapsed, h, -evaluations if failed else evaluations


@njit(
    types.none(FLOW, vector, vector, matrix, vector, int64, float64, float64, constant, constant, matrix),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def interpolant(flow, y, new, K, L, size, h, cost, data, field, terms):
    """Coefficients (DENSE_TERMS, 2n + 1) of the order-7 interpolant of z and the cost, with three more evaluations.

    Only the first `size` entries of y = (z, S) are interpolated. See `evaluate_interpolant`.
    """
    z = np.empty(size)
    none, d_none = np.empty((size, 0)), np.empty((size, 0))
    for s in range(EXTRA_STAGES):
        for i in range(size):
            total = 0.0
            for j in range(STAGES + 1 + s):
                total += EXTRA_A[s, j] * K[j, i]
            z[i] = y[i] + h * total
        L[STAGES + 1 + s] = flow(z, data, field, none, K[STAGES + 1 + s, :size], d_none)
    for i in range(size + 1):
        gap = new[i] - y[i] if i < size else cost
        first, last = (K[0, i], K[STAGES, i]) if i < size else (L[0], L[STAGES])
        terms[0, i] = gap
        terms[1, i] = h * first - gap
        terms[2, i] = 2.0 * gap - h * (last + first)
        for d in range(DENSE_TERMS - 3):
            total = 0.0
            for j in range(STAGES + 1 + EXTRA_STAGES):
                total += DENSE[d, j] * (K[j, i] if i < size else L[j])
            terms[3 + d, i] = h * total


@njit(float64(float64, float64, matrix, int64), cache=True, error_model="numpy", nogil=True)
def evaluate_interpolant(start, s, terms, i):
    """Component i at the fraction s of a step, from its value at the start and the step's `terms`."""
    value = 0.0
    for k in range(DENSE_TERMS - 1, -1, -1):
        value = (value + terms[k, i]) * (s if k % 2 == 0 else 1.0 - s)
    return start + value
