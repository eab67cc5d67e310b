"""What the compiled flow says about the dynamics q' = a + B u themselves, as compiled kernels."""

from __future__ import annotations

import numpy as np
from numba import types

from leapnav.envs.compiling import njit
from leapnav.experts.integrator import CONTROL, FLOW, constant, cube, matrix, vector
from leapnav.experts.linear import solve_dense


@njit(types.none(FLOW, CONTROL, matrix, constant, constant, matrix, cube), cache=True, error_model="numpy", nogil=True)
def sample_dynamics(flow, control, states, data, field, drift, fields):
    """Fills a (N, n) and B (N, n, m) at states (N, n)."""
    count, n = states.shape
    m = fields.shape[2]
    # With unit weights and no bounds u = -B'lam, so unit costates read B off row by row.
    probe = data.copy()
    probe[:m] = 1.0
    probe[m : 2 * m] = -np.inf
    probe[2 * m : 3 * m] = np.inf
    z, dz, u = np.zeros(2 * n), np.empty(2 * n), np.empty(m)
    none, d_none = np.empty((2 * n, 0)), np.empty((2 * n, 0))
    for k in range(count):
        z[:n] = states[k]
        flow(z, probe, field, none, dz, d_none)
        drift[k] = dz[:n]
        for i in range(n):
            z[n + i] = 1.0
            control(z, probe, u)
            z[n + i] = 0.0
            for j in range(m):
                fields[k, i, j] = -u[j]


@njit(types.none(matrix, cube, matrix, vector, matrix), cache=True, error_model="numpy", nogil=True)
def smallest_costates(drift, fields, rates, weight, costates):
    """Fills the smallest costates (N, n) whose controls drive the rates (N, n) in the least-squares sense.

    That control is u = (B'B)^-1 B'(rates - a), and lam = B (B'B)^-1 p has the switching functions p = -R u.
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
                # Where the fields are dependent a trace of their size keeps B'B regular.
                gram[i, i] += 1e-12 * trace + 1e-300
                if step == 0:
                    rhs[i] = 0.0
                    for r in range(n):
                        rhs[i] += fields[k, r, i] * (rates[k, r] - drift[k, r])
                else:
                    rhs[i] *= -weight[i]
            if not solve_dense(gram, rhs):
                rhs[:] = 0.0
        for r in range(n):
            costates[k, r] = 0.0
            for j in range(m):
                costates[k, r] += fields[k, r, j] * rhs[j]
