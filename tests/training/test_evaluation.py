import json
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from stable_baselines3 import PPO

from leapnav.envs import NavigateEnv, NavigateVectorEnv, Scenario, ScenarioBank
from leapnav.experts import ExpertPolicy, find_optimum, find_reached_optimum
from leapnav.experts.acting.policy import plan_actions
from leapnav.training import (
    Episode,
    Evaluation,
    GoToGoal,
    PolicyFactory,
    RandomPolicy,
    compare,
    evaluate,
    make_policy,
    network,
    profile,
    save_policy,
    score,
)
from leapnav.training.scoring.comparison import compare_policies
from leapnav.training.scoring.policy_specs import group_by_row, load_policy_spec, make_policy_from_spec
from leapnav.training.scoring.reports import (
    draw_episode,
    extremes,
    plot_episodes,
    plot_scores,
    print_scores,
    write_scores,
)
from leapnav.training.scoring.results import bank_identity


class Planned:
    """Drives the optima of the bank, with the speed multiplied by a factor."""

    def __init__(self, env, factor):
        self.env, self.factor, self.step = env.unwrapped, factor, 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        if np.any(episode_start):
            self.step = self.step if self.step and not np.all(episode_start) else 0
        single = isinstance(self.env, NavigateEnv)
        indices = [self.env.index] if single else self.env.indices
        rows = []
        for i in indices:
            plan = PLANS[i % COUNT]
            rows.append(plan[min(self.step, len(plan) - 1)] * np.float32([self.factor, 1.0]))
        self.step += 1
        actions = np.array(rows)
        return (actions[0] if single else actions), state


BANK, COUNT = ScenarioBank.shipped("open", "test"), 4
PLANS = [plan_actions(find_optimum(BANK[i]), BANK[i], 0.05) for i in range(COUNT)]


def test_the_expert_scores_one_and_random_zero():
    expert = evaluate(ExpertPolicy, "open", count=10, progress=False)
    assert expert.success == 1.0
    assert expert.soc == pytest.approx(1.0, abs=1e-3)
    assert abs(expert.regret) < 1e-3
    assert 0 < expert.milliseconds < 1000
    random = evaluate(
        PolicyFactory(lambda env: RandomPolicy(NavigateEnv().action_space)), "open", count=10, progress=False
    )
    assert random.success == 0.0
    assert random.soc == 0.0
    assert math.isnan(random.regret)
    assert [e.reference_cost for e in random] == pytest.approx(BANK.costs[:10].tolist())


def test_go_to_goal_succeeds_without_obstacles():
    found = evaluate(GoToGoal, "open", count=50, timed=False, progress=False)
    reached = np.mean([np.hypot(*(e.states[-1, :2] - np.array(BANK[e.index].goal[:2]))) < 0.3 for e in found])
    assert reached > 0.9
    blocked = evaluate(GoToGoal, "clutter", count=50, timed=False, progress=False)
    assert blocked.collision > 0.3


def test_the_episodes_are_those_of_the_single_environment():
    """The same policy has the same episodes in the single environment."""
    env = NavigateEnv("open", split="test")
    policy = make_policy(env.observation_space, env.action_space, 0, (16,))
    found = evaluate(policy, "open", count=5, timed=False, progress=False)
    for episode in found:
        observation, info = env.reset(options={"index": episode.index})
        poses, total, lowest, done = [info["pose"]], 0.0, math.inf, False
        while not done:
            observation, reward, done, _, info = env.step(policy.predict(observation, deterministic=True)[0])
            poses.append(info["pose"])
            total, lowest = total + float(reward), min(lowest, info["clearance"])
        np.testing.assert_allclose(episode.states, poses, atol=1e-5)
        assert episode.episode_return == pytest.approx(total, rel=1e-5)
        assert episode.cost == pytest.approx(info["cost"], rel=1e-5)
        assert episode.clearance == pytest.approx(lowest, abs=1e-4)
        assert episode.collision == info["collision"]


