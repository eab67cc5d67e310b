"""Statistics of evaluations: rates, regret and their bootstrap intervals, after Agarwal et al.

R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep reinforcement learning at the edge of
the statistical precipice" (NeurIPS 2021): interquartile means, stratified bootstrap intervals, performance profiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import trim_mean

from leapnav.training.evaluation import Evaluation

RESAMPLES = 2000
CONFIDENCE = 0.95
CHUNK = 2_000_000  # resampled numbers held at once
Statistic = Callable[[np.ndarray], np.ndarray]  # of the last axis


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % bootstrap interval; NaN where there is nothing to measure."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """The row of a policy.

    Attributes:
        policy: its name.
        runs: how many trained policies (seeds) the row stands for.
        episodes: how many scenarios each of them played.
        success, collision: rates.
        soc: mean success weighted by optimal cost.
        soc_iqm: its interquartile mean over runs and scenarios.
        regret: median over the successes.
        clearance: m, median over the episodes of the smallest.
        mean_return: mean of the episodes' returns.
        milliseconds: median time for one action.

    """

    policy: str
    runs: int
    episodes: int
    success: Interval
    collision: Interval
    soc: Interval
    soc_iqm: Interval
    regret: Interval
    clearance: Interval
    mean_return: Interval
    milliseconds: float


def score(name: str, runs: Evaluation | Sequence[Evaluation], seed: int = 0) -> Score:
    """The statistics of a policy, or of several runs of one method on the same scenarios.

    The intervals are percentiles of stratified bootstrap resamples: with several runs, of the runs anew for each
    scenario, as rliable does; with one, of the scenarios within their families.

    Raises:
        ValueError: there are no runs, or they played different scenarios.

    """
    evaluations = [runs] if isinstance(runs, Evaluation) else list(runs)
    if not evaluations:
        raise ValueError(f"{name}: expected at least one run, got none")
    played = [[(e.family, e.index, e.scenario) for e in evaluation] for evaluation in evaluations]
    if any(scenarios != played[0] for scenarios in played):
        raise ValueError(f"{name}: its runs have played different scenarios")
    families = np.array([family for family, _, _ in played[0]])
    rng = np.random.default_rng(seed)

    def interval(attribute: Callable[..., float], statistic: Statistic = _mean) -> Interval:
        values = np.array([[attribute(episode) for episode in evaluation] for evaluation in evaluations], dtype=float)
        return _interval(values, families, statistic, rng)

    return Score(
        policy=name,
        runs=len(evaluations),
        episodes=len(played[0]),
        success=interval(lambda e: e.success),
        collision=interval(lambda e: e.collision),
        soc=interval(lambda e: e.soc),
        soc_iqm=interval(lambda e: e.soc, _interquartile_mean),
        regret=interval(lambda e: e.regret if e.success else math.nan, _median),
        clearance=interval(lambda e: e.clearance, _median),
        mean_return=interval(lambda e: e.episode_return),
        milliseconds=float(np.mean([evaluation.milliseconds for evaluation in evaluations])),
    )


def profile(runs: Sequence[Evaluation], ratios: np.ndarray, seed: int = 0) -> np.ndarray:
    """The performance profile of a method: for each ratio, the share of its episodes with J / J* up to there.

    Returns:
        value, low, high (3, len(ratios)): with the intervals of `score`.

    Raises:
        ValueError: there are no runs.

    """
    if not runs:
        raise ValueError("runs: expected at least one, got none")
    values = np.array([[episode.ratio for episode in run] for run in runs])
    families = np.array([episode.family for episode in runs[0]])
    rows = []
    for ratio in ratios:
        # The same resamples for each ratio, so that the bands are as smooth as the profile.
        found = _interval((values <= ratio).astype(float), families, _mean, np.random.default_rng(seed))
        rows.append((found.value, found.low, found.high))
    return np.array(rows).T


def _interval(values: np.ndarray, families: np.ndarray, statistic: Statistic, rng: np.random.Generator) -> Interval:
    """The interval of a statistic of values (runs, scenarios); NaN values do not count."""
    flat = values.ravel()
    if np.isnan(flat).all():
        return Interval(math.nan, math.nan, math.nan)
    value = float(statistic(flat))
    if np.ptp(flat[~np.isnan(flat)]) == 0 and not np.isnan(flat).any():  # all resamples are the same
        return Interval(value, value, value)
    size = max(1, CHUNK // flat.size)
    found = [
        statistic(_resampled(values, families, min(size, RESAMPLES - first), rng))
        for first in range(0, RESAMPLES, size)
    ]
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(np.concatenate(found), [tail, 100 - tail])
    return Interval(value, float(low), float(high))


def _resampled(values: np.ndarray, families: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Resamples (count, runs * scenarios)."""
    runs, scenarios = values.shape
    if runs > 1:
        chosen = rng.integers(runs, size=(count, runs, scenarios))
        return values[chosen, np.arange(scenarios)].reshape(count, -1)
    columns = np.empty((count, scenarios), dtype=int)
    for family in np.unique(families):
        members = np.flatnonzero(families == family)
        columns[:, members] = rng.choice(members, (count, len(members)))
    return values[0][columns]


def _mean(values: np.ndarray) -> np.ndarray:
    return np.nanmean(values, axis=-1)


def _median(values: np.ndarray) -> np.ndarray:
    found = np.full(values.shape[:-1], np.nan)
    measured = ~np.isnan(values).all(axis=-1)  # a resample may have nothing that is
    found[measured] = np.nanmedian(values[measured], axis=-1)
    return found


def _interquartile_mean(values: np.ndarray) -> np.ndarray:
    return trim_mean(values, 0.25, axis=-1)
