import math

import numpy as np
import pytest
from helpers import ROBOTS, scenario_fields

from leapnav.envs import Scenario, ScenarioBank, sample_scenario
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.proximity import disc_proximity, footprint_proximity
from leapnav.envs.kernels.types import constant
from leapnav.experts import find_optimum
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.second_opinion import Opinion, second_opinion, verify_bank


@pytest.fixture(scope="module")
def scenario():
    return sample_scenario("clutter", 910_065)


def test_a_reference_that_is_not_the_best_is_found_out(scenario):
    optimum = find_optimum(scenario)
    second = optimum.alternatives[0].cost
    opinion = second_opinion(scenario, second)
    assert opinion.cost == second
    assert opinion.best <= optimum.cost * (1 + 1e-9)
    assert opinion.improvement == pytest.approx(1 - optimum.cost / second, abs=1e-9)
    assert opinion.source == "lattice"
    assert opinion.tried > 200


@pytest.mark.slow
def test_the_optimum_stands_against_a_hundred_times_the_effort(scenario):
    opinion = second_opinion(scenario)
    assert opinion.cost == find_optimum(scenario).cost
    assert opinion.improvement < 1e-6


def test_a_scenario_without_a_path_has_none():
    walls = [{"polygon": {"vertices": [[4.9, 0.0], [5.1, 0.0], [5.1, 10.0], [4.9, 10.0]]}}]
    fields = {"arena": [0, 0, 10, 10], "start": [2.0, 5.0, 0.0], "goal": [8.0, 5.0, 0.0], "horizon": 9.0}
    opinion = second_opinion(Scenario.from_dict({**fields, "obstacles": walls}))
    assert (opinion.cost, opinion.tried, opinion.improvement) == (math.inf, 0, 0.0)


@pytest.mark.slow
def test_a_whole_bank_gets_opinions_in_order_whatever_the_number_of_workers(tmp_path):
    from leapnav.experts import build_bank

    bank = build_bank("open", 3, tmp_path / "x.bank", progress=False)
    one = verify_bank(bank, workers=1, progress=False)
    assert one == verify_bank(ScenarioBank(bank.path), workers=2, progress=False)
    assert [opinion.name for opinion in one] == [scenario.name for scenario in bank]
    assert all(isinstance(opinion, Opinion) and opinion.improvement < 1e-6 for opinion in one)


def test_the_proximity_cost_of_the_transcription_is_that_of_the_kernels():
    casadi = pytest.importorskip("casadi")
    from leapnav.experts.ipopt import _proximity

    obstacles = [
        {"circle": {"center": [3, 3], "radius": 0.5}},
        {"capsule": {"start": [5, 2], "end": [7, 3], "radius": 0.2}},
        {"capsule": {"start": [5, 8], "end": [5, 8], "radius": 0.2}},
        {"polygon": {"vertices": [[3, 6], [3, 8], [5, 7]]}},
    ]
    small = Scenario.from_dict(scenario_fields(obstacles=obstacles))
    x, y = casadi.SX.sym("x"), casadi.SX.sym("y")
    value = _proximity(small, casadi.vertcat(x, y, 0), (0.0, 0.0, 0.0, 0.3, 0))
    hessian, gradient = casadi.hessian(value, casadi.vertcat(x, y))
    entries = [value, gradient[0], gradient[1], hessian[0, 0], hessian[0, 1], hessian[1, 1]]
    function = casadi.Function("proximity", [x, y], entries)
    for point in np.random.default_rng(0).uniform(0, 10, (500, 2)):
        expected = np.array(disc_proximity(*point, 0.3, small.field))
        # Terms below 1e-13 are skipped by the kernels; they are 1e-11 in the Hessian, for a scale of 0.1 m.
        assert np.ravel(function(*point)) == pytest.approx(
            expected, rel=1e-9, abs=1e-10 + 1e-9 * np.abs(expected).max()
        )


def test_the_proximity_cost_of_a_rectangle_in_the_transcription_is_that_of_the_kernels():
    casadi = pytest.importorskip("casadi")
    from leapnav.experts.ipopt import _proximity

    robot = {"model": "unicycle", "footprint": {"box": {"length": 0.6, "width": 0.3, "offset": 0.1}}}
    obstacles = [
        {"circle": {"center": [3, 3], "radius": 0.5}},
        {"capsule": {"start": [5, 2], "end": [7, 3], "radius": 0.2}},
        {"polygon": {"vertices": [[3, 6], [3, 8], [5, 7]]}},
    ]
    small = Scenario.from_dict(scenario_fields(obstacles=obstacles, robot=robot))
    q = casadi.SX.sym("q", 3)
    value = _proximity(small, q, small.outline[0].tolist())
    hessian, gradient = casadi.hessian(value, q)
    entries = [value, *(gradient[i] for i in range(3)), *(hessian[i, j] for i in range(3) for j in range(i, 3))]
    function, data = casadi.Function("proximity", [q], entries), constant(small.outline.ravel())
    for pose in np.random.default_rng(0).uniform((0, 0, -3), (10, 10, 3), (500, 3)):
        if footprint_clearance(np.array(pose), small.outline, small.field)[0] > 1e-3:
            expected = np.array(footprint_proximity(*pose, 0, data, 0, small.field))
            assert np.ravel(function(pose)) == pytest.approx(
                expected, rel=1e-7, abs=1e-8 + 1e-7 * np.abs(expected).max()
            )


@pytest.mark.slow
def test_ipopt_finds_the_same_optimum_by_other_means(scenario):
    pytest.importorskip("casadi")
    from leapnav.experts.ipopt import Transcription

    others = (sample_scenario("polygons", 3, robot) for robot in ROBOTS)
    for other in (scenario, *others):
        optimum = find_optimum(other)
        times = np.linspace(0.0, other.horizon, 101)
        rng = np.random.default_rng(0)
        states = optimum.evaluate(times)[0]
        guess = Trajectory(times, states + 0.02 * rng.normal(size=states.shape))
        problem = OptimalControlProblem.from_scenario(other).with_winding_of(guess.states)
        solution = Transcription(other, problem, 100).solve(problem, guess)
        assert solution is not None
        assert np.abs(solution.states - states)[:, :3].max() < 0.05
