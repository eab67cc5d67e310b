import json
import subprocess
import sys

import pytest
from helpers import FastClock, best_known, failing, scenario_fields

from leapnav.cli import COMMANDS, main
from leapnav.commands.demo import DemoSettings, run_demo
from leapnav.training.config import CloningConfig


@pytest.fixture
def scenario_file(tmp_path):
    scenario, cost = best_known()[0]
    path = tmp_path / "scenario.json"
    scenario.to_json(path)
    return path, cost


METHODS = {"single_shooting", "multiple_shooting", "leapfrog", "collocation"}


@pytest.mark.parametrize("method", ["optimum", "leapfrog", "multiple_shooting", "collocation"])
def test_solve_prints_draws_and_writes(method, scenario_file, tmp_path, capsys):
    path, cost = scenario_file
    plot, out = tmp_path / "path.png", tmp_path / "out.json"
    assert main(["solve", str(path), "--method", method, "--plot", str(plot), "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "SUCCESS" in printed
    assert "iterations" in printed
    assert "evaluations" in printed
    solution = json.loads(out.read_text())
    assert solution["success"] is True
    assert solution["cost"] == pytest.approx(cost, rel=1e-4)
    assert len(solution["times"]) == len(solution["states"]) == len(solution["costates"])
    assert plot.read_bytes()[:4] == b"\x89PNG"


def compared(text):
    """The rows of the table of methods by method: status, cost, residual, iterations, evaluations, time."""
    rows = [line.split() for line in text.splitlines()]
    return {row[0]: row[1:] for row in rows if len(row) == 7 and row[0] in METHODS}


def test_all_methods_are_compared_side_by_side(scenario_file, tmp_path, capsys):
    path, cost = scenario_file
    plot, out = tmp_path / "path.png", tmp_path / "out.json"
    assert main(["solve", str(path), "--method", "all", "--plot", str(plot), "--json", str(out)]) == 0
    table = compared(capsys.readouterr().out)
    assert table.keys() == METHODS
    for status, value, residual, iterations, evaluations, milliseconds in table.values():
        assert status == "SUCCESS"
        assert float(value) == pytest.approx(cost, rel=1e-6)
        assert float(residual) <= 1e-8
        assert int(iterations) > 0
        assert int(evaluations) > 100
        assert 0.1 < float(milliseconds) < 10_000
    solutions = json.loads(out.read_text())
    assert solutions.keys() == METHODS
    assert len({round(solution["cost"], 6) for solution in solutions.values()}) == 1
    assert all(len(solutions[method]["history"]) == int(table[method][3]) for method in METHODS)
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_a_method_that_fails_advises_and_the_cheapest_success_is_drawn(tmp_path, capsys, monkeypatch):
    scenario, cost = next((scenario, cost) for scenario, cost in best_known() if scenario.name == "clutter-9")
    path, out, drawn = tmp_path / "scenario.json", tmp_path / "out.json", []
    scenario.to_json(path)
    monkeypatch.setattr("leapnav.experts.plotting.plot_extremal", lambda extremal, *_: drawn.append(extremal))
    arguments = ["solve", str(path), "--method", "all", "--plot", str(tmp_path / "path.png"), "--json", str(out)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    table = compared(printed)
    assert table.keys() == METHODS
    solutions = json.loads(out.read_text())
    failed = {method for method in METHODS if not solutions[method]["success"]}
    assert "single_shooting" in failed
    for method in METHODS:
        assert table[method][0] == solutions[method]["status"]
        assert (f"{method}: {solutions[method]['advice']}" in printed) == (method in failed)
    (extremal,) = drawn
    assert extremal.success
    assert extremal.cost == min(solutions[method]["cost"] for method in METHODS - failed)
    assert extremal.cost == pytest.approx(cost, rel=1e-4)


@pytest.mark.parametrize("method", ["optimum", "all"])
def test_solve_without_a_solution_is_exit_code_1(method, tmp_path, capsys):
    walls = [{"polygon": {"vertices": [[5, y], [5.5, y], [5.5, y + 5], [5, y + 5]]}} for y in (0, 5)]
    path, out = tmp_path / "shut.json", tmp_path / "out.json"
    path.write_text(json.dumps(scenario_fields(obstacles=walls, start=[2, 5, 0], goal=[8, 5, 0])))
    arguments = ["solve", str(path), "--method", method, "--json", str(out), "--plot", str(tmp_path / "p.png")]
    assert main(arguments) == 1
    assert "NO_PATH: no path from start to goal" in capsys.readouterr().out
    solutions = json.loads(out.read_text())
    for solution in [solutions[name] for name in METHODS] if method == "all" else [solutions]:
        assert solution["status"] == "NO_PATH"
        assert solution["cost"] is None
    assert not (tmp_path / "p.png").exists()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{", "not valid JSON"),
        (json.dumps(scenario_fields(horizon=-1)), "horizon: expected a number > 0, got -1"),
        (json.dumps(scenario_fields(colour="red")), "colour: unknown field, got 'red'"),
        (json.dumps(scenario_fields(start=[4.0, 4.5, 0])), "start: (4, 4.5) is inside obstacles[0]"),
        (json.dumps(scenario_fields(horizon=float("nan"))), "horizon: expected a finite number, got nan"),
        ("\xff\xfe", "not valid JSON"),
        ("[]", "a scenario is a JSON object, got []"),
    ],
)
def test_a_faulty_scenario_file_is_one_line_and_exit_code_2(content, expected, tmp_path, capsys):
    path = tmp_path / "scenario.json"
    path.write_bytes(content.encode("latin-1"))
    code, line = failing(["solve", path], capsys)
    assert code == 2
    assert expected in line


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


def test_a_plot_in_an_unknown_format_is_refused(scenario_file, tmp_path, capsys):
    code, line = failing(["solve", scenario_file[0], "--plot", tmp_path / "path.xyz"], capsys)
    assert code == 2
    assert "xyz" in line


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


def test_a_custom_bank_can_be_played(tmp_path, capsys):
    bank = tmp_path / "mine.bank"
    arguments = ["bank", "build", "--family", "open", "--count", "3", "--seed", "5", "--workers", "1"]
    assert main([*arguments, "--out", str(bank)]) == 0
    assert main(["evaluate", "expert", "--bank", str(bank)]) == 0
    assert "3 scenarios" in capsys.readouterr().out


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


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS), ["train", "ppo"], ["bank", "build"]])
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command, "--help"])
    assert end.value.code in (0, None)
    assert " ".join(["usage: leapnav", *command]) in capsys.readouterr().out