def test_evaluation_is_deterministic():
    random = PolicyFactory(lambda env: RandomPolicy(NavigateEnv().action_space, 4))
    one, other = (evaluate(random, "open", count=5, timed=False, progress=False) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.states, b.states)
        assert a.cost == b.cost


def test_regret_is_measured_against_the_pose_that_was_reached():
    """A policy that stops before the goal has a lower cost than J*; the optimum to its final pose has, too."""
    found = evaluate(PolicyFactory(lambda env: Planned(env, 0.995)), "open", count=COUNT, timed=False, progress=False)
    assert found.success == 1.0
    for episode in found:
        assert episode.cost < episode.reference_cost
        assert abs(episode.cost - episode.reference_cost) > 1e-3
        assert 0 <= episode.reached_regret < 2e-3
        assert episode.reached_soc == pytest.approx(1 / (1 + episode.reached_regret), rel=1e-12)
        assert episode.soc == pytest.approx(1 / (1 + max(0.0, episode.regret)), rel=1e-12)
        assert episode.ratio == pytest.approx(1 + episode.regret, rel=1e-12)
        reached = BANK[episode.index].model_copy(update={"goal": tuple(episode.states[-1].tolist())})
        assert episode.reached_reference == pytest.approx(find_optimum(reached).cost, rel=1e-5)


def test_an_episode_that_is_cheaper_than_the_guess_is_compared_with_the_optimum_of_its_own_path_class():
    scenario = Scenario.from_discs([[4, 2.4, 0.5]], start=(1, 2.5, 0), goal=(7, 2.5, 0), horizon=8)
    optimum = find_optimum(scenario)
    worse = optimum.alternatives[0]
    found = find_reached_optimum(scenario, scenario.goal, cost=0.5 * (optimum.cost + worse.cost), guess=worse)
    assert found.cost == pytest.approx(optimum.cost, rel=1e-9)
    # An episode that costs more than the guess is compared with that, in one solve.
    found = find_reached_optimum(scenario, scenario.goal, cost=worse.cost * (1 + 1e-6), guess=worse)
    assert found.cost == pytest.approx(worse.cost, rel=1e-9)


def test_bad_arguments_are_named():
    env = NavigateEnv("open", lidar_beams=16)
    policy = PPO("MlpPolicy", env, policy_kwargs=network((16,)))
    with pytest.raises(ValueError, match=r"policy: expected observations \(25,\), got \(41,\)"):
        evaluate(policy.policy, "open", count=1, progress=False)
    assert len(evaluate(policy.policy, "open", count=1, environment={"lidar_beams": 16}, progress=False)) == 1
    assert len(evaluate(policy, "open", count=1, progress=False)) == 1  # the model knows its environment
    with pytest.raises(ValueError, match=r"family: expected .* got 'moon'"):
        evaluate(policy, "moon")
    with pytest.raises(ValueError, match="count: expected at least one scenario, got 0"):
        evaluate(policy, "open", count=0)


def episode(success=True, collision=False, cost=2.0, reference=1.0, family="open", index=0):
    return Episode(
        family=family,
        bank=family,
        index=index,
        scenario=f"{family}-{index}",
        success=success,
        collision=collision,
        cost=cost,
        episode_return=-cost,
        reference_cost=reference,
        reached_reference=reference if success else math.nan,
        clearance=0.2,
        reference_clearance=0.3,
        reversing=False,
        states=np.zeros((2, 3)),
        costs=np.array([0.0, cost]),
    )


def run(*episodes):
    numbered = [Episode(**{**vars(e), "index": i}) for i, e in enumerate(episodes)]
    return Evaluation(tuple(numbered), 0.5)


