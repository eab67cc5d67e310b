"""`find_optimum` of problems that are no scenarios: the best of several local optima, and the others."""

import itertools

import numpy as np
import pytest
import sympy
from helpers import known_problems, scenario_fields

from leapnav.envs import Scenario, sample_scenario
from leapnav.experts import (
    ControlAffineSystem,
    OptimalControlProblem,
    Status,
    find_optimum,
    plot_extremal,
    solve,
    unicycle,
)
from leapnav.experts.solve import METHODS

KNOWN = {entry.name: entry for entry in known_problems()}


def test_the_swing_up_of_a_cart_pole_has_two_local_optima():
    entry = KNOWN["cart-pole-swing-up"]
    optimum = find_optimum(entry.problem)
    assert optimum.success
    assert optimum.cost == pytest.approx(entry.value, rel=1e-7)
    assert [other.cost for other in optimum.alternatives] == pytest.approx(
        [58.80796], rel=1e-5
    )  # IPOPT in 40 intervals
    assert all(other.success for other in optimum.alternatives)


@pytest.mark.parametrize("method", METHODS)
def test_a_bicycle_at_rest_whose_heading_no_small_control_changes(method):
    # At rest and with the wheel straight, the linearised system cannot turn, so most initial controls lead nowhere.
    x, y, heading, speed, steer = sympy.symbols("x y heading speed steer")
    bicycle = ControlAffineSystem(
        state=(x, y, heading, speed, steer),
        drift=(speed * sympy.cos(heading), speed * sympy.sin(heading), speed * sympy.tan(steer) / 2.5, 0, 0),
        fields=((0, 0, 0, 1, 0), (0, 0, 0, 0, 1)),
        angles=(heading,),
    )
    problem = OptimalControlProblem(bicycle, (0, 0, 0, 0, 0), (8, 3, 0.5, 0, 0), 6.0, (1, 1))
    extremal = solve(problem, method)
    assert extremal.success
    assert extremal.cost == pytest.approx(2.140960196, rel=1e-8)


def test_a_planar_quadrotor_with_a_free_horizon():
    # Of the estimates of the horizon, the search finds paths for a short one and none for the longer one that follows.
    x, y, angle, u, v, rate = sympy.symbols("x y angle u v rate")
    quadrotor = ControlAffineSystem(
        state=(x, y, angle, u, v, rate),
        drift=(u, v, rate, 0, -9.81, 0),
        fields=((0, 0, 0, -sympy.sin(angle), sympy.cos(angle), 0), (0, 0, 0, 0, 0, 1)),
        angles=(angle,),
    )
    problem = OptimalControlProblem(quadrotor, (0,) * 6, (3, 1, 0, 0, 0, 0), None, (1, 1), time_weight=1.0)
    extremal = solve(problem, "multiple_shooting")
    assert extremal.success
    # It is a minimum over the horizon.
    for factor in (0.9, 1.1):
        horizon = factor * extremal.horizon
        other = solve(problem.with_horizon(horizon), "multiple_shooting", guess=extremal)
        assert other.success
        assert other.cost > extremal.cost


def test_local_optima_are_distinct_and_in_order_of_cost():
    problem = OptimalControlProblem(unicycle(), (0.0, 0.0, 0.0), (1.0, 1.0, 0.5), 3.0, (1.0, 1.0))
    optimum = find_optimum(problem)
    extremals = optimum, *optimum.alternatives
    assert len(extremals) > 2
    costs = [extremal.cost for extremal in extremals]
    assert costs == sorted(costs)
    for one, other in itertools.pairwise(extremals):
        times = np.linspace(0.0, 3.0, 50)
        assert np.abs(one.interpolate(times) - other.interpolate(times)).max() > 1e-3
    assert {extremal.heading_winding for extremal in extremals} > {0}
    assert optimum.path_class == ()  # there are no obstacles


def test_low_and_medium_effort_find_the_best_only():
    problem = KNOWN["cart-pole-swing-up"].problem
    assert find_optimum(problem, "low").cost == pytest.approx(find_optimum(problem, "medium").cost, rel=1e-12)
    assert find_optimum(problem, "medium").cost == solve(problem, "multiple_shooting").cost


@pytest.mark.slow
def test_limits_of_states_are_reached_by_the_best():
    entry = KNOWN["clamped-beam-load-60"]
    optimum = find_optimum(entry.problem)
    assert optimum.success
    assert 0 < optimum.barrier <= 1e-3
    assert optimum.cost == pytest.approx(entry.value, rel=2e-3)


@pytest.mark.slow
def test_the_problem_of_a_scenario_is_solved_without_its_lattice():
    """Which finds fewer local optima."""
    scenario = Scenario.from_dict(scenario_fields())
    optimum = find_optimum(OptimalControlProblem.from_scenario(scenario))
    assert optimum.success
    assert optimum.cost >= find_optimum(scenario).cost * (1 - 1e-9)
    assert len(optimum.path_class) == len(scenario.obstacles)


def test_a_problem_without_a_solution_is_a_failure():
    problem = KNOWN["rayleigh-bounded"].problem.with_horizon(0.1)
    optimum = find_optimum(problem)
    assert not optimum.success
    assert optimum.alternatives == ()
    there = OptimalControlProblem(unicycle(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None, (1.0, 1.0), time_weight=1.0)
    assert find_optimum(there).status is Status.ZERO_HORIZON


@pytest.mark.parametrize("name", ["elastica-clamped", pytest.param("cart-pole-swing-up", marks=pytest.mark.slow)])
def test_an_optimum_with_alternatives_is_drawn_and_converted(name, tmp_path):
    optimum = find_optimum(KNOWN[name].problem)
    content = optimum.to_dict()
    assert len(content["alternatives"]) == len(optimum.alternatives)
    assert "driving_modes" not in content
    plot_extremal(optimum, tmp_path / "optimum.png")


def test_the_better_of_two_close_local_optima_is_found():
    """They stay within 0.12 m and rad of each other, and the one of the shorter lattice path costs 0.85 % more."""
    assert find_optimum(sample_scenario("corridors", 907, "car")).cost == pytest.approx(8.7314937, rel=1e-6)
