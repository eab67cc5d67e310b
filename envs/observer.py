"""What a robot would observe somewhere else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from leapnav.envs.driving import TIME
from leapnav.envs.fleet import Fleet
from leapnav.envs.scenario import Scenario
from leapnav.envs.settings import Settings

ROOM = 512  # robots that observe together


class Observer:
    """Observations from any states of any scenarios, as the environment would show them there, undisturbed.

    Args:
        settings: of the environment, those of its defaults if not given.

    """

    def __init__(self, settings: Settings | None = None) -> None:
        self._fleet = Fleet(ROOM, settings or Settings())

    def observe(self, scenarios: Sequence[Scenario], states: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Flat observations (N, d), float32.

        Args:
            scenarios: N of them.
            states (N, 3): x, y (m), heading (rad).
            times (N,): s since the start of the episode.

        """
        fleet, count = self._fleet, len(scenarios)
        found = np.empty((count, fleet.layout.size), np.float32)
        rows = np.empty((ROOM, fleet.layout.size), np.float32)
        for first in range(0, count, ROOM):
            part = slice(first, min(first + ROOM, count))
            robots = np.arange(part.stop - first)
            fleet.begin(robots, scenarios[part])
            fleet.poses[robots] = states[part]
            fleet.state[robots, TIME] = times[part]
            fleet.observe(rows, robots)
            found[part] = rows[robots]
        return found
