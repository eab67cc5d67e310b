"""Continuation: solution of a sequence of problems, each from the solution of the preceding one.

The step control is that of `leapnav.experts.numerics.step_halving`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from leapnav.envs.field.packing import blend_fields
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.problem.extremal import Extremal, SolveError
from leapnav.experts.problem.problem import OptimalControlProblem, as_problem
from leapnav.experts.solve import Method, solve


def continuation(
    problems: Iterable[OptimalControlProblem | Scenario],
    method: Method = "multiple_shooting",
    guess: Extremal | None = None,
    tol: float = 1e-9,
    *,
    smallest_step: float = 1 / 64,
    raise_on_failure: bool = False,
) -> list[Extremal]:
    """Solve a sequence of problems, each with the extremal of the preceding one as the initial guess.

    If a step fails, intermediate problems are inserted: start, goal, horizon, weights, bounds, parameters and obstacles
    are interpolated linearly between two successive problems. The step is halved after a failure and doubled after a
    success.

    Args:
        problems: problems or scenarios with the same system, state cost, free goal components and kinds of obstacles.
        method: see `solve`.
        guess: extremal of a problem similar to the first; None solves the first problem without a guess.
        tol: see `solve`.
        smallest_step: minimum step as a fraction of the change between two successive problems, in (0, 1]; the
            continuation fails if a smaller one is needed.
        raise_on_failure: raise an exception instead of returning a list that ends with a failure.

    Returns:
        An extremal for each problem, in their order; the list ends with the first failure.

    Raises:
        ValueError: two successive problems cannot be blended, or an argument is invalid.
        SolveError: failure with `raise_on_failure`; the attribute `extremal` is the failed result.

    """
    if not 0.0 < smallest_step <= 1.0:
        raise ValueError(f"smallest_step: expected a number in (0, 1], got {smallest_step!r}")
    found: list[Extremal] = []
    for index, problem in enumerate(problems):
        if found:
            extremal = _continue(found[-1], as_problem(problem), method, tol, smallest_step)
        else:
            extremal = solve(problem, method=method, guess=guess, tol=tol)
        found.append(extremal)
        if not extremal.success:
            if raise_on_failure:
                raise SolveError(extremal, f"problem {index}")
            break
    return found


def _continue(
    start: Extremal, target: OptimalControlProblem, method: Method, tol: float, smallest_step: float
) -> Extremal:
    """The extremal of the target, by continuation from the extremal `start`."""
    origin = start.problem
    blend(origin, target, 0.5)  # raises an error before any computation if the problems cannot be blended
    target = _unwind(target, start)
    failed: Extremal | None = None

    def advance(fraction: float, guess: Extremal) -> Extremal | None:
        nonlocal failed
        problem = target if fraction == 1.0 else blend(origin, target, fraction)
        extremal = solve(problem, method=method, guess=guess, tol=tol)
        if extremal.success:
            return extremal
        if fraction == 1.0:
            failed = failed or extremal
        return None

    found = step_halving(advance, start, min_step=smallest_step)
    if found is not None:
        return found
    # The failure of the target, not of an intermediate problem.
    assert failed is not None
    return failed


def _unwind(target: OptimalControlProblem, start: Extremal) -> OptimalControlProblem:
    """The target with the angles of its start and goal at the windings closest to those of an extremal."""
    target_start = list(target.start)
    for i in target.winding_states:
        target_start[i] -= 2 * math.pi * round((target_start[i] - float(start.states[0, i])) / (2 * math.pi))
    return replace(target, start=tuple(target_start)).with_winding_of(start.states)


def _sides(problem: OptimalControlProblem) -> list[tuple[int, bool]]:
    """The states with finite bounds, each with whether it is the lower one."""
    return [(limit.state, limit.slope > 0) for limit in problem.state_limits]


def blend(first: OptimalControlProblem, second: OptimalControlProblem, fraction: float) -> OptimalControlProblem:
    """Interpolate linearly between two problems.

    Args:
        first: the problem at the fraction 0.
        second: the problem at the fraction 1.
        fraction: in [0, 1].

    Raises:
        ValueError: the problems differ in more than numerical values.

    """
    if first.system != second.system or first.state_cost != second.state_cost:
        raise ValueError("problems: two successive problems differ in their system or state cost")
    if (first.horizon is None) != (second.horizon is None):
        raise ValueError(
            f"problems: only one of two successive problems has a free horizon: {first.horizon!r}, {second.horizon!r}"
        )
    if [g is None for g in first.goal] != [g is None for g in second.goal]:
        raise ValueError(
            f"problems: two successive problems differ in the free goal components: {first.goal!r}, {second.goal!r}"
        )
    if _sides(first) != _sides(second):
        raise ValueError(
            f"problems: two successive problems differ in which states have finite bounds: {first.state_bounds!r}, "
            f"{second.state_bounds!r}"
        )
    if (first.control_bounds is None) != (second.control_bounds is None) or (first.field is None) != (
        second.field is None
    ):
        raise ValueError("problems: only one of two successive problems has control bounds or obstacles")

    def between(a: float, b: float) -> float:
        return a if a == b else (1.0 - fraction) * a + fraction * b  # equal bounds may be infinite

    def between_pairs(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
        return between(a[0], b[0]), between(a[1], b[1])

    bounds, state_bounds = None, None
    if first.control_bounds is not None and second.control_bounds is not None:
        bounds = tuple(map(between_pairs, first.control_bounds, second.control_bounds))
    if first.state_bounds is not None and second.state_bounds is not None:
        pairs = zip(first.state_bounds, second.state_bounds, strict=True)
        state_bounds = tuple(None if a is None or b is None else between_pairs(a, b) for a, b in pairs)
    goal = tuple(
        None if a is None or b is None else between(a, b) for a, b in zip(first.goal, second.goal, strict=True)
    )
    field: np.ndarray | None = None
    if first.field is not None and second.field is not None:
        field = blend_fields(first.field, second.field, fraction)
    return replace(
        first,
        start=tuple(map(between, first.start, second.start)),
        goal=goal,
        horizon=None if first.horizon is None or second.horizon is None else between(first.horizon, second.horizon),
        time_weight=between(first.time_weight, second.time_weight),
        control_weight=tuple(map(between, first.control_weight, second.control_weight)),
        control_bounds=bounds,
        state_bounds=state_bounds,
        barrier_weight=between(first.barrier_weight, second.barrier_weight),
        field=field,
        parameters=tuple(map(between, first.parameters, second.parameters)),
    )
