"""Stable-Baselines3 on the vector environment."""

import warnings

import numpy as np
import pytest
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from leapnav.envs import NavigateEnv, NavigateVectorEnv
from leapnav.training import NavigateVecEnv, make_vec_env


def test_the_last_step_of_an_episode_reports_it_and_starts_the_next():
    venv = make_vec_env(n_envs=3, seed=4, family="rooms")
    envs = [NavigateEnv("rooms") for _ in range(3)]
    observations = venv.reset()
    for i, env in enumerate(envs):
        alone, info = env.reset(seed=4 + i)
        assert np.array_equal(alone, observations[i])
        assert venv.reset_infos[i]["index"] == info["index"]
    totals, lengths, finished = np.zeros(3), np.zeros(3, int), 0
    rng = np.random.default_rng(0)
    for _ in range(250):
        actions = rng.uniform(-0.2, 1, (3, 2)).astype(np.float32)
        observations, rewards, dones, infos = venv.step(actions)
        for i, env in enumerate(envs):
            alone, reward, terminated, _, info = env.step(actions[i])
            totals[i] += reward
            lengths[i] += 1
            assert dones[i] == terminated
            assert rewards[i] == np.float32(reward)
            if terminated:
                finished += 1
                assert np.array_equal(infos[i]["terminal_observation"], alone)
                assert infos[i]["episode"]["r"] == pytest.approx(totals[i], abs=1e-5)
                assert infos[i]["episode"]["l"] == lengths[i]
                assert infos[i]["TimeLimit.truncated"] is False
                for name, value in info.items():
                    assert np.array_equal(infos[i][name], value)
                totals[i], lengths[i] = 0.0, 0
                alone, info = env.reset()
                for name in ("index", "reference_cost", "cost", "time"):
                    assert venv.reset_infos[i][name] == info[name]
            else:
                assert infos[i] == {}
            assert np.array_equal(observations[i], alone)
    assert finished > 3


def test_the_infos_of_all_steps_can_be_had():
    venv = make_vec_env(n_envs=2, step_infos=True)
    venv.reset()
    infos = venv.step(np.zeros((2, 2), np.float32))[3]
    assert infos[1]["time"] == 0.05
    assert infos[1]["TimeLimit.truncated"] is False
    parts = {"reward_effort", "reward_proximity", "reward_collision", "reward_miss"}
    assert {name for name in infos[0] if name.startswith("reward_")} == parts


def test_the_observations_are_those_of_a_policy_or_a_model():
    venv = make_vec_env(n_envs=1, policy="clutter", family="open", dict_observation=True)
    assert venv.observation_space["lidar"].shape == (64,)
    assert "detours" in venv.observation_space.spaces  # of the geodesic observation
    sensors = make_vec_env(n_envs=2, family="open", lidar_beams=16, history=(0.4,), actuation="motor")
    other = make_vec_env(n_envs=3, policy=PPO("MlpPolicy", sensors, n_steps=4), split="fresh")
    assert other.observation_space == sensors.observation_space
    with pytest.raises(ValueError, match="policy: expected a model with one of leapnav's environments"):
        make_vec_env(n_envs=1, policy=PPO("MlpPolicy", "CartPole-v1", n_steps=4))
    with pytest.raises(FileNotFoundError, match="missing"):
        make_vec_env(n_envs=1, policy="missing")


def test_seeds_and_options_are_used_once():
    venv = make_vec_env(n_envs=2, env_kwargs={"family": "slalom", "split": "test"})
    venv.set_options([{"index": 3}, {"index": 5}])
    venv.reset()
    assert [info["index"] for info in venv.reset_infos] == [3, 5]
    venv.seed(7)
    first = venv.reset()
    second = venv.reset()
    venv.seed(7)
    assert np.array_equal(venv.reset(), first)
    assert not np.array_equal(first, second)


