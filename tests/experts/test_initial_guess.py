"""The initial guess of `solve(scenario)`, for all robots and methods."""

import numpy as np
import pytest
from helpers import ROBOTS
from wagon_robot import Wagon

from leapnav.cli import main
from leapnav.envs import Scenario
from leapnav.envs.robots.base import MODELS
from leapnav.experts import OptimalControlProblem, Status, find_optimum, solve
from leapnav.experts.search.initial_guess import initial_guess
from leapnav.experts.solve import METHODS

WITH_WAGON = (*ROBOTS, Wagon.name())

MODELS.pop(Wagon.name(), None)  # registered for the tests of this module only: other tests read the list of models


@pytest.fixture(autouse=True)
def _wagon(monkeypatch):
    """Register the robot of an example for the tests of this module only."""
    monkeypatch.setitem(MODELS, Wagon.name(), Wagon)


def easy(model, horizon, **changes):
    fields = {
        "arena": [0, 0, 8, 8],
        "robot": {"model": model},
        "start": [2.0, 3.0, 0.4],
        "goal": [3.2, 3.4, 0.4],
        "horizon": horizon,
        "obstacles": [{"circle": {"center": [3.6, 5.6], "radius": 0.7}}],
        "cost": {"time_weight": 1.0} if horizon is None else {},
    }
    return Scenario.from_dict({**fields, **changes})


@pytest.mark.parametrize("horizon", [2.0, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("robot", WITH_WAGON)
def test_every_method_solves_an_easy_scenario_without_a_guess(robot, method, horizon):
    scenario = easy(robot, horizon)
    extremal = solve(scenario, method)
    assert extremal.success, extremal.status
    # Without the barrier of limits of states, which need not be the same.
    tolerance = 1e-8 if scenario.robot.state_bounds() is None else 1e-6
    assert extremal.cost == pytest.approx(find_optimum(scenario).cost, rel=tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_a_free_final_motion_is_lifted(method):
    scenario = easy("dynamic_unicycle", 2.0, goal_motion=[None, None])
    problem = OptimalControlProblem.from_scenario(scenario)
    assert initial_guess(scenario, problem)[1].states.shape[1] == 5
    assert solve(scenario, method).success


def test_the_command_solves_by_all_methods(tmp_path, capsys):
    for robot in ("unicycle", "trailer"):
        path = tmp_path / f"{robot}.json"
        path.write_text(easy(robot, 2.0).to_json())
        assert main(["solve", str(path), "--method", "all"]) == 0
        assert capsys.readouterr().out.count("SUCCESS") == len(METHODS)


@pytest.mark.parametrize("goal", [(190.0, 200.0), (170.0, 200.0)])
def test_a_detour_outside_of_the_lattice_is_found(goal):
    # The lattice covers the surroundings of start and goal; the wall reaches beyond them.
    wall = {"polygon": {"vertices": [[160, 60], [161, 60], [161, 340], [160, 340]]}}
    fields = {
        "arena": [0, 0, 400, 400],
        "start": [150, 200, 0],
        "goal": [*goal, 0],
        "horizon": 600,
        "obstacles": [wall],
    }
    scenario = Scenario.from_dict(fields)
    extremal = solve(scenario, "multiple_shooting")
    assert extremal.success
    assert extremal.cost == pytest.approx(find_optimum(scenario, "medium").cost, rel=1e-8)


def test_no_path_is_reported():
    wall = {"polygon": {"vertices": [[5, -1], [5.5, -1], [5.5, 9], [5, 9]]}}
    scenario = easy("unicycle", 5.0, obstacles=[wall], goal=[7.0, 4.0, 0.0])
    assert solve(scenario).status is Status.NO_PATH


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_unit_of_the_cost_does_not_matter(robot):
    """All weights times a factor: the same path at that multiple of the cost."""
    factor = 7.0
    weights = {"speed_weight": factor}
    if "turn_weight" in MODELS[robot].cost_fields:
        weights["turn_weight"] = 0.5 * factor
    first, model = easy(robot, 2.0), {"model": robot}
    for name in ("steering_weight", "acceleration_weight", "angular_acceleration_weight"):
        if hasattr(first.robot, name):
            model[name] = factor * getattr(first.robot, name)
    second = easy(robot, 2.0, robot=model, cost={**weights, "proximity_weight": factor})
    guesses = [initial_guess(s, OptimalControlProblem.from_scenario(s))[1] for s in (first, second)]
    np.testing.assert_allclose(guesses[0].states, guesses[1].states, atol=1e-6)
    np.testing.assert_allclose(factor * guesses[0].costates, guesses[1].costates, atol=1e-5)
