"""Rewards that are a function of the goal, for learners that ask what another goal would have brought."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leapnav.envs.settings import Settings


def reaches(achieved: np.ndarray, desired: np.ndarray, settings: Settings) -> np.ndarray:
    """Whether poses (..., 4): x, y, cosine and sine of the heading, are the desired ones, within the tolerances.

    A desired heading of (0, 0) is free.
    """
    achieved, desired = np.asarray(achieved, dtype=float), np.asarray(desired, dtype=float)
    near = np.hypot(*np.moveaxis(achieved[..., :2] - desired[..., :2], -1, 0)) <= settings.position_tolerance
    c, s, goal_c, goal_s = *np.moveaxis(achieved[..., 2:], -1, 0), *np.moveaxis(desired[..., 2:], -1, 0)
    turn = np.abs(np.arctan2(s * goal_c - c * goal_s, c * goal_c + s * goal_s))
    free = (goal_c == 0.0) & (goal_s == 0.0)
    return near & (free | (turn <= settings.heading_tolerance))


class GoalConditioned:
    """What the goal-conditioned environments, single and vector, add."""

    settings: Settings

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """The reward of steps that end in `achieved_goal` when `desired_goal` was wanted.

        Args:
            achieved_goal, desired_goal (4,) or (N, 4): see the observation space.
            info: of the step, or a sequence of N; the reward "sparse" does not look at it.

        Returns:
            A float, or an array (N,).

        Raises:
            ValueError: the reward "cost" without infos of the environment (with Stable-Baselines3's
                `HerReplayBuffer`, give `copy_info_dict=True`).

        """
        reached = reaches(achieved_goal, desired_goal, self.settings)
        if self.settings.reward == "sparse":
            return reached.astype(float) if reached.ndim else float(reached)
        if reached.ndim == 0:
            return self._cost_reward(bool(reached), info)
        if isinstance(info, Mapping) or len(info) != len(reached):
            raise ValueError(f"info: expected {len(reached)} dicts, one for each goal, got {_described(info)}")
        return np.array([self._cost_reward(bool(r), i) for r, i in zip(reached, info, strict=True)])

    def _cost_reward(self, reached: bool, info: Any) -> float:
        if not isinstance(info, Mapping) or "reward_parts" not in info:
            raise ValueError(
                f'info: the reward "cost" needs the info of the step, got {_described(info)} '
                "(HerReplayBuffer passes it on with copy_info_dict=True)"
            )
        parts = info["reward_parts"]
        running = parts["effort"] + parts["proximity"] + parts["collision"]
        missed = info["terminated"] and not (info["at_horizon"] and reached)
        return running - (self.settings.miss_penalty if missed else 0.0)


def _described(info: Any) -> str:
    if isinstance(info, Mapping):
        return f"a dict of {sorted(info)}"
    if isinstance(info, Sequence | np.ndarray):
        return f"{len(info)} of them"
    return repr(info)
