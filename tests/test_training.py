import hashlib
import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC, TD3
from tqdm import tqdm

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.experts import ExpertPolicy
from leapnav.experts.demonstrations import load_demonstrations
from leapnav.experts.rollouts import rollout
from leapnav.training import (
    CloningConfig,
    DAgger,
    DAggerConfig,
    Dataset,
    NavigationFeatures,
    behaviour_clone,
    evaluate,
    load_policy,
    make_policy,
    make_vec_env,
    network,
    save_policy,
)
from leapnav.training.actors import copy_actor, mean_action
from leapnav.training.cloning import Cloning
from leapnav.training.symmetries import mirror, turn_round
from leapnav.training.vec_env import ScaledReward

QUICK = CloningConfig(epochs=3, batch_size=256, validation_share=0.2)
SMALL = (32, 32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("training") / "open"
    rollout("open", 40, out, seed=300, recoveries=1, workers=2, progress=False)
    return out


@pytest.fixture(scope="module")
def demonstrations(folder):
    return load_demonstrations(folder)


@pytest.fixture(scope="module")
def dataset(folder):
    return Dataset.of(folder)


@pytest.fixture
def env():
    return gym.make("leapnav/Navigate-v0", family="open")


@pytest.fixture(scope="module")
def clone(dataset):
    env = NavigateEnv("open")
    policy = make_policy(env.observation_space, env.action_space, seed=0)
    config = CloningConfig(epochs=60, batch_size=256, patience=0)
    return policy, behaviour_clone(policy, dataset, config, progress=False)


def fresh(env, seed=0, hidden=SMALL):
    return make_policy(env.observation_space, env.action_space, seed, hidden)


def test_a_dataset_is_the_same_from_a_folder_and_from_demonstrations(demonstrations, dataset):
    other = Dataset.of(demonstrations)
    assert len(dataset) == len(other) == sum(len(d.actions) for d in demonstrations)
    for name in ("observations", "actions", "returns", "costates", "states", "times", "executed", "rewards"):
        np.testing.assert_allclose(getattr(dataset, name), getattr(other, name), atol=1e-9, err_msg=name)
    assert dataset.course_texts == other.course_texts
    assert (dataset.limits == [2.0, 3.0]).all()
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
    with pytest.raises(ValueError, match=r"part\.npz: not a dataset's file"):
        Dataset.load(tmp_path / "part.npz")


def test_datasets_that_cannot_be_learned_from_are_refused(folder, dataset, tmp_path, env, monkeypatch):
    import shutil

    with pytest.raises(ValueError, match="expected at least one"):
        Dataset.of([])
    with pytest.raises(FileNotFoundError, match="expected one Minari dataset"):
        Dataset.of(tmp_path)
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    metadata = next(other.glob("**/metadata.json"))
    content = json.loads(metadata.read_text())
    content["env_spec"] = content["env_spec"].replace("Navigate-v0", "Navigate-v1")
    metadata.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"a dataset of leapnav/Navigate-v1; leapnav learns from leapnav/Navigate-v0"):
        Dataset.of(other)
    fewer = gym.make("leapnav/Navigate-v0", lidar_beams=16)
    with pytest.raises(ValueError, match="its observations have 41 numbers, the policy's 25"):
        behaviour_clone(fresh(fewer), dataset, QUICK, progress=False)


