"""Policies that learn nothing, beside which the others stand."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.vector import NavigateVectorEnv

# Gains of the polar controller, in units of the mean speed that is needed to arrive on time.
BEARING_GAIN, HEADING_GAIN = 3.0, -0.8


class RandomPolicy:
    """Uniform random actions from a generator of its own, one for each observation."""

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
        """Random actions, whatever is observed."""
        count = np.asarray(observation).shape[:-1]
        return self._rng.uniform(self._low, self._high, (*count, 2)).astype(np.float32), state


class GoToGoal:
    """Drives to the goal pose as if there were no obstacles, in the gear that faces it, so as to arrive on time.

    The controller is that of M. Aicardi, G. Casalino, A. Bicchi and A. Balestrino, "Closed loop steering of
    unicycle-like vehicles via Lyapunov techniques" (1995), in the linear form of R. Siegwart and I. Nourbakhsh,
    "Introduction to Autonomous Mobile Robots": the turn rate is a weighted sum of the bearing of the goal and of the
    heading that will be missing there. The speed is what is needed to arrive on time.

    Args:
        env: the environment that is driven, single or vector; its scenarios' speed limits are read.

    Raises:
        TypeError: it is not leapnav's.

    """

    def __init__(self, env: Any) -> None:
        while hasattr(env, "venv"):  # Stable-Baselines3's wrappers, and leapnav's adapter
            env = env.venv
        self._env = getattr(env, "unwrapped", env)
        if not isinstance(self._env, (NavigateEnv, NavigateVectorEnv)):
            raise TypeError(f"env: expected leapnav's environment, got {type(self._env).__name__}")

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The actions for observations (d,) or (N, d)."""
        rows = np.atleast_2d(observation).astype(float)
        ahead, left, cos, sin, needed = rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 7]
        gear = np.where(ahead >= 0, 1.0, -1.0)
        bearing = np.arctan2(gear * left, gear * ahead)
        free = (cos == 0) & (sin == 0)
        missing = np.where(free, 0.0, np.arctan2(sin, cos) - bearing)  # of the heading, once the goal is faced
        missing = np.remainder(missing + math.pi, 2 * math.pi) - math.pi
        speed = gear * needed
        turn_rate = np.abs(needed) * (BEARING_GAIN * bearing + HEADING_GAIN * missing)
        actions = np.stack([speed, turn_rate], axis=1) / self._limits()
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32)
        return (actions if np.ndim(observation) > 1 else actions[0]), state

    def _limits(self) -> np.ndarray:
        """m/s and rad/s (N, 2) that an action of 1 stands for."""
        env = self._env
        scenarios = [env.scenario] if isinstance(env, NavigateEnv) else env.scenarios
        return np.array([(s.robot.max_speed, s.robot.max_turn_rate) for s in scenarios])
