import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.experts.demonstrations import load_demonstrations
from leapnav.experts.rollouts import rollout
from leapnav.training import (
    CloningConfig,
    Episode,
    NavigationFeatures,
    RandomPolicy,
    behaviour_clone,
    evaluate,
    load_policy,
    make_policy,
    run_episodes,
    save_policy,
    score,
)
from leapnav.training.reports import plot_gallery, print_scores, write_scores
from leapnav.training.symmetries import mirror, turn_round

QUICK = CloningConfig(epochs=3, batch_size=256, validation_share=0.2)


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    out = tmp_path_factory.mktemp("training") / "open"
    rollout("open", 40, out, seed=300, recoveries=1, workers=2, progress=False)
    return load_demonstrations(out)


@pytest.fixture
def env():
    return gym.make("leapnav/Navigate-v0", family="open")


@pytest.fixture(scope="module")
def clone(demonstrations):
    env = NavigateEnv("open")
    policy = make_policy(env.observation_space, env.action_space, seed=0)
    losses = behaviour_clone(policy, demonstrations, CloningConfig(epochs=60, batch_size=256), progress=False)
    return policy, losses


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


def test_cloning_learns(clone, demonstrations, env):
    policy, losses = clone
    assert losses[-1].training < 0.1 * losses[0].training
    assert losses[-1].validation < 0.3  # of the actions' variance
    references = demonstrations[:20]
    learned = score("clone", run_episodes(policy, env, references, progress=False))
    untrained = make_policy(env.observation_space, env.action_space, seed=1)
    before = score("untrained", run_episodes(untrained, env, references, progress=False))
    assert learned.mean_return.value > before.mean_return.value + 10


def test_the_noise_of_a_clone_is_the_error_that_remains(clone):
    policy, _ = clone
    assert th.all(policy.log_std.exp() < 0.2)


def test_the_same_seed_gives_the_same_weights(demonstrations, env):
    weights = []
    for _ in range(2):
        policy = make_policy(env.observation_space, env.action_space, seed=3)
        behaviour_clone(policy, demonstrations[:10], QUICK, progress=False)
        weights.append(policy.parameters_to_vector())
        th.rand(5)  # the global generator plays no part
    assert weights[0].tobytes() == weights[1].tobytes()


def test_making_and_cloning_leave_the_global_generators_alone(demonstrations, env):
    th.manual_seed(0)
    np.random.seed(0)
    torch_before, numpy_before = th.get_rng_state().clone(), np.random.get_state()[1].copy()
    behaviour_clone(make_policy(env.observation_space, env.action_space), demonstrations[:5], QUICK, progress=False)
    assert th.equal(torch_before, th.get_rng_state())
    assert np.array_equal(numpy_before, np.random.get_state()[1])


def test_no_course_is_in_both_training_and_validation(demonstrations):
    from leapnav.training.cloning import _split

    train, held_out = _split(demonstrations, CloningConfig(validation_share=0.25), th.Generator().manual_seed(0))
    assert len(train) + len(held_out) == len(demonstrations)
    assert not {d.scenario.goal for d in train} & {d.scenario.goal for d in held_out}


def test_ppo_can_go_on_from_a_clone(clone, env):
    policy, _ = clone
    model = PPO(
        ActorCriticPolicy,
        env,
        n_steps=64,
        batch_size=64,
        policy_kwargs={
            "net_arch": policy.net_arch,
            "activation_fn": policy.activation_fn,
            "features_extractor_class": NavigationFeatures,
        },
    )
    model.policy.load_state_dict(policy.state_dict())
    model.learn(64)


def test_a_saved_policy_acts_the_same(clone, env, tmp_path):
    policy, _ = clone
    save_policy(policy, tmp_path / "policy", {"id": "leapnav/Navigate-v0"})
    loaded = load_policy(tmp_path / "policy", env)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(
            policy.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
        )


def test_broken_and_foreign_policies_are_refused(clone, env, tmp_path):
    policy, _ = clone
    save_policy(policy, tmp_path, {"id": "leapnav/Navigate-v0"})
    with pytest.raises(ValueError, match="the policy observes 41 numbers with other bounds"):
        load_policy(tmp_path, gym.make("leapnav/Navigate-v0", lidar_beams=16))
    weights = (tmp_path / "weights.pt").read_bytes()
    (tmp_path / "weights.pt").write_bytes(weights[:1000])
    with pytest.raises(ValueError, match=r"weights\.pt: not this policy's weights"):
        load_policy(tmp_path)
    (tmp_path / "weights.pt").unlink()
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(json.dumps({**description, "format": 99}))
    with pytest.raises(ValueError, match="format: expected 1, got 99"):
        load_policy(tmp_path)
    (tmp_path / "policy.json").write_text("{}")
    with pytest.raises(ValueError, match="not a policy's description"):
        load_policy(tmp_path)


