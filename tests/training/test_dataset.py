import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from helpers import QUICK, fresh
from stable_baselines3 import PPO

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.training import Dataset, behaviour_clone, make_vec_env
from leapnav.training.policies.symmetries import mirror, time_reversal


def test_a_dataset_is_the_same_from_a_folder_and_from_demonstrations(demonstrated, dataset):
    demonstrations = load_demonstrations(demonstrated)
    other = Dataset.of(demonstrations)
    assert len(dataset) == len(other) == sum(len(d.actions) for d in demonstrations)
    for name in ("observations", "actions", "returns", "costates", "states", "times", "executed", "rewards"):
        np.testing.assert_allclose(getattr(dataset, name), getattr(other, name), atol=1e-9, err_msg=name)
    assert dataset.course_texts == other.course_texts
    assert (dataset.halves == [2.0, 3.0]).all()
    assert (dataset.weights == [1.0, 0.5]).all()
    first = demonstrations[0]
    np.testing.assert_allclose(dataset.returns[: len(first.actions)], -first.cost_to_go[:-1])


def test_datasets_are_joined_saved_and_loaded(dataset, tmp_path):
    parts = dataset[:100], dataset[100:300]
    joined = Dataset.joined(parts)
    np.testing.assert_array_equal(joined.observations, dataset.observations[:300])
    scenarios = [joined.scenarios[i] for i in joined.episodes]
    assert scenarios == [dataset.scenarios[i] for i in dataset.episodes[:300]]
    joined.save(tmp_path / "part.npz")
    loaded = Dataset.load(tmp_path / "part.npz")
    np.testing.assert_array_equal(loaded.costates, joined.costates)
    assert loaded.scenarios == joined.scenarios
    (tmp_path / "part.npz").write_bytes((tmp_path / "part.npz").read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"part\.npz: not a dataset file"):
        Dataset.load(tmp_path / "part.npz")


def test_datasets_that_cannot_be_learned_from_are_refused(demonstrated, dataset, tmp_path, env, monkeypatch):
    import shutil

    with pytest.raises(ValueError, match="expected at least one"):
        Dataset.of([])
    with pytest.raises(FileNotFoundError, match="expected one Minari dataset"):
        Dataset.of(tmp_path)
    other = tmp_path / "other"
    shutil.copytree(demonstrated, other)
    metadata = next(other.glob("**/metadata.json"))
    content = json.loads(metadata.read_text())
    content["env_spec"] = content["env_spec"].replace("Navigate-v0", "Navigate-v1")
    metadata.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="expected a dataset of leapnav/Navigate-v0, got one of leapnav/Navigate-v1"):
        Dataset.of(other)
    fewer = gym.make("leapnav/Navigate-v0", lidar_beams=16)
    with pytest.raises(ValueError, match="its observations have 41 numbers, the policy's 25"):
        behaviour_clone(fresh(fewer), dataset, QUICK, progress=False)


@pytest.mark.parametrize("fov", [2 * math.pi, 4.0])
def test_mirroring_and_time_reversal_are_symmetries_of_the_environment(fov):
    fields = sample_scenario("clutter", 5).to_dict()

    def mirrored(pose):
        return [10.0 - pose[0], pose[1], math.pi - pose[2]]

    def rotated(pose):
        return [pose[0], pose[1], pose[2] + math.pi]

    transformed = {
        mirror: {
            **fields,
            "start": mirrored(fields["start"]),
            "goal": mirrored(fields["goal"]),
            "obstacles": [
                {"circle": {**o["circle"], "center": [10.0 - o["circle"]["center"][0], o["circle"]["center"][1]]}}
                for o in fields["obstacles"]
            ],
        },
        time_reversal: {**fields, "start": rotated(fields["start"]), "goal": rotated(fields["goal"])},
    }
    if fov < 2 * math.pi:
        del transformed[time_reversal]  # the robot does not see what is behind it
    for transform, other_fields in transformed.items():
        env = NavigateEnv(scenario=Scenario.from_dict(fields), lidar_fov=fov)
        other = NavigateEnv(scenario=Scenario.from_dict(other_fields), lidar_fov=fov)
        observation, other_observation = env.reset()[0], other.reset()[0]
        for step in range(20):
            action = np.array([0.2, 0.3 * math.cos(step)], np.float32)
            inputs, targets = transform(env.settings)(th.as_tensor(observation)[None], th.as_tensor(action)[None])
            assert inputs[0].numpy() == pytest.approx(other_observation, abs=1e-4)
            observation, reward, *_ = env.step(action)
            other_observation, other_reward, *_ = other.step(targets[0].numpy())
            assert other_reward == pytest.approx(reward, rel=1e-6)


