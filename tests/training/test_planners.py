"""The planners among the baselines: dynamic window, path integral, lattice, freespace assumption."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction

from leapnav.envs import NavigateEnv, NavigateVectorEnv, Obstacle, Scenario, ScenarioBank
from leapnav.envs.shapes import Circle
from leapnav.experts import find_optimum
from leapnav.training import PlannerPolicy, PolicyFactory, evaluate
from leapnav.training.policies.planners import PLANNERS, FreespaceAssumption, Geodesics, arcs

POLICIES = {name: PolicyFactory(lambda env, name=name: PlannerPolicy(env, name)) for name in PLANNERS}


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("horizon", ["fixed", "free"])
def test_planners_reach_the_goal_among_obstacles(name, horizon):
    bank = ScenarioBank.shipped("clutter", "test", horizon=horizon)
    found = evaluate(POLICIES[name], bank, count=2 if name == "mppi" else 6, timed=False, progress=False)
    assert found.success >= 5 / 6 and found.collision == 0.0
    assert 0.4 < found.soc < 1.0  # they are not optimal


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_drives_single_vector_and_wrapped_environments_alike(name):
    bank = ScenarioBank.shipped("rooms", "test")
    single, vector = NavigateEnv(bank=bank), NavigateVectorEnv(2, bank=bank)
    scaled = RescaleAction(gym.make("leapnav/Navigate-v0", bank=bank), np.float32(-2), np.float32(2))
    policies = [PlannerPolicy(env, name) for env in (single, vector, scaled)]
    single.reset(options={"index": 3})
    vector.reset(options={"index": [3, 4]})
    scaled.reset(options={"index": 3})
    for _ in range(5):
        action, actions, twice = (policy.predict(None)[0] for policy in policies)
        assert action.shape == (2,) and actions.shape == (2, 2)
        assert twice == pytest.approx(2 * action, abs=1e-6)
        if name != "mppi":  # whose robots share a generator
            assert actions[0] == pytest.approx(action, abs=1e-6)
        single.step(action)
        vector.step(np.array([action, actions[1]]))
        scaled.step(twice)


@pytest.mark.parametrize("name", ["dwa", "mppi", "freespace"])
def test_a_disc_that_drives_towards_the_robot_is_avoided(name):
    path = {"times": [0, 5], "points": [[7.0, 2.2], [2.0, 2.2]]}
    disc = Obstacle(circle=Circle(center=(7.0, 2.2), radius=0.5), path=path)
    scenario = Scenario(arena=(0, 0, 8, 5), start=(1, 2.5, 0), goal=(7, 2.5, 0), horizon=8, obstacles=(disc,))
    env = NavigateEnv(scenario=scenario)
    policy, done = PlannerPolicy(env, name), False
    env.reset(seed=0)
    while not done:
        _, _, done, _, info = env.step(policy.predict(None)[0])
    assert info["is_success"] and not info["collision"] and info["clearance"] > 0.0


def test_an_obstacle_changes_the_plan_when_lidar_meets_it():
    first, behind = (Obstacle(circle=Circle(center=(x, 2.6), radius=r)) for x, r in ((3.0, 0.6), (5.0, 0.5)))
    scenario = Scenario(arena=(0, 0, 8, 5), start=(1, 2.5, 0), goal=(7, 2.5, 0), horizon=8, obstacles=(first, behind))
    driver = FreespaceAssumption(scenario, 0.05, np.random.default_rng(0))
    only_first = find_optimum(scenario.model_copy(update={"obstacles": (first,)}))
    control = driver.control(np.array(scenario.start), 0.0)
    assert control == pytest.approx(only_first.evaluate(0.025)[1], abs=1e-3)
    pose = np.array([2.6, 1.5, 0.3])  # beside the first obstacle, which no longer hides the other one
    both = find_optimum(scenario.from_state(pose, 2.0))
    assert driver.control(pose, 2.0) == pytest.approx(both.evaluate(0.025)[1], abs=1e-3)


def test_a_goal_that_cannot_be_reached_is_no_error():
    wall = Obstacle(circle=Circle(center=(4.0, 2.5), radius=2.4))
    scenario = Scenario(arena=(0, 0, 8, 5), start=(0.8, 2.5, 0), goal=(7.2, 2.5, 0), horizon=8, obstacles=(wall,))
    env = NavigateEnv(scenario=scenario)
    for name in PLANNERS:
        env.reset(seed=0)
        assert np.abs(PlannerPolicy(env, name).predict(None)[0]).max() <= 1.0


def test_arcs_are_those_of_the_unicycle():
    controls = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.5]])
    found = arcs(np.zeros((3, 3)), controls, np.array([0.5, 2.0]))
    assert found[0, 1] == pytest.approx([2.0, 0.0, 0.0]) and found[1, 1] == pytest.approx([0.0, 0.0, 2.0])
    assert found[2, 1] == pytest.approx([2.0 * np.sin(1.0), 2.0 * (1.0 - np.cos(1.0)), 1.0])  # radius v / omega


def test_the_geodesic_distance_descends_around_an_obstacle():
    scenario = ScenarioBank.shipped("rooms", "test")[0]
    distances, point = Geodesics(scenario), np.array([scenario.start[:2]], dtype=float)
    before = distances(point)[0]
    assert before > np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2])) - 0.1
    for _ in range(10):
        angle = distances.descents(point)[0]
        point = point + 0.05 * np.array([np.cos(angle), np.sin(angle)])
    assert before - distances(point)[0] == pytest.approx(0.5, rel=0.3)


def test_the_samples_of_mppi_depend_on_the_seed_alone():
    env = NavigateEnv("open")
    env.reset(seed=0)
    first, same, other = (PlannerPolicy(env, "mppi", seed).predict(None)[0] for seed in (1, 1, 2))
    assert (first == same).all() and (first != other).any()


def test_other_robots_and_planners_are_refused():
    with pytest.raises(ValueError, match=r"dwa: expected the robot 'unicycle'.*'car'"):
        PlannerPolicy(NavigateEnv("open", robot="car"), "dwa")
    with pytest.raises(ValueError, match=r"planner: expected .*'rrt'"):
        PlannerPolicy(NavigateEnv("open"), "rrt")
