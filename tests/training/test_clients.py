"""Clients of the environments and the policies: wrappers of Gymnasium, models of Stable-Baselines3, recorders."""

import json
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from gymnasium.utils.env_match import check_environments_match
from gymnasium.wrappers import (
    AddRenderObservation,
    ClipAction,
    DiscretizeAction,
    FrameStackObservation,
    RescaleAction,
)
from gymnasium.wrappers.vector import RescaleAction as RescaleActions
from onnxruntime import InferenceSession
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from leapnav.cli import main
from leapnav.envs import ScenarioBank
from leapnav.experts import ExpertPolicy, rollout
from leapnav.training import (
    CloningConfig,
    Dataset,
    WarmStartConfig,
    behaviour_clone,
    evaluate,
    load_policy,
    network,
    policy_environment,
    save_policy,
    warm_start,
)
from leapnav.training.policies.onnx_export import export_onnx
from leapnav.training.policies.zips import load_zip
from leapnav.training.scoring.policy_specs import load_policy_spec

ID = "leapnav/Navigate-v0"
DOUBLE = np.float32(-2.0), np.float32(2.0)


def open_env(**arguments):
    return gym.make(ID, family="open", **arguments)


def rescaled():
    return RescaleAction(open_env(), *DOUBLE)


def drives_to_the_goal(env):
    policy, done = ExpertPolicy(env), False
    observation, _ = env.reset(seed=0)
    while not done:
        observation, _, terminated, truncated, info = env.step(policy.predict(observation)[0])
        done = terminated or truncated
    return info["is_success"]


@pytest.mark.parametrize(
    "wrap",
    [
        lambda: rescaled(),
        lambda: RescaleAction(rescaled(), np.float32(0.0), np.float32(1.0)),
        lambda: ClipAction(open_env()),
        lambda: FrameStackObservation(open_env(), 3),
        lambda: AddRenderObservation(open_env(render_mode="rgb_array")),
    ],
    ids=["rescaled", "twice", "clipped", "stacked", "rendered"],
)
def test_the_expert_drives_wrapped_environments(wrap):
    assert drives_to_the_goal(wrap())


def test_the_expert_drives_wrapped_vector_environments():
    for venv in (
        RescaleActions(gym.make_vec(ID, 2, "vector_entry_point", family="open"), *DOUBLE),
        gym.vector.SyncVectorEnv([rescaled, rescaled]),
    ):
        observations, _ = venv.reset(seed=0)
        policy, successes = ExpertPolicy(venv), 0
        while not successes:
            observations, _, terminated, _, infos = venv.step(policy.predict(observations)[0])
            if terminated.any():
                successes = int(infos["is_success"][terminated].sum())
                assert successes


def test_other_action_wrappers_are_refused():
    with pytest.raises(ValueError, match=r"env: expected no action wrapper but .*, got DiscretizeAction"):
        ExpertPolicy(DiscretizeAction(open_env(), 3))


def test_cloned_models_of_a_rescaled_environment_have_its_actions(tmp_path):
    folder = tmp_path / "demonstrations"
    rollout("open", 3, folder, progress=False)
    data = Dataset.of(folder)
    for env, largest in ((open_env(), 1.0), (rescaled(), 2.0)):
        model = sb3.PPO("MlpPolicy", env, seed=0, policy_kwargs=network((64, 64)))
        behaviour_clone(model, data, CloningConfig(epochs=40, augment=False), progress=False)
        model.save(tmp_path / "model.zip")
        loaded, arguments = load_zip(tmp_path / "model.zip")
        assert loaded.action_space == env.action_space
        actions = model.predict(data.observations, deterministic=True)[0]
        assert np.abs(actions / largest - data.actions).mean() < 0.1 * np.abs(data.actions).mean()
        costs = [
            [e.cost for e in evaluate(one, "open", count=3, environment=arguments, timed=False, progress=False)]
            for one in (model, loaded)
        ]
        assert costs[0] == pytest.approx(costs[1])


def test_evaluations_normalise_the_observations_of_a_model_with_vec_normalize():
    class Recorded(sb3.PPO):
        def predict(self, observation, *arguments, **others):
            seen.append(np.abs(observation).max())
            return super().predict(observation, *arguments, **others)

    seen = []
    venv = VecNormalize(DummyVecEnv([open_env]), clip_obs=0.5)
    model = Recorded("MlpPolicy", venv, n_steps=64, batch_size=64)
    evaluate(model, "open", count=2, timed=False, progress=False)
    assert max(seen) <= 0.5
    with pytest.raises(ValueError, match="model: its observations are normalised by VecNormalize"):
        behaviour_clone(model, [])


def test_a_model_of_environments_in_processes_is_evaluated_with_their_sensors():
    venv = SubprocVecEnv([partial(gym.make, "leapnav/Navigate-v0", lidar_beams=24)], start_method="fork")
    model = sb3.PPO("MlpPolicy", venv, n_steps=16, batch_size=16)
    assert evaluate(model, "open", count=1, timed=False, progress=False).settings.lidar_beams == 24
    venv.close()
    with pytest.raises(ValueError, match=r"policy: expected observations \(33,\), got \(41,\)"):
        evaluate(model, "open", count=1, timed=False, progress=False)


