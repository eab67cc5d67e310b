"""`solve`: one problem, one path, one method."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from leapnav.envs.scenario import Scenario
from leapnav.experts import leapfrog as leapfrog_kernels
from leapnav.experts import multiple_shooting as multiple_shooting_kernels
from leapnav.experts import single_shooting as single_shooting_kernels
from leapnav.experts.certificate import certify, failure
from leapnav.experts.extremal import Extremal, Iteration, Status
from leapnav.experts.lattice import Lattice
from leapnav.experts.problem import OptimalControlProblem, Path, as_problem

Method = Literal["single_shooting", "multiple_shooting", "leapfrog"]

STATUS = {
    single_shooting_kernels.CONVERGED: Status.SUCCESS,
    single_shooting_kernels.STALLED: Status.STALLED,
    single_shooting_kernels.DIVERGED: Status.DIVERGED,
    single_shooting_kernels.SINGULAR: Status.SINGULAR,
    single_shooting_kernels.MAX_ITERATIONS: Status.MAX_ITERATIONS,
}
# The integrator is this much more accurate than the residual that Newton's method is asked for.
ACCURACY = 1e-2
SMALLEST_TOLERANCE = 1e-13  # of the integrator, near rounding
# Sweeps need no accuracy beyond what the next sweep changes; Newton's method polishes the result.
SWEEP_TOLERANCE = 1e-4


def solve(
    problem: OptimalControlProblem | Scenario,
    method: Method = "leapfrog",
    guess: Path | Extremal | None = None,
    tol: float = 1e-9,
    max_iterations: int = 60,
    segments: int | None = None,
) -> Extremal:
    """Solves the boundary value problem of the minimum principle from a guess: one extremal, not the global optimum.

    Args:
        problem: an optimal control problem, or a scenario (whose guess is then the best path of the lattice search).
        method: "leapfrog", "multiple_shooting" or "single_shooting".
        guess: a path; without costates they are estimated from its motion. None: see `problem`, or a straight line.
        tol: largest residual of the boundary and continuity conditions; the certificate asks for 1e-8 in any case.
        max_iterations: of Newton's method.
        segments: shooting segments, and nodes of Leapfrog; None chooses them from the guess.

    Returns:
        An `Extremal` whose status comes from its certificate.

    Raises:
        ValueError: an argument is impossible; the message names it.

    """
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if not (math.isfinite(tol) and tol > 0):
        raise ValueError(f"tol: expected a positive number, got {tol!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations: expected at least 1, got {max_iterations!r}")
    if segments is not None and segments < 1:
        raise ValueError(f"segments: expected at least 1, got {segments!r}")
    task = as_problem(problem)
    if isinstance(guess, Extremal):
        if len(guess.times) == 0:
            raise ValueError(f"guess: the extremal has no path: {guess.status.value}")
        path = Path(guess.times * (task.horizon / guess.times[-1]), guess.states, guess.costates)
    elif guess is not None:
        path = _checked(guess, task)
    elif isinstance(problem, Scenario):
        candidate = next(Lattice(problem).candidates(), None)
        if candidate is None:
            return failure(task, Status.NO_PATH)
        path = Path(candidate.times, candidate.poses)
    else:
        path = task.straight_line()
    return METHODS[method](task.with_winding_of(path.states), path, tol, max_iterations, segments)


def start_nodes(problem: OptimalControlProblem, path: Path, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Times (segments + 1,) and nodes (segments + 1, 2n) on a path, with both boundary conditions met exactly."""
    times = np.linspace(0.0, problem.horizon, segments + 1)
    even = path.resample(times)
    costates = even.costates if even.costates is not None else problem.estimate_costates(even)
    arrays = problem.arrays
    nodes = np.concatenate([even.states, costates], axis=1)
    n = problem.system.n
    nodes[0, :n] = arrays.start
    nodes[-1, :n] = np.where(arrays.free, nodes[-1, :n], arrays.goal)
    return times, nodes


def default_segments(path: Path) -> int:
    """One segment per half second or per two points of a lattice path (0.4 to 0.7 m), whichever is more."""
    return int(np.clip(max(len(path.times) / 2, path.times[-1] / 0.5), 8, 128))


