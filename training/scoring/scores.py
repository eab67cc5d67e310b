"""Statistics of evaluations: rates, regret, interquartile means, bootstrap intervals and performance profiles.

The methods are those of R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep reinforcement
learning at the edge of the statistical precipice" (NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import trim_mean

from leapnav.training.scoring.results import Evaluation

N_RESAMPLES = 2000  # bootstrap resamples of an interval
CONFIDENCE = 0.95
MAX_RESAMPLED_VALUES = 2_000_000  # values in memory at the same time
Statistic = Callable[[np.ndarray], np.ndarray]  # reduces the last axis


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % bootstrap interval; NaN if there are no values."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Bracket:
    """The proved limits of a median over episodes, see `Episode.true_regret`.

    Attributes:
        low, high: medians of both limits over the episodes; NaN if there are none.
        episodes: number of successful episodes in scenarios with a proved lower bound, of all runs.

    """

    low: float
    high: float
    episodes: int


@dataclass(frozen=True)
class Score:
    """The statistics of a policy: one row of the table.

    Attributes:
        policy: name of the row.
        runs: number of trained policies (seeds) in the row.
        episodes: number of episodes of each run.
        success, collision: success and collision rates.
        soc: mean success weighted by optimal cost.
        soc_iqm: interquartile mean of the success weighted by optimal cost, over runs and scenarios.
        regret: median regret of the successful episodes.
        clearance: median over the episodes of the minimum clearance (m).
        mean_return: mean return.
        milliseconds: median computation time of one action (ms), mean over the runs.
        true_regret: limits of the median of J / J_0 - 1, with J_0 the true optimal cost, see `Episode.true_regret`.

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
    true_regret: Bracket


def score(name: str, runs: Evaluation | Sequence[Evaluation], seed: int = 0) -> Score:
    """Compute the statistics of a policy, or of several runs of one method on the same scenarios.

    The intervals are percentiles of stratified bootstrap resamples. With several runs, the runs are resampled
    independently for each scenario, as in rliable; with one run, the scenarios are resampled within their families.

    Args:
        name: name of the row.
        runs: the evaluation, or one for each run.
        seed: random seed of the bootstrap.

    Raises:
        ValueError: there are no runs, or they have different scenarios.

    """
    evaluations = [runs] if isinstance(runs, Evaluation) else list(runs)
    if not evaluations:
        raise ValueError(f"{name}: expected at least one run, got none")
    scenarios = [[(e.family, e.index, e.scenario) for e in evaluation] for evaluation in evaluations]
    if any(other != scenarios[0] for other in scenarios):
        raise ValueError(f"{name}: expected runs with the same scenarios, got different ones")
    families = np.array([family for family, _, _ in scenarios[0]])
    rng = np.random.default_rng(seed)

    def interval(attribute: Callable[..., float], statistic: Statistic = _mean) -> Interval:
        values = np.array([[attribute(episode) for episode in evaluation] for evaluation in evaluations], dtype=float)
        return _interval(values, families, statistic, rng)

    return Score(
        policy=name,
        runs=len(evaluations),
        episodes=len(scenarios[0]),
        success=interval(lambda e: e.success),
        collision=interval(lambda e: e.collision),
        soc=interval(lambda e: e.soc),
        soc_iqm=interval(lambda e: e.soc, _interquartile_mean),
        regret=interval(lambda e: e.regret if e.success else math.nan, _median),
        clearance=interval(lambda e: e.clearance, _median),
        mean_return=interval(lambda e: e.episode_return),
        milliseconds=float(np.mean([evaluation.milliseconds for evaluation in evaluations])),
        true_regret=_bracket(evaluations),
    )


def _bracket(evaluations: Sequence[Evaluation]) -> Bracket:
    """Return the medians of both limits of the true regret."""
    pairs = [e.true_regret for evaluation in evaluations for e in evaluation if e.success]
    known = [pair for pair in pairs if not math.isnan(pair[0])]
    if not known:
        return Bracket(math.nan, math.nan, 0)
    low, high = np.median(known, axis=0).tolist()
    return Bracket(low, high, len(known))


def profile(runs: Sequence[Evaluation], ratios: np.ndarray, seed: int = 0) -> np.ndarray:
    """Compute the performance profile of a method: the fraction of episodes with J / J* <= ratio, for each ratio.

    Args:
        runs: the evaluation of each run.
        ratios (N,): cost ratios.
        seed: random seed of the bootstrap.

    Returns:
        Fractions and the lower and upper limits of their bootstrap intervals (3, N), see `score`.

    Raises:
        ValueError: there are no runs.

    """
    if not runs:
        raise ValueError("runs: expected at least one, got none")
    values = np.array([[episode.ratio for episode in run] for run in runs])
    families = np.array([episode.family for episode in runs[0]])
    rows = []
    for ratio in ratios:
        # All ratios use the same resamples, for a smooth interval band.
        interval = _interval((values <= ratio).astype(float), families, _mean, np.random.default_rng(seed))
        rows.append((interval.value, interval.low, interval.high))
    return np.array(rows).T


def _interval(values: np.ndarray, families: np.ndarray, statistic: Statistic, rng: np.random.Generator) -> Interval:
    """Return a statistic of values (runs, scenarios) with its interval; NaN values are ignored."""
    flat = values.ravel()
    if np.isnan(flat).all():
        return Interval(math.nan, math.nan, math.nan)
    value = float(statistic(flat))
    if np.ptp(flat[~np.isnan(flat)]) == 0 and not np.isnan(flat).any():  # all resamples would be identical
        return Interval(value, value, value)
    size = max(1, MAX_RESAMPLED_VALUES // flat.size)
    statistics = [
        statistic(_resample(values, families, min(size, N_RESAMPLES - first), rng))
        for first in range(0, N_RESAMPLES, size)
    ]
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(np.concatenate(statistics), [tail, 100 - tail])
    return Interval(value, float(low), float(high))


def _resample(values: np.ndarray, families: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return resamples (count, runs * scenarios) of values (runs, scenarios)."""
    n_runs, n_scenarios = values.shape
    if n_runs > 1:
        chosen = rng.integers(n_runs, size=(count, n_runs, n_scenarios))
        return values[chosen, np.arange(n_scenarios)].reshape(count, -1)
    columns = np.empty((count, n_scenarios), dtype=int)
    for family in np.unique(families):
        members = np.flatnonzero(families == family)
        columns[:, members] = rng.choice(members, (count, len(members)))
    return values[0][columns]


def _mean(values: np.ndarray) -> np.ndarray:
    return np.nanmean(values, axis=-1)


def _median(values: np.ndarray) -> np.ndarray:
    medians = np.full(values.shape[:-1], np.nan)
    measured = ~np.isnan(values).all(axis=-1)  # NumPy warns of resamples that contain NaN only
    medians[measured] = np.nanmedian(values[measured], axis=-1)
    return medians


def _interquartile_mean(values: np.ndarray) -> np.ndarray:
    return trim_mean(values, 0.25, axis=-1)
