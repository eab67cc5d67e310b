"""Problems with a free horizon: closed forms, consistency with the fixed horizon, certificate, errors."""

import json
import math
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import brentq, minimize_scalar

from leapnav.cli import main
from leapnav.envs import NavigateEnv, Scenario, ScenarioError, sample_scenario
from leapnav.experts import (
    ControlAffineSystem,
    OptimalControlProblem,
    Status,
    Trajectory,
    continuation,
    find_optimum,
    minimum_time,
    shortest_horizon,
    solve,
)
from leapnav.experts.problem.system import unicycle
from leapnav.experts.second_opinion import second_opinion
from leapnav.experts.solve import METHODS

TIME_WEIGHT, SPEED_WEIGHT, TURN_WEIGHT = 0.5, 1.0, 0.3
X, V = sp.symbols("x v")
DOUBLE_INTEGRATOR = ControlAffineSystem((X, V), (V, 0), ((0, 1),))
GRUSHIN = ControlAffineSystem((X, V), (0, 0), ((1, 0), (0, X)))


def drive(goal, horizon=None, **changes):
    weights = (SPEED_WEIGHT, TURN_WEIGHT)
    return OptimalControlProblem(unicycle(), (0, 0, 0), goal, horizon, weights, time_weight=TIME_WEIGHT, **changes)


def of_distance(distance):
    """Cost and horizon of a geodesic: the kinetic energy equals the time weight all the way."""
    return distance * math.sqrt(2 * TIME_WEIGHT), distance / math.sqrt(2 * TIME_WEIGHT)


def rest_to_rest(distance=2.0, weight=0.7):
    """J = 6 r d^2 / T^3 + c T is minimal at T^4 = 18 r d^2 / c."""
    problem = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 0), (distance, 0), None, (weight,), time_weight=TIME_WEIGHT)
    horizon = (18 * weight * distance**2 / TIME_WEIGHT) ** 0.25
    return problem, 6 * weight * distance**2 / horizon**3 + TIME_WEIGHT * horizon, horizon


def grushin(x=0.8, y=0.3):
    """Geodesics of unit speed from the origin: x = sin(k s) / k, y = (s / 2 - sin(2 k s) / (4 k)) / k."""
    problem = OptimalControlProblem(GRUSHIN, (0, 0), (x, y), None, (1, 1), time_weight=TIME_WEIGHT)

    def miss(angle):  # k s, on the branch before the first conjugate point
        k = math.sin(angle) / x
        return (angle / (2 * k) - math.sin(2 * angle) / (4 * k)) / k - y

    angle = brentq(miss, 1e-3, math.pi - 1e-3, xtol=1e-15)
    return problem, *of_distance(angle * x / math.sin(angle))


