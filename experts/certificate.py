"""Re-integration of a solver's nodes: the dense extremal and the evidence that it is one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
from numba import float64, int64, njit, types
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

from leapnav.envs.obstacles import clearance
from leapnav.experts.extremal import Certificate, Extremal, Iteration, Status
from leapnav.experts.integrator import (
    CONTROL,
    DENSE_TERMS,
    EXTRA_STAGES,
    FLOW,
    LIMIT,
    SMALLEST_STEP,
    STAGES,
    constant,
    cube,
    evaluate_interpolant,
    interpolant,
    matrix,
    next_step,
    propagate,
    step,
    vector,
)
from leapnav.experts.problem import OptimalControlProblem

# Tighter than any solver's own integration, and about what double precision allows.
ACCURACY = 1e-12
FAILED_ACCURACY = 1e-9
ROUGH_ACCURACY = 1e-6
MOST_ROWS = 100_000  # steps of an extremal; one that needs more has diverged
# A determinant that touches zero dips to this share of its size before, and the parabola through the points around goes
# to this share of the lowest; a singular value that counts as zero.
DIP, DEEPER, TOUCHED = 0.3, 0.7, 1e-5
NO_RANK = 1e-9  # a determinant below this has no sign that rounding leaves


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
    types.Tuple((int64, float64, int64, int64))(
        FLOW, CONTROL, vector, matrix, constant, constant, float64, int64, matrix, cube, matrix
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _trace(flow, control, times, Z, data, field, accuracy, m, out, terms, sensitivity):
    """Integrates each segment from its node, recording every accepted step.

    Rows of `out`: time, accumulated cost, running cost, u (m), z (2n), z' (2n), determinant of dq/dlambda(0) in an
    orthonormal basis; `terms` holds the interpolant of the
    step that starts at the row. Returns (rows or -1 if `out` is too short or -2 if the flow diverged, largest gap at a
    node, row of the step with the first conjugate point or -1, evaluations); `sensitivity` (2n, n) becomes the
    orthonormalised dz/dlambda(0) at the start of that step.
    """
    size = Z.shape[1]
    n = size // 2
    length = size * (1 + n)
    y, new = np.zeros(length), np.empty(length)
    K = np.empty((STAGES + 1 + EXTRA_STAGES, length))
    L = np.empty(STAGES + 1 + EXTRA_STAGES)
    S = y[size:].reshape((size, n))
    before_step = np.zeros((size, n))
    for i in range(n):
        S[n + i, i] = 1.0
    rows, gap, conjugate, total, sign, evaluations, determinant = 0, 0.0, -1, 0.0, 0.0, 0, 0.0
    last = len(times) - 2
    h = (times[1] - times[0]) / 4.0
    for k in range(last + 1):
        y[:size] = Z[k]
        elapsed, duration = 0.0, times[k + 1] - times[k]
        K[0, size:] = 0.0
        slope = K[0]
        running = flow(
            y[:size], data, field, y[size:].reshape((size, n)), slope[:size], slope[size:].reshape((size, n))
        )
        evaluations += 1
        while True:
            finished = elapsed >= duration
            if not finished or k == last:
                if rows == len(out):
                    return -1, gap, conjugate, evaluations
                out[rows, 0] = times[k] + elapsed
                out[rows, 1] = total
                out[rows, 2] = running
                control(y[:size], data, out[rows, 3 : 3 + m])
                out[rows, 3 + m : 3 + m + size] = y[:size]
                out[rows, 3 + m + size : 3 + m + 2 * size] = K[0, :size]
                out[rows, 3 + m + 2 * size] = determinant
            if finished:
                break
            while True:
                wanted = h
                ends = elapsed + h >= duration * (1 - 1e-14)
                if ends:
                    h = duration - elapsed
                cost, error = step(flow, y, new, K, L, size, n, h, accuracy, ROUGH_ACCURACY, data, field, running)
                evaluations += STAGES
                taken, h = h, next_step(h, error)
                if error <= 1.0:
                    break
                if h < SMALLEST_STEP * times[last + 1]:
                    return -2, np.inf, conjugate, evaluations
            if ends:  # cut short by the node, so the wanted step was not refuted
                h = max(h, wanted)
            interpolant(flow, y, new, K, L, size, taken, cost, data, field, terms[rows])
            evaluations += EXTRA_STAGES
            rows += 1
            total += cost
            elapsed = duration if ends else elapsed + taken
            before_step[:] = y[size:].reshape((size, n))
            y, new = new, y
            running = L[STAGES]
            for i in range(size):
                if not abs(y[i]) < LIMIT:
                    return -2, np.inf, conjugate, evaluations
            # Only the span of S matters. Gram-Schmidt keeps it numerically independent over any horizon, and its
            # positive scaling leaves the sign of det dq/dlambda(0) as it is.
            determinant = _orthonormalise(y[size:].reshape((size, n)))
            slope = K[0]
            flow(y[:size], data, field, y[size:].reshape((size, n)), slope[:size], slope[size:].reshape((size, n)))
            evaluations += 1
            if abs(determinant) > NO_RANK and conjugate < 0:
                if sign == 0.0:
                    sign = math.copysign(1.0, determinant)
                elif sign * determinant < 0.0:
                    conjugate = rows - 1
                    sensitivity[:] = before_step
        for i in range(size):
            gap = max(gap, abs(y[i] - Z[k + 1, i]))
    return rows + 1, gap, conjugate, evaluations


@njit(float64(constant, vector, matrix, cube, int64, int64), cache=True, error_model="numpy", nogil=True)
def _dense_clearance(field, times, starts, terms, ix, iy):
    """Smallest clearance (m) along the interpolated path.

    Clearance changes by no more than the way driven, so the walk skips what cannot hold a smaller value.
    """
    lowest, _ = clearance(starts[0, ix], starts[0, iy], field)
    for k in range(len(times) - 1):
        # The mean speed over the step and over its halves, with room: steps this accurate do not vary more in between.
        way = 0.0
        x, y = starts[k, ix], starts[k, iy]
        for part in range(1, 9):
            px = evaluate_interpolant(starts[k, ix], part / 8.0, terms[k], ix)
            py = evaluate_interpolant(starts[k, iy], part / 8.0, terms[k], iy)
            way = max(way, 8.0 * math.hypot(px - x, py - y))
            x, y = px, py
        way = 1.5 * way + 1e-12
        s = 0.0
        while s < 1.0:
            here, _ = clearance(
                evaluate_interpolant(starts[k, ix], s, terms[k], ix),
                evaluate_interpolant(starts[k, iy], s, terms[k], iy),
                field,
            )
            lowest = min(lowest, here)
            # At the walk's shortest step (m) the path bends away by hundredths of a millimetre; finer near a touch.
            s += max(here - lowest, min(max(0.1 * lowest, 1e-4), 5e-3)) / way
    here, _ = clearance(starts[-1, ix], starts[-1, iy], field)
    return min(lowest, here)


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
        history: the solver's iterations.
        work: the solver's evaluations of the flow.

    """
    arrays = problem.arrays
    n, m = problem.system.n, problem.system.m
    times, nodes = np.ascontiguousarray(times, dtype=float), np.ascontiguousarray(nodes, dtype=float)
    # A path that did not converge is only looked at.
    accuracy = ACCURACY if converged is Status.SUCCESS else FAILED_ACCURACY
    rows = 512
    sensitivity = np.empty((2 * n, n))
    while True:
        out, terms = np.empty((rows, 4 + m + 4 * n)), np.empty((rows, DENSE_TERMS, 2 * n + 1))
        count, gap, step_of_conjugate, _ = _trace(
            arrays.flow,
            arrays.control,
            times,
            nodes,
            arrays.data,
            arrays.field,
            accuracy,
            m,
            out,
            terms,
            sensitivity,
        )
        if count != -1 or rows > MOST_ROWS:
            break
        rows *= 4
    if count < 0:
        return failure(problem, Status.DIVERGED if converged is Status.SUCCESS else converged, history, work)
    out, terms = out[:count].copy(), terms[: count - 1].copy()
    z = np.ascontiguousarray(out[:, 3 + m : 3 + m + 2 * n])
    states, costates = z[:, :n], z[:, n:]
    hamiltonian = out[:, 2] + np.sum(costates * out[:, 3 + m + 2 * n : 3 + m + 3 * n], axis=1)
    end = np.where(arrays.free, costates[-1], states[-1] - arrays.goal)
    extremal = Extremal(
        problem=problem,
        status=converged,
        cost=float(out[-1, 1]),
        times=out[:, 0].copy(),
        states=states,
        controls=out[:, 3 : 3 + m].copy(),
        costates=costates,
        accumulated=out[:, 1].copy(),
        hamiltonian=hamiltonian,
        terms=terms,
        history=history,
        nodes=len(times),
        work=work,
    )
    if arrays.free.any():
        conjugate_point = _first_focal_time(extremal, arrays.free)
    else:
        conjugate_point = _first_touch(extremal, out[:, -1])
        if step_of_conjugate >= 0:
            crossing = _conjugate_time(extremal, step_of_conjugate, sensitivity)
            conjugate_point = min((t for t in (conjugate_point, crossing) if t is not None), default=None)
    closest = None
    if problem.field is not None and problem.system.position is not None:
        ix, iy = (problem.system.state.index(symbol) for symbol in problem.system.position)
        closest = float(_dense_clearance(problem.field, extremal.times, z, terms, ix, iy))
    certificate = Certificate(
        residual=float(max(np.abs(states[0] - arrays.start).max(), np.abs(end).max())),
        defect=float(gap),
        hamiltonian_drift=float(np.ptp(hamiltonian)),
        conjugate_point=conjugate_point,
        clearance=closest,
    )
    status = certificate.status() if converged is Status.SUCCESS else converged
    return replace(extremal, certificate=certificate, status=status)


