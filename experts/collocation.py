"""Collocation by `scipy.integrate.solve_bvp`: three-stage Lobatto IIIA, C1 cubics, control of the residual.

J. Kierzenka and L. F. Shampine, A BVP solver based on residual control and the MATLAB PSE, ACM TOMS 27 (2001). It gets
the compiled flow, its analytic Jacobian, and costates that are consistent with the minimum principle.
"""

from __future__ import annotations

import numpy as np
from numba import int64
from scipy.integrate import solve_bvp

from leapnav.envs.compiling import njit
from leapnav.experts.certificate import certify
from leapnav.experts.extremal import Extremal, Iteration, Status
from leapnav.experts.integrator import FLOW, constant, cube, matrix
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import Settings, default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem, Path

# With a polish to follow, cubics need not be exact: their error falls with the fourth power of the mesh only.
ROUGH_TOLERANCE = 1e-4
MOST_NODES = 5_000
MOST_POLISHED = 128  # segments
# solve_bvp's own exit codes.
ENDS = {0: Status.SUCCESS, 1: Status.MAX_ITERATIONS, 2: Status.SINGULAR, 3: Status.STALLED}


def collocation(problem: OptimalControlProblem, path: Path, settings: Settings) -> Extremal:
    """solve_bvp to `tol`; with `polish` to a rough tolerance, and Newton's method on nodes of its mesh."""
    arrays, n = problem.arrays, problem.system.n
    times, nodes = start_nodes(problem, path, settings.segments or default_segments(path))
    at_start = np.zeros((2 * n, 2 * n))
    at_end = np.zeros((2 * n, 2 * n))
    at_start[:n, :n] = np.eye(n)
    end = np.arange(n) + np.where(arrays.free, n, 0)  # where a component is free its costate vanishes
    at_end[np.arange(n, 2 * n), end] = 1.0
    goal = np.where(arrays.free, 0.0, arrays.goal)
    work = 0

    def rates(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        nonlocal work
        out = np.empty((z.shape[1], 2 * n))
        work += _rates(arrays.flow, np.ascontiguousarray(z.T), arrays.data, arrays.field, out)
        return out.T

    def jacobians(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        nonlocal work
        out = np.empty((z.shape[1], 2 * n, 2 * n))
        work += _jacobians(arrays.flow, np.ascontiguousarray(z.T), arrays.data, arrays.field, out)
        return out.transpose(1, 2, 0)

    def ends(first: np.ndarray, last: np.ndarray) -> np.ndarray:
        return np.concatenate([first[:n] - arrays.start, last[end] - goal])

    tolerance = max(settings.tol, ROUGH_TOLERANCE) if settings.polish else settings.tol
    with np.errstate(all="ignore"):  # a diverging Newton step is solve_bvp's to notice
        found = solve_bvp(
            rates,
            ends,
            times,
            nodes.T,
            fun_jac=jacobians,
            bc_jac=lambda *_: (at_start, at_end),
            tol=tolerance,
            max_nodes=MOST_NODES,
        )
    nodes = np.ascontiguousarray(found.y.T)
    status = ENDS.get(found.status, Status.STALLED)
    if not np.isfinite(nodes).all():
        return certify(problem, times, start_nodes(problem, path, times)[1], Status.DIVERGED, (), work)
    residual = float(np.max(found.rms_residuals, initial=0.0))
    history = (Iteration("collocation", len(found.x) - 1, _cost(problem, found.x, nodes), residual),)
    if status is not Status.SUCCESS or not settings.polish:
        return certify(problem, found.x, nodes, status, history, work)
    # Every so manieth node of the mesh, which is fine where the path needs it.
    every = -(-(len(found.x) - 1) // MOST_POLISHED)
    chosen = np.unique(np.append(np.arange(0, len(found.x), every), len(found.x) - 1))
    times, nodes = found.x[chosen], nodes[chosen]
    status, rows, evaluations = polish(problem, times, nodes, settings.tol, settings.max_iterations)
    return confirm(problem, times, nodes, status, (*history, *rows), work + evaluations, settings)


def _cost(problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray) -> float:
    """J by trapezoids on the mesh, which is good enough for a history."""
    arrays, size = problem.arrays, nodes.shape[1]
    none, dz = np.empty((size, 0)), np.empty(size)
    running = [arrays.flow(z, arrays.data, arrays.field, none, dz, none) for z in nodes]
    return float(np.trapezoid(running, times))


@njit(int64(FLOW, matrix, constant, constant, matrix), cache=True, error_model="numpy", nogil=True)
def _rates(flow, Z, data, field, out):
    none, d_none = np.empty((Z.shape[1], 0)), np.empty((Z.shape[1], 0))
    for k in range(len(Z)):
        flow(Z[k], data, field, none, out[k], d_none)
    return len(Z)


@njit(int64(FLOW, matrix, constant, constant, cube), cache=True, error_model="numpy", nogil=True)
def _jacobians(flow, Z, data, field, out):
    dz, identity = np.empty(Z.shape[1]), np.eye(Z.shape[1])
    for k in range(len(Z)):
        flow(Z[k], data, field, identity, dz, out[k])
    return len(Z)
