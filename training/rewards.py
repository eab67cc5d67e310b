"""What a learner is paid, where that differs from what the environment pays."""

from __future__ import annotations

import math

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

LEAST_MISS = 0.2  # share of the penalty that the slightest miss costs; with none a success is hardly worth more
MISS_SLOPE = 0.1  # share of the penalty for each m and each rad that the goal's pose is away


class ScaledReward(VecEnvWrapper):
    """Multiplies the rewards by a constant, so that a critic's targets are of the order of 1.

    Unlike a running normalisation it keeps the critic's meaning: its values are the scale times the return.

    Args:
        venv: the robots.
        scale: the factor.

    """

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self.scale = scale

    def reset(self) -> VecEnvObs:
        """Starts episodes of all robots."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all robots; the episodes' records in the infos keep the unscaled return."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self.scale, dones, infos


class GradedMiss(VecEnvWrapper):
    """Lets a miss cost the more the farther it is from the goal's pose, and no more than the environment's penalty.

    Until a learner has met the goal by chance, a penalty that is the same for all misses does not say where it is, and
    the cost says that standing still is best. What a success returns stays what it was: -J. A touch, which ends the
    episode, is a miss too, and costs its own penalty in full.

    Args:
        venv: robots whose observations begin with the part `goal`, as those of `leapnav/Navigate-v0` do.

    """

    def reset(self) -> VecEnvObs:
        """Starts episodes of all robots."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all robots; the episodes' records in the infos keep the environment's return."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones).tolist():
            penalty = -infos[i]["reward_parts"]["miss"]  # 0 for what is no miss
            ahead, left, cosine, sine = infos[i]["terminal_observation"][:4]
            away = math.hypot(ahead, left) + abs(math.atan2(sine, cosine))  # both are 0 for a free heading
            rewards[i] += penalty * (1.0 - min(1.0, LEAST_MISS + MISS_SLOPE * away))
        return observations, rewards, dones, infos