def _conjugate_time(extremal: Extremal, k: int, sensitivity: np.ndarray) -> float | None:
    """When det dq(t)/dlambda(0) vanishes within step k, at whose start dz/dlambda(0) spans `sensitivity` (2n, n)."""
    arrays = extremal.problem.arrays

    def determinant(duration: float) -> float:
        z = np.concatenate([extremal.states[k], extremal.costates[k]])
        S = sensitivity.copy()
        if duration > 0.0:
            propagate(arrays.flow, z, S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
        return _orthonormalise(S)

    step = float(extremal.times[k + 1] - extremal.times[k])
    time = float(extremal.times[k]) + _zero(determinant, step)
    # One at the horizon itself does not contradict a minimum.
    return time if time < extremal.problem.horizon * (1 - 1e-9) else None


def _first_touch(extremal: Extremal, determinants: np.ndarray) -> float | None:
    """First time at which det dq(t)/dlambda(0) vanishes without a change of sign, as it does in symmetric problems."""
    if not _dips(extremal.times, determinants, likely=True):
        return None
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    z = np.concatenate([extremal.states, extremal.costates], axis=1)
    S = np.concatenate([np.zeros((n, n)), np.eye(n)])
    frames = [S.copy()]

    def advance(k: int, S: np.ndarray, time: float) -> np.ndarray:
        S, duration = S.copy(), time - float(extremal.times[k])
        if duration > 0.0:
            propagate(arrays.flow, z[k].copy(), S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
            _orthonormalise(S)
        return S

    for k in range(len(z) - 1):
        frames.append(advance(k, frames[k], float(extremal.times[k + 1])))

    def frame(time: float) -> np.ndarray:
        k = min(int(np.searchsorted(extremal.times, time, side="right")) - 1, len(frames) - 1)
        return advance(k, frames[k], time)

    return _touch(extremal.times, determinants, frame, likely=True)


def _dips(times: np.ndarray, determinants: np.ndarray, likely: bool) -> list[int]:
    """Inner points at which |determinant| has a low minimum; the `likely` ones by the parabola through three points."""
    size = np.abs(determinants)
    before = np.maximum.accumulate(size)[1:-1]
    lowest = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < DIP * before)
    found = []
    for i in np.flatnonzero(lowest) + 1:
        a, b, c = np.polyfit(times[i - 1 : i + 2] - times[i], size[i - 1 : i + 2], 2)
        if not likely or a <= 0.0 or c - b * b / (4.0 * a) < DEEPER * size[i]:
            found.append(int(i))
    return found


def _touch(
    times: np.ndarray, determinants: np.ndarray, frame: Callable[[float], np.ndarray], likely: bool
) -> float | None:
    """First time (in the order of `times`) near a dip at which the frame's upper block loses rank."""
    for i in _dips(times, determinants, likely):
        low, high = sorted((float(times[i - 1]), float(times[i + 1])))
        found = minimize_scalar(
            lambda t: np.linalg.svd(frame(t)[: frame(t).shape[1]], compute_uv=False)[-1],
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-9 * (high - low)},
        )
        if found.fun < TOUCHED:
            return float(found.x)
    return None


