"""Initial guesses of a solution: local minima on piecewise constant controls, from several initial controls.

Different initial controls lead to different local minima of the direct transcription, and the cheapest of these is a
good guess of the optimum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.numerics.state_bounds import state_margin
from leapnav.experts.numerics.time_scaling import time_factor
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.transcription.direct import DirectPath, optimise
from leapnav.experts.transcription.discrete_problem import roll_out

INTERVALS = 64
# Initial controls per winding of the goal angles, and the common logarithms between which the relative amplitudes of
# random ones are distributed. Of 10 seeds, 7 find the optimum of a bicycle that starts at rest, and 5 that of the
# swing-up of a double pendulum; with 16 initial controls of one amplitude, none and 1.
MAX_STARTS, AMPLITUDES = 48, (-2.0, 0.5)
N_AGREEING = 6  # if this number of initial controls leads to one cost, the problem is assumed to have one minimum
MAX_VIOLATION = 1e-2  # sum of the constraint violations of a path, relative to the largest state
HARMONICS = 4  # of random initial controls
REST = 1e-3  # fraction of the first random controls below which a path is at rest, such as a straight beam
COST_TOLERANCE = 1e-4  # relative; paths whose costs agree to this are one local minimum, or its mirror image
WINDINGS = (0, -1, 1)
# First weight of a barrier, as a fraction of the cost per second; smaller costs per unit controls are rounding errors.
FIRST_BARRIER, NEGLIGIBLE = 0.1, 1e-12
# Free horizon: first guess (s), largest number of times it is doubled or halved, then smallest factor and largest
# number of steps, relative tolerance, and initial controls per horizon.
FIRST_HORIZON, MAX_DOUBLINGS, HORIZON_STARTS = 1.0, 11, 4
MIN_HORIZON_FACTOR, MAX_HORIZON_STEPS, HORIZON_TOLERANCE = 0.5, 8, 0.05


def initial_paths(
    problem: OptimalControlProblem, seeds: Iterable[int] = (0,)
) -> Iterator[tuple[float, OptimalControlProblem, Trajectory]]:
    """Yield costs of nearly feasible paths, in order, with the problem of their winding, and the paths with costates.

    Yields nothing if no path to the goal was found.

    Args:
        problem: the problem.
        seeds: random seeds of the initial controls, see `local_minima`; a search is made with each.

    """
    found: list[tuple[float, OptimalControlProblem, Trajectory]] = []
    for variant, seed in itertools.product(_windings(problem), seeds):
        found += [(cost, variant, path) for cost, path in local_minima(_with_horizon(variant, seed), seed=seed)]
    found.sort(key=lambda entry: entry[0])
    last: float | None = None
    for cost, variant, path in found:
        if last is None or cost > last + COST_TOLERANCE * (abs(last) + abs(cost)):
            last = cost
            yield cost, variant, path


def first_barrier_weight(problem: OptimalControlProblem, seed: int = 0) -> float:
    """Return a barrier weight (cost per second) at which the barrier is a small but not negligible part of the cost.

    It is a fraction of the mean cost per second of a path that ignores limits of states and obstacles without proximity
    cost, so it is independent of the units of cost, time and states. If there is no such path, or it costs nothing, it
    is a fraction of the cost of controls of 1.
    """
    plain = replace(problem, state_bounds=None, barrier_weight=0.0)
    fixed = _with_horizon(next(_windings(plain)), seed)
    cost = min((cost for cost, _ in local_minima(fixed, starts=N_AGREEING, seed=seed)), default=0.0)
    rate, unit_rate = abs(cost) / fixed.fixed_horizon, 0.5 * sum(problem.control_weight)
    return FIRST_BARRIER * (rate if rate > NEGLIGIBLE * unit_rate else unit_rate)


def _with_horizon(problem: OptimalControlProblem, seed: int) -> OptimalControlProblem:
    """Return the problem with a fixed horizon, estimated if it is free."""
    return problem if problem.horizon is not None else problem.with_horizon(estimate_horizon(problem, seed))


def estimate_horizon(problem: OptimalControlProblem, seed: int = 0) -> float:
    """Estimate the optimal horizon (s) of a problem with a free horizon.

    The cost of the best path of a fixed time may have several local minima over this time, and paths of some times are
    not found. Powers of 2 are tried first: longer times until the time alone costs more than the best path, and shorter
    ones until a path costs twice as much or is not found. The derivative of the cost by the time, which is the
    Hamiltonian, then gives the time that minimises a cost of the form a / T + b T; the step to it is shortened until
    the cost decreases. Without any path, the result is the first guess.
    """
    found: dict[float, tuple[float, Trajectory]] = {}

    def lowest_cost(horizon: float) -> float:
        """Return the lowest cost of the paths of a fixed time within the limits of the states, which is kept."""
        minima = local_minima(problem.with_horizon(horizon), starts=HORIZON_STARTS, seed=seed)
        minima = [(cost, path) for cost, path in minima if state_margin(problem.state_limits, path.states) > 0]
        if not minima:
            return math.inf
        found[horizon] = min(minima, key=lambda entry: entry[0])
        return found[horizon][0]

    best = math.inf
    for horizon in (FIRST_HORIZON * 2.0**k for k in range(MAX_DOUBLINGS + 1)):
        if problem.time_weight * horizon >= best > 0.0:
            break
        best = min(best, lowest_cost(horizon))
    for horizon in (FIRST_HORIZON * 2.0**-k for k in range(1, MAX_DOUBLINGS + 1)):
        cost = lowest_cost(horizon)
        if math.isfinite(best) and cost > 2.0 * abs(best):
            break
        best = min(best, cost)
    if not found:
        return FIRST_HORIZON
    horizon = min(found, key=lambda one: found[one][0])
    factor = _time_factor(problem, *found[horizon])
    for _ in range(MAX_HORIZON_STEPS):
        if abs(factor - 1.0) < HORIZON_TOLERANCE:
            break
        if lowest_cost(factor * horizon) < found[horizon][0]:
            horizon *= factor
            factor = _time_factor(problem, *found[horizon])
        else:
            factor = math.sqrt(factor)
    return horizon


def _time_factor(problem: OptimalControlProblem, cost: float, path: Trajectory) -> float:
    """Return the factor of the horizon of a path with costates that is expected to minimise the cost."""
    assert path.costates is not None  # `local_minima` computes them
    # On a coarse path the Hamiltonian varies where Phi does, so its mean is used.
    values = hamiltonians(problem.arrays.flow, np.concatenate([path.states, path.costates], axis=1))
    return time_factor(cost, float(np.trapezoid(values, path.times)), MIN_HORIZON_FACTOR)


def _windings(problem: OptimalControlProblem) -> Iterator[OptimalControlProblem]:
    """Yield the problem with each goal angle at the winding closest to the start, then at the neighbouring windings."""
    at = [i for i in problem.winding_states if problem.goal[i] is not None]
    for windings in itertools.product(WINDINGS, repeat=len(at)):
        goal = list(problem.goal)
        for i, winding in zip(at, windings, strict=True):
            start = problem.start[i]
            goal[i] = start + math.remainder((goal[i] or 0.0) - start, 2 * math.pi) + 2 * math.pi * winding
        yield replace(problem, goal=tuple(goal)) if at else problem


def local_minima(
    problem: OptimalControlProblem, intervals: int = INTERVALS, starts: int = MAX_STARTS, seed: int = 0
) -> list[tuple[float, Trajectory]]:
    """Find local minima on piecewise constant controls.

    Args:
        problem: the problem, with a fixed horizon and the windings of its goal angles chosen.
        intervals: number of control intervals.
        starts: largest number of initial controls: along the straight line, zero, and random ones.
        seed: random seed of the initial controls.

    Returns:
        Costs and paths (intervals + 1 points, with costates), in the order of the initial controls.

    """
    rng = np.random.default_rng(seed)
    found: list[tuple[float, Trajectory]] = []
    n, m = problem.system.n, problem.system.m
    line = problem.straight_line(intervals + 1)
    rates = np.gradient(line.states, line.times, axis=0)
    along = np.nan_to_num(problem.follow(line.states, rates)[:intervals])
    # Typical size of the controls, until a path is known that has any.
    size = np.full(m, np.linalg.norm(rates[0]) + n / problem.fixed_horizon)
    smallest = REST * np.linalg.norm(size)
    phases = np.cos(np.outer(np.linspace(0.0, np.pi, intervals), np.arange(HARMONICS)))
    for index in range(starts):
        U = along.copy() if index == 0 else np.zeros_like(along)
        if index > 1:
            U = phases @ (rng.normal(size=(HARMONICS, m)) / (1.0 + np.arange(HARMONICS))[:, None]) * size
            U *= 10.0 ** rng.uniform(*AMPLITUDES)
        path = _optimise(problem, _clip(problem, U))
        if path is None:
            continue
        rms = np.sqrt(np.mean(path.controls**2, axis=0) + 1e-12)
        if np.linalg.norm(rms) > smallest and state_margin(problem.state_limits, path.states) > 0:
            size = rms + 0.3 * np.sqrt(np.mean(path.controls**2))
        elif index > 1:
            size *= 0.3  # at rest if the random controls were too small, but beyond the limits if they were too large
        found.append((path.cost, Trajectory(path.times, path.states, path.costates)))
        costs = np.array([entry[0] for entry in found])
        if len(found) == N_AGREEING and np.ptp(costs) <= COST_TOLERANCE * np.abs(costs).max():
            break
    return found


def _optimise(problem: OptimalControlProblem, controls: np.ndarray) -> DirectPath | None:
    """Return the local optimum that is reached from controls (N, m), or None if it does not meet the constraints."""
    times = np.linspace(0.0, problem.fixed_horizon, len(controls) + 1)
    states = np.empty((len(times), problem.system.n))
    states[0] = problem.start
    if not roll_out(problem.compiled_dynamics.step, problem.arrays.data, times, controls, states):
        return None
    path = optimise(problem, DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False))
    scale = 1.0 + np.abs(path.states).max()
    # In a problem without a minimum, controls may be so large that their squares overflow.
    is_finite = math.isfinite(path.cost + float(np.vdot(path.controls, path.controls)))
    return path if path.violation < MAX_VIOLATION * scale and is_finite else None


def _clip(problem: OptimalControlProblem, U: np.ndarray) -> np.ndarray:
    """Return controls (N, m) within their bounds."""
    m = problem.system.m
    data = problem.arrays.data
    return np.clip(U, data[m : 2 * m], data[2 * m : 3 * m])
