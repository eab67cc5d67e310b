"""Comparison of one's own methods with the optimum and with other policies."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from helpers import SMALL
from matplotlib.figure import Figure
from stable_baselines3 import PPO

from leapnav.cli import main
from leapnav.envs import ScenarioBank
from leapnav.experts import ExpertPolicy
from leapnav.training import (
    PolicyFactory,
    RandomPolicy,
    compare,
    evaluate,
    make_policy,
    network,
    plot_episodes,
    plot_scores,
    print_scores,
    save_policy,
    write_report,
)
from leapnav.training.scoring.reports import training_notes


def towards_the_goal(observation):
    """A policy as a plain function: turn towards the goal and drive at the speed that is needed."""
    ahead, left, needed = observation[0], observation[1], observation[7]
    return np.clip([0.5 * needed * math.copysign(1, ahead), math.atan2(left, abs(ahead))], -1, 1)


def test_a_model_observes_what_its_environment_contains(tmp_path):
    env = gym.make("leapnav/Navigate-v0", family="open", observation="state", control_period=0.4)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0)
    alone = evaluate(model, "open", count=2, progress=False)
    assert alone.settings.sensors == "goal and motion, every 0.4 s"
    (compared,) = compare({"model": model}, "open", count=2, progress=False).runs["model"]
    save_policy(model, tmp_path / "policy")
    saved = evaluate(tmp_path / "policy", "open", count=2, progress=False)
    assert [e.cost for e in alone] == [e.cost for e in compared] == [e.cost for e in saved]
    # Given arguments take precedence; those of the whole comparison only where nothing is known of a policy.
    changed = evaluate(model, "open", count=2, progress=False, environment={"control_period": 0.2})
    assert changed.settings == replace(alone.settings, control_period=0.2)
    settings = {"control_period": 0.1, "observation": "map"}
    policies = {"model": (model, {"control_period": 0.2}), "own": model, "other": towards_the_goal, "name": "open"}
    runs = compare(policies, "open", count=1, environment=settings, progress=False).runs
    found = [(runs[name][0].settings.observation, runs[name][0].settings.control_period) for name in policies]
    assert found == [("state", 0.2), ("state", 0.4), ("map", 0.1), ("lidar", 0.1)]
    # Where the observations of a policy are known by its name, those of the comparison are not used.
    model.save(tmp_path / "model.zip")
    named = {"zip": (str(tmp_path / "model.zip"), {"control_period": 0.2}), "go": "go-to-goal"}
    runs = compare(named, "open", count=1, environment=settings, progress=False).runs
    found = [(runs[name][0].settings.observation, runs[name][0].settings.control_period) for name in named]
    assert found == [("state", 0.2), ("state", 0.1)]
    wrapped = gym.wrappers.TransformObservation(env, lambda observation: 0 * observation, None)
    with pytest.warns(UserWarning, match="trained with the wrappers TransformObservation, which are not applied"):
        evaluate(PPO("MlpPolicy", wrapped, n_steps=8, batch_size=8), "open", count=1, progress=False)


@pytest.mark.usefixtures("coarse_decisions")
def test_all_kinds_of_policies_are_compared(env, tmp_path):
    found = compare(
        {
            "function": towards_the_goal,
            "object": RandomPolicy(env.action_space),
            "class": ExpertPolicy,
            "factory": PolicyFactory(lambda env: ExpertPolicy(env, feedback="gains")),
            "name": "go-to-goal",
            "included": "slalom",
            "other observations": (lambda observation: [0.0, 0.0], {"observation": "state"}),
            "seeds": [make_policy(env.observation_space, env.action_space, seed, SMALL) for seed in (0, 1)],
        },
        "open",
        count=1,
        progress=False,
    )
    rows = {row.policy: row for row in found.scores()}
    assert list(rows) == ["function", "object", "class", "factory", "name", "included", "other observations", "seeds"]
    assert rows["class"].soc.value == pytest.approx(1.0, abs=1e-3) and rows["factory"].success.value == 1.0
    assert rows["seeds"].runs == 2 and rows["other observations"].success.value == 0.0
    assert rows["function"].mean_return.value > rows["object"].mean_return.value
    assert repr(found).startswith("<Comparison: open; SOC: function ")
    frame = found.to_dataframe()
    assert len(frame) == 9 and set(frame.policy) == set(rows) and set(frame.bank) == {"open"}
    assert frame[frame.policy == "seeds"].run.tolist() == [0, 1]
    assert training_notes(found) == ["open: included trained in another family: slalom"]
    print_scores(found)
    plot_scores(found, tmp_path / "scores.png")
    plot_episodes(found.banks, found.runs["function"][0].episodes, tmp_path / "episodes.png")
    write_report(found, tmp_path / "report.html", progress=False)
    page = (tmp_path / "report.html").read_text()
    assert "Comparison of policies" in page and "Learning curves" not in page and "<h2>Runs</h2>" not in page
    assert page.count("data:image/png") == 2 * len(rows)  # episodes and decisions


@pytest.mark.parametrize("title", [None, "own"])
def test_pictures_of_episodes_have_the_title_that_is_given(title, tmp_path, monkeypatch):
    found, titles = compare({"random": "random"}, "open", count=3, progress=False), []
    monkeypatch.setattr(Figure, "suptitle", lambda _, text: titles.append(text))
    plot_episodes(found.banks, found.runs["random"][0].episodes, tmp_path / "episodes.png", title=title)
    assert titles == ([] if title is None else [title])


def test_a_function_gets_one_observation_at_a_time_and_dictionaries_too():
    shapes = set()

    def still(observation):
        shapes.add(observation["goal"].shape)
        return (0, 0)

    found = evaluate(still, "open", count=2, environment={"dict_observation": True}, progress=False)
    assert shapes == {(9,)} and found.success == 0.0


def test_banks_are_given_in_any_form(env):
    bank = ScenarioBank.shipped("rooms", "test")
    policy = RandomPolicy(env.action_space)
    assert compare({"random": policy}, bank, count=1, progress=False).families == ("rooms",)
    assert compare(
        {"random": policy}, [bank, ScenarioBank.shipped("open", "test")], count=1, progress=False
    ).families == (
        "rooms",
        "open",
    )
    assert len(compare({"random": policy}, "all", count=1, progress=False).families) == 5


@pytest.mark.usefixtures("coarse_decisions")
def test_the_commands_take_models_of_stable_baselines3(env, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    PPO("MlpPolicy", env, policy_kwargs=network(SMALL), device="cpu").save("model.zip")
    assert main(["evaluate", "mine=model.zip", "expert", "--family", "open", "--count", "2"]) == 0
    assert "mine" in capsys.readouterr().out
    assert main(["evaluate", "model.zip", "go-to-goal", "--family", "open", "--count", "2", "--html", "page.html"]) == 0
    page = (tmp_path / "page.html").read_text()
    assert "model.zip" in page and "go-to-goal" in page and "Learning curves" not in page
