"""Initial guesses of a solution: local minima on piecewise constant controls, from several initial controls.

The controls u_1..u_N steer the system from its start. Sequential quadratic programming on the controls alone (condensed
direct single shooting with the Gauss-Newton Hessian; J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed.,
ch. 18) meets the end conditions and reduces the cost. The multipliers of the end conditions are the final costate, and
the adjoint recursion gives the costates along the path. Different initial controls lead to different local minima, and
the cheapest of these is a good guess of the optimum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from leapnav.experts.numerics.linear import solve_positive
from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.numerics.state_bounds import state_margin
from leapnav.experts.numerics.time_scaling import time_factor
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.condensing import ControlRollout, condense, roll_out

INTERVALS = 64
MAX_STARTS = 16  # initial controls per winding of the goal angles
N_AGREEING = 6  # if this number of initial controls leads to one cost, the problem is assumed to have one minimum
MAX_ITERATIONS = 40
HARMONICS = 4  # of random initial controls
COST_TOLERANCE = 1e-4  # relative; paths whose costs agree to this are one local minimum, or its mirror image
WINDINGS = (0, -1, 1)
# First weight of a barrier, as a fraction of the cost per second; smaller costs per unit controls are rounding errors.
FIRST_BARRIER, NEGLIGIBLE = 0.1, 1e-12
# Free horizon: first guess (s), smallest factor and largest number of its steps, relative tolerance, and initial
# controls per step.
FIRST_HORIZON, MIN_HORIZON_FACTOR, MAX_HORIZON_STEPS, HORIZON_TOLERANCE, HORIZON_STARTS = 1.0, 0.25, 12, 0.05, 4


@dataclass
class _Point:
    """Piecewise constant controls with the quantities that depend on them.

    Attributes:
        U: (N, m), controls.
        rollout: the path and its derivatives.
        cost: J.
        end_error: violation of the end conditions.

    """

    U: np.ndarray
    rollout: ControlRollout
    cost: float
    end_error: np.ndarray


def initial_paths(problem: OptimalControlProblem, seed: int = 0) -> Iterator[tuple[OptimalControlProblem, Trajectory]]:
    """Yield nearly feasible paths with costates, in order of cost, each with the problem that has its winding.

    Yields nothing if no path to the goal was found.
    """
    found: list[tuple[float, OptimalControlProblem, Trajectory]] = []
    for variant in _windings(problem):
        found += [(cost, variant, path) for cost, path in local_minima(_with_horizon(variant, seed), seed=seed)]
    found.sort(key=lambda entry: entry[0])
    last: float | None = None
    for cost, variant, path in found:
        if last is None or cost > last + COST_TOLERANCE * (abs(last) + abs(cost)):
            last = cost
            yield variant, path


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

    The best local minimum in a fixed time gives the derivative of its cost by the horizon, which is the Hamiltonian.
    The next horizon minimises a cost of the form a / T + b T with this value and derivative. If no path to the goal is
    found, or none within the limits of the states, the horizon is too short.
    """
    horizon, too_short, reachable = FIRST_HORIZON, 0.0, math.inf
    for _ in range(MAX_HORIZON_STEPS):
        minima = local_minima(problem.with_horizon(horizon), starts=HORIZON_STARTS, seed=seed)
        minima = [(cost, path) for cost, path in minima if state_margin(problem.state_limits, path.states) > 0]
        if not minima:
            if horizon < reachable:
                too_short = horizon
            horizon = math.sqrt(too_short * reachable) if reachable < math.inf else horizon / MIN_HORIZON_FACTOR
            continue
        reachable = horizon
        cost, path = min(minima, key=lambda entry: entry[0])
        assert path.costates is not None  # `local_minima` computes them
        # On a coarse path the Hamiltonian varies where Phi does, so its mean is used.
        values = hamiltonians(problem.arrays.flow, np.concatenate([path.states, path.costates], axis=1))
        slope = float(np.trapezoid(values, path.times))
        factor = time_factor(cost, slope, MIN_HORIZON_FACTOR)
        horizon = max(factor * horizon, math.sqrt(too_short * reachable))
        if abs(horizon / reachable - 1.0) < HORIZON_TOLERANCE:
            break
    return reachable if reachable < math.inf else horizon


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
    drift, fields = problem.dynamics(line.states)
    rates = np.gradient(line.states, line.times, axis=0)
    along = np.zeros((intervals, m))
    if np.isfinite(fields).all() and np.isfinite(drift).all():
        along = (np.linalg.pinv(fields) @ (rates - drift)[:, :, None])[:intervals, :, 0]
    # Typical size of the controls, until a solution is known.
    size = np.full(m, np.linalg.norm(rates[0]) + n / problem.fixed_horizon)
    phases = np.cos(np.outer(np.linspace(0.0, np.pi, intervals), np.arange(HARMONICS)))
    for index in range(starts):
        U = along.copy() if index == 0 else np.zeros_like(along)
        if index > 1:
            U = phases @ (rng.normal(size=(HARMONICS, m)) / (1.0 + np.arange(HARMONICS))[:, None]) * size
        with np.errstate(all="ignore"):
            solved = _optimise(problem, _clip(problem, U))
        if solved is None:
            continue
        cost, path, controls = solved
        size = np.sqrt(np.mean(controls**2, axis=0) + 1e-12) + 0.3 * np.sqrt(np.mean(controls**2))
        found.append((cost, path))
        costs = np.array([entry[0] for entry in found])
        if len(found) == N_AGREEING and np.ptp(costs) <= COST_TOLERANCE * np.abs(costs).max():
            break
    return found


