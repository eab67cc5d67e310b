"""More of what the learner cannot do yet: scenarios in which it failed are played again."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from leapnav.envs.scenario import Scenario
from leapnav.training.vec_env import NavigateVecEnv


class FailureReplay(VecEnvWrapper):
    """Plays scenarios again in which an episode failed, until one succeeds.

    Once a policy mostly succeeds, fresh scenarios have little to tell it; a simple form of M. Jiang, E. Grefenstette
    and T. Rocktaeschel, "Prioritized level replay" (ICML 2021).

    Args:
        venv: the robots.
        probability: that an episode plays a scenario again, if there is one.
        capacity: of the memory; the newest failures are kept.
        seed: of the choices.

    """

    def __init__(self, venv: NavigateVecEnv, probability: float = 0.5, capacity: int = 1000, seed: int = 0) -> None:
        super().__init__(venv)
        self._robots = venv
        self.probability, self._capacity = probability, capacity
        self._rng = np.random.default_rng(seed)
        self._failed: list[Scenario] = []
        self._playing: list[Scenario] = []

    def reset(self) -> VecEnvObs:
        """Starts episodes of all robots with scenarios of the environment."""
        observations = self.venv.reset()
        self._playing = self.venv.get_attr("scenario")
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all robots; some of those whose episode ends play a failure again."""
        observations, rewards, dones, infos = self.venv.step_wait()
        if not dones.any():
            return observations, rewards, dones, infos
        ended = np.flatnonzero(dones).tolist()
        for i in ended:
            # The newest failure comes last; a scenario that was mastered is forgotten.
            self._failed = [scenario for scenario in self._failed if scenario is not self._playing[i]]
            if not infos[i]["is_success"]:
                self._failed.append(self._playing[i])
        self._failed = self._failed[-self._capacity :]
        again: list[Scenario | None] = [None] * self.num_envs
        for i in ended:
            if self._failed and self._rng.random() < self.probability:
                again[i] = self._failed[self._rng.integers(len(self._failed))]
        mask = np.array([scenario is not None for scenario in again])
        if mask.any():
            observations = self._robots.restart(mask, again)
        self._playing = self.venv.get_attr("scenario")
        return observations, rewards, dones, infos

    def state_dict(self) -> dict[str, Any]:
        """What the choices that follow depend on."""
        return {"generator": self._rng.bit_generator.state, "failed": self._failed, "playing": self._playing}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up what `state_dict` described."""
        self._rng.bit_generator.state = state["generator"]
        self._failed, self._playing = state["failed"], state["playing"]