def test_the_network_refuses_normalised_observations():
    venv = VecNormalize(DummyVecEnv([open_env]))
    model = sb3.PPO("MlpPolicy", venv, n_steps=64, batch_size=64, policy_kwargs=network())
    with pytest.raises(
        ValueError, match=r"time left: expected at least 0 s, got -.*use VecNormalize with norm_obs=Fal"
    ):
        model.learn(128)


@pytest.mark.parametrize("returned", [lambda a: a, lambda a: (a, None)])
def test_arguments_of_predict_after_the_observation_are_optional(returned):
    class Batches:
        def predict(self, observation):
            assert observation.ndim == 2
            return returned(np.zeros((len(observation), 2), np.float32))

    class Deterministic:
        def predict(self, observation, deterministic=False):
            assert deterministic
            return returned(np.zeros((*np.shape(observation)[:-1], 2), np.float32))

    for policy in (Batches(), Deterministic()):
        assert len(evaluate(policy, "open", count=2, progress=False)) == 2


def test_goal_conditioned_models_are_evaluated_in_their_environment():
    env = gym.make("leapnav/NavigateGoal-v0", family="open")
    model = sb3.SAC("MultiInputPolicy", env, buffer_size=500, replay_buffer_class=sb3.HerReplayBuffer)
    for one in evaluate(model, "open", count=2, progress=False):
        assert not one.success
        assert one.episode_return == pytest.approx(-one.cost - 50 * (1 + one.collision))


def test_environments_match_themselves():
    check_environments_match(gym.make(ID, family="slalom"), gym.make(ID, family="slalom"), num_steps=20)


def test_infos_have_the_same_keys_and_kinds_after_a_reset_and_a_step():
    for env in (open_env(), open_env(horizon="free"), gym.make("leapnav/NavigateGoal-v0"), open_env(robot="car")):
        _, first = env.reset(seed=0)
        second = env.step(env.action_space.sample())[4]
        for name, value in first.items():
            assert type(second[name]) is type(value) and isinstance(value, (bool, int, float, np.ndarray)), name
        assert len(first) == len(second)


def test_vector_episodes_are_truncated():
    venv = gym.make_vec(ID, 2, "vector_entry_point", family="open", max_episode_steps=3)
    venv.reset(seed=0)
    ends = [venv.step(np.zeros((2, 2), np.float32))[2:4] for _ in range(8)]
    assert [(bool(t.any()), bool(c.all())) for t, c in ends] == [(False, k in (2, 6)) for k in range(8)]


def test_the_distance_from_the_goal_says_by_how_much_it_was_missed():
    (episode,) = evaluate(lambda observation: np.zeros(2), "open", count=1, timed=False, progress=False)
    x, y, heading = ScenarioBank.shipped("open", "test")[0].goal
    last = episode.states[-1]
    assert episode.goal_distance == pytest.approx(np.hypot(last[0] - x, last[1] - y))
    assert episode.heading_error == pytest.approx(abs(np.remainder(last[2] - heading + np.pi, 2 * np.pi) - np.pi))
    assert episode.to_dict()["goal_distance"] == episode.goal_distance


def test_statistics_of_vecnormalize_are_read_from_their_file(tmp_path, capsys):
    """The score is that of the model in memory; without the file it is another one, with a warning."""
    venv = VecNormalize(DummyVecEnv([open_env]))
    model = sb3.PPO("MlpPolicy", venv, n_steps=64, batch_size=64, seed=0, device="cpu").learn(256)
    model.save(tmp_path / "model.zip")
    venv.save(tmp_path / "vecnormalize.pkl")
    expected = evaluate(model, "open", count=3, timed=False, progress=False)
    spec = load_policy_spec(str(tmp_path / "model.zip"), trust=True, vecnormalize=tmp_path / "vecnormalize.pkl")
    found = evaluate(spec.policy, "open", count=3, timed=False, progress=False)
    assert [episode.cost for episode in found] == [episode.cost for episode in expected]
    with pytest.warns(UserWarning, match=r"vecnormalize\.pkl may contain statistics of VecNormalize"):
        spec = load_policy_spec(str(tmp_path / "model.zip"))
    other = evaluate(spec.policy, "open", count=3, timed=False, progress=False)
    assert [episode.cost for episode in other] != [episode.cost for episode in expected]
    words = ["evaluate", str(tmp_path / "model.zip"), "--family", "open", "--count", "2", "--workers", "1"]
    words += ["--vecnormalize", str(tmp_path / "vecnormalize.pkl")]
    assert main(words) == 2
    assert "is a pickle file, which can execute code" in capsys.readouterr().err
    assert main([*words, "--trust"]) == 0
    capsys.readouterr()
    assert main(["evaluate", "open", "--count", "2", "--trust", *words[-2:]]) == 2
    assert "vecnormalize: expected a model of Stable-Baselines3 (.zip)" in capsys.readouterr().err
    (tmp_path / "vecnormalize.pkl").write_bytes(b"text")
    assert main([*words, "--trust"]) == 2
    assert "not a file of VecNormalize" in capsys.readouterr().err


