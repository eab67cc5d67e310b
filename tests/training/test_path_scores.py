"""Success weighted by path length (SPL) and by completion time (SCT), and the values of banks that they need."""

import json
import math

import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import Obstacle, Scenario, ScenarioBank
from leapnav.envs.scenarios.bank import BankError
from leapnav.envs.scenarios.bank_writing import add_datasets
from leapnav.envs.shapes import Circle
from leapnav.experts import ExpertPolicy, build_bank_of
from leapnav.experts.data.bank_shortest import find_shortest, shortest
from leapnav.training import compare, evaluate
from leapnav.training.scoring.results import bank_identity


def straight(name, y=2.5):
    """A task whose minimum time is 3 m / 2 m/s, since the robot starts and ends at any speed."""
    return Scenario(
        name=name,
        arena=(0, 0, 8, 5),
        start=(1, y, 0),
        goal=(4, y, 0),
        horizon=None,
        cost={"time_weight": 1.0},
        obstacles=(Obstacle(circle=Circle(center=(6.5, 2.5), radius=0.5)),),
    )


@pytest.fixture(scope="module")
def bank_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("banks") / "straight.bank"
    build_bank_of([straight("first"), straight("second", 3.0)], path, progress=False)
    before = bank_identity(ScenarioBank(path))
    found = find_shortest(path, progress=False)
    assert [one.name for one in found] == ["first", "second"]
    assert bank_identity(ScenarioBank(path)) == before
    return path


def test_the_shortest_length_and_the_minimum_time_of_a_straight_path(bank_file):
    bank = ScenarioBank(bank_file)
    assert bank.shortest_lengths == pytest.approx([3.0, 3.0], rel=1e-3)
    assert ((bank.shortest_times >= 1.5 * (1 - 1e-9)) & (bank.shortest_times <= 1.5 * 1.01)).all()
    assert not list(bank_file.parent.glob("*.shortest"))  # the results of single scenarios are removed


def test_the_shortest_path_passes_an_obstacle_on_an_arc():
    scenario = Scenario(
        arena=(0, 0, 8, 5),
        start=(1, 2.5, 0),
        goal=(7, 2.5, 0),
        horizon=6,
        obstacles=(Obstacle(circle=Circle(center=(4, 2.5), radius=0.75)),),
    )
    length, time = shortest(scenario)
    tangent, angle = math.sqrt(3**2 - 1**2), math.asin(1 / 3)  # a disc of 0.75 m and the robot's 0.25 m
    assert length == pytest.approx(2 * (tangent + angle), rel=1e-3)
    assert time > length / 2.0  # at the largest speed; it also turns


def test_spl_and_sct_of_an_episode_are_those_of_their_papers(bank_file):
    found = evaluate(ExpertPolicy, ScenarioBank(bank_file), timed=False, progress=False)
    assert found.success == 1.0
    for episode in found:
        path = np.hypot(*np.diff(episode.states[:, :2], axis=0).T).sum()
        assert episode.spl == pytest.approx(min(1.0, episode.shortest_length / path)) and 0.95 < episode.spl <= 1.0
        assert episode.duration == pytest.approx(0.05 * (len(episode.states) - 1), abs=0.05)
        assert episode.sct == pytest.approx(episode.shortest_time / episode.duration) and episode.sct < 1.0
        assert episode.to_dict()["sct"] == episode.sct
    failed = evaluate(lambda _: np.zeros(2, np.float32), ScenarioBank(bank_file), timed=False, progress=False)
    assert all(episode.spl == episode.sct == 0.0 for episode in failed)


def test_evaluate_prints_spl_and_sct_beside_soc(bank_file, tmp_path, capsys):
    out = tmp_path / "scores.json"
    words = ["expert", "--bank", str(bank_file), "--workers", "1", "--json", str(out)]
    assert main(["evaluate", *words]) == 0
    printed = capsys.readouterr().out
    header = next(line for line in printed.splitlines() if "SPL" in line)
    assert header.index("SOC") < header.index("SPL") < header.index("SCT")
    assert max(len(line) for line in printed.splitlines() if line.startswith(" expert ") or line == header) <= 80
    (row,) = json.loads(out.read_text())["banks"][0]["scores"]
    assert 0.9 < row["spl"]["value"] <= 1.0 and 0.1 < row["sct"]["value"] < 1.0


def test_scores_without_shortest_paths_are_unknown(bank_file, tmp_path, capsys):
    path = tmp_path / "partly.bank"
    path.write_bytes(bank_file.read_bytes())
    add_datasets(path, shortest_lengths=np.array([3.0, math.nan]), shortest_times=np.full(2, math.nan))
    (row,) = compare({"expert": ExpertPolicy}, ScenarioBank(path), progress=False).scores()
    assert math.isnan(row.spl.value) and math.isnan(row.sct.value) and row.soc.value > 0.9
    assert main(["evaluate", "expert", "--bank", str(path), "--workers", "1"]) == 0
    assert "SOC" in (printed := capsys.readouterr().out) and "SPL" not in printed


def test_shortest_paths_are_stored_by_the_command(bank_file, tmp_path, capsys):
    path, out = tmp_path / "copy.bank", tmp_path / "shortest.json"
    path.write_bytes(bank_file.read_bytes())
    add_datasets(path, shortest_lengths=np.full(2, math.nan), shortest_times=np.full(2, math.nan))
    assert main(["bank", "shortest", str(path), "--workers", "1", "--json", str(out)]) == 0
    assert "scenarios: 2" in capsys.readouterr().out
    assert [row["time"] for row in json.loads(out.read_text())] == ScenarioBank(path).shortest_times.tolist()
    assert main(["bank", "show", str(path)]) == 0
    assert "minimum time (s)" in capsys.readouterr().out


def test_impossible_values_are_refused(bank_file, tmp_path):
    path = tmp_path / "copy.bank"
    path.write_bytes(bank_file.read_bytes())
    with pytest.raises(ValueError, match=r"shortest_times: expected the shape \(2,\), got \(3,\)"):
        add_datasets(path, shortest_times=np.zeros(3))
    with pytest.raises(ValueError, match="workers"):
        find_shortest(path, workers=0)
    add_datasets(path, shortest_times=np.array([1.0, -1.0]))
    with pytest.raises(BankError, match=r"shortest_times\[1\]: expected NaN or finite numbers >= 0, got -1"):
        ScenarioBank(path)
