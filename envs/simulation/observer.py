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

    def observe(self, scenarios: Sequence[Scenario], states: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return flat observations (N, d), float32.

        Args:
            scenarios: N scenarios.
            states (N, n): x, y (m), heading (rad) and further states of the robot.
            times (N,): times since the start of the episode (s).

        """
        simulator, count = self._simulator, len(scenarios)
        observations = np.empty((count, simulator.layout.size), np.float32)
        rows = np.empty((BATCH, simulator.layout.size), np.float32)
        for first in range(0, count, BATCH):
            part = slice(first, min(first + BATCH, count))
            robots = np.arange(part.stop - first)
            simulator.reset(robots, scenarios[part])
            simulator.states[robots] = states[part]
            simulator.episodes["time"][robots] = times[part]
            simulator.observe(rows, robots)
            observations[part] = rows[robots]
        return observations
