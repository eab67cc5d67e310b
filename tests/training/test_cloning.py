import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from helpers import QUICK, SMALL, fresh
from stable_baselines3 import A2C, PPO, SAC, TD3

from leapnav.envs import NavigateEnv, sample_scenario
from leapnav.training import (
    CloningConfig,
    Dataset,
    behaviour_clone,
    evaluate,
    load_policy,
    network,
    policy_environment,
    save_policy,
)
from leapnav.training.learning.cloning import _Fit
from leapnav.training.policies.actors import copy_actor, mean_action


def test_cloning_learns(clone, env):
    policy, losses = clone
    assert losses[-1].training < 0.1 * losses[0].training
    assert losses[-1].validation < 0.3  # relative to the loss of the mean action
    learned = evaluate(policy, "open", count=20, timed=False, progress=False)
    before = evaluate(fresh(env), "open", count=20, timed=False, progress=False)
    assert np.mean([e.episode_return for e in learned]) > np.mean([e.episode_return for e in before]) + 10


def test_the_noise_of_a_clone_is_the_error_that_remains(clone):
    assert th.all(clone[0].log_std.exp() < 0.2)


@pytest.mark.parametrize("observation", ["lidar", "state"])
def test_a_policy_with_a_smaller_field_of_view_is_cloned_saved_and_loaded(observation, dataset, tmp_path):
    settings = {"observation": observation, "lidar_fov": 4.0, "lidar_beams": 15}
    env = NavigateEnv("open", **settings)
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [32]}, seed=0, device="cpu")
    losses = behaviour_clone(model, dataset, CloningConfig(epochs=6, batch_size=256), progress=False)
    assert losses[-1].training < losses[0].training
    save_policy(model, tmp_path / "policy")
    assert policy_environment(tmp_path / "policy")["lidar_fov"] == 4.0
    load_policy(tmp_path / "policy", env)
    if observation == "lidar":
        seen = dataset.observed(env.settings)
        first = NavigateEnv(scenario=seen.scenarios[int(seen.episodes[0])], **settings).reset()[0]
        assert seen.observations[0] == pytest.approx(first, abs=1e-5)
        with pytest.raises(ValueError, match=r"lidar_fov=4.0 \(here 6.28"):
            load_policy(tmp_path / "policy", NavigateEnv("open", lidar_beams=15))


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
        th.rand(5)  # the global generator has no effect
    assert weights[0].tobytes() == weights[1].tobytes()


def test_making_and_cloning_leave_the_global_generators_alone(dataset, env):
    th.manual_seed(0)
    np.random.seed(0)
    torch_before, numpy_before = th.get_rng_state().clone(), np.random.get_state()[1].copy()
    behaviour_clone(fresh(env), dataset[:1000], QUICK, progress=False)
    assert th.equal(torch_before, th.get_rng_state())
    assert np.array_equal(numpy_before, np.random.get_state()[1])


def test_no_course_is_in_both_training_and_validation(dataset):
    from leapnav.training.learning.samples import split_courses

    train, held_out = split_courses(dataset, 0.25, 0)
    assert train.sum() + held_out.sum() == len(dataset)
    assert held_out.any()
    courses = np.array(dataset.course_texts)[dataset.episodes]
    assert not set(courses[train]) & set(courses[held_out])
    # With fewer courses the same ones are held out, except for the rounding of the fraction.
    fewer = dataset.episodes < 60
    again = split_courses(dataset[fewer], 0.25, 0)[1]
    assert len(set(courses[fewer][again]) - set(courses[held_out])) <= 3


def test_cloning_stops_early_and_keeps_the_best_epoch(dataset, env, capsys):
    policy = fresh(env)
    # With this learning rate the loss soon increases.
    config = CloningConfig(epochs=50, patience=2, batch_size=64, learning_rate=0.05, validation_share=0.3)
    seen, states = [], []

    def keep(loss):
        seen.append(loss.validation)
        states.append(copy.deepcopy(policy.state_dict()))

    losses = behaviour_clone(policy, dataset[:1500], config, on_epoch=keep)
    assert seen == [loss.validation for loss in losses] and len(seen) < 50
    assert f"stopped after {len(seen)} of 50 epochs" in capsys.readouterr().err
    assert min(seen[:-2]) <= min(seen[-2:])
    best = states[int(np.argmin(seen))]
    assert all(th.equal(best[name], value) for name, value in policy.state_dict().items() if name != "log_std")


