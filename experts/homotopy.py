"""Continuation: a sequence of problems, each solved from the solution of the one before, with step control.

E. L. Allgower and K. Georg, Numerical Continuation Methods, Springer (1990), ch. 2 (embedding with an adaptive step).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from leapnav.envs.fields import blend_fields
from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal, SolveError
from leapnav.experts.methods import Method, solve
from leapnav.experts.problem import OptimalControlProblem, as_problem

GROWTH = 2.0  # of the step after a success; a failure halves it


def continuation(
    problems: Iterable[OptimalControlProblem | Scenario],
    method: Method = "multiple_shooting",
    guess: Extremal | None = None,
    tol: float = 1e-9,
    *,
    smallest_step: float = 1 / 64,
    raise_on_failure: bool = False,
) -> list[Extremal]:
    """Solves problem after problem, each from the extremal of the one before.

    Where that fails, problems in between are put in: start, goal, horizon, weights, bounds, parameters and obstacles
    go linearly from one problem to the next, by steps that are halved when they fail and grow again when they succeed.

    Args:
        problems: of one system and one state cost, with the same components of the goal free and the same kinds of
            obstacles; scenarios, or problems.
        method: as in `solve`.
        guess: an extremal of a problem near the first; None solves the first from nothing.
        tol: as in `solve`.
        smallest_step: of the way from one problem to the next, 0 < smallest_step <= 1; a smaller step is a failure.
        raise_on_failure: raise an exception instead of ending with a failure.

    Returns:
        An extremal for each problem, in their order; it ends with the first failure.

    Raises:
        ValueError: two successive problems cannot be blended, or an argument is impossible.
        SolveError: `raise_on_failure`, and a problem could not be solved; its `extremal` is the failed result.

    """
    if not 0.0 < smallest_step <= 1.0:
        raise ValueError(f"smallest_step: expected a number in (0, 1], got {smallest_step!r}")
    found: list[Extremal] = []
    for number, problem in enumerate(problems):
        if found:
            extremal = _walk(found[-1], as_problem(problem), method, tol, smallest_step)
        else:
            extremal = solve(problem, method=method, guess=guess, tol=tol)
        found.append(extremal)
        if not extremal.success:
            if raise_on_failure:
                raise SolveError(extremal, f"problem {number}")
            break
    return found


def _walk(start: Extremal, target: OptimalControlProblem, method: Method, tol: float, smallest_step: float) -> Extremal:
    """The extremal of the target, by problems between it and that of `start`."""
    origin, here = start.problem, start
    target = _unwind(target, start)
    blend(origin, target, 0.5)  # names what cannot be blended before any work is done
    reached, step, first = 0.0, 1.0, None
    while True:
        share = min(1.0, reached + step)
        problem = target if share == 1.0 else blend(origin, target, share)
        extremal = solve(problem, method=method, guess=here, tol=tol)
        if share == 1.0:
            if extremal.success:
                return extremal
            first = first or extremal
        if extremal.success:
            reached, here = share, extremal
            step *= GROWTH
        else:
            step /= 2.0
            if step < smallest_step:
                # The failure of the target itself, not of a problem on the way.
                assert first is not None
                return first


def _unwind(target: OptimalControlProblem, start: Extremal) -> OptimalControlProblem:
    """The target with its angles at the windings nearest to those of an extremal, start and goal alike."""
    begin = list(target.start)
    for symbol in target.system.angles:
        i = target.system.state.index(symbol)
        begin[i] -= 2 * math.pi * round((begin[i] - float(start.states[0, i])) / (2 * math.pi))
    return replace(target, start=tuple(begin)).with_winding_of(start.states)


def blend(first: OptimalControlProblem, second: OptimalControlProblem, share: float) -> OptimalControlProblem:
    """The problem at `share` of the way from the first (0) to the second (1).

    Raises:
        ValueError: they differ in more than numbers.

    """
    if first.system != second.system or first.state_cost != second.state_cost:
        raise ValueError("problems: two successive ones differ in their system or state cost")
    if [g is None for g in first.goal] != [g is None for g in second.goal]:
        raise ValueError(f"problems: two successive ones differ in what is free: {first.goal!r} and {second.goal!r}")
    if (first.control_bounds is None) != (second.control_bounds is None) or (first.field is None) != (
        second.field is None
    ):
        raise ValueError("problems: of two successive ones only one has control bounds or obstacles")

    def between(a: float, b: float) -> float:
        return a if a == b else (1.0 - share) * a + share * b  # equal bounds may be infinite

    bounds = None
    if first.control_bounds is not None and second.control_bounds is not None:
        pairs = zip(first.control_bounds, second.control_bounds, strict=True)
        bounds = tuple((between(a[0], b[0]), between(a[1], b[1])) for a, b in pairs)
    goal = tuple(
        None if a is None or b is None else between(a, b) for a, b in zip(first.goal, second.goal, strict=True)
    )
    field: np.ndarray | None = None
    if first.field is not None and second.field is not None:
        field = blend_fields(first.field, second.field, share)
    return replace(
        first,
        start=tuple(map(between, first.start, second.start)),
        goal=goal,
        horizon=between(first.horizon, second.horizon),
        control_weight=tuple(map(between, first.control_weight, second.control_weight)),
        control_bounds=bounds,
        field=field,
        parameters=tuple(map(between, first.parameters, second.parameters)),
    )
