"""The dynamics q' = a(q) + B(q) u, evaluated with the compiled extremal flow (kernels)."""

from __future__ import annotations

import numpy as np
from numba import int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING, VECTOR
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, FLOW
from leapnav.experts.numerics.linear import solve_dense


@kernel(VECTOR(CONSTANT, int64))
def unit_weights(data, m):
    """Return the constants of a flow with unit control weights and without bounds, for which u = -B'lam."""
    probe = np.empty(len(data))
    for i in range(len(data)):
        probe[i] = 1.0 if i < m else (-np.inf if i < 2 * m else (np.inf if i < 3 * m else data[i]))
    return probe


@kernel(NOTHING(FLOW, CONTROL_FUNCTION, MATRIX, MATRIX, CUBE))
def sample_dynamics(flow, control, states, drift, fields):
    """Evaluate a(q) into `drift` (N, n) and B(q) into `fields` (N, n, m) at states (N, n)."""
    count, n = states.shape
    m = fields.shape[2]
    # With unit weights u = -B'lam, so unit costates give B row by row.
    probe = unit_weights(flow.data, m)
    z, dz, u = np.zeros(2 * n), np.empty(2 * n), np.empty(m)
    none, d_none = np.empty((2 * n, 0)), np.empty((2 * n, 0))
    for k in range(count):
        for i in range(n):
            z[i] = states[k, i]
        flow.function(z, probe, flow.field, none, dz, d_none)
        for i in range(n):
            drift[k, i] = dz[i]
        for i in range(n):
            z[n + i] = 1.0
            control(z, probe, u)
            z[n + i] = 0.0
            for j in range(m):
                fields[k, i, j] = -u[j]


@kernel(NOTHING(MATRIX, CUBE, MATRIX, VECTOR, MATRIX))
def minimum_norm_costates(drift, fields, rates, weight, costates):
    """Compute the costates (N, n) of least norm whose controls produce given rates (N, n) in the least-squares sense.

    The least-squares control is u = (B'B)^-1 B'(rates - a). The costate lam = B (B'B)^-1 p has the switching functions
    p = -R u.
    """
    count, n, m = fields.shape
    gram, rhs = np.empty((m, m)), np.empty(m)
    for k in range(count):
        for step in range(2):
            trace = 0.0
            for i in range(m):
                for j in range(m):
                    gram[i, j] = 0.0
                    for r in range(n):
                        gram[i, j] += fields[k, r, i] * fields[k, r, j]
                trace += gram[i, i]
            for i in range(m):
                # Keeps B'B regular where the fields are linearly dependent.
                gram[i, i] += 1e-12 * trace + 1e-300
                if step == 0:
                    rhs[i] = 0.0
                    for r in range(n):
                        rhs[i] += fields[k, r, i] * (rates[k, r] - drift[k, r])
                else:
                    rhs[i] *= -weight[i]
            if not solve_dense(gram, rhs):
                for i in range(m):
                    rhs[i] = 0.0
        for r in range(n):
            costates[k, r] = 0.0
            for j in range(m):
                costates[k, r] += fields[k, r, j] * rhs[j]
