"""Limits of states, as a barrier in the running cost.

The exact theory (A. E. Bryson, W. F. Denham, S. E. Dreyfus, Optimal programming problems with inequality constraints I,
AIAA Journal 1, 1963) requires that the sequence of the arcs on limits is known in advance. The barrier does not: each
limit adds the barrier weight times b(d / scale) to the running cost, where d is the distance of the state from the
limit, see `leapnav.envs.field.barrier`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64

from leapnav.envs.field.barrier import barrier
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, VECTOR, tuple_of

# Scale of a barrier, relative to the width of the interval or, for a limit on one side, to the largest distance of
# start and goal from it. The optimum for a vanishing weight does not depend on it.
RELATIVE_SCALE = 0.1
CONTACT = 1e-4  # scales, below which the barrier is a quadratic polynomial
MARGIN = 3e-3  # see `move_inside`; with 1e-4, a search from the limit fails, with 1e-3 one of 8 misses the optimum
ENTRIES = 3  # numbers per limit in the data of a flow


class StateLimit(NamedTuple):
    """One limit of a state.

    Attributes:
        state: index of the state.
        bound: the limit.
        slope: derivative of distance / scale with respect to the state: 1 / scale for a lower limit, -1 / scale for an
            upper one.

    """

    state: int
    bound: float
    slope: float


def check_state_bounds(
    bounds: Any, start: Sequence[float], goal: Sequence[float | None]
) -> tuple[tuple[float, float] | None, ...]:
    """Return state bounds as floats, with None for states without limits.

    Raises:
        ValueError: they are not a pair or None for each state, or start and goal are not between them.

    """
    n = len(start)
    if not isinstance(bounds, (Sequence, np.ndarray)) or isinstance(bounds, str) or len(bounds) != n:
        raise ValueError(f"state_bounds: expected {n} entries, a pair or None for each state, got {bounds!r}")
    checked: list[tuple[float, float] | None] = []
    for i, pair in enumerate(bounds):
        if pair is None:
            checked.append(None)
            continue
        try:
            low, high = map(float, pair)
        except (TypeError, ValueError):
            raise ValueError(f"state_bounds[{i}]: expected a pair (lowest, highest) or None, got {pair!r}") from None
        if not low < high or low == math.inf or high == -math.inf:
            raise ValueError(f"state_bounds[{i}]: expected lowest < highest, got ({low!r}, {high!r})")
        for name, value in (("start", start[i]), ("goal", goal[i])):
            if value is not None and not low < value < high:
                raise ValueError(
                    f"{name}[{i}]: expected a number between the state bounds {low!r} and {high!r}, not on them, since "
                    f"the barrier is infinite there, got {value!r}"
                )
        checked.append((low, high) if math.isfinite(low) or math.isfinite(high) else None)
    return tuple(checked)


def move_inside(bounds: Sequence[tuple[float, float] | None] | None, state: Sequence[Any]) -> tuple[Any, ...]:
    """Return a state, moved off its bounds by MARGIN of their distance; a robot may be at its limits."""

    def moved(value: Any, pair: tuple[float, float] | None) -> Any:
        if pair is None or value is None:
            return value
        margin = MARGIN * (pair[1] - pair[0])
        return min(max(value, pair[0] + margin), pair[1] - margin)

    return tuple(state) if bounds is None else tuple(map(moved, state, bounds))


def state_limits(
    bounds: Sequence[tuple[float, float] | None], start: Sequence[float], goal: Sequence[float | None]
) -> tuple[StateLimit, ...]:
    """Return the finite limits of checked state bounds."""
    limits: list[StateLimit] = []
    for i, pair in enumerate(bounds):
        if pair is None:
            continue
        low, high = pair
        ends = [value for value in (start[i], goal[i]) if value is not None]
        for bound, sign in ((low, 1.0), (high, -1.0)):
            if math.isfinite(bound):
                reach = high - low if math.isfinite(high - low) else max(abs(value - bound) for value in ends)
                limits.append(StateLimit(i, bound, sign / (RELATIVE_SCALE * reach)))
    return tuple(limits)


def state_margin(limits: Sequence[StateLimit], states: np.ndarray) -> float:
    """Return the smallest distance of states (K, n) from limits, relative to the length that defines the scale.

    It is negative beyond a limit, and infinite without limits.
    """
    margins = [float(((states[:, state] - bound) * slope).min()) for state, bound, slope in limits]
    return RELATIVE_SCALE * min(margins, default=math.inf)


@kernel(tuple_of(*[float64] * 3)(float64, CONSTANT, int64))
def limit_cost(x, data, at):
    """Return the running cost of a limit of a state x with its first and second derivative.

    Args:
        x: the state.
        data: from the index `at` on the limit, the slope (see `StateLimit`) and the barrier weight.
        at: see `data`.

    """
    slope, weight = data[at + 1], data[at + 2]
    value, first, second = barrier((x - data[at]) * slope, CONTACT)
    return weight * value, weight * slope * first, weight * slope * slope * second


@kernel(VECTOR(VECTOR, CONSTANT))
def limit_costs(x, data):
    """Return the running costs (K,) of a limit, whose data are those of `limit_cost`, at values (K,) of the state."""
    costs = np.empty(len(x))
    for k in range(len(x)):
        costs[k] = limit_cost(x[k], data, 0)[0]
    return costs
