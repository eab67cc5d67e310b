"""Paths to start from where nothing is known: Gauss-Newton on piecewise constant controls, from several beginnings.

The controls u_1..u_N steer the system from its start; the end condition is met and the cost lowered by sequential
quadratic programming on the controls alone (condensed direct single shooting, J. Nocedal and S. J. Wright, Numerical
Optimization, 2nd ed., ch. 18, with the Gauss-Newton Hessian). The multipliers of the end condition are the final
costate, and the adjoint recursion carries it back: the path comes with costates consistent with the minimum principle.
Different beginnings end in different local minima, so that the cheapest of them is a good candidate for the optimum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import boolean, float64, types

from leapnav.envs.compiling import njit
from leapnav.experts.integrator import CONTROL, FLOW, constant, cube, matrix, vector
from leapnav.experts.linear import solve_positive
from leapnav.experts.problem import OptimalControlProblem, Path

INTERVALS = 64
STARTS = 16  # beginnings per winding of the goal angles
AGREEING = 6  # so many beginnings with one and the same end are taken for a problem with one minimum
ITERATIONS = 40
HARMONICS = 4  # of a random beginning
SAME_COST = 1e-4  # relative; paths this near in cost are one local minimum, or its mirror image
WINDINGS = (0, -1, 1)


@njit(
    boolean(FLOW, CONTROL, vector, matrix, float64, constant, constant, matrix, vector, cube, cube, matrix, cube),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _roll_out(flow, control, start, U, h, data, field, X, phi, Ad, Bd, phi_q, phi_qq):
    """States X (N + 1, n) under controls U (N, m) held for h each, one classical Runge-Kutta step per interval.

    Also the steps' derivatives Ad (N, n, n), Bd (N, n, m) and Phi with gradient and Hessian at the nodes. False if the
    path left the numbers.
    """
    count, m = U.shape
    n = len(start)
    columns = n + m
    probe = data.copy()
    probe[:m] = 1.0
    probe[m : 2 * m] = -np.inf
    probe[2 * m : 3 * m] = np.inf
    held = data.copy()  # equal bounds hold the controls, whatever the costates
    z, dz = np.zeros(2 * n), np.empty(2 * n)
    S, dS = np.zeros((2 * n, columns)), np.empty((2 * n, columns))
    sum_z, sum_S = np.empty(n), np.empty((n, columns))
    slope_z, slope_S = np.zeros(n), np.zeros((n, columns))
    unit, u = np.zeros(2 * n), np.empty(m)
    X[0] = start
    for k in range(count + 1):
        for j in range(m):
            value = U[min(k, count - 1), j]
            held[m + j] = value
            held[2 * m + j] = value
        z[:n] = X[k]
        z[n:] = 0.0
        S[:] = 0.0
        for i in range(n):
            S[i, i] = 1.0
        running = flow(z, held, field, S, dz, dS)
        phi[k] = running
        for j in range(m):
            phi[k] -= 0.5 * data[j] * U[min(k, count - 1), j] ** 2
        for i in range(n):
            phi_q[k, i] = -dz[n + i]
            for j in range(n):
                phi_qq[k, i, j] = -dS[n + i, j]
        if k == count:
            break
        sum_z[:] = 0.0
        sum_S[:] = 0.0
        for stage in range(4):
            reach = 0.0 if stage == 0 else (h if stage == 3 else h / 2)
            weight = h / 6 if stage in (0, 3) else h / 3
            for i in range(n):
                z[i] = X[k, i] + reach * slope_z[i]
                for c in range(columns):
                    S[i, c] = (1.0 if c == i else 0.0) + reach * slope_S[i, c]
            flow(z, held, field, S, dz, dS)
            unit[:n] = z[:n]
            for i in range(n):
                unit[n + i] = 1.0
                control(unit, probe, u)
                unit[n + i] = 0.0
                for j in range(m):
                    dS[i, n + j] -= u[j]
            for i in range(n):
                slope_z[i] = dz[i]
                sum_z[i] += weight * dz[i]
                for c in range(columns):
                    slope_S[i, c] = dS[i, c]
                    sum_S[i, c] += weight * dS[i, c]
        for i in range(n):
            X[k + 1, i] = X[k, i] + sum_z[i]
            if not abs(X[k + 1, i]) < 1e8:
                return False
            for j in range(n):
                Ad[k, i, j] = sum_S[i, j] + (1.0 if i == j else 0.0)
            for j in range(m):
                Bd[k, i, j] = sum_S[i, n + j]
    return True


@njit(
    types.none(cube, cube, matrix, cube, float64, matrix, vector, matrix), cache=True, error_model="numpy", nogil=True
)
def _condense(Ad, Bd, phi_q, phi_qq, h, H, g, G):
    """Adds the state cost's share to H (Nm, Nm) and g (Nm,) and fills G = dq_N/dU (n, Nm)."""
    count, n, m = Bd.shape
    G[:] = 0.0
    following = np.zeros_like(G)
    for k in range(1, count + 1):
        width = k * m
        for i in range(n):
            for c in range(width - m):
                total = 0.0
                for j in range(n):
                    total += Ad[k - 1, i, j] * G[j, c]
                following[i, c] = total
            for j in range(m):
                following[i, width - m + j] = Bd[k - 1, i, j]
        G[:] = following
        weight = h if k < count else h / 2
        for i in range(n):
            if phi_q[k, i] != 0.0:
                for c in range(width):
                    g[c] += weight * phi_q[k, i] * G[i, c]
            for j in range(n):
                q = weight * phi_qq[k, i, j]
                if q != 0.0:
                    for a in range(width):
                        for b in range(width):
                            H[a, b] += q * G[i, a] * G[j, b]


