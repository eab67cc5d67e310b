from dataclasses import replace

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize

from leapnav.envs import NavigateEnv, sample_scenario
from leapnav.envs.simulation.observer import Observer
from leapnav.experts import ExpertPolicy
from leapnav.experts.data.rollouts import rollout
from leapnav.training import CloningConfig, Dataset, behaviour_clone, make_vec_env, network, warm_start
from leapnav.training.fit_settings import WarmStartConfig
from leapnav.training.learning.replay import DemonstrationReplayBuffer, imitate
from leapnav.training.policies.actors import mean_action
from leapnav.training.policies.navigation_policy import NavigationPolicy


def small():
    return network((64, 64))  # a new dict for each model: SB3 modifies it


CLONING = CloningConfig(epochs=4, batch_size=256)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "open"
    rollout("open", 60, out, seed=500, progress=False)
    return Dataset.of(out)


def ppo(**arguments):
    return PPO("MlpPolicy", make_vec_env(n_envs=2, family="open"), policy_kwargs=small(), seed=0, **arguments)


def test_an_observer_sees_what_the_environment_shows():
    env, rng = NavigateEnv("clutter", split="fresh"), np.random.default_rng(0)
    scenarios, states, times, expected = [], [], [], []
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        for _ in range(rng.integers(1, 6)):
            observation, _, done, _, _ = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
            assert not done
        scenarios.append(env.scenario)
        states.append(env.pose)
        times.append(env.time)
        expected.append(observation)
    found = Observer().observe(scenarios, np.array(states), np.array(times))
    np.testing.assert_array_equal(found, np.array(expected))


def test_the_critic_of_ppo_is_the_cost_to_go(dataset):
    model = ppo(gamma=1.0)
    config = WarmStartConfig(critic_epochs=75, critic_batch_size=512, slopes=5000)
    found = warm_start(model, dataset, config, cloning=CLONING, reward_scale=0.1, progress=False)
    assert len(found.cloning) == 4
    assert found.value_error < 0.02
    assert found.slope_error < 0.3
    with th.no_grad():
        values = model.policy.predict_values(th.as_tensor(dataset.observations)).numpy()[:, 0]
    assert np.mean((values - 0.1 * dataset.returns) ** 2) < 0.02 * np.var(0.1 * dataset.returns)


@pytest.mark.slow
def test_fitting_the_costate_makes_the_critics_slope_better(dataset):
    """Fitting the costates reduces the error of the value's gradient on unseen scenarios."""
    test = [sample_scenario("open", seed) for seed in range(900, 906)]
    errors = []
    for gradient in (True, False):
        model = ppo(gamma=1.0)
        config = WarmStartConfig(actor=False, critic_epochs=30, critic_batch_size=512, slopes=3000, gradient=gradient)
        warm_start(model, dataset, config, progress=False)
        squares = []
        for scenario in test:
            env = NavigateEnv(scenario=scenario)
            env.reset()
            costate = ExpertPolicy(env).costate()
            step = np.diag([0.02, 0.02, 0.02])
            states = np.concatenate([np.array(scenario.start) + step, np.array(scenario.start) - step])
            seen = Observer().observe([scenario] * 6, states, np.zeros(6))
            with th.no_grad():
                values = model.policy.predict_values(th.as_tensor(seen)).numpy()[:, 0]
            squares.append(((values[:3] - values[3:]) / 0.04 + costate) ** 2)
        errors.append(np.mean(squares))
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.slow
def test_the_q_functions_of_sac_know_what_an_action_costs(dataset):
    """Q is the value at the expert's action, and lower at other actions by the cost according to the Hamiltonian."""
    model = SAC("MlpPolicy", make_vec_env(n_envs=1, family="open"), policy_kwargs=small(), gamma=1.0, seed=0)
    config = WarmStartConfig(actor=False, critic_epochs=45, critic_batch_size=512, slopes=3000)
    found = warm_start(model, dataset, config, progress=False)
    assert found.value_error < 0.05
    # The excess cost of other actions, as the difference of the Q values.
    chosen = np.random.default_rng(0).integers(len(dataset), size=2000)
    inputs, best = th.as_tensor(dataset.observations[chosen]), th.as_tensor(dataset.actions[chosen])
    other = (best + th.tensor([0.6, 0.6]) * th.sign(-best)).clamp(-1, 1)
    with th.no_grad():
        costs = [th.stack(model.critic(inputs, actions)).mean(dim=0)[:, 0] for actions in (best, other)]
    found = float((costs[0] - costs[1]).mean())
    weights = th.as_tensor((dataset.weights * dataset.halves**2)[chosen])
    assert found == pytest.approx(float(0.05 * 0.5 * (weights * (other - best) ** 2).sum(dim=1).mean()), rel=0.3)
    states = model.critic.state_dict()
    assert all(th.equal(value, states[name]) for name, value in model.critic_target.state_dict().items())


def test_discounted_values_shrink():
    from leapnav.training.learning.warm_start import _Rewards

    # Ten steps of cost 1 each.
    assert _Rewards(0.9, 0.05, 1.0).factors(np.array([0.5])) * 10 == pytest.approx(sum(0.9**k for k in range(10)))
    assert _Rewards(0.9, 0.1, 2.0).factors(np.array([0.5])) * 5 == pytest.approx(2 * sum(0.9**k for k in range(5)))
    assert _Rewards(1.0, 0.05, 0.1).factors(np.array([0.5])) == 0.1