CLOSED_FORMS = {
    "straight line": lambda: (drive((3, 0, 0)), *of_distance(3 * math.sqrt(SPEED_WEIGHT))),
    "rotation": lambda: (drive((0, 0, 1.2)), *of_distance(1.2 * math.sqrt(TURN_WEIGHT))),
    "double integrator": rest_to_rest,
    "Grushin": grushin,
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_cost_and_horizon_are_those_of_the_closed_form(name, method):
    problem, cost, horizon = CLOSED_FORMS[name]()
    extremal = solve(problem, method)
    assert extremal.success
    assert extremal.cost == pytest.approx(cost, rel=1e-10)
    assert extremal.horizon == pytest.approx(horizon, rel=1e-8)
    assert np.abs(extremal.hamiltonian).max() < 1e-8
    if name == "double integrator":
        assert extremal.certificate.time_curvature == pytest.approx(72 * 0.7 * 2.0**2 / horizon**5, rel=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("goal", [(0, 2, 0), (1.5, -1, 2), (-1, 0.5, 0.5), (2, 1, None)])
def test_a_geodesic_costs_its_length(goal, method):
    # Without obstacles the optimum in a fixed time T costs d^2 / (2 T) + c T, with the distance d.
    fixed = solve(drive(goal, 2.0))
    distance = math.sqrt(2 * 2.0 * (fixed.cost - 2.0 * TIME_WEIGHT))
    cost, horizon = of_distance(distance)
    extremal = solve(drive(goal), method)
    assert extremal.success
    assert extremal.cost == pytest.approx(cost, rel=1e-8)
    assert extremal.horizon == pytest.approx(horizon, rel=1e-7)


def swing_up():
    """A pendulum with a state cost; the optimum over T of the fixed horizon is not known in closed form."""
    pendulum = ControlAffineSystem((X, V), (V, -sp.sin(X)), ((0, 1),), angles=(X,))
    state_cost = 0.1 * (1 + sp.cos(X)) + 0.05 * V**2
    return OptimalControlProblem(
        pendulum, (0, 0), (math.pi, 0), None, (1.0,), state_cost, ((-2.0, 2.0),), time_weight=0.1
    )


@pytest.mark.parametrize("problem", [swing_up(), drive((2, 1.5, 1), control_bounds=((-0.9, 0.9), (-2.0, 2.0)))])
def test_the_horizon_minimises_the_cost_of_the_fixed_horizon(problem):
    extremal = solve(problem, "multiple_shooting")
    assert extremal.success

    def fixed(horizon):
        return solve(replace(problem, horizon=horizon), "multiple_shooting", guess=extremal)

    def cost(horizon):
        found = fixed(horizon)
        return found.cost if found.success else 10 * extremal.cost  # too short for the control bounds

    found = minimize_scalar(
        cost,
        bounds=(0.9 * extremal.horizon, 1.1 * extremal.horizon),
        method="bounded",
        options={"xatol": 1e-6},
    )
    assert extremal.cost == pytest.approx(found.fun, rel=1e-9)
    assert extremal.horizon == pytest.approx(found.x, rel=1e-4)
    step = 1e-4 * extremal.horizon
    shorter, same, longer = (fixed(extremal.horizon + change) for change in (-step, 0.0, step))
    # dJ/dT = H, and the derivative of that is the curvature of the certificate.
    assert (longer.cost - shorter.cost) / (2 * step) == pytest.approx(same.hamiltonian.mean(), abs=1e-4)
    slopes = [e.hamiltonian.mean() for e in (shorter, longer)]
    assert (slopes[1] - slopes[0]) / (2 * step) == pytest.approx(extremal.certificate.time_curvature, rel=1e-3)


def test_leapfrog_stays_feasible_and_its_cost_never_increases():
    problem = drive((1, 2, 1))
    extremal = solve(
        problem,
        "leapfrog",
        guess=Trajectory(np.linspace(0, 9, 17), drive((1, 2, 1)).straight_line(17).states),
        polish=False,
    )
    assert extremal.success
    sweeps = [row for row in extremal.history if row.phase in ("sweep", "reduce")]
    assert len(sweeps) > 3
    costs = [row.cost for row in sweeps]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(costs))
    assert all(row.residual < 1e-8 for row in sweeps)
    assert sweeps[0].times[-1] != pytest.approx(extremal.horizon, rel=1e-3)  # the times were scaled


def test_continuation_follows_a_free_horizon():
    problems = [replace(drive((2, 1, 1)), time_weight=weight) for weight in (0.5, 2.0, 8.0)]
    extremals = continuation(problems)
    assert [extremal.success for extremal in extremals] == [True] * 3
    # T = d / sqrt(2 c): four times the weight halves the horizon.
    assert extremals[1].horizon == pytest.approx(extremals[0].horizon / 2, rel=1e-8)
    assert extremals[2].horizon == pytest.approx(extremals[1].horizon / 2, rel=1e-8)
    with pytest.raises(ValueError, match="free horizon"):
        continuation([problems[0], drive((2, 1, 1), 3.0)])


def test_a_time_weight_adds_a_constant_to_the_cost_of_a_fixed_horizon():
    weighted = solve(drive((2, 1, 1), 3.0))
    plain = solve(replace(drive((2, 1, 1), 3.0), time_weight=0.0))
    assert weighted.cost == pytest.approx(plain.cost + 3.0 * TIME_WEIGHT, rel=1e-12)
    assert weighted.horizon == 3.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"time_weight": 0.0},
            "time_weight: expected a positive number, since the horizon is free and there is no state cost, got 0",
        ),
        ({"time_weight": -1.0}, "time_weight: expected a number of at least 0, got -1.0"),
        ({"horizon": math.nan}, "horizon: expected a positive number, or None for a free horizon, got nan"),
    ],
)
def test_invalid_values_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(drive((1, 0, 0)), **changes)


def free(scenario, time_weight=TIME_WEIGHT):
    cost = scenario.cost.model_copy(update={"time_weight": time_weight})
    return scenario.model_copy(update={"horizon": None, "cost": cost})


@pytest.mark.parametrize("family", ["open", "clutter", "polygons", "rooms", "slalom"])
def test_the_optimum_of_a_scenario_minimises_over_the_horizon(family):
    for seed in range(2):
        scenario = free(sample_scenario(family, 31_000 + seed))
        optimum = find_optimum(scenario, "medium")
        assert optimum.success
        assert np.abs(optimum.hamiltonian).max() < 1e-8
        for factor in (0.85, 1.0, 1.15):
            fixed = find_optimum(scenario.model_copy(update={"horizon": factor * optimum.horizon}), "medium")
            assert not fixed.success or fixed.cost >= optimum.cost * (1 - 1e-9)
            if factor == 1.0:
                assert fixed.cost == pytest.approx(optimum.cost, rel=1e-6)