@dataclass
class _Point:
    """Controls U with everything that depends on them."""

    U: np.ndarray
    X: np.ndarray
    Ad: np.ndarray
    Bd: np.ndarray
    phi_q: np.ndarray
    phi_qq: np.ndarray
    cost: float
    miss: np.ndarray


def initial_paths(problem: OptimalControlProblem, seed: int = 0) -> Iterator[tuple[OptimalControlProblem, Path]]:
    """Nearly feasible paths with costates, the cheapest first, each with the problem whose winding it has.

    None at all if no beginning could be steered to the goal.
    """
    found: list[tuple[float, OptimalControlProblem, Path]] = []
    for wound in _windings(problem):
        found += [(cost, wound, path) for cost, path in local_minima(wound, seed=seed)]
    found.sort(key=lambda entry: entry[0])
    last: float | None = None
    for cost, wound, path in found:
        if last is None or cost > last + SAME_COST * (abs(last) + abs(cost)):
            last = cost
            yield wound, path


def _windings(problem: OptimalControlProblem) -> Iterator[OptimalControlProblem]:
    """The problem with each goal angle at its nearest winding, then at the neighbouring ones."""
    at = [problem.system.state.index(symbol) for symbol in problem.system.angles]
    at = [i for i in at if problem.goal[i] is not None]
    for turns in itertools.product(WINDINGS, repeat=len(at)):
        goal = list(problem.goal)
        for i, turn in zip(at, turns, strict=True):
            start = problem.start[i]
            goal[i] = start + math.remainder((goal[i] or 0.0) - start, 2 * math.pi) + 2 * math.pi * turn
        yield replace(problem, goal=tuple(goal)) if at else problem


def local_minima(
    problem: OptimalControlProblem, intervals: int = INTERVALS, starts: int = STARTS, seed: int = 0
) -> list[tuple[float, Path]]:
    """Costs and paths (intervals + 1 points, with costates) of what the beginnings lead to, in their order."""
    rng = np.random.default_rng(seed)
    found: list[tuple[float, Path]] = []
    n, m = problem.system.n, problem.system.m
    line = problem.straight_line(intervals + 1)
    drift, fields = problem.dynamics(line.states)
    rates = np.gradient(line.states, line.times, axis=0)
    along = np.zeros((intervals, m))
    if np.isfinite(fields).all() and np.isfinite(drift).all():
        along = (np.linalg.pinv(fields) @ (rates - drift)[:, :, None])[:intervals, :, 0]
    # What a typical control is, until a solution tells.
    size = np.full(m, np.linalg.norm(rates[0]) + n / problem.horizon)
    phases = np.cos(np.outer(np.linspace(0.0, np.pi, intervals), np.arange(HARMONICS)))
    for number in range(starts):
        U = along.copy() if number == 0 else np.zeros_like(along)
        if number > 1:
            U = phases @ (rng.normal(size=(HARMONICS, m)) / (1.0 + np.arange(HARMONICS))[:, None]) * size
        with np.errstate(all="ignore"):
            solved = _optimise(problem, _clip(problem, U))
        if solved is None:
            continue
        cost, path, controls = solved
        size = np.sqrt(np.mean(controls**2, axis=0) + 1e-12) + 0.3 * np.sqrt(np.mean(controls**2))
        found.append((cost, path))
        costs = np.array([entry[0] for entry in found])
        if len(found) == AGREEING and np.ptp(costs) <= SAME_COST * np.abs(costs).max():
            break
    return found


