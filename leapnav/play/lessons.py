"""The lessons of `leapnav play`, as plain numbers and sentences: three solvers on one scenario, and a conjugate point.

Every number is computed when a lesson is opened. The sentences describe the computed numbers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.caching import computed_once
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.initial_guess import best_path
from leapnav.experts.solve import solve
from leapnav.experts.solvers.feasible_path import dense_path
from leapnav.experts.solvers.multiple_shooting import polish
from leapnav.experts.solvers.nodes import start_nodes
from leapnav.experts.solvers.single_shooting import segment

# ---- Lesson 1: three methods from the same initial guess

# In this scenario single shooting fails from the lattice path, and the two other methods converge to the optimum.
METHODS_SCENARIO = Scenario(
    name="three methods",
    arena=(0, 0, 8, 6),
    start=(1, 2.2, 0),
    goal=(7, 2.1, 0),
    horizon=7,
    obstacles=({"circle": {"center": (2.5, 3.9), "radius": 0.6}}, {"circle": {"center": (4.6, 3.15), "radius": 0.8}}),
    cost={"proximity_scale": 0.3},
)
SEGMENTS = 8  # of multiple shooting and of Leapfrog's first path
TOLERANCE = 1e-9  # of Newton's method
MAX_NEWTON_STEPS = 30
PATH_POINTS = 121  # of each path

# ---- Lesson 2: a local minimum with two cusps, followed while the goal is rotated

FOLLOWED_HEADINGS = (0.5, 0.4, 0.3, 0.2, 0.1, 0.0, -0.1, -0.15)  # rad, of the goal; the fold follows
RETURN_HEADINGS = (-0.15, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4)  # rad, along the branch of the saddles
LOST_HEADING = -0.25  # rad, beyond the fold
FOLD_TOLERANCE = 1e-4  # rad
FOLD_DISTANCE = 0.01  # rad from the fold at which the second branch is found
SAME_BRANCH = 0.05  # largest change of the cost per step along a branch
MINIMUM = "No conjugate point lies before the horizon, so the extremal is a local minimum (Jacobi's condition)."
EXTENSION = 2.0  # the extremal is continued to this multiple of the horizon, to find its conjugate point


@computed_once()
def compare_methods() -> dict[str, Any]:
    """Solve one scenario by single shooting, multiple shooting and Leapfrog from the same initial guess.

    Returns:
        A dictionary: `scenario`, `optimum` (cost, states), and `methods`, each with `name`, `status` and `iterates`.
        An iterate has `cost`, `residual`, `miss` (distance (m) from the end of the path to the goal), `jump` (largest
        distance (m) between the end of a piece and the start of the next), `pieces` (states of each segment, up to
        where the flow diverges) and `nodes` (x, y). `steps` contains the title and the explanation of each iteration.

    """
    scenario = METHODS_SCENARIO
    problem = OptimalControlProblem.from_scenario(scenario)
    guess = best_path(scenario)
    assert guess is not None
    problem = problem.with_winding_of(guess.states)
    times, nodes = start_nodes(problem, guess, SEGMENTS)
    optimum = find_optimum(scenario)
    methods = [
        _shooting("single shooting", problem, *segment(problem, nodes[0], problem.fixed_horizon)),
        _shooting("multiple shooting", problem, times, nodes),
        _leapfrog(scenario, guess),
    ]
    count = max(len(method["iterates"]) for method in methods)
    return {
        "title": "Single shooting, multiple shooting and Leapfrog",
        "scenario": scenario.to_dict(),
        "guess": _rows(guess.states),
        "optimum": {"cost": optimum.cost, "states": _states(optimum)},
        "methods": methods,
        "steps": [_describe_iteration(k, methods, optimum.cost) for k in range(count)],
    }


def _shooting(name: str, problem: OptimalControlProblem, times: np.ndarray, guess: np.ndarray) -> dict[str, Any]:
    """The iterates of Newton's method on all nodes (segments + 1, 2n)."""
    iterates: list[dict[str, Any]] = []
    status = Status.MAX_ITERATIONS
    for limit in range(MAX_NEWTON_STEPS + 1):
        nodes = guess.copy()
        # Over the whole horizon, the first extremal cannot be integrated with the fine accuracy.
        status, rows, _ = polish(problem, times, nodes, TOLERANCE, limit, fine=len(times) > 2)
        if len(rows) <= limit:
            break
        iterates.append(_iterate(problem, times, nodes, rows[-1].cost, rows[-1].residual))
        if status is Status.SUCCESS:
            break
    return {"name": name, "status": "converged" if status is Status.SUCCESS else "stalled", "iterates": iterates}


