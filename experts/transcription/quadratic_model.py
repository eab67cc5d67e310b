"""The quadratic model of the discretised problem about a path, and its end conditions (kernels).

A. E. Bryson and Y.-C. Ho, Applied Optimal Control (1975), section 5.3: the value function depends on the multipliers of
the end conditions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, MATRIX, VECTOR
from leapnav.experts.numerics.flow import END_CONDITION
from leapnav.experts.numerics.linear import eliminate, substitute


class Model(NamedTuple):
    """The value function of the quadratic model, and the controls that minimise it.

    At node k the value function is 1/2 dq'P dq + p'dq + dq'F nu + 1/2 nu'G nu + g'nu with the multipliers nu of the end
    conditions. The minimising controls are -(step + gain dq + end_gain nu).

    Attributes:
        P: (N + 1, n, n).
        p: (N + 1, n).
        F: (N + 1, n, n).
        step: (N, m).
        gain: (N, m, n).
        end_gain: (N, m, n).
        G: (n, n), at the first node.
        g: (n,), at the first node.

    """

    P: np.ndarray
    p: np.ndarray
    F: np.ndarray
    step: np.ndarray
    gain: np.ndarray
    end_gain: np.ndarray
    G: np.ndarray
    g: np.ndarray


MODEL = record_type(Model, P=CUBE, p=MATRIX, F=CUBE, step=MATRIX, gain=CUBE, end_gain=CUBE, G=MATRIX, g=VECTOR)


@kernel(MODEL(int64, int64, int64))
def empty_model(intervals, n, m):
    """Return a model of a path to be filled."""
    return Model(
        np.empty((intervals + 1, n, n)),
        np.empty((intervals + 1, n)),
        np.empty((intervals + 1, n, n)),
        np.empty((intervals, m)),
        np.empty((intervals, m, n)),
        np.empty((intervals, m, n)),
        np.empty((n, n)),
        np.empty(n),
    )


class Regularisation(NamedTuple):
    """Modifications that make the quadratic model convex.

    Attributes:
        shift: term added to the diagonal of the Hessian, per second.
        penalty: weight of a quadratic penalty on the end conditions. It does not change the solution, which meets them.
        convex: whether to omit the curvature of the dynamics and negative curvature of the proximity cost, for an
            initial guess far from any optimum.

    """

    shift: float
    penalty: float
    convex: bool


REGULARISATION = record_type(Regularisation, shift=float64, penalty=float64, convex=boolean)


@kernel(boolean(MATRIX, VECTOR, VECTOR, END_CONDITION, VECTOR))
def end_multipliers(G, g, last_state, end, nu):
    """Solve G nu = goal - last_state - g for the fixed components; return False if G is not negative definite."""
    n = len(g)
    extended = np.empty((n, n + 1))
    for i in range(n):
        for j in range(n):
            extended[i, j] = G[i, j]
        extended[i, n] = 0.0 if end.free[i] else end.goal[i] - last_state[i] - g[i]
        if end.free[i]:
            extended[i, i] = -1.0
    if eliminate(extended, False, 0.0) == 0.0:
        return False
    for i in range(n):
        if not extended[i, i] < 0.0:
            return False
    substitute(extended, nu)
    return True
