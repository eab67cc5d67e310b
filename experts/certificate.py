"""Re-integration of a solver's nodes: the dense extremal and the evidence that it is one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import float64, int64, types
from scipy.integrate import solve_ivp

from leapnav.envs.compiling import njit
from leapnav.envs.obstacles import clearance
from leapnav.experts.conjugate_points import (
    NO_RANK,
    ROUGH_ACCURACY,
    conjugate_time,
    first_focal_time,
    first_touch,
    orthonormalise,
)
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
    step,
    vector,
)
from leapnav.experts.problem import OptimalControlProblem

# Tighter than any solver's own integration, and about what double precision allows.
ACCURACY = 1e-12
FAILED_ACCURACY = 1e-9
FEWEST_ROWS, ROWS_PER_SEGMENT = 512, 24  # room for the steps of an extremal; where it is short, four times as much
MOST_ROWS = 100_000  # steps of an extremal; one that needs more has diverged


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
            determinant = orthonormalise(y[size:].reshape((size, n)))
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
    rows = max(FEWEST_ROWS, ROWS_PER_SEGMENT * len(times))
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
        conjugate_point = first_focal_time(extremal, arrays.free)
    else:
        conjugate_point = first_touch(extremal, out[:, -1])
        if step_of_conjugate >= 0:
            crossing = conjugate_time(extremal, step_of_conjugate, sensitivity)
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
