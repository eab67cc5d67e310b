"""The environment's options: what each of them does."""

import itertools
import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import scenario_fields
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import leapnav  # noqa: F401 (registers)
from leapnav.envs import (
    FAMILIES,
    Disturbance,
    Motor,
    NavigateEnv,
    NavigateGoalEnv,
    NavigateGoalVectorEnv,
    Scenario,
    ScenarioBank,
)
from leapnav.envs.simulation.observations import GOAL_ENTRIES, MOTION_ENTRIES, parts_of
from leapnav.envs.simulation.sensing import WALL_ENTRIES

ID, GOAL_ID = "leapnav/Navigate-v0", "leapnav/NavigateGoal-v0"
EMPTY = {"start": [5.0, 5.0, 0.3], "goal": [6.0, 5.0, 0.0], "obstacles": []}


def scenario(**changes):
    return Scenario.from_dict(scenario_fields(**{**EMPTY, **changes}))


def drive(env, actions, **reset):
    env.reset(**reset)
    steps = []
    for action in actions:
        steps.append(env.step(np.asarray(action, np.float32)))
        if steps[-1][2]:
            break
    return steps


OPTIONS = [
    {"observation": observation, "actuation": actuation, "dict_observation": in_parts, "disturbance": disturbance}
    for observation, actuation, in_parts, disturbance in itertools.product(
        ("lidar", "state", "map"), ("velocity", "motor"), (False, True), (None, 0.1)
    )
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_both_checkers_accept_every_option_without_a_warning(options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ID, render_mode="rgb_array", **options).unwrapped)
        check_env_sb3(gym.make(ID, reward="shaped", terminate_on_collision=False, **options))


@pytest.mark.parametrize("reward", ["sparse", "cost"])
def test_both_checkers_accept_the_goal_environment_without_a_warning(reward):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(GOAL_ID, render_mode="rgb_array", reward=reward).unwrapped)
        if reward == "sparse":  # the checker gives compute_reward an empty info
            check_env_sb3(gym.make(GOAL_ID, observation="map", actuation="motor").unwrapped)


@pytest.mark.parametrize("family", FAMILIES)
def test_both_checkers_accept_every_family(family):
    check_env(gym.make(ID, family=family, render_mode="rgb_array").unwrapped, skip_render_check=True)
    check_env_sb3(gym.make(ID, family=family, split="test"))


def test_the_parts_of_a_dict_observation_are_the_flat_one():
    for observation, actuation in itertools.product(("lidar", "state", "map"), ("velocity", "motor")):
        arguments = {"observation": observation, "actuation": actuation, "family": "polygons"}
        flat, _ = gym.make(ID, **arguments).reset(seed=3)
        parts, _ = gym.make(ID, dict_observation=True, **arguments).reset(seed=3)
        names = ["goal", *(["motion"] if actuation == "motor" else [])]
        names += {"lidar": ["lidar"], "state": [], "map": ["walls", "obstacles"]}[observation]
        assert list(names) == sorted(parts, key=names.index)
        assert np.array_equal(np.concatenate([parts[name] for name in names]), flat)


def test_a_map_shows_the_nearest_obstacles_in_the_robot_s_frame():
    task = scenario(
        start=[2.0, 3.0, math.pi / 2],
        obstacles=[
            {"polygon": {"vertices": [[5, 2], [6, 2], [6, 4]]}},
            {"circle": {"center": [2.0, 6.0], "radius": 0.5}},
            {"circle": {"center": [8.0, 8.0], "radius": 1.5}},
        ],
    )
    env = gym.make(ID, scenario=task, observation="map", map_obstacles=4, map_vertices=4, dict_observation=True)
    observation, _ = env.reset()
    assert observation["walls"] == pytest.approx([2.0, 3.0, 8.0, 7.0, 0.0, 1.0], abs=1e-6)
    rows = observation["obstacles"].reshape(4, 2 + 2 * 4)
    # Ahead is north: ahead = y - 3, left = 2 - x.
    assert rows[0] == pytest.approx([1, 0.5, *[3.0, 0.0] * 4], abs=1e-6)
    assert rows[1, :2].tolist() == [1, 0]
    corners = {tuple(corner) for corner in rows[1, 2:].reshape(4, 2).round(5).tolist()}
    assert corners == {(-1.0, -3.0), (-1.0, -4.0), (1.0, -4.0)}
    assert rows[2] == pytest.approx([1, 1.5, *[5.0, -6.0] * 4], abs=1e-6)
    assert not rows[3].any()
    few, _ = gym.make(ID, scenario=task, observation="map", map_obstacles=1, map_vertices=4).reset()
    assert len(few) == GOAL_ENTRIES + WALL_ENTRIES + 10
    assert few[-10:] == pytest.approx(rows[0])