def test_the_package_is_a_command():
    done = subprocess.run([sys.executable, "-m", "leapnav", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "usage: leapnav" in done.stdout


def test_solve_prints_and_plots_the_alternatives(tmp_path, capsys):
    from leapnav.envs import sample_scenario

    path, out, plot = tmp_path / "hard.json", tmp_path / "out.json", tmp_path / "hard.svg"
    sample_scenario("clutter", 910_065).to_json(path)
    assert main(["solve", str(path), "--json", str(out), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    solution = json.loads(out.read_text())
    assert len(solution["alternatives"]) >= 5
    for entry in (solution, *solution["alternatives"]):
        assert f"{entry['cost']:.6f}" in printed
        assert "".join(side[0].upper() for side in entry["path_class"]) in printed
        assert set(entry["driving_modes"]) <= {"forward", "backward"}
        assert isinstance(entry["heading_winding"], int)
        assert len(entry["states"]) == len(entry["times"])
    drawn = plot.read_text()
    assert f"best of {1 + len(solution['alternatives'])} local optima" in drawn
    assert "(+48 %), backward, forward, backward" in drawn


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


def test_deviations_that_are_not_finite_are_null_in_json(tmp_path, capsys, monkeypatch):
    from leapnav.experts.data import rollouts

    replay = rollouts.Replay(episodes=1, observation=float("inf"), reward=0.0, state=float("nan"), worst=0)
    monkeypatch.setattr(rollouts, "check_dataset", lambda folder: replay)
    assert main(["dataset", "check", str(tmp_path), "--json", "-"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found == {"episodes": 1, "observation": None, "reward": 0.0, "state": None, "worst": 0}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell, capsys):
    with pytest.raises(SystemExit) as end:
        main(["--tyro-print-completion", shell])
    printed = capsys.readouterr().out
    assert end.value.code in (0, None)
    assert all(word in printed for word in ("solve", "evaluate", "--episodes-plot", "play"))


def test_a_bank_is_built_and_shown(tmp_path, capsys):
    bank, sheet, report = tmp_path / "small.bank", tmp_path / "sheet.png", tmp_path / "report.json"
    alone = ["--workers", "1"]
    assert main(["bank", "build", "--family", "open", "--count", "3", "--seed", "9", "--out", str(bank), *alone]) == 0
    assert "3 of 3 sampled scenarios" in capsys.readouterr().out
    assert main(["bank", "show", str(bank), "--plot", str(sheet), "--count", "2", "--json", str(report)]) == 0
    printed = capsys.readouterr().out
    assert "3 scenarios of open, seed 9" in printed
    assert "clearance (m)" in printed
    assert sheet.read_bytes()[:4] == b"\x89PNG"
    names = [f"open-9-{k}" for k in range(3)]
    assert [entry["name"] for entry in json.loads(report.read_text())] == names
    assert main(["bank", "verify", str(bank), "--json", str(report), *alone]) == 0
    assert "cost lower by more than 0.1 % in 0 of 3 scenarios" in capsys.readouterr().out
    assert [entry["name"] for entry in json.loads(report.read_text())] == names


def test_a_shipped_bank_is_shown_by_its_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["bank", "show", "slalom-test"]) == 0
    assert "200 scenarios of slalom, seed 1" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "none.bank"], "none.bank: no such bank"),
        (["show", "{text}"], "not a scenario bank, or damaged"),
        (["show", "slalom-test", "--count", "0"], "count: expected at least 1, got 0"),
        (["show", "slalom-test", "--plot", "x.txt"], "x.txt: expected a name that ends in .png, .pdf, .svg"),
        (["verify", "slalom-test", "--workers", "0"], "workers: expected at least 1, got 0"),
        (["build", "--family", "moon", "--out", "x.bank"], "family: expected one of open, clutter, polygons"),
        (["build", "--count", "0", "--out", "x.bank"], "count: expected at least 1, got 0"),
        (["build", "--out", "no/folder/x.bank"], "no/folder: no such directory"),
        (["build", "--out", "{text}"], "not a scenario bank, or damaged"),
        (["build", "--out", "{folder}"], "is a directory"),
    ],
)
def test_bad_bank_arguments_are_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = tmp_path / "text.bank"
    text.write_text("no bank")
    arguments = [a.format(text=text, folder=tmp_path) for a in arguments]
    code, line = failing(["bank", *arguments], capsys)
    assert code == 2
    assert message in line
    assert text.read_text() == "no bank"
