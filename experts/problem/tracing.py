"""Re-integration of a solver's nodes, and the clearance along the interpolated path (kernels)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, int64

from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.layout import header_of
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import matrix_of, part_of
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, CUBE, INTEGERS, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, FLOW
from leapnav.experts.numerics.integrator import (
    ALL_STAGES,
    MAX_VALUE,
    MIN_STEP,
    Stages,
    before_knot,
    cross,
    cubic_interpolant,
    evaluate_interpolant,
    evaluate_stage,
    interpolant,
    next_step,
    shorter_step,
    step,
)
from leapnav.experts.problem.frames import MIN_DETERMINANT, SENSITIVITY_ACCURACY, orthonormalise

FULL, DIVERGED = -1, -2  # error codes that `trace` returns instead of the number of rows


class TraceRecord(NamedTuple):
    """The output of `trace`.

    Attributes:
        rows: (N, 4 + m + 4n), one row per accepted step: time, accumulated cost, running cost, u (m), z (2n), z' (2n),
            and the determinant of dq/dlambda(0) in an orthonormal basis.
        terms: (N, DENSE_TERMS, 2n + 1), the interpolant of the step that starts at the row.
        sensitivity: (2n, n), dz/dlambda(0), orthonormalised, at the start of the step with the first conjugate point.
        final: (2n, n), the same at the final time.

    """

    rows: np.ndarray
    terms: np.ndarray
    sensitivity: np.ndarray
    final: np.ndarray


TRACE_RECORD = record_type(TraceRecord, rows=MATRIX, terms=CUBE, sensitivity=MATRIX, final=MATRIX)


@kernel(tuple_of(int64, float64, int64)(FLOW, CONTROL_FUNCTION, VECTOR, MATRIX, int64, float64, TRACE_RECORD))
def trace(flow, control, times, Z, clock, accuracy, record):
    """Integrate each segment from its node and record every accepted step.

    The index `clock` is that of the time in the state, -1 without it, see `orthonormalise`.

    Returns (n_rows, defect, conjugate): the number of rows, FULL if the record is too short or DIVERGED; the largest
    defect at a node; the index of the step with the first conjugate point, or -1.
    """
    out = record.rows
    size = Z.shape[1]
    n = size // 2
    m = out.shape[1] - 4 - 2 * size
    length = size * (1 + n)
    y, new = np.zeros(length), np.empty(length)
    stages = Stages(np.empty((ALL_STAGES, length)), np.empty(ALL_STAGES))
    K, L = stages.slopes, stages.running
    before_step = np.zeros((size, n))
    for i in range(n):
        y[size + (n + i) * n + i] = 1.0
    rows, defect, conjugate, total, sign, determinant = 0, 0.0, -1, 0.0, 0.0, 0.0
    last = len(times) - 2
    h, gap, crosses = (times[1] - times[0]) / 4.0, 0.0, False
    proposed, taken, ends = h, h, False
    for k in range(last + 1):
        for i in range(size):
            y[i] = Z[k, i]
        elapsed, duration = 0.0, times[k + 1] - times[k]
        evaluate_stage(flow, y, stages, 0, size)
        while True:
            finished = elapsed >= duration
            if not finished or k == last:
                if rows == len(out):
                    return FULL, defect, conjugate
                out[rows, 0] = times[k] + elapsed
                out[rows, 1] = total
                out[rows, 2] = L[0]
                control(part_of(y, 0, size), flow.data, part_of(out, rows * out.shape[1] + 3, m))
                for i in range(size):
                    out[rows, 3 + m + i] = y[i]
                    out[rows, 3 + m + size + i] = K[0, i]
                out[rows, 3 + m + 2 * size] = determinant
            if finished:
                break
            if gap == 0.0:
                proposed = h
                h, gap = before_knot(flow, y, h)
                if h <= 0.0:
                    crosses, h = True, proposed
            if crosses:
                taken, ends = min(gap, duration - elapsed), False
                cost = cross(flow, y, new, stages, size, taken)
                cubic_interpolant(y, new, stages, taken, cost, record.terms[rows])
            else:
                while True:
                    if gap == 0.0:
                        proposed = h
                    ends = elapsed + h >= duration * (1 - 1e-14)
                    if ends:
                        h = duration - elapsed
                    cost, error = step(flow, y, new, stages, size, h, accuracy, SENSITIVITY_ACCURACY)
                    taken = h
                    if error <= 1.0:
                        break
                    h, gap, _ = shorter_step(flow, y, new, stages, size, h, error)
                    if h < MIN_STEP * times[last + 1]:
                        return DIVERGED, np.inf, conjugate
                # A shortened step keeps the proposal of the step size control.
                h = max(next_step(h, error), proposed) if ends or gap > 0.0 else next_step(h, error)
                interpolant(flow, y, new, stages, taken, cost, record.terms[rows])
            rows += 1
            total += cost
            elapsed = duration if ends else elapsed + taken
            for i in range(size):
                for j in range(n):
                    before_step[i, j] = y[size + i * n + j]
            y, new = new, y
            for i in range(size):
                if not abs(y[i]) < MAX_VALUE:
                    return DIVERGED, np.inf, conjugate
            # Only the span of S matters. Gram-Schmidt keeps it numerically independent over any horizon, and its
            # positive scaling leaves the sign of det dq/dlambda(0) unchanged.
            determinant = orthonormalise(matrix_of(y, size, size, n), clock)
            # Orthonormalisation changed S, so the last stage of the step cannot serve as the first of the next one.
            evaluate_stage(flow, y, stages, 0, size)
            crosses = gap > 0.0 and not crosses
            gap = gap if crosses else 0.0
            if abs(determinant) > MIN_DETERMINANT and conjugate < 0:
                if sign == 0.0:
                    sign = math.copysign(1.0, determinant)
                elif sign * determinant < 0.0:
                    conjugate = rows - 1
                    for i in range(size):
                        for j in range(n):
                            record.sensitivity[i, j] = before_step[i, j]
        for i in range(size):
            defect = max(defect, abs(y[i] - Z[k + 1, i]))
    for i in range(size):
        for j in range(n):
            record.final[i, j] = y[size + i * n + j]
    return rows + 1, defect, conjugate


@kernel(NOTHING(float64, INTEGERS, VECTOR, MATRIX, VECTOR), forceinline=True)
def _interpolate(s, places, start, terms, q):
    """Write the pose, or the state if it has further entries, at a fraction of a step to q."""
    for i in range(len(q)):
        place = places[i] if i < 3 else i
        q[i] = evaluate_interpolant(start[place], s, terms, place) if place >= 0 else 0.0


@kernel(float64(CONSTANT, CONSTANT_MATRIX, INTEGERS, VECTOR, MATRIX, CUBE))
def dense_clearance(field, outline, places, times, starts, terms):
    """Return the smallest clearance (m) along the interpolated path.

    Clearance changes by at most the distance travelled by a disc or a corner, so parts of the path without a smaller
    value are skipped.

    Args:
        field: packed obstacle field.
        outline (K, 5): of the robot, see `leapnav.envs.robots.footprints.outline_of`.
        places (3,): indices of x, y and the heading in the state; the heading may be -1 for one disc without an offset.
        times, starts, terms: see `Extremal`.

    """
    arm, last = 0.0, 2
    for k in range(len(outline)):
        arm = max(arm, math.hypot(max(abs(outline[k, 0]), abs(outline[k, 1])), outline[k, 2]))
        last = max(last, int(outline[k, 4]))
    clock, top_speed = header_of(field).clock, header_of(field).top_speed
    entries = max(last, clock) + 1
    q, before = np.zeros(entries), np.zeros(entries)
    _interpolate(0.0, places, starts[0], terms[0], q)
    smallest, _ = footprint_clearance(q, outline, field)
    for k in range(len(times) - 1):
        # An upper bound of the speed: the largest mean speed over an eighth of the step, with a safety factor of 1.5.
        length = 0.0
        _interpolate(0.0, places, starts[k], terms[k], before)
        for part in range(1, 9):
            _interpolate(part / 8.0, places, starts[k], terms[k], q)
            travelled = math.hypot(q[0] - before[0], q[1] - before[1])
            for i in range(2, last + 1):
                travelled += arm * abs(q[i] - before[i])
            travelled += top_speed * (times[k + 1] - times[k]) / 8.0
            length = max(length, 8.0 * travelled)
            before[:] = q
        length = 1.5 * length + 1e-12
        s = 0.0
        while s < 1.0:
            _interpolate(s, places, starts[k], terms[k], q)
            value, _ = footprint_clearance(q, outline, field)
            smallest = min(smallest, value)
            # Advance by the distance to a smaller value, at least 0.1 to 5 mm. Over 5 mm the path deviates from a line
            # by about 0.01 mm; close to contact the steps are shorter.
            s += max(value - smallest, min(max(0.1 * smallest, 1e-4), 5e-3)) / length
    _interpolate(0.0, places, starts[-1], terms[-1], q)
    value, _ = footprint_clearance(q, outline, field)
    return min(smallest, value)
