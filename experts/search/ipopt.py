"""Direct transcription of a scenario with CasADi and IPOPT (extra `bench`), an independent check of the search."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory

TOLERANCE, MAX_ITERATIONS = 1e-6, 300


class Transcription:
    """Trapezoidal transcription of a scenario, built once and solved from several initial guesses.

    Args:
        scenario: the scenario.
        intervals: number of time intervals.

    """

    def __init__(self, scenario: Scenario, intervals: int) -> None:
        cost, robot = scenario.cost, scenario.robot
        self._scenario, self._intervals = scenario, intervals
        q, u = casadi.SX.sym("q", 3, intervals + 1), casadi.SX.sym("u", 2, intervals + 1)
        goal = casadi.SX.sym("goal", 3)
        h = scenario.horizon / intervals
        v, w = u[0, :], u[1, :]
        rates = casadi.vertcat(v * casadi.cos(q[2, :]), v * casadi.sin(q[2, :]), w)
        running = (cost.speed_weight * v**2 + cost.turn_weight * w**2) / 2
        running += cost.proximity_weight * _proximity(scenario, q[0, :], q[1, :])
        steps = q[:, 1:] - q[:, :-1] - h / 2 * (rates[:, 1:] + rates[:, :-1])
        fixed = 3 if scenario.goal[2] is not None else 2
        constraints = casadi.vertcat(
            casadi.vec(steps), q[:, 0] - np.array(scenario.start), q[:fixed, -1] - goal[:fixed]
        )
        program = {
            "x": casadi.vertcat(casadi.vec(q), casadi.vec(u)),
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
        limits = [robot.max_speed, robot.max_turn_rate]
        self._limits = np.concatenate([np.full(3 * (intervals + 1), np.inf), np.tile(limits, intervals + 1)])

    def solve(self, problem: OptimalControlProblem, path: Trajectory) -> Trajectory | None:
        """Solve from an initial guess.

        Args:
            problem: the problem, whose goal has the winding of the guess.
            path: the initial guess.

        Returns:
            A local optimum, None if IPOPT does not converge.

        """
        times = np.linspace(0.0, self._scenario.horizon, self._intervals + 1)
        states = path.resample(times).states
        rates = np.gradient(states, times, axis=0)
        speed = rates[:, 0] * np.cos(states[:, 2]) + rates[:, 1] * np.sin(states[:, 2])
        guess = np.concatenate([states.ravel(), np.stack([speed, rates[:, 2]], axis=1).ravel()])
        zero = np.zeros(self._count)
        goal = problem.arrays.goal
        found = self._solver(x0=guess, p=goal, lbx=-self._limits, ubx=self._limits, lbg=zero, ubg=zero)
        if not self._solver.stats()["success"]:
            return None
        return Trajectory(times, np.array(found["x"]).ravel()[: states.size].reshape(-1, 3))


def _proximity(scenario: Scenario, x: Any, y: Any) -> Any:
    """The proximity cost divided by its weight, written independently of the kernels."""
    sigma, radius = scenario.cost.proximity_scale, scenario.robot.radius
    x_min, y_min, x_max, y_max = scenario.arena
    total = 0
    for distance in (x - x_min, x_max - x, y - y_min, y_max - y):
        total += casadi.exp(-(distance - radius) / sigma)
    for obstacle in scenario.obstacles:
        if obstacle.circle is not None:
            (cx, cy), r = obstacle.circle.center, obstacle.circle.radius
            total += casadi.exp(-(casadi.sqrt((x - cx) ** 2 + (y - cy) ** 2 + 1e-6) - r - radius) / sigma)
        elif obstacle.polygon is not None:
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
