"""Jump start: the expert drives the first part of an episode, the learner the rest.

I. Uchendu et al., "Jump-start reinforcement learning" (ICML 2023). The expert's part is not simulated: the episode
starts at a state of the scenario's optimum, with the remaining time as its horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.training.robots.vec_env import NavigateVecEnv

MIN_REMAINING_TIME = 0.5  # s that the learner drives at least


class JumpStart(VecEnvWrapper):
    """Start some of the episodes at a later state of the optimum.

    Args:
        venv: the training environment.
        banks: scenario banks with references. An episode with a jump start plays one of their scenarios, any other
            episode a scenario of the environment.
        max_fraction: maximum fraction of an episode that the expert drives. The fraction of an episode is drawn
            uniformly from 0 to this maximum, which may be changed at any time, for example by a callback.
        probability: probability that an episode has a jump start.
        seed: random seed.

    """

    def __init__(
        self,
        venv: NavigateVecEnv,
        banks: Sequence[ScenarioBank],
        max_fraction: float = 0.8,
        probability: float = 0.5,
        seed: int = 0,
    ) -> None:
        super().__init__(venv)
        self._robots, self._banks = venv, list(banks)
        self.max_fraction, self.probability = max_fraction, probability
        self._rng = np.random.default_rng(seed)

    def reset(self) -> VecEnvObs:
        """Start an episode of each robot, without a jump start."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all robots; some of the episodes that start in this step get a jump start."""
        observations, rewards, dones, infos = self.venv.step_wait()
        jumping = dones & (self._rng.random(self.num_envs) < self.probability)
        if self.max_fraction > 0 and jumping.any():
            scenarios = [self._draw_scenario() if jumps else None for jumps in jumping]
            observations = self._robots.restart(jumping, scenarios)
        return observations, rewards, dones, infos

    def _draw_scenario(self) -> Scenario:
        """Return a random scenario of a bank that starts at a state of its optimum."""
        bank = self._banks[self._rng.integers(len(self._banks))]
        index = int(self._rng.integers(len(bank)))
        scenario, reference = bank[index], bank.reference(index)
        latest = max(0.0, 1.0 - MIN_REMAINING_TIME / float(bank.horizons[index]))
        fraction = min(self._rng.uniform(0.0, self.max_fraction), latest)
        k = int(fraction * (len(reference.times) - 1))
        if k == 0:
            return scenario
        return scenario.from_state(reference.states[k], float(reference.times[k]))

    def state_dict(self) -> dict[str, Any]:
        """Return the state that determines the following jump starts."""
        return {"generator": self._rng.bit_generator.state, "max_fraction": self.max_fraction}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state returned by `state_dict`."""
        self._rng.bit_generator.state = state["generator"]
        self.max_fraction = state["max_fraction"]
