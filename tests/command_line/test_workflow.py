"""Commands one after the other, and what all commands have in common: files, JSON, messages."""

import json

import pytest
from helpers import FastClock, best_known, failing

from leapnav.cli import main
from leapnav.commands.demo import DemoSettings, run_demo
from leapnav.training.fit_settings import CloningConfig


@pytest.fixture
def scenario_file(tmp_path):
    scenario, cost = best_known()[0]
    path = tmp_path / "scenario.json"
    scenario.to_json(path)
    return path, cost


def test_missing_files_and_folders_are_named_before_the_work(scenario_file, tmp_path, capsys):
    missing = tmp_path / "missing"
    for arguments in (
        ["solve", missing / "scenario.json"],
        ["solve", tmp_path],
        ["solve", scenario_file[0], "--json", missing / "out.json"],
        ["solve", scenario_file[0], "--plot", missing / "out.png"],
        ["evaluate", missing],
        ["evaluate", "expert", "--bank", missing],
        ["evaluate", "expert", "expert", "--count", "1", "--family", "open"],
        ["evaluate", "expert", "--family", "moon"],
        ["evaluate", "expert", "--episodes-plot", missing / "out.png"],
        ["evaluate", tmp_path, "--html", missing / "report.html"],
        ["solve", scenario_file[0], "--plot", tmp_path],
        ["solve", scenario_file[0], "--plot", tmp_path / "nosuffix"],
        ["rollout", "--out", scenario_file[0] / "demos"],
        ["evaluate"],
        ["evaluate", "expert", "--json", missing / "out.json"],
        ["rollout", "--out", tmp_path / "out", "--family", "moon"],
        ["rollout", "--out", tmp_path / "out", "--count", "-3"],
        ["rollout", "--out", tmp_path],
        ["train", "bc", "--demos", missing, "--out", tmp_path / "policy"],
        ["train", "dagger", "--policy", missing, "--out", tmp_path / "policy"],
        ["train", "ppo", "--family", "moon", "--out", tmp_path / "policy"],
        ["train", "ppo", "--warm-start", missing, "--out", tmp_path / "policy"],
        ["train", "ppo", "--resume", "--out", missing],
    ):
        code, line = failing(arguments, capsys)
        assert code == 2, arguments
        assert "missing" in line or "moon" in line or "-3" in line or str(tmp_path) in line or "policies" in line
    assert not (tmp_path / "policy").exists()


@pytest.mark.usefixtures("coarse_decisions")
def test_rollout_train_and_evaluate_work_together(tmp_path, capsys):
    demos, run, table = tmp_path / "demos", tmp_path / "run", tmp_path / "scores.json"
    assert main(["rollout", "--family", "open", "--count", "6", "--workers", "1", "--out", str(demos)]) == 0
    train = ["train", "bc", "--family", "open", "--demos", str(demos), "--out", str(run), "--cloning.epochs", "2"]
    assert main([*train, "--hidden", "16", "16", "--evaluation-scenarios", "2"]) == 0
    assert "open: success" in capsys.readouterr().out
    arguments = ["evaluate", "expert", str(run), "go-to-goal", "--family", "open", "--count", "3", "--json", str(table)]
    plots = ["--plot", str(tmp_path / "plot.png"), "--episodes-plot", str(tmp_path / "episodes.png")]
    assert main([*arguments, *plots]) == 0
    rows = json.loads(table.read_text())["scores"]
    assert [row["policy"] for row in rows] == ["expert", str(run), "go-to-goal"]
    assert rows[0]["success"]["value"] == 1.0
    assert (tmp_path / "plot.png").exists()
    assert (tmp_path / "episodes.png").exists()
    assert main(["evaluate", str(run), "--count", "2", "--html", str(tmp_path / "report.html")]) == 0
    assert "<svg" in (tmp_path / "report.html").read_text()
    assert failing(train, capsys)[0] == 2
    assert failing(["rollout", "--count", "1", "--out", demos], capsys)[0] == 2
    # A resumed run has its own settings; they need not be repeated and cannot be changed.
    assert main(["train", "bc", "--out", str(run), "--resume"]) == 0
    code, line = failing(["train", "bc", "--out", run, "--resume", "--seed", "5"], capsys)
    assert code == 2
    assert "seed: the run in" in line


def test_the_demo_runs_and_a_second_run_uses_what_is_there(tmp_path, capsys):
    settings = DemoSettings(
        training_scenarios=4, recoveries=1, test_scenarios=3, workers=1, cloning=CloningConfig(epochs=1)
    )
    run_demo(tmp_path, settings)
    weights = (tmp_path / "policy" / "weights.pt").stat().st_mtime_ns
    scores = [line for line in (tmp_path / "scores.json").read_text().splitlines() if "milliseconds" not in line]
    assert "clone" in capsys.readouterr().out
    assert (tmp_path / "episodes.png").exists()
    run_demo(tmp_path, settings)
    assert "Using" in capsys.readouterr().out
    assert (tmp_path / "policy" / "weights.pt").stat().st_mtime_ns == weights
    again = (tmp_path / "scores.json").read_text().splitlines()
    assert [line for line in again if "milliseconds" not in line] == scores
    with pytest.raises(ValueError, match="other settings"):
        run_demo(tmp_path, DemoSettings())


@pytest.mark.parametrize(
    "words",
    [
        ["solve", "{scenario}"],
        ["solve", "{scenario}", "--method", "all"],
        ["bank", "build", "--family", "open", "--count", "2", "--workers", "1", "--out", "{folder}/small.bank"],
        ["bank", "show", "open-test"],
        ["rollout", "--family", "open", "--count", "2", "--workers", "1", "--out", "{folder}/demos"],
        ["evaluate", "go-to-goal", "--family", "open", "--count", "2"],
        ["watch", "--family", "open", "--policy", "go-to-goal", "--episodes", "1"],
        ["compile"],
        ["doctor"],
    ],
)
def test_every_command_writes_json_to_a_file_or_to_standard_output_alone(
    words, scenario_file, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", FastClock)
    words = [word.format(scenario=scenario_file[0], folder=tmp_path) for word in words]
    code = main([*words, "--json", "-"])
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert code == 0 and found and captured.err
    out = tmp_path / "found.json"
    assert main([*words, "--json", str(out)]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    written = json.loads(out.read_text())
    assert type(written) is type(found)
    assert written.keys() == found.keys() if isinstance(found, dict) else len(written) == len(found)
    assert failing([*words, "--json", tmp_path / "missing" / "x.json"], capsys)[0] == 2
