"""Datasets of the episodes of any policies, for offline reinforcement learning."""

import json

import minari
import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import Scenario, ScenarioBank
from leapnav.experts import find_optimum
from leapnav.training import record


def loaded(folder, name, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return minari.load_dataset(name)


def test_a_mixture_of_policies_is_recorded_with_its_scores(tmp_path, monkeypatch, capsys):
    words = [
        "rollout",
        "--policy",
        "random",
        "open",
        "--family",
        "open",
        "--count",
        "6",
        "--out",
        str(tmp_path / "data"),
    ]
    assert main([*words, "--workers", "1", "--json", str(tmp_path / "summary.json")]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["name"] == "leapnav/open/mixed-v0" and summary["episodes"] == 6
    assert 0.5 <= summary["success"] < 1.0  # the included policy succeeds in each second scenario
    assert "success" in capsys.readouterr().out
    dataset = loaded(tmp_path / "data", summary["name"], monkeypatch)
    episodes = list(dataset.iterate_episodes())
    assert [bool(episode.infos["is_success"][-1]) for episode in episodes[1::2]] == [True] * 3
    returns = np.array([episode.rewards.sum() for episode in episodes])
    scores = minari.get_normalized_score(dataset, returns)
    assert (scores[1::2] > 0.98).all() and (scores[::2] < 0.6).all()
    bank = ScenarioBank.shipped("open", "test")
    assert dataset.storage.metadata["ref_max_score"] == pytest.approx(-bank.costs.mean())
    evaluation = dataset.recover_environment(eval_env=True)
    _, info = evaluation.reset(seed=0)
    assert info["reference_cost"] == bank.costs[info["index"]]


def test_an_episode_contains_what_happened(tmp_path, monkeypatch):
    found = record("clutter", "clutter", 2, tmp_path, name="noisy", noise=0.1, seed=31, progress=False)
    dataset = loaded(tmp_path, "leapnav/clutter/noisy-v0", monkeypatch)
    assert found.steps == dataset.total_steps and found.episodes == 2
    env = dataset.recover_environment()
    for episode, metadata in zip(dataset.iterate_episodes(), dataset.storage.get_episode_metadata([0, 1]), strict=True):
        scenario = Scenario.from_json(metadata["options"]["scenario"])
        assert scenario.name.endswith(str(metadata["seed"]))
        assert episode.infos["reference_cost"][0] == pytest.approx(find_optimum(scenario, "medium").cost)
        observation, _ = env.reset(options=metadata["options"])
        cost = 0.0
        for k, action in enumerate(episode.actions):
            assert observation == pytest.approx(episode.observations[k], abs=1e-6)
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == pytest.approx(episode.rewards[k], abs=1e-9)
            assert (terminated, truncated) == (episode.terminations[k], episode.truncations[k])
            cost += episode.infos["running_cost"][k + 1]
            assert cost == pytest.approx(info["cost"])
    env.close()


def test_the_same_arguments_give_the_same_episodes(tmp_path):
    first, second = (record("mppi", "open", 1, tmp_path / str(k), progress=False, seed=9) for k in (0, 1))
    assert first == second


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policies": []}, "policies: expected at least one"),
        ({"policies": ["open", "clutter"]}, "policies: expected policies that observe the same"),
        ({"policies": "car-clutter"}, "robot: expected 'car'.*got 'unicycle'"),
        ({"policies": "free-clutter"}, "horizon: expected 'free'.*got 'fixed'"),
        ({"name": "a/b"}, "name: expected letters, digits and hyphens, got 'a/b'"),
        ({"noise": -1.0}, "noise: expected"),
        ({"seed": 1}, "seed: expected at least 2, got 1"),
        ({"count": 0}, "count: expected"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        record(**{"policies": "random", "family": "open", "count": 1, "out": tmp_path, "progress": False, **arguments})


def test_a_directory_with_other_files_is_kept(tmp_path, capsys):
    record("random", "open", 1, tmp_path / "data", progress=False)
    words = ["rollout", "--policy", "random", "--family", "open", "--count", "1", "--out", str(tmp_path / "data")]
    assert main(words) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    assert main([*words, "--force", "--workers", "1"]) == 0
    assert main([*words, "--force", "--recoveries", "2"]) == 2
    assert "recoveries: expected 0 with --policy, got 2" in capsys.readouterr().err
    assert main(["rollout", "--name", "x", "--out", str(tmp_path / "other")]) == 2
    assert "name: expected --policy" in capsys.readouterr().err