def test_mirroring_and_turning_round_are_symmetries_of_the_environment():
    fields = sample_scenario("clutter", 5).to_dict()

    def mirrored(pose):
        return [10.0 - pose[0], pose[1], math.pi - pose[2]]

    def turned(pose):
        return [pose[0], pose[1], pose[2] + math.pi]

    twins = {
        mirror: {
            **fields,
            "start": mirrored(fields["start"]),
            "goal": mirrored(fields["goal"]),
            "obstacles": [
                {"circle": {**o["circle"], "center": [10.0 - o["circle"]["center"][0], o["circle"]["center"][1]]}}
                for o in fields["obstacles"]
            ],
        },
        turn_round: {**fields, "start": turned(fields["start"]), "goal": turned(fields["goal"])},
    }
    for transform, twin_fields in twins.items():
        env = NavigateEnv(scenario=Scenario.from_dict(fields))
        twin = NavigateEnv(scenario=Scenario.from_dict(twin_fields))
        observation, twin_observation = env.reset()[0], twin.reset()[0]
        for step in range(20):
            action = np.array([0.2, 0.3 * math.cos(step)], np.float32)
            inputs, targets = transform(th.as_tensor(observation)[None], th.as_tensor(action)[None])
            assert inputs[0].numpy() == pytest.approx(twin_observation, abs=1e-4)
            observation, reward, *_ = env.step(action)
            twin_observation, twin_reward, *_ = twin.step(targets[0].numpy())
            assert twin_reward == pytest.approx(reward, rel=1e-6)


def test_an_odd_number_of_beams_cannot_be_turned_round():
    with pytest.raises(ValueError, match="even number of lidar beams, got 3"):
        turn_round(th.zeros(1, 12), th.zeros(1, 2))


def test_the_features_have_the_promised_size_and_are_finite(env):
    features = NavigationFeatures(env.observation_space)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        found = features(th.as_tensor(observation)[None])
        assert found.shape == (1, features.features_dim)
        assert th.isfinite(found).all()
    low, high = env.observation_space.low, env.observation_space.high
    assert th.isfinite(features(th.as_tensor(np.stack([low, high, np.zeros_like(low)])))).all()


def test_cloning_learns(clone, env):
    policy, losses = clone
    assert losses[-1].training < 0.1 * losses[0].training
    assert losses[-1].validation < 0.3  # of what the mean action loses
    learned = evaluate(policy, "open", count=20, timed=False, progress=False)
    before = evaluate(fresh(env), "open", count=20, timed=False, progress=False)
    assert np.mean([e.episode_return for e in learned]) > np.mean([e.episode_return for e in before]) + 10


def test_the_noise_of_a_clone_is_the_error_that_remains(clone):
    assert th.all(clone[0].log_std.exp() < 0.2)


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
def test_the_actors_of_all_algorithms_can_be_cloned(algorithm, dataset, env):
    model = algorithm("MlpPolicy", env, policy_kwargs=network(SMALL), seed=0, device="cpu")
    losses = behaviour_clone(model, dataset, CloningConfig(epochs=6, batch_size=256), progress=False)
    assert losses[-1].training < 0.5 * losses[0].training
    inputs = th.as_tensor(dataset.observations[:50])
    with th.no_grad():
        expected = mean_action(model.policy, inputs).clamp(-1, 1).numpy()
    found, _ = model.predict(dataset.observations[:50], deterministic=True)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_model_without_an_actor_is_refused(dataset):
    with pytest.raises(TypeError, match="expected one of Stable-Baselines3 or its policy, got int"):
        behaviour_clone(3, dataset, QUICK)


def test_the_same_seed_gives_the_same_weights(dataset, env):
    weights = []
    for _ in range(2):
        policy = fresh(env, seed=3)
        behaviour_clone(policy, dataset[:2000], QUICK, progress=False)
        weights.append(policy.parameters_to_vector())
        th.rand(5)  # the global generator plays no part
    assert weights[0].tobytes() == weights[1].tobytes()


def test_making_and_cloning_leave_the_global_generators_alone(dataset, env):
    th.manual_seed(0)
    np.random.seed(0)
    torch_before, numpy_before = th.get_rng_state().clone(), np.random.get_state()[1].copy()
    behaviour_clone(fresh(env), dataset[:1000], QUICK, progress=False)
    assert th.equal(torch_before, th.get_rng_state())
    assert np.array_equal(numpy_before, np.random.get_state()[1])


def test_no_course_is_in_both_training_and_validation(dataset):
    from leapnav.training.cloning import _split

    train, held_out = _split(dataset, 0.25, 0)
    assert train.sum() + held_out.sum() == len(dataset)
    assert held_out.any()
    courses = np.array(dataset.course_texts)[dataset.episodes]
    assert not set(courses[train]) & set(courses[held_out])
    # Of fewer courses those are held out that were before, but for the share's rounding.
    fewer = dataset.episodes < 60
    again = _split(dataset[fewer], 0.25, 0)[1]
    assert len(set(courses[fewer][again]) - set(courses[held_out])) <= 3


