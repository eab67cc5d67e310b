"""Episodes that a learner drives on new scenarios, in parallel processes."""

from __future__ import annotations

import warnings
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from stable_baselines3.common.policies import BasePolicy

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import ScenarioSource, get_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.simulator import BatchSimulator
from leapnav.training.threads import limit_threads


@dataclass(frozen=True, eq=False)
class DrivenEpisode:
    """An episode of a learner, K steps.

    Attributes:
        scenario: its scenario.
        states (K + 1, n): the states before and after each step.
        costs (K + 1,): the cost J so far at these states.
        success, collision: its outcome.

    """

    scenario: Scenario
    states: np.ndarray
    costs: np.ndarray
    success: bool
    collision: bool


def drive_episodes(
    policy: BasePolicy,
    source: ScenarioSource,
    settings: EnvironmentSettings,
    seed: tuple[int, ...],
    *,
    robots: int,
    per_task: int,
    workers: int,
) -> Generator[DrivenEpisode]:
    """Yield episodes of a policy with deterministic actions, without end.

    Args:
        policy: the policy; it must not change until the generator is closed.
        source: source of the scenarios.
        settings: settings of the environment, without disturbances.
        seed: seed of the scenarios; the episodes do not depend on the number of workers.
        robots: number of robots that a process simulates together.
        per_task: number of episodes of one task of a process, on which the scenarios depend.
        workers: number of processes.

    """
    tasks = (delayed(_drive)(policy, source, settings, (*seed, number), robots, per_task) for number in count())
    portions = Parallel(workers, return_as="generator")(tasks)
    try:
        for portion in cast(Iterator[list[DrivenEpisode]], portions):
            yield from portion
    finally:
        with warnings.catch_warnings():  # joblib warns that results were not used
            warnings.simplefilter("ignore", UserWarning)
            cast(Any, portions).close()


@limit_threads
def _drive(
    policy: BasePolicy,
    source: ScenarioSource,
    settings: EnvironmentSettings,
    seed: tuple[int, ...],
    robots: int,
    per_task: int,
) -> list[DrivenEpisode]:
    """Return the episodes of one task, in the order of their scenarios."""
    rng = np.random.default_rng(seed)
    choices = [source.draw(rng) for _ in range(per_task)]
    robots = min(robots, len(choices))
    simulator = BatchSimulator(robots, settings)
    episodes: list[DrivenEpisode | None] = [None] * len(choices)
    playing = np.arange(robots)  # the number of the episode of each robot
    following = robots  # the number of the next episode
    simulator.reset(playing, choices[:robots], source.bank)
    paths: list[list[np.ndarray]] = [[] for _ in range(robots)]
    costs: list[list[float]] = [[] for _ in range(robots)]
    observations = np.empty((robots, simulator.layout.size), np.float32)
    active, starts = np.ones(robots, dtype=bool), np.ones(robots, dtype=bool)
    memory: Any = None
    _record(simulator, np.arange(robots), paths, costs)
    while active.any():
        simulator.observe(observations)
        actions, memory = policy.predict(observations, memory, starts, deterministic=True)
        simulator.step(np.asarray(actions, dtype=float), active)
        _record(simulator, np.flatnonzero(active), paths, costs)
        starts = active & (simulator.episodes["terminated"] | simulator.episodes["truncated"])
        for i in np.flatnonzero(starts).tolist():
            episode = simulator.episode(i)
            episodes[playing[i]] = DrivenEpisode(
                scenario=get_scenario(choices[playing[i]], source.bank),
                states=np.array(paths[i]),
                costs=np.array(costs[i]),
                success=episode.success,
                collision=episode.collided,
            )
            if following < len(choices):
                simulator.reset([i], [choices[following]], source.bank)
                playing[i], following = following, following + 1
                paths[i], costs[i] = [], []
                _record(simulator, np.array([i]), paths, costs)
            else:
                active[i] = False
    return [episode for episode in episodes if episode is not None]


def _record(
    simulator: BatchSimulator, robots: np.ndarray, paths: list[list[np.ndarray]], costs: list[list[float]]
) -> None:
    """Append the current states and costs of robots to their lists."""
    for i in robots.tolist():
        paths[i].append(simulator.states[i].copy())
        costs[i].append(float(simulator.episodes["cost"][i]))
