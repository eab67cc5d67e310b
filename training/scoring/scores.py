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
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from leapnav.training.scoring.results import Evaluation

N_RESAMPLES = 2000  # bootstrap resamples of an interval with one run
N_VARIANCE_RESAMPLES = 500  # bootstrap resamples of each of the three variances with several runs
CONFIDENCE = 0.95
QUANTILE = (1 + CONFIDENCE) / 2
NORMAL_QUANTILE = float(ndtri(QUANTILE))
MAX_RESAMPLED_VALUES = 2_000_000  # values in memory at the same time
Statistic = Callable[[np.ndarray], np.ndarray]  # reduces the last axis


class Limits(NamedTuple):
    """The limits of a 95 % interval."""

    low: float
    high: float


UNKNOWN = Limits(math.nan, math.nan)


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % intervals; NaN if there are no values.

    Attributes:
        value: the statistic of all episodes.
        low, high: the interval over the scenarios: for the same policies in other scenarios of the same banks.
        runs: the statistic of each run.
        over_runs: limits of the interval over runs and scenarios: for other seeds of the training too; NaN for one run.

    """

    value: float
    low: float
    high: float
    runs: tuple[float, ...] = ()
    over_runs: Limits = UNKNOWN


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


class Score:
    """The statistics of a policy: one row of the table. Each is computed when it is first read.

    Args:
        policy: name of the row.
        evaluations: the evaluation of each run, of the same scenarios.
        seed: random seed of the bootstrap of each statistic.

    Attributes:
        policy: name of the row.
        runs: number of trained policies (seeds) in the row.
        episodes: number of episodes of each run.

    """

    STATISTICS = (
        *("success", "collision", "soc", "spl", "sct", "soc_iqm", "regret", "reached_soc", "reached_regret"),
        *("unknown", "clearance", "mean_return", "milliseconds", "true_regret"),
    )

    def __init__(self, policy: str, evaluations: Sequence[Evaluation], seed: int) -> None:
        self.policy, self.runs, self.episodes = policy, len(evaluations), len(evaluations[0])
        self._evaluations, self._seed = evaluations, seed
        self._banks = np.array([episode.bank for episode in evaluations[0]])

    @cached_property
    def success(self) -> Interval:
        """Success rate."""
        return _rate(self._values("success"), self._banks)

    @cached_property
    def collision(self) -> Interval:
        """Collision rate."""
        return _rate(self._values("collision"), self._banks)

    @cached_property
    def soc(self) -> Interval:
        """Mean success weighted by optimal cost."""
        return self._weighted("soc")

    @cached_property
    def spl(self) -> Interval:
        """Mean success weighted by path length, see `Episode`; NaN if not all scenarios have the shortest length."""
        return self._weighted("spl")

    @cached_property
    def sct(self) -> Interval:
        """Mean success weighted by completion time, see `Episode`; NaN if not all scenarios have the minimum time."""
        return self._weighted("sct")

    @cached_property
    def soc_iqm(self) -> Interval:
        """Interquartile mean of the success weighted by optimal cost, over runs and scenarios."""
        return _within_unit(self._interval("soc", _interquartile_mean))

    @cached_property
    def regret(self) -> Interval:
        """Median regret of the successful episodes."""
        return self._interval("regret", _median)

    @cached_property
    def reached_soc(self) -> Interval:
        """SOC for the pose reached, see `Episode.reached_soc`, over the episodes for which it is known."""
        return self._weighted("reached_soc", partly=True)

    @cached_property
    def reached_regret(self) -> Interval:
        """Median regret for the pose reached, over the successful episodes for which it is known."""
        return self._interval("reached_regret", _median)

    @cached_property
    def unknown(self) -> int:
        """Number of successful episodes of all runs for which no optimum for the pose reached was found."""
        return sum(
            e.success and math.isnan(e.reached_reference) for evaluation in self._evaluations for e in evaluation
        )

    @cached_property
    def clearance(self) -> Interval:
        """Median over the episodes of the minimum clearance (m)."""
        return self._interval("clearance", _median)

    @cached_property
    def mean_return(self) -> Interval:
        """Mean return."""
        return self._interval("episode_return", _mean)

    @cached_property
    def milliseconds(self) -> float:
        """Median computation time of one action (ms), mean over the runs."""
        return float(np.mean([evaluation.milliseconds for evaluation in self._evaluations]))

    @cached_property
    def true_regret(self) -> Bracket:
        """Limits of the median of J / J_0 - 1, with J_0 the true optimal cost, see `Episode.true_regret`."""
        return _bracket(self._evaluations)

    def to_dict(self) -> dict[str, Any]:
        """Convert to dictionaries, lists and numbers, with all statistics."""
        values = {name: getattr(self, name) for name in ("policy", "runs", "episodes", *self.STATISTICS)}
        return {name: asdict(one) if isinstance(one, (Interval, Bracket)) else one for name, one in values.items()}

    def _values(self, attribute: str) -> np.ndarray:
        """Return an attribute of all episodes (runs, scenarios)."""
        return np.array([[getattr(e, attribute) for e in evaluation] for evaluation in self._evaluations], dtype=float)

    def _interval(self, attribute: str, statistic: Statistic) -> Interval:
        return _interval(self._values(attribute), self._banks, statistic, np.random.default_rng(self._seed))

    def _weighted(self, attribute: str, *, partly: bool = False) -> Interval:
        """Return the mean of an attribute from 0 to 1; NaN if it is unknown anywhere, unless it may be `partly`."""
        values = self._values(attribute)
        if np.isnan(values).any() and not partly:
            return Interval(math.nan, math.nan, math.nan, (math.nan,) * len(values))
        if set(values.flat) in ({0.0}, {1.0}):
            return _rate(values, self._banks)
        return _within_unit(self._interval(attribute, _mean))


def score(name: str, runs: Evaluation | Sequence[Evaluation], seed: int = 0) -> Score:
    """Return the statistics of a policy, or of several runs of one method on the same scenarios.

    Intervals over the scenarios contain the variance between scenarios only, those over runs and scenarios also that
    between runs, see `Interval`:

    - Those of rates over the scenarios are Wilson intervals, and the others are percentiles of a bootstrap that
      resamples the scenarios within their banks. An SOC, SPL or SCT of 0 or 1 in all episodes has the interval of a
      rate.
    - Those over runs and scenarios use the t distribution; with two or three runs they are wide.

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
    return Score(name, evaluations, seed)


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
        Fractions, and the lower and upper limits of their intervals over the scenarios (3, N), see `Interval`.

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
            return NORMAL_QUANTILE
        runs, scenarios = n_runs - 1, max(1, n_scenarios - 1)
        parts = self.runs**2 / runs + self.scenarios**2 / scenarios + self.interaction**2 / (runs * scenarios)
        total = self.scenarios + self.excess
        return float(stdtrit(max(1.0, total**2 / parts), QUANTILE)) if parts > 0 else NORMAL_QUANTILE


