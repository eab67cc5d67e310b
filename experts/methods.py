"""`solve`: one problem, one method, one extremal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any, Literal

import numpy as np

from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import failure
from leapnav.experts.collocation import collocation
from leapnav.experts.extremal import Extremal, SolveError, Status
from leapnav.experts.initial_path import initial_paths
from leapnav.experts.lattice import Lattice
from leapnav.experts.leapfrog import leapfrog
from leapnav.experts.multiple_shooting import multiple_shooting
from leapnav.experts.nodes import FEWEST_SEGMENTS, Settings
from leapnav.experts.problem import OptimalControlProblem, Path, as_problem
from leapnav.experts.single_shooting import single_shooting

Method = Literal["single_shooting", "multiple_shooting", "leapfrog", "collocation"]
METHODS: dict[str, Callable[[OptimalControlProblem, Path, Settings], Extremal]] = {
    "single_shooting": single_shooting,
    "multiple_shooting": multiple_shooting,
    "leapfrog": leapfrog,
    "collocation": collocation,
}
# Of the paths found where no guess is given: so many are solved, unless dearer than the best by this share.
TRIED, NEARLY = 4, 0.05
POINTS_PER_SEGMENT = 8  # of an extremal that serves as a guess


def solve(
    problem: OptimalControlProblem | Scenario,
    method: Method = "leapfrog",
    guess: Path | Extremal | None = None,
    tol: float = 1e-9,
    max_iterations: int = 60,
    segments: int | None = None,
    *,
    polish: bool = True,
    update: Literal["mean_time", "half_cost"] = "mean_time",
    order: Literal["sequential", "red_black"] = "sequential",
    raise_on_failure: bool = False,
) -> Extremal:
    """Solves the boundary value problem of the minimum principle: one certified extremal, not the global optimum.

    Args:
        problem: an optimal control problem, or a scenario.
        method: "leapfrog", "multiple_shooting", "single_shooting" or "collocation".
        guess: a path, whose costates are estimated from its motion if it has none, or an extremal (of a problem with
            another horizon, goal or obstacle). None: for a scenario the best path of the lattice search; for a problem
            the cheapest of several local minima on piecewise constant controls, neighbouring windings of goal angles
            included.
        tol: largest residual of the boundary and continuity conditions; the certificate asks for 1e-8 in any case.
        max_iterations: of Newton's method.
        segments: shooting segments, Leapfrog's nodes, collocation's first mesh; None chooses them from the guess, and
            lets multiple shooting divide those that need it.
        polish: end Leapfrog and collocation with multiple-shooting Newton steps, which is much faster; else Leapfrog
            reduces its nodes until the last sub-problem is the whole problem, and collocation goes on to `tol`.
        update: where Leapfrog moves a node on its sub-problem's extremal.
        order: of the nodes in a Leapfrog sweep; "red_black" moves the odd ones, which do not depend on each other, and
            then the even ones.
        raise_on_failure: raise an exception instead of returning a failure.

    Returns:
        An `Extremal` whose status comes from its certificate.

    Raises:
        ValueError, TypeError: an argument is impossible; the message names it.
        SolveError: `raise_on_failure`, and there is no success; its `extremal` is the failed result.

    """
    settings = _settings(method, tol, max_iterations, segments, polish, update, order)
    task = as_problem(problem)
    if guess is not None:
        task, path, settings = _from_guess(task, guess, settings)
        extremal = METHODS[method](task, path, settings)
    elif isinstance(problem, Scenario):
        candidate = next(Lattice(problem).candidates(), None)
        if candidate is None:
            extremal = failure(task, Status.NO_PATH)
        else:
            path = Path(candidate.times, candidate.poses)
            extremal = METHODS[method](task.with_winding_of(path.states), path, settings)
    else:
        extremal = _without_guess(METHODS[method], task, settings)
    if raise_on_failure and not extremal.success:
        raise SolveError(extremal, problem.name if isinstance(problem, Scenario) else "")
    return extremal


def _without_guess(
    solver: Callable[[OptimalControlProblem, Path, Settings], Extremal],
    problem: OptimalControlProblem,
    settings: Settings,
) -> Extremal:
    """The cheapest success from the most promising paths; the last resort is the straight line."""
    best: Extremal | None = None
    failed: list[Extremal] = []
    for wound, path in islice(initial_paths(problem), TRIED):
        extremal = solver(wound, path, settings)
        if not extremal.success:
            failed.append(extremal)
        elif best is None or extremal.cost < best.cost:
            best = extremal
        elif extremal.cost > best.cost + NEARLY * abs(best.cost):
            break
    if best is not None:
        return best
    line = problem.straight_line()
    failed.append(solver(problem.with_winding_of(line.states), line, settings))
    if failed[-1].success:
        return failed[-1]
    # One that converged says more than one that did not.
    converged = [extremal for extremal in failed if extremal.status in (Status.CONJUGATE_POINT, Status.COLLISION)]
    return (converged or failed)[0]


def _from_guess(
    problem: OptimalControlProblem, guess: Path | Extremal, settings: Settings
) -> tuple[OptimalControlProblem, Path, Settings]:
    """Problem (with the guess's winding), path and settings for a guess."""
    if isinstance(guess, Extremal):
        if len(guess.times) == 0:
            raise ValueError(f"guess: the extremal has no path: {guess.status.value}")
        n, expected = guess.states.shape[1], problem.system.n
        if n != expected:
            raise ValueError(f"guess: the extremal has {n} states, the problem {expected}")
        if settings.segments is None and guess.nodes > 2:
            settings = replace(settings, segments=guess.nodes - 1)
        points = POINTS_PER_SEGMENT * (settings.segments or FEWEST_SEGMENTS) + 1
        values = guess.interpolate(np.linspace(0.0, guess.times[-1], points))
        # Another horizon stretches the path.
        path = Path(np.linspace(0.0, problem.horizon, points), values[:, :n], values[:, n:])
    elif isinstance(guess, Path):
        path = _checked(guess, problem)
    else:
        raise TypeError(f"guess: expected a Path or an Extremal, got {type(guess).__name__}")
    return problem.with_winding_of(path.states), path, settings


def _settings(
    method: str, tol: float, max_iterations: int, segments: int | None, polish: bool, update: Any, order: Any
) -> Settings:
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if not (math.isfinite(tol) and tol > 0):
        raise ValueError(f"tol: expected a positive number, got {tol!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations: expected at least 1, got {max_iterations!r}")
    if segments is not None:
        if not isinstance(segments, (int, np.integer)) or segments < 1:
            raise ValueError(f"segments: expected a whole number of at least 1, got {segments!r}")
        segments = int(segments)
    if update not in ("mean_time", "half_cost"):
        raise ValueError(f"update: expected 'mean_time' or 'half_cost', got {update!r}")
    if order not in ("sequential", "red_black"):
        raise ValueError(f"order: expected 'sequential' or 'red_black', got {order!r}")
    return Settings(tol, max_iterations, segments, polish, update, order)


def _checked(guess: Path, problem: OptimalControlProblem) -> Path:
    n = problem.system.n
    costates = None if guess.costates is None else np.asarray(guess.costates, dtype=float)
    path = Path(np.asarray(guess.times, dtype=float), np.asarray(guess.states, dtype=float), costates)
    times = path.times
    if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) > 0):
        raise ValueError("guess: its times must be an increasing array of at least two")
    if abs(times[0]) > 1e-6 * problem.horizon or abs(times[-1] - problem.horizon) > 1e-6 * problem.horizon:
        raise ValueError(f"guess: its times must run from 0 to {problem.horizon:g}, not {times[0]:g} to {times[-1]:g}")
    for name, array in (("states", path.states), ("costates", path.costates)):
        if array is not None and array.shape != (len(times), n):
            raise ValueError(f"guess: its {name} must have shape {(len(times), n)}, got {array.shape}")
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"guess: its {name} are not finite")
    return path
