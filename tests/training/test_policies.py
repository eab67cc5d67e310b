import json

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from helpers import SMALL
from stable_baselines3 import A2C, PPO, SAC, TD3

from leapnav.envs import NavigateEnv
from leapnav.training import NavigationFeatures, load_policy, make_vec_env, network, save_policy
from leapnav.training.policies.files import _checksum


def test_the_features_have_the_promised_size_and_are_finite(env):
    features = NavigationFeatures(env.observation_space)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        found = features(th.as_tensor(observation)[None])
        assert found.shape == (1, features.features_dim)
        assert th.isfinite(found).all()
    low, high = env.observation_space.low, env.observation_space.high
    assert th.isfinite(features(th.as_tensor(np.stack([low, high, np.zeros_like(low)])))).all()


def test_policies_are_checked_against_the_robots_of_stable_baselines3(clone, tmp_path):
    save_policy(clone[0], tmp_path)
    load_policy(tmp_path, make_vec_env(n_envs=2, family="open", reward_scale=0.1))
    with pytest.raises(ValueError, match="lidar_beams=32"):
        load_policy(tmp_path, make_vec_env(n_envs=2, family="open", lidar_beams=16))


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_a_saved_policy_acts_the_same(algorithm, env, tmp_path):
    model = algorithm("MlpPolicy", env, policy_kwargs=network(SMALL), seed=0, device="cpu")
    save_policy(model, tmp_path / "policy")
    loaded = load_policy(tmp_path / "policy", env)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(
            model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
        )


def test_half_precision_keeps_the_actor(clone, env, tmp_path):
    save_policy(clone[0], tmp_path / "whole")
    save_policy(clone[0], tmp_path / "half", half=True)
    sizes = [(tmp_path / name / "weights.pt").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.3 * sizes[0]
    loaded = load_policy(tmp_path / "half", env)
    observation, _ = env.reset(seed=0)
    assert loaded.predict(observation, deterministic=True)[0] == pytest.approx(
        clone[0].predict(observation, deterministic=True)[0], abs=0.01
    )


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
def test_an_ordinary_mlp_policy_is_saved(algorithm, env, tmp_path):
    model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [16, 8], "activation_fn": th.nn.ELU}, device="cpu")
    save_policy(model, tmp_path / "policy")
    loaded = load_policy(tmp_path / "policy", env)
    observations = np.array([env.reset(seed=seed)[0] for seed in range(5)])
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)


class OwnFeatures(NavigationFeatures):
    pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"features_extractor_class": OwnFeatures}, "features extractor: expected one of .*, got OwnFeatures"),
        ({"activation_fn": th.nn.Softplus}, "activation function: expected one of ReLU, .*, got Softplus"),
    ],
)
def test_a_policy_that_cannot_be_described_is_not_saved(arguments, message, env, tmp_path):
    with pytest.raises(ValueError, match=message):
        save_policy(PPO("MlpPolicy", env, policy_kwargs=arguments), tmp_path / "policy")
    with pytest.raises(ValueError, match="use_sde=True"):
        save_policy(PPO("MlpPolicy", env, use_sde=True), tmp_path / "policy")
    with pytest.raises(ValueError, match=r"environment: has observations \(25,\), the policy's are \(41,\)"):
        save_policy(PPO("MlpPolicy", env), tmp_path / "policy", {"lidar_beams": 16})
    assert not (tmp_path / "policy").exists()


def test_broken_and_foreign_policies_are_refused(clone, tmp_path):
    save_policy(clone[0], tmp_path)
    with pytest.raises(ValueError, match=r"was trained with other observations: lidar_beams=32 \(here 16\)"):
        load_policy(tmp_path, gym.make("leapnav/Navigate-v0", lidar_beams=16))
    with pytest.raises(ValueError, match=r"actuation='velocity' \(here 'motor'\)"):
        load_policy(tmp_path, gym.make("leapnav/Navigate-v0", actuation="motor"))
    weights = (tmp_path / "weights.pt").read_bytes()
    half = len(weights) // 2
    for damaged in (weights[:1000], weights[:half] + bytes([weights[half] ^ 255]) + weights[half + 1 :]):
        (tmp_path / "weights.pt").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"weights\.pt: not the weights of this policy: damaged"):
            load_policy(tmp_path)
    (tmp_path / "weights.pt").unlink()
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    faults = [
        ({**description, "format": 99}, "format: expected 6, got 99"),
        ({}, "not the description of a policy"),
        ({**description, "environment": {"id": "leapnav/Navigate-v1"}}, "a policy for leapnav/Navigate-v1"),
        ({**description, "kind": "dqn"}, "kind: expected one of actor-critic, sac, td3, tqc, got 'dqn'"),
        ({**description, "hidden": ["wide"]}, "not the description of a policy"),
        ({**description, "observation_low": [0.0]}, "not the description of a policy"),
    ]
    for content, message in faults:
        (tmp_path / "policy.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=message):
            load_policy(tmp_path)


def test_loading_a_policy_executes_nothing(clone, tmp_path):
    import os
    import pickle

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    save_policy(clone[0], tmp_path)
    (tmp_path / "weights.pt").write_bytes(pickle.dumps(Evil()))
    description = json.loads((tmp_path / "policy.json").read_text())
    description["sha256"] = _checksum(tmp_path, description)
    (tmp_path / "policy.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="not the weights of this policy"):
        load_policy(tmp_path)
    assert not (tmp_path / "executed").exists()


def test_the_motion_features_contain_the_acceleration_that_stops_at_the_goal():
    distance, rate, period, steps = 2.0, 0.7, 0.05, 40
    space = NavigateEnv("open", robot="dynamic_unicycle").observation_space
    features = NavigationFeatures(space)
    for step in range(steps):
        time_left = (steps - step) * period
        observation = th.zeros(1, *space.shape)
        observation[0, 4], observation[0, 5], observation[0, 9] = time_left, distance / time_left, rate
        observation[0, 11:] = 5.0
        first = 23 + 3 * 2  # after the features of the goal and three values of each of the two rates
        acceleration = 6 * float(features(observation)[0, first])  # of the speed, towards the goal
        distance -= rate * period + acceleration * period**2 / 2
        rate += acceleration * period
    assert distance == pytest.approx(0, abs=0.01) and rate == pytest.approx(0, abs=1e-3)