# With the large time weights the robots drive at their speed limits most of the time.
@pytest.mark.parametrize(
    ("robot", "time_weight"),
    [
        ("unicycle", 5.0),
        ("dynamic_unicycle", 5.0),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [("differential_drive", 0.5), ("car", 0.5), ("car", 3.0)]
        ),
    ],
)
def test_no_fixed_horizon_close_to_the_optimum_costs_less(robot, time_weight):
    for seed in (41_007,):
        scenario = free(sample_scenario("clutter", seed, robot=robot), time_weight)
        optimum = find_optimum(scenario)
        assert optimum.success
        for factor in (0.95, 1.0, 1.05):
            fixed = find_optimum(scenario.model_copy(update={"horizon": factor * optimum.horizon}), "medium")
            assert not fixed.success or fixed.cost >= optimum.cost * (1 - 1e-6)


def test_a_second_opinion_finds_nothing_cheaper():
    assert second_opinion(free(sample_scenario("clutter", 31_001))).improvement < 1e-6


def test_a_horizon_that_hardly_matters_is_not_certified():
    # x' = u with Phi = x^2 / 2 from 1 to 0: J = coth(T) / 2 decreases for ever.
    integrator = ControlAffineSystem((X,), (0,), ((1,),))
    problem = OptimalControlProblem(integrator, (1,), (0,), None, (1.0,), state_cost=X**2 / 2)
    extremal = solve(problem, "multiple_shooting", guess=solve(replace(problem, horizon=14.0)))
    assert not extremal.success
    assert extremal.certificate is None or extremal.certificate.horizon_error > 1e-4


def test_controls_at_their_bounds_all_the_time_leave_no_other_duration_close_by():
    extremal = solve(drive((3, 0, 0), control_bounds=((-0.5, 0.5), (-1, 1))))
    assert extremal.success
    assert extremal.certificate.time_curvature == math.inf
    assert extremal.horizon == pytest.approx(6.0, rel=1e-9)


def test_an_optimum_that_takes_no_time_is_none():
    scenario = free(sample_scenario("open", 3))
    x, y, heading = scenario.start
    for goal in ((x, y, heading), (x, y, heading + 2 * math.pi), (x, y, None)):
        assert find_optimum(scenario.model_copy(update={"goal": goal})).status is Status.ZERO_HORIZON
    assert find_optimum(scenario.model_copy(update={"goal": (x, y, heading + 0.001)})).success


def test_a_large_time_weight_is_certified():
    fast = free(sample_scenario("open", 3, {"model": "unicycle", "max_speed": 1e4, "max_turn_rate": 1e4}), 1e6)
    slow = free(sample_scenario("open", 3), 1e-2)
    costs = [find_optimum(scenario).cost for scenario in (fast, slow)]
    assert costs[0] == pytest.approx(1e4 * costs[1], rel=1e-3)  # J = d sqrt(2 c) without proximity cost


def test_a_problem_with_a_free_horizon_survives_pickling():
    problem = drive((2, 1, 1))
    problem.arrays  # noqa: B018 (compiled functions are not pickled)
    assert solve(pickle.loads(pickle.dumps(problem))).cost == solve(problem).cost


def test_continuation_introduces_a_time_weight():
    plain = replace(drive((2, 1, 1), 3.0), time_weight=0.0)
    extremals = continuation([plain, drive((2, 1, 1), 3.0)])
    assert [extremal.success for extremal in extremals] == [True, True]
    assert extremals[1].cost == pytest.approx(extremals[0].cost + 3.0 * TIME_WEIGHT, rel=1e-9)


def test_a_scenario_with_a_free_horizon_is_read_solved_and_written(tmp_path, capsys):
    path, out = tmp_path / "free.json", tmp_path / "out.json"
    scenario = free(sample_scenario("clutter", 31_000))
    scenario.to_json(path)
    assert json.loads(path.read_text())["horizon"] is None
    assert Scenario.from_json(path) == scenario
    assert main(["solve", str(path), "--json", str(out), "--plot", str(tmp_path / "free.png")]) == 0
    solution = json.loads(out.read_text())
    assert f"{solution['horizon']:.6f} s (free)" in capsys.readouterr().out
    assert solution["horizon"] == pytest.approx(find_optimum(scenario).horizon)
    assert main(["solve", str(path), "--method", "all"]) == 0
    assert capsys.readouterr().out.count(f"{solution['cost']:.9g}") >= 3  # single shooting may fail on long paths


