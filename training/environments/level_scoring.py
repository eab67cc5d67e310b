"""Scores of levels from the rollouts of Stable-Baselines3's on-policy algorithms."""

from __future__ import annotations

from typing import cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from leapnav.envs.unwrapping import unwrap
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.training.environments.level_samplers import PrioritizedSampler


class LevelScoring(BaseCallback):
    """Give the values and advantages of each rollout of PPO or A2C to a level sampler.

    The scores "positive_value_loss" and "max_mc" need it; the others do not.

    Args:
        sampler: the sampler of the training environment.

    Raises:
        TypeError: `sampler` is not a `PrioritizedSampler`.

    """

    def __init__(self, sampler: PrioritizedSampler) -> None:
        super().__init__()
        if not isinstance(cast(object, sampler), PrioritizedSampler):
            raise TypeError(f"sampler: expected a PrioritizedSampler, got {type(sampler).__name__}")
        self._sampler = sampler
        self._levels: list[np.ndarray] = []
        self._ends: list[np.ndarray] = []

    def _on_training_start(self) -> None:
        inner = unwrap(self.training_env)[0]
        if not isinstance(inner, NavigateVectorEnv) or inner.sampler is not self._sampler:
            raise ValueError("sampler: expected that of the training environment, make_vec_env(bank=..., sampler=...)")
        self._robots = inner
        if self.model.num_timesteps == 0:  # `learn` has reset the environment
            self._sampler.discard_episodes()

    def _on_rollout_start(self) -> None:
        self._levels, self._ends, self._current = [], [], self._playing()

    def _on_step(self) -> bool:
        self._levels.append(self._current)
        self._ends.append(np.array(self.locals["dones"], dtype=bool))
        self._current = self._playing()
        return True

    def _on_rollout_end(self) -> None:
        buffer = cast(OnPolicyAlgorithm, self.model).rollout_buffer
        self._sampler.score_rollout(
            np.array(self._levels), buffer.values, buffer.advantages, buffer.rewards, np.array(self._ends)
        )

    def _playing(self) -> np.ndarray:
        """Return the index of the level (N,) that each robot plays."""
        return np.array(self._robots.indices, dtype=np.int64)
