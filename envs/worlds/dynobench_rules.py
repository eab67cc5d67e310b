"""The rules of dynobench for a trajectory, written independently of the simulation and of the kernels of distances.

A trajectory is a sequence of states with a fixed time step, and of actions that are held between them. It is accepted
if each state follows from the one before by a step of Euler's method, if it starts and ends at the given states, if
the boxes do not overlap, and if states and actions are within their limits, each up to a tolerance (`Trajectory::check`
and `Feasibility_thresholds` in the repository of dynobench).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import pymunk

from leapnav.envs.robots import Box, DynamicUnicycle, RobotModel, Trailer
from leapnav.envs.robots.footprints import corners_of, outline_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.worlds.dynobench import DynobenchProblem

# `evaluate(times)` -> states (K, n) at times (s).
Evaluation = Callable[[np.ndarray], np.ndarray]


class DiscreteTrajectory(NamedTuple):
    """A trajectory of dynobench, in its states and actions.

    Attributes:
        states (N + 1, n): x, y, heading; then speed and turn rate, or the heading of the trailer.
        actions (N, 2): speed and turn rate, their derivatives, or speed and steering angle.

    """

    states: np.ndarray
    actions: np.ndarray


@dataclass(frozen=True)
class Violations:
    """The largest violation of each rule, see `TOLERANCES`.

    Attributes:
        jump: distance between a state and the step of Euler's method from the state before.
        start, goal: distances from the given states.
        collision: depth (m) of an overlap.
        state, action: distances from the limits.

    """

    jump: float
    start: float
    goal: float
    collision: float
    state: float
    action: float

    @property
    def broken(self) -> dict[str, float]:
        """The violations that exceed the tolerance, by the name of the rule."""
        sizes = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: size for name, size in sizes.items() if size >= getattr(TOLERANCES, name)}


TOLERANCES = Violations(jump=0.01, start=0.03, goal=0.03, collision=0.01, state=0.01, action=0.01)


def discretise(problem: DynobenchProblem, evaluate: Evaluation, duration: float) -> DiscreteTrajectory:
    """Return a path in the time steps of dynobench, stretched to a multiple of the step.

    The error of Euler's method is of first order if all states are taken at the same time. Headings and velocities
    are therefore taken half a step later than positions, up to the end of the path.

    Args:
        problem: a problem with a scenario.
        evaluate: the states of the path of the scenario's robot at times (K,) (s).
        duration: of the path (s).

    """
    scenario, step = _scenario(problem), problem.time_step
    count = max(math.ceil(duration / step - 1e-6), 1)
    times = np.linspace(0.0, duration, count + 1)
    states = evaluate(times)
    later = evaluate(np.minimum(times + duration / count / 2.0, duration))
    heading = later[:, 2]
    moved = np.diff(states[:, :2], axis=0) / step
    speed = moved[:, 0] * np.cos(heading[:-1]) + moved[:, 1] * np.sin(heading[:-1])
    turn_rate = np.diff(heading) / step
    rows, actions = [*states[:, :2].T, heading], [speed, turn_rate]
    if isinstance(scenario.robot, DynamicUnicycle):
        velocities = [np.append(values, later[-1, 3 + k]) for k, values in enumerate(actions)]
        rows, actions = [*rows, *velocities], [np.diff(values) / step for values in velocities]
    elif isinstance(scenario.robot, Trailer):
        rows.append(states[:, 2] + states[:, -1])
        actions[1] = np.arctan(scenario.robot.wheelbase * turn_rate / np.where(speed == 0.0, np.inf, speed))
    return DiscreteTrajectory(np.column_stack(rows), np.column_stack(actions))


def check_trajectory(problem: DynobenchProblem, trajectory: DiscreteTrajectory) -> Violations:
    """Check a trajectory by the rules of dynobench."""
    scenario, (states, actions) = _scenario(problem), trajectory
    robot, weights = scenario.robot, problem.distance_weights
    ends = [
        [*given[:3], *(given[3:] if isinstance(robot, DynamicUnicycle) else ())]
        for given in (scenario.start_state, scenario.goal_state)
    ]
    if isinstance(robot, Trailer):
        for end, given in zip(ends, (scenario.start_state, scenario.goal_state), strict=True):
            end.append((given[2] or 0.0) + (given[-1] or 0.0))
    angles = (2, 3) if isinstance(robot, Trailer) else (2,)

    def distance(first: np.ndarray, second: np.ndarray) -> float:
        gaps = np.abs(first - second)
        for k in angles:
            gaps[k] = abs(math.remainder(gaps[k], 2.0 * math.pi))
        return float(np.dot(weights, [math.hypot(gaps[0], gaps[1]), *gaps[2:]]))

    followed = states[:-1] + problem.time_step * _rates(robot, states[:-1], actions)
    low, high = _limits(scenario)
    first, last = (np.array(end, dtype=float) for end in ends)
    return Violations(
        jump=max(distance(a, b) for a, b in zip(followed, states[1:], strict=True)),
        start=distance(states[0], first),
        goal=distance(states[-1], last),
        collision=_overlap(scenario, states),
        state=_beyond(states, low[:-2], high[:-2]),
        action=_beyond(actions, low[-2:], high[-2:]),
    )


def _scenario(problem: DynobenchProblem) -> Scenario:
    if problem.scenario is None:
        raise ValueError(f"problem: expected one with a scenario, got one that was left out: {problem.reason}")
    return problem.scenario


def _rates(robot: RobotModel, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return the derivatives of states (N, n) with actions (N, 2)."""
    heading = states[:, 2]
    if isinstance(robot, DynamicUnicycle):
        speed, turn_rate = states[:, 3:].T
        further = [*actions.T]
    elif isinstance(robot, Trailer):
        speed = actions[:, 0]
        turn_rate = speed / robot.wheelbase * np.tan(actions[:, 1])
        further = [speed / robot.hitch_length * np.sin(heading - states[:, 3])]
    else:
        speed, turn_rate = actions.T
        further = []
    return np.column_stack([speed * np.cos(heading), speed * np.sin(heading), turn_rate, *further])