def test_what_needs_a_fixed_horizon_says_so():
    scenario = free(sample_scenario("open", 0))
    with pytest.raises(ScenarioError, match=r"cost\.time_weight: environments and banks with a fixed horizon need 0"):
        NavigateEnv(scenario=scenario.model_copy(update={"horizon": 5.0})).reset(seed=0)
    with pytest.raises(ScenarioError, match=r"cost\.time_weight: expected a positive number"):
        free(scenario, 0.0)
    with pytest.raises(ValueError, match="a free horizon is never too short"):
        shortest_horizon(scenario)


@pytest.mark.parametrize(("distance", "limit"), [(2.0, 1.5), (1.0, 1.0)])
def test_the_minimum_time_of_the_double_integrator(distance, limit):
    bounds = ((-limit, limit),)
    problem = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 0), (distance, 0), 1.0, (1.0,), control_bounds=bounds)
    found = minimum_time(problem)
    shortest = 2 * math.sqrt(distance / limit)
    assert found.lower_bound <= shortest <= found.horizon * (1 + 1e-9)
    assert found.horizon == pytest.approx(shortest, rel=1e-5)
    assert found.switching_times == pytest.approx([shortest / 2], rel=1e-2)
    assert found.levels.tolist() == [[limit], [-limit]]


# Paths of at most four pieces (D. J. Balkcom and M. T. Mason, 2002), found by a search over all words of up to four
# pieces with full speed ahead or astern, straight or with the full turn rate, for |v| <= 1 and |omega| <= 1.
@pytest.mark.parametrize(
    ("goal", "shortest", "pieces"),
    [
        ((3, 0, 0), 3.0, 1),
        ((0, 0, 1.5), 1.5, 1),
        ((0, 1, 0), 2.636232, 4),
        ((2, 1, 1), 2.278325, 3),
        ((-1, 0.5, 3), 3.0, 3),
        ((1, 0.3, -1), 1.787701, 3),
    ],
)
def test_the_minimum_time_of_a_unicycle(goal, shortest, pieces):
    problem = replace(drive(goal), control_bounds=((-1, 1), (-1, 1)))
    found = minimum_time(problem)
    assert found.horizon == pytest.approx(shortest, rel=1e-4)
    assert found.lower_bound == pytest.approx(shortest, rel=2e-3)
    assert found.lower_bound <= found.horizon
    assert len(found.levels) == pieces == len(found.switching_times) + 1


@pytest.mark.parametrize(
    "scenario",
    [sample_scenario("open", 5), pytest.param(sample_scenario("open", 3, robot="car"), marks=pytest.mark.slow)],
)
def test_the_minimum_time_of_a_scenario(scenario):
    found = minimum_time(scenario)
    assert found.extremal.success
    assert found.tolerance <= 2e-2
    assert math.isnan(found.lower_bound)
    assert find_optimum(free(scenario)).horizon > found.horizon
    controls = np.abs(found.extremal.evaluate(np.linspace(0, found.horizon, 101))[1])
    assert np.median(controls.max(axis=0) - scenario.robot.action_scale()[1]) == pytest.approx(0.0, abs=1e-9)


def test_the_weights_of_a_scenario_do_not_matter_to_its_minimum_time():
    heavy = sample_scenario("open", 5)
    heavy = heavy.model_copy(update={"cost": heavy.cost.model_copy(update={"speed_weight": 100, "turn_weight": 50})})
    assert minimum_time(heavy).horizon == pytest.approx(minimum_time(sample_scenario("open", 5)).horizon, rel=1e-2)


def test_a_tolerance_that_is_not_reached_is_stated():
    jerk = sp.symbols("a")
    system = ControlAffineSystem((X, V, jerk), (V, jerk, 0), ((0, 0, 1),))
    found = minimum_time(OptimalControlProblem(system, (0, 0, 0), (1, 0, 0), 1.0, (1.0,), control_bounds=((-1, 1),)))
    shortest = 32 ** (1 / 3)
    assert found.lower_bound <= shortest <= found.horizon <= shortest * (1 + found.tolerance)


def test_invalid_arguments_of_the_minimum_time_are_named():
    with pytest.raises(ValueError, match="control_bounds: expected finite numbers, got None"):
        minimum_time(drive((1, 0, 0)))
    with pytest.raises(ValueError, match="tol: expected a number below 1, got 2"):
        minimum_time(replace(drive((1, 0, 0)), control_bounds=((-1, 1), (-1, 1))), tol=2)
