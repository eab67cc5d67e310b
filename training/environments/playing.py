"""Episodes of a policy on chosen scenarios, one for each robot of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from leapnav.envs.vector import NavigateVectorEnv


@dataclass(frozen=True, eq=False)
class PlayedEpisode:
    """An episode of K steps.

    Attributes:
        states (K + 1, n): the states before and after each step.
        actions (K, m): the actions, clipped to [-1, 1].
        costs (K + 1,): the cost J so far at these states.
        episode_return: the sum of the rewards.
        clearance: smallest clearance (m).
        duration: time at the end (s).
        success, collision, truncated: the outcome.
        goal_distance, heading_error: of the last pose from the goal (m, rad).

    """

    states: np.ndarray
    actions: np.ndarray
    costs: np.ndarray
    episode_return: float
    clearance: float
    duration: float
    success: bool
    collision: bool
    truncated: bool
    goal_distance: float
    heading_error: float

    @property
    def length(self) -> float:
        """Length (m) of the path of the robot's position."""
        return float(np.hypot(*np.diff(self.states[:, :2], axis=0).T).sum())


def play_episodes(
    policy: Any, venv: NavigateVectorEnv, options: Mapping[str, Any], seed: int | None = None
) -> list[PlayedEpisode]:
    """Play an episode of each robot with deterministic actions.

    Args:
        policy: an object with the `predict` method of Stable-Baselines3.
        venv: the robots, with `autoreset_mode="SameStep"`: those whose episode has ended drive on until all have.
        options: "scenario" or "index", see `NavigateVectorEnv.reset`.
        seed: seed of the reset.

    """
    count = venv.num_envs
    observations, _ = venv.reset(seed=seed, options=dict(options))
    states, actions, costs = [venv.states], [], [np.zeros(count)]
    returns, clearances = np.zeros(count), np.full(count, np.inf)
    episodes: list[PlayedEpisode | None] = [None] * count
    memory, starts = None, np.ones(count, dtype=bool)
    while any(episode is None for episode in episodes):
        chosen, memory = policy.predict(observations, memory, starts, deterministic=True)
        observations, rewards, terminated, truncated, infos = venv.step(chosen)
        starts = terminated | truncated
        playing = np.array([episode is None for episode in episodes])
        returns += np.where(playing, rewards, 0.0)
        # Robots whose episode has ended are already in the next one; their last step is in `final_info`.
        last = infos.get("final_info", infos)
        states.append(np.where(starts[:, None], _states(last), _states(infos)))
        actions.append(np.clip(np.asarray(chosen, np.float32), -1.0, 1.0))
        costs.append(np.where(starts, last["cost"], infos["cost"]))
        clearances = np.minimum(clearances, np.where(starts, last["clearance"], infos["clearance"]))
        for i in np.flatnonzero(starts & playing).tolist():
            episodes[i] = PlayedEpisode(
                states=np.array([row[i] for row in states]),
                actions=np.array([row[i] for row in actions]),
                costs=np.array([row[i] for row in costs]),
                episode_return=float(returns[i]),
                clearance=float(clearances[i]),
                duration=float(last["time"][i]),
                success=bool(last["is_success"][i]),
                collision=bool(last["collision"][i]),
                truncated=bool(truncated[i]),
                goal_distance=float(last["goal_distance"][i]),
                heading_error=float(last["heading_error"][i]),
            )
    return [episode for episode in episodes if episode is not None]


def _states(infos: Mapping[str, Any]) -> np.ndarray:
    """Return the states (N, n) of the robots from the infos of a step."""
    return np.concatenate([infos["pose"], infos["motion"]], axis=1) if "motion" in infos else infos["pose"]
