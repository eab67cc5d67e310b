"""Direct transcription of a scenario with CasADi and IPOPT (extra `bench`), an independent check of the search."""

from __future__ import annotations

import math
from typing import Any

import casadi
import numpy as np
import sympy as sp

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Capsule
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.transcription.direct import follow_controls

TOLERANCE, MAX_ITERATIONS = 1e-6, 300


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
        for offset, radius in scenario.discs.tolist():
            x, y = q[0, :] + offset * casadi.cos(q[2, :]), q[1, :] + offset * casadi.sin(q[2, :])
            running += scenario.cost.proximity_weight * _proximity(scenario, x, y, radius)
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
        limits = scenario.robot.limits()
        upper = np.concatenate([np.full(n * (intervals + 1), np.inf), np.tile(limits, intervals + 1)])
        self._bounds = np.append(-upper, 0.0 if unknown else []), np.append(upper, np.inf if unknown else [])

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
        controls = follow_controls(problem, states, np.gradient(states, times, axis=0))
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


def _proximity(scenario: Scenario, x: Any, y: Any, radius: float) -> Any:
    """The proximity cost of a disc divided by its weight, written independently of the kernels."""
    sigma = scenario.cost.proximity_scale
    x_min, y_min, x_max, y_max = scenario.arena
    total = 0
    for distance in (x - x_min, x_max - x, y - y_min, y_max - y):
        total += casadi.exp(-(distance - radius) / sigma)
    for obstacle in scenario.obstacles:
        if obstacle.circle is not None:
            (cx, cy), r = obstacle.circle.center, obstacle.circle.radius
            total += casadi.exp(-(casadi.sqrt((x - cx) ** 2 + (y - cy) ** 2 + 1e-6) - r - radius) / sigma)
        elif isinstance(capsule := obstacle.shape, Capsule):
            total += casadi.exp(-(_capsule_distance(capsule, sigma, x, y) - radius) / sigma)
        elif obstacle.polygon is None:
            raise ValueError(f"obstacles: IPOPT supports circles, polygons and capsules, got {obstacle.shape.kind!r}")
        else:
            vertices = np.array(obstacle.polygon.vertices)
            edges = np.roll(vertices, -1, axis=0) - vertices
            normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
            centre = vertices.mean(axis=0)
            normals *= np.sign(np.sum(normals * (vertices - centre), axis=1))[:, None]
            offsets = np.sum(normals * vertices, axis=1)
            distances = [n[0] * x + n[1] * y - offset for n, offset in zip(normals, offsets, strict=True)]
            maximum = distances[0]
            for distance in distances[1:]:
                maximum = casadi.fmax(maximum, distance)
            normaliser = sum(casadi.exp((distance - maximum) / sigma) for distance in distances)
            total += casadi.exp((radius - maximum) / sigma) / normaliser
    return total


def _capsule_distance(capsule: Capsule, sigma: float, x: Any, y: Any) -> Any:
    """The smooth distance to a capsule; the excess beyond its ends is a difference of two softplus functions."""
    (ax, ay), (bx, by) = capsule.start, capsule.end
    length = math.dist(capsule.start, capsule.end)
    ux, uy = ((bx - ax) / length, (by - ay) / length) if length > 0 else (1.0, 0.0)
    along, across = (x - ax) * ux + (y - ay) * uy, (y - ay) * ux - (x - ax) * uy

    def softplus(z: Any) -> Any:
        return sigma * (casadi.fmax(z / sigma, 0) + casadi.log1p(casadi.exp(-casadi.fabs(z / sigma))))

    excess = softplus(along - length) - softplus(-along)
    return casadi.sqrt(excess**2 + across**2 + 1e-6) - capsule.radius
