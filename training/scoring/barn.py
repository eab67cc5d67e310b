"""The score of the BARN challenge, beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.worlds.barn import GOAL_DISTANCE
from leapnav.training.scoring.comparison import Comparison
from leapnav.training.scoring.results import Episode

REFERENCE_SPEED = 2.0  # m/s: the challenge's optimal time is the length of its path divided by this speed
FASTEST, SLOWEST = 2.0, 8.0  # the time of an episode counts at least and at most so many optimal times
TIME_LIMIT = 100.0  # s


@dataclass(frozen=True)
class BarnScore:
    """The results of a policy in the worlds of the BARN challenge, as the challenge counts them.

    Attributes:
        policy: name of the policy.
        success: rate of the episodes in which the robot comes within 1 m of the goal, without a collision before.
        seconds: mean time until then (s), NaN without a success.
        score: mean of success x OT / clip(AT, 2 OT, 8 OT), with the optimal time OT and the time AT until success; at
            most 0.5.

    """

    policy: str
    success: float
    seconds: float
    score: float


def barn_scores(comparison: Comparison, lengths: Mapping[str, float]) -> list[BarnScore]:
    """Return the scores of the policies of a comparison on a bank of the worlds.

    Args:
        comparison: the comparison, with one bank.
        lengths: lengths of the challenge's paths (m) by the names of the scenarios, see `path_lengths`; for other
            scenarios, the straight distance counts.

    """
    (bank,) = comparison.banks
    rows = []
    for name, runs in comparison.runs.items():
        times = [
            (arrival_time(episode, bank, run.settings.control_period), _length(episode, bank, lengths))
            for run in runs
            for episode in run
        ]
        scores = [barn_score(time, length) for time, length in times]
        arrived = [time for time, _ in times if time is not None]
        seconds = float(np.mean(arrived)) if arrived else math.nan
        rows.append(BarnScore(name, len(arrived) / len(times), seconds, float(np.mean(scores))))
    return rows


def barn_score(time: float | None, length: float) -> float:
    """Return the challenge's score of an episode.

    Args:
        time: time until success (s), None without a success.
        length: length of the challenge's path (m).

    """
    if time is None:
        return 0.0
    optimal = length / REFERENCE_SPEED
    return optimal / min(max(time, FASTEST * optimal), SLOWEST * optimal)


def arrival_time(episode: Episode, bank: ScenarioBank, control_period: float) -> float | None:
    """Return the time (s) at which an episode comes within 1 m of the goal; None if it does not within 100 s."""
    goal = bank[episode.index].goal[:2]
    near = np.hypot(*(episode.states[:, :2] - goal).T) <= GOAL_DISTANCE
    if not near.any():
        return None
    time = float(np.argmax(near)) * control_period
    return time if time <= TIME_LIMIT else None


def _length(episode: Episode, bank: ScenarioBank, lengths: Mapping[str, float]) -> float:
    scenario = bank[episode.index]
    return lengths.get(scenario.name, math.dist(scenario.start[:2], scenario.goal[:2]))
