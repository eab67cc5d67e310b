"""A bank of scenarios with a robot of their own, from the rollout to the report, without the robot being named."""

import json
from pathlib import Path

import gymnasium as gym
import pytest

from leapnav.cli import main
from leapnav.envs import NavigateEnv
from leapnav.envs.robots import Unicycle
from leapnav.envs.scenarios.families import sample_scenario, task_of
from leapnav.experts import build_bank
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.training import BCConfig, DAggerRunConfig

WIDE = Unicycle(radius=0.3)
SMALL = ["--hidden", "16", "16", "--lidar-beams", "8", "--evaluation-scenarios", "2", "--observation", "lidar"]


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    path = tmp_path_factory.mktemp("bank") / "wide.bank"
    build_bank("open", 4, path, robot=WIDE, horizon="free", seed=5, progress=False)
    return str(path)


def test_the_task_of_a_bank_is_that_of_its_scenarios(bank):
    assert task_of(bank) == task_of(bank, "unicycle", "free", "cost") == (WIDE, "free", "cost")
    assert task_of("open") == (Unicycle(), "fixed", "cost") and task_of("open", "car")[0].model == "car"
    assert task_of(bank, Unicycle())[0] == Unicycle()  # given with its parameters
    assert sample_scenario(bank, 3).robot == WIDE
    with pytest.raises(ValueError, match=r"robot: expected that of the scenarios of .*radius=0.3.*got .*radius=0.25"):
        sample_scenario(bank, 3, Unicycle())
    with pytest.raises(ValueError, match=r"horizon: expected that of the scenarios of .*'free', got 'fixed'"):
        sample_scenario(bank, 3, horizon="fixed")
    env = NavigateEnv(bank)
    env.reset(seed=0)
    assert env.scenario.robot == WIDE and env.settings.horizon == "free"
    assert gym.make("leapnav/Navigate-v0", family=bank).unwrapped.settings.horizon == "free"


def test_the_settings_of_a_run_follow_the_bank(bank, tmp_path):
    config = DAggerRunConfig(out=tmp_path, family=bank)
    assert config.task == {"robot": "unicycle", "horizon": "free", "obstacles": "cost"}
    assert config.environment["horizon"] == "free" and config.environment["previous_action"]
    assert BCConfig(out=tmp_path).task == {"robot": "unicycle", "horizon": "fixed", "obstacles": "cost"}


@pytest.mark.usefixtures("coarse_decisions")
def test_rollout_training_evaluation_and_report_need_no_robot(bank, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "--family", bank, "--count", "4", "--out", "demos", "--workers", "1"]) == 0
    assert {demonstration.scenario.robot for demonstration in load_demonstrations("demos")} == {WIDE}
    train = ["train", "bc", "--family", bank, "--demos", "demos", "--out", "clone", "--cloning.epochs", "1"]
    assert main([*train, *SMALL]) == 0
    few = ["--dagger.rounds", "1", "--dagger.max-episodes", "2", "--dagger.max-failures", "1", "--dagger.lead", "0.5"]
    train = ["train", "dagger", "--family", bank, "--demos", "demos", "--out", "dagger", "--cloning.epochs", "1"]
    assert main([*train, *few, *SMALL]) == 0
    lines = [json.loads(line) for line in Path("dagger/evaluations.jsonl").read_text().splitlines()]
    assert [line["split"] for line in lines] == ["train", "test"]
    capsys.readouterr()
    assert main(["evaluate", "clone", "lattice", "--html", "page.html", "--count", "2", "--workers", "1"]) == 0
    assert "2 scenarios" in capsys.readouterr().out
    assert main(["rollout", "--policy", "clone", "--family", bank, "--count", "1", "--out", "driven"]) == 0