def test_the_score_is_what_its_definition_says():
    found = score("policy", run(episode(cost=1), episode(cost=2), episode(cost=4), episode(False, True)))
    assert found.success.value == 0.75
    assert found.collision.value == 0.25
    assert found.soc.value == pytest.approx((1 + 1 / 2 + 1 / 4 + 0) / 4)
    assert found.soc_iqm.value == pytest.approx((1 / 2 + 1 / 4) / 2)
    assert found.regret.value == 1.0
    assert found.reached_soc.value == found.soc.value and found.reached_regret.value == 1.0 and found.unknown == 0
    assert found.mean_return.value == -(1 + 2 + 4 + 2) / 4
    assert found.success.low < 0.75 < found.success.high
    assert found.milliseconds == 0.5


def test_the_soc_does_not_depend_on_the_pose_reached():
    """J* of the scenario is 1; the policy stopped short at a pose with J* = 0.5, or at one whose J* is not known."""
    short, unknown = (replace(episode(cost=2.0), reached_reference=value) for value in (0.5, math.nan))
    assert short.soc == unknown.soc == 0.5 and short.regret == unknown.regret == 1.0
    assert short.reached_soc == 0.25 and short.reached_regret == 3.0
    found = score("policy", run(short, unknown, episode(False)))
    assert found.soc.value == pytest.approx(1 / 3) and found.unknown == 1
    assert found.reached_soc.value == 0.125 and found.reached_regret.value == 3.0  # of the episodes that are known


def test_an_evaluation_is_one_line_and_one_data_frame():
    found = run(episode(cost=1), episode(cost=2), episode(False, True))
    text = repr(found)
    assert "\n" not in text
    for part in ("3 episodes", "success 66.7 %", "collision 33.3 %", "SOC 0.500", "median regret 50.00 %"):
        assert part in text
    frame = found.to_dataframe()
    assert len(frame) == 3
    assert frame["success"].mean() == found.success
    assert frame["soc"].mean() == found.soc
    assert frame[frame["success"]]["regret"].median() == found.regret
    assert list(frame["index"]) == [0, 1, 2]


def test_the_performance_profile_counts_episodes_up_to_a_cost():
    value, low, high = profile(
        [run(episode(cost=1.0), episode(cost=1.5), episode(cost=3.0), episode(False, True, cost=0.5))],
        np.array([1.0, 1.5, 2.0, 3.0]),
    )
    assert value.tolist() == [0.25, 0.5, 0.5, 0.75]
    assert (low <= value).all()
    assert (value <= high).all()


def test_one_episode_and_none():
    single = score("policy", run(episode())).success
    assert (single.value, single.high) == (1.0, 1.0) and single.low == pytest.approx(0.2065, abs=1e-4)  # Wilson
    with pytest.raises(ValueError, match="expected runs with the same scenarios"):
        score("policy", [run(episode(), episode()), run(episode())])
    with pytest.raises(ValueError, match="policy: expected at least one run"):
        score("policy", [])


def test_a_random_policy_repeats_itself_for_the_same_seed():
    one, other = (RandomPolicy(NavigateEnv().action_space, 3) for _ in range(2))
    assert np.array_equal(one.predict(np.zeros((2, 41)))[0], other.predict(np.zeros((2, 41)))[0])
    assert one.predict(np.zeros(41))[0].shape == (2,)


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """A directory with two seeds of one method and another policy."""
    root, env = tmp_path_factory.mktemp("policies"), NavigateEnv("open")
    for seed in (0, 1):
        training = {"algorithm": "bc", "family": "open", "seed": seed, "out": f"anything-{seed}"}
        policy = make_policy(env.observation_space, env.action_space, seed, (16,))
        save_policy(policy, root / f"seed{seed}", training=training)
    save_policy(make_policy(env.observation_space, env.action_space, 5, (16,)), root / "other")
    return root


def test_seeds_of_one_method_share_a_row(policies):
    names = [str(policies / name) for name in ("seed0", "other", "seed1")]
    rows = group_by_row([load_policy_spec(name) for name in [*names, "expert"]])
    assert [[member.name for member in members] for members in rows.values()] == [
        [names[0], names[2]],
        [names[1]],
        ["expert"],
    ]
    labelled = group_by_row([load_policy_spec(f"mine={names[0]}"), load_policy_spec(f"mine={names[1]}")])
    assert list(labelled) == ["mine"]
    with pytest.raises(ValueError, match="expert: given more than once"):
        group_by_row([load_policy_spec("expert"), load_policy_spec("expert")])


