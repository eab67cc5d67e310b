"""Direct transcription of a scenario's problem: a path to the nearest local optimum of its discretisation, in 0.2 ms.

Constant controls on each interval move the robot along exact arcs; the cost of being near obstacles is the trapezoidal
rule's. The discrete problem is solved by sequential quadratic programming, each step by a Riccati recursion (linear in
the number of intervals), with multipliers for the end conditions swept along (Bryson and Ho, Applied Optimal Control,
1975, section 5.3). The Hessian is exact, shifted until the recursion shows it to be positive definite, so that a step
descends and saddles are left; the line search is on the augmented Lagrangian, which does not stall on curved
constraints as penalties do (Nocedal and Wright, Numerical Optimization, 2006, chapters 15, 17 and 18).

The result is no extremal: its cost is off by the square of the interval (a thousandth, at the default). But it tells
which paths are promising and which are the same, and its multipliers are the costates from which multiple shooting
needs three or four Newton steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.envs.obstacles import proximity
from leapnav.experts.integrator import constant, cube, matrix, vector
from leapnav.experts.problem import OptimalControlProblem, Path

# Intervals per piece of a lattice path (0.2 to 0.45 m), and in all.
DENSITY, FEWEST, MOST = 2.0, 32, 1024
ITERATIONS, HALVINGS = 40, 5
CLOSE = 1e-3  # of the scale of the path: converged when a full step is smaller
# In units of the horizon and of the cost: a first shift of the Hessian, the largest one, and penalties on the end
# conditions (in the recursion) and on all constraints (in the line search).
SHIFT, LARGEST_SHIFT, END_PENALTY, PENALTY = 100.0, 1e7, 1e4, 300.0
ACTIVE_SETS = 8  # rounds of a step in which the controls at their limits are found
flags = types.Array(boolean, 1, "C")
signs = types.Array(types.int8, 2, "C")


@dataclass(frozen=True)
class DirectPath:
    """A solution of the discretised problem.

    Attributes:
        times (N + 1,), states (N + 1, 3), controls (N, 2), costates (N + 1, 3).
        cost: J of the discretised problem.
        gap: sum of the constraints' violations.
        converged: whether the iteration converged.

    """

    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    cost: float
    gap: float
    converged: bool

    def refined(self) -> DirectPath:
        """The same path with every interval halved, not yet optimal for the finer discretisation."""
        times = np.interp(np.arange(2 * len(self.controls) + 1) / 2, np.arange(len(self.times)), self.times)
        states, costates = (
            np.stack([np.interp(times, self.times, column) for column in array.T], axis=1)
            for array in (self.states, self.costates)
        )
        controls = np.repeat(self.controls, 2, axis=0)
        return DirectPath(times, states, controls, costates, self.cost, self.gap, False)


def discretise(path: Path) -> DirectPath:
    """A lattice path as a start of the iteration: intervals of equal time, controls that follow it, no costates."""
    intervals = int(np.clip(DENSITY * (len(path.times) - 1), FEWEST, MOST))
    times = np.linspace(0.0, path.times[-1], intervals + 1)
    states = path.resample(times).states
    step = np.diff(states, axis=0)
    heading = (states[1:, 2] + states[:-1, 2]) / 2
    controls = np.column_stack([step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading), step[:, 2]])
    controls /= np.diff(times)[:, None]
    return DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False)


def optimise(problem: OptimalControlProblem, guess: DirectPath) -> DirectPath:
    """The local optimum of the discretised problem near a guess.

    Args:
        problem: of a scenario, with the goal heading's winding chosen.
        guess: times (N + 1,), and states, controls and costates that need not be consistent.

    """
    arrays = problem.arrays
    speed_weight = problem.control_weight[0]
    states, controls, costates = guess.states.copy(), guess.controls.copy(), guess.costates / speed_weight
    states[0] = arrays.start
    scale = max(math.dist(problem.start[:2], arrays.goal[:2]) / 5.0, 0.1)
    converged, cost, gap = descend(
        np.diff(guess.times),
        states,
        controls,
        costates,
        arrays.goal,
        arrays.free,
        problem.control_weight[1] / speed_weight,
        1.0 / speed_weight,
        arrays.data[4:6],
        arrays.field,
        CLOSE * min(scale, 1.0),
        ITERATIONS,
    )
    return DirectPath(guess.times, states, controls, costates * speed_weight, cost * speed_weight, gap, converged)


@njit(types.UniTuple(float64, 4)(float64, float64, float64, float64), cache=True, error_model="numpy", nogil=True)
def _arc(h, v, omega, theta):
    """Heading of an arc's chord, and the chord over its length with two derivatives in omega (a series to 1e-6)."""
    a = 0.5 * h * omega
    if abs(a) < 0.5:
        square = a * a
        s = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        s1 = -a / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0))
        s2 = -1.0 / 3.0 * (1.0 - 0.3 * square * (1.0 - square * 5.0 / 84.0))
    else:
        s = math.sin(a) / a
        s1 = (math.cos(a) - s) / a
        s2 = -s - 2.0 * s1 / a
    return theta + a, s, 0.5 * h * s1, 0.25 * h * h * s2


