"""Export of policies to ONNX."""

import json

import numpy as np
import pytest
from helpers import SMALL
from onnxruntime import InferenceSession
from stable_baselines3 import PPO, SAC

from leapnav.cli import main
from leapnav.envs import NavigateEnv
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import ObservationLayout, observation_entries
from leapnav.training import load_policy, network, policy_environment
from leapnav.training.policies.onnx_export import export_onnx


def actions_of(path, observations):
    return InferenceSession(str(path)).run(["action"], {"observation": observations})[0]


def test_an_included_policy_acts_the_same_after_the_export(tmp_path, capsys):
    path = tmp_path / "clutter.onnx"
    assert main(["export", "clutter", "--onnx", str(path)]) == 0
    assert capsys.readouterr().out == f"wrote {path} and {path}.json\n"
    policy, env = load_policy("clutter"), NavigateEnv("clutter", **policy_environment("clutter"))
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        expected, _ = policy.predict(observation, deterministic=True)
        np.testing.assert_allclose(actions_of(path, observation[None])[0], expected, atol=1e-5)
        observation, *_ = env.step(expected)
    description = json.loads((tmp_path / "clutter.onnx.json").read_text())
    assert description["input"]["shape"] == ["N", 138] and len(description["observation"]) == 138
    assert description["observation"][4] == {"index": 4, "name": "goal.time_left", "unit": "s", "low": 0, "high": 10000}
    assert description["environment"]["lidar_beams"] == 64
    assert [entry["name"] for entry in description["action"]] == ["speed / max_speed", "turn_rate / max_turn_rate"]


def test_a_policy_with_momentum_is_a_function_of_its_observation(tmp_path):
    assert main(["export", "free-clutter", "--onnx", str(tmp_path / "free.onnx")]) == 0
    env = NavigateEnv("clutter", split="test", **policy_environment("free-clutter"))
    policy = load_policy("free-clutter")
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        expected, _ = policy.predict(observation, deterministic=True)
        np.testing.assert_allclose(actions_of(tmp_path / "free.onnx", observation[None])[0], expected, atol=1e-5)
        observation = env.step(expected)[0]


@pytest.mark.parametrize("arguments", [dict, lambda: {"policy_kwargs": network(SMALL)}], ids=["default", "navigation"])
@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_models_of_stable_baselines3_are_exported(algorithm, arguments, env, tmp_path):
    model = algorithm("MlpPolicy", env, device="cpu", **arguments())
    export_onnx(model, tmp_path / "model.onnx")
    observations = np.array([env.reset(seed=seed)[0] for seed in range(7)])
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(actions_of(tmp_path / "model.onnx", observations), expected, atol=1e-5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.onnx", "model.onnx.json"]


@pytest.mark.parametrize(
    "arguments",
    [{}, {"observation": "state"}, {"observation": "map", "map_obstacles": 2}, {"actuation": "motor"}],
)
def test_every_entry_of_an_observation_has_a_name_and_a_unit(arguments):
    settings = EnvironmentSettings(**arguments)
    entries = observation_entries(settings)
    assert len(entries) == ObservationLayout(settings).size == len({entry.name for entry in entries})
    env = NavigateEnv("polygons", **arguments)
    env.reset(seed=0)
    observation, *_ = env.step([1, 0])
    by_name = dict(zip([entry.name for entry in entries], observation, strict=True))
    assert by_name["goal.time_left"] == pytest.approx(env.scenario.horizon - 0.05, rel=1e-6)
    assert by_name["goal.needed_speed"] * by_name["goal.time_left"] == pytest.approx(
        np.hypot(by_name["goal.ahead"], by_name["goal.left"]), rel=1e-5
    )
    assert all(entry.unit in ("1", "m", "s", "m/s", "rad/s") for entry in entries)


def test_bad_arguments_are_named(env, tmp_path):
    model = PPO("MlpPolicy", env, device="cpu")
    with pytest.raises(ValueError, match=r"expected a name that ends in \.onnx"):
        export_onnx(model, tmp_path / "model.pt")
    with pytest.raises(ValueError, match=r"environment: has observations of 25 numbers, the policy's 41"):
        export_onnx(model, tmp_path / "model.onnx", {"lidar_beams": 16})
    with pytest.raises(ValueError, match="expected flat observations"):
        export_onnx(model, tmp_path / "model.onnx", {"dict_observation": True})
    assert not list(tmp_path.iterdir())
