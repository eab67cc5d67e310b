"""Rollout of piecewise constant controls, and the condensed quadratic model of its cost (kernels)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, MATRIX, NOTHING, VECTOR
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, FLOW
from leapnav.experts.problem.dynamics import unit_weights


class ControlRollout(NamedTuple):
    """The path of piecewise constant controls on N intervals.

    Attributes:
        X: (N + 1, n), states.
        phi: (N + 1,), state cost.
        Ad: (N, n, n), derivatives of the next state with respect to the state.
        Bd: (N, n, m), derivatives of the next state with respect to the controls.
        phi_q: (N + 1, n), gradient of the state cost.
        phi_qq: (N + 1, n, n), Hessian of the state cost.

    """

    X: np.ndarray
    phi: np.ndarray
    Ad: np.ndarray
    Bd: np.ndarray
    phi_q: np.ndarray
    phi_qq: np.ndarray


CONTROL_ROLLOUT = record_type(ControlRollout, X=MATRIX, phi=VECTOR, Ad=CUBE, Bd=CUBE, phi_q=MATRIX, phi_qq=CUBE)


@kernel(boolean(FLOW, CONTROL_FUNCTION, VECTOR, MATRIX, float64, CONTROL_ROLLOUT))
def roll_out(flow, control, start, U, h, rollout):
    """Compute the path of controls U (N, m), each held for time h, with one classical Runge-Kutta step per interval.

    Fills the rollout: the states, the derivatives of the steps, and Phi with gradient and Hessian at the nodes. Returns
    False if the path is not finite.
    """
    X, phi, Ad, Bd, phi_q, phi_qq = rollout.X, rollout.phi, rollout.Ad, rollout.Bd, rollout.phi_q, rollout.phi_qq
    data, field = flow.data, flow.field
    count, m = U.shape
    n = len(start)
    columns = n + m
    probe = unit_weights(data, m)
    held = data.copy()  # equal lower and upper bounds fix the controls, independently of the costates
    z, dz = np.zeros(2 * n), np.empty(2 * n)
    S, dS = np.zeros((2 * n, columns)), np.empty((2 * n, columns))
    sum_z, sum_S = np.empty(n), np.empty((n, columns))
    slope_z, slope_S = np.zeros(n), np.zeros((n, columns))
    unit, u = np.zeros(2 * n), np.empty(m)
    for i in range(n):
        X[0, i] = start[i]
    for k in range(count + 1):
        for j in range(m):
            value = U[min(k, count - 1), j]
            held[m + j] = value
            held[2 * m + j] = value
        for i in range(n):
            z[i], z[n + i] = X[k, i], 0.0
        for i in range(2 * n):
            for c in range(columns):
                S[i, c] = 1.0 if c == i and i < n else 0.0
        running = flow.function(z, held, field, S, dz, dS)
        phi[k] = running
        for j in range(m):
            phi[k] -= 0.5 * data[j] * U[min(k, count - 1), j] ** 2
        for i in range(n):
            phi_q[k, i] = -dz[n + i]
            for j in range(n):
                phi_qq[k, i, j] = -dS[n + i, j]
        if k == count:
            break
        for i in range(n):
            sum_z[i] = 0.0
            for c in range(columns):
                sum_S[i, c] = 0.0
        for stage in range(4):
            reach = 0.0 if stage == 0 else (h if stage == 3 else h / 2)
            weight = h / 6 if stage in (0, 3) else h / 3
            for i in range(n):
                z[i] = X[k, i] + reach * slope_z[i]
                for c in range(columns):
                    S[i, c] = (1.0 if c == i else 0.0) + reach * slope_S[i, c]
            flow.function(z, held, field, S, dz, dS)
            for i in range(n):
                unit[i] = z[i]
            for i in range(n):
                unit[n + i] = 1.0
                control(unit, probe, u)
                unit[n + i] = 0.0
                for j in range(m):
                    dS[i, n + j] -= u[j]
            for i in range(n):
                slope_z[i] = dz[i]
                sum_z[i] += weight * dz[i]
                for c in range(columns):
                    slope_S[i, c] = dS[i, c]
                    sum_S[i, c] += weight * dS[i, c]
        for i in range(n):
            X[k + 1, i] = X[k, i] + sum_z[i]
            if not abs(X[k + 1, i]) < 1e8:
                return False
            for j in range(n):
                Ad[k, i, j] = sum_S[i, j] + (1.0 if i == j else 0.0)
            for j in range(m):
                Bd[k, i, j] = sum_S[i, n + j]
    return True


@kernel(NOTHING(CONTROL_ROLLOUT, float64, MATRIX, VECTOR, MATRIX))
def condense(rollout, h, H, g, G):
    """Add the state cost to the Hessian H (Nm, Nm) and the gradient g (Nm,), and fill G = dq_N/dU (n, Nm)."""
    Ad, Bd, phi_q, phi_qq = rollout.Ad, rollout.Bd, rollout.phi_q, rollout.phi_qq
    count, n, m = Bd.shape
    following = np.zeros(G.shape)
    for i in range(n):
        for c in range(G.shape[1]):
            G[i, c] = 0.0
    for k in range(1, count + 1):
        width = k * m
        for i in range(n):
            for c in range(width - m):
                total = 0.0
                for j in range(n):
                    total += Ad[k - 1, i, j] * G[j, c]
                following[i, c] = total
            for j in range(m):
                following[i, width - m + j] = Bd[k - 1, i, j]
        for i in range(n):
            for c in range(width):
                G[i, c] = following[i, c]
        weight = h if k < count else h / 2
        for i in range(n):
            if phi_q[k, i] != 0.0:
                for c in range(width):
                    g[c] += weight * phi_q[k, i] * G[i, c]
            for j in range(n):
                q = weight * phi_qq[k, i, j]
                if q != 0.0:
                    for a in range(width):
                        for b in range(width):
                            H[a, b] += q * G[i, a] * G[j, b]
