"""Regret of a policy on each level, and of each of its decisions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_at_least, check_positive
from leapnav.experts.optimum import find_optimum
from leapnav.training.scoring.adapters import PolicyOrFactory
from leapnav.training.scoring.evaluation import evaluate, resolve
from leapnav.training.scoring.results import Episode, Evaluation
from leapnav.training.threads import limit_threads

RESOLUTION = 0.25  # s between the states from which the optimum is searched


@dataclass(frozen=True, eq=False)
class Decisions:
    """The regret of the decisions in one episode.

    The optimal cost from a state plus the cost so far increases by the regret of the decisions in between, and is
    constant along an optimum.

    Attributes:
        episode: the episode.
        steps (M + 1,): environment steps at the ends of the intervals, from 0 to that of the end of the episode.
        times (M + 1,): the same in s since the start of the episode.
        regrets (M,): regret of each interval, in the unit of the cost, not negative. The sum is the regret of the
            level, unless penalties below the optimal cost make that lower.
        lost_at: time (s) of the first state from which no optimum exists any more; NaN if there is none. The interval
            before it has all of the remaining regret.

    """

    episode: Episode
    steps: np.ndarray
    times: np.ndarray
    regrets: np.ndarray
    lost_at: float

    @property
    def states(self) -> np.ndarray:
        """States (M + 1, n) at the ends of the intervals."""
        return self.episode.states[self.steps]


@dataclass(frozen=True, eq=False)
class PolicyRegret:
    """The regret of a policy on the levels (scenarios) of a bank.

    Attributes:
        evaluation: the episodes.
        levels (N,): regret of each level, in the unit of the cost: the return of the optimum minus that of the policy.
            For a success it is J - J*, with J* for the pose reached, or that of the scenario if no optimum for the pose
            reached is found; else J plus the penalties minus J*.
        decisions: the regret of the decisions in each episode; None unless requested.

    """

    evaluation: Evaluation
    levels: np.ndarray
    decisions: tuple[Decisions, ...] | None = None

    def worst(self, count: int = 10) -> list[tuple[int, float, float]]:
        """Return the most expensive decisions: index of the scenario, time (s) and regret, in decreasing order.

        Raises:
            ValueError: the regret of the decisions was not requested.

        """
        if self.decisions is None:
            raise ValueError("decisions: expected regret(..., decisions=True), got the regret of the levels only")
        rows = [
            (one.episode.index, float(time), float(value))
            for one in self.decisions
            for time, value in zip(one.times[:-1], one.regrets, strict=True)
        ]
        return sorted(rows, key=lambda row: -row[2])[:count]


@limit_threads
def regret(
    policy: PolicyOrFactory | str | Path,
    bank: ScenarioBank | str | Path = "clutter",
    *,
    decisions: bool = False,
    resolution: float = RESOLUTION,
    count: int | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 0,
    workers: int = 1,
    progress: bool = True,
) -> PolicyRegret:
    """Compute the regret of a policy on each scenario of a bank, and on request that of its decisions.

    The regret of a decision is J(t2) - J(t1) + V(q(t2), t2) - V(q(t1), t1), with the cost J so far and the optimal cost
    V from the state of the robot. V comes from a new search at each of the states: a local optimum that is only tracked
    gives false regret where another one becomes better. Where the search finds a worse local optimum than at the
    following state, V is bounded by the driven path followed by that optimum, so that no regret is negative. With
    motors, V is that of the ideal robot at the same pose.

    Args:
        policy, bank, count, environment, seed: see `evaluate`.
        decisions: compute the regret of the decisions.
        resolution: time between the states from which the optimum is searched (s), rounded to control periods.
        workers: number of processes for the searches.
        progress: show progress bars.

    Raises:
        TypeError, ValueError: see `evaluate`.

    """
    check_positive("resolution", resolution)
    check_at_least("workers", workers, 1)
    policy, bank, environment = resolve(policy, bank, environment, seed)
    evaluation = evaluate(policy, bank, count=count, environment=environment, seed=seed, timed=False, progress=progress)
    if not decisions:
        return PolicyRegret(evaluation, level_regrets(evaluation))
    found = decisions_of(evaluation, bank, resolution=resolution, workers=workers, progress=progress)
    return PolicyRegret(evaluation, level_regrets(evaluation), tuple(found))


def decisions_of(
    evaluation: Evaluation,
    bank: ScenarioBank,
    *,
    resolution: float = RESOLUTION,
    workers: int = 1,
    progress: bool = True,
) -> list[Decisions]:
    """Return the regret of the decisions in each episode of an evaluation on one bank, see `regret`."""
    levels, settings = level_regrets(evaluation), evaluation.settings
    every = max(1, round(resolution / settings.control_period))
    tasks = (
        delayed(_decide)(bank[episode.index], episode, level, every, settings.control_period)
        for episode, level in zip(evaluation, levels.tolist(), strict=True)
    )
    found: list[Decisions] = []
    with progress_bar(total=len(levels), label="Regret of decisions", unit="episodes", show=progress) as bar:
        for one in cast(Iterator[Decisions], Parallel(workers, return_as="generator")(tasks)):
            found.append(one)
            bar.update()
    return found


def level_regrets(evaluation: Evaluation) -> np.ndarray:
    """Return the regret of each level (N,): the return of the optimum minus that of the episode, with reward "cost"."""
    return np.array([_level_regret(episode, evaluation.settings) for episode in evaluation])


def _level_regret(episode: Episode, settings: EnvironmentSettings) -> float:
    if episode.success:
        unknown = math.isnan(episode.reached_reference)
        return max(0.0, episode.cost - (episode.reference_cost if unknown else episode.reached_reference))
    penalty = settings.collision_penalty * episode.collision + settings.miss_penalty * (not episode.truncated)
    return episode.cost + penalty - episode.reference_cost


def _decide(scenario: Scenario, episode: Episode, level: float, every: int, period: float) -> Decisions:
    """Return the regret of the decisions of an episode, with a search after every so many steps."""
    if episode.success:  # the optimum to the pose reached, with which the cost of the episode is compared
        scenario = scenario.to_state(episode.states[-1])
    last = len(episode.states) - 1
    steps = [*range(0, last, every), last]
    # The cost so far plus the optimal cost to go
    totals = [episode.cost - level if episode.success else episode.reference_cost]
    lost_at = math.nan
    for step in steps[1:-1]:
        value = _optimal_cost(scenario, episode.states[step], step * period)
        if math.isnan(value):
            if not episode.success:
                lost_at = step * period
                break
            value = episode.cost - episode.costs[step]  # the rest of the episode is a path to the goal
        totals.append(float(episode.costs[step]) + value)
    end = episode.cost if episode.success else totals[0] + level
    totals += [end] * (len(steps) - len(totals))
    # No state can have a greater total than the next one, see `regret`.
    bounded = np.minimum.accumulate(np.array(totals)[::-1])[::-1]
    chosen = np.array(steps)
    return Decisions(episode, chosen, chosen * period, np.diff(bounded), lost_at)


def _optimal_cost(scenario: Scenario, state: np.ndarray, time: float) -> float:
    """Return the optimal cost from a state at a time (s) to the goal; NaN if none was found."""
    try:
        rest = scenario.from_state(state, time)
    except ScenarioError:  # in collision, or without time left
        return math.nan
    for effort in ("low", "medium"):
        optimum = find_optimum(rest, effort)
        if optimum.success:
            return float(optimum.cost)
    return math.nan