def single_shooting(
    problem: OptimalControlProblem, path: Path, tol: float, max_iterations: int, segments: int | None
) -> Extremal:
    """Newton's method on the initial costate."""
    arrays = problem.arrays
    _, nodes = start_nodes(problem, path, segments or default_segments(path))
    z, end = nodes[0].copy(), nodes[0].copy()
    code, iterations, residual, cost, work = single_shooting_kernels.shoot(
        arrays.flow,
        z,
        arrays.goal,
        end,
        arrays.free,
        problem.horizon,
        arrays.data,
        arrays.field,
        tol,
        # Over the whole horizon the integration errors of all steps add up and grow.
        max(tol * ACCURACY**2, SMALLEST_TOLERANCE),
        max_iterations,
    )
    history = (Iteration("newton", 1, cost, residual, 0),) * min(iterations, 1)
    times = np.array([0.0, problem.horizon])
    return certify(problem, times, np.stack([z, end]), STATUS[code], history, work)


def multiple_shooting(
    problem: OptimalControlProblem, path: Path, tol: float, max_iterations: int, segments: int | None
) -> Extremal:
    """Newton's method on states and costates at all nodes."""
    times, nodes = start_nodes(problem, path, segments or default_segments(path))
    status, history, work = polish(problem, times, nodes, tol, max_iterations)
    return certify(problem, times, nodes, status, history, work)


def leapfrog(
    problem: OptimalControlProblem, path: Path, tol: float, max_iterations: int, segments: int | None
) -> Extremal:
    """Leapfrog sweeps until Newton's method takes over, then multiple shooting on the same nodes."""
    times, nodes = start_nodes(problem, path, segments or default_segments(path))
    history: list[Iteration] = []
    work = 0
    costs = connect(problem, times, nodes)
    for sweeps in (3, 6, 12, 24):
        rows, steps = sweep(problem, times, nodes, costs, sweeps)
        attempt = nodes.copy()
        status, newton_rows, newton_steps = polish(problem, times, attempt, tol, max_iterations)
        history += [*rows, *newton_rows]
        work += steps + newton_steps
        if status is Status.SUCCESS:
            break
    return certify(problem, times, attempt, status, tuple(history), work)


METHODS: dict[str, Callable[[OptimalControlProblem, Path, float, int, int | None], Extremal]] = {
    "single_shooting": single_shooting,
    "multiple_shooting": multiple_shooting,
    "leapfrog": leapfrog,
}


def connect(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, tolerance: float = SWEEP_TOLERANCE
) -> np.ndarray:
    """Makes a path of nodes feasible in place; returns the cost of each segment, infinite where that failed."""
    arrays = problem.arrays
    costs = np.empty(len(times) - 1)
    leapfrog_kernels.connect(
        arrays.flow,
        times,
        nodes,
        arrays.goal,
        arrays.free,
        arrays.data,
        arrays.field,
        tolerance,
        tolerance,
        costs,
    )
    return costs


def sweep(
    problem: OptimalControlProblem,
    times: np.ndarray,
    nodes: np.ndarray,
    costs: np.ndarray,
    sweeps: int,
    half_cost: bool = False,
    tolerance: float = SWEEP_TOLERANCE,
) -> tuple[list[Iteration], int]:
    """Leapfrog sweeps in place; returns a row for each, and the integration steps."""
    arrays = problem.arrays
    rows, work = [], 0
    for _ in range(sweeps):
        rejected, steps = leapfrog_kernels.sweep(
            arrays.flow,
            times,
            nodes,
            arrays.goal,
            arrays.free,
            arrays.data,
            arrays.field,
            tolerance,
            tolerance,
            half_cost,
            costs,
            1,
            1,
        )
        rows.append(Iteration("sweep", len(costs), float(costs.sum()), math.nan, rejected))
        work += steps
    return rows, work


def polish(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, tol: float, max_iterations: int
) -> tuple[Status, tuple[Iteration, ...], int]:
    """Multiple-shooting Newton on the nodes, in place: (status, a row per iterate, integration steps)."""
    arrays = problem.arrays
    costs = np.empty(len(times) - 1)
    log = np.zeros((max_iterations + 1, 3))
    code, iterations, _, work = multiple_shooting_kernels.newton(
        arrays.flow,
        times,
        nodes,
        arrays.start,
        arrays.goal,
        arrays.free,
        arrays.data,
        arrays.field,
        tol,
        tol * ACCURACY,
        max_iterations,
        costs,
        log,
    )
    rows = tuple(Iteration("newton", len(costs), row[1], row[0], 0) for row in log[: iterations + 1].tolist())
    return STATUS[code], rows, work


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
