"""Direct transcription of a scenario with CasADi and IPOPT (extra `bench`), an independent check of the search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np
import sympy as sp

from leapnav.envs.field.barrier import CONTACT
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory

TOLERANCE, MAX_ITERATIONS = 1e-6, 300
ROUNDING = 1e-9  # m, below which a square root is smooth


# CasADi's functions by their names in SymPy.
FUNCTIONS = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "log", "sqrt", "sinh", "cosh", "tanh")


class Transcription:
    """Trapezoidal transcription of a scenario, built once and solved from several initial guesses.

    Args:
        scenario: the scenario.
        problem: its optimal control problem.
        intervals: number of time intervals.

    """

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem, intervals: int) -> None:
        system = problem.system
        self._problem, self._intervals = problem, intervals
        n, m = system.n, system.m
        q, u = casadi.SX.sym("q", n, intervals + 1), casadi.SX.sym("u", m, intervals + 1)
        goal = casadi.SX.sym("goal", n)
        horizon = casadi.SX.sym("T") if scenario.horizon is None else casadi.SX(scenario.horizon)
        h = horizon / intervals
        functions = {name: getattr(casadi, name) for name in FUNCTIONS}
        symbols = (*system.state, *system.parameters)

        def evaluate(expression: Any) -> Any:
            function = sp.lambdify(symbols, expression, modules=[functions, "math"], cse=True)
            return function(*(q[i, :] for i in range(n)), *problem.parameters)

        rates = casadi.vertcat(
            *(
                evaluate(a) + sum(u[j, :] * evaluate(system.fields[j][i]) for j in range(m))
                for i, a in enumerate(system.drift)
            )
        )
        running = evaluate(sp.sympify(problem.state_cost)) + problem.time_weight
        for j, weight in enumerate(problem.control_weight):
            running += weight * u[j, :] ** 2 / 2
        for row in scenario.outline.tolist():
            running += scenario.cost.proximity_weight * _proximity(scenario, q, row)
        steps = q[:, 1:] - q[:, :-1] - h / 2 * (rates[:, 1:] + rates[:, :-1])
        fixed = [i for i, value in enumerate(problem.goal) if value is not None]
        constraints = casadi.vertcat(
            casadi.vec(steps), q[:, 0] - np.array(problem.start), *(q[i, -1] - goal[i] for i in fixed)
        )
        unknown = [horizon] if scenario.horizon is None else []
        program = {
            "x": casadi.vertcat(casadi.vec(q), casadi.vec(u), *unknown),
            "p": goal,
            "f": h * (casadi.sum2(running) - (running[0] + running[-1]) / 2),
            "g": constraints,
        }
        options = {
            "print_time": False,
            "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE, "max_iter": MAX_ITERATIONS},
        }
        self._solver: Any = casadi.nlpsol("solver", "ipopt", program, options)
        self._count = constraints.shape[0]
        low, high = scenario.robot.control_bounds().T
        limits = np.array([pair or (-np.inf, np.inf) for pair in problem.state_bounds or [None] * n])
        lower, upper = (
            np.append(np.tile(states, intervals + 1), np.tile(controls, intervals + 1))
            for states, controls in ((limits[:, 0], low), (limits[:, 1], high))
        )
        self._bounds = np.append(lower, 0.0 if unknown else []), np.append(upper, np.inf if unknown else [])

    def solve(self, problem: OptimalControlProblem, path: Trajectory) -> Trajectory | None:
        """Solve from an initial guess.

        Args:
            problem: the problem, whose goal has the winding of the guess.
            path: the initial guess, in the states of the problem.

        Returns:
            A local optimum, None if IPOPT does not converge.

        """
        horizon = problem.horizon_of(path)
        times = np.linspace(0.0, horizon, self._intervals + 1)
        states = path.resample(times).states
        controls = problem.follow(states, np.gradient(states, times, axis=0))
        guess = np.concatenate([states.ravel(), controls.ravel(), [horizon] if problem.horizon is None else []])
        zero = np.zeros(self._count)
        goal = problem.arrays.goal
        found = self._solver(x0=guess, p=goal, lbx=self._bounds[0], ubx=self._bounds[1], lbg=zero, ubg=zero)
        if not self._solver.stats()["success"]:
            return None
        values = np.array(found["x"]).ravel()
        if problem.horizon is None:
            times *= values[-1] / horizon
        return Trajectory(times, values[: states.size].reshape(states.shape))


def _proximity(scenario: Scenario, q: Any, row: Sequence[float]) -> Any:
    """The proximity cost of a disc or a rectangle divided by its weight, written independently of the kernels.

    Args:
        scenario: the scenario.
        q: states (n, N); among moving obstacles the time is the last one.
        row: of the outline.

    """
    rear, front, half_width, radius, joint = row
    axis = q[2, :] + (q[int(joint), :] if joint else 0.0)
    x, y, cos, sin = q[0, :], q[1, :], casadi.cos(axis), casadi.sin(axis)
    is_disc = rear == front
    corners = [(a, b) for a in {rear, front} for b in {half_width, -half_width}]
    points = [(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in corners]
    x_min, y_min, x_max, y_max = scenario.arena
    distances = [d for px, py in points for d in (px - x_min, x_max - px, py - y_min, y_max - py)]
    for obstacle, part in ((one, part) for one in scenario.obstacles for part in one.shape.parts()):
        vertices, rounding = part.rounded_polygon()
        dx, dy = _displacement(obstacle.knots, q[-1, :])
        if is_disc or len(np.unique(vertices, axis=0)) > 1:
            distances += [_polygon_distance(vertices, px - dx, py - dy) - rounding for px, py in points]
        if not is_disc:
            for vx, vy in np.unique(vertices, axis=0).tolist():
                ahead = (vx + dx - x) * cos + (vy + dy - y) * sin
                left = (vy + dy - y) * cos - (vx + dx - x) * sin
                distances.append(_rectangle_distance(ahead, left, rear, front, half_width) - rounding)
    return sum(_barrier((distance - radius) / scenario.cost.proximity_scale) for distance in distances)


def _displacement(knots: np.ndarray, time: Any) -> tuple[Any, Any]:
    """The displacement (x, y) of an obstacle with knots (K, 5): a sum of ramps, one for each change of the velocity."""
    changes = np.diff(knots[:, 3:], axis=0, prepend=0.0)
    ramps = [casadi.fmax(time - start, 0) for start in knots[:, 0].tolist()]
    dx, dy = (sum(change * ramp for change, ramp in zip(changes[:, i].tolist(), ramps, strict=True)) for i in (0, 1))
    return dx, dy


def _rectangle_distance(ahead: Any, left: Any, rear: float, front: float, half_width: float) -> Any:
    """The distance of a point in the frame of a rectangle; inside, the negative distance to the nearest side."""
    along, across = casadi.fmax(rear - ahead, ahead - front), casadi.fmax(left, -left) - half_width
    outside = casadi.sqrt(casadi.fmax(along, 0) ** 2 + casadi.fmax(across, 0) ** 2 + ROUNDING**2)
    inside = casadi.fmax(along, across)
    return casadi.if_else(inside < 0, inside, outside)


def _barrier(s: Any) -> Any:
    """The barrier function, and below CONTACT the quadratic polynomial with the same derivatives there."""
    b = 1 / math.expm1(CONTACT)
    slope, bend = -b * (1 + b), b * (1 + b) * (1 + 2 * b)
    beyond = casadi.fmin(s - CONTACT, 0)
    return 1 / casadi.expm1(casadi.fmax(s, CONTACT)) + beyond * slope + beyond**2 * bend / 2


def _polygon_distance(vertices: np.ndarray, x: Any, y: Any) -> Any:
    """The distance to a point, a segment or a convex polygon; inside, the negative distance to the nearest line."""
    following = np.roll(vertices, -1, axis=0)
    orientation = np.sign(np.sum(vertices[:, 0] * following[:, 1] - vertices[:, 1] * following[:, 0]))
    outside, inside = math.inf, -math.inf
    for (ax, ay), (bx, by) in zip(vertices.tolist(), following.tolist(), strict=True):
        length = math.hypot(bx - ax, by - ay)
        ux, uy = ((bx - ax) / length, (by - ay) / length) if length > 0 else (1.0, 0.0)
        along, across = (x - ax) * ux + (y - ay) * uy, (y - ay) * ux - (x - ax) * uy
        beyond = along - casadi.fmin(casadi.fmax(along, 0), length)
        outside = casadi.fmin(outside, casadi.sqrt(beyond**2 + across**2))
        inside = casadi.fmax(inside, -orientation * across)
    return casadi.if_else(inside < 0, inside, outside) if len(vertices) > 2 else outside