def test_cloning_stops_early_and_keeps_the_best_epoch(dataset, env):
    policy = fresh(env)
    # A learning rate at which the loss soon rises.
    config = CloningConfig(epochs=50, patience=2, batch_size=64, learning_rate=0.05, validation_share=0.3)
    fit = Cloning(policy, dataset[:1500], config)
    while not fit.finished:
        fit.run_epoch()
    validation = [loss.validation for loss in fit.losses]
    assert len(validation) < 50
    assert min(validation[:-2]) <= min(validation[-2:])
    fit.finish()
    assert fit._validation() == pytest.approx(min(validation), rel=1e-5)


def test_a_fit_that_was_put_aside_goes_on_to_the_same_bits(dataset, env):
    config = CloningConfig(epochs=4, batch_size=256)
    straight, first, second = fresh(env), fresh(env), fresh(env, seed=9)
    behaviour_clone(straight, dataset, config, progress=False)
    begun = Cloning(first, dataset, config)
    begun.run_epoch()
    begun.run_epoch()
    state, weights = begun.state_dict(), first.state_dict()
    resumed = Cloning(second, dataset, config)
    second.load_state_dict(weights)
    resumed.load_state_dict(state)
    while not resumed.finished:
        resumed.run_epoch()
    resumed.finish()
    assert second.parameters_to_vector().tobytes() == straight.parameters_to_vector().tobytes()


def test_the_hamiltonian_loss_is_what_an_error_costs():
    """H(q, lambda, u) - H(q, lambda, u*), written out, for optima inside the robot's limits and on them."""
    from leapnav.training.cloning import _hamiltonian_loss, action_slopes

    rng = np.random.default_rng(0)
    count, limits, weights = 200, np.array([2.0, 3.0]), np.array([1.0, 0.5])
    heading, costates = rng.uniform(-4, 4, count), 3 * rng.normal(size=(count, 3))
    p = np.stack([np.cos(heading) * costates[:, 0] + np.sin(heading) * costates[:, 1], costates[:, 2]], axis=1)
    best = np.clip(-p / weights, -limits, limits)
    assert (np.abs(best) == limits).any()
    taken = np.clip(best + rng.normal(size=best.shape), -limits, limits)
    extra = (0.5 * weights * (taken**2 - best**2) + p * (taken - best)).sum(axis=1)
    dataset = Dataset(
        observations=np.zeros((count, 41), np.float32),
        actions=best / limits,
        returns=np.zeros(count),
        costates=costates,
        states=np.stack([np.zeros(count), np.zeros(count), heading], axis=1),
        times=np.zeros(count),
        executed=best / limits,
        rewards=np.zeros(count),
        episodes=np.zeros(count, dtype=int),
        scenarios=(sample_scenario("open", 1).to_json(),),
    )
    error = th.as_tensor((taken - best) / limits)
    loss = _hamiltonian_loss(error, th.as_tensor(action_slopes(dataset)), th.as_tensor(weights * limits**2))
    assert loss.sum(dim=1).numpy() == pytest.approx(extra, abs=1e-9)


def test_cloning_by_the_hamiltonian_learns(dataset, env):
    losses = behaviour_clone(
        fresh(env), dataset, CloningConfig(epochs=8, batch_size=256, loss="hamiltonian"), progress=False
    )
    assert losses[-1].validation < 0.3 < losses[0].validation


def test_ppo_can_go_on_from_a_clone(clone, env):
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, policy_kwargs=network())
    copy_actor(clone[0], model.policy)
    observation, _ = env.reset(seed=0)
    assert model.predict(observation, deterministic=True)[0] == pytest.approx(
        clone[0].predict(observation, deterministic=True)[0], abs=1e-6
    )
    model.learn(64)
    with pytest.raises(ValueError, match="its network has the shapes"):
        copy_actor(clone[0], fresh(env))
    squashing = SAC("MlpPolicy", env, policy_kwargs=network(), device="cpu")
    with pytest.raises(ValueError, match="which squashes its actions or does not"):
        copy_actor(clone[0], squashing.policy)


