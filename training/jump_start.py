"""Jump-start: the expert drives the first part of an episode, the learner the rest, which grows.

I. Uchendu et al., "Jump-start reinforcement learning" (ICML 2023). The expert's part need not be driven: a scenario
from a state on its optimum, with the time that is left then, is the rest of the episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.scenario import Scenario
from leapnav.training.vec_env import NavigateVecEnv

SHORTEST = 0.5  # s that the learner drives at least


class JumpStart(VecEnvWrapper):
    """Starts episodes later on the optimum.

    Args:
        venv: the robots.
        banks: scenarios with optima, of which an episode with a jump-start plays one; the others are the environment's.
        share: of the episodes' time that the expert drives, at most; each episode's is drawn uniformly up to there.
            May be changed at any time: a callback lets it fall to zero.
        probability: that an episode has a jump-start.
        seed: of the choices.

    """

    def __init__(
        self,
        venv: NavigateVecEnv,
        banks: Sequence[ScenarioBank],
        share: float = 0.8,
        probability: float = 0.5,
        seed: int = 0,
    ) -> None:
        super().__init__(venv)
        self._robots, self._banks = venv, list(banks)
        self.share, self.probability = share, probability
        self._rng = np.random.default_rng(seed)

    def reset(self) -> VecEnvObs:
        """Starts episodes of all robots; none of these first ones has a jump-start."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all robots; of those whose episode ends some start the next one further on."""
        observations, rewards, dones, infos = self.venv.step_wait()
        jumping = dones & (self._rng.random(self.num_envs) < self.probability)
        if self.share > 0 and jumping.any():
            scenarios = [self._later() if jumps else None for jumps in jumping]
            observations = self._robots.restart(jumping, scenarios)
        return observations, rewards, dones, infos

    def _later(self) -> Scenario:
        """A scenario of a bank from a state on its optimum."""
        bank = self._banks[self._rng.integers(len(self._banks))]
        number = int(self._rng.integers(len(bank)))
        scenario, reference = bank[number], bank.reference(number)
        latest = max(0.0, 1.0 - SHORTEST / scenario.horizon)
        share = min(self._rng.uniform(0.0, self.share), latest)
        k = int(share * (len(reference.times) - 1))
        if k == 0:
            return scenario
        return scenario.model_copy(
            update={
                "start": tuple(reference.states[k].astype(float).tolist()),
                "horizon": float(scenario.horizon - reference.times[k]),
            }
        )

    def state_dict(self) -> dict[str, Any]:
        """What the choices that follow depend on."""
        return {"generator": self._rng.bit_generator.state, "share": self.share}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up what `state_dict` described."""
        self._rng.bit_generator.state = state["generator"]
        self.share = state["share"]
