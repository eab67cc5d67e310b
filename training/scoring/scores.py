"""Statistics of evaluations: rates, regret, interquartile means, their intervals and performance profiles.

The statistics are those of R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep
reinforcement learning at the edge of the statistical precipice" (NeurIPS 2021). The intervals differ from theirs,
because each trained policy plays all scenarios: runs and scenarios are crossed random factors, and the variance of a
statistic is the sum of the variances of both (A. B. Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1,
2007). The limits of a statistic over several runs use the t distribution, with the degrees of freedom of
F. E. Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics Bulletin 2 (1946),
since percentiles of a bootstrap over few runs are too narrow. The limits of a rate are those of E. B. Wilson, "Probable
inference, the law of succession, and statistical inference", Journal of the American Statistical Association 22 (1927),
in each bank, and those of several banks are combined as by R. G. Newcombe, "Interval estimation for the difference
between independent proportions", Statistics in Medicine 17 (1998).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t, trim_mean

from leapnav.training.scoring.results import Evaluation

N_RESAMPLES = 2000  # bootstrap resamples of an interval with one run
N_VARIANCE_RESAMPLES = 500  # bootstrap resamples of each of the three variances with several runs
CONFIDENCE = 0.95
QUANTILE = (1 + CONFIDENCE) / 2
MAX_RESAMPLED_VALUES = 2_000_000  # values in memory at the same time
Statistic = Callable[[np.ndarray], np.ndarray]  # reduces the last axis


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % interval; NaN if there are no values."""

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
        spl, sct: mean success weighted by path length and by completion time, see `Episode`; NaN if not all scenarios
            have the shortest length and the minimum time.
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
    spl: Interval
    sct: Interval
    soc_iqm: Interval
    regret: Interval
    clearance: Interval
    mean_return: Interval
    milliseconds: float
    true_regret: Bracket


