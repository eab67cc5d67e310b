"""Episodes that a learner drives on new scenarios, in parallel processes."""

from __future__ import annotations

import warnings
from collections.abc import Generator, Iterator
from itertools import count
from typing import Any, NamedTuple, cast

import numpy as np
from joblib import Parallel, delayed
from stable_baselines3.common.policies import BasePolicy

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import ScenarioSource, get_scenario
from leapnav.envs.settings import ARGUMENTS, EnvironmentSettings
from leapnav.envs.vector import AutoresetMode, NavigateVectorEnv
from leapnav.training.environments.playing import PlayedEpisode, play_episodes
from leapnav.training.threads import limit_threads


class DrivenEpisode(NamedTuple):
    """A scenario, and the episode of a learner on it."""

    scenario: Scenario
    played: PlayedEpisode


def drive_episodes(
    policy: BasePolicy,
    source: ScenarioSource,
    settings: EnvironmentSettings,
    seed: tuple[int, ...],
    *,
    robots: int,
    workers: int,
) -> Generator[DrivenEpisode]:
    """Yield episodes of a policy with deterministic actions, without end.

    Args:
        policy: the policy; it must not change until the generator is closed.
        source: source of the scenarios.
        settings: settings of the environment, without disturbances.
        seed: seed of the scenarios; the episodes do not depend on the number of workers.
        robots: number of robots that a process simulates together, on which the scenarios depend.
        workers: number of processes.

    """
    tasks = (delayed(_drive)(policy, source, settings, (*seed, number), robots) for number in count())
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
    policy: BasePolicy, source: ScenarioSource, settings: EnvironmentSettings, seed: tuple[int, ...], robots: int
) -> list[DrivenEpisode]:
    """Return one episode of each robot."""
    rng = np.random.default_rng(seed)
    scenarios = [get_scenario(source.draw(rng), source.bank) for _ in range(robots)]
    arguments = {name: getattr(settings, name) for name in ARGUMENTS}
    # Robots whose episode has ended drive their first scenario, until all have ended.
    venv = NavigateVectorEnv(robots, scenario=scenarios[0], autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    played = play_episodes(policy, venv, {"scenario": scenarios}, seed=0)
    return [DrivenEpisode(scenario, episode) for scenario, episode in zip(scenarios, played, strict=True)]
