"""Takeovers: the states of a learner's episodes from which the expert drives, and the samples that it provides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observer import Observer
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.optimum import Effort, find_optimum
from leapnav.experts.problem.extremal import Extremal
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.driving import DrivenEpisode

# Times of the takeovers before a collision (s), denser shortly before it. In an episode that misses its goal
# the number of takeovers is the same, at uniformly distributed times. With a free horizon, a robot that misses its goal
# has mostly stopped, between two paths of similar cost: the times are then those before a time shortly after the stop.
TAKEOVER_TIMES = np.array([8.0, 6.5, 5.0, 4.0, 3.25, 2.5, 2.0, 1.5, 1.1, 0.8, 0.5, 0.3])
STOP_DISTANCE, AFTER_STOP = 0.1, 0.6  # m (and rad) from the last state; s
RELATIVE_SPREAD = 0.2  # half-width of the random factor of these times around 1
MIN_TIME_LEFT = 1.0  # s before the horizon, after which the expert does not take over


class Labeller:
    """Choose takeovers in the episodes of a learner, and label them.

    Args:
        settings: settings of the environment.
        lead: time that the expert drives after a takeover (s).
        effort: effort of the searches, see `find_optimum`.

    """

    def __init__(self, settings: EnvironmentSettings, lead: float, effort: Effort) -> None:
        self._settings, self._lead = settings, lead
        self._effort: Effort = effort
        self._observer = Observer(settings)

    def label(self, episode: DrivenEpisode, rng: np.random.Generator) -> list[Dataset]:
        """Return the samples of the takeovers in order of time, up to the first one without an optimum."""
        found = []
        for step in scheduled_steps(episode, self._settings.control_period, rng):
            scenario = rest_of(episode, step, self._settings.control_period)
            optimum = None if scenario is None else find_optimum(scenario, effort=self._effort)
            if scenario is None or optimum is None or not optimum.success:
                break
            played = episode.played
            found.append(self.samples(scenario, optimum, played.states[:step], played.actions[:step]))
        return found

    def samples(
        self,
        scenario: Scenario,
        optimum: Extremal,
        states_before: np.ndarray | None = None,
        actions_before: np.ndarray | None = None,
    ) -> Dataset:
        """Return the samples along the first seconds of an optimum, one per control period.

        The states are those of the optimum, so neither a simulation nor further solves are necessary.

        Args:
            scenario: the scenario from the takeover on.
            optimum: its optimum.
            states_before (K, n), actions_before (K, m): the states of the learner in the K control periods before the
                takeover, and its actions there; None: the episode begins with the takeover.

        """
        period = self._settings.control_period
        actions = plan_actions(optimum, scenario, period)[: max(1, round(self._lead / period))]
        times = np.minimum(period * np.arange(len(actions) + 1), optimum.horizon)
        n = len(scenario.robot.state_names)  # among moving obstacles, the time is a further state of the optimum
        states, costates = (values[:, :n] for values in optimum.evaluate(times[:-1])[::2])
        costs = np.asarray(optimum.cost_to_go(times))
        # The history of the observations begins with the states of the learner.
        before = 0 if states_before is None else min(len(states_before), 1 + max(self._settings.lags, default=0))
        driven, previous = states, np.concatenate([np.zeros_like(actions[:1]), actions[:-1]])
        if states_before is not None and actions_before is not None and before:
            driven = np.concatenate([states_before[-before:], states])
            known = np.concatenate([np.zeros_like(actions[:1]), actions_before, actions[:-1]])
            previous = known[-len(driven) :]
        observations = self._observer.observe(
            [scenario] * len(driven),
            driven,
            np.append(period * np.arange(-before, 0), times[:-1]),
            previous,
            np.zeros(len(driven), dtype=int),
        )
        return Dataset(
            observations=observations[before:],
            actions=actions,
            returns=-costs[:-1],
            costates=costates,
            states=states,
            times=times[:-1],
            executed=actions,
            rewards=np.diff(costs),
            episodes=np.zeros(len(actions), dtype=int),
            scenarios=(scenario.to_json(),),
            settings=replace(self._settings, reward="cost"),
        )


def scheduled_steps(episode: DrivenEpisode, period: float, rng: np.random.Generator) -> list[int]:
    """Return the steps of an episode at which the expert takes over, in increasing order."""
    played, horizon = episode.played, episode.scenario.horizon
    count = len(played.actions)
    end = count * period
    if played.success:
        times = rng.uniform(0.0, end, 1)
    elif played.collision or horizon is None:
        n_takeovers = len(TAKEOVER_TIMES)
        decision = end if played.collision else min(_stop_time(played.states, period) + AFTER_STOP, end)
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
        return episode.scenario.from_state(episode.played.states[step], time)
    except ScenarioError:
        return None


def _stop_time(states: np.ndarray, period: float) -> float:
    """Return the time (s) from which the robot stays where the episode ends."""
    distances = np.linalg.norm(states[:, :3] - states[-1, :3], axis=1)
    moving = np.flatnonzero(distances > STOP_DISTANCE)
    return period * (int(moving[-1]) + 1 if len(moving) else 0)


def label_episodes(labeller: Labeller, episodes: Sequence[DrivenEpisode], seed: Any) -> list[Dataset]:
    """Return the samples of the takeovers of several episodes."""
    rng = np.random.default_rng(seed)
    return [samples for episode in episodes for samples in labeller.label(episode, rng)]
