"""Conjugate and focal points: where extremals from one start, or to one end condition, meet again (Jacobi's test)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import numpy as np
from numba import float64, int64, types
from scipy.optimize import brentq, minimize_scalar

from leapnav.envs.compiling import njit
from leapnav.experts.extremal import Extremal
from leapnav.experts.integrator import FLOW, constant, cube, matrix, propagate, vector

ROUGH_ACCURACY = 1e-6
# A determinant that touches zero dips to this share of its size before, and the parabola through the points around goes
# to this share of the lowest; a singular value that counts as zero.
DIP, DEEPER, TOUCHED = 0.3, 0.7, 1e-5
NO_RANK = 1e-9  # a determinant below this has no sign that rounding leaves


@njit(float64(matrix), cache=True, error_model="numpy", nogil=True)
def orthonormalise(S):
    """Modified Gram-Schmidt on the columns, in place; returns the determinant of the upper square block."""
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
    block = S[:n].copy()
    determinant = 1.0
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(block[i, k]) > abs(block[pivot, k]):
                pivot = i
        if block[pivot, k] == 0.0:
            return 0.0
        if pivot != k:
            determinant = -determinant
            for j in range(n):
                block[k, j], block[pivot, j] = block[pivot, j], block[k, j]
        determinant *= block[k, k]
        for i in range(k + 1, n):
            factor = block[i, k] / block[k, k]
            for j in range(k, n):
                block[i, j] -= factor * block[k, j]
    return determinant


def conjugate_time(extremal: Extremal, k: int, sensitivity: np.ndarray) -> float | None:
    """When det dq(t)/dlambda(0) vanishes within step k, at whose start dz/dlambda(0) spans `sensitivity` (2n, n)."""
    arrays = extremal.problem.arrays

    def determinant(duration: float) -> float:
        z = np.concatenate([extremal.states[k], extremal.costates[k]])
        S = sensitivity.copy()
        if duration > 0.0:
            propagate(arrays.flow, z, S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
        return orthonormalise(S)

    step = float(extremal.times[k + 1] - extremal.times[k])
    time = float(extremal.times[k]) + _zero(determinant, step)
    # One at the horizon itself does not contradict a minimum.
    return time if time < extremal.problem.horizon * (1 - 1e-9) else None


def first_touch(extremal: Extremal, determinants: np.ndarray) -> float | None:
    """First time at which det dq(t)/dlambda(0) vanishes without a change of sign, as it does in symmetric problems."""
    if not _dips(extremal.times, determinants, likely=True):
        return None
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    S = np.concatenate([np.zeros((n, n)), np.eye(n)])
    frames = [S.copy()]

    def advance(k: int, S: np.ndarray, time: float) -> np.ndarray:
        S, duration = S.copy(), time - float(extremal.times[k])
        if duration > 0.0:
            propagate(arrays.flow, z[k].copy(), S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
            orthonormalise(S)
        return S

    for k in range(len(z) - 1):
        frames.append(advance(k, frames[k], float(extremal.times[k + 1])))

    def frame(time: float) -> np.ndarray:
        k = min(int(np.searchsorted(extremal.times, time, side="right")) - 1, len(frames) - 1)
        return advance(k, frames[k], time)

    return _touch(extremal.times, determinants, frame, likely=True)


def _dips(times: np.ndarray, determinants: np.ndarray, likely: bool) -> list[int]:
    """Inner points at which |determinant| has a low minimum; the `likely` ones by the parabola through three points."""
    size = np.abs(determinants)
    before = np.maximum.accumulate(size)[1:-1]
    lowest = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < DIP * before)
    found = []
    for i in np.flatnonzero(lowest) + 1:
        a, b, c = np.polyfit(times[i - 1 : i + 2] - times[i], size[i - 1 : i + 2], 2)
        if not likely or a <= 0.0 or c - b * b / (4.0 * a) < DEEPER * size[i]:
            found.append(int(i))
    return found


def _touch(
    times: np.ndarray, determinants: np.ndarray, frame: Callable[[float], np.ndarray], likely: bool
) -> float | None:
    """First time (in the order of `times`) near a dip at which the frame's upper block loses rank."""
    for i in _dips(times, determinants, likely):
        low, high = sorted((float(times[i - 1]), float(times[i + 1])))
        found = minimize_scalar(
            lambda t: _smallest_singular_value(frame(t)),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-9 * (high - low)},
        )
        if found.fun < TOUCHED:
            return float(found.x)
    return None


