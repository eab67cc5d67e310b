"""Baseline policies, which are not learned."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.unwrapping import unwrap

# Gains of the polar controller (rad/s per rad), per unit of the mean speed needed to arrive on time (m/s).
BEARING_GAIN, HEADING_GAIN = 3.0, -0.8
BRAKING_DISTANCE = 0.5  # m; closer to the goal, the speed is proportional to the distance if the horizon is free


class RandomPolicy:
    """Uniformly distributed actions.

    Args:
        action_space: the action space of a single environment.
        seed: random seed of the policy's own generator.

    """

    def __init__(self, action_space: gym.spaces.Space, seed: int = 0) -> None:
        assert isinstance(action_space, gym.spaces.Box)
        self._low, self._high = action_space.low, action_space.high
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return one random action for each observation."""
        count = np.asarray(observation).shape[:-1]
        return self._rng.uniform(self._low, self._high, (*count, *self._low.shape)).astype(np.float32), state


class GoToGoal:
    """Controller that drives to the goal pose and ignores obstacles.

    The turn rate is a weighted sum of the bearing of the goal and of the heading error that remains on arrival: the
    controller of M. Aicardi, G. Casalino, A. Bicchi and A. Balestrino, "Closed loop steering of unicycle-like vehicles
    via Lyapunov techniques" (1995), in the linear form of R. Siegwart and I. Nourbakhsh, "Introduction to Autonomous
    Mobile Robots". The robot drives forwards if the goal is ahead and backwards otherwise, at the speed that is needed
    to arrive on time; with a free horizon at the cruise speed, slower close to the goal.

    Args:
        env: the environment, single or vector; the speed limits are those of its scenarios.

    Raises:
        TypeError: the environment is not one of leapnav's.

    """

    def __init__(self, env: Any) -> None:
        self._envs = unwrap(env)
        robot = self._envs[0].settings.robot
        if robot != "unicycle":
            raise ValueError(f"go-to-goal: expected the robot 'unicycle', whose controls it computes, got {robot!r}")

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for observations (d,) or (N, d)."""
        rows = np.atleast_2d(observation).astype(float)
        ahead, left, cosine, sine = rows[:, :4].T
        if self._envs[0].settings.free_horizon:
            cruise_speeds = np.array([scenario.cruise_speed for scenario in self._scenarios()])
            needed_speed = cruise_speeds * np.minimum(np.hypot(ahead, left) / BRAKING_DISTANCE, 1.0)
        else:
            needed_speed = rows[:, 7]
        direction = np.where(ahead >= 0, 1.0, -1.0)
        bearing = np.arctan2(direction * left, direction * ahead)
        heading_is_free = (cosine == 0) & (sine == 0)
        heading_error = np.where(heading_is_free, 0.0, np.arctan2(sine, cosine) - bearing)
        heading_error = np.remainder(heading_error + math.pi, 2 * math.pi) - math.pi
        speed = direction * needed_speed
        turn_rate = np.abs(needed_speed) * (BEARING_GAIN * bearing + HEADING_GAIN * heading_error)
        controls = np.stack([speed, turn_rate], axis=1)
        robots = [scenario.robot for scenario in self._scenarios()]
        actions = np.stack([robot.actions(row) for robot, row in zip(robots, controls, strict=True)])
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32)
        return (actions if np.ndim(observation) > 1 else actions[0]), state

    def _scenarios(self) -> list[Scenario]:
        """Return the scenarios of all robots."""
        found: list[Scenario] = []
        for env in self._envs:
            found += [env.scenario] if isinstance(env, NavigateEnv) else env.scenarios
        return found
