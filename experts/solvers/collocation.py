"""Collocation with `scipy.integrate.solve_bvp`: three-stage Lobatto IIIA with residual control.

J. Kierzenka and L. F. Shampine, A BVP solver based on residual control and the MATLAB PSE, ACM TOMS 27 (2001). It is
called with the compiled flow, its analytic Jacobian, and costates that are consistent with the minimum principle. The
unknown parameter of a problem with a free horizon is the factor of all times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import int64
from scipy.integrate import solve_bvp

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CUBE, MATRIX, VECTOR
from leapnav.experts.numerics.flow import FLOW
from leapnav.experts.numerics.shooting import hamiltonian, set_identity
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Iteration, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.multiple_shooting import confirm, polish
from leapnav.experts.solvers.nodes import SolverOptions, first_mesh, start_nodes

# Tolerance if Newton's method follows. The error of the cubics decreases with the fourth power of the step only, so a
# tight tolerance would need a fine mesh.
COARSE_TOLERANCE = 1e-4
MAX_NODES = 5_000
# Entries of the Jacobian beyond which the iteration has diverged. SuperLU, which solve_bvp uses, overflows for matrices
# with larger entries, and the BLAS then prints messages about illegal arguments.
MAX_ENTRY = 1e30
# Exit codes of solve_bvp.
STATUS = {0: Status.SUCCESS, 1: Status.MAX_ITERATIONS, 2: Status.SINGULAR, 3: Status.STALLED}


class _DivergedError(Exception):
    """Newton's method inside `solve_bvp` has diverged."""


def collocation(problem: OptimalControlProblem, path: Trajectory, options: SolverOptions) -> Extremal:
    """Solve by collocation to `tol`, or with `polish` to a coarse tolerance followed by Newton's method."""
    arrays, n = problem.arrays, problem.system.n
    times, nodes = start_nodes(problem, path, first_mesh(path, options))
    at_start = np.zeros((2 * n, 2 * n))
    at_end = np.zeros((2 * n, 2 * n))
    at_start[:n, :n] = np.eye(n)
    end = np.arange(n) + np.where(arrays.free, n, 0)  # the costate of a free component vanishes
    at_end[np.arange(n, 2 * n), end] = 1.0
    goal = np.where(arrays.free, 0.0, arrays.goal)
    dz, evaluations = np.empty(2 * n), 0

    def rates(_: np.ndarray, z: np.ndarray, factor: Sequence[float] = (1.0,)) -> np.ndarray:
        nonlocal evaluations
        out = np.empty((z.shape[1], 2 * n))
        evaluations += _rates(arrays.flow, np.ascontiguousarray(z.T), out, np.empty(len(out)))
        return factor[0] * out.T

    def jacobians(t: np.ndarray, z: np.ndarray, factor: Sequence[float] | None = None) -> Any:
        nonlocal evaluations
        out = np.empty((z.shape[1], 2 * n, 2 * n))
        evaluations += _jacobians(arrays.flow, np.ascontiguousarray(z.T), out)
        if not np.abs(out).max() < MAX_ENTRY:  # also if there are NaN
            raise _DivergedError
        by_state = out.transpose(1, 2, 0)
        return by_state if factor is None else (factor[0] * by_state, rates(t, z)[:, None, :])

    def ends(first: np.ndarray, last: np.ndarray, factor: Sequence[float] | None = None) -> np.ndarray:
        conditions = [first[:n] - arrays.start, last[end] - goal]
        return np.concatenate(conditions if factor is None else [*conditions, [hamiltonian(arrays.flow, first, dz)]])

    def end_jacobians(first: np.ndarray, _: np.ndarray, factor: Sequence[float] | None = None) -> Any:
        if factor is None:
            return at_start, at_end
        hamiltonian(arrays.flow, first, dz)
        gradient = np.concatenate([-dz[n:], dz[:n]])
        none = np.zeros((1, 2 * n))
        return np.vstack([at_start, gradient]), np.vstack([at_end, none]), np.zeros((2 * n + 1, 1))

    tolerance = max(options.tol, COARSE_TOLERANCE) if options.polish else options.tol
    try:
        with np.errstate(all="ignore"):  # solve_bvp detects singular matrices itself
            found = solve_bvp(
                rates,
                ends,
                times,
                nodes.T,
                [1.0] if problem.horizon is None else None,  # the factor of a free horizon
                fun_jac=jacobians,
                bc_jac=end_jacobians,
                tol=tolerance,
                max_nodes=MAX_NODES,
            )
    except _DivergedError:
        return certify(problem, times, nodes, Status.DIVERGED, (), evaluations)
    mesh = found.x if found.p is None else found.x * found.p[0]
    nodes = np.ascontiguousarray(found.y.T)
    status = STATUS.get(found.status, Status.STALLED)
    if not (np.isfinite(nodes).all() and mesh[-1] > 0.0):
        return certify(problem, times, start_nodes(problem, path, times)[1], Status.DIVERGED, (), evaluations)
    residual = float(np.max(found.rms_residuals, initial=0.0))
    history = (Iteration("collocation", len(mesh) - 1, _cost(problem, mesh, nodes), residual),)
    if status is not Status.SUCCESS or not options.polish:
        return certify(problem, mesh, nodes, status, history, evaluations)
    status, rows, count = polish(problem, mesh, nodes, options.tol, options.max_iterations)
    return confirm(problem, mesh, nodes, status, (*history, *rows), evaluations + count, options)


def _cost(problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray) -> float:
    """Return J by the trapezoidal rule on the mesh, which is accurate enough for the history."""
    costs = np.empty(len(nodes))
    _rates(problem.arrays.flow, nodes, np.empty_like(nodes), costs)
    return float(np.trapezoid(costs, times))


@kernel(int64(FLOW, MATRIX, MATRIX, VECTOR))
def _rates(flow, Z, out, costs):
    """Fill the derivatives (N, 2n) and running costs (N,) at Z (N, 2n); return the number of evaluations."""
    none, d_none = np.empty((Z.shape[1], 0)), np.empty((Z.shape[1], 0))
    for k in range(len(Z)):
        costs[k] = flow.function(Z[k], flow.data, flow.field, none, out[k], d_none)
    return len(Z)


@kernel(int64(FLOW, MATRIX, CUBE))
def _jacobians(flow, Z, out):
    """Fill the Jacobians (N, 2n, 2n) of the flow at Z (N, 2n); return the number of evaluations."""
    dz, identity = np.empty(Z.shape[1]), np.empty((Z.shape[1], Z.shape[1]))
    set_identity(identity, 0)
    for k in range(len(Z)):
        flow.function(Z[k], flow.data, flow.field, identity, dz, out[k])
    return len(Z)