def test_the_target_actor_of_td3_is_cloned_too(dataset, env):
    model = TD3("MlpPolicy", env, policy_kwargs=network(SMALL), seed=0, device="cpu")
    behaviour_clone(model, dataset, QUICK, progress=False)
    target = model.actor_target.state_dict()
    assert all(th.equal(value, target[name]) for name, value in model.actor.state_dict().items())


def test_a_fit_that_diverges_says_so(dataset, env):
    config = CloningConfig(epochs=3, batch_size=64, learning_rate=1e30)
    with pytest.raises(ValueError, match="learning_rate: the fit diverged in epoch"):
        behaviour_clone(fresh(env), dataset, config, progress=False)
    with pytest.raises(ValueError, match="dataset: actions: expected finite numbers"):
        replace(dataset, actions=np.full_like(dataset.actions, np.nan))


def test_policies_are_checked_against_the_robots_of_stable_baselines3(clone, tmp_path):
    save_policy(clone[0], tmp_path)
    load_policy(tmp_path, ScaledReward(make_vec_env(n_envs=2, family="open"), 0.1))
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


def test_a_policy_with_another_network_is_not_saved(env, tmp_path):
    with pytest.raises(ValueError, match=r"policy_kwargs=leapnav\.training\.network\(\)"):
        save_policy(PPO("MlpPolicy", env), tmp_path)


def test_broken_and_foreign_policies_are_refused(clone, tmp_path):
    save_policy(clone[0], tmp_path)
    with pytest.raises(ValueError, match=r"observes another environment than this one: lidar_beams=32 \(here 16\)"):
        load_policy(tmp_path, gym.make("leapnav/Navigate-v0", lidar_beams=16))
    with pytest.raises(ValueError, match=r"actuation='velocity' \(here 'motor'\)"):
        load_policy(tmp_path, gym.make("leapnav/Navigate-v0", actuation="motor"))
    weights = (tmp_path / "weights.pt").read_bytes()
    half = len(weights) // 2
    for damaged in (weights[:1000], weights[:half] + bytes([weights[half] ^ 255]) + weights[half + 1 :]):
        (tmp_path / "weights.pt").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"weights\.pt: not this policy's weights: damaged"):
            load_policy(tmp_path)
    (tmp_path / "weights.pt").unlink()
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    faults = [
        ({**description, "format": 99}, "format: expected 2, got 99"),
        ({}, "not a policy's description"),
        ({**description, "environment": {"id": "leapnav/Navigate-v1"}}, "a policy for leapnav/Navigate-v1"),
        ({**description, "kind": "dqn"}, "kind: expected one of actor-critic, sac, tqc, got 'dqn'"),
        ({**description, "hidden": ["wide"]}, "not a policy's description"),
        ({**description, "observation_low": [0.0]}, "not a policy's description"),
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
    description["sha256"] = hashlib.sha256((tmp_path / "weights.pt").read_bytes()).hexdigest()
    (tmp_path / "policy.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="not this policy's weights"):
        load_policy(tmp_path)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs: .*0"),
        ({"batch_size": -1}, "batch_size: .*-1"),
        ({"validation_share": 1.0}, "validation_share"),
        ({"learning_rate": math.inf}, "learning_rate: .*inf"),
        ({"seed": 10**20}, "seed: "),
        ({"patience": -1}, "patience: .*-1"),
        ({"loss": "l3"}, "loss: expected action or hamiltonian, got 'l3'"),
    ],
)
def test_bad_settings_are_named(settings, message, dataset, env):
    with pytest.raises(ValueError, match=message):
        behaviour_clone(fresh(env), dataset, CloningConfig(**settings), progress=False)


