from dataclasses import replace

import numpy as np
import pytest

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.experts import ExpertPolicy
from leapnav.training import GoToGoal, regret
from leapnav.training.scoring import decisions, evaluation
from leapnav.training.scoring.decision_reports import costliest_decisions, plot_decisions, print_decisions
from leapnav.training.scoring.policy_specs import load_policy_spec


def late(policy, steps=40):
    """A policy that stands still for some steps, then acts as another one."""

    class Late:
        def __init__(self, env):
            self._inner, self._left = policy(env), steps

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self._left -= 1
            actions, state = self._inner.predict(observation, state, episode_start, deterministic)
            return (actions * 0.0 if self._left >= 0 else actions), state

    return Late


def test_the_expert_has_no_regret():
    found = regret(ExpertPolicy, "clutter", count=3, decisions=True, resolution=1.0, progress=False)
    assert found.levels.max() < 1e-2 * found.evaluation.episodes[0].cost
    assert len(found.decisions) == 3 and all(np.isnan(one.lost_at) for one in found.decisions)


def test_waiting_costs_regret_where_the_robot_waits():
    """The regret of the decisions is that of the level, and is incurred while the robot waits."""
    found = regret(late(ExpertPolicy), "clutter", count=2, decisions=True, resolution=0.5, progress=False)
    for one, episode, level in zip(found.decisions, found.evaluation, found.levels, strict=True):
        assert episode.success and (one.regrets >= 0.0).all()
        assert one.regrets.sum() == pytest.approx(level) and level == pytest.approx(
            episode.cost - episode.reached_reference
        )
        waiting = one.times[:-1] < 2.0 - 1e-9
        assert one.regrets[waiting].sum() > 0.97 * level > 0.1
        assert one.states.shape == (len(one.times), 3)
    index, time, value = found.worst(1)[0]
    assert value == max(one.regrets.max() for one in found.decisions) and time < 2.0 and index in (0, 1)


def test_failures_cost_the_penalties_and_are_lost_before_they_end(tmp_path, capsys):
    found = regret(GoToGoal, "clutter", count=4, progress=False, environment={"miss_penalty": 20.0})
    assert found.decisions is None
    for episode, level in zip(found.evaluation, found.levels, strict=True):
        if not episode.success:
            penalty = 20.0 + 50.0 * episode.collision
            assert level == pytest.approx(episode.cost + penalty - episode.reference_cost)
    with pytest.raises(ValueError, match="decisions: expected"):
        found.worst()
    bank = ScenarioBank.shipped("clutter", "test")
    decisions = costliest_decisions(found.evaluation, [bank], 2, progress=False)
    assert decisions[0].regrets.sum() == pytest.approx(found.levels.max())
    plot_decisions(decisions, [bank], tmp_path / "decisions.png")
    assert (tmp_path / "decisions.png").stat().st_size > 10_000
    print_decisions(decisions)
    assert decisions[0].episode.scenario in capsys.readouterr().out


@pytest.mark.parametrize("decisions", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_regret_of_a_failure_is_that_of_the_returns(decisions):
    """Also of episodes that continue after a contact, until the time limit of a free horizon."""
    environment = {"horizon": "free", "terminate_on_collision": False}
    found = regret(GoToGoal, count=4, decisions=decisions, resolution=20.0, environment=environment, progress=False)
    failures = [not episode.success for episode in found.evaluation]
    assert any(failures) and any(episode.collision and episode.truncated for episode in found.evaluation)
    for episode, level in zip(found.evaluation, found.levels, strict=True):
        if not episode.success:
            assert level == pytest.approx(-episode.episode_return - episode.reference_cost)


def test_a_robot_that_stands_still_loses_before_the_horizon():
    """The interval before the first state without an optimum has the regret of the penalty."""
    found = regret(late(ExpertPolicy, 10_000), "open", count=1, decisions=True, progress=False)
    (one,) = found.decisions
    assert 0.0 < one.lost_at < one.times[-1]
    lost = int(np.searchsorted(one.times, one.lost_at - 1e-9))
    assert (one.regrets[lost:] == 0.0).all() and one.regrets[lost - 1] == one.regrets.max() > 10.0
    assert (np.diff(one.regrets[: lost - 1]) > 0.0).all()  # the later, the faster the robot must drive


def test_a_policy_by_name_on_the_file_of_a_bank():
    path = ScenarioBank.shipped("open", "test").path
    found = regret("open", path, count=2, decisions=True, resolution=5.0, progress=False)
    assert [one.episode.index for one in found.decisions] == [0, 1]
    assert (found.levels == regret("open", "open", count=2, progress=False).levels).all()


def test_decisions_are_scored_among_the_obstacles_of_the_training(monkeypatch):
    """The bank is the one on which the policy is evaluated."""
    spec = replace(load_policy_spec("go-to-goal"), obstacles="hard")
    monkeypatch.setattr(evaluation, "load_policy_spec", lambda name, seed: spec)
    seen = []
    monkeypatch.setattr(decisions, "decisions_of", lambda evaluation, bank, **_: seen.append(bank) or [])
    regret("go-to-goal", "clutter", count=1, decisions=True, progress=False)
    assert seen == [ScenarioBank.shipped("clutter", "test", obstacles="hard")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"resolution": 0.0}, "resolution: "), ({"workers": 0}, "workers: "), ({"count": 0}, "count: ")],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        regret(ExpertPolicy, "open", progress=False, **arguments)
