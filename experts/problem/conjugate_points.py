"""Conjugate and focal points along an extremal (Jacobi's condition).

A conjugate point is a zero of det dq(t)/dlambda(0). A determinant that only changes its sign is found during the
re-integration; a zero of even order, which is typical of symmetric problems, is a local minimum of |det| at which the
matrix loses rank.

The functions raise FloatingPointError where the sensitivities diverge, so that the question cannot be decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import boolean
from scipy.optimize import brentq, minimize_scalar

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import INTEGERS, VECTOR
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.frames import (
    DIVERGED,
    MIN_DETERMINANT,
    SENSITIVITY_ACCURACY,
    carry_back,
    orthonormalise,
    pull_back,
)

# A local minimum of |det| may be a zero of even order if it is below this fraction of the largest value before it ...
MAX_DIP = 0.3
# ... and if the parabola through it and its neighbours has its minimum below this fraction of it.
MAX_PARABOLA_MINIMUM = 0.7
# The smallest singular value of an orthonormal frame counts as zero below the first number, if it is also below this
# fraction of its values at the neighbouring steps. A steep barrier or a small control weight make all values small: in
# one extremal they were 4e-6 to 1e-5 over 0.5 s, without a zero.
ZERO_SINGULAR_VALUE, ZERO_FRACTION = 1e-5, 0.1
# Tolerances of the time of a minimum, relative to the two steps. The minimum is computed with the second one only if,
# with the first one, it is below ZERO_FRACTION of the values at the neighbouring steps.
COARSE_TIME_TOLERANCE, TIME_TOLERANCE = 1e-3, 1e-9
DIVERGENCE = "the sensitivities diverge along the extremal"


def conjugate_time(extremal: Extremal, k: int, sensitivity: np.ndarray) -> float | None:
    """Return the time (s) in step k at which det dq(t)/dlambda(0) changes its sign, or None.

    Args:
        extremal: the extremal.
        k: index of the integration step.
        sensitivity: (2n, n), an orthonormal basis of the span of dz/dlambda(0) at the start of the step.

    Returns:
        The time; None if it is the horizon itself, which does not contradict a minimum.

    """

    def determinant(duration: float) -> float:
        z = np.concatenate([extremal.states[k], extremal.costates[k]])
        S = sensitivity.copy()
        if duration > 0.0:
            _transport(extremal, z, S, duration)
        return orthonormalise(S, extremal.problem.clock)

    step = float(extremal.times[k + 1] - extremal.times[k])
    time = float(extremal.times[k]) + _zero(determinant, step)
    return time if time < extremal.horizon * (1 - 1e-9) else None


def first_even_conjugate_time(extremal: Extremal, determinants: np.ndarray) -> float | None:
    """Return the first time (s) at which det dq(t)/dlambda(0) vanishes without a change of sign, or None.

    Args:
        extremal: the extremal.
        determinants: (N,), the determinant at the integrator's steps.

    """
    if len(_dips(extremal.times, determinants, True)) == 0:
        return None
    n, clock = extremal.problem.system.n, extremal.problem.clock
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    S = np.concatenate([np.zeros((n, n)), np.eye(n)])
    frames = [S.copy()]

    def advance(k: int, S: np.ndarray, time: float) -> np.ndarray:
        S, duration = S.copy(), time - float(extremal.times[k])
        if duration > 0.0:
            _transport(extremal, z[k].copy(), S, duration)
            orthonormalise(S, clock)
        return S

    for k in range(len(z) - 1):
        frames.append(advance(k, frames[k], float(extremal.times[k + 1])))

    def frame(time: float) -> np.ndarray:
        k = min(int(np.searchsorted(extremal.times, time, side="right")) - 1, len(frames) - 1)
        return advance(k, frames[k], time)

    return _first_rank_loss(extremal.times, determinants, frame, clock=clock, check_parabola=True)


def _transport(extremal: Extremal, z: np.ndarray, S: np.ndarray, duration: float) -> None:
    """Advance a point (2n,) and its sensitivities in place by a duration (s) > 0."""
    success, *_ = propagate(extremal.problem.arrays.flow, z, S, duration, SENSITIVITY_ACCURACY, 0.0, False)
    if not success:
        raise FloatingPointError(DIVERGENCE)


@kernel(INTEGERS(VECTOR, VECTOR, boolean))
def _dips(times, determinants, check_parabola):
    """Return the indices at which |determinant| has a low local minimum.

    A determinant that has only been rounding error so far is that of an extremal whose controls are at their bounds.
    With `check_parabola` the parabola through each minimum and its neighbours must come close to zero as well.
    """
    found, count, largest = np.empty(len(times), np.int64), 0, 0.0
    for i in range(len(times) - 1):
        here, after = abs(determinants[i]), abs(determinants[i + 1])
        if math.isnan(here):  # the sensitivities have diverged
            break
        largest = max(largest, here)
        before = abs(determinants[i - 1]) if i > 0 else 0.0
        if i == 0 or not (here <= before and here <= after and here < MAX_DIP * largest and largest > MIN_DETERMINANT):
            continue
        falling, rising = (here - before) / (times[i] - times[i - 1]), (after - here) / (times[i + 1] - times[i])
        a = (rising - falling) / (times[i + 1] - times[i - 1])
        b = falling + a * (times[i] - times[i - 1])
        if not check_parabola or a <= 0.0 or here - b * b / (4.0 * a) < MAX_PARABOLA_MINIMUM * here:
            found[count] = i
            count += 1
    return found[:count]


def _first_rank_loss(
    times: np.ndarray,
    determinants: np.ndarray,
    frame: Callable[[float], np.ndarray],
    *,
    clock: int,
    check_parabola: bool,
) -> float | None:
    """Return the first time, in the order of `times`, at which the upper block of the frame loses rank, or None."""
    for i in _dips(times, determinants, check_parabola):
        low, high = sorted((float(times[i - 1]), float(times[i + 1])))
        around = max(smallest_singular_value(frame(t), clock) for t in (low, high))
        coarse = _smallest_between(low, high, frame, clock, COARSE_TIME_TOLERANCE)
        if coarse.fun < ZERO_FRACTION * around:
            found = _smallest_between(low, high, frame, clock, TIME_TOLERANCE)
            if found.fun < min(ZERO_SINGULAR_VALUE, ZERO_FRACTION * around):
                return float(found.x)
    return None


def _smallest_between(low: float, high: float, frame: Callable[[float], np.ndarray], clock: int, tol: float) -> Any:
    """Return SciPy's minimum of the smallest singular value between two times (s)."""
    return minimize_scalar(
        lambda t: smallest_singular_value(frame(t), clock),
        bounds=(low, high),
        method="bounded",
        options={"xatol": tol * (high - low)},
    )