def _optimise(problem: OptimalControlProblem, U: np.ndarray) -> tuple[float, Path, np.ndarray] | None:
    """Cost, path and controls of the local minimum that the beginning U leads to; None if it leads to none."""
    intervals = len(U)
    weight = np.tile(problem.control_weight, intervals)
    h = problem.horizon / intervals
    fixed = np.flatnonzero(~problem.arrays.free)
    lower, upper = (np.tile(bound, intervals) for bound in _bounds(problem))
    here = _evaluate(problem, U)
    if here is None:
        return None
    penalty, multiplier, count = 0.0, np.zeros(len(fixed)), U.size
    for _ in range(ITERATIONS):
        H, g, G = np.diag(h * weight), h * weight * here.U.ravel(), np.empty((problem.system.n, count))
        _condense(here.Ad, here.Bd, here.phi_q, here.phi_qq, h, H, g, G)
        values = here.U.ravel()
        held, move = np.zeros(count, dtype=bool), np.zeros(count)
        for _ in range(3):  # controls that would leave their bounds stay on them
            move, multiplier = _quadratic_step(H, g, G[fixed], -here.miss, ~held, lower - values, upper - values)
            leaving = (values + move < lower - 1e-12) | (values + move > upper + 1e-12)
            if not np.any(leaving & ~held):
                break
            held |= leaving
        penalty = max(penalty, 1.5 * float(np.abs(multiplier).max(initial=0.0)) + 1e-9)
        merit = here.cost + penalty * float(np.abs(here.miss).sum())
        share, following = 1.0, None
        while share > 1e-3:
            trial = _evaluate(problem, _clip(problem, here.U + share * move.reshape(U.shape)))
            if trial is not None and trial.cost + penalty * float(np.abs(trial.miss).sum()) < merit:
                following = trial
                break
            share /= 2.0
        if following is None:
            break
        gain = merit - following.cost - penalty * float(np.abs(following.miss).sum())
        here = following
        if gain < 1e-7 * (1.0 + abs(here.cost)):
            break
    scale = 1.0 + np.abs(here.X).max()
    if not np.abs(here.miss).max(initial=0.0) < 1e-2 * scale:
        return None
    n = problem.system.n
    costates = np.zeros((intervals + 1, n))
    costates[-1, fixed] = multiplier
    costates[-1] += h / 2 * here.phi_q[-1]
    for k in range(intervals - 1, -1, -1):
        costates[k] = here.Ad[k].T @ costates[k + 1] + (h if k > 0 else h / 2) * here.phi_q[k]
    times = np.linspace(0.0, problem.horizon, intervals + 1)
    return here.cost, Path(times, here.X, costates), here.U


def _quadratic_step(
    H: np.ndarray,
    g: np.ndarray,
    G: np.ndarray,
    c: np.ndarray,
    moving: np.ndarray,
    lowest: np.ndarray,
    highest: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Minimum of 1/2 d'Hd + g'd subject to G d = c, where what is not `moving` goes to its bound; with multipliers."""
    move = np.zeros(len(g))
    held = ~moving
    # To the bound that is nearer.
    move[held] = np.where(np.abs(lowest[held]) < np.abs(highest[held]), lowest[held], highest[held])
    block = H[np.ix_(moving, moving)]
    rhs = np.column_stack([-(g[moving] + np.einsum("ij,j->i", H[np.ix_(moving, held)], move[held])), G[:, moving].T])
    # The state cost need not be convex: enough is added to the diagonal to make the step one of descent.
    extra = 0.0
    solved = rhs.copy()
    while not solve_positive(block + extra * np.eye(len(block)), solved):
        extra = max(4.0 * extra, 1e-3 * float(np.abs(np.diag(block)).max(initial=1e-300)))
        solved = rhs.copy()
    free_move, spread = solved[:, 0], solved[:, 1:]
    gram = G[:, moving] @ spread
    wanted = c - G[:, held] @ move[held]
    multiplier = np.linalg.lstsq(gram, G[:, moving] @ free_move - wanted, rcond=1e-10)[0]
    move[moving] = free_move - spread @ multiplier
    return move, multiplier


def _evaluate(problem: OptimalControlProblem, U: np.ndarray) -> _Point | None:
    arrays, n, m = problem.arrays, problem.system.n, problem.system.m
    intervals = len(U)
    h = problem.horizon / intervals
    X, phi = np.empty((intervals + 1, n)), np.empty(intervals + 1)
    Ad, Bd = np.empty((intervals, n, n)), np.empty((intervals, n, m))
    phi_q, phi_qq = np.empty((intervals + 1, n)), np.empty((intervals + 1, n, n))
    arguments = (arrays.start, np.ascontiguousarray(U), h, arrays.data, arrays.field, X, phi, Ad, Bd, phi_q, phi_qq)
    if not _roll_out(arrays.flow, arrays.control, *arguments):
        return None
    effort = 0.5 * h * float(np.sum(np.asarray(problem.control_weight) * U**2))
    cost = effort + h * float(phi.sum() - (phi[0] + phi[-1]) / 2)
    if not (math.isfinite(cost) and all(np.isfinite(a).all() for a in (Ad, Bd, phi_q, phi_qq))):
        return None
    miss = (X[-1] - arrays.goal)[~arrays.free]
    return _Point(U, X, Ad, Bd, phi_q, phi_qq, cost, miss)


def _bounds(problem: OptimalControlProblem) -> tuple[np.ndarray, np.ndarray]:
    m = problem.system.m
    return problem.arrays.data[m : 2 * m], problem.arrays.data[2 * m : 3 * m]


def _clip(problem: OptimalControlProblem, U: np.ndarray) -> np.ndarray:
    return np.clip(U, *_bounds(problem))