def score(name: str, runs: Evaluation | Sequence[Evaluation], seed: int = 0) -> Score:
    """Compute the statistics of a policy, or of several runs of one method on the same scenarios.

    The intervals refer to other scenarios of the same banks and, with several runs, to other seeds of the training:

    - With one run, those of rates are Wilson intervals, and the others are percentiles of a bootstrap that resamples
      the scenarios within their banks. An SOC, SPL or SCT of 0 or 1 in all episodes has the interval of a rate.
    - With several runs, they contain the variance between runs and that between scenarios, and use the t distribution;
      with two or three runs they are wide.

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
    scenarios = [[(e.bank, e.index, e.scenario) for e in evaluation] for evaluation in evaluations]
    if any(other != scenarios[0] for other in scenarios):
        raise ValueError(f"{name}: expected runs with the same scenarios, got different ones")
    banks = np.array([bank for bank, _, _ in scenarios[0]])
    rng = np.random.default_rng(seed)

    def values_of(attribute: Callable[..., float]) -> np.ndarray:
        return np.array([[attribute(episode) for episode in evaluation] for evaluation in evaluations], dtype=float)

    def interval(attribute: Callable[..., float], statistic: Statistic = _mean) -> Interval:
        return _interval(values_of(attribute), banks, statistic, rng)

    def weighted(attribute: Callable[..., float]) -> Interval:
        values = values_of(attribute)
        if np.isnan(values).any():
            return Interval(math.nan, math.nan, math.nan)
        if set(values.flat) in ({0.0}, {1.0}):
            return _rate(values, banks)
        return _within_unit(_interval(values, banks, _mean, rng))

    return Score(
        policy=name,
        runs=len(evaluations),
        episodes=len(scenarios[0]),
        success=_rate(values_of(lambda e: e.success), banks),
        collision=_rate(values_of(lambda e: e.collision), banks),
        soc=weighted(lambda e: e.soc),
        soc_iqm=_within_unit(interval(lambda e: e.soc, _interquartile_mean)),
        regret=interval(lambda e: e.regret if e.success else math.nan, _median),
        clearance=interval(lambda e: e.clearance, _median),
        mean_return=interval(lambda e: e.episode_return),
        milliseconds=float(np.mean([evaluation.milliseconds for evaluation in evaluations])),
        true_regret=_bracket(evaluations),
        spl=weighted(lambda e: e.spl),
        sct=weighted(lambda e: e.sct),
    )


def _bracket(evaluations: Sequence[Evaluation]) -> Bracket:
    """Return the medians of both limits of the true regret."""
    pairs = [e.true_regret for evaluation in evaluations for e in evaluation if e.success]
    known = [pair for pair in pairs if not math.isnan(pair[0])]
    if not known:
        return Bracket(math.nan, math.nan, 0)
    low, high = np.median(known, axis=0).tolist()
    return Bracket(low, high, len(known))


def profile(runs: Sequence[Evaluation], ratios: np.ndarray) -> np.ndarray:
    """Compute the performance profile of a method: the fraction of episodes with J / J* <= ratio, for each ratio.

    Args:
        runs: the evaluation of each run.
        ratios (N,): cost ratios.

    Returns:
        Fractions and the lower and upper limits of their intervals (3, N), see `score`.

    Raises:
        ValueError: there are no runs.

    """
    if not runs:
        raise ValueError("runs: expected at least one, got none")
    values = np.array([[episode.ratio for episode in run] for run in runs])
    banks = np.array([episode.bank for episode in runs[0]])
    intervals = [_rate((values <= ratio).astype(float), banks) for ratio in ratios]
    return np.array([(interval.value, interval.low, interval.high) for interval in intervals]).T


@dataclass(frozen=True)
class _Variances:
    """The parts of the variance of a statistic of values (runs, scenarios).

    Attributes:
        runs: variance of the statistic between sets of as many runs, in the same scenarios.
        scenarios: variance between sets of as many scenarios, with the same runs.
        interaction: the part of both that is due to single episodes, which must be counted once.
        shape: numbers of runs and scenarios.

    """

    runs: float
    scenarios: float
    interaction: float
    shape: tuple[int, int]

    @property
    def excess(self) -> float:
        """What the runs add to the variance between scenarios."""
        return max(0.0, self.runs - self.interaction)

    @property
    def quantile(self) -> float:
        """Quantile of the t distribution with the degrees of freedom of Satterthwaite; with one run, the normal one."""
        n_runs, n_scenarios = self.shape
        if n_runs == 1:
            return float(norm.ppf(QUANTILE))
        runs, scenarios = n_runs - 1, max(1, n_scenarios - 1)
        parts = self.runs**2 / runs + self.scenarios**2 / scenarios + self.interaction**2 / (runs * scenarios)
        total = self.scenarios + self.excess
        return float(t.ppf(QUANTILE, max(1.0, total**2 / parts))) if parts > 0 else float(norm.ppf(QUANTILE))


def _rate(values: np.ndarray, banks: np.ndarray) -> Interval:
    """Return the mean of values (runs, scenarios) from 0 to 1 with its interval, which never has zero width.

    In each bank, the Wilson interval has an effective number of episodes: that with which independent episodes would
    have the variance between the scenarios. It is the number of scenarios if all episodes have the same outcome.
    """
    n_runs, n_scenarios = values.shape
    value, variances = float(values.mean()), _variances_of_mean(values, banks)
    k = variances.quantile
    below = above = k**2 * variances.excess
    for bank in np.unique(banks):
        means = values[:, banks == bank].mean(axis=0)
        count, rate, spread = len(means), float(means.mean()), float(means.var())
        n = count if spread == 0 else min(count * rate * (1 - rate) / spread, n_runs * count)
        centre = (rate + k**2 / (2 * n)) / (1 + k**2 / n)
        half = k * math.sqrt(rate * (1 - rate) / n + (k / (2 * n)) ** 2) / (1 + k**2 / n)
        below += (count / n_scenarios * (rate - centre + half)) ** 2
        above += (count / n_scenarios * (centre + half - rate)) ** 2
    # Rounding must not exclude the value.
    return _within_unit(Interval(value, value - math.sqrt(below), value + math.sqrt(above)))


def _within_unit(interval: Interval) -> Interval:
    """Return an interval of a statistic from 0 to 1, without the limits that it cannot have."""
    return Interval(interval.value, max(0.0, interval.low), min(1.0, interval.high))


def _variances_of_mean(values: np.ndarray, banks: np.ndarray) -> _Variances:
    """Return the variances of the mean of values (runs, scenarios) without NaN."""
    n_runs, n_scenarios = values.shape
    means, scenarios = values.mean(axis=0), 0.0
    for bank in np.unique(banks):
        chosen = means[banks == bank]
        scenarios += len(chosen) * float(chosen.var(ddof=1)) / n_scenarios**2 if len(chosen) > 1 else 0.0
    if n_runs == 1:
        return _Variances(0.0, scenarios, 0.0, (n_runs, n_scenarios))
    of_runs = values.mean(axis=1)
    residuals = values - of_runs[:, None]
    single = float(residuals.var(axis=0, ddof=1).mean()) / (n_runs * n_scenarios)
    return _Variances(float(of_runs.var(ddof=1)) / n_runs, scenarios, single, (n_runs, n_scenarios))


def _interval(values: np.ndarray, banks: np.ndarray, statistic: Statistic, rng: np.random.Generator) -> Interval:
    """Return a statistic of values (runs, scenarios) with its interval; NaN values are ignored."""
    n_runs, n_scenarios = values.shape
    flat = values.ravel()
    if np.isnan(flat).all():
        return Interval(math.nan, math.nan, math.nan)
    value = float(statistic(flat))
    if n_runs == 1:
        if np.ptp(flat[~np.isnan(flat)]) == 0 and not np.isnan(flat).any():  # all resamples would be identical
            return Interval(value, value, value)
        resamples = _statistics(values, lambda n: values[0][_scenarios(banks, n, rng)], statistic, N_RESAMPLES)
        low, high = np.nanpercentile(resamples, [100 * (1 - QUANTILE), 100 * QUANTILE])
        return Interval(value, float(low), float(high))
    if statistic is _mean and not np.isnan(flat).any():
        variances = _variances_of_mean(values, banks)
    else:
        columns = np.arange(n_scenarios)
        # Whole runs, whole scenarios, and for each scenario other runs
        schemes: list[Callable[[int], np.ndarray]] = [
            lambda n: values[rng.integers(n_runs, size=(n, n_runs))],
            lambda n: np.moveaxis(values[:, _scenarios(banks, n, rng)], 0, 1),
            lambda n: values[rng.integers(n_runs, size=(n, n_runs, n_scenarios)), columns],
        ]
        found = [
            np.nanvar(_statistics(values, lambda n, draw=draw: draw(n).reshape(n, -1), statistic, N_VARIANCE_RESAMPLES))
            for draw in schemes
        ]
        unbiased = n_runs / (n_runs - 1)  # resamples of few runs vary less than new runs
        variances = _Variances(
            unbiased * float(found[0]), float(found[1]), unbiased * float(found[2]), (n_runs, n_scenarios)
        )
    half = variances.quantile * math.sqrt(variances.scenarios + variances.excess)
    return Interval(value, value - half, value + half)


def _statistics(values: np.ndarray, draw: Callable[[int], np.ndarray], statistic: Statistic, count: int) -> np.ndarray:
    """Return a statistic of `count` resamples, drawn in parts that fit into memory."""
    size = max(1, MAX_RESAMPLED_VALUES // values.size)
    return np.concatenate([statistic(draw(min(size, count - first))) for first in range(0, count, size)])


def _scenarios(banks: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return resamples (count, scenarios) of the indices of the scenarios, drawn within their banks."""
    columns = np.empty((count, len(banks)), dtype=int)
    for bank in np.unique(banks):
        members = np.flatnonzero(banks == bank)
        columns[:, members] = rng.choice(members, (count, len(members)))
    return columns


def _mean(values: np.ndarray) -> np.ndarray:
    return np.nanmean(values, axis=-1)


def _median(values: np.ndarray) -> np.ndarray:
    medians = np.full(values.shape[:-1], np.nan)
    measured = ~np.isnan(values).all(axis=-1)  # NumPy warns of resamples that contain NaN only
    medians[measured] = np.nanmedian(values[measured], axis=-1)
    return medians


def _interquartile_mean(values: np.ndarray) -> np.ndarray:
    return trim_mean(values, 0.25, axis=-1)
