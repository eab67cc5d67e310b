"""Observations with a history and the last action, and policies that use them."""

import json
import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from helpers import QUICK, SMALL
from onnxruntime import InferenceSession
from stable_baselines3 import PPO, SAC

from leapnav.cli import main
from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import frame_size, observation_entries, parts_of
from leapnav.envs.simulation.observer import Observer
from leapnav.experts import find_optimum
from leapnav.training import (
    DAgger,
    DAggerConfig,
    Dataset,
    behaviour_clone,
    load_policy,
    make_policy,
    make_vec_env,
    network,
    save_policy,
    warm_start,
)
from leapnav.training.config import DAggerRunConfig
from leapnav.training.environments.playing import PlayedEpisode
from leapnav.training.fit_settings import WarmStartConfig
from leapnav.training.learning.driving import DrivenEpisode
from leapnav.training.learning.takeovers import Labeller
from leapnav.training.policies.navigation_policy import MomentumSACPolicy, NavigationPolicy
from leapnav.training.policies.onnx_export import export_onnx
from leapnav.training.policies.symmetries import mirror, time_reversal

AGES = (0.4, 1.2, 2.8)
HISTORY = {"history": AGES, "previous_action": True}
LAGS = (8, 24, 56)  # of AGES at the default control period
FRAME = 9 + 2 + 32
MOMENTUM = {"previous_action": True, "horizon": "free"}


@pytest.fixture(scope="module")
def remembering():
    return NavigateEnv("open", split="fresh", **HISTORY)


def test_the_observation_contains_earlier_ones_and_the_last_action():
    env, plain = (NavigateEnv("clutter", **options) for options in (HISTORY, {}))
    rng = np.random.default_rng(0)
    for seed in (1, 2):  # the second episode does not remember the first
        frames, action = [], np.zeros(2)
        observation, current = env.reset(seed=seed)[0], plain.reset(seed=seed)[0]
        for step in range(70):
            assert observation in env.observation_space
            frame = np.concatenate([current[:9], action, current[9:]])
            frames.append(frame)
            expected = [frame, *(frames[max(step - lag, 0)] for lag in LAGS)]
            np.testing.assert_array_equal(observation, np.concatenate(expected).astype(np.float32))
            chosen = rng.uniform(-0.2, 0.2, 2).astype(np.float32)
            (observation, *_), (current, *_) = env.step(chosen), plain.step(chosen)
            action = chosen.astype(float)
    names = [entry.name for entry in observation_entries(env.settings)]
    assert len(names) == len(set(names)) == len(observation)
    assert names[FRAME] == "goal.ahead, 0.4 s before" and names[9] == "action[0]"
    assert frame_size(env.observation_space) == FRAME and parts_of(env.observation_space)["action"] == slice(9, 11)


def test_the_robots_of_a_vector_environment_remember_their_own_episodes():
    arguments = {"family": "clutter", "split": "test", "control_period": 0.2, **HISTORY}
    venv = gym.make_vec("leapnav/Navigate-v0", 3, vectorization_mode="vector_entry_point", **arguments)
    single = NavigateEnv(**arguments)
    actions = np.full((3, 2), [0.9, 0.3], np.float32)
    observations, _ = venv.reset(seed=0, options={"index": [0, 1, 2]})
    states = [single.reset(options={"index": index})[0] for index in range(3)]
    np.testing.assert_array_equal(observations, states)
    rows = []
    single.reset(options={"index": 1})
    for _ in range(60):
        observations, _, terminated, _, _ = venv.step(actions)
        rows.append(observations[1])
        if terminated[1]:
            break
        np.testing.assert_array_equal(single.step(actions[1])[0], observations[1])
    assert terminated[1]  # and the next episode begins with its own first observation
    first = venv.step(actions)[0][1].reshape(4, -1)
    assert (first == first[0]).all() and (first[0, 9:11] == 0).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"history": 0.4}, r"history: expected a sequence of ages in seconds, got 0\.4"),
        ({"history": (0.4, 0.4)}, r"history: expected increasing ages"),
        ({"history": (-1.0,)}, r"history: expected increasing ages in \(0, 500\] s, got \(-1\.0,\)"),
        ({"history": (0.01,)}, r"history: expected ages of at least one control period, got 0\.01"),
        ({"history": (0.025,)}, r"history: expected ages of at least one control period, got 0\.025"),
        ({"history": AGES, "dict_observation": True}, r"history: expected the default, because .* dictionaries"),
        ({"previous_action": 1}, "previous_action: expected True or False, got 1"),
    ],
)
def test_bad_histories_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        NavigateEnv(**arguments)


