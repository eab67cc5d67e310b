"""Certification of a solution by re-integration, independent of the solver that found it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from leapnav.envs.utils.validation import as_matrix, as_vector
from leapnav.experts.numerics.integrator import DENSE_TERMS
from leapnav.experts.numerics.state_bounds import state_margin
from leapnav.experts.problem.conjugate_points import (
    conjugate_time,
    first_even_conjugate_time,
    first_focal_time,
    smallest_singular_value,
)
from leapnav.experts.problem.extremal import Certificate, Extremal, Iteration, Status
from leapnav.experts.problem.frames import MIN_DETERMINANT
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.problem.tracing import FULL, TraceRecord, dense_clearance, trace

# Integrator tolerance for a converged solution: tighter than that of any solver, and close to rounding level ...
ACCURACY = 1e-12
# ... and for an iterate that did not converge, which is only displayed.
UNCONVERGED_ACCURACY = 1e-9
# Initial size of the table of integration steps; it grows by a factor of 4 when it is full.
MIN_ROWS, ROWS_PER_SEGMENT = 512, 24
POINTS_PER_STEP = 8  # at which limits of states are checked; the barrier makes steps short close to them
MAX_ROWS = 100_000  # integration steps; an extremal that needs more has diverged


def certify(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    converged: Status,
    history: tuple[Iteration, ...] = (),
    evaluations: int = 0,
) -> Extremal:
    """Re-integrate a solver's nodes and return the `Extremal` with its certificate.

    Args:
        problem: the problem that was solved.
        times: (K,) from 0 to the horizon (s).
        nodes: (K, 2n), states and costates.
        converged: status of the solver. SUCCESS is replaced by the status of the certificate; any other status is kept.
        history: the solver's iterations.
        evaluations: number of evaluations of the extremal flow by the solver.

    Raises:
        ValueError: the times are not increasing or fewer than two, or an array has a wrong shape.

    """
    arrays = problem.arrays
    n, m = problem.system.n, problem.system.m
    times = as_vector("times", times, finite=False)
    nodes = as_matrix("nodes", nodes, len(times), 2 * n, finite=False)
    if len(times) < 2 or not (times[1:] > times[:-1]).all() or not math.isfinite(times[-1]):
        raise ValueError(f"times: expected at least two increasing numbers, got {times}")
    if not np.isfinite(nodes).all():
        return failure(problem, Status.DIVERGED if converged is Status.SUCCESS else converged, history, evaluations)
    accuracy = ACCURACY if converged is Status.SUCCESS else UNCONVERGED_ACCURACY
    capacity = max(MIN_ROWS, ROWS_PER_SEGMENT * len(times))
    sensitivity, final = np.full((2, 2 * n, n), np.nan)
    while True:
        out, terms = np.empty((capacity, 4 + m + 4 * n)), np.empty((capacity, DENSE_TERMS, 2 * n + 1))
        record = TraceRecord(out, terms, sensitivity, final)
        n_rows, defect, conjugate_step = trace(
            arrays.flow, arrays.control, times, nodes, problem.clock, accuracy, record
        )
        if n_rows != FULL or capacity > MAX_ROWS:
            break
        capacity *= 4
    if n_rows < 0:
        return failure(problem, Status.DIVERGED if converged is Status.SUCCESS else converged, history, evaluations)
    # The step across a knot of a path at the end of a segment may be shorter than the rounding error of the time.
    lasting = np.diff(out[:n_rows, 0]) > 0.0
    out, terms = out[:n_rows][np.append(lasting, True)], terms[: n_rows - 1][lasting]
    conjugate_step -= int((~lasting[: max(conjugate_step, 0)]).sum())
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
        n_nodes=len(times),
        n_evaluations=evaluations,
    )
    # The time is free at the end, but no control changes it.
    has_free_end = arrays.free.sum() > (problem.clock >= 0)
    try:
        if has_free_end:
            conjugate_point = first_focal_time(extremal, arrays.free)
        else:
            conjugate_point = first_even_conjugate_time(extremal, out[:, -1].copy())
            if conjugate_step >= 0:
                crossing = conjugate_time(extremal, conjugate_step, sensitivity)
                conjugate_point = min((t for t in (conjugate_point, crossing) if t is not None), default=None)
    except FloatingPointError:
        conjugate_point = math.nan
    clearance = None
    if problem.field is not None and problem.system.position is not None:
        system = problem.system
        heading = -1 if system.heading is None else system.state.index(system.heading)
        places = np.array([*map(system.state.index, problem.system.position), heading])
        clearance = float(dense_clearance(problem.field, problem.outline, places, extremal.times, z, terms))
    margin = state_margin(problem.state_limits, _dense_states(extremal)) if problem.state_limits else None
    residual = float(max(np.abs(states[0] - arrays.start).max(), np.abs(end).max()))
    curvature, horizon_error = None, None
    if problem.horizon is None:
        largest = float(np.abs(hamiltonian).max())
        residual = max(residual, largest / max(1.0, problem.time_weight))
        curvature = _time_curvature(final, out[-1, 3 + m + 2 * n : 3 + m + 4 * n], arrays.free)
        horizon_error = largest / (curvature * extremal.horizon) if curvature > 0 else math.inf
    at_bounds = problem.control_bounds is not None and _saturates(extremal.controls, problem.control_bounds)
    certificate = Certificate(
        residual=residual,
        defect=float(defect),
        hamiltonian_drift=float(np.ptp(hamiltonian)),
        conjugate_point=conjugate_point,
        clearance=clearance,
        time_curvature=curvature,
        horizon_error=horizon_error,
        state_margin=margin,
        controllability=None if has_free_end or at_bounds else _controllability(extremal, final),
    )
    status = certificate.status() if converged is Status.SUCCESS else converged
    if clearance is not None and clearance <= 0:  # an extremal has positive clearance; the path explains the failure
        status = Status.COLLISION
    return replace(extremal, certificate=certificate, status=status)


def _dense_states(extremal: Extremal) -> np.ndarray:
    """Return the states (K, n) at the steps of the integrator and between them."""
    fractions = np.arange(POINTS_PER_STEP) / POINTS_PER_STEP
    times = extremal.times[:-1, None] + np.diff(extremal.times)[:, None] * fractions
    return extremal.interpolate(np.append(times.ravel(), extremal.times[-1]))[:, : extremal.problem.system.n]


def _saturates(controls: np.ndarray, bounds: Sequence[tuple[float, float]]) -> bool:
    """Return whether a control (K, m) is at one of its bounds somewhere."""
    low, high = np.array(bounds).T
    return bool(((controls <= low) | (controls >= high)).any())


def _controllability(extremal: Extremal, frame: np.ndarray) -> float:
    """Return the larger of the smallest singular values at the final time and, if that is small, at half of it."""
    clock = extremal.problem.clock
    largest = _smallest_singular_value(frame, clock)
    if not largest > Certificate.MIN_CONTROLLABILITY:
        arrays, (size, n) = extremal.problem.arrays, frame.shape
        times = np.array([0.0, 0.5 * extremal.times[-1]])
        rows = np.empty((len(extremal.times) + MIN_ROWS, 4 + extremal.controls.shape[1] + 2 * size))
        terms = np.empty((len(rows), DENSE_TERMS, size + 1))
        middle = np.full((size, n), np.nan)  # remains if the flow diverges
        record = TraceRecord(rows, terms, np.empty((size, n)), middle)
        trace(arrays.flow, arrays.control, times, extremal.interpolate(times), clock, ACCURACY, record)
        largest = max(largest, _smallest_singular_value(middle, clock))
    return largest


def _smallest_singular_value(frame: np.ndarray, clock: int) -> float:
    """Return that of the upper half of an orthonormal frame (2n, n); NaN if it has diverged."""
    return smallest_singular_value(frame, clock) if np.isfinite(frame).all() else math.nan


def _time_curvature(frame: np.ndarray, rates: np.ndarray, free: np.ndarray) -> float:
    """Return d2J/dT2 for extremals with the same ends, which is the derivative of the Hamiltonian at the final time.

    A change of T moves the final state by q' along an extremal. The initial costate changes so that the goal, and the
    zero costates of free components, are met again.

    Args:
        frame (2n, n): a basis of the changes of the final state and costate with the initial costate.
        rates (2n,): q' and lambda' at the final time.
        free (n,): which final states are free, bool.

    Returns:
        The derivative; infinite if no extremal with another duration is close, because controls are at their bounds all
        the time.

    """
    n = len(free)
    upper, lower, rate, costate_rate = frame[:n], frame[n:], rates[:n], rates[n:]
    conditions = np.where(free[:, None], lower, upper)
    if abs(np.linalg.det(conditions)) < MIN_DETERMINANT:
        return math.inf
    change = np.linalg.solve(conditions, np.where(free, costate_rate, rate))
    return float((costate_rate @ upper - rate @ lower) @ change)


def verify(extremal: Extremal) -> float:
    """Return the largest defect of an extremal when SciPy's DOP853 integrates it from point to point.

    An independent check of the certificate's defect, with relative and absolute tolerance 1e-11: it shares only the
    extremal flow with the compiled integrator, and takes about 100 times as long.

    Raises:
        ValueError: the extremal has no path, because the solve failed.

    """
    if len(extremal.times) == 0:
        raise ValueError(f"there is no path: {extremal.status.value}")
    arrays = extremal.problem.arrays
    points = np.concatenate([extremal.states, extremal.costates], axis=1)
    defect = 0.0
    for k in range(len(points) - 1):
        span = (float(extremal.times[k]), float(extremal.times[k + 1]))
        end = solve_ivp(lambda _, z: arrays.rates(z), span, points[k], method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
        defect = max(defect, float(np.abs(end - points[k + 1]).max()))
    return defect


def failure(
    problem: OptimalControlProblem, status: Status, history: tuple[Iteration, ...] = (), evaluations: int = 0
) -> Extremal:
    """Return a failed result without a path."""
    n, m = problem.system.n, problem.system.m
    return Extremal(
        problem=problem,
        status=status,
        cost=np.inf,
        times=np.empty(0),
        states=np.empty((0, n)),
        controls=np.empty((0, m)),
        costates=np.empty((0, n)),
        accumulated=np.empty(0),
        hamiltonian=np.empty(0),
        terms=np.empty((0, DENSE_TERMS, 2 * n + 1)),
        history=history,
        n_evaluations=evaluations,
    )