def smallest_singular_value(frame: np.ndarray, clock: int) -> float:
    """Return the smallest singular value of the upper block of a frame (2n, n); see `orthonormalise` for `clock`."""
    n = frame.shape[1]
    rows = np.arange(n) + np.where(np.arange(n) == clock, n, 0)
    if not np.isfinite(frame).all():
        raise FloatingPointError(DIVERGENCE)
    return float(np.linalg.svd(frame[rows], compute_uv=False)[-1])


def first_focal_time(extremal: Extremal, free: np.ndarray) -> float | None:
    """Return the last focal point (s) of an extremal with free final components, or None.

    The variations (dq, dlambda) of the extremals that meet the end conditions form a Lagrangian subspace: at the
    horizon dq_i = 0 where q_i is fixed, and dlambda_i = 0 where it is free. This subspace is carried backwards in time.
    At a focal point its projection on dq loses rank. An extremal with a focal point before its horizon is not a local
    minimum.

    Args:
        extremal: the extremal.
        free: (n,), bool, which final components are free.

    """
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    times, count = extremal.times[::-1].copy(), len(extremal.times)
    frames, determinants = np.empty((count, 2 * n, n)), np.zeros(count)
    frames[0] = np.concatenate([np.diag(free.astype(float)), np.diag((~free).astype(float))])
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    step = carry_back(arrays.flow, extremal.times, z, frames, determinants)
    if step == DIVERGED:
        raise FloatingPointError(DIVERGENCE)

    def back(k: int, time: float) -> tuple[np.ndarray, float]:
        """Return the orthonormal frame at a time within the step before times[k], and its determinant."""
        duration, basis = float(times[k]) - time, frames[k].copy()
        if duration > 0.0:
            z, S = extremal.interpolate(np.array([time]))[0], np.eye(2 * n)
            _transport(extremal, z, S, duration)
            pull_back(S, basis)
        return basis, orthonormalise(basis, -1)

    crossing = None
    if step >= 0:
        determinants = determinants[: step + 2]
        start = float(times[step])
        crossing = start - _zero(lambda d: back(step, start - d)[1], start - float(times[step + 1]))

    def frame(time: float) -> np.ndarray:
        return back(max(int(np.searchsorted(-times, -time, side="left")) - 1, 0), time)[0]

    even = _first_rank_loss(times, determinants, frame, clock=-1, check_parabola=False)
    return max((t for t in (even, crossing) if t is not None), default=None)


def _zero(function: Callable[[float], float], step: float) -> float:
    """Return the sign change of `function` on [0, step]; 0 if rounding hides the sign at the start."""
    if function(0.0) * function(step) >= 0.0:
        return 0.0
    return cast(float, brentq(function, 0.0, step, xtol=1e-12))