def test_a_goal_conditioned_environment_has_no_history():
    with pytest.raises(ValueError, match="previous_action: expected the default, because observations are those of a"):
        gym.make("leapnav/NavigateGoal-v0", previous_action=True)


def test_a_dataset_is_observed_as_its_episodes_were(dataset, remembering):
    """The history of the expert's samples is that of an environment in which its actions are executed."""
    observed = dataset.observed(remembering.settings)
    assert observed.observations.shape[1] == 4 * FRAME
    for episode in (0, 3):
        rows = observed.episodes == episode
        env = NavigateEnv(scenario=Scenario.from_json(observed.scenarios[episode]), **HISTORY)
        found = [env.reset()[0], *(env.step(action)[0] for action in observed.executed[rows][:60])]
        np.testing.assert_allclose(observed.observations[rows][:61], found[: rows.sum()], atol=2e-3)


def test_a_symmetry_transforms_all_frames_and_the_last_action(dataset, remembering):
    observed = dataset.observed(remembering.settings)
    plain, full = th.as_tensor(dataset.observations), th.as_tensor(observed.observations)
    actions = th.as_tensor(dataset.actions)
    for symmetry in (mirror, time_reversal):
        expected, moved = symmetry(EnvironmentSettings())(plain, actions)
        found, same = symmetry(remembering.settings)(full, actions)
        assert th.equal(moved, same)
        frames = found.reshape(len(found), 4, FRAME)
        assert th.equal(th.cat([frames[:, 0, :9], frames[:, 0, 11:]], dim=1), expected)
        assert th.equal(frames[1:, 0, 9:11], th.where((full[1:, 9:11] == 0).all(1, True), 0.0, moved[:-1]))
        assert th.equal(symmetry(remembering.settings)(found, moved)[0], full)


def test_the_displacements_are_those_of_the_robot():
    scenario = sample_scenario("clutter", 3)
    poses = np.array(scenario.start) + np.linspace(0, 1, 60)[:, None] * [0.8, -0.5, 1.1]
    observer, times = Observer(EnvironmentSettings(history=AGES)), 0.05 * np.arange(60)
    observations = observer.observe([scenario] * 60, poses, times, starts=np.zeros(60, dtype=int))
    env = NavigateEnv(scenario=scenario, history=AGES)
    extractor = make_policy(env.observation_space, env.action_space, 0, SMALL).pi_features_extractor
    with th.no_grad():
        found = extractor(th.as_tensor(observations[-1:]))[0, -4 * len(LAGS) :].reshape(4, len(LAGS)).numpy()
    x, y, heading = poses[-1]
    for k, lag in enumerate(LAGS):
        moved, turned = poses[59 - lag][:2] - (x, y), poses[59 - lag][2] - heading
        ahead = np.cos(heading) * moved[0] + np.sin(heading) * moved[1]
        left = -np.sin(heading) * moved[0] + np.cos(heading) * moved[1]
        assert found[:, k] == pytest.approx([ahead / 2, left / 2, np.sin(turned), np.cos(turned) - 1], abs=1e-4)


def test_an_observer_is_copied_to_other_processes_without_its_arrays():
    scenario, observer = sample_scenario("clutter", 3), Observer(EnvironmentSettings(history=AGES))
    stored = pickle.dumps(observer)
    poses = np.array(scenario.start) + np.linspace(0, 1, 9)[:, None] * [0.8, -0.5, 1.1]
    arguments = [scenario] * 9, poses, 0.05 * np.arange(9)
    assert len(stored) < 10_000
    np.testing.assert_array_equal(pickle.loads(stored).observe(*arguments), observer.observe(*arguments))


