"""leapnav's vector environment as Stable-Baselines3 wants it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from leapnav.envs.scenario import Scenario
from leapnav.envs.vector import AutoresetMode, NavigateVectorEnv, row_of

ENVIRONMENT = "leapnav/Navigate-v0"
# Attributes that each robot has for itself, or of which there is one for one robot and one for all.
_OWN = {"scenario": "scenarios", "time": "times", "pose": "poses"}
_SINGLE = {"observation_space": "single_observation_space", "action_space": "single_action_space"}


def make_vec_env(
    env_id: str = ENVIRONMENT,
    n_envs: int = 16,
    *,
    seed: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    step_infos: bool = False,
    **arguments: Any,
) -> NavigateVecEnv:
    """Many robots for Stable-Baselines3: pass the result to `PPO`, `SAC` and the like as their environment.

    Args:
        env_id: "leapnav/Navigate-v0", or "leapnav/NavigateGoal-v0" for hindsight experience replay.
        n_envs: number of robots, all stepped together in this process.
        seed: of the first robot's first episode, the next ones following.
        env_kwargs, arguments: of the environment, in a dict as Stable-Baselines3's own function has it, or directly.
        step_infos: see `NavigateVecEnv`.

    Raises:
        ValueError: an argument is impossible, or the environment is none of leapnav's.
        gymnasium.error.Error: there is no such environment.

    """
    if not str(gym.spec(env_id).vector_entry_point).startswith("leapnav."):
        raise ValueError(f"env_id: expected one of leapnav's environments, got {env_id!r}")
    venv = gym.make_vec(
        env_id,
        num_envs=n_envs,
        vectorization_mode="vector_entry_point",
        **{**(env_kwargs or {}), **arguments, "autoreset_mode": AutoresetMode.SAME_STEP},
    )
    assert isinstance(venv, NavigateVectorEnv)  # as its specification says
    wrapped = NavigateVecEnv(venv, step_infos=step_infos)
    if seed is not None:
        wrapped.seed(seed)
    return wrapped


def environment_seed(seed: int, stream: int = 0) -> int:
    """A seed for the robots of a training run, the next ones following.

    Runs with seeds that follow each other would share most of their robots' scenarios, and those with the smallest ones
    would meet the first scenarios of the banks that ship.
    """
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])


class NavigateVecEnv(VecEnv):
    """Adapts a `NavigateVectorEnv` to Stable-Baselines3's interface.

    The infos of an episode's last step have `terminal_observation`, the record `episode` that `Monitor` would write,
    and what the environment tells; those of other steps are empty, unless asked for.

    Args:
        venv: made with `autoreset_mode="SameStep"`.
        step_infos: whether the infos of all steps are filled, which takes longer than the steps themselves. Hindsight
            experience replay needs them for the reward "cost", which therefore always fills them.

    Raises:
        ValueError: the environment resets in another way.

    """

    def __init__(self, venv: NavigateVectorEnv, *, step_infos: bool = False) -> None:
        if venv.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"venv: expected autoreset_mode='SameStep', got {venv.autoreset_mode.value!r}")
        self.venv = venv
        self._step_infos = step_infos or (venv.settings.goal_conditioned and venv.settings.reward == "cost")
        self._actions = np.zeros((venv.num_envs, 2), np.float32)
        self._returns = np.zeros(venv.num_envs)
        self._lengths = np.zeros(venv.num_envs, dtype=int)
        self._started = time.time()
        super().__init__(venv.num_envs, venv.single_observation_space, venv.single_action_space)
        self.metadata = venv.metadata

    def reset(self) -> VecEnvObs:
        """Starts episodes of all robots, with the seeds and options set before."""
        options: dict[str, Any] = {}
        for name in {name for chosen in self._options for name in chosen}:
            options[name] = [chosen.get(name) for chosen in self._options]
        observations, infos = self.venv.reset(seed=self._seeds, options=options)
        self.reset_infos = [row_of(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions (n_envs, 2) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all robots; those whose episode ends start the next one."""
        observations, rewards, ended, _, infos = self.venv.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if self._step_infos:
            rows = [{**row_of(infos, i), "TimeLimit.truncated": False} for i in range(self.num_envs)]
        if ended.any():
            last = infos.pop("final_info"), infos.pop("final_obs")
            for i in np.flatnonzero(ended).tolist():
                self.reset_infos[i] = row_of(infos, i)
                rows[i] = {
                    **row_of(last[0], i),
                    "terminal_observation": last[1][i],
                    "TimeLimit.truncated": False,
                    "episode": {
                        "r": round(float(self._returns[i]), 6),
                        "l": int(self._lengths[i]),
                        "t": round(time.time() - self._started, 6),
                    },
                }
                self._returns[i], self._lengths[i] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, rows

    def restart(self, mask: np.ndarray, scenarios: Sequence[Scenario | None]) -> VecEnvObs:
        """Starts other episodes than those that have just begun.

        Args:
            mask (n_envs,): bool, which robots' episodes.
            scenarios: one for each robot; those of the others are not looked at.

        Returns:
            The observations of all robots.

        """
        observations, infos = self.venv.reset(options={"reset_mask": mask, "scenario": scenarios})
        for i in np.flatnonzero(mask).tolist():
            self.reset_infos[i] = row_of(infos, i)
            self._returns[i], self._lengths[i] = 0.0, 0
        return observations

    def state_dict(self) -> dict[str, Any]:
        """All robots where they are, and what they will play: a training run's checkpoint needs it."""
        return {"venv": self.venv, "returns": self._returns, "lengths": self._lengths}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up what `state_dict` described, of an environment with the same arguments."""
        self.venv, self._returns, self._lengths = state["venv"], state["returns"], state["lengths"]

    def close(self) -> None:
        """Closes the environment."""
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A frame of each robot, for `render_mode="rgb_array"`."""
        return self.venv.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the environment for each robot: its own scenario, time and pose, else what all share."""
        robots = list(self._get_indices(indices))
        if attr_name in _OWN:
            values = getattr(self.venv, _OWN[attr_name])
            return [values[i] for i in robots]
        return [getattr(self.venv, _SINGLE.get(attr_name, attr_name))] * len(robots)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of the environment, which all robots share.

        Raises:
            ValueError: only some robots are to have it, or it is one of their own, which only a reset sets.

        """
        if attr_name in _OWN:
            raise ValueError(f"attr_name: {attr_name!r} is set by a reset")
        self._check_all(f"{attr_name!r} is set", indices)
        setattr(self.venv, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of the environment once, and repeats its result for each robot asked for.

        Raises:
            ValueError: it is to be called for some robots only, and is not one that leaves the robots alone.

        """
        if method_name not in ("compute_reward", "render"):
            self._check_all(f"{method_name!r} is called", indices)
        result = getattr(self.venv, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def _check_all(self, what: str, indices: VecEnvIndices) -> None:
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"indices: the robots share their environment; {what} for all or none")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """True for `Monitor`, whose records are kept here."""
        return [issubclass(Monitor, wrapper_class)] * len(list(self._get_indices(indices)))
