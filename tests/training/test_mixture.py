"""Policies with several actions, of which they choose one."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import RescaleAction
from helpers import SMALL
from stable_baselines3 import PPO, SAC

from leapnav.training import CloningConfig, WarmStartConfig, behaviour_clone, network, warm_start
from leapnav.training.policies.actors import action_mixture
from leapnav.training.policies.architecture import Architecture
from leapnav.training.policies.mixture import TEMPERATURE, Mixture
from leapnav.training.policies.navigation_policy import NavigationPolicy
from leapnav.training.policies.network import make_policy


def mixture(actions, weights):
    return Mixture(th.tensor([actions]), th.tensor([weights]).log())


def make(env, components, seed=0):
    return make_policy(env.observation_space, env.action_space, seed, SMALL, components=components)


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ([0.5, 0.3, 0.2], [0.8, 0.0]),
        ([0.3, 0.5, 0.2], [-0.8, 0.0]),
        # Components close to each other count together, and their mean is the action.
        ([0.4, 0.3, 0.3], [-0.8, 0.05]),
    ],
)
def test_the_mode_is_the_action_of_the_highest_density(weights, expected):
    found = mixture([[0.8, 0.0], [-0.8, 0.0], [-0.8, 0.1]], weights).mode()[0]
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_the_loss_of_a_mixture():
    losses = th.tensor([[0.2, 3.0]])
    # A component that explains the action has its own loss, apart from its weight.
    expected = 0.2 - TEMPERATURE * np.log(0.5)
    assert float(mixture([[0.0], [1.0]], [0.5, 0.5]).loss(losses)) == pytest.approx(expected)
    single = Mixture.from_output(th.zeros(3, 2), 1)
    np.testing.assert_allclose(single.loss(th.tensor([[1.0], [2.0], [3.0]])), [1.0, 2.0, 3.0], rtol=1e-6)


def test_a_mixture_decides_between_two_actions(dataset, env):
    # Whether the expert drives forwards or backwards cannot be seen.
    actions = dataset.actions.copy()
    actions[:, 0] = np.random.default_rng(0).choice([-0.8, 0.8], len(dataset))
    samples = replace(dataset, actions=actions)[:4000]
    settings = CloningConfig(epochs=10, batch_size=64, patience=0, augment=False)
    medians, noise = {}, {}
    for components in (1, 3):
        policy = make(env, components)
        losses = behaviour_clone(policy, samples, settings, progress=False)
        found, _ = policy.predict(samples.observations[::50], deterministic=True)
        medians[components] = np.median(np.abs(found[:, 0]))
        assert losses[-1].training < losses[0].training
        noise[components] = float(policy.log_std.exp()[0].detach())
    assert noise[3] < 0.2 < 0.7 < noise[1]
    assert medians[3] == pytest.approx(0.8, abs=0.05)
    assert medians[1] < 0.7


def test_the_weights_of_a_new_mixture_depend_on_its_seed_alone(env):
    policies = [make(env, 3), make(env, 3), make(env, 3, seed=1)]
    first, again, other = (policy.state_dict()["action_net.bias"] for policy in policies)
    assert th.equal(first, again)
    assert not th.equal(first, other)
    rows = th.as_tensor(np.array([env.reset(seed=seed)[0] for seed in range(2)]))
    actions, log_weights = action_mixture(policies[0], rows)
    assert actions.shape == (2, 3, 2)
    np.testing.assert_allclose(log_weights.exp().sum(dim=1).detach(), 1.0, rtol=1e-6)
    assert actions.std(dim=1).min() > 0.01


def test_a_number_of_components_that_does_not_fit(dataset, env):
    with pytest.raises(ValueError, match="components: expected an integer >= 1, got 0"):
        make(env, 0)
    model = PPO("MlpPolicy", env, policy_kwargs=network(SMALL), n_steps=8, batch_size=8, device="cpu")
    config = WarmStartConfig(critic=False)
    with pytest.raises(ValueError, match=r"has 3 components, that of the model 1; .*'components': 3"):
        warm_start(model, dataset, config, policy=make(env, 3), progress=False)
    options = {**network(SMALL), "components": 3}
    model = PPO(NavigationPolicy, env, policy_kwargs=options, n_steps=8, batch_size=8, device="cpu")
    start = make(env, 3, seed=5)
    warm_start(model, dataset, config, policy=start, progress=False)
    rows = dataset.observations[:9]
    found, expected = (one.predict(rows, deterministic=True)[0] for one in (model, start))
    np.testing.assert_array_equal(found, expected)
    sac = SAC("MlpPolicy", env, policy_kwargs=network(SMALL), device="cpu")
    with pytest.raises(ValueError, match="expected the same squashing of the actions"):
        warm_start(sac, dataset, config, policy=start, progress=False)
    with pytest.raises(ValueError, match="components: expected none for actions with other bounds than -1 and 1"):
        make(RescaleAction(env, -2.0, 2.0), 3)
    with pytest.raises(ValueError, match="components: expected none for a policy of kind 'sac'"):
        Architecture("sac", SMALL, SMALL, components=3).make(env.observation_space, env.action_space)
