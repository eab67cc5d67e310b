"""Policies, and adapters of those with other actions, observations or signatures to the interface of an evaluation."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from leapnav.envs.utils.validation import in_words
from leapnav.training.policies.actors import action_range

GOAL_KEYS = {"observation", "achieved_goal", "desired_goal"}
ARGUMENTS = "state", "episode_start", "deterministic"  # of `predict` in Stable-Baselines3


class Policy(Protocol):
    """Any object with the `predict` method of Stable-Baselines3, for one observation or a batch of observations."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for observations, and the state of a recurrent policy."""
        ...


@dataclass(frozen=True)
class PolicyFactory:
    """A function that makes a policy for an environment, as in `PolicyFactory(lambda env: ExpertPolicy(env))`.

    A class such as `ExpertPolicy` needs no factory. Any other function is a policy itself: it maps an observation to an
    action.

    Attributes:
        make: the function.

    """

    make: Callable[[Any], Policy]

    def __call__(self, env: Any) -> Policy:
        """Return the policy for an environment."""
        return self.make(env)


PolicyOrFactory = Policy | Callable[[Any], Any]


class FunctionPolicy:
    """A policy from a function of one observation, called for each robot.

    Args:
        function: maps an observation (d,), or a dictionary, to an action (m,).
        observation_space: the space of one observation, to recognise batches.
        n_actions: number m of controls.

    """

    def __init__(self, function: Callable[[Any], Any], observation_space: gym.spaces.Space, n_actions: int = 2) -> None:
        self._function, self._space, self._n_actions = function, observation_space, n_actions

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions (m,) or (N, m) for an observation or a batch of them."""
        if isinstance(observation, Mapping):
            assert isinstance(self._space, gym.spaces.Dict)
            name, values = next(iter(observation.items()))
            is_batch, count = np.ndim(values) > len(self._space[name].shape or ()), len(values)
            rows = [{key: value[i] for key, value in observation.items()} for i in range(count)] if is_batch else []
        else:
            is_batch = np.ndim(observation) > len(self._space.shape or ())
            rows = list(observation) if is_batch else []
        return np.array([self._action(row) for row in rows]) if is_batch else self._action(observation), state

    def _action(self, observation: Any) -> np.ndarray:
        given = self._function(observation)
        if hasattr(given, "predict"):
            raise TypeError("policy: expected an action from the function, got a policy; pass a PolicyFactory of it")
        action = np.asarray(given, dtype=np.float32)
        if action.shape != (self._n_actions,) or not np.isfinite(action).all():
            raise ValueError(
                f"policy: expected {in_words(self._n_actions)} finite numbers from the function, got {action.tolist()}"
            )
        return action


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


class NormalizedPolicy:
    """A policy with the statistics of `VecNormalize`, by which an evaluation normalises its observations.

    Args:
        policy: the policy.
        statistics: the `VecNormalize`, which needs no environment.

    """

    def __init__(self, policy: Any, statistics: VecNormalize) -> None:
        self._policy, self._statistics = policy, statistics
        self.observation_space, self.action_space = policy.observation_space, policy.action_space

    def get_vec_normalize_env(self) -> VecNormalize:
        """Return the statistics, as do models of Stable-Baselines3."""
        return self._statistics

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for normalised observations."""
        return self._policy.predict(observation, state, episode_start, deterministic)


def read_statistics(path: str | Path) -> VecNormalize:
    """Read a file of `VecNormalize.save`. It is a pickle file: reading it can execute code.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it contains something else.

    """
    try:
        statistics = pickle.loads(Path(path).read_bytes())
    except FileNotFoundError:
        raise
    except Exception as error:  # pickle raises many types of errors for a damaged file
        raise ValueError(f"{path}: not a file of VecNormalize: {error!r}") from None
    if not isinstance(statistics, VecNormalize):
        raise ValueError(f"{path}: expected a file of VecNormalize, got {type(statistics).__name__}")
    return statistics


def statistics_beside(model: str | Path) -> Path | None:
    """Return the file of statistics beside a model, where RL Zoo and `VecNormalize.save` commonly put it."""
    path = Path(model)
    names = [path.with_suffix("") / "vecnormalize.pkl"]
    names += [path.parent / name for name in ("vecnormalize.pkl", "vec_normalize.pkl", f"{path.stem}_vecnormalize.pkl")]
    return next((file for file in names if file.is_file()), None)


def _statistics_of(policy: Any) -> Any:
    """Return the `VecNormalize` whose statistics normalise the observations of a model; None if there is none."""
    find = getattr(policy, "get_vec_normalize_env", None)
    statistics = None if find is None else find()
    return statistics if statistics is not None and statistics.norm_obs else None


def is_goal_conditioned(policy: Any) -> bool:
    """Return whether a policy observes what `leapnav/NavigateGoal-v0` contains."""
    space = getattr(policy, "observation_space", None)
    return isinstance(space, gym.spaces.Dict) and set(space) == GOAL_KEYS