def test_a_polygon_that_does_not_fit_the_map_is_refused():
    task = scenario(obstacles=[{"polygon": {"vertices": [[1, 1], [2, 1], [2, 2], [1, 2]]}}])
    with pytest.raises(ValueError, match=r"map_vertices: expected at least 4, .*got 3"):
        gym.make(ID, scenario=task, observation="map", map_vertices=3).reset()


# Shaped reward.


def discounted(rewards, discount):
    return sum(reward * discount**k for k, reward in enumerate(rewards))


@pytest.mark.parametrize(("discount", "family"), [(1.0, "clutter"), (0.97, "rooms")])
def test_shaping_changes_every_return_by_the_same(discount, family):
    """For any policy, the shaped return is the other one minus the potential of the start."""
    plain = gym.make(ID, family=family, split="test")
    shaped = gym.make(ID, family=family, split="test", reward="shaped", discount=discount)
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(6):
        actions = np.clip(np.cumsum(0.3 * rng.normal(size=(400, 2)), axis=0), -1, 1)
        rewards, others = ([step[1] for step in drive(env, actions, options={"index": 5})] for env in (plain, shaped))
        assert len(rewards) == len(others)
        differences.append(discounted(others, discount) - discounted(rewards, discount))
    assert differences[0] > 1  # minus the potential, which is minus a cost
    assert differences == pytest.approx([differences[0]] * 6, abs=1e-9)


def test_shaping_leaves_the_optimal_policy_of_a_small_problem_as_it_is():
    """All sequences of a few coarse actions, ranked by either reward."""
    task = scenario(goal=[6.2, 5.3, None], start=[5.0, 5.0, 0.0], horizon=2.0)
    choices = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.25), (0.3, -0.25), (0.6, 0.0)]

    def ranking(**arguments):
        env = gym.make(ID, scenario=task, control_period=0.5, position_tolerance=0.3, **arguments)
        returns = [
            discounted([step[1] for step in drive(env, plan)], 0.9) for plan in itertools.product(choices, repeat=4)
        ]
        return np.argsort(np.round(returns, 9), kind="stable")

    plain, shaped = ranking(), ranking(reward="shaped", discount=0.9)
    assert plain[-1] == shaped[-1]
    assert np.array_equal(plain, shaped)