def _leapfrog(scenario: Scenario, guess: Trajectory) -> dict[str, Any]:
    """The sweeps of Leapfrog without Newton's method."""
    extremal = solve(scenario, "leapfrog", guess, polish=False, segments=SEGMENTS)
    iterates = [
        _iterate(extremal.problem, row.times, row.nodes, row.cost, row.residual)
        for row in extremal.history
        if row.times is not None and row.nodes is not None
    ]
    return {"name": "Leapfrog", "status": "converged" if extremal.success else "stalled", "iterates": iterates}


def _iterate(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, cost: float, residual: float
) -> dict[str, Any]:
    """An iterate with its path, integrated from each node to the next, or to where the flow diverges."""
    _, states = dense_path(problem, times, nodes, PATH_POINTS)
    pieces = [piece[np.isfinite(piece).all(1)] for piece in np.split(states, len(times) - 1)]
    jumps = [math.dist(before[-1, :2], after[0, :2]) for before, after in itertools.pairwise(pieces)]
    miss = math.dist(pieces[-1][-1, :2], problem.arrays.goal[:2])
    return {
        "cost": float(cost),
        "residual": float(residual),
        "miss": round(miss, 6),
        "jump": round(max(jumps, default=0.0), 6),
        "pieces": [_rows(piece, 4) for piece in pieces],
        "nodes": _rows(nodes[:, :2], 4),
    }


def _describe_iteration(k: int, methods: list[dict[str, Any]], best: float) -> dict[str, str]:
    """Title and explanation of iteration k; a method that has ended keeps its last iterate."""
    single, multiple, leapfrog = (method["iterates"][min(k, len(method["iterates"]) - 1)] for method in methods)
    ended = [k >= len(method["iterates"]) for method in methods]
    if k == 0:
        text = (
            "All three methods start from the same path of a lattice search. Single shooting integrates the extremal "
            f"from the estimated initial costate; it misses the goal by {single['miss']:.1f} m. Multiple shooting "
            f"integrates {SEGMENTS} segments from their nodes; the pieces are not connected. Leapfrog connects the "
            f"nodes by extremal arcs: its first path is feasible, and its cost is {_excess(leapfrog, best)} above the "
            "optimum."
        )
        return {"title": "The initial guess", "text": text}
    first = (
        "Single shooting stalled: no Newton step reduces its residual, and it misses the goal by "
        f"{single['miss']:.1f} m. "
        if ended[0]
        else f"Single shooting misses the goal by {single['miss']:.1f} m, because a change of the initial costate is "
        "amplified along the horizon. "
    )
    if multiple["residual"] <= TOLERANCE:
        second = f"Multiple shooting converged: the largest defect is {multiple['residual']:.0e}. "
    else:
        second = (
            f"Multiple shooting: the largest defect is {multiple['residual']:.1e}, the largest jump at a node "
            f"{multiple['jump']:.3f} m. "
        )
    third = (
        f"Leapfrog converged, {_excess(leapfrog, best)} above the optimum."
        if k >= len(methods[2]["iterates"]) - 1
        else f"Leapfrog: the path is feasible, {_excess(leapfrog, best)} above the optimum, and a sweep never "
        "increases its cost."
    )
    return {"title": f"Iteration {k}", "text": first + second + third}


