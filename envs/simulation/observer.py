"""Observations at given states, without simulation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.simulator import BatchSimulator

BATCH = 512  # states observed together


class Observer:
    """Compute the observations of the environment at any states of any scenarios, without noise.

    Args:
        settings: settings of the environment; None for its defaults.

    """

    def __init__(self, settings: EnvironmentSettings | None = None) -> None:
        self._simulator = BatchSimulator(BATCH, settings or EnvironmentSettings())

    def __reduce__(self) -> tuple[type[Observer], tuple[EnvironmentSettings]]:
        """Leave out the arrays: those of a history are large enough that joblib would share them, read-only."""
        return Observer, (self._simulator.settings,)

    def observe(
        self,
        scenarios: Sequence[Scenario],
        states: np.ndarray,
        times: np.ndarray,
        actions: np.ndarray | None = None,
        starts: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return flat observations (N, d), float32.

        Args:
            scenarios: N scenarios.
            states (N, n): x, y (m), heading (rad) and further states of the robot.
            times (N,): times since the start of the episode (s).
            actions (N, m): the last actions; None: 0.
            starts (N,): index of the first row of each row's episode, of which the rows are consecutive control
                periods: the source of the history; None: each row is the first of an episode.

        """
        simulator, count = self._simulator, len(scenarios)
        observations = np.empty((count, simulator.layout.size), np.float32)
        frame = simulator.layout.frame
        rows = np.empty((BATCH, simulator.layout.size), np.float32)
        for first in range(0, count, BATCH):
            part = slice(first, min(first + BATCH, count))
            robots = np.arange(part.stop - first)
            simulator.reset(robots, scenarios[part])
            simulator.states[robots] = states[part]
            simulator.episodes["time"][robots] = times[part]
            if actions is not None:
                simulator.layout.actions[robots] = actions[part]
            simulator.observe(rows, robots)
            observations[part] = rows[robots]
        if starts is not None:
            for number, lag in enumerate(simulator.settings.lags, start=1):
                earlier = np.maximum(np.arange(count) - lag, starts)
                observations[:, number * frame : (number + 1) * frame] = observations[earlier, :frame]
        return observations
