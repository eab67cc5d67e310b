"""The lessons of `leapnav play`: their sentences are true for the numbers that are computed."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from leapnav.experts import Status, certify, find_optimum
from leapnav.play.lessons import (
    METHODS_SCENARIO,
    TOLERANCE,
    compare_methods,
    conjugate_time,
    cusp_scenario,
    follow_minimum,
)

COST = 1e-8  # relative tolerance


@pytest.fixture(scope="module")
def methods():
    return {method["name"]: method for method in compare_methods()["methods"]}


@pytest.fixture(scope="module")
def steps():
    return follow_minimum()["steps"]


def test_single_shooting_misses_the_goal_and_stalls(methods):
    single = methods["single shooting"]
    # The flow amplifies rounding errors: different machine code of the same source gives other numbers of iterates.
    assert single["status"] == "stalled" and len(single["iterates"]) >= 2
    for iterate in single["iterates"]:
        (path,) = iterate["pieces"]
        assert path[0] == list(METHODS_SCENARIO.start)
        assert iterate["miss"] == pytest.approx(np.hypot(*np.subtract(path[-1], METHODS_SCENARIO.goal)[:2]), abs=1e-3)
        assert iterate["miss"] > 1
    assert json.dumps(single, allow_nan=False)  # a path ends where the flow diverges


def test_multiple_shooting_closes_the_jumps_in_a_few_newton_steps(methods):
    multiple = methods["multiple shooting"]
    assert multiple["status"] == "converged" and len(multiple["iterates"]) <= 8
    residuals = [iterate["residual"] for iterate in multiple["iterates"]]
    assert residuals == sorted(residuals, reverse=True) and residuals[-1] <= TOLERANCE
    first, last = multiple["iterates"][0], multiple["iterates"][-1]
    assert first["jump"] > 0.1 and last["jump"] == last["miss"] == 0
    optimum = find_optimum(METHODS_SCENARIO)
    assert last["cost"] == pytest.approx(optimum.cost, rel=COST) == pytest.approx(compare_methods()["optimum"]["cost"])


def test_leapfrog_is_feasible_at_every_sweep_and_its_cost_never_increases(methods):
    leapfrog = methods["Leapfrog"]
    costs = [iterate["cost"] for iterate in leapfrog["iterates"]]
    assert leapfrog["status"] == "converged" and len(costs) > 5
    assert all(after <= before * (1 + COST) for before, after in itertools.pairwise(costs))
    for iterate in leapfrog["iterates"]:
        assert iterate["residual"] < 1e-9 and iterate["jump"] == iterate["miss"] == 0
        assert iterate["pieces"][0][0] == list(METHODS_SCENARIO.start)
    assert costs[0] > 1.05 * costs[-1]
    assert costs[-1] == pytest.approx(find_optimum(METHODS_SCENARIO).cost, rel=COST)


def test_every_iteration_is_explained(methods):
    texts = [step["text"] for step in compare_methods()["steps"]]
    assert len(texts) == max(len(method["iterates"]) for method in methods.values())
    assert "Single shooting stalled" in texts[-1] and "Multiple shooting converged" in texts[-1]
    assert "Leapfrog converged" in texts[-1] and "Leapfrog converged" not in texts[-2]


def test_a_minimum_has_its_conjugate_point_after_the_horizon_and_a_saddle_before_it(steps):
    minima = [step for step in steps if step["branch"] == "minimum"]
    saddles = [step for step in steps if step["branch"] == "saddle"]
    assert len(minima) > 5 and len(saddles) > 5
    times = [step["conjugate_time"] for step in (*minima, *saddles)]
    assert times == sorted(times, reverse=True)  # it moves through the horizon at the fold
    horizon = minima[0]["horizon"]
    assert times[len(minima) - 1] == pytest.approx(horizon, abs=0.05)
    for step in minima:
        assert step["status"] == "SUCCESS" and step["conjugate_time"] > horizon
    for step in saddles:
        assert step["status"] == "CONJUGATE_POINT" and step["conjugate_time"] < horizon
        same = [other for other in minima if other["heading"] == step["heading"]]
        assert all(step["cost"] > other["cost"] for other in same)  # of two branches, the saddle costs more
    assert all(step["cost"] > step["optimum"]["cost"] + 0.2 for step in (*minima, *saddles))


def test_beyond_the_fold_the_minimum_is_lost(steps):
    (lost,) = [step for step in steps if step["branch"] == "lost"]
    assert lost["status"] == "STALLED" and lost["heading"] < min(
        step["heading"] for step in steps if step["branch"] == "minimum"
    )
    costs = lost["sweep_costs"]
    assert all(after <= before * (1 + COST) for before, after in itertools.pairwise(costs))
    assert costs[-1] == pytest.approx(lost["optimum"]["cost"], rel=1e-6) and costs[0] > 2 * costs[-1]
    # No other local minimum is there at all.
    assert find_optimum(cusp_scenario(lost["heading"])).alternatives == ()


def test_the_conjugate_time_is_that_of_a_longer_extremal():
    (minimum,) = find_optimum(cusp_scenario(0.3)).alternatives
    time = conjugate_time(minimum)
    assert minimum.success and time > minimum.problem.horizon
    for horizon, has_point in ((0.98 * time, False), (1.02 * time, True)):
        z = np.concatenate([minimum.states, minimum.costates], axis=1)[[0, -1]]
        times = np.array([0.0, minimum.problem.horizon, horizon])
        longer = certify(replace(minimum.problem, horizon=horizon), times, z[[0, 1, 1]], Status.MAX_ITERATIONS)
        point = longer.certificate.conjugate_point
        assert (point is not None) == has_point
