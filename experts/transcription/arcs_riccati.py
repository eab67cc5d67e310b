"""Riccati recursion for the quadratic model of the discretised problem of the unicycle (kernels).

`leapnav.experts.transcription.riccati` is the same for any robot; this one uses the sparsity of the derivatives.
"""

from __future__ import annotations

import math

from numba import boolean

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import carray, matrix_of, part_of, scratch_buffer
from leapnav.envs.kernels.types import MATRIX, SIGNS, VECTOR
from leapnav.experts.transcription.arcs import DISCRETE_PROBLEM, EXPANSION
from leapnav.experts.transcription.quadratic_model import MODEL, REGULARISATION


@kernel(boolean(DISCRETE_PROBLEM, MATRIX, SIGNS, VECTOR, REGULARISATION, EXPANSION, MODEL))
def backward(problem, u, held, last_state, regularisation, expansion, model):
    """Compute the model by backward recursion; return False if it is not convex.

    `held` (N, 2) contains the signs of the limits at which controls are held, or 0; `last_state` (3,) is the final
    state of the path.
    """
    h, turn_weight, limits = problem.h, problem.turn_weight, problem.limits
    goal, free = problem.end.goal, problem.end.free
    dphi, A, B, defects, W = expansion.dphi, expansion.A, expansion.B, expansion.defects, expansion.W
    P, p, F, G, g = model.P, model.p, model.F, model.G, model.g
    step, gain, end_gain = model.step, model.gain, model.end_gain
    shift, penalty, convex = regularisation.shift, regularisation.penalty, regularisation.convex
    intervals = len(h)
    for i in range(3):
        p[intervals, i] = 0.0
        g[i] = 0.0
        for j in range(3):
            P[intervals, i, j] = 0.0
            F[intervals, i, j] = 0.0
            G[i, j] = 0.0
        if not free[i]:
            P[intervals, i, i] = penalty
            p[intervals, i] = -penalty * (goal[i] - last_state[i])
            F[intervals, i, i] = 1.0
    # On the stack, where the compiler knows that they do not overlap with the arrays of the model.
    Qux, Fu = carray(scratch_buffer(6), (2, 3)), carray(scratch_buffer(6), (2, 3))
    PA, PB = carray(scratch_buffer(9), (3, 3)), carray(scratch_buffer(6), (3, 2))
    pc, Qu = carray(scratch_buffer(3), (3,)), carray(scratch_buffer(2), (2,))
    b = carray(scratch_buffer(6), (3, 2))
    b[2, 0] = 0.0
    for k in range(intervals, -1, -1):
        hxx, hxy, hyy = dphi[k, 2], dphi[k, 3], dphi[k, 4]
        if convex:
            mean, spread = 0.5 * (hxx + hyy), math.hypot(0.5 * (hxx - hyy), hxy)
            if mean < spread:
                # Keeps the larger eigenvalue, if it is positive, with its eigenvector.
                largest = max(mean + spread, 0.0)
                xx = 0.5 + 0.25 * (hxx - hyy) / spread
                hxy = largest * 0.5 * hxy / spread
                hxx, hyy = largest * xx, largest * (1.0 - xx)
        if k < intervals:
            after, before = matrix_of(P, 9 * (k + 1), 3, 3), matrix_of(F, 9 * (k + 1), 3, 3)
            last = part_of(p, 3 * (k + 1), 3)
            a0, a1 = A[k, 0], A[k, 1]
            b[0, 0], b[0, 1], b[1, 0], b[1, 1], b[2, 1] = B[k, 0, 0], B[k, 0, 1], B[k, 1, 0], B[k, 1, 1], h[k]
            for i in range(3):
                pc[i] = (
                    last[i] + after[i, 0] * defects[k, 0] + after[i, 1] * defects[k, 1] + after[i, 2] * defects[k, 2]
                )
                PA[i, 0], PA[i, 1] = after[i, 0], after[i, 1]
                PA[i, 2] = after[i, 2] + after[i, 0] * a0 + after[i, 1] * a1
                for j in range(2):
                    PB[i, j] = after[i, 0] * b[0, j] + after[i, 1] * b[1, j] + after[i, 2] * b[2, j]
            for j in range(2):
                weight = h[k] if j == 0 else h[k] * turn_weight
                Qu[j] = weight * u[k, j] + b[0, j] * pc[0] + b[1, j] * pc[1] + b[2, j] * pc[2]
                for i in range(3):
                    Qux[j, i] = b[0, j] * PA[0, i] + b[1, j] * PA[1, i] + b[2, j] * PA[2, i]
                Fu[j, 0] = b[0, j] * before[0, 0] + b[1, j] * before[1, 0] + b[2, j] * before[2, 0]
                Fu[j, 1] = b[0, j] * before[0, 1] + b[1, j] * before[1, 1] + b[2, j] * before[2, 1]
                Fu[j, 2] = b[0, j] * before[0, 2] + b[1, j] * before[1, 2] + b[2, j] * before[2, 2]
            q00 = h[k] + b[0, 0] * PB[0, 0] + b[1, 0] * PB[1, 0]
            q01 = b[0, 0] * PB[0, 1] + b[1, 0] * PB[1, 1]
            q11 = h[k] * turn_weight + b[0, 1] * PB[0, 1] + b[1, 1] * PB[1, 1] + b[2, 1] * PB[2, 1]
            w_theta = 0.0
            if not convex:
                w_theta = W[k, 0, 0]
                Qux[0, 2] += W[k, 0, 1]
                Qux[1, 2] += W[k, 0, 2]
                q01 += W[k, 1, 2]
                q11 += W[k, 2, 2]
            held_0, held_1 = held[k, 0] != 0, held[k, 1] != 0
            determinant = q00 * q11 - q01 * q01
            if held_0 or held_1:
                i00 = 0.0 if held_0 else 1.0 / q00
                i11 = 0.0 if held_1 else 1.0 / q11
                i01 = 0.0
                definite = (held_0 or q00 > 1e-9 * h[k]) and (held_1 or q11 > 1e-9 * h[k] * turn_weight)
            else:
                i00, i01, i11 = q11 / determinant, -q01 / determinant, q00 / determinant
                definite = q00 > 1e-9 * h[k] and determinant > 1e-12 * h[k] * h[k] * turn_weight
            if not definite:
                return False
            # A held control moves to its limit, independently of the other control.
            to_0, to_1 = held[k, 0] * limits[0] - u[k, 0], held[k, 1] * limits[1] - u[k, 1]
            push_0 = Qu[0] + (q01 * to_1 if held_1 else 0.0)
            push_1 = Qu[1] + (q01 * to_0 if held_0 else 0.0)
            step[k, 0] = -to_0 if held_0 else i00 * push_0 + i01 * push_1
            step[k, 1] = -to_1 if held_1 else i01 * push_0 + i11 * push_1
            for i in range(3):
                gain[k, 0, i], gain[k, 1, i] = i00 * Qux[0, i] + i01 * Qux[1, i], i01 * Qux[0, i] + i11 * Qux[1, i]
                end_gain[k, 0, i], end_gain[k, 1, i] = i00 * Fu[0, i] + i01 * Fu[1, i], i01 * Fu[0, i] + i11 * Fu[1, i]
            for i in range(3):
                for j in range(3):
                    value = PA[i, j] if i < 2 else PA[2, j] + a0 * PA[0, j] + a1 * PA[1, j]
                    P[k, i, j] = value - Qux[0, i] * gain[k, 0, j] - Qux[1, i] * gain[k, 1, j]
                    value = before[i, j] if i < 2 else before[2, j] + a0 * before[0, j] + a1 * before[1, j]
                    F[k, i, j] = value - Qux[0, i] * end_gain[k, 0, j] - Qux[1, i] * end_gain[k, 1, j]
                    G[i, j] -= Fu[0, i] * end_gain[k, 0, j] + Fu[1, i] * end_gain[k, 1, j]
                value = pc[i] if i < 2 else pc[2] + a0 * pc[0] + a1 * pc[1]
                p[k, i] = value - Qux[0, i] * step[k, 0] - Qux[1, i] * step[k, 1]
                g[i] += before[0, i] * defects[k, 0] + before[1, i] * defects[k, 1] + before[2, i] * defects[k, 2]
                g[i] -= Fu[0, i] * step[k, 0] + Fu[1, i] * step[k, 1]
            P[k, 2, 2] += w_theta
        p[k, 0] += dphi[k, 0]
        p[k, 1] += dphi[k, 1]
        duration = h[min(k, intervals - 1)]
        P[k, 0, 0] += hxx + shift * duration
        P[k, 0, 1] += hxy
        P[k, 1, 0] += hxy
        P[k, 1, 1] += hyy + shift * duration
        P[k, 2, 2] += turn_weight * shift * duration
    return True
