"""Switching functions B(q)'lambda of a robot model for many states, in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from leapnav.envs.robots import RobotModel


def switching_functions(
    model: type[RobotModel], states: np.ndarray, costates: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return the switching functions B(q)'lambda, the derivatives of lambda'q' with respect to the controls.

    Args:
        model: the robot's model.
        states (N, n): states.
        costates (N, n): costates.
        parameters (N, k): parameters of the dynamics.

    Returns:
        An array (N, m).

    """
    functions, count = _functions(model), len(states)
    arguments = (*states.T, *costates.T, *parameters.reshape(count, -1).T)
    return np.stack([np.broadcast_to(function(*arguments), count) for function in functions], axis=1)


@cache
def _functions(model: type[RobotModel]) -> list[Callable[..., np.ndarray]]:
    """Return the switching functions of (q, lambda, parameters)."""
    import sympy as sp

    dynamics = model.dynamics()
    costate = sp.symbols(f"costate:{len(dynamics.state)}")
    arguments = (*dynamics.state, *costate, *dynamics.parameters)
    products = [sum(sp.sympify(b) * p for b, p in zip(field, costate, strict=True)) for field in dynamics.fields]
    return [sp.lambdify(arguments, product, modules="numpy") for product in products]
