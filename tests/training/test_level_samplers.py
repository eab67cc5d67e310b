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
    sampler = PrioritizedSampler(bank, "regret", replay=1.0, temperature=0.3, staleness=0.0)
    for i in range(50):
        sampler.record(LevelOutcome(i, i % 2 == 0, False, -float(i), float(i)))
    drawn = np.array([sampler.draw(rng) for _ in range(2000)])
    assert (drawn == 49).mean() > 0.8  # the first rank: 1 / sum of k^(-1/0.3) = 0.86
    assert sampler.probabilities[:50].argmax() == 49 and sampler.probabilities.sum() == pytest.approx(1.0)
    stale = PrioritizedSampler(bank, "regret", replay=1.0, staleness=1.0)
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
    sampler = PrioritizedSampler(bank, "positive_value_loss")
    sampler.score_rollout(levels, values, advantages, np.zeros((3, 2)), np.zeros((3, 2), dtype=bool))
    assert sampler.scores[[3, 5, 8]] == pytest.approx([1.0, 0.0, 4.0])


def test_max_mc_compares_the_highest_return_with_the_expected_one(bank):
    """Two robots and rollouts of two steps; the episodes of the first robot have the returns -6 and -4."""
    sampler = PrioritizedSampler(bank, "max_mc")

    def score_rollout(levels, values, rewards, ends):
        advantages = np.zeros((2, 2))
        sampler.score_rollout(np.array(levels), np.array(values), advantages, np.array(rewards), np.array(ends))

    score_rollout([[3, 5], [3, 5]], [[-7.0, -1.0], [-5.0, -1.0]], [[-1.0, -1.0], [-2.0, -1.0]], [[0, 0], [0, 0]])
    assert np.isnan(sampler.scores).all()  # no episode has ended
    score_rollout([[3, 5], [3, 5]], [[-3.0, -1.0], [-5.0, -1.0]], [[-3.0, -1.0], [-4.0, -1.0]], [[1, 0], [1, 0]])
    # The highest return is -4; the returns expected before the two steps are -3 - 3 and 0 - 5.
    assert sampler.scores[3] == pytest.approx(((-4 + 6) + (-4 + 5)) / 2) and np.isnan(sampler.scores[5])
    sampler.discard_episodes()  # the environment is reset
    score_rollout([[8, 5], [8, 5]], [[0.0, 0.0], [0.0, 0.0]], [[-1.0, -1.0], [-1.0, -2.0]], [[0, 0], [0, 1]])
    assert np.isnan(sampler.scores[8]) and sampler.scores[5] == pytest.approx((-3.0 + -2.0) / 2)


def test_equal_scores_have_equal_probabilities(bank):
    sampler = PrioritizedSampler(bank, "regret", staleness=0.0)
    for i in range(20):
        sampler.record(LevelOutcome(i, True, False, -1.0, float(i >= 15)))
    probabilities = sampler.probabilities
    assert np.ptp(probabilities[:15]) == np.ptp(probabilities[15:20]) == 0.0 < probabilities[0] < probabilities[15]


def test_the_first_levels_with_a_score_are_not_played_all_the_time(bank):
    rng, sampler = np.random.default_rng(0), PrioritizedSampler(bank, "regret")
    drawn = []
    for _ in range(200):
        drawn.append(sampler.draw(rng))
        sampler.record(LevelOutcome(drawn[-1], True, False, -1.0, 0.1))
    assert np.bincount(drawn).max() <= 12


def test_a_level_whose_episode_was_aborted_is_drawn_again():
    few = ScenarioBank.shipped("clutter", "train")
    rng, sampler = np.random.default_rng(0), RegretSampler(few)
    aborted = [sampler.draw(rng) for _ in range(64)]
    for _ in range(2000):
        sampler.record(LevelOutcome(sampler.draw(rng), True, False, -1.0, 0.1))
    assert (sampler.plays[aborted] > 0).all()


