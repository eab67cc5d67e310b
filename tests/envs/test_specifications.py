"""The specification of an environment, which Gymnasium and Minari store as JSON."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import leapnav  # noqa: F401 (registers the environments)
from leapnav.envs import Car, Cost, Disturbance, Motor, NavigateEnv, NavigateGoalEnv, Scenario, ScenarioBank, Unicycle
from leapnav.envs.vector import AutoresetMode

IDS = "leapnav/Navigate-v0", "leapnav/NavigateGoal-v0"
BANK = ScenarioBank.shipped("rooms", "test")
FREE = Scenario.from_discs(
    [[4, 2.4, 0.5]],
    start=(1, 2.5, 0),
    goal=(7, 2.5, None),
    horizon=None,
    robot=Unicycle(max_speed=1.5),
    cost=Cost(time_weight=0.5),
)
SHARED = [
    {},
    {"family": "slalom", "split": "fresh", "horizon": "free"},
    {"scenario": BANK[3]},
    {"scenario": FREE},
    {"scenario": {**FREE.to_dict(), "robot": Unicycle(max_speed=1.5)}},
    {"scenario": FREE.to_json()},
    {"bank": BANK},
    {"bank": Path(BANK.path)},
    {"robot": Unicycle(radius=0.2), "split": "fresh"},
    {"robot": Car(), "family": "open"},
    {"robot": Unicycle(footprint=({"offset": 0.1, "radius": 0.2}, {"radius": 0.25})), "split": "fresh"},
    {"disturbance": Disturbance(sensing=0.1)},
    {"disturbance": np.float32(0.25)},
    {"actuation": "motor", "motor": Motor(mass=np.float64(12.0))},
    {"actuation": "motor", "motor": {"mass": np.float32(12.0)}},
    {"control_period": np.float32(0.0625), "lidar_beams": np.int64(16), "lidar_range": np.int32(8)},
    {"observation": "map", "map_obstacles": np.int64(4), "terminate_on_collision": False},
    {"position_tolerance": np.float32(0.5), "collision_penalty": np.int64(10), "discount": np.float32(0.5)},
]


def first_observation(env):
    observation, info = env.reset(seed=4)
    return gym.spaces.flatten(env.observation_space, observation), info


@pytest.mark.parametrize("arguments", SHARED, ids=lambda arguments: "-".join(arguments) or "none")
@pytest.mark.parametrize("name", IDS)
def test_a_specification_survives_json(name, arguments):
    env = gym.make(name, **arguments)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(first_observation(again)[0], first_observation(env)[0])
    assert again.unwrapped.settings == env.unwrapped.settings
    assert again.unwrapped.scenario == env.unwrapped.scenario
    assert again.spec.to_json() == env.spec.to_json()


@pytest.mark.parametrize("arguments", SHARED, ids=lambda arguments: "-".join(arguments) or "none")
@pytest.mark.parametrize("name", IDS)
def test_the_specification_of_a_vector_environment_survives_json(name, arguments):
    env = gym.make_vec(name, num_envs=3, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    again = gym.make_vec(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(first_observation(again)[0], first_observation(env)[0])
    assert again.unwrapped.settings == env.unwrapped.settings
    assert again.unwrapped.scenarios == env.unwrapped.scenarios
    assert (again.num_envs, again.unwrapped.autoreset_mode) == (3, AutoresetMode.SAME_STEP)


def test_a_specification_keeps_the_wrappers():
    env = gym.wrappers.FlattenObservation(gym.make(IDS[0], scenario=FREE, dict_observation=True))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(again.reset(seed=0)[0], env.reset(seed=0)[0])


@pytest.mark.parametrize("kind", [NavigateEnv, NavigateGoalEnv])
def test_a_step_after_the_end_is_an_error_and_changes_nothing(kind):
    env = kind(scenario=BANK[0].model_copy(update={"horizon": 0.1}))
    env.reset(seed=0)
    done, action = False, np.array([0.5, 0.0])
    while not done:
        _, _, done, _, info = env.step(action)
    pose, time = env.pose, env.time
    for _ in range(2):
        with pytest.raises(gym.error.ResetNeeded):
            env.step(action)
    assert (env.pose, env.time, tuple(info["pose"])) == (pose, time, pose)
    env.reset()
    assert env.step(action)[4]["time"] > 0


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_gymnasium_s_vector_environment_restarts_episodes(mode):
    """The autoreset of Gymnasium never takes a step after the end."""
    scenario = BANK[0].model_copy(update={"horizon": 0.1})
    envs = gym.vector.SyncVectorEnv([lambda: gym.make(IDS[0], scenario=scenario)] * 2, autoreset_mode=mode)
    envs.reset(seed=0)
    ends = 0
    for _ in range(7):
        *_, terminated, _, _ = envs.step(np.zeros((2, 2), np.float32))
        ends += int(terminated.sum())
        if mode is AutoresetMode.DISABLED and terminated.any():
            envs.reset(options={"reset_mask": terminated})
    assert ends >= 4