def _limits(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest values of states and actions."""
    robot, (x_min, y_min, x_max, y_max) = scenario.robot, scenario.arena
    low, high = [x_min, y_min, -math.inf], [x_max, y_max, math.inf]
    if isinstance(robot, Trailer):
        pairs = [(-math.inf, math.inf), robot.interval("speed"), (-robot.max_steering, robot.max_steering)]
    else:
        pairs = [robot.interval(name) for name in (*robot.limited_states, *robot.limited)]
    return np.array([*low, *(pair[0] for pair in pairs)]), np.array([*high, *(pair[1] for pair in pairs)])


def _beyond(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    return float(max(np.maximum(low - values, values - high).max(), 0.0))


def _overlap(scenario: Scenario, states: np.ndarray) -> float:
    """Return the largest depth (m) by which a box of the robot overlaps an obstacle, by Chipmunk's contacts."""
    robot, body = scenario.robot, pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    outlines = [(outline_of(_box(robot.footprint)), False)]
    if isinstance(robot, Trailer):
        outlines.append((outline_of(_box(robot.trailer), -robot.hitch_length), True))
    space = pymunk.Space()
    for obstacle in scenario.obstacles:
        for part in obstacle.shape.parts():
            space.add(_polygon(space.static_body, part.rounded_polygon()[0].tolist()))
    deepest = 0.0
    for state in states.tolist():
        for outline, is_trailer in outlines:
            pose = [*state[:2], state[3] if is_trailer else state[2]]
            for row in outline.tolist():
                shape = _polygon(body, corners_of(row, pose).tolist())
                for found in space.shape_query(shape):
                    deepest = max(deepest, *(-point.distance for point in found.contact_point_set.points))
    return deepest


def _box(footprint: object) -> Box:
    if not isinstance(footprint, Box):
        raise ValueError(f"footprint: expected a box, got {footprint!r}")
    return footprint


def _polygon(body: pymunk.Body, vertices: Sequence[Sequence[float]]) -> pymunk.Poly:
    return pymunk.Poly(body, [(x, y) for x, y in vertices])