def _rate(values: np.ndarray, banks: np.ndarray) -> Interval:
    """Return the mean of values (runs, scenarios) from 0 to 1 with its intervals, which never have zero width."""
    over_runs = UNKNOWN
    if len(values) > 1:
        variances = _variances_of_mean(values, banks)
        over_runs = _wilson(values, banks, variances.quantile, variances.excess)
    limits = _wilson(values, banks, NORMAL_QUANTILE, 0.0)
    return Interval(float(values.mean()), *limits, tuple(values.mean(axis=1).tolist()), over_runs)


def _wilson(values: np.ndarray, banks: np.ndarray, k: float, excess: float) -> Limits:
    """Return the limits of the mean of values (runs, scenarios) from 0 to 1.

    In each bank, the Wilson interval has an effective number of episodes: that with which independent episodes would
    have the variance between the scenarios. It is the number of scenarios if all episodes have the same outcome.

    Args:
        values: see above.
        banks: the bank of each scenario.
        k: quantile of the distribution.
        excess: variance that is added to that between the scenarios.

    """
    n_runs, n_scenarios = values.shape
    value = float(values.mean())
    below = above = k**2 * excess
    for bank in np.unique(banks):
        means = values[:, banks == bank].mean(axis=0)
        count, rate, spread = len(means), float(means.mean()), float(means.var())
        n = count if spread == 0 else min(count * rate * (1 - rate) / spread, n_runs * count)
        centre = (rate + k**2 / (2 * n)) / (1 + k**2 / n)
        half = k * math.sqrt(rate * (1 - rate) / n + (k / (2 * n)) ** 2) / (1 + k**2 / n)
        below += (count / n_scenarios * (rate - centre + half)) ** 2
        above += (count / n_scenarios * (centre + half - rate)) ** 2
    # Rounding must not exclude the value.
    return Limits(max(0.0, value - math.sqrt(below)), min(1.0, value + math.sqrt(above)))


