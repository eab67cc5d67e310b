"""Access to leapnav's environments inside the wrappers of Gymnasium and of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.vector import NavigateVectorEnv


@dataclass(frozen=True)
class Situation:
    """Where one robot of an environment is.

    Attributes:
        scenario: its scenario.
        index: its index in the bank; None if it is not from a bank.
        bank: the bank of the environment.
        state: (n,), the state of the robot.
        time: s since the start of the episode.
        period: control period (s).

    """

    scenario: Scenario
    index: int | None
    bank: ScenarioBank | None
    state: np.ndarray
    time: float
    period: float


def unwrap(env: Any) -> list[NavigateEnv | NavigateVectorEnv]:
    """Return the leapnav environments inside an environment.

    Args:
        env: `NavigateEnv` or `NavigateVectorEnv`, wrapped or not, or a Stable-Baselines3 `VecEnv` of them.

    Returns:
        One environment, or one for each environment that a `VecEnv` contains.

    Raises:
        TypeError: the environment is not one of leapnav's.

    """
    while hasattr(env, "venv"):  # the `VecEnv` wrappers of Stable-Baselines3, and leapnav's own adapter
        env = env.venv
    env = getattr(env, "unwrapped", env)
    inner = [getattr(one, "unwrapped", one) for one in getattr(env, "envs", [env])]
    for one in inner:
        if not isinstance(one, (NavigateEnv, NavigateVectorEnv)):
            raise TypeError(f"env: expected an environment of leapnav, got {type(one).__name__}")
    return inner


def action_scale(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return factor and offset (m,) with which actions of leapnav's environment become those of its wrappers.

    Raises:
        ValueError: an action wrapper is neither Gymnasium's `RescaleAction` nor `ClipAction`.

    """
    *wrappers, inner = _layers(env)
    space = _single_action_space(inner)
    factor, offset = np.ones(space.shape), np.zeros(space.shape)
    kinds = gym.ActionWrapper | gym.vector.VectorActionWrapper
    for layer in reversed([wrapper for wrapper in wrappers if isinstance(wrapper, kinds)]):
        name = type(layer).__name__
        if name == "RescaleAction":
            inside, outside = _single_action_space(layer.env), _single_action_space(layer)
            ratio = (outside.high - outside.low) / (inside.high - inside.low)
            factor, offset = ratio * factor, outside.low + ratio * (offset - inside.low)
        elif name != "ClipAction":
            raise ValueError(f"env: expected no action wrapper but RescaleAction and ClipAction, got {name}")
    return factor, offset


def observation_wrappers(env: Any) -> list[str]:
    """Return the names of the wrappers of Gymnasium that change the observations of leapnav's environment."""
    kinds = gym.ObservationWrapper | gym.vector.VectorObservationWrapper
    return [type(layer).__name__ for layer in _layers(env) if isinstance(layer, kinds)]


def _layers(env: Any) -> list[Any]:
    """Return the wrappers of Gymnasium around an environment, from the outermost, and the environment."""
    while hasattr(env, "venv"):
        env = env.venv
    layers: list[Any] = []
    while True:
        if isinstance(env, gym.Wrapper | gym.vector.VectorWrapper):
            layers.append(env)
            env = env.env
        elif getattr(env, "envs", None):  # those of a vector environment are wrapped in the same way
            env = env.envs[0]
        else:
            return [*layers, env]


def _single_action_space(env: Any) -> Any:
    return getattr(env, "single_action_space", None) or env.action_space


def situations(envs: Sequence[NavigateEnv | NavigateVectorEnv]) -> list[Situation]:
    """Return the situations of all robots of environments, see `unwrap`."""
    found: list[Situation] = []
    for env in envs:
        period, bank = env.control_period, env.bank
        if isinstance(env, NavigateEnv):
            found.append(Situation(env.scenario, env.index, bank, env.state, env.time, period))
        else:
            rows = zip(env.scenarios, env.indices, env.states, env.times.tolist(), strict=True)
            found += [Situation(scenario, i, bank, state, time, period) for scenario, i, state, time in rows]
    return found