def _optimise(problem: OptimalControlProblem, U: np.ndarray) -> tuple[float, Trajectory, np.ndarray] | None:
    """Return cost, path and controls of the local minimum reached from controls U (N, m), or None."""
    intervals = len(U)
    weight = np.tile(problem.control_weight, intervals)
    h = problem.fixed_horizon / intervals
    fixed = np.flatnonzero(~problem.arrays.free)
    lower, upper = (np.tile(bound, intervals) for bound in _bounds(problem))
    point = _evaluate(problem, U)
    if point is None:
        return None
    penalty, multiplier, count = 0.0, np.zeros(len(fixed)), U.size
    for _ in range(MAX_ITERATIONS):
        H, g, G = np.diag(h * weight), h * weight * point.U.ravel(), np.empty((problem.system.n, count))
        condense(point.rollout, h, H, g, G)
        values = point.U.ravel()
        held, move = np.zeros(count, dtype=bool), np.zeros(count)
        for _ in range(3):  # controls that would leave their bounds are fixed at them
            move, multiplier = _quadratic_step(H, g, G[fixed], -point.end_error, ~held, lower - values, upper - values)
            leaving = (values + move < lower - 1e-12) | (values + move > upper + 1e-12)
            if not np.any(leaving & ~held):
                break
            held |= leaving
        penalty = max(penalty, 1.5 * float(np.abs(multiplier).max(initial=0.0)) + 1e-9)
        merit = point.cost + penalty * float(np.abs(point.end_error).sum())
        damping, following = 1.0, None
        while damping > 1e-3:
            trial = _evaluate(problem, _clip(problem, point.U + damping * move.reshape(U.shape)))
            if trial is not None and trial.cost + penalty * float(np.abs(trial.end_error).sum()) < merit:
                following = trial
                break
            damping /= 2.0
        if following is None:
            break
        gain = merit - following.cost - penalty * float(np.abs(following.end_error).sum())
        point = following
        if gain < 1e-7 * (1.0 + abs(point.cost)):
            break
    scale = 1.0 + np.abs(point.rollout.X).max()
    if not np.abs(point.end_error).max(initial=0.0) < 1e-2 * scale:
        return None
    n = problem.system.n
    costates = np.zeros((intervals + 1, n))
    costates[-1, fixed] = multiplier
    costates[-1] += h / 2 * point.rollout.phi_q[-1]
    for k in range(intervals - 1, -1, -1):
        costates[k] = point.rollout.Ad[k].T @ costates[k + 1] + (h if k > 0 else h / 2) * point.rollout.phi_q[k]
    times = np.linspace(0.0, problem.fixed_horizon, intervals + 1)
    return point.cost, Trajectory(times, point.rollout.X, costates), point.U


def _quadratic_step(
    H: np.ndarray,
    g: np.ndarray,
    G: np.ndarray,
    c: np.ndarray,
    moving: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise 1/2 d'Hd + g'd subject to G d = c, where the entries that are not `moving` go to their closest bound.

    Returns the step d and the multipliers of the constraints.
    """
    move = np.zeros(len(g))
    held = ~moving
    move[held] = np.where(np.abs(lower[held]) < np.abs(upper[held]), lower[held], upper[held])
    block = H[np.ix_(moving, moving)]
    rhs = np.column_stack([-(g[moving] + np.einsum("ij,j->i", H[np.ix_(moving, held)], move[held])), G[:, moving].T])
    # The state cost need not be convex: the diagonal is increased until the step is a descent direction.
    shift = 0.0
    solved = rhs.copy()
    while not solve_positive(block + shift * np.eye(len(block)), solved):
        shift = max(4.0 * shift, 1e-3 * float(np.abs(np.diag(block)).max(initial=1e-300)))
        solved = rhs.copy()
    free_move, spread = solved[:, 0], solved[:, 1:]
    gram = G[:, moving] @ spread
    target = c - G[:, held] @ move[held]
    multiplier = np.linalg.lstsq(gram, G[:, moving] @ free_move - target, rcond=1e-10)[0]
    move[moving] = free_move - spread @ multiplier
    return move, multiplier


def _evaluate(problem: OptimalControlProblem, U: np.ndarray) -> _Point | None:
    """Return the point with controls U (N, m), or None if its path is not finite."""
    arrays, n, m = problem.arrays, problem.system.n, problem.system.m
    intervals = len(U)
    h = problem.fixed_horizon / intervals
    rollout = ControlRollout(
        X=np.empty((intervals + 1, n)),
        phi=np.empty(intervals + 1),
        Ad=np.empty((intervals, n, n)),
        Bd=np.empty((intervals, n, m)),
        phi_q=np.empty((intervals + 1, n)),
        phi_qq=np.empty((intervals + 1, n, n)),
    )
    if not roll_out(arrays.flow, arrays.control, arrays.start, np.ascontiguousarray(U), h, rollout):
        return None
    phi = rollout.phi
    effort = 0.5 * h * float(np.sum(np.asarray(problem.control_weight) * U**2))
    cost = effort + h * float(phi.sum() - (phi[0] + phi[-1]) / 2)
    derivatives = rollout.Ad, rollout.Bd, rollout.phi_q, rollout.phi_qq
    if not (math.isfinite(cost) and all(np.isfinite(array).all() for array in derivatives)):
        return None
    return _Point(U, rollout, cost, (rollout.X[-1] - arrays.goal)[~arrays.free])


def _bounds(problem: OptimalControlProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper control bounds, (m,) each."""
    m = problem.system.m
    return problem.arrays.data[m : 2 * m], problem.arrays.data[2 * m : 3 * m]


def _clip(problem: OptimalControlProblem, U: np.ndarray) -> np.ndarray:
    return np.clip(U, *_bounds(problem))