def _within_unit(interval: Interval) -> Interval:
    """Return an interval of a statistic from 0 to 1, without the limits that it cannot have."""
    low, high = interval.over_runs
    over_runs = UNKNOWN if math.isnan(low) else Limits(max(0.0, low), min(1.0, high))
    return replace(interval, low=max(0.0, interval.low), high=min(1.0, interval.high), over_runs=over_runs)


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
    """Return a statistic of values (runs, scenarios) with its intervals; NaN values are ignored."""
    flat, runs = values.ravel(), tuple(statistic(values).tolist())
    if np.isnan(flat).all():
        return Interval(math.nan, math.nan, math.nan, runs)
    value = float(statistic(flat))
    over_runs = UNKNOWN if len(values) == 1 else _over_runs(values, banks, statistic, rng)
    if np.ptp(flat[~np.isnan(flat)]) == 0 and not np.isnan(flat).any():  # all resamples would be identical
        return Interval(value, value, value, runs, over_runs)
    resamples = _statistics(values, lambda n: _other_scenarios(values, banks, n, rng), statistic, N_RESAMPLES)
    low, high = np.nanpercentile(resamples, [100 * (1 - QUANTILE), 100 * QUANTILE])
    return Interval(value, float(low), float(high), runs, over_runs)


def _over_runs(values: np.ndarray, banks: np.ndarray, statistic: Statistic, rng: np.random.Generator) -> Limits:
    """Return the limits of a statistic of values of several runs (runs, scenarios), over runs and scenarios."""
    n_runs, n_scenarios = values.shape
    if statistic is _mean and not np.isnan(values).any():
        variances = _variances_of_mean(values, banks)
    else:
        columns = np.arange(n_scenarios)
        # Whole runs, whole scenarios, and for each scenario other runs
        schemes: list[Callable[[int], np.ndarray]] = [
            lambda n: values[rng.integers(n_runs, size=(n, n_runs))],
            lambda n: _other_scenarios(values, banks, n, rng),
            lambda n: values[rng.integers(n_runs, size=(n, n_runs, n_scenarios)), columns],
        ]
        found = [np.nanvar(_statistics(values, draw, statistic, N_VARIANCE_RESAMPLES)) for draw in schemes]
        unbiased = n_runs / (n_runs - 1)  # resamples of few runs vary less than new runs
        variances = _Variances(
            unbiased * float(found[0]), float(found[1]), unbiased * float(found[2]), (n_runs, n_scenarios)
        )
    value = float(statistic(values.ravel()))
    half = variances.quantile * math.sqrt(variances.scenarios + variances.excess)
    return Limits(value - half, value + half)


def _statistics(values: np.ndarray, draw: Callable[[int], np.ndarray], statistic: Statistic, count: int) -> np.ndarray:
    """Return a statistic of `count` resamples (runs, scenarios), drawn in parts that fit into memory."""
    size = max(1, MAX_RESAMPLED_VALUES // values.size)
    parts = [min(size, count - first) for first in range(0, count, size)]
    return np.concatenate([statistic(draw(n).reshape(n, -1)) for n in parts])


def _other_scenarios(values: np.ndarray, banks: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return resamples (count, runs, scenarios) with scenarios drawn within their banks."""
    parts = [values[:, banks == bank] for bank in np.unique(banks)]
    drawn = [rng.choice(part, (count, part.shape[1]), axis=1) for part in parts]
    return np.moveaxis(np.concatenate(drawn, axis=2), 0, 1)


def _mean(values: np.ndarray) -> np.ndarray:
    known = (~np.isnan(values)).sum(axis=-1)  # NumPy warns of a mean of NaN only
    return np.nansum(values, axis=-1) / np.where(known > 0, known, np.nan)


def _median(values: np.ndarray) -> np.ndarray:
    # As `np.nanmedian`, which calls a function for each row; NaN are sorted to the end.
    ordered, known = np.sort(values, axis=-1), (~np.isnan(values)).sum(axis=-1, keepdims=True)
    middle = (np.take_along_axis(ordered, np.maximum(at, 0), axis=-1) for at in ((known - 1) // 2, known // 2))
    low, high = (np.where(known > 0, part, np.nan)[..., 0] for part in middle)
    return 0.5 * (low + high)


def _interquartile_mean(values: np.ndarray) -> np.ndarray:
    from scipy.stats import trim_mean  # takes half a second to load

    return trim_mean(values, 0.25, axis=-1)
