"""Numerical continuation with an adaptive step, from a known solution to the solution of another problem.

E. L. Allgower and K. Georg, Numerical Continuation Methods, Springer (1990), ch. 2 (embedding with an adaptive step).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Solution = TypeVar("Solution")

GROWTH = 2.0  # factor of the step after a success; a failure halves it


def step_halving(
    advance: Callable[[float, Solution], Solution | None],
    start: Solution,
    *,
    first_step: float = 1.0,
    max_step: float = 1.0,
    min_step: float,
) -> Solution | None:
    """Follow a solution from the parameter value 0 to 1, with step size control.

    Args:
        advance: solves the problem at a parameter value in (0, 1] from the last solution; returns None if that fails.
        start: the solution at 0.
        first_step: first step of the parameter.
        max_step: largest step.
        min_step: smallest step; if it fails, the continuation fails.

    Returns:
        The solution at 1, or None if it was not reached.

    """
    value, step, solution = 0.0, first_step, start
    while value < 1.0:
        target = min(1.0, value + step)
        found = advance(target, solution)
        if found is not None:
            value, solution = target, found
            step = min(GROWTH * step, max_step)
        else:
            step /= 2.0
            if step < min_step:
                return None
    return solution
