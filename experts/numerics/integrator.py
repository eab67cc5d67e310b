"""Adaptive Dormand-Prince 8(5,3) integration of the extremal flow with its sensitivities, as compiled kernels.

E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., section II.5, and the code
DOP853, with the coefficients of `scipy.integrate.DOP853`. Order 8 is efficient because extremals are computed to 1e-9
and better: at that accuracy one step of 12 evaluations replaces ten steps of the Dormand-Prince 5(4) pair. The last
stage of a step is the first stage of the next. The step size is controlled by the error of z alone, because Newton's
method needs the sensitivities to a few digits only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64
from scipy.integrate import DOP853

from leapnav.envs.field.layout import header_of, time_to_knot
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import matrix_of, part_of
from leapnav.envs.kernels.types import MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import FLOW

STAGES = 12
ORDER = 8
A = np.ascontiguousarray(np.vstack([DOP853.A, DOP853.B]))  # the last row is the step itself
WEIGHTS = np.ascontiguousarray(DOP853.B)
ERROR_3, ERROR_5 = np.ascontiguousarray(DOP853.E3), np.ascontiguousarray(DOP853.E5)
EXTRA_A, DENSE = np.ascontiguousarray(DOP853.A_EXTRA), np.ascontiguousarray(DOP853.D)
EXTRA_STAGES = len(EXTRA_A)
ALL_STAGES = STAGES + 1 + EXTRA_STAGES
DENSE_TERMS = 3 + len(DENSE)  # number of terms of the interpolant of order 7

MAX_STEPS = 1_000  # per interval; segments of extremals take 10 to 100
# Fractions of a step: accuracy of the boundary of a smooth piece, with which the error of z is at rounding level, and
# distances before and after the boundary at which a point and the stages around it are in one piece. With 1e-5 before
# it, 1.1 times as many evaluations in random scenarios; with 1e-3, the error of `cross` would be larger than that of
# other steps.
FRACTION_ACCURACY, MARGIN, BEYOND = 1e-10, 1e-4, 1e-9
MAX_ESTIMATES = 2  # of a boundary; with 1, up to 1.03 times as many evaluations, with 3 as many
# s before and after a knot of the path of a moving obstacle, where a step ends and the next one begins. At the knot the
# costate of the time has a kink, whose error is about this number.
KNOT_GAP = 1e-11
MAX_VALUE = 1e14  # a state or costate beyond this has diverged
MIN_STEP = 1e-13  # relative to the interval; smaller steps are at rounding level


class Stages(NamedTuple):
    """The stages of one step.

    Attributes:
        slopes: (ALL_STAGES, len(y)), derivatives of y = (z, S); the last EXTRA_STAGES serve the interpolant.
        running: (number of slopes,), running costs.

    """

    slopes: np.ndarray
    running: np.ndarray


STAGES_TYPE = record_type(Stages, slopes=MATRIX, running=VECTOR)


@kernel(NOTHING(FLOW, VECTOR, STAGES_TYPE, int64, int64))
def evaluate_stage(flow, y, stages, s, size):
    """Fill slope and running cost of stage s at y = (z, S), flat, or at y = z, of `size` entries."""
    start, columns = s * stages.slopes.shape[1], len(y) // size - 1
    stages.running[s] = flow.function(
        part_of(y, 0, size),
        flow.data,
        flow.field,
        matrix_of(y, size, size, columns),
        part_of(stages.slopes, start, size),
        matrix_of(stages.slopes, start + size, size, columns),
    )


@kernel(tuple_of(float64, float64)(FLOW, VECTOR, VECTOR, STAGES_TYPE, int64, float64, float64, float64))
def step(flow, y, new, stages, size, h, tolerance, sensitivity_tolerance):
    """Make one step of length h from y = (z, S) to `new`, both flat; return (cost, error relative to the tolerance).

    The first slope and running cost are given. The error is that of z (the first `size` entries), and with
    `sensitivity_tolerance` > 0 also that of S. A step with an error above 1 has to be rejected. The error is infinite
    if the flow is not finite.
    """
    K, L = stages.slopes, stages.running
    length = len(y)
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
        evaluate_stage(flow, new, stages, s, size)
    cost = 0.0
    for s in range(STAGES):
        cost += WEIGHTS[s] * L[s]
    fifth, third = 0.0, 0.0
    for i in range(length if sensitivity_tolerance > 0.0 else size):
        e5, e3 = 0.0, 0.0
        for s in range(STAGES + 1):
            e5 += ERROR_5[s] * K[s, i]
            e3 += ERROR_3[s] * K[s, i]
        scale = (tolerance if i < size else sensitivity_tolerance) * (1.0 + max(abs(y[i]), abs(new[i])))
        fifth += (e5 / scale) ** 2
        third += (e3 / scale) ** 2
    if not math.isfinite(fifth + third):
        return h * cost, np.inf
    if fifth == 0.0 and third == 0.0:
        return h * cost, 0.0
    return h * cost, h * fifth / math.sqrt((fifth + 0.01 * third) * size)


@kernel(float64(float64, float64))
def next_step(h, error):
    """Return the next step size of an elementary controller of order 8; an infinite error reduces the step to 1/5."""
    return h * min(6.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.125))


@kernel(NOTHING(VECTOR, VECTOR, STAGES_TYPE, float64, float64, MATRIX))
def cubic_interpolant(y, new, stages, h, cost, terms):
    """Fill the coefficients of the cubic interpolant, see `interpolant`."""
    K, L = stages.slopes, stages.running
    size = terms.shape[1] - 1
    terms[:] = 0.0
    for i in range(size + 1):
        change = new[i] - y[i] if i < size else cost
        first, last = (K[0, i], K[STAGES, i]) if i < size else (L[0], L[STAGES])
        terms[0, i] = change
        terms[1, i] = h * first - change
        terms[2, i] = 2.0 * change - h * (last + first)


@kernel(NOTHING(FLOW, VECTOR, VECTOR, STAGES_TYPE, float64, float64, MATRIX))
def interpolant(flow, y, new, stages, h, cost, terms):
    """Fill the coefficients (DENSE_TERMS, 2n + 1) of the interpolant of order 7 of z and the cost.

    Takes three more evaluations of the flow. Only the first 2n entries of y = (z, S) are interpolated. See
    `evaluate_interpolant`.
    """
    K, L = stages.slopes, stages.running
    size = terms.shape[1] - 1
    z = np.empty(size)
    none, d_none = np.empty((size, 0)), np.empty((size, 0))
    for s in range(EXTRA_STAGES):
        for i in range(size):
            total = 0.0
            for j in range(STAGES + 1 + s):
                total += EXTRA_A[s, j] * K[j, i]
            z[i] = y[i] + h * total
        slope = part_of(K, (STAGES + 1 + s) * K.shape[1], size)
        L[STAGES + 1 + s] = flow.function(z, flow.data, flow.field, none, slope, d_none)
    cubic_interpolant(y, new, stages, h, cost, terms)
    for i in range(size + 1):
        for d in range(DENSE_TERMS - 3):
            total = 0.0
            for j in range(ALL_STAGES):
                total += DENSE[d, j] * (K[j, i] if i < size else L[j])
            terms[3 + d, i] = h * total


@kernel(float64(float64, float64, MATRIX, int64))
def evaluate_interpolant(start, s, terms, i):
    """Return component i at the fraction s of a step, from its value at the start and the terms of the interpolant."""
    value = 0.0
    for k in range(DENSE_TERMS - 1, -1, -1):
        value = (value + terms[k, i]) * (s if k % 2 == 0 else 1.0 - s)
    return start + value


@kernel(float64(FLOW, VECTOR, VECTOR, STAGES_TYPE, int64, float64, float64, float64))
def _boundary(flow, y, new, stages, size, h, end, accuracy):
    """Return the fraction of a step, at most `end`, at which its interpolant leaves the smooth piece of y.

    The end of the step, at the fraction 1, is given.
    """
    first = flow.piece(part_of(y, 0, size), flow.data, flow.field)
    low, high, fraction = 0.0, 1.0, end
    if flow.piece(part_of(new, 0, size), flow.data, flow.field) == first:
        if end == 1.0:
            return end
        low, high = 1.0, end
    else:
        fraction = 0.5
    terms, z = np.empty((DENSE_TERMS, size + 1)), np.empty(size)
    interpolant(flow, y, new, stages, h, 0.0, terms)
    while high - low > accuracy:
        for i in range(size):
            z[i] = evaluate_interpolant(y[i], fraction, terms, i)
        if flow.piece(z, flow.data, flow.field) != first:
            high = fraction
        elif fraction == end:
            return end
        else:
            low = fraction
        fraction = 0.5 * (low + high)
    return low


@kernel(tuple_of(float64, int64)(FLOW, VECTOR, VECTOR, STAGES_TYPE, int64, float64))
def _smooth_fraction(flow, y, new, stages, size, h):
    """Return the fraction of a step at which its smooth piece of the flow ends, and the evaluations of the flow.

    The fraction is 1 if both ends of the step are in the same piece. The interpolant of the step gives a first
    estimate. The interpolant of another step of z, which ends just before it, is accurate.
    """
    fraction = _boundary(flow, y, new, stages, size, h, 1.0, MARGIN)
    if not 2.0 * MARGIN < fraction < 1.0:
        return 1.0, 0 if fraction == 1.0 else EXTRA_STAGES
    start, end = y[:size].copy(), np.empty(size)
    closer = Stages(np.empty((ALL_STAGES, size)), np.empty(ALL_STAGES))
    closer.slopes[0] = stages.slopes[0, :size]
    closer.running[0] = stages.running[0]
    evaluations = EXTRA_STAGES
    for _ in range(MAX_ESTIMATES):
        before = fraction - MARGIN
        step(flow, start, end, closer, size, before * h, 1.0, 0.0)
        farthest = 1.0 + 4.0 * MARGIN / before
        found = _boundary(flow, start, end, closer, size, before * h, farthest, FRACTION_ACCURACY)
        fraction = found * before
        evaluations += STAGES + EXTRA_STAGES
        if 1.0 < found < farthest:
            break
    return (fraction if fraction < 1.0 - BEYOND else 1.0), evaluations


@kernel(tuple_of(float64, float64, int64)(FLOW, VECTOR, VECTOR, STAGES_TYPE, int64, float64, float64))
def shorter_step(flow, y, new, stages, size, h, error):
    """Return (step size, gap, evaluations of the flow) after a rejected step of length h.

    A step across a discontinuity of the derivatives has a low order, so that many steps would be rejected before it.
    Therefore the next step ends just before the boundary of its smooth piece. `gap` is the length (s) of the following
    step, which `cross` makes across the boundary; it is 0 if the rejected step did not leave its piece.
    """
    evaluations = 0
    if error < np.inf:
        fraction, evaluations = _smooth_fraction(flow, y, new, stages, size, h)
        if fraction < 1.0:
            return (fraction - MARGIN) * h, (MARGIN + BEYOND) * h, evaluations
    return next_step(h, error), 0.0, evaluations


@kernel(tuple_of(float64, float64)(FLOW, VECTOR, float64))
def before_knot(flow, y, h):
    """Return (step size, gap) of a step from y = (z, S), flat, that would be of length h.

    A step ends just before the next knot of the path of a moving obstacle, at which the flow is discontinuous. `gap` is
    then the length (s) of the following step, which `cross` makes across the knot, otherwise 0. The step size is at
    most 0 if y is there already.
    """
    if len(flow.field) == 0 or header_of(flow.field).moving == 0:
        return h, 0.0
    ahead = time_to_knot(flow.field, y[header_of(flow.field).clock])
    return (h, 0.0) if h < ahead - KNOT_GAP else (ahead - KNOT_GAP, 2.0 * KNOT_GAP)


@kernel(float64(FLOW, VECTOR, VECTOR, STAGES_TYPE, int64, float64))
def cross(flow, y, new, stages, size, h):
    """Make a very short step of length h across the boundary of a smooth piece, and return its cost.

    The step is of Heun's method for z, and of Euler's for S. Like `step`, it computes the last slopes, which are the
    first of the next step.
    """
    K, L = stages.slopes, stages.running
    for e in range(len(y)):
        new[e] = y[e] + h * K[0, e]
    evaluate_stage(flow, part_of(new, 0, size), stages, STAGES, size)
    for i in range(size):
        new[i] = y[i] + 0.5 * h * (K[0, i] + K[STAGES, i])
    evaluate_stage(flow, new, stages, STAGES, size)
    return 0.5 * h * (L[0] + L[STAGES])


@kernel(tuple_of(boolean, float64, float64, float64, int64)(FLOW, VECTOR, MATRIX, float64, float64, float64, boolean))
def propagate(flow, z, S, duration, tolerance, first_step, once):
    """Advance z (2n,) and S (2n, columns) in place by `duration`, or by one accepted step if `once`.

    Returns (success, cost, elapsed time, next step size, evaluations of the flow). Without success the flow diverged or
    the step size fell to rounding level; then z, S and the cost are NaN, so that no caller can use them by mistake.
    """
    size, columns = S.shape
    length = size * (1 + columns)
    y, new = np.empty(length), np.empty(length)
    stages = Stages(np.empty((ALL_STAGES, length)), np.empty(ALL_STAGES))
    K, L = stages.slopes, stages.running
    for i in range(size):
        y[i] = z[i]
        for c in range(columns):
            y[size + i * columns + c] = S[i, c]
    cost, elapsed, evaluations = 0.0, 0.0, 1
    h = duration if first_step <= 0.0 else first_step
    evaluate_stage(flow, y, stages, 0, size)
    failed, last, proposed, gap, crosses = False, False, h, 0.0, False
    while elapsed < duration:
        if gap == 0.0:
            proposed = h
            h, gap = before_knot(flow, y, h)
            if h <= 0.0:
                crosses, h = True, proposed
        if crosses:
            taken, error = min(gap, duration - elapsed), 0.0
            part = cross(flow, y, new, stages, size, taken)
            evaluations += 2
        else:
            last = elapsed + h >= duration * (1 - 1e-14)
            if last:
                h = duration - elapsed
            part, error = step(flow, y, new, stages, size, h, tolerance, 0.0)
            taken, evaluations = h, evaluations + STAGES
        if error > 1.0:
            h, gap, count = shorter_step(flow, y, new, stages, size, h, error)
            evaluations += count
        else:
            cost += part
            L[0] = L[STAGES]
            y, new = new, y
            for e in range(length):
                K[0, e] = K[STAGES, e]
            for i in range(size):
                failed = failed or not abs(y[i]) < MAX_VALUE
            elapsed = duration if last else elapsed + taken
            if not crosses:
                # A shortened step keeps the proposal of the step size control.
                h = max(next_step(h, error), proposed) if last or gap > 0.0 else next_step(h, error)
            crosses = gap > 0.0 and not crosses
            gap = gap if crosses else 0.0
        failed = failed or evaluations > STAGES * MAX_STEPS or h < MIN_STEP * duration
        if failed or (once and error <= 1.0):
            break
    for i in range(size):
        z[i] = np.nan if failed else y[i]
        for c in range(columns):
            S[i, c] = np.nan if failed else y[size + i * columns + c]
    return not failed, np.nan if failed else cost, elapsed, h, evaluations
