"""The dynamics q' = a(q) + B(q) u along a path, and the controls and costates that follow it."""

from __future__ import annotations

import numpy as np
from numba import int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING, VECTOR
from leapnav.experts.numerics.flow import AFFINE_FUNCTION
from leapnav.experts.numerics.linear import eliminate, substitute

RELATIVE_SHIFT = 1e-12  # of the diagonal of B'B, relative to its trace
TINY = float(np.finfo(float).tiny)


@kernel(NOTHING(AFFINE_FUNCTION, CONSTANT, MATRIX, MATRIX, CUBE))
def sample_dynamics(affine, data, states, drift, fields):
    """Evaluate a(q) into `drift` (N, n) and B(q) into `fields` (N, n, m) at states (N, n)."""
    for k in range(len(states)):
        affine(states[k], data, drift[k], fields[k])


@kernel(MATRIX(CUBE, MATRIX))
def _solve_gram(fields, right):
    """Solve B'B x = right (N, m), where B'B is kept regular if fields B (N, n, m) are linearly dependent.

    The solution is not finite where the dynamics are not.
    """
    count, n, m = fields.shape
    result, system = np.empty((count, m)), np.empty((m, m + 1))
    for k in range(count):
        trace = 0.0
        for i in range(m):
            for j in range(m):
                system[i, j] = 0.0
                for r in range(n):
                    system[i, j] += fields[k, r, i] * fields[k, r, j]
            trace += system[i, i]
            system[i, m] = right[k, i]
        for i in range(m):
            system[i, i] += RELATIVE_SHIFT * trace + TINY
        if eliminate(system, False, 0.0) == 0.0:
            system[:] = np.nan
        substitute(system, result[k])
    return result


@kernel(MATRIX(CUBE, MATRIX))
def least_squares_controls(fields, rates):
    """Return the controls u (N, m) for which B u is closest to given rates (N, n), with fields B (N, n, m)."""
    count, n, m = fields.shape
    right = np.zeros((count, m))
    for k in range(count):
        for i in range(n):
            for j in range(m):
                right[k, j] += fields[k, i, j] * rates[k, i]
    return _solve_gram(fields, right)


@kernel(MATRIX(AFFINE_FUNCTION, CONSTANT, VECTOR, MATRIX, int64))
def controls_along(affine, data, times, states, m):
    """Return the controls (N, m) that follow a path (N + 1, n) best, each constant between two times (N + 1,)."""
    count, n = len(times) - 1, states.shape[1]
    middles, rates = np.empty((count, n)), np.empty((count, n))
    drift, fields = np.empty((count, n)), np.empty((count, n, m))
    for k in range(count):
        for i in range(n):
            middles[k, i] = 0.5 * (states[k + 1, i] + states[k, i])
    sample_dynamics(affine, data, middles, drift, fields)
    for k in range(count):
        for i in range(n):
            rates[k, i] = (states[k + 1, i] - states[k, i]) / (times[k + 1] - times[k]) - drift[k, i]
    return least_squares_controls(fields, rates)


def least_norm_costates(fields: np.ndarray, switching: np.ndarray) -> np.ndarray:
    """Return the costates (N, n) of least norm with given switching functions B'lambda (N, m)."""
    return np.einsum("kij,kj->ki", fields, _solve_gram(fields, switching))