def _first_focal_time(extremal: Extremal, free: np.ndarray) -> float | None:
    """Last time at which the extremals that meet the end conditions focus, for free final components.

    These extremals are a Lagrangian subspace of (dq, dlambda): at the horizon dq_i = 0 where q_i is fixed and
    dlambda_i = 0 where it is free. Carried backwards, its projection on dq loses rank at a focal point, and an extremal
    with one before its horizon is no local minimum.
    """
    arrays, n = extremal.problem.arrays, extremal.problem.system.n
    symplectic = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    times = extremal.times[::-1]
    frames = [np.concatenate([np.diag(free.astype(float)), np.diag((~free).astype(float))])]

    def back(k: int, time: float) -> np.ndarray:
        """The frame at a time up to a step before times[k], orthonormal."""
        duration = float(times[k]) - time
        basis = np.ascontiguousarray(frames[k])
        if duration > 0.0:
            z, S = extremal.interpolate(np.array([time]))[0], np.eye(2 * n)
            propagate(arrays.flow, z, S, duration, arrays.data, arrays.field, ROUGH_ACCURACY, 0.0, False)
            # The inverse of a symplectic matrix.
            basis = np.ascontiguousarray(-symplectic @ S.T @ symplectic @ basis)
        return basis

    determinants = [0.0]
    sign, crossing = 0.0, None
    for k in range(len(times) - 1):
        frames.append(back(k, float(times[k + 1])))
        determinants.append(_orthonormalise(frames[-1]))
        if abs(determinants[-1]) > NO_RANK:
            if sign * determinants[-1] < 0:
                step = float(times[k] - times[k + 1])
                crossing = float(times[k]) - _zero(lambda d, k=k: _orthonormalise(back(k, float(times[k]) - d)), step)
                break
            sign = math.copysign(1.0, determinants[-1])

    def frame(time: float) -> np.ndarray:
        k = max(int(np.searchsorted(-times, -time, side="left")) - 1, 0)
        basis = back(k, time)
        _orthonormalise(basis)
        return basis

    touch = _touch(times, np.array(determinants), frame, likely=False)
    return max((t for t in (touch, crossing) if t is not None), default=None)


