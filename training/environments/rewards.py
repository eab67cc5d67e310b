"""Wrappers that change the environment's rewards for training."""

from __future__ import annotations

import math

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

# Fraction of the penalty that any miss costs. Without it a success would return hardly more than a close miss.
MIN_MISS_FRACTION = 0.2
MISS_FRACTION_SLOPE = 0.1  # fraction of the penalty per m of distance and per rad of heading error


class ScaledReward(VecEnvWrapper):
    """Multiply the rewards by a constant, so that the critic's targets are of the order of 1.

    Unlike with a running normalisation, the critic's values keep a fixed meaning: the scale times the return.

    Args:
        venv: the training environment.
        scale: the factor.

    """

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self.scale = scale

    def reset(self) -> VecEnvObs:
        """Start an episode of each robot."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all robots; the episode records in the infos keep the unscaled return."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self.scale, dones, infos


class GradedMiss(VecEnvWrapper):
    """Grade the penalty of a missed goal by the final distance from the goal pose, up to the environment's penalty.

    With a constant penalty a learner has no information about the goal until it reaches it by chance, and the cost
    favours standing still. The return of a success is unchanged. A collision that ends the episode is also a miss; its
    own penalty is not graded.

    Args:
        venv: a training environment whose observations begin with the part `goal`, as in `leapnav/Navigate-v0`.

    """

    def reset(self) -> VecEnvObs:
        """Start an episode of each robot."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all robots; the episode records in the infos keep the return of the environment."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones).tolist():
            penalty = -infos[i]["reward_miss"]  # 0 for a success
            ahead, left, cosine, sine = infos[i]["terminal_observation"][:4]
            away = math.hypot(ahead, left) + abs(math.atan2(sine, cosine))  # the heading error of a free heading is 0
            rewards[i] += penalty * (1.0 - min(1.0, MIN_MISS_FRACTION + MISS_FRACTION_SLOPE * away))
        return observations, rewards, dones, infos