def test_a_comparison_is_printed_written_and_plotted(policies, tmp_path, capsys):
    names = [str(policies / "seed0"), str(policies / "seed1"), "expert", "random", "go-to-goal"]
    banks = [ScenarioBank.shipped(family, "test") for family in ("open", "rooms")]
    found = compare_policies([load_policy_spec(name) for name in names], banks, count=4, progress=False)
    print_scores(found)
    printed = capsys.readouterr().out
    assert "expert" in printed
    assert "100.0" in printed
    assert "success % / SOC by family" in printed
    write_scores(found, tmp_path / "scores.json")
    content = json.loads((tmp_path / "scores.json").read_text())
    rows = {row["policy"]: row for row in content["scores"]}
    assert rows["random"]["regret"]["value"] is None
    assert rows[names[0]]["runs"] == 2
    assert content["episodes"]["expert"][0][0]["success"] is True
    assert {row["policy"] for row in content["families"]["rooms"]} == set(rows)
    plot_scores(found, tmp_path / "scores.png")
    plot_episodes(banks, found.runs["random"][0].episodes, tmp_path / "episodes.png")
    for name in ("scores.png", "episodes.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("reached", "title"), [(0.98, "regret 1.0 %"), (0.99001, "regret 0.0 %"), (math.nan, "regret unknown")]
)
def test_the_picture_of_an_episode_shows_the_regret_for_the_pose_reached(reached, title):
    stopped_short = replace(episode(cost=0.99), bank=bank_identity(BANK), reached_reference=reached)
    axes = Figure().subplots()
    draw_episode(axes, [BANK], stopped_short)
    assert axes.get_title() == f"open-0\n{title}"


def test_extremes_are_the_best_the_median_and_the_worst():
    episodes = [episode(cost=1 + k / 10) for k in range(9)] + [episode(False), episode(False, True)]
    rows = extremes(episodes, 2)
    assert [e.cost for e in rows["best"]] == [1.0, 1.1]
    assert [e.cost for e in rows["median"]] == pytest.approx([1.3, 1.4])
    assert [e.collision for e in rows["worst"]] == [True, False]
    assert list(extremes([episode(False, True)], 2)) == ["worst"]
    few = extremes([episode(cost=1 + k / 10) for k in range(3)], 2)  # each episode once
    assert {group: [e.cost for e in chosen] for group, chosen in few.items()} == {"best": [1.0, 1.1], "worst": [1.2]}


def test_policies_by_name_drive_single_and_vector_environments(policies):
    for env in (NavigateEnv("open"), NavigateVectorEnv(3, "open")):
        observation, _ = env.reset(seed=0)
        for name in ("expert", "random", "go-to-goal", str(policies / "other")):
            action, _ = make_policy_from_spec(name, env).predict(observation, deterministic=True)
            assert action.shape == env.action_space.shape
    with pytest.raises(FileNotFoundError):
        load_policy_spec("nobody")


def test_the_included_bank_is_that_of_the_policy_s_robot():
    found = evaluate(ExpertPolicy, "clutter", count=2, environment={"robot": "car"}, timed=False, progress=False)
    bank = ScenarioBank.shipped("clutter", "test", "car")
    assert [episode.reference_cost for episode in found] == pytest.approx(bank.costs[:2])
    comparison = compare({"expert": "expert", "mine": (ExpertPolicy, {"robot": "car"})}, "clutter", count=2)
    assert [bank.robot.model for bank in comparison.banks] == ["car"]
    with pytest.raises(ValueError, match="policies: expected policies of one robot, got car, unicycle"):
        compare({"a": (ExpertPolicy, {"robot": "car"}), "b": (ExpertPolicy, {})}, "clutter", count=2)
