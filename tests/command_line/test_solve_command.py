"""The command `solve`."""

import json

import pytest
from helpers import SOLVERS, best_known, failing, let_newton_stall, scenario_fields

from leapnav.cli import main
from leapnav.envs import sample_scenario
from leapnav.experts import find_optimum


@pytest.fixture
def scenario_file(tmp_path):
    scenario, cost = best_known()[0]
    path = tmp_path / "scenario.json"
    scenario.to_json(path)
    return path, cost


METHODS = set(SOLVERS)


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
    monkeypatch.setattr("leapnav.experts.plotting.extremals.plot_extremal", lambda extremal, *_: drawn.append(extremal))
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


def test_a_cheaper_solution_without_a_certificate_is_printed_first_and_is_exit_code_1(tmp_path, capsys, monkeypatch):
    scenario, path = sample_scenario("clutter", 0), tmp_path / "scenario.json"
    scenario.to_json(path)
    best = find_optimum(scenario)
    let_newton_stall(monkeypatch, best.cost)
    assert main(["solve", str(path)]) == 1
    doubt, solution, *_ = capsys.readouterr().out.splitlines()
    assert f"a cheaper solution is not certified: J = {best.cost:.3f}"[:-2] in doubt and "SUCCESS" in solution


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


def test_a_plot_in_an_unknown_format_is_refused(scenario_file, tmp_path, capsys):
    code, line = failing(["solve", scenario_file[0], "--plot", tmp_path / "path.xyz"], capsys)
    assert code == 2
    assert "xyz" in line


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


def test_deviations_that_are_not_finite_are_null_in_json(tmp_path, capsys, monkeypatch):
    from leapnav.experts.data import rollouts

    replay = rollouts.Replay(episodes=1, observation=float("inf"), reward=0.0, state=float("nan"), worst=0)
    monkeypatch.setattr(rollouts, "check_dataset", lambda folder: replay)
    assert main(["dataset", "check", str(tmp_path), "--json", "-"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found == {"episodes": 1, "observation": None, "reward": 0.0, "state": None, "worst": 0}
