"""Limits of the controls that are intervals."""

import json

import numpy as np
import pytest
from helpers import info_of_plan, scenario_fields
from scipy.integrate import cumulative_trapezoid

from leapnav.envs import DifferentialDrive, DynamicCar, DynamicUnicycle, NavigateEnv, Scenario, ScenarioError, Unicycle
from leapnav.envs.kernels.types import constant
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
        (DynamicUnicycle(max_speed=1.0, max_turn_rate=1.0), True, True),
        (DynamicUnicycle(speed=(-0.1, 0.5)), True, False),
        (DynamicUnicycle(turn_rate=(-0.5, 1.0)), False, True),
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


LIMITED = {"model": "dynamic_unicycle", "max_speed": 0.8, "turn_rate": [-1.0, 1.5]}


@pytest.mark.parametrize(("acceleration", "angular"), [(1.0, 3.0), (-2.0, -1.0), (3.0, 0.0), (0.0, -3.0)])
def test_a_robot_does_not_accelerate_beyond_the_limits_of_its_states(acceleration, angular):
    scenario = task(LIMITED)
    parameters, new = constant(scenario.robot.parameters(scenario.cost)), np.zeros(5)
    start = np.array([0.0, 0.0, 0.0, 0.5, -0.5])
    DynamicUnicycle.advance(start, np.array([acceleration, angular]), 1.5, parameters, new)
    times = np.linspace(0.0, 1.5, 200_001)
    speed, turn_rate = np.clip(0.5 + acceleration * times, -0.8, 0.8), np.clip(-0.5 + angular * times, -1.0, 1.5)
    heading = cumulative_trapezoid(turn_rate, times, initial=0.0)
    position = [np.trapezoid(speed * function(heading), times) for function in (np.cos, np.sin)]
    assert new == pytest.approx([*position, heading[-1], speed[-1], turn_rate[-1]], abs=1e-8)


@pytest.mark.parametrize(("acceleration", "steering_rate"), [(1.5, 2.0), (-3.0, -1.0), (0.0, 4.0)])
def test_a_car_does_not_accelerate_beyond_the_limits_of_its_speed(acceleration, steering_rate):
    scenario = task({"model": "dynamic_car", "speed": [-0.6, 1.2]})
    parameters, new = constant(scenario.robot.parameters(scenario.cost)), np.zeros(5)
    start = np.array([0.0, 0.0, 0.3, -0.2, 0.5])
    DynamicCar.advance(start, np.array([acceleration, steering_rate]), 1.5, parameters, new)
    times = np.linspace(0.0, 1.5, 200_001)
    speed, steering = np.clip(0.5 + acceleration * times, -0.6, 1.2), -0.2 + steering_rate * times
    turn_rate = scenario.robot.max_curvature * speed * np.sin(steering)
    heading = 0.3 + cumulative_trapezoid(turn_rate, times, initial=0.0)
    position = [np.trapezoid(speed * function(heading), times) for function in (np.cos, np.sin)]
    assert new == pytest.approx([*position, heading[-1], steering[-1], speed[-1]], abs=1e-8)


@pytest.mark.slow
def test_the_optimum_of_a_car_respects_the_limit_of_its_speed():
    robot = {"model": "dynamic_car", "max_speed": 0.9, "max_acceleration": 2.0}
    scenario = task(robot, horizon=None, cost={"time_weight": 1.0})
    optimum = find_optimum(scenario, "medium")
    assert optimum.success and optimum.barrier <= 1e-3
    states, controls, _ = optimum.evaluate(np.linspace(0.0, optimum.horizon, 1001))
    assert 0.85 < states[:, 4].max() < 0.9
    assert np.abs(controls[:, 0]).max() <= 2.0 + 1e-9


@pytest.mark.slow
def test_optima_respect_the_limits_of_states():
    scenario = task(LIMITED, horizon=None, cost={"time_weight": 1.0})
    assert json.loads(scenario.to_json())["robot"].keys() >= {"max_speed", "turn_rate"}
    assert "max_speed" not in DynamicUnicycle().model_dump() and Scenario.from_json(scenario.to_json()) == scenario
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.barrier <= 1e-3
    states, controls, _ = optimum.evaluate(np.linspace(0.0, optimum.horizon, 1001))
    assert 0.75 < np.abs(states[:, 3]).max() < 0.8
    assert states[:, 4].min() > -1.0 and states[:, 4].max() < 1.5
    low, high = scenario.robot.control_bounds().T
    assert (controls >= low - 1e-9).all() and (controls <= high + 1e-9).all()
    without = task({"model": "dynamic_unicycle"}, horizon=None, cost={"time_weight": 1.0})
    assert optimum.cost > find_optimum(without).cost
    info = info_of_plan(optimum, scenario)
    assert info["is_success"] and info["cost"] == pytest.approx(optimum.cost, rel=5e-3)


@pytest.mark.slow
def test_the_expert_drives_at_the_limit_of_the_speed():
    scenario = task(LIMITED, horizon=None, start_motion=[0.8, 0.0], cost={"time_weight": 1.0})
    env = NavigateEnv(scenario=scenario)
    observation, _ = env.reset()
    expert, done, info = ExpertPolicy(env), False, {}
    while not done:
        observation, _, terminated, truncated, info = env.step(expert.predict(observation)[0])
        assert abs(env.state[3]) <= 0.8
        done = terminated or truncated
    assert info["is_success"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_motion": [0.9, 0.0]}, "start_motion: expected a speed from -0.8 to 0.8, got 0.9"),
        ({"goal_motion": [0.0, 2.0]}, "goal_motion: expected a turn_rate from -1 to 1.5, got 2"),
        ({"robot": {**LIMITED, "speed": [-1.0, 1.0]}}, "max_speed: cannot be combined with speed"),
        (
            {"robot": {"model": "dynamic_unicycle", "speed": [0.1, 1.0]}},
            r"speed: expected an interval that contains 0 inside, got \[0.1, 1.0\]",
        ),
    ],
)
def test_errors_of_limits_of_states(changes, message):
    with pytest.raises(ScenarioError, match=message):
        task(**{"robot": LIMITED, **changes})
