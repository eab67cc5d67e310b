"""Rewards as a function of the goal, for goal-conditioned learners such as hindsight experience replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leapnav.envs.settings import EnvironmentSettings


def is_reached(achieved: np.ndarray, desired: np.ndarray, settings: EnvironmentSettings) -> np.ndarray:
    """Return whether achieved poses are the desired ones, within the tolerances.

    Args:
        achieved, desired (..., 4): x, y (m), cosine and sine of the heading. A desired heading of (0, 0) is free.
        settings: settings of the environment.

    """
    achieved, desired = np.asarray(achieved, dtype=float), np.asarray(desired, dtype=float)
    distance = np.hypot(*np.moveaxis(achieved[..., :2] - desired[..., :2], -1, 0))
    c, s, goal_c, goal_s = *np.moveaxis(achieved[..., 2:], -1, 0), *np.moveaxis(desired[..., 2:], -1, 0)
    turn = np.abs(np.arctan2(s * goal_c - c * goal_s, c * goal_c + s * goal_s))
    free = (goal_c == 0.0) & (goal_s == 0.0)
    return (distance <= settings.position_tolerance) & (free | (turn <= settings.heading_tolerance))


class GoalConditioned:
    """Mixin of the goal-conditioned environments, single and vector: `compute_reward`."""

    settings: EnvironmentSettings

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Return the reward of steps that end in `achieved_goal`, for the goal `desired_goal`.

        Args:
            achieved_goal, desired_goal (4,) or (N, 4): see the observation space.
            info: the info of the step, or a sequence of N infos; not used by the reward "sparse".

        Returns:
            A float, or an array (N,).

        Raises:
            ValueError: the reward "cost" without the infos of the steps (Stable-Baselines3's `HerReplayBuffer` needs
                `copy_info_dict=True`).

        """
        reached = is_reached(achieved_goal, desired_goal, self.settings)
        if self.settings.reward == "sparse":
            scaled = self.settings.reward_scale * reached
            return scaled if reached.ndim else float(scaled)
        if reached.ndim == 0:
            return self._cost_reward(bool(reached), info)
        if isinstance(info, Mapping) or len(info) != len(reached):
            raise ValueError(f"info: expected {len(reached)} dicts, one for each goal, got {_describe(info)}")
        return np.array([self._cost_reward(bool(r), i) for r, i in zip(reached, info, strict=True)])

    def _cost_reward(self, reached: bool, info: Any) -> float:
        if not isinstance(info, Mapping) or "reward_effort" not in info:
            raise ValueError(
                f'info: the reward "cost" needs the info of the step, got {_describe(info)} '
                "(HerReplayBuffer passes it on with copy_info_dict=True)"
            )
        names = "effort", "proximity", "collision", "time"
        running = sum(info.get(f"reward_{name}", 0.0) for name in names)
        arrived = reached and (info["at_horizon"] or self.settings.free_horizon)
        missed = info["terminated"] and not arrived
        return self.settings.reward_scale * (running - (self.settings.miss_penalty if missed else 0.0))


def _describe(info: Any) -> str:
    if isinstance(info, Mapping):
        return f"a dict of {sorted(info)}"
    if isinstance(info, Sequence | np.ndarray):
        return f"a sequence of length {len(info)}"
    return repr(info)