@pytest.mark.parametrize("algorithm", [PPO, pytest.param(SAC, marks=pytest.mark.slow)])
def test_learners_with_a_history_are_warm_started_trained_saved_and_exported(algorithm, dataset, tmp_path):
    venv = make_vec_env(n_envs=2, family="open", split="fresh", **HISTORY)
    steps = {"n_steps": 64} if algorithm is PPO else {"learning_starts": 150}
    model = algorithm("MlpPolicy", venv, policy_kwargs=network(SMALL), batch_size=64, seed=0, device="cpu", **steps)
    observed = dataset.observed(venv.get_attr("settings")[0])
    config = WarmStartConfig(critic_epochs=1, slopes=200)
    result = warm_start(model, observed, config, cloning=replace(QUICK, epochs=6), progress=False)
    assert result.cloning[-1].training < 0.8 * result.cloning[0].training
    assert np.isfinite([result.value_error, result.slope_error]).all()
    model.learn(250 if algorithm is SAC else 128)
    save_policy(model, tmp_path / "policy", HISTORY)
    loaded = load_policy(tmp_path / "policy", NavigateEnv("open", **HISTORY))
    observations = observed.observations[:50]
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(loaded.predict(observations, deterministic=True)[0], expected, atol=1e-6)
    described = json.loads(export_onnx(tmp_path / "policy", tmp_path / "policy.onnx").read_text())
    session = InferenceSession(str(tmp_path / "policy.onnx"))
    np.testing.assert_allclose(session.run(["action"], {"observation": observations})[0], expected, atol=1e-5)
    assert described["environment"]["history"] == list(AGES)


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_the_policy_that_is_trained_is_the_one_that_is_evaluated(kind):
    """With momentum, the mean of the actions during training is the deterministic action."""
    env = NavigateEnv("open", split="fresh", **MOMENTUM)
    policy_class = NavigationPolicy if kind is PPO else MomentumSACPolicy
    options = {**network(SMALL), "effort_weights": (4.0, 4.5)}
    steps = {"n_steps": 64, "batch_size": 64} if kind is PPO else {"learning_starts": 100}
    model = kind(policy_class, env, policy_kwargs=options, device="cpu", seed=1, **steps)
    observations = np.stack([env.reset(seed=seed)[0] for seed in range(4)])
    observations[1:, 4:6] = [[0.5, 0.1], [-0.3, 0.2], [0.1, -0.6]]  # the last actions
    actions = model.predict(observations, deterministic=True)[0]
    network_alone = observations.copy()
    network_alone[:, 4:6] = 0.0
    assert np.abs(actions - model.predict(network_alone, deterministic=True)[0])[1:].max() > 0.1
    assert (actions**2 @ (4.0, 4.5) >= 1 - 1e-4).all()  # the effort of an optimum
    batch = th.as_tensor(observations)
    with th.no_grad():
        if kind is PPO:
            means = model.policy.get_distribution(batch).distribution.mean
        else:
            means = th.tanh(model.policy.actor.get_action_dist_params(batch)[0])
    np.testing.assert_allclose(np.clip(means, -1, 1), actions, atol=1e-5)
    model.learn(150 if kind is SAC else 128)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_momentum_needs_the_last_action(env):
    with pytest.raises(ValueError, match="effort_weights: expected None for observations without the last action"):
        make_policy(env.observation_space, env.action_space, effort_weights=(1.0, 1.0))


