"""The intervals of scores: their coverage, with and without differences between runs, and their limits."""

import math

import numpy as np
import pytest

from leapnav.training import Episode, Evaluation, score
from leapnav.training.scoring import scores

P, SEED_EFFECT = 0.9, 0.03  # success rate, and standard deviation of the rates of runs


def evaluation(outcomes, costs=None, banks=None):
    """Return the evaluation of a run with the given outcomes, and cost ratios of the successful episodes."""
    episodes = tuple(
        Episode(
            family="open",
            bank="open" if banks is None else banks[i],
            index=i,
            scenario=f"open-{i}",
            success=bool(success),
            collision=not success,
            cost=1.0 if costs is None else float(costs[i]),
            episode_return=0.0,
            reference_cost=1.0,
            reached_reference=1.0 if success else math.nan,
            clearance=0.2,
            reference_clearance=0.3,
            reversing=False,
            states=np.zeros((2, 3)),
            costs=np.zeros(2),
        )
        for i, success in enumerate(outcomes)
    )
    return Evaluation(episodes, 0.5)


def outcomes_of_one_method(rng, n_runs, n_scenarios, seed_effect, difficulty):
    """Return outcomes of runs whose rates differ by `seed_effect`, in scenarios whose rates differ by `difficulty`."""
    rates = P + seed_effect * rng.standard_normal((n_runs, 1)) + difficulty * rng.uniform(-1, 1, n_scenarios)
    return (rng.random((n_runs, n_scenarios)) < np.clip(rates, 0, 1)).astype(float)


@pytest.mark.parametrize(
    ("n_runs", "seed_effect", "difficulty"),
    [
        (3, SEED_EFFECT, 0.05),
        (5, SEED_EFFECT, 0.0),
        (5, SEED_EFFECT, 0.05),
        (5, 0.0, 0.05),
    ],
)
def test_intervals_of_a_rate_over_runs_cover_that_of_the_method(n_runs, seed_effect, difficulty):
    rng, trials, hits = np.random.default_rng(0), 1000, 0
    for _ in range(trials):
        outcomes = outcomes_of_one_method(rng, n_runs, 200, seed_effect, difficulty)
        low, high = scores._rate(outcomes, np.zeros(200)).over_runs
        hits += low <= P <= high
    assert hits / trials >= 0.932  # 95 % less 2.6 standard deviations of the estimate


@pytest.mark.parametrize(("n_runs", "difficulty"), [(1, 0.0), (1, 0.05), (5, 0.0), (5, 0.05)])
def test_intervals_of_a_rate_over_scenarios_cover_that_of_the_policies(n_runs, difficulty):
    """The rates of the runs differ, but stay the same in all trials: other scenarios are drawn, not other runs."""
    rng, trials, hits = np.random.default_rng(0), 1000, 0
    rates = np.linspace(0.85, 0.95, n_runs)[:, None] if n_runs > 1 else np.array([[P]])
    for _ in range(trials):
        chances = rates + difficulty * rng.uniform(-1, 1, 200)
        found = scores._rate((rng.random((n_runs, 200)) < chances).astype(float), np.zeros(200))
        hits += found.low <= P <= found.high
    assert 0.932 <= hits / trials <= 0.985


def test_intervals_of_a_median_cover_it_with_a_seed_effect():
    """The regret of run r in scenario s is exp(a_r + b_s + c_rs) with the median 1."""
    rng, trials, hits = np.random.default_rng(0), 40, 0
    for _ in range(trials):
        logs = 0.2 * rng.standard_normal((5, 1)) + rng.standard_normal(100) + 0.5 * rng.standard_normal((5, 100))
        low, high = scores._over_runs(np.exp(logs), np.zeros(100), scores._median, rng)
        hits += low <= 1.0 <= high
    assert hits >= 34  # 38 less 2.9 standard deviations


def test_runs_that_differ_have_wider_intervals_than_runs_that_do_not():
    """Of five runs with rates from 84 to 96 %, the standard error is that of the five rates."""
    rates = np.array([168, 174, 180, 186, 192])
    apart = [evaluation(np.random.default_rng(k).permutation(200) < n) for k, n in enumerate(rates)]
    equal = [evaluation(np.random.default_rng(k).permutation(200) < 180) for k in range(5)]
    found = [score("method", runs).success for runs in (apart, equal)]
    assert found[0].runs == pytest.approx(rates / 200)
    widths = [one.over_runs.high - one.over_runs.low for one in found]
    assert widths[0] > 2 * widths[1]
    spread = 2 * 2.776 * np.std(rates / 200, ddof=1) / math.sqrt(5)  # t distribution with 4 degrees of freedom
    assert widths[0] == pytest.approx(spread, rel=0.15)


def test_identical_runs_add_no_information():
    one = evaluation([True] * 30 + [False] * 10)
    alone, thrice = score("method", one).success, score("method", [one] * 3).success
    assert (thrice.low, thrice.high) == pytest.approx((alone.low, alone.high), abs=1e-9)
    assert thrice.over_runs == pytest.approx((alone.low, alone.high), abs=0.01)  # t instead of normal
    assert all(math.isnan(limit) for limit in alone.over_runs)


@pytest.mark.parametrize("n_runs", [1, 3])
@pytest.mark.parametrize("n_scenarios", [1, 2, 50])
@pytest.mark.parametrize("success", [True, False])
def test_no_interval_of_a_rate_has_zero_width(n_runs, n_scenarios, success):
    found = score("method", [evaluation([success] * n_scenarios)] * n_runs)
    z = 1.959964
    limit = z**2 / (n_scenarios + z**2)  # Wilson, with the scenarios as the units
    intervals = [found.success, found.collision] if success else [found.collision, found.success, found.soc]
    assert intervals[0].high == 1.0 and intervals[0].low == pytest.approx(1 - limit, rel=1e-6)
    for interval in intervals[1:]:
        assert interval.low == 0.0 and interval.high == pytest.approx(limit, rel=1e-6)


def test_the_interval_of_one_run_is_that_of_wilson():
    found = score("method", evaluation([True] * 81 + [False] * 182)).success
    # Newcombe, Statistics in Medicine 17, 857-872 (1998), table I: 81 of 263
    assert (found.low, found.high) == pytest.approx((0.2553, 0.3662), abs=5e-5)


def test_scenarios_are_resampled_within_their_banks():
    """Banks of which one is always solved and the other one never: the numbers of their scenarios are fixed."""
    outcomes = [True] * 30 + [False] * 10
    parts, whole = (
        score("method", evaluation(outcomes, banks=banks)).success for banks in (["a"] * 30 + ["b"] * 10, None)
    )
    assert 0.05 < parts.high - parts.low < 0.7 * (whole.high - whole.low)
    returns = score("method", evaluation(outcomes, banks=["a"] * 30 + ["b"] * 10)).soc
    assert returns.value == 0.75


def test_outcomes_that_balance_leave_an_interval():
    """Each scenario is solved by one of two runs: neither runs nor scenarios differ on average."""
    found = score("method", [evaluation([True, False] * 20), evaluation([False, True] * 20)]).success
    assert found.value == 0.5 and found.high - found.low > 0.1 and found.over_runs.high - found.over_runs.low > 0.1