def test_parts_of_a_warm_start_can_be_left_out(dataset):
    model = ppo()
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    warm_start(model, dataset, WarmStartConfig(critic=False), cloning=CLONING, progress=False)
    changed = {name for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert any(name.startswith("action_net") for name in changed)
    assert not any("value" in name for name in changed)
    model = ppo()
    warm_start(model, dataset, WarmStartConfig(actor=False, critic_epochs=1, slopes=50), progress=False)
    changed = {name for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert changed
    assert all("value" in name for name in changed)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"critic_epochs": 0}, "critic_epochs: .*0"), ({"gradient_weight": -1.0}, r"gradient_weight: .*-1\.0")],
)
def test_bad_settings_are_named(settings, message, dataset):
    with pytest.raises(ValueError, match=message):
        warm_start(ppo(), dataset, WarmStartConfig(**settings), progress=False)
    with pytest.raises(ValueError, match="reward_scale: expected a positive number, got 0"):
        warm_start(ppo(), dataset, reward_scale=0.0, progress=False)


def test_without_values_for_the_critic_the_actor_is_not_changed(dataset):
    model = ppo()
    before = model.policy.parameters_to_vector()
    with pytest.raises(ValueError, match=r"dataset: no sample has a cost-to-go and a costate"):
        warm_start(model, replace(dataset, returns=np.nan * dataset.returns), cloning=CLONING, progress=False)
    np.testing.assert_array_equal(model.policy.parameters_to_vector(), before)


def test_exploration_fades_before_the_horizon(tmp_path):
    env = NavigateEnv("open")
    policy = NavigationPolicy(
        env.observation_space, env.action_space, lambda _: 1e-3, quiet=2.0, log_std_init=0.0, **small()
    )
    observations = th.as_tensor(np.stack([env.reset(seed=0)[0]] * 3))
    observations[:, 4] = th.tensor([3.0, 1.0, 0.0])
    spread = policy.get_distribution(observations).distribution.stddev
    assert th.allclose(spread, th.tensor([[1.0], [0.5], [0.3]]).expand(3, 2))
    actions, _, likelihoods = policy(observations)
    values, again, _ = policy.evaluate_actions(observations, actions)
    assert th.allclose(likelihoods, again)
    assert values.shape == (3, 1)
    policy.save(tmp_path / "policy")
    loaded = NavigationPolicy.load(tmp_path / "policy")
    assert th.equal(loaded.get_distribution(observations).distribution.stddev, spread)


def test_batches_hold_their_share_of_demonstrations(dataset):
    venv = make_vec_env(n_envs=1, family="open")
    arguments = {"dataset": dataset, "share": 0.25, "reward_scale": 0.1}
    buffer = DemonstrationReplayBuffer(100, venv.observation_space, venv.action_space, **arguments)
    blank = np.zeros((1, 41), np.float32)
    buffer.add(blank, blank, np.zeros((1, 2)), np.array([7.0]), np.array([False]), [{}])
    batch = buffer.sample(400)
    assert (batch.rewards[:300] == 7.0).all()
    demonstrated = batch.observations[300:].numpy()
    rows = {row.tobytes(): i for i, row in enumerate(dataset.observations)}
    for k in range(100):
        i = rows[demonstrated[k].tobytes()]
        assert batch.rewards[300 + k] == pytest.approx(0.1 * dataset.rewards[i], rel=1e-5)
        ends = i + 1 == len(dataset) or dataset.episodes[i + 1] != dataset.episodes[i]
        assert bool(batch.dones[300 + k]) == ends
        if not ends:
            np.testing.assert_array_equal(batch.next_observations[300 + k].numpy(), dataset.observations[i + 1])
    assert batch.dones[300:].sum() < 20
    with pytest.raises(ValueError, match="share: expected a number in"):
        DemonstrationReplayBuffer(100, venv.observation_space, venv.action_space, dataset=dataset, share=1.0)
    with pytest.raises(ValueError, match="VecNormalize"):
        buffer.sample(8, env=VecNormalize(venv))


@pytest.mark.parametrize("kind", [SAC, pytest.param(TD3, marks=pytest.mark.slow)])
def test_imitation_holds_an_actor_to_the_demonstrations(kind, dataset):
    """With an untrained critic the actor drifts away from a clone, unless its loss has the imitation term."""
    error = {}
    for weight in (0.0, 100.0):
        venv = make_vec_env(n_envs=2, seed=0, family="open", split="fresh")
        model = kind("MlpPolicy", venv, policy_kwargs=small(), seed=0, learning_starts=0, batch_size=64)
        behaviour_clone(model, dataset, CLONING, progress=False)
        if weight > 0:
            imitate(model, dataset, weight)
        model.learn(200)
        with th.no_grad():
            actions = mean_action(model.policy, th.as_tensor(dataset.observations))
        error[weight] = float(np.abs(actions.numpy() - dataset.actions).mean())
    assert error[100.0] < 0.5 * error[0.0]


def test_imitation_needs_the_models_observations(dataset):
    model = SAC("MlpPolicy", make_vec_env(n_envs=2, lidar_beams=8), policy_kwargs=small())
    with pytest.raises(ValueError, match="dataset: its observations have 41 numbers, the policy's 17"):
        imitate(model, dataset, 1.0)


def test_scaled_rewards_are_multiples():
    one, other = (make_vec_env(n_envs=2, family="open", seed=0, reward_scale=scale) for scale in (1.0, 0.1))
    one.reset(), other.reset()
    for _ in range(5):
        actions = np.full((2, 2), 0.3, np.float32)
        assert other.step(actions)[1] == pytest.approx(0.1 * one.step(actions)[1])
