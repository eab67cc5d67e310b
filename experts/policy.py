"""The expert as a policy, with the interface of Stable-Baselines3."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal
from leapnav.experts.optimum import find_optimum


class NoOptimumError(RuntimeError):
    """The expert has no certified optimum of a scenario. The message names the scenario and the solver's status."""


def plan_actions(extremal: Extremal, scenario: Scenario, control_period: float) -> np.ndarray:
    """The optimum as actions (K, 2) in [-1, 1], one for each control period of the environment.

    Each is the optimal control in the middle of its period, which the exact arcs turn back into the optimum up to the
    square of the period.
    """
    count = max(1, math.ceil(scenario.horizon / control_period - 1e-6))
    starts = control_period * np.arange(count)
    middles = (starts + np.minimum(starts + control_period, scenario.horizon)) / 2
    limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
    return (extremal.evaluate(middles)[1] / limits).astype(np.float32)


class ExpertPolicy:
    """Drives the optimum of the scenario that the environment plays.

    Args:
        env: the (wrapped) environment that the actions are for; the scenario and the time are read from it.
        plans: actions (K, 2) of scenarios whose optimum is known already; others are solved at their first step.

    """

    def __init__(self, env: gym.Env[Any, Any], plans: Mapping[Scenario, np.ndarray] | None = None) -> None:
        if not isinstance(env.unwrapped, NavigateEnv):
            raise TypeError(f"env: expected leapnav's environment, got {env.unwrapped}")
        self._env = env.unwrapped
        self._plans = dict(plans or {})

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The action (2,) for the environment's current step, and the state unchanged.

        Raises:
            NoOptimumError: the scenario has no certified optimum.

        """
        scenario = self._env.scenario
        if scenario not in self._plans:
            extremal = find_optimum(scenario)
            if not extremal.success:
                raise NoOptimumError(f"scenario {scenario.name!r}: {extremal.status.name}: {extremal.status.value}")
            self._plans[scenario] = plan_actions(extremal, scenario, self._env.control_period)
        plan = self._plans[scenario]
        step = round(self._env.time / self._env.control_period)
        return cast(np.ndarray, plan[min(step, len(plan) - 1)]), state
