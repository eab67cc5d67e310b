"""Adapters of policies with other actions, observations or signatures to the interface of an evaluation."""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium as gym
import numpy as np

from leapnav.training.policies.actors import action_range

GOAL_KEYS = {"observation", "achieved_goal", "desired_goal"}
ARGUMENTS = "state", "episode_start", "deterministic"  # of `predict` in Stable-Baselines3


class AdaptedPolicy:
    """A policy with the interface of Stable-Baselines3, and actions in [-1, 1].

    Args:
        policy: an object with `predict(observation)`, which may have the further arguments of Stable-Baselines3, and
            returns the action or a tuple that begins with it.

    Raises:
        ValueError: its action space is no box.

    """

    def __init__(self, policy: Any) -> None:
        self._policy = policy
        parameters = inspect.signature(policy.predict).parameters.values()
        takes_all = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters)
        self._names = [name for name in ARGUMENTS if takes_all or name in {one.name for one in parameters}]
        self._statistics = _statistics_of(policy)
        self._range = None
        space = getattr(policy, "action_space", None)
        if space is not None:
            if not isinstance(space, gym.spaces.Box):
                raise ValueError(f"policy: expected actions in a Box, got {space}")
            middle, half = action_range(space)
            if (middle != 0.0).any() or (half != 1.0).any():
                self._range = middle, half

    @property
    def changes_nothing(self) -> bool:
        """Whether the policy itself has the interface."""
        return self._statistics is None and self._range is None and len(self._names) == len(ARGUMENTS)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions of the policy, and the state of a recurrent one."""
        given = {"state": state, "episode_start": episode_start, "deterministic": deterministic}
        if self._statistics is not None:
            observation = self._statistics.normalize_obs(observation)
        found = self._policy.predict(observation, **{name: given[name] for name in self._names})
        action, *rest = found if isinstance(found, tuple) else (found,)
        if self._range is not None:
            action = (np.asarray(action) - self._range[0]) / self._range[1]
        return np.asarray(action), rest[0] if rest else None


def adapted(policy: Any) -> Any:
    """Return a policy with the interface of an evaluation: the policy itself, or an `AdaptedPolicy`."""
    adapter = AdaptedPolicy(policy)
    return policy if adapter.changes_nothing else adapter


def _statistics_of(policy: Any) -> Any:
    """Return the `VecNormalize` whose statistics normalise the observations of a model; None if there is none."""
    find = getattr(policy, "get_vec_normalize_env", None)
    statistics = None if find is None else find()
    return statistics if statistics is not None and statistics.norm_obs else None


def is_goal_conditioned(policy: Any) -> bool:
    """Return whether a policy observes what `leapnav/NavigateGoal-v0` contains."""
    space = getattr(policy, "observation_space", None)
    return isinstance(space, gym.spaces.Dict) and set(space) == GOAL_KEYS
