"""The score of a policy: how often it succeeds, and how far from the optimum it is. Every policy goes through here."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from scipy.stats import bootstrap
from tqdm.auto import tqdm

from leapnav.experts.demonstrations import ENVIRONMENT, Demonstration
from leapnav.experts.policy import ExpertPolicy
from leapnav.training.policies import load_policy

RESAMPLES = 2000
CONFIDENCE = 0.95


class Policy(Protocol):
    """What can be scored: anything with Stable-Baselines3's `predict`."""

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions for observations, and the policy's own state."""
        ...


class RandomPolicy:
    """Uniform random actions from a generator of its own."""

    def __init__(self, action_space: gym.spaces.Space, seed: int = 0) -> None:
        self._space = action_space
        self._space.seed(seed)

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """A random action, whatever the observation."""
        return np.asarray(self._space.sample()), state


@dataclass(frozen=True, eq=False)
class Episode:
    """How a policy did on one scenario.

    `reference_cost` is J* of the scenario, `reached_reference` J* for the pose that was reached, to first order:
    J*(q) = J* - lambda(T)'(q - q_f). `states` (K + 1, 3) is the path driven.
    """

    scenario: str
    success: bool
    collision: bool
    cost: float
    episode_return: float
    reference_cost: float
    reached_reference: float
    states: np.ndarray

    @property
    def soc(self) -> float:
        """Success weighted by optimal cost: S J* / max(J, J*)."""
        return float(self.success) * self.reference_cost / max(self.cost, self.reference_cost)

    @property
    def regret(self) -> float:
        """(J - J*) / J*, with J* for the pose that was reached."""
        return (self.cost - self.reached_reference) / self.reached_reference


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % bootstrap interval; NaN where there is nothing to measure."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """The row of a policy: means over the episodes, regret as the median over the successes."""

    policy: str
    episodes: int
    success: Interval
    collision: Interval
    soc: Interval
    regret: Interval
    mean_return: Interval


def run_episodes(
    policy: Policy,
    env: gym.Env,
    references: Sequence[Demonstration],
    *,
    label: str = "Evaluating",
    progress: bool = True,
) -> list[Episode]:
    """Plays each reference's scenario once with deterministic actions.

    Args:
        policy: for `ExpertPolicy`, one made for this same `env`.
        env: an environment of `leapnav/Navigate-v0`.
        references: the expert's demonstrations of the scenarios, which carry their optimal costs.

    """
    episodes = []
    for reference in tqdm(references, desc=label, unit="episode", disable=not progress):
        observation, info = env.reset(options={"scenario": reference.scenario})
        poses, total, state, start, done = [info["pose"]], 0.0, None, True, False
        while not done:
            action, state = policy.predict(observation, state, np.array([start]), deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            poses.append(info["pose"])
            total += float(reward)
            start, done = False, terminated or truncated
        error = np.array(poses[-1]) - reference.states[-1]
        error[2] = math.remainder(error[2], 2 * math.pi)
        episodes.append(
            Episode(
                scenario=reference.scenario.name,
                success=bool(info["is_success"]),
                collision=bool(info["collision"]),
                cost=float(info["cost"]),
                episode_return=total,
                reference_cost=reference.reference_cost,
                reached_reference=reference.reference_cost - float(reference.costates[-1] @ error),
                states=np.array(poses),
            )
        )
    return episodes


def score(name: str, episodes: Sequence[Episode], seed: int = 0) -> Score:
    """The statistics of a policy's episodes, with percentile bootstrap intervals over the episodes.

    Raises:
        ValueError: there are no episodes.

    """
    if not episodes:
        raise ValueError("episodes: expected at least one, got none")
    rng = np.random.default_rng(seed)

    def interval(values: Sequence[float], statistic: Callable[..., Any] = np.mean) -> Interval:
        sample = np.asarray(values, dtype=float)
        if len(sample) == 0:
            return Interval(math.nan, math.nan, math.nan)
        value = float(statistic(sample))
        if len(sample) == 1 or np.ptp(sample) == 0:  # all resamples are the same
            return Interval(value, value, value)
        found = bootstrap(
            (sample,), statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile", rng=rng
        ).confidence_interval
        return Interval(value, float(found.low), float(found.high))

    return Score(
        policy=name,
        episodes=len(episodes),
        success=interval([e.success for e in episodes]),
        collision=interval([e.collision for e in episodes]),
        soc=interval([e.soc for e in episodes]),
        regret=interval([e.regret for e in episodes if e.success], np.median),
        mean_return=interval([e.episode_return for e in episodes]),
    )


def evaluate(
    entrants: Sequence[str], references: Sequence[Demonstration], *, seed: int = 0, progress: bool = True
) -> tuple[list[Score], dict[str, list[Episode]]]:
    """Plays policies side by side on the same scenarios.

    Args:
        entrants: folders that `save_policy` wrote, or "expert" (in closed loop), or "random".
        references: the expert's demonstrations of the scenarios.
        seed: of the random policy and the bootstrap.

    Returns:
        A score for each entrant, and its episodes by name.

    Raises:
        FileNotFoundError, ValueError: a policy cannot be loaded, see `load_policy`.

    """
    env = gym.make(ENVIRONMENT)
    # All are loaded before the first is played: a broken file is told at once.
    policies = {name: load_entrant(name, env, references, seed=seed) for name in entrants}
    episodes = {
        name: run_episodes(policy, env, references, label=f"Evaluating {Path(name).name}", progress=progress)
        for name, policy in policies.items()
    }
    return [score(name, played, seed) for name, played in episodes.items()], episodes


def load_entrant(name: str, env: gym.Env, references: Sequence[Demonstration] = (), *, seed: int = 0) -> Policy:
    """A policy by its name: a folder that `save_policy` wrote, or "expert", or "random".

    Args:
        name: the name.
        env: the environment that it is to drive.
        references: demonstrations whose optima the expert starts from; it solves other scenarios itself.
        seed: of the random policy.

    Raises:
        FileNotFoundError, ValueError: see `load_policy`.

    """
    if name == "expert":
        return ExpertPolicy(env, {reference.scenario: reference.path for reference in references})
    if name == "random":
        return RandomPolicy(env.action_space, seed)
    return load_policy(name, env)