def test_dagger_labels_what_the_learner_sees(dataset, env, tmp_path):
    """The labels are the expert's at the learner's states, with value and costate; rounds are kept on disk."""
    policy = fresh(env)
    behaviour_clone(policy, dataset, QUICK, progress=False)
    venv = make_vec_env(n_envs=4, family="open", split="fresh")
    config = DAggerConfig(rounds=2, failures=5, successes=2, expert_share=0.5)
    dagger = DAgger(
        policy,
        ExpertPolicy(venv, reconsider=0.1),
        venv,
        config,
        cloning=QUICK,
        dataset=dataset,
        folder=tmp_path / "rounds",
    )
    rounds = dagger.run(progress=False)
    assert [done.number for done in rounds] == [1, 2]
    assert all(done.episodes >= 5 for done in rounds)
    assert len(dagger.dataset) == len(dataset) + sum(done.samples for done in rounds)
    kept = Dataset.load(tmp_path / "rounds" / "round-001.npz")
    assert len(kept) == rounds[0].samples
    for i in (0, len(kept) // 2, len(kept) - 1):
        scenario = Scenario.from_json(kept.scenarios[kept.episodes[i]])
        rest = scenario.model_copy(
            update={"start": tuple(kept.states[i].tolist()), "horizon": scenario.horizon - float(kept.times[i])}
        )
        one = NavigateEnv(scenario=rest)
        observation, _ = one.reset()
        assert observation == pytest.approx(kept.observations[i], abs=1e-4)
        expert = ExpertPolicy(one)
        assert expert.predict(observation)[0] == pytest.approx(kept.actions[i], abs=2e-2)
        assert -expert.value() == pytest.approx(kept.returns[i], rel=1e-4)
        assert expert.costate() == pytest.approx(kept.costates[i], abs=1e-2 * max(1, np.abs(kept.costates[i]).max()))
        assert scenario.horizon - kept.times[i] >= config.forgiven


def test_dagger_is_the_same_with_the_same_seed_and_any_number_of_workers(env, monkeypatch):
    monkeypatch.setattr("leapnav.training.dagger.PORTION", 2)
    found = []
    for workers in (1, 1, 2):
        policy = fresh(env)
        venv = make_vec_env(n_envs=2, family="open", split="fresh")
        config = DAggerConfig(rounds=1, failures=4, successes=0, seed=4)
        dagger = DAgger(policy, ExpertPolicy(venv), venv, config, cloning=QUICK, workers=workers)
        dagger.run(progress=False)
        found.append((policy.parameters_to_vector().tobytes(), dagger.dataset.observations.tobytes()))
    assert found[0] == found[1] == found[2]
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        DAgger(fresh(env), ExpertPolicy(venv), venv, workers=0)


@pytest.mark.parametrize("settings", [{"rounds": 0}, {"expert_share": 1.5}, {"learning_rate": -1.0}])
def test_bad_settings_of_dagger_are_named(settings, env):
    venv = make_vec_env(n_envs=1, family="open", split="fresh")
    with pytest.raises(ValueError, match=f"{next(iter(settings))}: "):
        DAgger(fresh(env), ExpertPolicy(venv), venv, DAggerConfig(**settings))
    with pytest.raises(ValueError, match="expert: expected one for venv"):
        DAgger(fresh(env), ExpertPolicy(make_vec_env(n_envs=1, family="open")), venv)
    with pytest.raises(TypeError, match="venv: expected one from"):
        DAgger(fresh(env), ExpertPolicy(venv), ScaledReward(venv, 2.0))


def test_dagger_labels_what_the_learner_failed_in_first(dataset, env):
    """Where it always fails, all that is labelled are failures; the successes are a sample."""
    venv = make_vec_env(n_envs=4, family="open", split="fresh", seed=0)
    dagger = DAgger(fresh(env), ExpertPolicy(venv), venv, DAggerConfig(rounds=1, failures=6, successes=3))
    failed, succeeded, _ = dagger._drive("", False)
    assert len(failed) >= 6
    assert len(succeeded) == 0
    labelled = dagger._label(failed[:2], 0, np.random.default_rng(0), tqdm(disable=True))
    assert {Scenario.from_json(text) for text in labelled.scenarios} == set(failed[:2])