def test_attributes_and_methods_reach_the_environment():
    venv = make_vec_env("leapnav/NavigateGoal-v0", n_envs=3, family="open", render_mode="rgb_array")
    observations = venv.reset()
    scenarios = venv.get_attr("scenario", indices=[0, 2])
    assert [s.start for s in scenarios] == [venv.venv.scenarios[i].start for i in (0, 2)]
    assert venv.get_attr("time") == [0.0] * 3
    assert venv.get_attr("render_mode", 1) == ["rgb_array"]
    goals = observations["achieved_goal"], observations["desired_goal"]
    (rewards,) = venv.env_method("compute_reward", *goals, [{}] * 3, indices=[0])
    assert rewards.tolist() == [0.0] * 3
    assert venv.env_is_wrapped(Monitor) == [True] * 3
    assert venv.env_is_wrapped(VecMonitor) == [False] * 3
    assert venv.get_attr("action_space") == [venv.action_space] * 3
    assert [tuple(pose) for pose in venv.get_attr("pose")] == [s.start for s in venv.get_attr("scenario")]
    with pytest.raises(ValueError, match=r"indices: .*'reset' is called for all or none"):
        venv.env_method("reset", indices=[0])
    with pytest.raises(ValueError, match="attr_name: 'scenario' is set by a reset"):
        venv.set_attr("scenario", scenarios[0])
    with pytest.raises(AttributeError):
        venv.get_attr("gravity")
    with pytest.raises(ValueError, match=r"indices: .*'gravity'"):
        venv.set_attr("gravity", 9.81, indices=[0])
    venv.set_attr("gravity", 9.81)
    assert venv.get_attr("gravity") == [9.81] * 3
    assert venv.render().shape[2] == 3
    venv.close()


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match="autoreset_mode='SameStep', got 'NextStep'"):
        NavigateVecEnv(NavigateVectorEnv(2))
    with pytest.raises(ValueError, match="env_id: expected one of leapnav's environments, got 'CartPole-v1'"):
        make_vec_env("CartPole-v1")


@pytest.mark.parametrize("name", ["PPO", "PPO with a dict and a map", "SAC", "SAC with HER", "TQC"])
def test_learners_accept_the_environment_without_a_warning(name):
    off_policy = {"learning_starts": 200, "buffer_size": 5000, "batch_size": 64, "seed": 0}
    small = {"policy_kwargs": {"net_arch": [16]}}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        match name:
            case "PPO":
                venv = VecNormalize(make_vec_env(n_envs=8))
                model = PPO("MlpPolicy", venv, n_steps=64, batch_size=128, seed=0, **small)
            case "PPO with a dict and a map":
                venv = make_vec_env(n_envs=8, dict_observation=True, observation="map", actuation="motor")
                model = PPO("MultiInputPolicy", venv, n_steps=64, batch_size=128, seed=0, **small)
            case "SAC":
                model = SAC("MlpPolicy", make_vec_env(n_envs=4, reward="shaped"), **off_policy, **small)
            case "SAC with HER":
                venv = make_vec_env("leapnav/NavigateGoal-v0", n_envs=4, reward="cost")
                model = SAC(
                    "MultiInputPolicy",
                    venv,
                    replay_buffer_class=HerReplayBuffer,
                    replay_buffer_kwargs={"copy_info_dict": True},
                    **{**off_policy, "learning_starts": 1000},  # HER needs an episode that has ended
                    **small,
                )
            case "TQC":
                model = TQC("MlpPolicy", make_vec_env(n_envs=4, disturbance=0.1), **off_policy, **small)
        model.learn(1600)
        assert len(model.ep_info_buffer) > 0
        mean, _ = evaluate_policy(model, make_vec_env(venv_id(name), n_envs=2, **arguments(name)), n_eval_episodes=2)
    assert np.isfinite(mean)


def venv_id(name):
    return "leapnav/NavigateGoal-v0" if name == "SAC with HER" else "leapnav/Navigate-v0"


def arguments(name):
    return {"dict_observation": True, "observation": "map", "actuation": "motor"} if "map" in name else {}
