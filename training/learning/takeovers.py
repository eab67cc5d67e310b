"""Takeovers: the states of a learner's episodes from which the expert drives, and the samples that it provides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observer import Observer
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem.extremal import Extremal
from leapnav.training.config import DAggerConfig
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.driving import DrivenEpisode

# Times of the takeovers before a collision (s), denser shortly before it. In an episode that misses its goal
# the number of takeovers is the same, at uniformly distributed times. With a free horizon, a robot that misses its goal
# has mostly stopped, between two paths of similar cost: the times are then those before a time shortly after the stop.
TAKEOVER_TIMES = np.array([8.0, 6.5, 5.0, 4.0, 3.25, 2.5, 2.0, 1.5, 1.1, 0.8, 0.5, 0.3])
STOP_DISTANCE, AFTER_STOP = 0.1, 0.6  # m (and rad) from the last state; s
RELATIVE_SPREAD = 0.2  # half-width of the random factor of these times around 1
MIN_TIME_LEFT = 1.0  # s before the horizon, after which the expert does not take over


class Takeover(NamedTuple):
    """A step of an episode, the rest of the episode from there as a scenario, and its optimum."""

    step: int
    scenario: Scenario
    optimum: Extremal


class Labeller:
    """Choose takeovers in the episodes of a learner, and label them.

    Args:
        settings: settings of the environment.
        config: settings of DAgger.
        quick: whether the searches examine only the most promising candidates, see `find_optimum`.
        history: maximum number of samples without a label before a takeover, for policies with memory.

    """

    def __init__(self, settings: EnvironmentSettings, config: DAggerConfig, *, quick: bool, history: int = 0) -> None:
        self._settings, self._config, self._quick, self._history = settings, config, quick, history
        self._observer = Observer(settings)

    def label(self, episode: DrivenEpisode, rng: np.random.Generator) -> list[Dataset]:
        """Return the samples of the takeovers in order of time, up to the first one without an optimum."""
        found = []
        for step in scheduled_steps(episode, self._settings.control_period, rng):
            taken = self._search(episode, step)
            if taken is None:
                break
            found.append(self._samples(episode, taken))
        return found

    def _samples(self, episode: DrivenEpisode, taken: Takeover) -> Dataset:
        """Return the samples of a takeover, after those of the learner's states before it."""
        lead = self._config.lead
        samples = samples_of(self._observer, self._settings, taken.scenario, taken.optimum, lead)
        before = episode.states[max(0, taken.step - self._history) : taken.step]
        if len(before) == 0:
            return samples
        times = self._settings.control_period * np.arange(-len(before), 0)
        observations = self._observer.observe([taken.scenario] * len(before), before, times)
        return samples.preceded(observations, before, times)

    def _search(self, episode: DrivenEpisode, step: int) -> Takeover | None:
        """Return the takeover at a step; None if there is no optimum."""
        scenario = rest_of(episode, step, self._settings.control_period)
        if scenario is None:
            return None
        optimum = find_optimum(scenario, thorough=not self._quick, alternatives=False)
        return Takeover(step, scenario, optimum) if optimum.success else None


def scheduled_steps(episode: DrivenEpisode, period: float, rng: np.random.Generator) -> list[int]:
    """Return the steps of an episode at which the expert takes over, in increasing order."""
    count = len(episode.states) - 1
    end, horizon = count * period, episode.scenario.horizon
    if episode.success:
        times = rng.uniform(0.0, end, 1)
    elif episode.collision or horizon is None:
        n_takeovers = len(TAKEOVER_TIMES)
        decision = end if episode.collision else min(_stop_time(episode.states, period) + AFTER_STOP, end)
        times = decision - TAKEOVER_TIMES * rng.uniform(1 - RELATIVE_SPREAD, 1 + RELATIVE_SPREAD, n_takeovers)
    else:
        times = np.sort(rng.uniform(0.0, end, len(TAKEOVER_TIMES)))
    steps = np.unique((times / period).round().astype(int))
    return steps[(steps > 0) & (steps < count)].tolist()


def rest_of(episode: DrivenEpisode, step: int, period: float) -> Scenario | None:
    """Return the scenario that starts at a state of an episode; None in collision or with little time left."""
    horizon, time = episode.scenario.horizon, step * period
    if horizon is not None and horizon - time < MIN_TIME_LEFT:
        return None
    try:
        return episode.scenario.from_state(episode.states[step], time)
    except ScenarioError:
        return None


def _stop_time(states: np.ndarray, period: float) -> float:
    """Return the time (s) from which the robot stays where the episode ends."""
    distances = np.linalg.norm(states[:, :3] - states[-1, :3], axis=1)
    moving = np.flatnonzero(distances > STOP_DISTANCE)
    return period * (int(moving[-1]) + 1 if len(moving) else 0)


def samples_of(
    observer: Observer, settings: EnvironmentSettings, scenario: Scenario, optimum: Extremal, lead: float
) -> Dataset:
    """Return the samples along the first `lead` seconds of an optimum, one per control period.

    The states are those of the optimum, so neither a simulation nor further solves are necessary.
    """
    actions = plan_actions(optimum, scenario, settings.control_period)
    actions = actions[: max(1, round(lead / settings.control_period))]
    times = np.minimum(settings.control_period * np.arange(len(actions) + 1), optimum.horizon)
    states, _, costates = optimum.evaluate(times[:-1])
    costs = np.asarray(optimum.cost_to_go(times))
    return Dataset(
        observations=observer.observe([scenario] * len(actions), states, times[:-1]),
        actions=actions,
        returns=-costs[:-1],
        costates=costates,
        states=states,
        times=times[:-1],
        executed=actions,
        rewards=np.diff(costs),
        episodes=np.zeros(len(actions), dtype=int),
        scenarios=(scenario.to_json(),),
        settings=replace(settings, reward="cost"),
    )


def label_episodes(labeller: Labeller, episodes: Sequence[DrivenEpisode], seed: Any) -> list[Dataset]:
    """Return the samples of the takeovers of several episodes."""
    rng = np.random.default_rng(seed)
    return [samples for episode in episodes for samples in labeller.label(episode, rng)]