def _smallest_singular_value(frame: np.ndarray) -> float:
    """Of the upper block of a frame (2n, n)."""
    return float(np.linalg.svd(frame[: frame.shape[1]], compute_uv=False)[-1])


@njit(types.none(matrix, matrix), cache=True, error_model="numpy", nogil=True)
def _pull_back(S, basis):
    """Turns basis (2n, n) into S^-1 basis for a symplectic S (2n, 2n), whose inverse is [[D', -B'], [-C', A']]."""
    size, n = basis.shape
    pulled = np.zeros((size, n))
    for i in range(n):
        for r in range(n):
            for j in range(n):
                pulled[i, j] += S[n + r, n + i] * basis[r, j] - S[r, n + i] * basis[n + r, j]
                pulled[n + i, j] += S[r, i] * basis[n + r, j] - S[n + r, i] * basis[r, j]
    basis[:] = pulled


@njit(int64(FLOW, vector, matrix, constant, constant, cube, vector), cache=True, error_model="numpy", nogil=True)
def _carry_back(flow, times, z, data, field, frames, determinants):
    """Carries frames[0] (2n, n), at the last of the times, back to the others; the step of a change of sign, or -1.

    Fills `frames` (N, 2n, n), orthonormal, and `determinants` (N,) of their upper blocks, in the order of falling
    times, up to the step in which the determinant changes its sign.
    """
    last = len(times) - 1
    size = z.shape[1]
    sign = 0.0
    S = np.empty((size, size))
    for k in range(last):
        early = last - k - 1
        state = z[early].copy()
        S[:] = 0.0
        for i in range(size):
            S[i, i] = 1.0
        propagate(flow, state, S, times[early + 1] - times[early], data, field, ROUGH_ACCURACY, 0.0, False)
        frames[k + 1] = frames[k]
        _pull_back(S, frames[k + 1])
        determinants[k + 1] = orthonormalise(frames[k + 1])
        if abs(determinants[k + 1]) > NO_RANK:
            if sign * determinants[k + 1] < 0.0:
                return k
            sign = math.copysign(1.0, determinants[k + 1])
    return -1


def first_focal_time(extremal: Extremal, free: np.ndarray) -> float | None:
    """Last time at which the extremals that meet the end conditions focus, for free final components.

    These extremals are a Lagrangian subspace of (dq, dlambda): at the horizon dq_i = 0 where q_i is fixed and
    dlambda_i = 0 where it is free. Carried backwards, its projection on dq loses rank at a focal point, and an extremal
    with one before its horizon is no local minimum.
    """
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    times, count = extremal.times[::-1], len(extremal.times)
    frames, determinants = np.empty((count, 2 * n, n)), np.zeros(count)
    frames[0] = np.concatenate([np.diag(free.astype(float)), np.diag((~free).astype(float))])
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    step = _carry_back(arrays.flow, extremal.times, z, arrays.data, arrays.field, frames, determinants)

    def back(k: int, time: float) -> tuple[np.ndarray, float]:
        """The frame at a time up to a step before times[k], orthonormal, and its determinant."""
        duration, basis = float(times[k]) - time, frames[k].copy()
        if duration > 0.0:
            z, S = extremal.interpolate(np.array([time]))[0], np.eye(2 * n)
            propagate(arrays.flow, z, S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
            _pull_back(S, basis)
        return basis, orthonormalise(basis)

    crossing = None
    if step >= 0:
        determinants = determinants[: step + 2]
        start = float(times[step])
        crossing = start - _zero(lambda d: back(step, start - d)[1], start - float(times[step + 1]))

    def frame(time: float) -> np.ndarray:
        return back(max(int(np.searchsorted(-times, -time, side="left")) - 1, 0), time)[0]

    touch = _touch(times, determinants, frame, likely=False)
    return max((t for t in (touch, crossing) if t is not None), default=None)


def _zero(function: Callable[[float], float], step: float) -> float:
    """Where `function` changes its sign on [0, step]; the start, if it is too small there to have one."""
    if function(0.0) * function(step) >= 0.0:
        return 0.0
    return cast(float, brentq(function, 0.0, step, xtol=1e-12))
