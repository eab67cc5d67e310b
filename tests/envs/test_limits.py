"""Limits of the controls that are intervals."""

import json

import numpy as np
import pytest
from helpers import scenario_fields

from leapnav.envs import DifferentialDrive, NavigateEnv, Scenario, ScenarioError, Unicycle
from leapnav.experts import ExpertPolicy, find_optimum
from leapnav.training.policies.baselines import GoToGoal

FORWARD = {"model": "unicycle", "speed": [0.25, 0.5], "turn_rate": [-0.5, 1.0]}


def task(robot, **changes):
    return Scenario.from_dict(scenario_fields(robot=robot, **changes))


def test_actions_span_the_intervals_of_the_limits():
    scenario = task(FORWARD)
    assert scenario.robot.control_bounds().tolist() == [[0.25, 0.5], [-0.5, 1.0]]
    written = json.loads(scenario.to_json())["robot"]
    assert written["speed"] == [0.25, 0.5] and "max_speed" not in written and "speed" not in Unicycle().model_dump()
    assert Scenario.from_json(scenario.to_json()) == scenario
    env = NavigateEnv("open", control_period=0.1)
    for action, speed, turn_rate in ((-1, 0.25, -0.5), (1, 0.5, 1.0), (0, 0.375, 0.25)):
        env.reset(options={"scenario": scenario})
        env.step(np.full(2, action, np.float32))
        step = env.state - scenario.start_state
        assert step[2] == pytest.approx(0.1 * turn_rate)
        assert np.hypot(*step[:2]) == pytest.approx(0.1 * speed, rel=1e-3)


@pytest.mark.parametrize(
    "robot",
    [
        FORWARD,
        {"model": "unicycle", "speed": [-1.0, 0.0]},
        {"model": "car", "speed": [0.2, 1.0]},
        {"model": "differential_drive", "wheel_speed": [0.0, 1.5]},
        {"model": "dynamic_unicycle", "acceleration": [-2.0, 0.5]},
    ],
    ids=lambda robot: f"{robot['model']}-{len(robot)}",
)
def test_optima_and_experts_respect_intervals(robot):
    scenario = task(robot, horizon=None, cost={"time_weight": 1.0})
    optimum = find_optimum(scenario)
    assert optimum.success, optimum.status
    low, high = scenario.robot.control_bounds().T
    assert (optimum.controls >= low - 1e-12).all() and (optimum.controls <= high + 1e-12).all()
    actions = scenario.robot.actions(optimum.controls)
    assert np.abs(actions).max() <= 1 + 1e-9
    np.testing.assert_allclose(scenario.robot.controls(actions), optimum.controls, atol=1e-12)
    env = NavigateEnv("open", horizon="free", robot=robot["model"])
    expert = ExpertPolicy(env)
    observation, _ = env.reset(options={"scenario": scenario})
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(expert.predict(observation)[0])
        done = terminated or truncated
    assert info["is_success"]


def test_symmetries_need_symmetric_limits():
    for robot, mirrored, reversible in (
        (Unicycle(), True, True),
        (Unicycle(speed=(0.25, 0.5)), True, False),
        (Unicycle(turn_rate=(-0.5, 1.0)), False, True),
        (DifferentialDrive(wheel_speed=(0.0, 1.0)), True, False),
    ):
        assert robot.has_symmetric_limits(type(robot).mirror) == mirrored
        assert robot.has_symmetric_limits(type(robot).reversal) == reversible


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"speed": [0.5, 0.25]}, r"speed: .*lowest < highest.*0\.5, 0\.25"),
        ({"speed": [0.0, 1.0], "max_speed": 1.0}, "max_speed: cannot be combined with speed"),
        ({"turn_rate": [0.1, 1.0]}, r"turn_rate: expected an interval that contains 0 inside, got \[0\.1, 1\.0\]"),
    ],
)
def test_invalid_intervals_are_named(limits, message):
    with pytest.raises(ScenarioError, match=message):
        task({"model": "unicycle", **limits})


def test_go_to_goal_commands_the_same_controls_with_other_limits():
    controls = []
    for limits in ({"max_speed": 2.0}, {"speed": [-1.0, 3.0], "turn_rate": [-4.0, 3.0]}):
        scenario = task({"model": "unicycle", **limits})
        env = NavigateEnv(scenario=scenario)
        observation, _ = env.reset(seed=0)
        controls.append(scenario.robot.controls(GoToGoal(env).predict(observation)[0]))
    np.testing.assert_allclose(*controls, rtol=1e-5)
    assert np.abs(controls[0]).min() > 0.01
