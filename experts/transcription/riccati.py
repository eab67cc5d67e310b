"""Riccati recursion for the quadratic model of the discretised problem (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, int64, types

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import FunctionPointer, matrix_of, part_of
from leapnav.envs.kernels.types import MATRIX, NOTHING
from leapnav.envs.utils.caching import computed_once
from leapnav.experts.transcription.discrete_problem import DISCRETE_PROBLEM, EVALUATION, EXPANSION, PATH, node_weight
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


# backward(problem, path, regularisation, evaluation, expansion, model): computes the model by backward recursion;
# returns False if it is not convex.
BACKWARD_SIGNATURE = boolean(DISCRETE_PROBLEM, PATH, REGULARISATION, EVALUATION, EXPANSION, MODEL)
BACKWARD_FUNCTION = types.FunctionType(BACKWARD_SIGNATURE)


@kernel(boolean(*BACKWARD_SIGNATURE.args, int64, int64), forceinline=True)
def backward_of_size(problem, path, regularisation, evaluation, expansion, model, n, m):
    """Compute the model, for n states and m controls. With literals, the compiler unrolls the loops."""
    u, held = path.u, path.held
    h, data, unit = problem.h, problem.data, problem.unit
    goal, free = problem.end.goal, problem.end.free
    P, p, F, G, g = model.P, model.p, model.F, model.G, model.g
    shift, penalty, convex = regularisation.shift, regularisation.penalty, regularisation.convex
    intervals = len(u)
    for i in range(n):
        p[intervals, i] = 0.0
        g[i] = 0.0
        for j in range(n):
            P[intervals, i, j] = 0.0
            F[intervals, i, j] = 0.0
            G[i, j] = 0.0
        if not free[i]:
            P[intervals, i, i] = penalty
            p[intervals, i] = -penalty * (goal[i] - path.q[intervals, i])
            F[intervals, i, i] = 1.0
    PA, PB, pc = np.empty((n, n)), np.empty((n, m)), np.empty(n)
    Qux, Quu, Fu, to_limit = np.empty((m, n)), np.empty((m, m)), np.empty((m, n)), np.empty(m)
    curvature, vectors = np.empty((n, n)), np.empty((n, n))
    for k in range(intervals, -1, -1):
        weight = unit * node_weight(h, k)
        for i in range(n):
            for j in range(n):
                curvature[i, j] = weight * evaluation.hessians[k, i, j]
        if convex:
            convex_part(curvature, vectors)
        if k < intervals:
            A, B = matrix_of(expansion.A, k * n * n, n, n), matrix_of(expansion.B, k * n * m, n, m)
            W = matrix_of(expansion.W, k * (n + m) * (n + m), n + m, n + m)
            after, before = matrix_of(P, (k + 1) * n * n, n, n), matrix_of(F, (k + 1) * n * n, n, n)
            step, gain = part_of(model.step, k * m, m), matrix_of(model.gain, k * m * n, m, n)
            end_gain = matrix_of(model.end_gain, k * m * n, m, n)
            for i in range(n):
                pc[i] = p[k + 1, i]
                for r in range(n):
                    pc[i] += after[i, r] * expansion.defects[k, r]
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
                limit = data[m + j if held[k, j] < 0 else 2 * m + j]
                to_limit[j] = limit - u[k, j] if held[k, j] != 0 else 0.0
                step[j] = unit * h[k] * data[j] * u[k, j]
                for r in range(n):
                    step[j] += B[r, j] * pc[r]
                for c in range(n):
                    total = 0.0 if convex else W[n + j, c]
                    ends = 0.0
                    for r in range(n):
                        total += B[r, j] * PA[r, c]
                        ends += B[r, j] * before[r, c]
                    Qux[j, c], Fu[j, c] = total, ends
                    gain[j, c], end_gain[j, c] = total, ends
                for c in range(m):
                    total = 0.0 if convex else W[n + j, n + c]
                    for r in range(n):
                        total += B[r, j] * PB[r, c]
                    Quu[j, c] = total + (unit * h[k] * data[j] if j == c else 0.0)
            # A held control moves to its limit, independently of the others.
            for j in range(m):
                if held[k, j] != 0:
                    for c in range(m):
                        step[c] += Quu[c, j] * to_limit[j]
                        Quu[c, j] = Quu[j, c] = 0.0
                    Quu[j, j] = 1.0
            for j in range(m):
                if held[k, j] != 0:
                    step[j] = -to_limit[j]
                    for c in range(n):
                        gain[j, c] = end_gain[j, c] = 0.0
            for j in range(m):
                if not Quu[j, j] > MIN_CURVATURE * (1.0 if held[k, j] != 0 else unit * h[k] * data[j]):
                    return False
                for i in range(j + 1, m):
                    factor = Quu[i, j] / Quu[j, j]
                    for c in range(j + 1, m):
                        Quu[i, c] -= factor * Quu[j, c]
                    step[i] -= factor * step[j]
                    for c in range(n):
                        gain[i, c] -= factor * gain[j, c]
                        end_gain[i, c] -= factor * end_gain[j, c]
            for j in range(m - 1, -1, -1):
                for i in range(j + 1, m):
                    step[j] -= Quu[j, i] * step[i]
                    for c in range(n):
                        gain[j, c] -= Quu[j, i] * gain[i, c]
                        end_gain[j, c] -= Quu[j, i] * end_gain[i, c]
                scale = 1.0 / Quu[j, j]
                step[j] *= scale
                for c in range(n):
                    gain[j, c] *= scale
                    end_gain[j, c] *= scale
            for i in range(n):
                for c in range(n):
                    ends = 0.0
                    for r in range(n):
                        ends += A[r, i] * before[r, c]
                    for j in range(m):
                        ends -= Qux[j, i] * end_gain[j, c]
                        G[i, c] -= Fu[j, i] * end_gain[j, c]
                    F[k, i, c] = ends
                for c in range(i, n):
                    value = curvature[i, c] + (0.0 if convex else W[i, c])
                    for r in range(n):
                        value += A[r, i] * PA[r, c]
                    for j in range(m):
                        value -= Qux[j, i] * gain[j, c]
                    P[k, i, c] = P[k, c, i] = value
                value = weight * evaluation.gradients[k, i]
                for r in range(n):
                    value += A[r, i] * pc[r]
                    g[i] += before[r, i] * expansion.defects[k, r]
                for j in range(m):
                    value -= Qux[j, i] * step[j]
                    g[i] -= Fu[j, i] * step[j]
                p[k, i] = value
        else:
            for i in range(n):
                p[k, i] += weight * evaluation.gradients[k, i]
                for c in range(n):
                    P[k, i, c] += curvature[i, c]
        for i in range(n):
            P[k, i, i] += shift * h[min(k, intervals - 1)]
    return True


@computed_once(maxsize=64)
def recursion(n: int, m: int) -> FunctionPointer:
    """Return the recursion for n states and m controls, of the type BACKWARD_FUNCTION."""
    from leapnav.experts.problem.code_generation import load

    source = f'''"""Generated by leapnav.experts.transcription.riccati: recursion of one size. Do not edit."""
from leapnav.envs.kernels import kernel
from leapnav.experts.transcription.riccati import BACKWARD_SIGNATURE, backward_of_size

@kernel(BACKWARD_SIGNATURE)
def backward(problem, path, regularisation, evaluation, expansion, model):
    return backward_of_size(problem, path, regularisation, evaluation, expansion, model, {n}, {m})
'''
    return FunctionPointer(load("riccati", __file__, source, lambda: source).backward, BACKWARD_FUNCTION)
