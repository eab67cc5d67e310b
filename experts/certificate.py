"""Re-integration of a solver's nodes: the dense extremal and the evidence that it is one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import float64, int64, njit, types

from leapnav.envs.obstacles import clearances
from leapnav.experts.extremal import Certificate, Extremal, Iteration, Status
from leapnav.experts.integrator import FLOW, constant, matrix, propagate, vector
from leapnav.experts.problem import OptimalControlProblem

# Tighter than any solver's own integration, and about what double precision allows.
ACCURACY = 1e-12
ROUGH_ACCURACY = 1e-6
MOST_ROWS = 100_000  # steps of an extremal; one that needs more has diverged
# The dense path has a point every SPACING metres; where it comes nearer to something than that, every tenth of that.
SPACING = 5e-3


@njit(float64(matrix), cache=True, error_model="numpy", nogil=True)
def _orthonormalise(S):
    """Modified Gram-Schmidt on the columns, in place; returns the determinant of the upper square block."""
    size, n = S.shape
    for j in range(n):
        for i in range(j):
            dot = 0.0
            for r in range(size):
                dot += S[r, i] * S[r, j]
            for r in range(size):
                S[r, j] -= dot * S[r, i]
        norm = 0.0
        for r in range(size):
            norm += S[r, j] ** 2
        norm = math.sqrt(norm)
        for r in range(size):
            S[r, j] /= norm
    block = S[:n].copy()
    determinant = 1.0
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(block[i, k]) > abs(block[pivot, k]):
                pivot = i
        if block[pivot, k] == 0.0:
            return 0.0
        if pivot != k:
            determinant = -determinant
            for j in range(n):
                block[k, j], block[pivot, j] = block[pivot, j], block[k, j]
        determinant *= block[k, k]
        for i in range(k + 1, n):
            factor = block[i, k] / block[k, k]
            for j in range(k, n):
                block[i, j] -= factor * block[k, j]
    return determinant


@njit(
    types.Tuple((int64, float64, float64))(FLOW, vector, matrix, constant, constant, float64, matrix),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _trace(flow, times, Z, data, field, accuracy, out):
    """Integrates each segment from its node, recording every accepted step.

    Rows of `out`: time, accumulated cost, running cost, z (2n), z' (2n), z'' (2n). Returns (rows or -1 if `out` is too
    short or -2 if the flow diverged, largest gap at a node, first conjugate time or inf).
    """
    size = Z.shape[1]
    n = size // 2
    S = np.zeros((size, n))  # dz(t)/dlambda(0)
    for i in range(n):
        S[n + i, i] = 1.0
    one = np.empty((size, 1))
    d_one = np.empty((size, 1))
    dz = np.empty(size)
    z = np.empty(size)
    rows, gap, conjugate, total, sign, before = 0, 0.0, np.inf, 0.0, 0.0, 0.0
    last = len(times) - 2
    step = 0.0
    for k in range(last + 1):
        z[:] = Z[k]
        elapsed, duration = 0.0, times[k + 1] - times[k]
        if step <= 0.0:
            step = duration / 64.0
        while True:
            finished = elapsed >= duration
            if not finished or k == last:
                if rows == len(out):
                    return -1, gap, conjugate
                one[:, 0] = 0.0
                flow(z, data, field, one, dz, d_one)
                one[:, 0] = dz  # A z' = z''
                running = flow(z, data, field, one, dz, d_one)
                out[rows, 0] = times[k] + elapsed
                out[rows, 1] = total
                out[rows, 2] = running
                out[rows, 3 : 3 + size] = z
                out[rows, 3 + size : 3 + 2 * size] = dz
                out[rows, 3 + 2 * size :] = d_one[:, 0]
                rows += 1
            if finished:
                break
            cost, taken, following, steps = propagate(flow, z, S, duration - elapsed, data, field, accuracy, step, True)
            if steps < 0:
                return -2, np.inf, conjugate
            step = following
            total += cost
            elapsed = duration if taken >= duration - elapsed else elapsed + taken
            # Only the span of S matters. Gram-Schmidt keeps it numerically independent over any horizon, and its
            # positive scaling leaves the sign of det dq/dlambda(0) as it is.
            determinant = _orthonormalise(S)
            if abs(determinant) > 1e-9 and conjugate == np.inf:
                if sign == 0.0:
                    sign = math.copysign(1.0, determinant)
                elif sign * determinant < 0.0:
                    crossing = times[k] + elapsed - taken * determinant / (determinant - before)
                    if crossing < times[last + 1] * (1 - 1e-9):
                        conjugate = crossing
                before = determinant
        for i in range(size):
            gap = max(gap, abs(z[i] - Z[k + 1, i]))
    return rows, gap, conjugate


def certify(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    converged: Status,
    history: tuple[Iteration, ...] = (),
    work: int = 0,
) -> Extremal:
    """The `Extremal` of a solver's nodes, with its certificate.

    Args:
        times: (K,) from 0 to the horizon.
        nodes: (K, 2n), q and lambda.
        converged: the solver's own verdict. Anything but SUCCESS stays; SUCCESS has to be confirmed here.

    """
    arrays = problem.arrays
    n = problem.system.n
    # A path that did not converge is only looked at, so it need not be exact.
    accuracy = ACCURACY if converged is Status.SUCCESS else ROUGH_ACCURACY
    rows = 2048
    while True:
        out = np.empty((rows, 3 + 6 * n))
        count, gap, conjugate = _trace(arrays.flow, times, nodes, arrays.data, arrays.field, accuracy, out)
        if count != -1 or rows > MOST_ROWS:
            break
        rows *= 4
    if count < 0:
        return failure(problem, Status.DIVERGED if converged is Status.SUCCESS else converged, history, work)
    out = out[:count]
    states, costates = out[:, 3 : 3 + n].copy(), out[:, 3 + n : 3 + 2 * n].copy()
    rates, curvatures = out[:, 3 + 2 * n : 3 + 4 * n].copy(), out[:, 3 + 4 * n :].copy()
    controls = np.empty((count, problem.system.m))
    for row, z in zip(controls, out[:, 3 : 3 + 2 * n].copy(), strict=True):
        arrays.control(z, arrays.data, row)
    hamiltonian = out[:, 2] + np.sum(costates * rates[:, :n], axis=1)
    end = np.where(arrays.free, costates[-1], states[-1] - arrays.goal)
    extremal = Extremal(
        problem=problem,
        status=converged,
        cost=float(out[-1, 1]),
        times=out[:, 0].copy(),
        states=states,
        controls=controls,
        costates=costates,
        accumulated=out[:, 1].copy(),
        rates=rates,
        curvatures=curvatures,
        history=history,
        nodes=len(times),
        work=work,
    )
    if arrays.free.any():
        conjugate_point = _first_focal_time(extremal, arrays.free)
    else:
        conjugate_point = None if conjugate == np.inf else float(conjugate)
    certificate = Certificate(
        residual=float(max(np.abs(states[0] - arrays.start).max(), np.abs(end).max())),
        defect=float(gap),
        hamiltonian_drift=float(np.ptp(hamiltonian)),
        conjugate_point=conjugate_point,
        clearance=None if problem.field is None else _dense_clearance(extremal, problem),
    )
    status = certificate.status() if converged is Status.SUCCESS else converged
    return replace(extremal, certificate=certificate, status=status)


def _dense_clearance(extremal: Extremal, problem: OptimalControlProblem) -> float:
    assert problem.field is not None and problem.system.position is not None
    field = problem.field
    at = [problem.system.state.index(symbol) for symbol in problem.system.position]

    def look(times: np.ndarray) -> np.ndarray:
        return clearances(np.ascontiguousarray(extremal.interpolate(times)[:, at]), field)

    # Speeds at both ends of a step bound the way driven in it, up to a factor that steps this accurate stay below.
    speeds = np.linalg.norm(extremal.rates[:, at], axis=1)
    way = 1.5 * np.maximum(speeds[1:], speeds[:-1]) * np.diff(extremal.times)
    times = _subdivide(extremal.times, np.ceil(way / SPACING).astype(int).clip(1))
    found = look(times)
    near = (found[1:] < SPACING) | (found[:-1] < SPACING)
    if near.any():
        found = np.append(found, look(_subdivide(times, np.where(near, 10, 1))))
    return float(found.min())


def _subdivide(times: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """Each interval of `times` (N,) in so many equal pieces (N - 1,)."""
    first = np.repeat(times[:-1], pieces)
    number = np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(first + number * np.repeat(np.diff(times) / pieces, pieces), times[-1])


def _first_focal_time(extremal: Extremal, free: np.ndarray) -> float | None:
    """Last time at which the extremals that meet the end conditions focus, for free final components.

    These extremals are a Lagrangian subspace of (dq, dlambda): at the horizon dq_i = 0 where q_i is fixed and
    dlambda_i = 0 where it is free. Carried backwards, its projection on dq loses rank at a focal point, and an extremal
    with one before its horizon is no local minimum.
    """
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    symplectic = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    basis = np.concatenate([np.diag(free.astype(float)), np.diag((~free).astype(float))])
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    sign, before = 0.0, 0.0
    for k in range(len(extremal.times) - 2, -1, -1):
        step = extremal.times[k + 1] - extremal.times[k]
        S = np.eye(2 * n)
        propagate(arrays.flow, z[k].copy(), S, step, arrays.data, arrays.field, ROUGH_ACCURACY, step, False)
        basis = -symplectic @ S.T @ symplectic @ basis  # the inverse of a symplectic matrix
        basis = np.ascontiguousarray(basis)
        determinant = _orthonormalise(basis)
        if abs(determinant) > 1e-9:
            if sign * determinant < 0:
                return float(extremal.times[k] + step * determinant / (determinant - before))
            sign = math.copysign(1.0, determinant)
        before = determinant
    return None


def failure(
    problem: OptimalControlProblem, status: Status, history: tuple[Iteration, ...] = (), work: int = 0
) -> Extremal:
    """A result without a path."""
    n, m = problem.system.n, problem.system.m
    empty, none = np.empty((0, n)), np.empty((0, 2 * n))
    return Extremal(
        problem,
        status,
        np.inf,
        np.empty(0),
        empty,
        np.empty((0, m)),
        empty,
        np.empty(0),
        none,
        none,
        history,
        None,
        0,
        work,
    )
