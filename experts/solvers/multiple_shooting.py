"""Multiple shooting: Newton's method on states and costates at all nodes, with a banded solver."""

from __future__ import annotations

import numpy as np

from leapnav.experts.numerics.flow import NewtonOptions
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Iteration, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.newton import MARGIN, STALLED, segment_growth, solve_nodes
from leapnav.experts.solvers.nodes import SolverOptions, first_mesh, start_nodes
from leapnav.experts.solvers.outcome import KERNEL_STATUS

# Tolerance of the integrator relative to the tolerance of Newton's method, and where the certificate does not confirm
# the result: steps across a discontinuous curvature, at the vertices of polygons, have larger errors than estimated.
ACCURACY, FINE_ACCURACY = 0.1, 1e-3
# Largest growth of the sensitivities over a segment; beyond it Newton's method loses half of its digits.
MAX_GROWTH = 1e4
MAX_PIECES = 8  # pieces into which a segment is divided
PIECES_DIVERGED = 4  # pieces of a segment over which the flow diverged
MAX_REFINEMENTS, MAX_SEGMENTS = 6, 20_000


def multiple_shooting(problem: OptimalControlProblem, path: Trajectory, options: SolverOptions) -> Extremal:
    """Solve by Newton's method on states and costates at all nodes.

    If it fails, the segments over which the flow is too sensitive are divided, or all segments if there are none, and
    Newton's method starts again from the same path.
    """
    times, nodes = start_nodes(problem, path, first_mesh(path, options))
    mesh = times.copy()
    status, history, evaluations = polish(problem, times, nodes, options.tol, options.max_iterations)
    for _ in range(MAX_REFINEMENTS):
        if status is Status.SUCCESS or not options.subdivide:
            break
        mesh, count = _refine(problem, path, mesh)
        evaluations += count
        if len(mesh) > MAX_SEGMENTS:
            break
        times, nodes = start_nodes(problem, path, mesh.copy())
        status, rows, count = polish(problem, times, nodes, options.tol, options.max_iterations)
        history += rows
        evaluations += count
    return confirm(problem, times, nodes, status, history, evaluations, options)


def confirm(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    status: Status,
    history: tuple[Iteration, ...],
    evaluations: int,
    options: SolverOptions,
) -> Extremal:
    """Certify nodes; if the certificate does not confirm a predicted residual, continue Newton's method."""
    extremal = certify(problem, times, nodes, status, history, evaluations)
    if extremal.status is not Status.NOT_CERTIFIED:
        return extremal
    status, rows, count = polish(problem, times, nodes, options.tol, options.max_iterations, fine=True)
    return certify(problem, times, nodes, status, history + rows, evaluations + count)


def polish(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    tol: float,
    max_iterations: int,
    fine: bool = False,
) -> tuple[Status, tuple[Iteration, ...], int]:
    """Apply Newton's method of multiple shooting to nodes, in place.

    Args:
        problem: the problem.
        times: (segments + 1,), s; changed in place if the horizon is free.
        nodes: (segments + 1, 2n), changed in place.
        tol: largest residual.
        max_iterations: largest number of Newton steps.
        fine: whether to integrate with the fine accuracy from the start, and to evaluate the last iterate also if
            quadratic convergence predicts its residual.

    Returns:
        Status, one `Iteration` per iterate, and the number of evaluations of the flow.

    """
    arrays = problem.arrays
    costs = np.empty(len(times) - 1)
    log = np.zeros((max_iterations + 1, 3))
    accuracy = FINE_ACCURACY if fine else ACCURACY
    newton = NewtonOptions(MARGIN * tol, MARGIN * tol * accuracy, max_iterations, not fine)
    code, iterations, residual, evaluations = solve_nodes(
        arrays.flow, times, nodes, arrays.start, arrays.end, newton, costs, log
    )
    rows = tuple(Iteration("newton", len(costs), row[1], row[0]) for row in log[: iterations + 1].tolist())
    # Rounding errors may exceed the margin; the certificate decides.
    status = Status.SUCCESS if code == STALLED and residual <= tol else KERNEL_STATUS[code]
    return status, rows, evaluations


def polish_in_stages(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, tol: float, max_iterations: int
) -> tuple[Status, tuple[Iteration, ...], int]:
    """Apply `polish`, with a free horizon if necessary in two stages, of which the first keeps the times."""
    first_times, first = times.copy(), nodes.copy()
    status, rows, evaluations = polish(problem, times, nodes, tol, max_iterations)
    if status is Status.SUCCESS or problem.horizon is not None:
        return status, rows, evaluations
    times[:] = first_times
    fixed = problem.with_horizon(float(times[-1]))
    status, more, count = polish(fixed, times, first, tol, max_iterations)
    rows, evaluations = rows + more, evaluations + count
    if status is Status.SUCCESS:
        nodes[:] = first
        status, more, count = polish(problem, times, nodes, tol, max_iterations)
        rows, evaluations = rows + more, evaluations + count
    return status, rows, evaluations


def _refine(problem: OptimalControlProblem, path: Trajectory, times: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the times of more nodes, and the evaluations of the flow.

    Segments over which the flow from the path's nodes is too sensitive are divided, or all segments in two if there are
    none.
    """
    times, nodes = start_nodes(problem, path, times)
    growth = np.empty(len(times) - 1)
    evaluations = segment_growth(problem.arrays.flow, times, nodes, growth)
    # The growth is exponential in time, so the number of pieces is proportional to its logarithm.
    with np.errstate(divide="ignore"):
        needed = np.ceil(np.log(growth) / np.log(MAX_GROWTH))
    pieces = np.where(np.isfinite(growth), needed, PIECES_DIVERGED).clip(1, MAX_PIECES).astype(int)
    if pieces.max() == 1:
        pieces[:] = 2
    first = np.repeat(times[:-1], pieces)
    index = np.concatenate([np.arange(count) for count in pieces])
    return np.append(first + index * np.repeat(np.diff(times) / pieces, pieces), times[-1]), evaluations