@pytest.mark.parametrize(
    ("n_samples", "batch_size", "batches", "epochs"),
    [(5_000, 64, 79, 32), (40_000, 192, 209, 12), (2_000_000, 2048, 977, 12)],
)
def test_little_data_gives_smaller_batches_and_more_epochs(
    n_samples, batch_size, batches, epochs, dataset, env, monkeypatch
):
    monkeypatch.setattr("leapnav.training.learning.samples.Samples.__len__", lambda samples: n_samples)
    fit = _Fit(fresh(env), dataset, CloningConfig(), 0)
    assert (fit._batch_size, fit.batches, fit.epochs) == (batch_size, batches, epochs)
    assert fit.epochs * fit.batches >= 2500
    fit = _Fit(fresh(env), dataset, CloningConfig(epochs=2, batch_size=1024), 0)  # given values are not changed
    assert (fit._batch_size, fit.epochs) == (1024, 2)


def test_the_hamiltonian_loss_equals_the_cost_of_an_error():
    """The loss equals H(q, lambda, u) - H(q, lambda, u*) for optima inside the robot's limits and at them."""
    from leapnav.training.learning.cloning import _hamiltonian_loss
    from leapnav.training.learning.samples import action_slopes

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
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, policy_kwargs=network((128, 128)))
    copy_actor(clone[0], model.policy)
    observation, _ = env.reset(seed=0)
    assert model.predict(observation, deterministic=True)[0] == pytest.approx(
        clone[0].predict(observation, deterministic=True)[0], abs=1e-6
    )
    model.learn(64)
    with pytest.raises(ValueError, match="its network has hidden"):
        copy_actor(clone[0], fresh(env))
    squashing = SAC("MlpPolicy", env, policy_kwargs=network(), device="cpu")
    with pytest.raises(ValueError, match="expected the same squashing of the actions"):
        copy_actor(clone[0], squashing.policy)


def test_the_target_actor_of_td3_is_cloned_too(dataset, env):
    model = TD3("MlpPolicy", env, policy_kwargs=network(SMALL), seed=0, device="cpu")
    behaviour_clone(model, dataset, QUICK, progress=False)
    target = model.actor_target.state_dict()
    assert all(th.equal(value, target[name]) for name, value in model.actor.state_dict().items())


def test_the_learning_rate_rises_linearly_and_falls_along_a_cosine():
    from leapnav.training.learning.cloning import WARM_UP_STEPS, warm_up_and_cosine

    total = 10 * WARM_UP_STEPS
    factor = warm_up_and_cosine(total)
    assert factor(0) == 1 / WARM_UP_STEPS
    assert factor(WARM_UP_STEPS - 1) == pytest.approx(1.0, abs=0.03)
    assert factor(total // 2) == pytest.approx(0.5)
    assert factor(total) == 0.0


def test_a_diverging_fit_raises_an_error(dataset, env):
    config = CloningConfig(epochs=3, batch_size=64, learning_rate=1e30)
    with pytest.raises(ValueError, match="learning_rate: the fit diverged in epoch"):
        behaviour_clone(fresh(env), dataset, config, progress=False)
    with pytest.raises(ValueError, match="dataset: actions: expected finite numbers"):
        replace(dataset, actions=np.full_like(dataset.actions, np.nan))
    with pytest.raises(ValueError, match="dataset: actions: expected finite numbers"):
        replace(dataset, actions=np.where([True, False], dataset.actions, np.nan))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs: .*0"),
        ({"batch_size": -1}, "batch_size: .*-1"),
        ({"validation_share": 1.0}, "validation_share"),
        ({"learning_rate": math.inf}, "learning_rate: .*inf"),
        ({"seed": 10**20}, "seed: "),
        ({"patience": -1}, "patience: .*-1"),
        ({"loss": "l3"}, "loss: expected one of action, hamiltonian, got 'l3'"),
    ],
)
def test_bad_settings_are_named(settings, message, dataset, env):
    with pytest.raises(ValueError, match=message):
        behaviour_clone(fresh(env), dataset, CloningConfig(**settings), progress=False)


def test_observations_of_a_map_are_not_augmented(dataset):
    env = NavigateEnv("open", observation="map", map_obstacles=2)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, device="cpu")
    losses = behaviour_clone(model, dataset.observed(env.settings), QUICK, progress=False)
    assert losses[-1].training < losses[0].training
