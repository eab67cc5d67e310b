"""The equations of multiple shooting and their linearisation (kernels)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import END_CONDITION, FLOW
from leapnav.experts.numerics.integrator import ORDER, propagate


@kernel(NOTHING(MATRIX, int64))
def set_identity(S, first_row):
    """Set S to zero, with ones at S[first_row + i, i]."""
    for i in range(S.shape[0]):
        for j in range(S.shape[1]):
            S[i, j] = 1.0 if i == first_row + j else 0.0


@kernel(float64(FLOW, VECTOR, VECTOR))
def hamiltonian(flow, z, dz):
    """Return the Hamiltonian at z = (q, lam), and fill dz = z'."""
    n = len(z) // 2
    none, d_none = np.empty((2 * n, 0)), np.empty((2 * n, 0))
    value = flow.function(z, flow.data, flow.field, none, dz, d_none)
    for i in range(n):
        value += z[n + i] * dz[i]
    return value


@kernel(VECTOR(FLOW, MATRIX))
def hamiltonians(flow, rows):
    """Return the Hamiltonian at each row (q, lam)."""
    values, dz = np.empty(len(rows)), np.empty(rows.shape[1])
    for k in range(len(rows)):
        values[k] = hamiltonian(flow, rows[k], dz)
    return values


class NewtonSystem(NamedTuple):
    """The linear system of a Newton step, with by-products of its evaluation.

    Attributes:
        rows: (unknowns, 3 half + 1), the banded matrix, see `solve_banded`.
        rhs: (unknowns,), negative residuals.
        costs: (segments,), cost of each segment.
        hints: (segments,), last step size of the integrator in each segment, for the accuracy 1; 0 if unknown.

    """

    rows: np.ndarray
    rhs: np.ndarray
    costs: np.ndarray
    hints: np.ndarray


SYSTEM = record_type(NewtonSystem, rows=MATRIX, rhs=VECTOR, costs=VECTOR, hints=VECTOR)


@kernel(tuple_of(float64, float64, int64)(FLOW, VECTOR, float64, MATRIX, VECTOR, END_CONDITION, float64, SYSTEM))
def linearise(flow, times, factor, Z, start, end, accuracy, system):
    """Evaluate the Newton system at Z; return (norm^2, largest residual, evaluations), infinite if the flow diverged.

    The components of the last node that the end conditions leave open are set to the result of the integration.

    All times are multiplied by `factor`. The rows are n start conditions, 2n continuity conditions per segment, and n
    end conditions. With the unknowns in the order of time the half-width of the band is 3n - 1.

    If the final time is free, the relative change of all times is an unknown of every node, which keeps the matrix
    banded: there is another start condition, that the Hamiltonian vanishes, and another continuity condition, that the
    changes of neighbouring nodes agree. The half-width is 3n + 1.
    """
    rows, rhs, goal, free = system.rows, system.rhs, end.goal, end.free
    n = len(goal)
    extra = 1 if end.free_time else 0
    size = 2 * n
    stride, first = size + extra, n + extra  # unknowns of a node, and start conditions
    half = 3 * n - 1 + 2 * extra
    segments = len(times) - 1
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] = 0.0
    z, rates = np.empty(size), np.empty(size)
    S = np.empty((size, size))
    evaluations, scale, hint = 0, accuracy ** (1.0 / ORDER), 0.0
    for i in range(n):
        rows[i, half] = 1.0
        rhs[i] = start[i] - Z[0, i]
    if end.free_time:
        rhs[n] = -hamiltonian(flow, Z[0], rates)
        for i in range(n):
            rows[n, i - n + half] = -rates[n + i]
            rows[n, i + half] = rates[i]
    for k in range(segments):
        for i in range(size):
            z[i] = Z[k, i]
        set_identity(S, 0)
        duration = times[k + 1] - times[k]
        first_step = scale * system.hints[k] if system.hints[k] > 0.0 else hint
        success, cost, _, hint, count = propagate(flow, z, S, factor * duration, accuracy, first_step, False)
        evaluations += count
        if not success:
            return np.inf, np.inf, evaluations
        system.costs[k] = cost
        system.hints[k] = hint / scale
        if k == segments - 1:  # what the end conditions leave open is a result of the integration
            for i in range(n):
                at = i if free[i] else n + i
                Z[segments, at] = z[at]
        for i in range(size):
            row = first + stride * k + i
            rhs[row] = Z[k + 1, i] - z[i]
            for j in range(size):
                rows[row, stride * k + j - row + half] = S[i, j]
            rows[row, stride * (k + 1) + i - row + half] = -1.0
        if end.free_time:
            hamiltonian(flow, z, rates)
            for i in range(size):
                row = first + stride * k + i
                rows[row, stride * k + size - row + half] = factor * duration * rates[i]
            row = first + stride * k + size
            rhs[row] = 0.0
            rows[row, stride * k + size - row + half] = 1.0
            rows[row, stride * (k + 1) + size - row + half] = -1.0
    for i in range(n):
        row = first + stride * segments + i
        column = stride * segments + (n + i if free[i] else i)
        rows[row, column - row + half] = 1.0
        rhs[row] = -Z[segments, n + i] if free[i] else goal[i] - Z[segments, i]
    norm, largest = 0.0, 0.0
    for i in range(len(rhs)):
        norm += rhs[i] * rhs[i]
        largest = max(largest, abs(rhs[i]))
    return norm, largest, evaluations