def test_the_potential_rises_along_the_optimum():
    """Following the reference, the shaped rewards are positive early in the episode."""
    bank = ScenarioBank.shipped("rooms", "test")
    env = gym.make(ID, bank=bank, reward="shaped", discount=1.0)
    reference = bank.reference(3)
    limits = bank[3].robot.max_speed, bank[3].robot.max_turn_rate
    times = np.arange(0, bank[3].horizon, 0.05) + 0.025
    actions = np.stack([np.interp(times, reference.times, c) for c in reference.controls.T], axis=1) / limits
    steps = drive(env, actions, options={"index": 3})
    shaping = np.array([step[4]["reward_shaping"] for step in steps])
    assert (shaping[: len(shaping) // 2] > 0).mean() > 0.9


# Motors.


def test_a_robot_with_mass_takes_time_to_start_and_to_stop():
    env = NavigateEnv(scenario=scenario(start=[5.0, 5.0, 0.0], horizon=4.0), actuation="motor", observation="state")
    observation, _ = env.reset()
    assert observation[GOAL_ENTRIES:].tolist() == [0.0, 0.0, 0.0]
    speeds = []
    for k in range(40):
        observation, *_ = env.step(np.array([0.5 if k < 20 else 0.0, 0.0], np.float32))
        speeds.append(float(observation[GOAL_ENTRIES]))
    force, mass = Motor().wheel_force, Motor().mass
    assert speeds[0] == pytest.approx(2 * force / mass * 0.05, rel=0.05)  # both motors at their limit
    assert speeds[19] == pytest.approx(1.0, abs=0.01)
    assert all(b > a - 1e-9 for a, b in itertools.pairwise(speeds[:20]))
    assert 0.1 < speeds[20] < 0.9
    assert speeds[-1] == pytest.approx(0.0, abs=0.01)
    assert abs(env.pose[1] - 5.0) < 1e-9


def slide(grip):
    env = NavigateEnv(
        scenario=scenario(start=[2.0, 2.0, 0.0], goal=[8.0, 8.0, 0.0], horizon=3.0),
        actuation="motor",
        observation="state",
        motor={"grip": grip},
    )
    env.reset()
    sideways = []
    for k in range(50):
        observation, *_ = env.step(np.array([1.0, 0.0 if k < 25 else 1.0], np.float32))
        sideways.append(abs(float(observation[GOAL_ENTRIES + 1])))
    return max(sideways)


def test_tyres_slip_sideways_when_they_do_not_grip():
    assert slide(grip=2.0) < 0.1
    assert slide(grip=0.2) > 0.5


def test_a_robot_with_motors_collides_with_each_disc_of_its_footprint():
    disc = {"circle": {"center": [6.5, 5.0], "radius": 0.5}}
    clearances = []
    for footprint in ([(0.0, 0.2)], [(0.0, 0.2), (0.6, 0.2)]):
        robot = {"footprint": [{"offset": offset, "radius": radius} for offset, radius in footprint]}
        task = scenario(start=[4.0, 5.0, 0.0], goal=[5.0, 3.0, 0.0], obstacles=[disc], robot=robot, horizon=4.0)
        env = NavigateEnv(scenario=task, actuation="motor", observation="state")
        env.reset()
        terminated = False
        while not terminated:
            *_, terminated, _, info = env.step(np.array([1.0, 0.0]))
        assert info["collision"]
        clearances.append(6.0 - info["pose"][0])
    assert clearances == pytest.approx([0.2, 0.8], abs=1e-3)


def test_a_map_has_other_parts_than_a_network_for_the_lidar_expects():
    with pytest.raises(ValueError, match="observation_space: expected goal, motion, lidar and detours"):
        parts_of(NavigateEnv(split="fresh", observation="map").observation_space)


def test_the_motors_effort_is_that_of_the_motion():
    env = NavigateEnv(scenario=scenario(horizon=2.0), actuation="motor", miss_penalty=0.0, observation="state")
    steps = drive(env, [(0.4, 0.2)] * 40)
    cost = steps[-1][4]["cost"]
    speed, turn_rate = 0.8, 0.6
    settled = 0.5 * (1.0 * speed**2 + 0.5 * turn_rate**2)
    assert 0.8 * settled * 2 < cost < settled * 2 + 0.05
    assert sum(step[1] for step in steps) == pytest.approx(-cost)


def test_in_contact_friction_slows_a_robot_down():
    wall = {"polygon": {"vertices": [[0.5, 5.3], [9.5, 5.3], [9.5, 5.6], [0.5, 5.6]]}}
    task = scenario(start=[1.0, 5.0, 0.3], goal=[9.0, 2.0, 0.0], obstacles=[wall], horizon=4.0)
    distances = []
    for friction in (0.0, 0.9):
        env = NavigateEnv(scenario=task, actuation="motor", motor={"friction": friction}, terminate_on_collision=False)
        steps = drive(env, [(0.5, 0.0)] * 60)
        assert steps[-1][4]["collision"]
        distances.append(env.pose[0] - 1.0)
    assert distances[1] < distances[0] - 0.2


# Disturbances.


def test_the_disturbance_has_a_generator_of_its_own():
    calm, rough = gym.make(ID), gym.make(ID, disturbance=0.2)
    for seed in range(3):
        assert calm.reset(seed=seed)[1]["index"] == rough.reset(seed=seed)[1]["index"]
        assert calm.reset()[1]["index"] == rough.reset()[1]["index"]


def test_disturbances_are_the_same_with_the_same_seed_and_differ_otherwise():
    def end(seed):
        env = gym.make(ID, scenario=scenario(horizon=4.0), disturbance=0.1)
        return drive(env, [(0.3, 0.1)] * 70, seed=seed)[-1][4]["pose"].tolist()

    assert end(1) == end(1)
    assert end(1) != end(2)


def test_each_part_of_the_disturbance_does_what_it_says():
    task = scenario(start=[2.0, 5.0, 0.0], goal=[8.0, 5.0, 0.0], horizon=4.0)

    def observe(**disturbance):
        env = NavigateEnv(scenario=task, disturbance=disturbance)
        steps = drive(env, [(0.5, 0.0)] * 80, seed=3)
        return np.array([step[0] for step in steps]), np.array([step[4]["pose"] for step in steps])

    still, path = observe()
    assert path[-1] == pytest.approx([6.0, 5.0, 0.0])
    _, pushed = observe(actuation=0.2)
    driven = np.diff(pushed[:, 0])
    assert driven.mean() == pytest.approx(0.05, rel=0.1)
    assert driven.std() == pytest.approx(0.2 * 0.05, rel=0.3)
    assert np.abs(pushed[:, 2]).max() == 0.0  # relative to a turn rate of zero
    _, slipped = observe(slip=0.2)
    assert slipped[-1, 0] < 5.8
    assert np.abs(np.diff(slipped[:, 2])).max() > 1e-3  # the wheels slip one by one
    sensed, same = observe(sensing=0.05)
    assert np.array_equal(same, path)
    assert (sensed[:, 0] - still[:, 0]).std() == pytest.approx(0.05, rel=0.3)
    ranges, clear = sensed[:, GOAL_ENTRIES:], still[:, GOAL_ENTRIES:]
    assert (ranges - clear)[clear < 9].std() == pytest.approx(0.05, rel=0.05)


def test_a_number_stands_for_all_of_the_disturbance():
    env = NavigateEnv(disturbance=0.2)
    assert env.settings.disturbance == Disturbance(actuation=0.2, slip=0.2, sensing=0.02)


def test_a_disturbed_environment_goes_on_after_pickling():
    env = NavigateEnv(scenario=scenario(horizon=8.0), disturbance=0.1, actuation="motor")
    drive(env, [(0.2, 0.1)] * 40, seed=5)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(80):
        one, other = env.step(np.array([0.2, -0.1])), copy.step(np.array([0.2, -0.1]))
        assert one[0].tobytes() == other[0].tobytes()
    assert env.reset()[0].tobytes() == copy.reset()[0].tobytes()


# Goals.


@pytest.mark.parametrize("reward", ["sparse", "cost"])
def test_the_reward_is_the_one_computed_from_the_goals(reward):
    task = scenario(start=[5.0, 5.0, 0.0], goal=[6.0, 5.0, 0.0], horizon=1.5)
    env = gym.make(GOAL_ID, scenario=task, reward=reward, miss_penalty=7.0)
    steps = drive(env, [(0.5, 0.0)] * 20 + [(0.0, 0.0)] * 10)
    achieved, desired = (np.array([step[0][f"{name}_goal"] for step in steps]) for name in ("achieved", "desired"))
    infos = [step[4] for step in steps]
    rewards = np.array([step[1] for step in steps])
    assert np.array_equal(env.unwrapped.compute_reward(achieved, desired, infos), rewards)
    assert steps[-1][4]["is_success"]
    if reward == "sparse":
        assert rewards.tolist() == [0.0] * 17 + [1.0] * 13
        elsewhere = env.unwrapped.compute_reward(achieved, np.roll(desired, 1, axis=1), [{}] * len(steps))
        assert not elsewhere.any()
    else:
        assert rewards.sum() == pytest.approx(-infos[-1]["cost"])
        missed = env.unwrapped.compute_reward(achieved, desired + np.float32(1.0), infos)
        assert missed.sum() == pytest.approx(-infos[-1]["cost"] - 7.0)


@pytest.mark.parametrize("reward", ["sparse", "cost"])
def test_goals_decide_by_where_the_robot_is(reward):
    """Neither noise nor the bounds of the observation make a goal look achieved or missed."""
    stay = scenario(start=[5.0, 5.0, 0.0], goal=[5.05, 5.0, 0.0], horizon=1.0)
    noisy = NavigateGoalEnv(scenario=stay, reward=reward, disturbance={"sensing": 0.2})
    steps = drive(noisy, [(0.0, 0.0)] * 20)
    assert steps[-1][4]["is_success"]
    assert [step[1] for step in steps] == pytest.approx([1.0] * 20 if reward == "sparse" else [0.0] * 20, abs=1e-9)
    far = scenario(
        arena=[0.0, 0.0, 5000.0, 5000.0], start=[1500.0, 1200.0, 0.0], goal=[3000.0, 4000.0, 0.0], horizon=0.1
    )
    steps = drive(NavigateGoalEnv(scenario=far, reward=reward), [(0.0, 0.0)] * 2)
    assert steps[-1][1] == pytest.approx(0.0 if reward == "sparse" else -50.0)


def test_a_free_goal_heading_is_reached_by_any():
    env = NavigateGoalEnv(scenario=scenario(goal=[5.05, 5.0, None], horizon=0.5))
    observation, _ = env.reset()
    assert observation["desired_goal"][2:].tolist() == [0.0, 0.0]
    assert env.step(np.zeros(2, np.float32))[1] == 1.0


def test_the_reward_cost_asks_for_the_infos():
    env = NavigateGoalEnv(reward="cost")
    observation, _ = env.reset()
    goals = observation["achieved_goal"], observation["desired_goal"]
    with pytest.raises(ValueError, match=r"info: .*copy_info_dict=True"):
        env.compute_reward(*goals, {})
    with pytest.raises(ValueError, match="info: expected 1 dicts"):
        env.compute_reward(goals[0][None], goals[1][None], [])


def test_single_and_vector_agree_on_goals_too():
    for reward in ("sparse", "cost"):
        arguments = {
            "reward": reward,
            "scenario": scenario(horizon=2.0),
            "position_tolerance": 0.5,
            "heading_tolerance": 0.5,
        }
        env, venv = NavigateGoalEnv(**arguments), NavigateGoalVectorEnv(1, **arguments)
        env.reset(seed=0)
        venv.reset(seed=0)
        seen = set()
        for k in range(60):
            action = np.array([0.6, 0.2 * math.sin(k)], np.float32)
            observation, r, end, _, info = env.step(action)
            observations, rewards, ends, _, infos = venv.step(action[None])
            assert all(np.array_equal(observation[name], observations[name][0]) for name in observation)
            assert (r, end) == (rewards[0], ends[0])
            assert info["at_horizon"] == infos["at_horizon"][0]
            seen.add(r)
            if end:
                break
        assert len(seen) > 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation": "camera"}, "observation: expected one of lidar, state, map, geodesic, got 'camera'"),
        ({"reward": "sparse"}, "reward: expected one of cost, shaped, got 'sparse'"),
        ({"actuation": "legs"}, "actuation: expected one of velocity, motor, got 'legs'"),
        ({"disturbance": -0.1}, "disturbance: expected a number >= 0, got -0.1"),
        ({"disturbance": {"wind": 1}}, "disturbance: expected the attributes .*, got 'wind'"),
        ({"disturbance": {"slip": math.nan}}, "disturbance: slip: .*nan"),
        ({"disturbance": "much"}, "disturbance: expected Disturbance .*'much'"),
        ({"motor": {"mass": 0}}, "motor: mass: expected a positive number, got 0"),
        ({"discount": 1.5}, r"discount: expected a number in \(0, 1\], got 1.5"),
        ({"map_vertices": 2}, "map_vertices: expected an integer from 3 to 10000, got 2"),
        ({"lidar_beams": 10**9}, "lidar_beams: expected an integer from 0 to 10000, got 1000000000"),
        ({"bank": 5}, "bank: expected a ScenarioBank or its file, got 5"),
        ({"family": []}, r"family: expected one of .*, got \[\]"),
        ({"dict_observation": 1}, "dict_observation: expected True or False, got 1"),
        ({"split": "validation"}, "split: expected one of train, test, fresh, got 'validation'"),
        ({"split": "test", "scenario": scenario_fields()}, "split: cannot be combined with scenario"),
    ],
)
def test_impossible_settings_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **arguments)
    with pytest.raises(ValueError, match=message):
        gym.make_vec(ID, num_envs=2, **arguments)


def test_an_unknown_render_mode_is_named():
    with pytest.raises(ValueError, match="render_mode: expected None or one of human, rgb_array, got 'ansi'"):
        NavigateEnv(render_mode="ansi")


def test_motion_is_observed_with_motors_only():
    plain, motors = gym.make(ID, observation="state"), gym.make(ID, observation="state", actuation="motor")
    assert plain.observation_space.shape == (GOAL_ENTRIES,)
    assert motors.observation_space.shape == (GOAL_ENTRIES + MOTION_ENTRIES,)