def _excess(iterate: dict[str, Any], best: float) -> str:
    percent = 100.0 * (iterate["cost"] / best - 1.0)
    return f"{percent:.2g} %" if percent > 0.001 else "less than 0.001 %"


def cusp_scenario(heading: float) -> Scenario:
    """Return the scenario of the second lesson.

    Args:
        heading: heading of the goal (rad).

    """
    return Scenario(
        name="conjugate point", arena=(-4, -3, 3, 4), start=(0, 0, 0), goal=(-0.95, 1.45, heading), horizon=8
    )


@computed_once()
def follow_minimum() -> dict[str, Any]:
    """Follow a local minimum to the fold at which it is lost, and return along the branch of saddles.

    Returns:
        A dictionary: `title`, `scenario` and `steps`. A step has `heading` of the goal (rad), `branch` ("minimum",
        "saddle" or "lost"), `status` of the solve, `cost`, `conjugate_time` (s) of the extremal continued beyond its
        horizon (None if there is none), `states`, `optimum` (cost, states), `goal`, `title` and `text`.

    """
    (followed,) = find_optimum(cusp_scenario(FOLLOWED_HEADINGS[0])).alternatives
    minima: list[tuple[float, Extremal]] = [(FOLLOWED_HEADINGS[0], followed)]
    for heading in FOLLOWED_HEADINGS[1:]:
        minima.append((heading, _resolve(heading, minima[-1][1])))
    fold, last = _find_fold(*minima[-1])
    minima.append((fold, last))
    saddles: list[tuple[float, Extremal]] = [(fold + FOLD_DISTANCE, _find_saddle(fold, last))]
    for heading in RETURN_HEADINGS:
        saddles.append((heading, _resolve(heading, saddles[-1][1])))
    steps = [_step(heading, "minimum", extremal) for heading, extremal in minima]
    steps[0]["text"] = (
        "A local minimum with two cusps; the global optimum (orange) has one. As the goal is rotated clockwise, the "
        "local minimum is re-solved from the one before it. Its conjugate point is found by integrating the extremal "
        f"beyond the horizon: here at {steps[0]['conjugate_time']:.2f} s, later than the horizon of 8 s. " + MINIMUM
    )
    steps[-1]["title"] = f"The fold, at a heading of {fold:.3f} rad"
    steps[-1]["text"] = (
        f"The conjugate point, at {steps[-1]['conjugate_time']:.2f} s, has almost reached the horizon of 8 s. There "
        "the local minimum meets a saddle of the cost, and both vanish."
    )
    steps.append(_lost_step(last))
    steps += [_step(heading, "saddle", extremal) for heading, extremal in saddles]
    return {"title": "A conjugate point: how a local minimum is lost", "scenario": steps[0]["scenario"], "steps": steps}


def _resolve(heading: float, guess: Extremal) -> Extremal:
    return solve(cusp_scenario(heading), "multiple_shooting", guess)


def _find_fold(heading: float, extremal: Extremal) -> tuple[float, Extremal]:
    """Return the last heading at which the minimum exists, to FOLD_TOLERANCE, and the minimum there."""
    step = heading - LOST_HEADING
    while step > FOLD_TOLERANCE:
        trial = _resolve(heading - step, extremal)
        if trial.success and abs(trial.cost - extremal.cost) < SAME_BRANCH:
            heading, extremal = heading - step, trial
        else:
            step /= 2
    return heading, extremal


def _find_saddle(fold: float, last: Extremal) -> Extremal:
    """Return the saddle at FOLD_DISTANCE from the fold.

    Near a fold, the two branches differ from the solution at the fold by plus and minus c sqrt(distance). So the minima
    at FOLD_DISTANCE and at four times that distance determine c, and the saddle to first order.
    """
    near = _resolve(fold + FOLD_DISTANCE, last)
    far = _resolve(fold + 4 * FOLD_DISTANCE, near)
    times = np.linspace(0.0, near.horizon, PATH_POINTS)
    at_near, at_far = near.interpolate(times), far.interpolate(times)
    guess = at_near + 2.0 * (at_near - at_far)
    n = near.states.shape[1]
    return solve(
        cusp_scenario(fold + FOLD_DISTANCE), "multiple_shooting", Trajectory(times, guess[:, :n], guess[:, n:])
    )


