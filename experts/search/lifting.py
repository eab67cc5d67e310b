"""Initial guesses in the state space of the robot, from the poses of candidate paths."""

from __future__ import annotations

from typing import Any

import numpy as np

from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.dynamics import least_squares_controls
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.path_class import SeenPaths, shape_of
from leapnav.experts.transcription.direct import discretise, optimise

MAX_LIMIT = 1e3  # m/s or rad/s, for robots without a limit of the speed or the turn rate
# Two paths of the kinematic robot are duplicates if they stay within this distance of each other (m, and rad).
DUPLICATE_DISTANCE = 0.05


class Lifting:
    """The paths of a robot from paths of poses.

    Candidates of a robot that is not kinematic are optimised for a kinematic robot with the same footprint and limits
    first: a lattice path has corners, which the robot cannot follow.

    Args:
        scenario: the scenario.
        problem: its optimal control problem.
        relaxed_weight: proximity weight of the relaxed barrier, see `optimise`.

    """

    def __init__(self, scenario: Scenario, problem: OptimalControlProblem, relaxed_weight: float) -> None:
        self._scenario, self._problem, self._relaxed_weight = scenario, problem, relaxed_weight
        self._companion: OptimalControlProblem | None = None
        self._seen = SeenPaths(DUPLICATE_DISTANCE)
        if not scenario.robot.is_kinematic:
            self._kinematic = scenario.robot.kinematic() or _unicycle(scenario.robot)
            update = {"robot": self._kinematic, "start_motion": None, "goal_motion": None}
            companion = OptimalControlProblem.from_scenario(scenario.model_copy(update=update))
            self._companion = companion.with_barrier(problem.barrier_weight)

    def __call__(self, path: Trajectory) -> Trajectory | None:
        """Return the path in the robot's states, or None for a duplicate of an earlier path."""
        if path.states.shape[1] > 3:
            return path
        lifted = self._lift(path)
        return None if lifted is None else self._timed(lifted)

    def _timed(self, path: Trajectory) -> Trajectory:
        """Return a path with the time as its last state, among moving obstacles."""
        if self._problem.system.clock is None:
            return path
        return Trajectory(path.times, np.column_stack([path.states, path.times]))

    def _lift(self, path: Trajectory) -> Trajectory | None:
        if self._companion is not None:
            lifted = self._kinematic.lift(path.times, path.states, self._companion.start)
            lifted = self._timed(path if lifted is None else Trajectory(path.times, lifted))
            companion = self._companion.with_winding_of(lifted.states)
            direct = optimise(companion, discretise(companion, lifted), relaxed_weight=self._relaxed_weight)
            shape = shape_of(direct.times, direct.states)
            if self._seen.contain(shape):
                return None
            self._seen.add(shape)
            path = Trajectory(direct.times, direct.states[:, :3])
        if len(self._scenario.robot.state_names) == 3:
            return path
        start = self._scenario.start_state
        states = self._scenario.robot.lift(path.times, path.states, start)
        return Trajectory(path.times, self._integrated(path, start) if states is None else states)

    def _integrated(self, path: Trajectory, start: tuple[float, ...]) -> np.ndarray:
        """Return the path with the further states that result from controls which follow its poses best."""
        poses, times = path.states, path.times
        states = np.column_stack([poses, np.tile(start[3:], (len(poses), 1))])
        for k in range(len(times) - 1):
            step = times[k + 1] - times[k]
            row = states[k : k + 1].copy()
            row[0, :3] = 0.5 * (poses[k] + poses[k + 1])
            (drift,), (fields,) = self._problem.dynamics(self._timed(Trajectory(times[k : k + 1], row)).states)
            rates = (poses[k + 1] - poses[k]) / step - drift[:3]
            (controls,) = least_squares_controls(fields[None, :3], rates[None])
            states[k + 1, 3:] = states[k, 3:] + step * (drift + fields @ controls)[3 : states.shape[1]]
        return states


def _unicycle(robot: RobotModel) -> Unicycle:
    """Return a unicycle with the footprint and the limits of a robot."""
    speed, turn_rate = (min(limit, MAX_LIMIT) for limit in robot.speed_limits())
    limits: dict[str, Any] = {"max_speed": speed, "max_turn_rate": turn_rate}
    return Unicycle(footprint=robot.footprint, **limits) if robot.footprint else Unicycle(radius=robot.radius, **limits)
