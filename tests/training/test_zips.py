"""Models that Stable-Baselines3 has saved (`.zip`)."""

import io
import json
import os
import zipfile

import numpy as np
import pytest
import torch as th
from helpers import SMALL
from sb3_contrib import TQC
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from leapnav.envs import NavigateEnv
from leapnav.training import load_policy, network, policy_environment
from leapnav.training.policies.network import NavigationFeatures
from leapnav.training.policies.zips import load_zip

OFF_POLICY = (SAC, TD3, DDPG, TQC)


def make(algorithm, env, **arguments):
    more = {"buffer_size": 1} if algorithm in OFF_POLICY else {}
    return algorithm("MlpPolicy", env, seed=1, device="cpu", **more, **arguments)


@pytest.fixture
def observations(env):
    return np.array([env.reset(seed=seed)[0] for seed in range(6)])


def rewritten(path, name, change):
    """Replace a file in a zip."""
    with zipfile.ZipFile(path) as file:
        contents = {item: file.read(item) for item in file.namelist()}
    contents[name] = change(contents[name])
    with zipfile.ZipFile(path, "w") as file:
        for item, content in contents.items():
            file.writestr(item, content)


@pytest.mark.parametrize("algorithm", [PPO, A2C, *OFF_POLICY])
@pytest.mark.parametrize("arguments", [dict, lambda: {"policy_kwargs": network(SMALL)}], ids=["default", "navigation"])
def test_a_model_is_loaded_without_executing_it_and_acts_the_same(algorithm, arguments, env, observations, tmp_path):
    model = make(algorithm, env, **arguments())
    model.save(tmp_path / "model.zip")
    # Every pickled object is replaced by one that cannot be loaded.
    rewritten(tmp_path / "model.zip", "data", without_pickles)
    policy = load_policy(tmp_path / "model.zip", env)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)


def without_pickles(data):
    content = json.loads(data)
    for value in content.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = "no pickle"
    return json.dumps(content).encode()


@pytest.mark.parametrize("sensors", [{"observation": "state"}, {"observation": "map", "horizon": "free"}])
def test_an_observation_of_the_state_or_the_map_is_recognised(sensors, tmp_path):
    make(PPO, NavigateEnv("open", split="fresh", **sensors)).save(tmp_path / "model.zip")
    assert policy_environment(tmp_path / "model.zip") == sensors


def test_the_sensors_of_the_environment_are_derived_from_the_file(tmp_path):
    env = NavigateEnv("open", lidar_beams=20, lidar_range=5.0)
    make(PPO, env).save(tmp_path / "model.zip")
    assert policy_environment(tmp_path / "model.zip") == {"lidar_beams": 20, "lidar_range": 5.0}
    with pytest.raises(ValueError, match=r"its observations \(a Box of shape \(29,\)\) are not those"):
        load_policy(tmp_path / "model.zip", NavigateEnv("open"))
    env = NavigateEnv("open", observation="map", map_obstacles=3)
    make(PPO, env).save(tmp_path / "map.zip")
    with pytest.raises(ValueError, match=r"--env observation=map"):
        load_zip(tmp_path / "map.zip")
    policy, arguments = load_zip(tmp_path / "map.zip", {"observation": "map", "map_obstacles": 3})
    assert policy.observation_space == env.observation_space
    assert arguments == {"observation": "map", "map_obstacles": 3}


class OwnFeatures(NavigationFeatures):
    pass


@pytest.mark.parametrize("algorithm", [PPO, A2C, *OFF_POLICY])
def test_a_model_with_own_classes_is_loaded_only_if_it_is_trusted(algorithm, env, observations, tmp_path):
    model = make(algorithm, env, policy_kwargs={"features_extractor_class": OwnFeatures})
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"OwnFeatures is not supported; trust=True \(--trust\) loads it"):
        load_zip(tmp_path / "model.zip")
    policy, _ = load_zip(tmp_path / "model.zip", trust=True)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)


def test_damaged_and_foreign_files_are_refused_and_nothing_is_executed(env, tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    path = tmp_path / "model.zip"
    make(PPO, env).save(path)
    evil = io.BytesIO()
    th.save(Evil(), evil)
    rewritten(path, "policy.pth", lambda _: evil.getvalue())
    with pytest.raises(ValueError, match=r"model\.zip: not a model of Stable-Baselines3, or damaged"):
        load_policy(path)
    assert not (tmp_path / "executed").exists()
    make(PPO, env).save(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match="not a model of Stable-Baselines3, or damaged"):
        load_policy(path)
    make(PPO, env, policy_kwargs={"net_arch": [8]}).save(path)
    rewritten(
        path, "data", lambda data: data.replace(b'"net_arch": [\n            8\n', b'"net_arch": [\n            9\n')
    )
    with pytest.raises(ValueError, match="the weights are not those of the network that the file describes"):
        load_policy(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip: no such file"):
        load_policy("nowhere.zip")