def conjugate_time(extremal: Extremal) -> float | None:
    """Return the first conjugate time (s) of an extremal, also if it is later than the horizon.

    Args:
        extremal: an extremal without free final components.

    Returns:
        The time; None if there is none up to EXTENSION times the horizon.

    """
    horizon = extremal.horizon
    longer = replace(extremal.problem, horizon=EXTENSION * horizon)
    ends = np.concatenate([extremal.states[[0, -1]], extremal.costates[[0, -1]]], axis=1)
    # The last node only marks the end of the integration, so it may have any value.
    nodes = np.concatenate([ends, ends[-1:]])
    times = np.array([0.0, horizon, longer.fixed_horizon])
    certificate = certify(longer, times, nodes, Status.MAX_ITERATIONS).certificate
    return None if certificate is None else certificate.conjugate_point


def _step(heading: float, branch: str, extremal: Extremal) -> dict[str, Any]:
    """A step of the second lesson on one of the branches."""
    optimum = find_optimum(cusp_scenario(heading))
    time, horizon = conjugate_time(extremal), extremal.horizon
    shown = "none" if time is None else f"at {time:.2f} s"
    if branch == "minimum":
        text = f"Conjugate point {shown}, horizon {horizon:g} s. {MINIMUM}"
    else:
        text = (
            "The second branch of extremals, on the way back from the fold. Its conjugate point (the dot), "
            f"{shown}, is before the horizon of {horizon:g} s: the extremal is a saddle, and paths close to it cost "
            f"less. Its certificate has the status {extremal.status.name}."
        )
    return _fields(heading, branch, extremal, optimum, time, f"Heading {heading:.2f} rad: a {branch}", text)


def _lost_step(last: Extremal) -> dict[str, Any]:
    """The step beyond the fold: Newton's method has no solution nearby, and Leapfrog descends to the optimum."""
    scenario = cusp_scenario(LOST_HEADING)
    newton = _resolve(LOST_HEADING, last)
    descent = solve(scenario, "leapfrog", last, polish=False)
    sweeps = [row for row in descent.history if row.times is not None]
    text = (
        f"Beyond the fold no extremal is close to the last one. Newton's method from it ends with the status "
        f"{newton.status.name}. Leapfrog from the same path decreases the cost at each sweep, from "
        f"{sweeps[0].cost:.4f} to {sweeps[-1].cost:.4f}, that of the global optimum: the local minimum is lost."
    )
    fields = _fields(LOST_HEADING, "lost", descent, find_optimum(scenario), None, "Beyond the fold", text)
    return {**fields, "status": newton.status.name, "sweep_costs": [row.cost for row in sweeps]}


def _fields(
    heading: float,
    branch: str,
    extremal: Extremal,
    optimum: Extremal,
    time: float | None,
    title: str,
    text: str,
) -> dict[str, Any]:
    scenario = cusp_scenario(heading).to_dict()
    return {
        "heading": round(heading, 6),
        "scenario": scenario,
        "goal": scenario["goal"],
        "branch": branch,
        "status": extremal.status.name,
        "cost": extremal.cost,
        "conjugate_time": time,
        "horizon": extremal.horizon,
        "states": _states(extremal),
        "optimum": {"cost": optimum.cost, "states": _states(optimum)},
        "title": title,
        "text": text,
    }


LESSONS: dict[str, Callable[[], dict[str, Any]]] = {"methods": compare_methods, "conjugate": follow_minimum}


def _states(extremal: Extremal) -> list[list[float]]:
    return _rows(extremal.interpolate(np.linspace(0.0, extremal.horizon, PATH_POINTS))[:, :3], 4)


def _rows(array: np.ndarray, digits: int = 6) -> list[list[float]]:
    return np.round(array, digits).tolist()