def test_the_history_of_a_takeover_is_the_learners():
    scenario = sample_scenario("clutter", 7)
    poses = np.linspace(scenario.start, scenario.goal, 121)
    actions = np.random.default_rng(0).uniform(-1, 1, (120, 2)).astype(np.float32)
    played = PlayedEpisode(
        poses,
        actions,
        np.zeros(121),
        episode_return=0.0,
        clearance=0.0,
        duration=6.0,
        success=False,
        collision=True,
        truncated=False,
        goal_distance=0.0,
        heading_error=0.0,
    )
    settings = EnvironmentSettings(**HISTORY)
    parts = Labeller(settings, 1.0, "low").label(DrivenEpisode(scenario, played), np.random.default_rng(0))
    seen = Observer(EnvironmentSettings()).observe([scenario] * 121, poses, 0.05 * np.arange(121))
    assert len(parts) > 3
    for part in parts:
        step = round((scenario.horizon - Scenario.from_json(part.scenarios[0]).horizon) / 0.05)
        frames = part.observations.reshape(len(part), 4, FRAME)
        for row in (0, 5):
            np.testing.assert_allclose(frames[row, 0, 9:11], actions[step - 1] if row == 0 else part.actions[4])
            for k, lag in enumerate(LAGS, start=1):
                if row < lag:
                    earlier = max(step + row - lag, 0)
                    frame = np.concatenate([frames[row, k, :9], frames[row, k, 11:]])
                    np.testing.assert_allclose(frame, seen[earlier], atol=1e-4)


def test_dagger_aggregates_for_a_policy_with_a_history(remembering, dataset, tmp_path):
    policy = make_policy(remembering.observation_space, remembering.action_space, 0, SMALL)
    observed = dataset.observed(remembering.settings)
    behaviour_clone(policy, observed, QUICK, progress=False)
    config = DAggerConfig(rounds=1, max_failures=3, max_episodes=8, lead=1.0)
    arguments = {"cloning": QUICK, "dataset": observed, "folder": tmp_path}
    (done,) = DAgger(policy, "open", config, environment=HISTORY, robots=4, **arguments).run(progress=False)
    assert len(Dataset.load(tmp_path / "round-001.npz")) == done.samples > 0


def test_runs_with_a_history(tmp_path, capsys):
    run = tmp_path / "run"
    arguments = ["--family", "open", "--scenarios", "8", "--hidden", "16", "16", "--evaluation-scenarios", "2"]
    arguments += ["--cloning.epochs", "1", "--observation", "lidar"]
    assert main(["train", "bc", *arguments, "--history", "0.4", "1.2", "--out", str(run)]) == 0
    assert json.loads((run / "policy.json").read_text())["environment"]["history"] == [0.4, 1.2]
    assert main(["evaluate", str(run), "--family", "open", "--count", "3"]) == 0
    capsys.readouterr()
    assert DAggerRunConfig.tuned("open", policy=run, out=tmp_path).history == (0.4, 1.2)
    sizes = {"total-timesteps": 600, "n-envs": 2, "n-steps": 64, "batch-size": 64, "evaluation-scenarios": 2}
    short = [word for name, size in sizes.items() for word in (f"--{name}", str(size))] + ["--hidden", "16", "16"]
    started = ["train", "ppo", "--family", "open", "--warm-start", str(run), *short]
    assert main([*started, "--out", str(tmp_path / "ppo")]) == 0
    assert json.loads((tmp_path / "ppo" / "policy.json").read_text())["environment"]["history"] == [0.4, 1.2]
    assert main([*started, "--history", "0.4", "--out", str(tmp_path / "other")]) == 2
    assert "history" in capsys.readouterr().err


def test_samples_with_another_control_period_keep_their_history():
    scenario = sample_scenario("open", 4)
    settings = EnvironmentSettings(history=(0.4,), control_period=0.2)
    samples = Labeller(settings, 3.0, "low").samples(scenario, find_optimum(scenario, "low"))
    fewer = samples.observed(replace(settings, lidar_beams=16)).observations
    size = fewer.shape[1] // 2
    np.testing.assert_array_equal(fewer[2:, size:], fewer[:-2, :size])  # 0.4 s are two control periods
    assert np.abs(fewer[2:, size:] - fewer[2:, :size]).max() > 0.1
