import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.sources import LevelOutcome
from leapnav.training import (
    LevelScoring,
    PrioritizedSampler,
    RegretSampler,
    UniformSampler,
    evaluate,
    make_sampler,
    make_vec_env,
    regret,
)

ID = "leapnav/Navigate-v0"
SAME = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep"}


@pytest.fixture(scope="module")
def bank():
    return ScenarioBank.shipped("clutter", "train")


class GoAhead:
    """Drives ahead at half the speed."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.tile(np.array([0.5, 0.0], np.float32), (*np.shape(observation)[:-1], 1)), state


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_a_sampler_chooses_the_levels_and_is_told_their_regret(bank, mode):
    """The recorded regrets are those of `regret`, in both modes of autoreset."""
    sampler = RegretSampler(bank, replay=0.0)
    venv = gym.make_vec(ID, 4, **{**SAME, "autoreset_mode": mode}, bank=bank, sampler=sampler)
    venv.reset(seed=0)
    played = set(venv.unwrapped.indices)
    for _ in range(260):
        venv.step(np.tile([0.5, 0.0], (4, 1)))
        played |= set(venv.unwrapped.indices)
    finished = np.flatnonzero(sampler.plays)
    assert len(finished) >= 4 and set(finished.tolist()) <= played
    assert sampler.plays.max() == 1  # with replay=0 no level is repeated before all were played
    assert np.isnan(sampler.regrets[sampler.plays == 0]).all()
    exact = regret(GoAhead(), bank, count=int(finished.max()) + 1, progress=False)
    assert sampler.regrets[finished] == pytest.approx(exact.levels[finished], abs=1e-6)


def test_a_level_selected_by_a_reset_is_not_sampled(bank):
    sampler = UniformSampler(bank)
    venv = gym.make_vec(ID, 2, **SAME, bank=bank, sampler=sampler)
    venv.reset(seed=0, options={"index": 7})
    assert venv.unwrapped.indices == (7, 7)


def test_high_scores_and_levels_not_drawn_for_long_are_preferred(bank):
    rng = np.random.default_rng(0)
    sampler = PrioritizedSampler(bank, "exact_regret", replay=1.0, temperature=0.3, staleness=0.0)
    for i in range(50):
        sampler.record(LevelOutcome(i, i % 2 == 0, False, -float(i), float(i)))
    drawn = np.array([sampler.draw(rng) for _ in range(2000)])
    assert (drawn == 49).mean() > 0.8  # the first rank: 1 / sum of k^(-1/0.3) = 0.86
    assert sampler.probabilities[:50].argmax() == 49 and sampler.probabilities.sum() == pytest.approx(1.0)
    stale = PrioritizedSampler(bank, "exact_regret", replay=1.0, staleness=1.0)
    for i in range(50):
        stale.record(LevelOutcome(i, True, False, 0.0, float(i)))
    counts = np.bincount([stale.draw(rng) for _ in range(3000)], minlength=50)
    assert counts[:50].min() > 20 and counts[:50].max() < 150


def test_learnability_is_highest_at_half_the_success(bank):
    sampler = make_sampler("learnability", bank)
    for success in (True, False, True, False):
        sampler.record(LevelOutcome(0, success, False, -1.0, 0.0))
    for i, success in ((1, True), (2, False)):
        for _ in range(4):
            sampler.record(LevelOutcome(i, success, False, -1.0, 0.0))
    assert sampler.scores[0] > 0.2 and sampler.scores[1] == sampler.scores[2] == 0.0


def test_value_scores_are_means_over_the_steps_of_a_level(bank):
    levels = np.array([[3, 5], [3, 5], [3, 8]])
    values, advantages = np.full((3, 2), -2.0), np.array([[1.0, -1.0], [-3.0, -1.0], [2.0, 4.0]])
    rewards, starts = np.array([[-1.0, -2.0], [-1.0, -2.0], [-3.0, -7.0]]), np.zeros((3, 2), bool)
    starts[0], starts[2, 1] = True, True
    sampler = PrioritizedSampler(bank, "positive_value_loss")
    sampler.score_rollout(levels, values, advantages, rewards, starts)
    assert sampler.scores[[3, 5, 8]] == pytest.approx([1.0, 0.0, 4.0])


def test_max_mc_compares_the_highest_return_with_the_expected_one(bank):
    """Two robots and rollouts of two steps; the episodes of the first robot have the returns -6 and -4."""
    sampler = PrioritizedSampler(bank, "max_mc")

    def score_rollout(levels, values, rewards, starts):
        advantages = np.zeros((2, 2))
        sampler.score_rollout(np.array(levels), np.array(values), advantages, np.array(rewards), np.array(starts))

    score_rollout([[3, 5], [3, 5]], [[-7.0, -1.0], [-5.0, -1.0]], [[-1.0, -1.0], [-2.0, -1.0]], [[1, 1], [0, 0]])
    assert np.isnan(sampler.scores).all()  # no episode has ended
    score_rollout([[3, 5], [3, 5]], [[-3.0, -1.0], [-5.0, -1.0]], [[-3.0, -1.0], [-4.0, -1.0]], [[0, 0], [1, 0]])
    # The highest return is -6; the returns expected before the two steps are -3 - 3 and 0 - 5.
    assert sampler.scores[3] == pytest.approx(((-6 + 6) + (-6 + 5)) / 2) and np.isnan(sampler.scores[5])
    score_rollout([[8, 5], [8, 5]], [[0.0, -1.0], [0.0, -1.0]], [[-1.0, -1.0], [-1.0, -1.0]], [[1, 0], [0, 0]])
    assert sampler._best_returns[3] == -4.0 and np.isnan(sampler.scores[[5, 8]]).all()


@pytest.mark.parametrize("name", ["uniform", "plr", "learnability", "exact_regret"])
def test_ppo_of_stable_baselines_trains_with_every_sampler(bank, name):
    sampler = make_sampler(name, bank)
    venv = make_vec_env(n_envs=4, bank=bank, sampler=sampler, control_period=0.2, lidar_beams=8)
    model = PPO("MlpPolicy", venv, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    model.learn(512, callback=LevelScoring(sampler) if name == "plr" else None)
    assert sampler.plays.sum() > 4
    if name != "uniform":
        assert (~np.isnan(sampler.scores)).sum() >= 4
    assert len(evaluate(model, bank, count=2, environment={"lidar_beams": 8}, progress=False)) == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda bank: PrioritizedSampler(bank, "regret"), "score: .*'regret'"),
        (lambda bank: PrioritizedSampler(bank, replay=2.0), "replay: "),
        (lambda bank: PrioritizedSampler(bank, temperature=0.0), "temperature: "),
        (lambda bank: make_sampler("random", bank), "name: .*'random'"),
        (lambda bank: make_vec_env(n_envs=1, split="fresh", sampler=UniformSampler(bank)), "sampler: "),
    ],
)
def test_bad_arguments_are_named(bank, make, message):
    with pytest.raises(ValueError, match=message):
        make(bank)
