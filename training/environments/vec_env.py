"""Adapter of the vector environment to the interface of Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from leapnav.envs.vector import AutoresetMode, NavigateVectorEnv, select_robot
from leapnav.training.policies.files import policy_environment

ENVIRONMENT = "leapnav/Navigate-v0"
# Names in the vector environment of attributes that differ between robots, and of those of a single robot.
_PER_ROBOT = {"scenario": "scenarios", "time": "times", "pose": "poses", "state": "states"}
_SINGLE = {"observation_space": "single_observation_space", "action_space": "single_action_space"}


def make_vec_env(
    env_id: str = ENVIRONMENT,
    n_envs: int = 16,
    *,
    seed: int | None = None,
    policy: str | Path | BaseAlgorithm | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    step_infos: bool = False,
    **arguments: Any,
) -> NavigateVecEnv:
    """Make a vector environment for the algorithms of Stable-Baselines3.

    Args:
        env_id: "leapnav/Navigate-v0", or "leapnav/NavigateGoal-v0" for hindsight experience replay.
        n_envs: number of robots, stepped together in this process.
        seed: seed of the first episode of the first robot; robot i gets `seed + i`.
        policy: name, directory, file or model whose observations the environment has, see `policy_environment`.
        env_kwargs: arguments of the environment as a dict, as in the function of Stable-Baselines3.
        step_infos: see `NavigateVecEnv`.
        arguments: arguments of the environment; they take precedence over those of the policy.

    Raises:
        FileNotFoundError, TypeError: there is no such policy.
        ValueError: an argument is invalid, or the environment is not one of leapnav's.
        gymnasium.error.Error: the environment does not exist.

    """
    if not str(gym.spec(env_id).vector_entry_point).startswith("leapnav."):
        raise ValueError(f"env_id: expected one of leapnav's environments, got {env_id!r}")
    observed = {} if policy is None else policy_environment(policy)
    venv = gym.make_vec(
        env_id,
        num_envs=n_envs,
        vectorization_mode="vector_entry_point",
        **{**observed, **(env_kwargs or {}), **arguments, "autoreset_mode": AutoresetMode.SAME_STEP},
    )
    assert isinstance(venv, NavigateVectorEnv)  # its specification is that of leapnav
    wrapped = NavigateVecEnv(venv, step_infos=step_infos)
    if seed is not None:
        wrapped.seed(seed)
    return wrapped


def environment_seed(seed: int, stream: int = 0) -> int:
    """Derive the seed of a training environment from the seed of a run.

    Robot i uses the derived seed plus i. Used directly, consecutive seeds of runs would give the robots mostly the same
    scenarios, and small seeds the first scenarios of the included banks.

    Args:
        seed: seed of the run.
        stream: index of the environment within the run.

    """
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])


class NavigateVecEnv(VecEnv):
    """Adapter of a `NavigateVectorEnv` to the `VecEnv` interface of Stable-Baselines3.

    The infos of the last step of an episode contain `terminal_observation`, the record `episode` of Stable-Baselines3's
    `Monitor`, and the infos of the environment. The infos of all other steps are empty by default.

    Args:
        venv: a vector environment with `autoreset_mode="SameStep"`.
        step_infos: fill the infos of all steps; this takes longer than the steps themselves. They are always filled for
            goal-conditioned environments with the reward "cost", since hindsight experience replay computes the reward
            from them.

    Raises:
        ValueError: the environment has another autoreset mode.

    """

    def __init__(self, venv: NavigateVectorEnv, *, step_infos: bool = False) -> None:
        if venv.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"venv: expected autoreset_mode='SameStep', got {venv.autoreset_mode.value!r}")
        self.venv = venv
        self._step_infos = step_infos or (venv.settings.goal_conditioned and venv.settings.reward == "cost")
        self._actions = np.zeros((venv.num_envs, venv.settings.model.sizes()[1]), np.float32)
        self._returns = np.zeros(venv.num_envs)
        self._lengths = np.zeros(venv.num_envs, dtype=int)
        self._started = time.time()
        super().__init__(venv.num_envs, venv.single_observation_space, venv.single_action_space)
        self.metadata = venv.metadata

    def reset(self) -> VecEnvObs:
        """Start an episode of each robot, with the seeds and options set by `seed` and `set_options`."""
        options: dict[str, Any] = {}
        for name in {name for chosen in self._options for name in chosen}:
            options[name] = [chosen.get(name) for chosen in self._options]
        observations, infos = self.venv.reset(seed=self._seeds, options=options)
        self.reset_infos = [select_robot(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (n_envs, m) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all robots; a robot whose episode ends starts the next one."""
        observations, rewards, terminated, truncated, infos = self.venv.step(self._actions)
        ended = terminated | truncated
        self._returns += rewards / self.venv.settings.reward_scale
        self._lengths += 1
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if self._step_infos:
            rows = [{**select_robot(infos, i), "TimeLimit.truncated": bool(truncated[i])} for i in range(self.num_envs)]
        if ended.any():
            last = infos.pop("final_info"), infos.pop("final_obs")
            for i in np.flatnonzero(ended).tolist():
                self.reset_infos[i] = select_robot(infos, i)
                rows[i] = {
                    **select_robot(last[0], i),
                    "terminal_observation": last[1][i],
                    "TimeLimit.truncated": bool(truncated[i]),
                    "episode": {
                        "r": round(float(self._returns[i]), 6),
                        "l": int(self._lengths[i]),
                        "t": round(time.time() - self._started, 6),
                    },
                }
                self._returns[i], self._lengths[i] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, rows

    def close(self) -> None:
        """Close the environment."""
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render a frame of each robot, for `render_mode="rgb_array"`."""
        return self.venv.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each robot: its own scenario, time or pose, or an attribute shared by all robots."""
        robots = list(self._get_indices(indices))
        if attr_name in _PER_ROBOT:
            values = getattr(self.venv, _PER_ROBOT[attr_name])
            return [values[i] for i in robots]
        return [getattr(self.venv, _SINGLE.get(attr_name, attr_name))] * len(robots)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environment shared by all robots.

        Raises:
            ValueError: `indices` are not all robots, or the attribute is a scenario, time or pose, set by a reset.

        """
        if attr_name in _PER_ROBOT:
            raise ValueError(f"attr_name: {attr_name!r} is set by a reset")
        self._check_all(f"{attr_name!r} is set", indices)
        setattr(self.venv, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once, and return its result for each of the robots.

        Raises:
            ValueError: `indices` are not all robots, and the method may change the state of the environment.

        """
        if method_name not in ("compute_reward", "render"):
            self._check_all(f"{method_name!r} is called", indices)
        result = getattr(self.venv, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def _check_all(self, operation: str, indices: VecEnvIndices) -> None:
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"indices: the robots share their environment; {operation} for all or none")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return True for `Monitor`, since this class keeps its records, and False for other wrappers."""
        return [issubclass(Monitor, wrapper_class)] * len(list(self._get_indices(indices)))
