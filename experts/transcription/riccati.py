"""Riccati recursion for the quadratic model of the discretised problem of any robot (kernels).

`leapnav.experts.transcription.arcs_riccati` is the same for the unicycle, with its sparsity.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import MATRIX, NOTHING, SIGNS, VECTOR
from leapnav.experts.numerics.linear import eliminate
from leapnav.experts.transcription.midpoint import DISCRETE_PROBLEM, EXPANSION
from leapnav.experts.transcription.quadratic_model import MODEL, REGULARISATION

MIN_CURVATURE = 1e-9  # of the model along a control, relative to the curvature of the control cost
ROTATIONS = 12  # sweeps of Jacobi's method; quadratic convergence needs about 6 for six states


@kernel(NOTHING(MATRIX, MATRIX))
def convex_part(A, V):
    """Replace the negative eigenvalues of a symmetric A (n, n) by 0, by Jacobi's method; V (n, n) is overwritten.

    G. H. Golub and C. F. Van Loan, Matrix Computations (2013), section 8.5.
    """
    n = len(A)
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(ROTATIONS):
        largest = 0.0
        for a in range(n - 1):
            for b in range(a + 1, n):
                if abs(A[a, b]) <= 1e-12 * math.sqrt(abs(A[a, a] * A[b, b])) or A[a, b] == 0.0:
                    continue
                largest = max(largest, abs(A[a, b]))
                ratio = 0.5 * (A[b, b] - A[a, a]) / A[a, b]
                t = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for i in range(n):
                    first, second = A[i, a], A[i, b]
                    A[i, a], A[i, b] = c * first - s * second, s * first + c * second
                for i in range(n):
                    first, second = A[a, i], A[b, i]
                    A[a, i], A[b, i] = c * first - s * second, s * first + c * second
                    first, second = V[i, a], V[i, b]
                    V[i, a], V[i, b] = c * first - s * second, s * first + c * second
        if largest == 0.0:
            break
    values = np.empty(n)
    for k in range(n):
        values[k] = max(A[k, k], 0.0)
    for i in range(n):
        for j in range(n):
            A[i, j] = 0.0
            for k in range(n):
                A[i, j] += values[k] * V[i, k] * V[j, k]


@kernel(boolean(DISCRETE_PROBLEM, MATRIX, SIGNS, VECTOR, REGULARISATION, EXPANSION, MODEL))
def backward(problem, u, held, last_state, regularisation, expansion, model):
    """Compute the model by backward recursion; return False if it is not convex.

    `held` (N, m) contains the signs of the limits at which controls are held, or 0; `last_state` (n,) is the final
    state of the path.
    """
    h, data, unit = problem.h, problem.data, problem.unit
    goal, free = problem.end.goal, problem.end.free
    defects = expansion.defects
    P, p, F, G, g = model.P, model.p, model.F, model.G, model.g
    step, gain, end_gain = model.step, model.gain, model.end_gain
    shift, penalty, convex = regularisation.shift, regularisation.penalty, regularisation.convex
    intervals, m = u.shape
    n = len(last_state)
    for i in range(n):
        p[intervals, i] = 0.0
        g[i] = 0.0
        for j in range(n):
            P[intervals, i, j] = 0.0
            F[intervals, i, j] = 0.0
            G[i, j] = 0.0
        if not free[i]:
            P[intervals, i, i] = penalty
            p[intervals, i] = -penalty * (goal[i] - last_state[i])
            F[intervals, i, i] = 1.0
    PA, PB, pc = np.empty((n, n)), np.empty((n, m)), np.empty(n)
    Qux, Quu, Qu, Fu = np.empty((m, n)), np.empty((m, m)), np.empty(m), np.empty((m, n))
    # The controls solve Quu x = right-hand sides: the gradient, and the columns of Qux and Fu.
    width = m + 1 + 2 * n
    system, solution = np.empty((m, width)), np.empty((m, width))
    curvature, vectors = np.empty((n, n)), np.empty((n, n))
    for k in range(intervals, -1, -1):
        for i in range(n):
            for j in range(n):
                curvature[i, j] = expansion.hessian[k, i, j]
        if convex:
            convex_part(curvature, vectors)
        if k < intervals:
            A, B, after, last, before = expansion.A[k], expansion.B[k], P[k + 1], p[k + 1], F[k + 1]
            W = expansion.W[k]
            for i in range(n):
                pc[i] = last[i]
                for r in range(n):
                    pc[i] += after[i, r] * defects[k, r]
                for c in range(n):
                    total = 0.0
                    for r in range(n):
                        total += after[i, r] * A[r, c]
                    PA[i, c] = total
                for c in range(m):
                    total = 0.0
                    for r in range(n):
                        total += after[i, r] * B[r, c]
                    PB[i, c] = total
            for j in range(m):
                weight = unit * h[k] * data[j]
                Qu[j] = weight * u[k, j]
                for r in range(n):
                    Qu[j] += B[r, j] * pc[r]
                for c in range(n):
                    total = 0.0 if convex else W[n + j, c]
                    ends = 0.0
                    for r in range(n):
                        total += B[r, j] * PA[r, c]
                        ends += B[r, j] * before[r, c]
                    Qux[j, c], Fu[j, c] = total, ends
                for c in range(m):
                    total = 0.0 if convex else W[n + j, n + c]
                    for r in range(n):
                        total += B[r, j] * PB[r, c]
                    Quu[j, c] = total + (weight if j == c else 0.0)
            for j in range(m):
                if held[k, j] != 0:  # a held control moves to its limit, independently of the others
                    to_limit = data[m + j if held[k, j] < 0 else 2 * m + j] - u[k, j]
                    for c in range(width):
                        system[j, c] = 1.0 if c == j else (-to_limit if c == m else 0.0)
                    continue
                system[j, m] = Qu[j]
                for c in range(m):
                    system[j, c] = Quu[j, c] if held[k, c] == 0 else 0.0
                    if held[k, c] != 0:
                        limit = data[m + c if held[k, c] < 0 else 2 * m + c]
                        system[j, m] += Quu[j, c] * (limit - u[k, c])
                for c in range(n):
                    system[j, m + 1 + c], system[j, m + 1 + n + c] = Qux[j, c], Fu[j, c]
            if eliminate(system, False, 0.0) == 0.0:
                return False
            for j in range(m - 1, -1, -1):
                smallest = MIN_CURVATURE * (1.0 if held[k, j] != 0 else unit * h[k] * data[j])
                if not system[j, j] > smallest:
                    return False
                for c in range(m, width):
                    total = system[j, c]
                    for r in range(j + 1, m):
                        total -= system[j, r] * solution[r, c]
                    solution[j, c] = total / system[j, j]
                step[k, j] = solution[j, m]
                for c in range(n):
                    gain[k, j, c], end_gain[k, j, c] = solution[j, m + 1 + c], solution[j, m + 1 + n + c]
            for i in range(n):
                for c in range(n):
                    value = curvature[i, c] + (0.0 if convex else W[i, c])
                    ends = 0.0
                    for r in range(n):
                        value += A[r, i] * PA[r, c]
                        ends += A[r, i] * before[r, c]
                    for j in range(m):
                        value -= Qux[j, i] * gain[k, j, c]
                        ends -= Qux[j, i] * end_gain[k, j, c]
                        G[i, c] -= Fu[j, i] * end_gain[k, j, c]
                    P[k, i, c], F[k, i, c] = value, ends
                value = expansion.gradient[k, i]
                for r in range(n):
                    value += A[r, i] * pc[r]
                    g[i] += before[r, i] * defects[k, r]
                for j in range(m):
                    value -= Qux[j, i] * step[k, j]
                    g[i] -= Fu[j, i] * step[k, j]
                p[k, i] = value
        else:
            for i in range(n):
                p[k, i] += expansion.gradient[k, i]
                for c in range(n):
                    P[k, i, c] += curvature[i, c]
        for i in range(n):
            P[k, i, i] += shift * h[min(k, intervals - 1)]
    return True