def test_loading_a_policy_executes_nothing(clone, tmp_path):
    import os
    import pickle

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    save_policy(clone[0], tmp_path, {})
    (tmp_path / "weights.pt").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(ValueError, match="not this policy's weights"):
        load_policy(tmp_path)
    assert not (tmp_path / "executed").exists()


def test_the_expert_scores_one_and_random_zero(demonstrations):
    scores, episodes = evaluate(["expert", "random"], demonstrations[:10], progress=False)
    expert, random = scores
    assert expert.success.value == 1.0
    assert expert.soc.value == pytest.approx(1.0, abs=1e-3)
    assert abs(expert.regret.value) < 1e-3
    assert random.success.value == 0.0
    assert random.soc.value == 0.0
    assert math.isnan(random.regret.value)
    assert len(episodes["expert"]) == 10


def test_evaluation_is_deterministic(demonstrations):
    one, other = (evaluate(["random"], demonstrations[:5], seed=4, progress=False)[0] for _ in range(2))
    assert str(one) == str(other)


def test_regret_allows_for_the_pose_that_was_reached(demonstrations, env):
    """A policy that stops short saves cost; the reference for the pose reached must follow to first order."""
    reference = demonstrations[0]

    class Slow:
        def __init__(self):
            self.step = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            if episode_start[0]:
                self.step = 0
            action = reference.actions[self.step] * np.array([0.995, 1.0], np.float32)
            self.step += 1
            return action, state

    episode = run_episodes(Slow(), env, [reference], progress=False)[0]
    assert episode.cost < reference.reference_cost
    assert abs(episode.cost - reference.reference_cost) > 1e-3
    assert abs(episode.regret) < 1e-3


def episode(success=True, collision=False, cost=2.0, reference=1.0):
    return Episode("s", success, collision, cost, -cost, reference, reference, np.zeros((2, 3)))


def test_the_score_is_what_its_definition_says():
    episodes = [episode(cost=1.0), episode(cost=2.0), episode(cost=4.0), episode(success=False, collision=True)]
    found = score("policy", episodes)
    assert found.success.value == 0.75
    assert found.collision.value == 0.25
    assert found.soc.value == pytest.approx((1 + 1 / 2 + 1 / 4 + 0) / 4)
    assert found.regret.value == 1.0
    assert found.mean_return.value == -(1 + 2 + 4 + 2) / 4
    assert found.success.low < 0.75 < found.success.high


def test_bootstrap_intervals_cover_the_truth():
    rng = np.random.default_rng(0)
    hits = 0
    for trial in range(40):
        episodes = [episode(success=bool(s)) for s in rng.random(100) < 0.7]
        interval = score("policy", episodes, seed=trial).success
        hits += interval.low <= 0.7 <= interval.high
    assert hits >= 33  # 95 % of 40 is 38


def test_one_episode_and_none():
    assert score("policy", [episode()]).success.low == 1.0
    with pytest.raises(ValueError, match="episodes: expected at least one"):
        score("policy", [])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs: .*0"),
        ({"batch_size": -1}, "batch_size: .*-1"),
        ({"validation_share": 1.0}, "validation_share"),
        ({"learning_rate": math.inf}, "learning_rate: .*inf"),
        ({"seed": 10**20}, "seed: "),
    ],
)
def test_bad_settings_are_named(settings, message, demonstrations, env):
    policy = make_policy(env.observation_space, env.action_space)
    with pytest.raises(ValueError, match=message):
        behaviour_clone(policy, demonstrations, CloningConfig(**settings), progress=False)
    with pytest.raises(ValueError, match="demonstrations: expected at least one"):
        behaviour_clone(policy, [], progress=False)


def test_a_random_policy_repeats_itself_for_the_same_seed(env):
    one, other = RandomPolicy(env.action_space, 3), RandomPolicy(gym.make("leapnav/Navigate-v0").action_space, 3)
    assert np.array_equal(one.predict(np.zeros(41))[0], other.predict(np.zeros(41))[0])


def test_reports_are_written(demonstrations, tmp_path, capsys):
    scores, episodes = evaluate(["expert", "random"], demonstrations[:4], progress=False)
    print_scores(scores)
    printed = capsys.readouterr().out
    assert "expert" in printed
    assert "100.0" in printed
    write_scores(scores, episodes, tmp_path / "scores.json")
    content = json.loads((tmp_path / "scores.json").read_text())
    assert content["scores"][1]["regret"]["value"] is None
    assert content["episodes"]["expert"][0]["success"] is True
    plot_gallery(demonstrations[:4], episodes["random"], tmp_path / "episodes.png")
    assert (tmp_path / "episodes.png").read_bytes()[:4] == b"\x89PNG"
