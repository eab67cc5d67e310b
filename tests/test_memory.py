"""Policies with a memory of stacked observations."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from helpers import QUICK, SMALL
from onnxruntime import InferenceSession

from leapnav.cli import main
from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observer import Observer
from leapnav.training import (
    DAgger,
    DAggerConfig,
    Dataset,
    behaviour_clone,
    load_policy,
    make_policy,
    make_vec_env,
    policy_environment,
    save_policy,
)
from leapnav.training.config import DAggerRunConfig
from leapnav.training.learning.cloning import Cloning
from leapnav.training.learning.driving import DrivenEpisode
from leapnav.training.learning.samples import samples_class
from leapnav.training.learning.takeovers import Labeller
from leapnav.training.policies.actors import copy_actor
from leapnav.training.policies.memory import LAGS, history_length, stack_frames
from leapnav.training.policies.onnx_export import export_onnx


def with_memory(env, kind="stack", seed=0):
    return make_policy(env.observation_space, env.action_space, seed, SMALL, memory=kind)


def observed(env, seed, count):
    """Return the first observations of an episode with random actions."""
    rng = np.random.default_rng(seed)
    observations = [env.reset(seed=seed)[0]]
    while len(observations) < count:
        observations.append(env.step(rng.uniform(-0.3, 0.3, 2).astype(np.float32))[0])
    return np.array(observations)


def act(policy, observations, starts=None):
    """Return the actions (T, N, m) for the observations (T, N, d) of robots."""
    state, actions = None, []
    for step, row in enumerate(observations):
        start = None if starts is None else starts[step]
        action, state = policy.predict(row, state, start, deterministic=True)
        actions.append(action)
    return np.array(actions)


def test_the_memory_begins_again_with_each_episode(env):
    policy = with_memory(env)
    one, other, third = (observed(env, seed, 70) for seed in range(3))
    alone = [act(policy, episode) for episode in (one, other, third)]
    # The second robot begins its third episode after 30 steps of the second.
    second = np.concatenate([other[:30], third[:40]])
    starts = np.zeros((70, 2), dtype=bool)
    starts[0], starts[30, 1] = True, True
    together = act(policy, np.stack([one, second], axis=1), starts)
    np.testing.assert_allclose(together[:, 0], alone[0], atol=1e-6)
    np.testing.assert_allclose(together[:30, 1], alone[1][:30], atol=1e-6)
    np.testing.assert_allclose(together[30:, 1], alone[2][:40], atol=1e-6)
    without = np.array([policy.predict(row, deterministic=True)[0] for row in one])
    assert np.abs(without - alone[0]).max() > 1e-3  # the memory matters


def test_a_policy_learns_from_what_it_observes_while_driving(env, dataset):
    """The inputs of a fit are those with which `predict` computes actions, also where only later steps have labels."""
    policy = with_memory(env)
    episodes = dataset[np.isin(dataset.episodes, (3, 4, 5))]
    unlabelled = episodes.episodes == 4
    unlabelled[np.flatnonzero(unlabelled)[-20:]] = False
    actions = np.where(unlabelled[:, None], np.nan, episodes.actions)
    samples = samples_class(policy)(replace(episodes, actions=actions), np.ones(len(episodes), bool), policy.device)
    assert len(samples) == (~unlabelled).sum()
    with th.no_grad():
        batches = [samples.batch(chosen) for chosen in samples.in_order(10_000)]
        found = th.cat([batch.actions_of(policy) for batch in batches]).numpy()
    expected = [act(policy, episodes.observations[episodes.episodes == k]) for k in (3, 4, 5)]
    np.testing.assert_allclose(np.clip(found, -1, 1), np.concatenate(expected)[~unlabelled], atol=1e-5)
    np.testing.assert_allclose(th.cat([batch.actions for batch in batches]), episodes.actions[~unlabelled])
    shuffled = list(samples.shuffled(100, th.Generator().manual_seed(0)))
    assert len(shuffled) > 1
    assert sum(len(samples.batch(chosen)) for chosen in shuffled) == len(samples)


def test_the_displacements_are_those_of_the_robot():
    scenario = sample_scenario("clutter", 3)
    poses = np.array(scenario.start) + np.linspace(0, 1, 60)[:, None] * [0.8, -0.5, 1.1]
    observations = Observer(EnvironmentSettings()).observe([scenario] * 60, poses, 0.05 * np.arange(60))
    env = NavigateEnv(scenario=scenario)
    extractor = with_memory(env, "stack").pi_features_extractor
    frames = stack_frames(observations[-1:][None], observations[None, :-1])
    with th.no_grad():
        found = extractor(th.as_tensor(frames))[0, -4 * len(LAGS) :].reshape(4, len(LAGS)).numpy()
    x, y, heading = poses[-1]
    for k, lag in enumerate(LAGS):
        moved, turned = poses[59 - lag][:2] - (x, y), poses[59 - lag][2] - heading
        ahead = np.cos(heading) * moved[0] + np.sin(heading) * moved[1]
        left = -np.sin(heading) * moved[0] + np.cos(heading) * moved[1]
        assert found[:, k] == pytest.approx([ahead / 2, left / 2, np.sin(turned), np.cos(turned) - 1], abs=1e-4)


def test_a_policy_is_fitted_with_the_symmetries(env, dataset):
    policy = with_memory(env)
    losses = behaviour_clone(policy, dataset, replace(QUICK, epochs=6), progress=False)
    assert losses[-1].training < 0.7 * losses[0].training
    assert losses[-1].validation < 1.0


def test_the_schedule_of_a_fit_has_as_many_steps_as_there_are_batches(env, dataset):
    fit = Cloning(with_memory(env), dataset, replace(QUICK, batch_size=150))
    batches = []
    fit.run_epoch(lambda: batches.append(1))
    assert len(batches) == fit.batches


def test_a_policy_with_stacked_frames_is_loaded_by_stable_baselines(env, tmp_path):
    policy = with_memory(env, "stack")
    policy.save(tmp_path / "policy.pt")
    observations = observed(env, 5, 65)
    np.testing.assert_array_equal(
        act(type(policy).load(tmp_path / "policy.pt"), observations), act(policy, observations)
    )


@pytest.mark.parametrize("half", [False, True])
def test_a_policy_with_memory_is_saved_and_exported(half, env, tmp_path):
    policy = with_memory(env)
    save_policy(policy, tmp_path / "policy", half=half)
    loaded = load_policy(tmp_path / "policy", env)
    assert type(loaded) is type(policy) and policy_environment(tmp_path / "policy")["lidar_beams"] == 32
    observations = observed(env, 5, 65)
    expected = act(loaded, observations)
    np.testing.assert_allclose(expected, act(policy, observations), atol=1e-2 if half else 1e-6)
    described = json.loads(export_onnx(loaded, tmp_path / "policy.onnx").read_text())
    session = InferenceSession(str(tmp_path / "policy.onnx"))
    states = {"history": np.zeros((1, *described["history"]["shape"][1:]), np.float32)}
    assert described["history"]["start"] == "the first observation in every row"
    states["history"][:] = observations[0]
    names = ["action", *(described[name]["next"] for name in states)]
    for observation, action in zip(observations, expected, strict=True):
        found, *following = session.run(names, {"observation": observation[None], **states})
        np.testing.assert_allclose(found[0], action, atol=1e-5)
        states = dict(zip(states, following, strict=True))


def test_the_learners_history_precedes_each_takeover(env):
    scenario = sample_scenario("clutter", 7)
    poses = np.linspace(scenario.start, scenario.goal, 121)
    episode = DrivenEpisode(scenario, poses, np.zeros(len(poses)), False, True)
    settings, length = EnvironmentSettings(), history_length(with_memory(env))
    labelled = Labeller(settings, DAggerConfig(lead=1.0), quick=True, history=length)
    plain = Labeller(settings, DAggerConfig(lead=1.0), quick=True)
    parts, without = (one.label(episode, np.random.default_rng(0)) for one in (labelled, plain))
    assert len(parts) == len(without) > 3
    seen = Observer(settings).observe([scenario] * len(poses), poses, 0.05 * np.arange(len(poses)))
    for part, own in zip(parts, without, strict=True):
        before = len(part) - len(own)
        step = round((scenario.horizon - Scenario.from_json(part.scenarios[0]).horizon) / 0.05)
        assert before == min(step, length) and not part.labelled[:before].any() and part.labelled[before:].all()
        np.testing.assert_allclose(part.observations[:before], seen[step - before : step], atol=1e-4)
        np.testing.assert_array_equal(part.observations[before:], own.observations)
        np.testing.assert_allclose(part.times[:before], 0.05 * np.arange(-before, 0))
        assert np.isnan(part.returns[:before]).all() and (part.episodes == 0).all()


def test_dagger_aggregates_for_a_policy_with_memory(env, dataset, tmp_path):
    policy = with_memory(env)
    behaviour_clone(policy, dataset, QUICK, progress=False)
    venv = make_vec_env(n_envs=4, family="open", split="fresh")
    from leapnav.experts import ExpertPolicy

    config = DAggerConfig(rounds=1, max_failures=3, max_episodes=30, lead=1.0)
    arguments = {"cloning": QUICK, "dataset": dataset, "folder": tmp_path}
    (done,) = DAgger(policy, ExpertPolicy(venv, quick=True), venv, config, **arguments).run(progress=False)
    samples = Dataset.load(tmp_path / "round-001.npz")
    assert len(samples) > samples.labelled.sum() == done.samples > 0


def test_runs_with_memory(tmp_path, capsys):
    run = tmp_path / "run"
    arguments = ["--family", "open", "--scenarios", "8", "--hidden", "16", "16", "--evaluation-scenarios", "2"]
    arguments += ["--cloning.epochs", "1", "--observation", "lidar"]
    assert main(["train", "bc", *arguments, "--memory", "stack", "--out", str(run)]) == 0
    assert json.loads((run / "policy.json").read_text())["memory"] == "stack"
    assert main(["evaluate", str(run), "--family", "open", "--count", "3"]) == 0
    capsys.readouterr()
    assert DAggerRunConfig.tuned("open", policy=run, out=tmp_path).memory == "stack"
    assert main(["train", "ppo", "--family", "open", "--warm-start", str(run), "--out", str(tmp_path / "ppo")]) == 2
    assert "expected the memory 'none', got 'stack'" in capsys.readouterr().err


def test_what_has_no_memory_is_refused(env):
    with pytest.raises(ValueError, match="memory: expected one of none, stack, got 'gru'"):
        with_memory(env, "gru")
    with pytest.raises(ValueError, match="memory: expected 'none' for a policy with momentum, got 'stack'"):
        make_policy(env.observation_space, env.action_space, effort_weights=(1.0, 1.0), memory="stack")
    with pytest.raises(ValueError, match="policy: expected the memory 'none', got 'stack'"):
        copy_actor(with_memory(env, "stack"), with_memory(env, "none"))