def _zero(function: Callable[[float], float], step: float) -> float:
    """Where `function` changes its sign on [0, step]; the start, if it is too small there to have one."""
    if function(0.0) * function(step) >= 0.0:
        return 0.0
    return cast(float, brentq(function, 0.0, step, xtol=1e-12))


def verify(extremal: Extremal) -> float:
    """Largest gap of the extremal when scipy's DOP853 integrates it again at 1e-11, from point to point.

    The certificate's own defect comes from a compiled integrator with the same coefficients; this is a second opinion
    that shares only the flow with it, and takes a hundred times as long.

    Raises:
        ValueError: a failed solve has no path.

    """
    if len(extremal.times) == 0:
        raise ValueError(f"there is no path: {extremal.status.value}")
    arrays, size = extremal.problem.arrays, 2 * extremal.problem.system.n
    none, dz = np.empty((size, 0)), np.empty(size)

    def flow(_: float, z: np.ndarray) -> np.ndarray:
        arrays.flow(z, arrays.data, arrays.field, none, dz, none)
        return dz.copy()

    points = np.concatenate([extremal.states, extremal.costates], axis=1)
    gap = 0.0
    for k in range(len(points) - 1):
        span = (float(extremal.times[k]), float(extremal.times[k + 1]))
        end = solve_ivp(flow, span, points[k], method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
        gap = max(gap, float(np.abs(end - points[k + 1]).max()))
    return gap


def failure(
    problem: OptimalControlProblem, status: Status, history: tuple[Iteration, ...] = (), work: int = 0
) -> Extremal:
    """A result without a path."""
    n, m = problem.system.n, problem.system.m
    empty = np.empty((0, n))
    return Extremal(
        problem,
        status,
        np.inf,
        np.empty(0),
        empty,
        np.empty((0, m)),
        empty,
        np.empty(0),
        np.empty(0),
        np.empty((0, DENSE_TERMS, 2 * n + 1)),
        history,
        None,
        0,
        work,
    )