class CountingSampler:
    """A sampler of a user, which draws integers of NumPy."""

    def __init__(self):
        self.outcomes = []

    def draw(self, rng):
        return rng.integers(10)

    def record(self, outcome):
        self.outcomes.append(outcome)


def test_a_sampler_may_draw_integers_of_numpy(bank):
    sampler = CountingSampler()
    venv = gym.make_vec(ID, 4, **SAME, bank=bank, sampler=sampler)
    venv.reset(seed=0)
    for _ in range(260):
        venv.step(np.tile([0.5, 0.0], (4, 1)))
    assert len(sampler.outcomes) >= 4 and {type(outcome.index) for outcome in sampler.outcomes} == {int}


@pytest.mark.parametrize("terminate_on_collision", [True, False])
def test_the_return_of_an_outcome_is_the_sum_of_the_rewards(bank, terminate_on_collision):
    sampler = CountingSampler()
    options = {**SAME, "terminate_on_collision": terminate_on_collision}
    venv = gym.make_vec(ID, 4, **options, bank=bank, sampler=sampler)
    venv.reset(seed=0)
    totals, ended = np.zeros(4), []
    for _ in range(260):
        _, rewards, terminated, truncated, _ = venv.step(np.tile([1.0, 0.1], (4, 1)))
        totals += rewards
        done = terminated | truncated
        ended += totals[done].tolist()
        totals[done] = 0.0
    assert len(ended) == len(sampler.outcomes) >= 4
    assert [outcome.episode_return for outcome in sampler.outcomes] == pytest.approx(ended)
    assert any(outcome.collision for outcome in sampler.outcomes)


def test_a_sampler_and_a_callback_have_to_fit_the_environment(bank):
    other = UniformSampler(ScenarioBank.shipped("clutter", "test"))
    with pytest.raises(ValueError, match=r"sampler: expected one for the bank .*clutter-train\.bank"):
        make_vec_env(n_envs=1, bank=bank, sampler=other)
    with pytest.raises(TypeError, match="sampler: expected an object with the methods draw and record, got 'uniform'"):
        make_vec_env(n_envs=1, bank=bank, sampler="uniform")
    with pytest.raises(TypeError, match="bank: expected a ScenarioBank, got str"):
        RegretSampler("clutter")
    with pytest.raises(TypeError, match="sampler: expected a PrioritizedSampler, got UniformSampler"):
        LevelScoring(UniformSampler(bank))
    venv = make_vec_env(n_envs=4, bank=bank, sampler=PrioritizedSampler(bank), control_period=0.2, lidar_beams=8)
    model = PPO("MlpPolicy", venv, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    with pytest.raises(ValueError, match="sampler: expected that of the training environment"):
        model.learn(256, callback=LevelScoring(PrioritizedSampler(bank)))


def test_scores_that_are_never_set_are_reported(bank):
    rng, sampler = np.random.default_rng(0), make_sampler("plr", bank)
    for _ in range(5 * len(bank)):
        sampler.record(LevelOutcome(sampler.draw(rng), True, False, -1.0, 0.1))
    with pytest.warns(UserWarning, match=r"no scores 'positive_value_loss'.*LevelScoring"):
        sampler.draw(rng)


@pytest.mark.parametrize("name", ["uniform", "plr", "learnability", "regret"])
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
        (lambda bank: PrioritizedSampler(bank, "surprise"), "score: .*'surprise'"),
        (lambda bank: PrioritizedSampler(bank, replay=2.0), "replay: "),
        (lambda bank: PrioritizedSampler(bank, temperature=0.0), "temperature: "),
        (lambda bank: make_sampler("random", bank), "name: .*'random'"),
        (lambda bank: make_vec_env(n_envs=1, split="fresh", sampler=UniformSampler(bank)), "sampler: "),
    ],
)
def test_bad_arguments_are_named(bank, make, message):
    with pytest.raises(ValueError, match=message):
        make(bank)
