"""The loop over one episode of a single environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

# Return the action for an observation and the info that came with it; None stops the episode before the step.
Act = Callable[[Any, dict[str, Any]], np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Transition:
    """One environment step.

    Attributes:
        observation: the observation after the step.
        reward: the reward of the step.
        terminated, truncated: whether the episode has ended, as defined by Gymnasium.
        info: the info after the step.
        action: the action that was executed.

    """

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    action: np.ndarray

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated


def play_episode(
    env: gym.Env[Any, Any], act: Act, *, seed: int | None = None, options: dict[str, Any] | None = None
) -> tuple[Any, dict[str, Any], Iterator[Transition]]:
    """Start an episode and return an iterator over its steps.

    The environment is reset immediately. Each item requested from the iterator takes one step, so a loop over it may
    stop early.

    Args:
        env: an environment with the interface of `gymnasium.Env`.
        act: a function that returns the action for an observation and the info that came with it, or None to stop
            before the step. `act_with(policy)` makes one from a policy; `replay(actions)` replays actions.
        seed: seed of the reset.
        options: options of the reset.

    Returns:
        The observation and the info of the reset, and the iterator over the steps.

    """
    observation, info = env.reset(seed=seed, options=options)
    return observation, info, _steps(env, act, observation, info)


def act_with(policy: Any) -> Act:
    """Return an `act` function for one episode of a policy with the interface of Stable-Baselines3's `predict`.

    The state of a recurrent policy is carried from step to step. Actions are deterministic.
    """
    state, start = None, True

    def act(observation: Any, info: dict[str, Any]) -> np.ndarray:
        nonlocal state, start
        action, state = policy.predict(observation, state, np.array([start]), deterministic=True)
        start = False
        return action.reshape(-1)

    return act


def replay(actions: Any) -> Act:
    """Return an `act` function that replays actions (N, m) in order, and stops after the last one."""
    remaining = iter(actions)
    return lambda observation, info: next(remaining, None)


def _steps(env: gym.Env[Any, Any], act: Act, observation: Any, info: dict[str, Any]) -> Iterator[Transition]:
    done = False
    while not done:
        action = act(observation, info)
        if action is None:
            return
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        yield Transition(observation, float(reward), terminated, truncated, info, action)