def test_unknown_arguments_are_named_in_python_s_words():
    """TorchRL passes `frameskip` and tries again without it if the error has these words."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        open_env(frameskip=1)


def test_a_saved_policy_keeps_the_bounds_of_its_actions(tmp_path):
    model = sb3.PPO("MlpPolicy", rescaled(), n_steps=64, batch_size=64, seed=0)
    save_policy(model, tmp_path / "policy")
    policy = load_policy(tmp_path / "policy")
    assert policy.action_space == model.action_space
    expected, found = (evaluate(one, "open", count=2, timed=False) for one in (model, policy))
    assert [episode.cost for episode in found] == [episode.cost for episode in expected]


def test_the_sensors_are_those_of_the_model_s_environment(tmp_path):
    model = sb3.PPO("MlpPolicy", open_env(observation="geodesic", lidar_beams=16), n_steps=64, batch_size=64)
    assert evaluate(model, "open", count=1, timed=False).settings.sensors == "lidar and geodesic distances, 16 beams"
    save_policy(model, tmp_path / "policy")
    assert policy_environment(tmp_path / "policy")["lidar_beams"] == 16
    rollout("open", 1, tmp_path / "demos", progress=False)
    before = model.policy.state_dict()["action_net.weight"].clone()
    behaviour_clone(model, tmp_path / "demos", CloningConfig(epochs=1, batch_size=32), progress=False)
    assert not before.equal(model.policy.state_dict()["action_net.weight"])


@pytest.mark.parametrize("goal", [False, True], ids=["dictionary", "hindsight"])
def test_models_with_observations_in_dictionaries_are_evaluated(goal, tmp_path, capsys):
    if goal:
        env = gym.make("leapnav/NavigateGoal-v0", family="open", lidar_beams=16)
        buffer = {"replay_buffer_class": HerReplayBuffer, "buffer_size": 1000}
        model = sb3.SAC("MultiInputPolicy", env, learning_starts=1000, seed=0, **buffer)
    else:
        env = open_env(dict_observation=True, lidar_beams=16)
        model = sb3.PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, seed=0)
    expected = evaluate(model, "open", count=2, timed=False)
    path = tmp_path / "model.zip"
    model.save(path)
    with pytest.raises(ValueError, match="not a vector; trust=True"):
        load_zip(path)
    policy, arguments = load_zip(path, trust=True)
    found = evaluate(policy, "open", environment=arguments, count=2, timed=False)
    assert [episode.cost for episode in found] == [episode.cost for episode in expected]
    assert main(["evaluate", str(path), "--trust", "--family", "open", "--count", "1"]) == 0
    assert "lidar, 16 beams" in capsys.readouterr().out
    with pytest.raises(ValueError, match="expected a Box, got Dict"):
        sb3.PPO("MultiInputPolicy", env, policy_kwargs=network())


@pytest.mark.parametrize("kind", [sb3.PPO, sb3.SAC])
def test_models_with_observations_in_dictionaries_are_cloned_warm_started_saved_and_exported(kind, dataset, tmp_path):
    arguments = {"dict_observation": True, "lidar_beams": 16}
    env = open_env(**arguments)
    steps = {"n_steps": 64, "batch_size": 64} if kind is sb3.PPO else {"learning_starts": 1000}
    model = kind("MultiInputPolicy", env, seed=0, device="cpu", **steps)
    losses = behaviour_clone(model, dataset, CloningConfig(epochs=3, batch_size=256), progress=False)
    assert losses[-1].training < 0.8 * losses[0].training
    found = warm_start(model, dataset, WarmStartConfig(actor=False, critic_epochs=1, slopes=100), progress=False)
    assert np.isfinite(found.value_error)
    save_policy(model, tmp_path / "policy")
    assert policy_environment(tmp_path / "policy")["dict_observation"]
    loaded = load_policy(tmp_path / "policy", env)
    description = json.loads(export_onnx(tmp_path / "policy", tmp_path / "policy.onnx").read_text())
    session = InferenceSession(str(tmp_path / "policy.onnx"))
    rows = []
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        expected = model.predict(observation, deterministic=True)[0]
        np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)
        flat = open_env(lidar_beams=16).reset(seed=seed)[0]
        np.testing.assert_allclose(session.run(None, {"observation": flat[None]})[0][0], expected, atol=1e-5)
        rows.append(flat)
    assert len(description["observation"]) == len(rows[0])
    costs = [
        [episode.cost for episode in evaluate(policy, "open", environment=settings, count=2, timed=False)]
        for policy, settings in ((model, None), (loaded, policy_environment(tmp_path / "policy")))
    ]
    assert costs[0] == costs[1]
    goal = gym.make("leapnav/NavigateGoal-v0", family="open")
    with pytest.raises(ValueError, match="expected the parts of an observation of dict_observation=True, got achieved"):
        save_policy(kind("MultiInputPolicy", goal), tmp_path / "goal")
