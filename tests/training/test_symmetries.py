"""Policies whose actions are equivariant under the symmetries of the robot, with and without a mixture."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from onnxruntime import InferenceSession
from stable_baselines3 import PPO, SAC

from leapnav.envs import NavigateEnv
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts import rollout
from leapnav.training import (
    BCConfig,
    CloningConfig,
    PPOConfig,
    WarmStartConfig,
    load_policy,
    save_policy,
    train_bc,
    train_ppo,
    warm_start,
)
from leapnav.training.config import read_config
from leapnav.training.policies.architecture import with_symmetries
from leapnav.training.policies.navigation_policy import NavigationPolicy
from leapnav.training.policies.network import make_policy, network
from leapnav.training.policies.onnx_export import export_onnx
from leapnav.training.policies.symmetries import symmetries

ENVIRONMENTS = {
    "unicycle": {},
    "history": {"history": (0.4, 1.2)},
    "geodesic": {"observation": "geodesic", "velocities": True},
    "differential_drive": {"robot": "differential_drive"},
    "car": {"robot": "car"},
    "motor": {"actuation": "motor"},
    "dynamic_unicycle": {"robot": "dynamic_unicycle"},
    "free": {"horizon": "free", "previous_action": True},
}


def environment(**arguments):
    return NavigateEnv("open", split="fresh", lidar_beams=16, **arguments)


def symmetric_policy(env, hidden=(16, 16), **arguments):
    found = symmetries(env.settings, [env.source.robot])
    return make_policy(env.observation_space, env.action_space, 0, hidden, symmetries=found, **arguments)


def observations_of(env):
    """Return observations of an episode with random actions."""
    env.action_space.seed(0)
    rows = [env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(20))]
    return th.as_tensor(np.array(rows))


def actions_of(policy, observations):
    return th.as_tensor(policy.predict(observations.numpy(), deterministic=True)[0])


@pytest.mark.parametrize("components", [1, 3])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_transformed_observation_leads_to_the_transformed_action(name, components):
    env = environment(**ENVIRONMENTS[name])
    weights = (1.0, 1.0) if name == "free" else None
    policy = symmetric_policy(env, effort_weights=weights, components=components)
    observations = observations_of(env)
    actions = actions_of(policy, observations)
    assert actions.abs().max() > 1e-4
    assert len(policy.symmetries) == 2
    for transformation in policy.symmetries:
        found, expected = transformation(observations, actions)
        assert th.equal(transformation(found, expected)[0], observations)
        th.testing.assert_close(actions_of(policy, found), expected, atol=1e-6, rtol=1e-4)


def test_what_is_not_symmetric():
    robot = environment().source.robot
    assert len(symmetries(EnvironmentSettings(lidar_beams=16), [robot])) == 2
    for arguments, count in (
        ({"lidar_beams": 15}, 1),
        ({"lidar_fov": 4.0}, 1),
        ({"observation": "map"}, 0),
        ({"dict_observation": True}, 0),
        ({"goal_conditioned": True}, 0),
    ):
        assert len(symmetries(EnvironmentSettings(**arguments), [robot])) == count
    limited = type(robot)(speed=(0.0, 1.0), turn_rate=(-1.0, 1.0))
    assert len(symmetries(EnvironmentSettings(), [limited])) == 1
    env = environment()
    env.action_space.high[:] = 2.0
    with pytest.raises(ValueError, match="symmetries: expected none for actions with other bounds than -1 and 1"):
        symmetric_policy(env)


def test_files_contain_the_symmetries_and_the_components(tmp_path):
    env = environment()
    found = symmetries(env.settings, [env.source.robot])
    options = {**network((16, 16)), "symmetries": found, "components": 3}
    model = PPO(NavigationPolicy, env, policy_kwargs=options, n_steps=32, batch_size=32, device="cpu", seed=0)
    model.learn(32)
    observations = observations_of(env)
    expected = actions_of(model.policy, observations)
    save_policy(model, tmp_path / "policy")
    model.save(tmp_path / "model.zip")
    for saved in (tmp_path / "policy", tmp_path / "model.zip"):
        loaded = load_policy(saved)
        assert loaded.symmetries == model.policy.symmetries
        assert loaded.components == 3
        th.testing.assert_close(actions_of(loaded, observations), expected)
    export_onnx(tmp_path / "policy", tmp_path / "policy.onnx")
    session = InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    (exported,) = session.run(None, {"observation": observations.numpy()})
    th.testing.assert_close(th.as_tensor(exported), expected, atol=1e-5, rtol=0.0)
    again = PPO.load(tmp_path / "model.zip", device="cpu")
    th.testing.assert_close(actions_of(again.policy, observations), expected)


def test_symmetries_are_added_to_a_policy():
    env = environment()
    found = symmetries(env.settings, [env.source.robot])
    plain = make_policy(env.observation_space, env.action_space, 0, (16, 16))
    symmetric, observations = with_symmetries(plain, found), observations_of(env)
    expected = actions_of(plain, observations)
    for transformation in found:
        images, _ = transformation(observations, expected)
        _, back = transformation(images, actions_of(plain, images))
        assert not th.allclose(back, expected, atol=1e-4)
    th.testing.assert_close(actions_of(symmetric, observations), actions_of(symmetric_policy(env), observations))
    other = symmetries(replace(env.settings, lidar_beams=8), [env.source.robot])
    with pytest.raises(ValueError, match=r"symmetries: expected those of observations of shape \(25,\), got \(17,\)"):
        with_symmetries(plain, other)
    with pytest.raises(ValueError, match="symmetries: expected none for a policy of kind 'sac'"):
        with_symmetries(SAC("MlpPolicy", env, policy_kwargs=network((16, 16)), device="cpu").policy, found)


def test_runs_of_imitation_are_symmetric_and_ppo_starts_from_them(tmp_path):
    cloning = CloningConfig(epochs=1, validation_share=0.0)
    settings = {"family": "open", "hidden": (16, 16), "lidar_beams": 16, "evaluation_scenarios": 2, "cloning": cloning}
    for symmetric in (True, False):
        chosen = {"symmetric": symmetric, "components": 3 if symmetric else 1}
        config = BCConfig(out=tmp_path / str(symmetric), observation="lidar", scenarios=2, **chosen, **settings)
        train_bc(config, progress=False)
        clone = load_policy(config.out)
        assert bool(getattr(clone, "symmetries", ())) == symmetric
        assert getattr(clone, "components", 1) == chosen["components"]
    start = tmp_path / "True"
    options = {"n_envs": 2, "n_steps": 8, "batch_size": 16, "total_timesteps": 16, "warm_start": (start,)}
    config = PPOConfig(out=tmp_path / "ppo", learning_rate=1e-12, **options, **settings)
    train_ppo(config, progress=False)
    trained, clone = load_policy(config.out), load_policy(start)
    observations = observations_of(environment())
    assert trained.symmetries == clone.symmetries
    assert trained.components == 3
    options |= {"actuation": "motor", "start": WarmStartConfig(critic=False)}
    train_ppo(PPOConfig(out=tmp_path / "motor", **options, **settings), progress=False)
    assert len(load_policy(tmp_path / "motor").symmetries) == 2
    th.testing.assert_close(actions_of(trained, observations), actions_of(clone, observations), atol=1e-4, rtol=1e-4)


def test_a_run_of_an_earlier_version_is_resumed(tmp_path):
    cloning = CloningConfig(epochs=1, validation_share=0.0)
    settings = {"family": "open", "hidden": (16, 16), "lidar_beams": 16, "evaluation_scenarios": 2, "cloning": cloning}
    config = BCConfig(out=tmp_path / "run", observation="lidar", scenarios=2, symmetric=False, **settings)
    first = train_bc(config, progress=False)
    path = config.out / "config.json"
    stored = json.loads(path.read_text())
    for name in ("symmetric", "components"):
        del stored["config"][name]
    path.write_text(json.dumps(stored))
    assert replace(read_config(config.out)[1], out=config.out) == config
    again = train_bc(replace(config, resume=True), progress=False)
    costs = [[episode.cost for episode in one.episodes] for one in (*first, *again)]
    assert costs[0] == costs[1]


def test_a_warm_start_without_the_symmetries_of_the_policy_says_so(tmp_path):
    rollout("open", 2, tmp_path, progress=False)
    env = environment()
    start = symmetric_policy(env)
    for policy, options, expected in (
        ("MlpPolicy", {}, pytest.warns(UserWarning, match="policy: its actions are equivariant under symmetries")),
        (NavigationPolicy, {"symmetries": start.symmetries}, nullcontext()),
    ):
        model = PPO(policy, env, policy_kwargs={**network((16, 16)), **options}, n_steps=8, batch_size=8, device="cpu")
        with expected:
            warm_start(model, tmp_path, WarmStartConfig(critic=False), policy=start, progress=False)