def test_the_velocities_of_obstacles_have_the_symmetries_too():
    fields = sample_scenario("crossing", 5).to_dict()
    (x, y, heading), (goal_x, goal_y, goal_heading) = fields["start"], fields["goal"]

    def reflected(obstacle):
        circle, (vx, vy) = obstacle["circle"], obstacle["velocity"]
        return {
            "circle": {**circle, "center": [10.0 - circle["center"][0], circle["center"][1]]},
            "velocity": [-vx, vy],
        }

    ends = {"start": [10.0 - x, y, math.pi - heading], "goal": [10.0 - goal_x, goal_y, math.pi - goal_heading]}
    turned = {"start": [x, y, heading + math.pi], "goal": [goal_x, goal_y, goal_heading + math.pi]}
    transformed = {mirror: {**ends, "obstacles": list(map(reflected, fields["obstacles"]))}, time_reversal: turned}
    for transform, changes in transformed.items():
        env, other = (
            NavigateEnv(scenario=Scenario.from_dict(one), observation="geodesic", lidar_beams=64)
            for one in (fields, {**fields, **changes})
        )
        observation, expected = env.reset()[0], other.reset()[0]
        for _ in range(20):
            action = np.array([0.2, 0.1], np.float32)
            inputs, targets = transform(env.settings)(th.as_tensor(observation)[None], th.as_tensor(action)[None])
            found, part = inputs[0].numpy(), env._simulator.layout.parts["velocities"]
            assert np.abs(expected[part]).max() > 0.0
            close = np.abs(found - expected) < 1e-3
            assert close[:9].all() and close.mean() > 0.97  # a beam along the rim of a disc may miss it
            observation, expected = env.step(action)[0], other.step(targets[0].numpy())[0]


def test_time_reversal_needs_an_even_number_of_beams():
    with pytest.raises(ValueError, match="even number of lidar beams, got 3"):
        time_reversal(EnvironmentSettings(lidar_beams=3))
    with pytest.raises(ValueError, match="lidar_fov of 2 pi rad, got 4"):
        time_reversal(EnvironmentSettings(lidar_fov=4.0))


def test_samples_can_be_seen_with_other_sensors(demonstrated, tmp_path):
    """Observations can be computed for another lidar; the file contains its settings."""
    found = Dataset.of(demonstrated)
    seen = found.observed(EnvironmentSettings(lidar_beams=64))
    assert seen.observations.shape == (len(found), 9 + 64)
    # Every second of the 64 beams is one of the 32.
    assert seen.observations[:, 9::2] == pytest.approx(found.observations[:, 9:], abs=1e-4)
    assert seen.observations[:, :9] == pytest.approx(found.observations[:, :9], abs=1e-4)
    assert found.observed(found.settings) is found
    model = PPO("MlpPolicy", make_vec_env(n_envs=1, lidar_beams=64), n_steps=2, batch_size=2)
    assert found.observed(model).observations.tobytes() == seen.observations.tobytes()
    seen.save(tmp_path / "seen.npz")
    assert Dataset.load(tmp_path / "seen.npz").settings == EnvironmentSettings(lidar_beams=64)
    # Settings that do not belong to the sensors are ignored.
    assert found.observed(EnvironmentSettings(reward="shaped", control_period=0.2)) is found
    with pytest.raises(ValueError, match="actuation: expected that of the samples, 'velocity', got 'motor'"):
        found.observed(EnvironmentSettings(actuation="motor"))
    with pytest.raises(ValueError, match="datasets: lidar_beams: expected the same for all, got 32 and 64"):
        Dataset.joined([found, seen])