@njit(float64(vector, matrix, matrix, float64, float64, constant), cache=True, error_model="numpy", nogil=True)
def _cost(h, q, u, turn_weight, unit, field):
    """J of the discretised problem over the speed weight."""
    intervals = len(h)
    cost = 0.0
    for k in range(intervals + 1):
        weight = 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        cost += unit * weight * proximity(q[k, 0], q[k, 1], field)[0]
    for k in range(intervals):
        cost += 0.5 * h[k] * (u[k, 0] * u[k, 0] + turn_weight * u[k, 1] * u[k, 1])
    return cost


@njit(
    types.UniTuple(float64, 3)(vector, matrix, matrix, matrix, vector, vector, flags),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _violations(h, q, u, multipliers, end_multipliers, goal, free):
    """Sums over the violations of the constraints: of their sizes, times the multipliers, and of their squares."""
    intervals = len(h)
    gap, weighted, squares = 0.0, 0.0, 0.0
    for k in range(intervals):
        v, omega = u[k, 0], u[k, 1]
        heading, s, _, _ = _arc(h[k], v, omega, q[k, 2])
        gap_x = q[k, 0] + h[k] * v * s * math.cos(heading) - q[k + 1, 0]
        gap_y = q[k, 1] + h[k] * v * s * math.sin(heading) - q[k + 1, 1]
        gap_theta = q[k, 2] + h[k] * omega - q[k + 1, 2]
        gap += abs(gap_x) + abs(gap_y) + abs(gap_theta)
        squares += gap_x * gap_x + gap_y * gap_y + gap_theta * gap_theta
        row = multipliers[k + 1]
        weighted += row[0] * gap_x + row[1] * gap_y + row[2] * gap_theta
    for i in range(3):
        if not free[i]:
            miss = q[intervals, i] - goal[i]
            gap += abs(miss)
            squares += miss * miss
            weighted += end_multipliers[i] * miss
    return gap, weighted, squares


@njit(
    types.void(vector, matrix, matrix, matrix, vector, float64, float64, constant, matrix, cube, cube, matrix, cube),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _expand(h, q, u, costates, goal, turn_weight, unit, field, near, A, B, gaps, W):
    """Second-order expansion about a path.

    `near` (N + 1, 5): gradient and Hessian of the weighted proximity cost; `A` (N, 2, 1) and `B` (N, 2, 2): what x and
    y gain by heading and by controls; `gaps` (N, 3): violations; `W` (N, 3, 3): curvature of costates times dynamics in
    (theta, v, omega).
    """
    intervals = len(h)
    for k in range(intervals + 1):
        weight = unit * 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        _, gx, gy, hxx, hxy, hyy = proximity(q[k, 0], q[k, 1], field)
        near[k, 0], near[k, 1] = weight * gx, weight * gy
        near[k, 2], near[k, 3], near[k, 4] = weight * hxx, weight * hxy, weight * hyy
    for k in range(intervals):
        v, omega = u[k, 0], u[k, 1]
        heading, s, s1, s2 = _arc(h[k], v, omega, q[k, 2])
        c, d, half = math.cos(heading), math.sin(heading), 0.5 * h[k]
        way = h[k] * v
        gaps[k, 0] = q[k, 0] + way * s * c - q[k + 1, 0]
        gaps[k, 1] = q[k, 1] + way * s * d - q[k + 1, 1]
        gaps[k, 2] = q[k, 2] + h[k] * omega - q[k + 1, 2]
        A[k, 0, 0], A[k, 1, 0] = -way * s * d, way * s * c
        B[k, 0, 0], B[k, 0, 1] = h[k] * s * c, way * (s1 * c - half * s * d)
        B[k, 1, 0], B[k, 1, 1] = h[k] * s * d, way * (s1 * d + half * s * c)
        along = costates[k + 1, 0] * c + costates[k + 1, 1] * d
        across = costates[k + 1, 1] * c - costates[k + 1, 0] * d
        W[k, 0, 0] = -way * s * along
        W[k, 0, 1] = W[k, 1, 0] = h[k] * s * across
        W[k, 0, 2] = W[k, 2, 0] = way * (s1 * across - half * s * along)
        W[k, 1, 1] = 0.0
        W[k, 1, 2] = W[k, 2, 1] = h[k] * (s1 * along + half * s * across)
        W[k, 2, 2] = way * (s2 * along + 2.0 * s1 * half * across - s * half * half * along)


@njit(
    boolean(
        vector, matrix, signs, vector, vector, flags, float64, constant, float64, float64, boolean,
        matrix, cube, cube, matrix, cube, cube, matrix, cube, matrix, cube, cube, matrix, vector,
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)  # fmt: skip
def _backward(
    h, u, held, end, goal, free, turn_weight, limits, shift, penalty, convex,
    near, A, B, gaps, W, P, p, F, step, gain, end_gain, G, g,
):  # fmt: skip
    """Riccati recursion of the quadratic model; False if it is not convex.

    The model's value at node k is 1/2 dq'P dq + p'dq + dq'F nu + 1/2 nu'G nu + g'nu, the controls that minimise it are
    -(step + gain dq + end_gain nu). `convex`: the curvature of the dynamics and negative curvature of the proximity
    cost are left out, for a start far from any optimum. `held` (N, 2): signs of the limits at which controls are held.
    """
    intervals = len(h)
    P[intervals] = 0.0
    p[intervals] = 0.0
    F[intervals] = 0.0
    G[:] = 0.0
    g[:] = 0.0
    for i in range(3):
        if not free[i]:
            # A penalty on what the end condition forbids changes no solution, and makes the recursion convex.
            P[intervals, i, i] = penalty
            p[intervals, i] = -penalty * (goal[i] - end[i])
            F[intervals, i, i] = 1.0
    Qux, Fu, PA, PB = np.empty((2, 3)), np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 2))
    b = np.zeros((3, 2))
    pc, Qu = np.empty(3), np.empty(2)
    for k in range(intervals, -1, -1):
        hxx, hxy, hyy = near[k, 2], near[k, 3], near[k, 4]
        if convex:
            mean, spread = 0.5 * (hxx + hyy), math.hypot(0.5 * (hxx - hyy), hxy)
            if mean < spread:
                # What remains is the larger eigenvalue, if positive, with its direction.
                largest = max(mean + spread, 0.0)
                xx = 0.5 + 0.25 * (hxx - hyy) / spread
                hxy = largest * 0.5 * hxy / spread
                hxx, hyy = largest * xx, largest * (1.0 - xx)
        if k < intervals:
            after, last, before = P[k + 1], p[k + 1], F[k + 1]
            a0, a1 = A[k, 0, 0], A[k, 1, 0]
            b[0, 0], b[0, 1], b[1, 0], b[1, 1], b[2, 1] = B[k, 0, 0], B[k, 0, 1], B[k, 1, 0], B[k, 1, 1], h[k]
            for i in range(3):
                pc[i] = last[i] + after[i, 0] * gaps[k, 0] + after[i, 1] * gaps[k, 1] + after[i, 2] * gaps[k, 2]
                PA[i, 0], PA[i, 1] = after[i, 0], after[i, 1]
                PA[i, 2] = after[i, 2] + after[i, 0] * a0 + after[i, 1] * a1
                for j in range(2):
                    PB[i, j] = after[i, 0] * b[0, j] + after[i, 1] * b[1, j] + after[i, 2] * b[2, j]
            for j in range(2):
                weight = h[k] if j == 0 else h[k] * turn_weight
                Qu[j] = weight * u[k, j] + b[0, j] * pc[0] + b[1, j] * pc[1] + b[2, j] * pc[2]
                for i in range(3):
                    Qux[j, i] = b[0, j] * PA[0, i] + b[1, j] * PA[1, i] + b[2, j] * PA[2, i]
                Fu[j, 0] = b[0, j] * before[0, 0] + b[1, j] * before[1, 0] + b[2, j] * before[2, 0]
                Fu[j, 1] = b[0, j] * before[0, 1] + b[1, j] * before[1, 1] + b[2, j] * before[2, 1]
                Fu[j, 2] = b[0, j] * before[0, 2] + b[1, j] * before[1, 2] + b[2, j] * before[2, 2]
            q00 = h[k] + b[0, 0] * PB[0, 0] + b[1, 0] * PB[1, 0]
            q01 = b[0, 0] * PB[0, 1] + b[1, 0] * PB[1, 1]
            q11 = h[k] * turn_weight + b[0, 1] * PB[0, 1] + b[1, 1] * PB[1, 1] + b[2, 1] * PB[2, 1]
            w_theta = 0.0
            if not convex:
                w_theta = W[k, 0, 0]
                Qux[0, 2] += W[k, 0, 1]
                Qux[1, 2] += W[k, 0, 2]
                q01 += W[k, 1, 2]
                q11 += W[k, 2, 2]
            held_0, held_1 = held[k, 0] != 0, held[k, 1] != 0
            determinant = q00 * q11 - q01 * q01
            if held_0 or held_1:
                i00 = 0.0 if held_0 else 1.0 / q00
                i11 = 0.0 if held_1 else 1.0 / q11
                i01 = 0.0
                definite = (held_0 or q00 > 1e-9 * h[k]) and (held_1 or q11 > 1e-9 * h[k] * turn_weight)
            else:
                i00, i01, i11 = q11 / determinant, -q01 / determinant, q00 / determinant
                definite = q00 > 1e-9 * h[k] and determinant > 1e-12 * h[k] * h[k] * turn_weight
            if not definite:
                return False
            # A held control goes to its limit, whatever the others do.
            to_0, to_1 = held[k, 0] * limits[0] - u[k, 0], held[k, 1] * limits[1] - u[k, 1]
            push_0 = Qu[0] + (q01 * to_1 if held_1 else 0.0)
            push_1 = Qu[1] + (q01 * to_0 if held_0 else 0.0)
            step[k, 0] = -to_0 if held_0 else i00 * push_0 + i01 * push_1
            step[k, 1] = -to_1 if held_1 else i01 * push_0 + i11 * push_1
            for i in range(3):
                gain[k, 0, i], gain[k, 1, i] = i00 * Qux[0, i] + i01 * Qux[1, i], i01 * Qux[0, i] + i11 * Qux[1, i]
                end_gain[k, 0, i], end_gain[k, 1, i] = i00 * Fu[0, i] + i01 * Fu[1, i], i01 * Fu[0, i] + i11 * Fu[1, i]
            for i in range(3):
                for j in range(3):
                    value = PA[i, j] if i < 2 else PA[2, j] + a0 * PA[0, j] + a1 * PA[1, j]
                    P[k, i, j] = value - Qux[0, i] * gain[k, 0, j] - Qux[1, i] * gain[k, 1, j]
                    value = before[i, j] if i < 2 else before[2, j] + a0 * before[0, j] + a1 * before[1, j]
                    F[k, i, j] = value - Qux[0, i] * end_gain[k, 0, j] - Qux[1, i] * end_gain[k, 1, j]
                    G[i, j] -= Fu[0, i] * end_gain[k, 0, j] + Fu[1, i] * end_gain[k, 1, j]
                value = pc[i] if i < 2 else pc[2] + a0 * pc[0] + a1 * pc[1]
                p[k, i] = value - Qux[0, i] * step[k, 0] - Qux[1, i] * step[k, 1]
                g[i] += before[0, i] * gaps[k, 0] + before[1, i] * gaps[k, 1] + before[2, i] * gaps[k, 2]
                g[i] -= Fu[0, i] * step[k, 0] + Fu[1, i] * step[k, 1]
            P[k, 2, 2] += w_theta
        p[k, 0] += near[k, 0]
        p[k, 1] += near[k, 1]
        duration = h[min(k, intervals - 1)]
        P[k, 0, 0] += hxx + shift * duration
        P[k, 0, 1] += hxy
        P[k, 1, 0] += hxy
        P[k, 1, 1] += hyy + shift * duration
        P[k, 2, 2] += turn_weight * shift * duration
    return True


@njit(boolean(matrix, vector, vector, vector, flags, vector), cache=True, error_model="numpy", nogil=True)
def _end_multipliers(G, g, end, goal, free, nu):
    """Solves G nu = goal - end - g over the fixed components; False if G is not negative definite."""
    for i in range(3):
        nu[i] = 0.0 if free[i] else goal[i] - end[i] - g[i]
        if free[i]:
            G[i, i] = -1.0
    for i in range(3):
        if not G[i, i] < 0.0:
            return False
        for j in range(i + 1, 3):
            factor = G[j, i] / G[i, i]
            for m in range(i, 3):
                G[j, m] -= factor * G[i, m]
            nu[j] -= factor * nu[i]
    for i in range(2, -1, -1):
        for j in range(i + 1, 3):
            nu[i] -= G[i, j] * nu[j]
        nu[i] /= G[i, i]
    return True


@njit(
    types.Tuple((boolean, float64, float64))(
        vector, matrix, matrix, matrix, vector, flags, float64, float64, constant, constant, float64, int64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def descend(h, q, u, costates, goal, free, turn_weight, unit, limits, field, tolerance, max_iterations):
    """Sequential quadratic programming on states (N + 1, 3), controls (N, 2) and costates (N + 1, 3), in place.

    The cost is in units of the speed weight: `turn_weight` and Phi (by `unit`) are divided by it. Returns (converged,
    cost, sum of the constraints' violations).
    """
    intervals = len(h)
    horizon = h.sum()
    first_shift, largest_shift = SHIFT / horizon**2, LARGEST_SHIFT / horizon**2
    near, gaps = np.empty((intervals + 1, 5)), np.empty((intervals, 3))
    A, B, W = np.empty((intervals, 2, 1)), np.empty((intervals, 2, 2)), np.empty((intervals, 3, 3))
    P, p, F = np.empty((intervals + 1, 3, 3)), np.empty((intervals + 1, 3)), np.empty((intervals + 1, 3, 3))
    step, gain, end_gain = np.empty((intervals, 2)), np.empty((intervals, 2, 3)), np.empty((intervals, 2, 3))
    G, g, nu = np.empty((3, 3)), np.empty(3), np.zeros(3)
    dq, du, multipliers = np.zeros((intervals + 1, 3)), np.empty((intervals, 2)), np.zeros((intervals + 1, 3))
    new_q, new_u = np.empty((intervals + 1, 3)), np.empty((intervals, 2))
    held = np.zeros((intervals, 2), dtype=np.int8)
    for k in range(intervals):
        for j in range(2):
            u[k, j] = min(max(u[k, j], -limits[j]), limits[j])
    cold = not np.any(costates)
    current = _cost(h, q, u, turn_weight, unit, field)
    shift, largest, cost, gap = 0.0, 0.0, np.inf, np.inf
    for _ in range(max_iterations):
        _expand(h, q, u, costates, goal, turn_weight, unit, field, near, A, B, gaps, W)
        for _ in range(ACTIVE_SETS):
            while not (
                _backward(
                    h, u, held, q[intervals], goal, free, turn_weight, limits, shift, END_PENALTY / horizon, cold,
                    near, A, B, gaps, W, P, p, F, step, gain, end_gain, G, g,
                )
                and _end_multipliers(G, g, q[intervals], goal, free, nu)
            ):  # fmt: skip
                shift = max(4.0 * shift, first_shift)
                if not shift <= largest_shift:
                    return False, current, _violations(h, q, u, multipliers, nu, goal, free)[0]
            largest = 0.0
            for k in range(intervals):
                for j in range(2):
                    du[k, j] = -step[k, j]
                    for i in range(3):
                        du[k, j] -= gain[k, j, i] * dq[k, i] + end_gain[k, j, i] * nu[i]
                for i in range(2):
                    dq[k + 1, i] = dq[k, i] + A[k, i, 0] * dq[k, 2] + gaps[k, i]
                    dq[k + 1, i] += B[k, i, 0] * du[k, 0] + B[k, i, 1] * du[k, 1]
                dq[k + 1, 2] = dq[k, 2] + h[k] * du[k, 1] + gaps[k, 2]
                largest = max(largest, abs(dq[k + 1, 0]), abs(dq[k + 1, 1]), abs(dq[k + 1, 2]))
            for k in range(intervals + 1):
                for i in range(3):
                    multipliers[k, i] = p[k, i]
                    for j in range(3):
                        multipliers[k, i] += P[k, i, j] * dq[k, j] + F[k, i, j] * nu[j]
            changed = False
            for k in range(intervals):
                for j in range(2):
                    weight = h[k] if j == 0 else h[k] * turn_weight
                    value = u[k, j] + du[k, j]
                    if held[k, j] != 0:
                        slope = weight * value + B[k, 0, j] * multipliers[k + 1, 0] + B[k, 1, j] * multipliers[k + 1, 1]
                        slope += h[k] * multipliers[k + 1, 2] if j == 1 else 0.0
                        if held[k, j] * slope > 0.0:  # inwards is cheaper
                            held[k, j], changed = 0, True
                    elif abs(value) > limits[j] * (1.0 + 1e-9):
                        held[k, j], changed = (1 if value > 0.0 else -1), True
            if not changed:
                break
        _, weighted, squares = _violations(h, q, u, multipliers, nu, goal, free)
        before = current + weighted + PENALTY / horizon * squares
        damping, descends = 1.0, False
        cost, gap = np.inf, np.inf
        for _ in range(HALVINGS):
            for k in range(intervals + 1):
                for i in range(3):
                    new_q[k, i] = q[k, i] + damping * dq[k, i]
            for k in range(intervals):
                for j in range(2):
                    new_u[k, j] = min(max(u[k, j] + damping * du[k, j], -limits[j]), limits[j])
            cost = _cost(h, new_q, new_u, turn_weight, unit, field)
            gap, weighted, squares = _violations(h, new_q, new_u, multipliers, nu, goal, free)
            descends = cost + weighted + PENALTY / horizon * squares <= before + 1e-9 * abs(before)
            if descends:
                break
            damping *= 0.5
        if not descends:
            shift = max(8.0 * shift, first_shift)
            if shift > largest_shift:
                return False, cost, gap
            continue
        q[:] = new_q
        u[:] = new_u
        current = cost
        share = 1.0 if cold else damping
        for k in range(intervals + 1):
            for i in range(3):
                costates[k, i] += share * (multipliers[k, i] - costates[k, i])
        if damping == 1.0 and largest < tolerance and shift <= first_shift:
            return True, cost, gap
        cold = False
        if damping == 1.0:
            shift = 0.25 * shift if shift > 0.01 * first_shift else 0.0
        elif damping < 0.3:
            shift = max(4.0 * shift, first_shift)
    return False, cost, gap
