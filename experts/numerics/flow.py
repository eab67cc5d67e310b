"""Types of the generated functions of a problem, and the records that the kernels take with them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float64, types

from leapnav.envs.kernels import record_type
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import CONSTANT, FLAGS, MATRIX, NOTHING, VECTOR

# flow(z, data, field, S, dz, dS) -> running cost: fills dz = z' and dS = S' for z = (q, lam) and S (2n, columns).
# With an explicit function type the kernels are compiled once for all systems.
FLOW_SIGNATURE = float64(VECTOR, CONSTANT, CONSTANT, MATRIX, VECTOR, MATRIX)
# control(z, data, u): fills the control u (m,) of the minimum principle.
CONTROL_SIGNATURE = NOTHING(VECTOR, CONSTANT, VECTOR)
# piece(z, data, field) -> number of the smooth piece of the flow that contains z.
PIECE_SIGNATURE = types.int64(VECTOR, CONSTANT, CONSTANT)
FLOW_FUNCTION = types.FunctionType(FLOW_SIGNATURE)
CONTROL_FUNCTION = types.FunctionType(CONTROL_SIGNATURE)
PIECE_FUNCTION = types.FunctionType(PIECE_SIGNATURE)

# affine(q, data, drift, fields): fills a(q) (n,) and B(q) (n, m).
AFFINE_SIGNATURE = NOTHING(VECTOR, CONSTANT, VECTOR, MATRIX)
# step(q, u, h, data, end): fills the state F(q, u) (n,) after a step of duration h with constant controls u (m,).
STEP_SIGNATURE = NOTHING(VECTOR, VECTOR, float64, CONSTANT, VECTOR)
# step_derivatives(q, u, h, lam, data, A, B, W): fills dF/dq (n, n), dF/du (n, m), and the Hessian (n + m, n + m) of
# lam'F in (q, u).
STEP_DERIVATIVES_SIGNATURE = NOTHING(VECTOR, VECTOR, float64, VECTOR, CONSTANT, MATRIX, MATRIX, MATRIX)
# state_cost(q, data, field, gradient, hessian) -> Phi(q): fills its gradient (n,) and Hessian (n, n).
STATE_COST_SIGNATURE = float64(VECTOR, CONSTANT, CONSTANT, VECTOR, MATRIX)
AFFINE_FUNCTION = types.FunctionType(AFFINE_SIGNATURE)
STEP_FUNCTION = types.FunctionType(STEP_SIGNATURE)
STEP_DERIVATIVES_FUNCTION = types.FunctionType(STEP_DERIVATIVES_SIGNATURE)
STATE_COST_FUNCTION = types.FunctionType(STATE_COST_SIGNATURE)


class ExtremalFlow(NamedTuple):
    """The extremal flow of a problem with its constants.

    Attributes:
        function: the compiled flow, of type FLOW_SIGNATURE.
        piece: the number of a smooth piece of the flow, of type PIECE_SIGNATURE. The derivatives of the flow are
            discontinuous where a control reaches a limit, and where the closest edge or vertex of a polygon changes.
        data: control weights (m,), lower and upper control bounds (2m,), parameters of the system, three numbers for
            each limit of a state (`leapnav.experts.numerics.state_bounds`), rows of the outline of a
            footprint.
        field: packed obstacle field; empty without obstacles.

    """

    function: FunctionPointer
    piece: FunctionPointer
    data: np.ndarray
    field: np.ndarray


class EndCondition(NamedTuple):
    """The conditions at the final time: q_i = goal_i, or lambda_i = 0 where the component is free.

    Attributes:
        goal: (n,), ignored where a component is free.
        free: (n,), bool.
        free_time: whether the final time is free; the Hamiltonian, which is constant, is then 0.

    """

    goal: np.ndarray
    free: np.ndarray
    free_time: bool


class NewtonOptions(NamedTuple):
    """Options of the Newton kernels.

    Attributes:
        tolerance: largest residual.
        accuracy: tolerance of the integrator close to the solution.
        max_iterations: largest number of Newton steps.
        adaptive: whether the accuracy of the integrator follows the residual, and that of the last iterate may be
            predicted from quadratic convergence.

    """

    tolerance: float
    accuracy: float
    max_iterations: int
    adaptive: bool = True


FLOW = record_type(ExtremalFlow, function=FLOW_FUNCTION, piece=PIECE_FUNCTION, data=CONSTANT, field=CONSTANT)
END_CONDITION = record_type(EndCondition, goal=VECTOR, free=FLAGS, free_time=types.boolean)
NEWTON_OPTIONS = record_type(
    NewtonOptions, tolerance=float64, accuracy=float64, max_iterations=types.int64, adaptive=types.boolean
)
