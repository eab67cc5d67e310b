"""Proved lower bounds of the scenarios of a bank."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import BankError, NavigateEnv, NavigateVectorEnv, ScenarioBank
from leapnav.envs.scenarios.bank_writing import add_datasets
from leapnav.experts import build_bank
from leapnav.experts.data import bank_bounds
from leapnav.experts.data.bank_bounds import prove_bank
from leapnav.experts.proofs.proof import ProofError
from leapnav.training import GoToGoal, compare, evaluate, score
from leapnav.training.scoring.reports import print_scores

COUNT, GAP = 3, 0.4
EASY = {"position_tolerance": 0.3, "heading_tolerance": 3.1}  # which a policy reaches that drives to the goal


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bank") / "small.bank"
    build_bank("open", COUNT, path, seed=5, progress=False)
    return path


@pytest.fixture(scope="module")
def proved(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("proved") / "small.bank"
    shutil.copyfile(built, path)
    prove(path, count=2)
    return path


@pytest.fixture
def bank_file(built: Path, tmp_path: Path) -> Path:
    return Path(shutil.copyfile(built, tmp_path / "small.bank"))


def prove(path: Path, **changes: Any) -> list[bank_bounds.BankBound]:
    return prove_bank(path, **{"gap": GAP, "progress": False, **changes})


def test_bounds_are_stored_in_the_bank(built: Path, proved: Path):
    bank = ScenarioBank(proved)
    bank.verify_checksums()
    assert bank.lower_bounds[:2] == pytest.approx((1 - GAP) * bank.costs[:2], rel=1e-9)
    assert math.isnan(bank.lower_bounds[2])
    assert bank.reference(0).lower_bound == bank.lower_bounds[0]
    assert bank.reference(2).lower_bound is None
    before = ScenarioBank(built)
    assert np.isnan(before.lower_bounds).all()
    assert [a == b for a, b in zip(bank, before, strict=True)] == [True] * COUNT
    assert np.array_equal(bank.costs, before.costs)
    assert not proved.with_name("small.bank.bounds").exists()


def test_proved_scenarios_are_skipped_and_better_bounds_replace_others(bank_file: Path):
    assert [result.index for result in prove(bank_file, count=1)] == [0]
    assert [result.index for result in prove(bank_file, count=2)] == [1]
    assert prove(bank_file, count=2) == []
    (result,) = prove(bank_file, gap=0.2, count=1)
    assert result.gap == pytest.approx(0.2, abs=1e-6)
    assert result.check_seconds > 0
    stored = ScenarioBank(bank_file).lower_bounds
    assert stored[0] == result.value
    add_datasets(bank_file, lower_bounds=np.array([stored[0], math.nan, math.nan]))
    prove(bank_file, gap=0.3)
    assert ScenarioBank(bank_file).lower_bounds[0] == stored[0]


def test_an_interrupted_run_resumes(bank_file: Path, monkeypatch: pytest.MonkeyPatch):
    original, calls = bank_bounds.lower_bound, list[str]()

    def interrupted(scenario: Any, *arguments: Any, **options: Any) -> Any:
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(scenario.name)
        return original(scenario, *arguments, **options)

    monkeypatch.setattr(bank_bounds, "lower_bound", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prove(bank_file)
    assert np.isnan(ScenarioBank(bank_file).lower_bounds).all()
    with pytest.raises(BankError, match=r"bank-proof of other settings: gap is 0\.4, got 0\.3"):
        prove(bank_file, gap=0.3)
    monkeypatch.setattr(bank_bounds, "lower_bound", lambda *a, **o: calls.append("again") or original(*a, **o))
    results = prove(bank_file)
    assert calls.count("again") == 1
    assert len(results) == COUNT
    assert np.isfinite(ScenarioBank(bank_file).lower_bounds).all()


def test_a_scenario_without_a_bound_is_reported(bank_file: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: Any, **__: Any) -> None:
        raise ValueError("horizon: too long")

    monkeypatch.setattr(bank_bounds, "lower_bound", refuse)
    (result,) = prove(bank_file, count=1)
    assert result.fault == "horizon: too long"
    assert main(["bank", "prove", str(bank_file), "--count", "1", "--workers", "1"]) == 1
    assert math.isnan(result.value)
    assert np.isnan(ScenarioBank(bank_file).lower_bounds).all()


def test_a_bound_whose_proof_is_refused_is_not_stored(bank_file: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(_: Any) -> float:
        raise ProofError("stage 0: start: the gradient")

    monkeypatch.setattr(bank_bounds, "check_proof", refuse)
    (result,) = prove(bank_file, count=1)
    assert result.fault == "the checker refuses the proof: stage 0: start: the gradient"
    assert np.isnan(ScenarioBank(bank_file).lower_bounds).all()


def test_bounds_are_not_stored_in_another_bank(bank_file: Path, monkeypatch: pytest.MonkeyPatch):
    original = bank_bounds.lower_bound

    def replaced(*arguments: Any, **options: Any) -> Any:
        build_bank("open", COUNT, bank_file.with_name("other.bank"), seed=6, progress=False)
        shutil.copyfile(bank_file.with_name("other.bank"), bank_file)
        return original(*arguments, **options)

    monkeypatch.setattr(bank_bounds, "lower_bound", replaced)
    with pytest.raises(BankError, match="replaced by a bank with other scenarios"):
        prove(bank_file, count=1)
    assert np.isnan(ScenarioBank(bank_file).lower_bounds).all()


def test_bounds_that_are_written_meanwhile_are_kept(bank_file: Path, monkeypatch: pytest.MonkeyPatch):
    original = bank_bounds.lower_bound

    def other(*arguments: Any, **options: Any) -> Any:
        add_datasets(bank_file, lower_bounds=np.array([math.nan, 0.1, 0.1]))
        return original(*arguments, **options)

    monkeypatch.setattr(bank_bounds, "lower_bound", other)
    (result,) = prove(bank_file, count=1)
    assert ScenarioBank(bank_file).lower_bounds.tolist() == [result.value, 0.1, 0.1]


def test_finished_scenarios_are_stored_when_a_run_resumes_with_a_smaller_count(
    bank_file: Path, monkeypatch: pytest.MonkeyPatch
):
    original, calls = bank_bounds.lower_bound, list[int]()

    def interrupted(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(bank_bounds, "lower_bound", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prove(bank_file)
    assert [result.index for result in prove(bank_file, count=1)] == [0, 1]


def test_a_link_stays_a_link_and_the_bounds_are_aligned(bank_file: Path, tmp_path: Path):
    link = tmp_path / "link.bank"
    link.symlink_to(bank_file)
    add_datasets(link, lower_bounds=np.arange(COUNT, dtype=float))
    assert link.is_symlink()
    bank = ScenarioBank(bank_file)
    assert bank.lower_bounds.tolist() == [0.0, 1.0, 2.0]
    assert bank.lower_bounds.flags.aligned


def test_changed_bounds_are_noticed(proved: Path, tmp_path: Path):
    path = Path(shutil.copyfile(proved, tmp_path / "changed.bank"))
    with h5py.File(path, "r+") as file:
        file["lower_bounds"][0] *= 1.01
    with pytest.raises(BankError, match="lower_bounds"):
        ScenarioBank(path).verify_checksums()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gap": 2.0}, "gap: expected a number between 0 and 1, got 2.0"),
        ({"time_limit": 0.0}, "time_limit: expected a positive number"),
        ({"count": 0}, "count: expected"),
        ({"workers": 0}, "workers: expected"),
    ],
)
def test_invalid_arguments(built: Path, arguments: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        prove(built, **arguments)


def test_a_bank_of_another_robot_is_refused(tmp_path: Path):
    path = Path(shutil.copyfile(ScenarioBank.shipped("clutter", "test", "car").path, tmp_path / "car.bank"))
    with pytest.raises(ValueError, match="robot: lower bounds need a unicycle"):
        prove(path)
    with pytest.raises(ValueError, match=r"lower_bounds: expected the shape \(200,\), got \(3,\)"):
        add_datasets(path, lower_bounds=np.zeros(3))


def test_environments_report_the_bound(proved: Path):
    env = NavigateEnv(bank=proved)
    bank = ScenarioBank(proved)
    _, info = env.reset(options={"index": 1})
    assert info["lower_bound"] == bank.lower_bounds[1]
    _, info = env.reset(options={"index": 2})
    assert info["lower_bound"] == -math.inf
    envs = NavigateVectorEnv(COUNT, bank=proved)
    _, infos = envs.reset(options={"index": np.arange(COUNT)})
    assert np.array_equal(infos["lower_bound"], np.nan_to_num(bank.lower_bounds, nan=-math.inf))
    assert infos["_lower_bound"].all()


def test_an_evaluation_brackets_the_true_regret(proved: Path, built: Path, capsys: pytest.CaptureFixture[str]):
    result = evaluate(GoToGoal, ScenarioBank(proved), environment=EASY, progress=False)
    known = [episode for episode in result if not math.isnan(episode.lower_bound)]
    assert len(known) == 2
    for episode in known:
        if not episode.success:
            assert all(math.isnan(end) for end in episode.true_regret)
            continue
        low, high = episode.true_regret
        assert low == episode.cost / episode.reference_cost - 1
        assert high == pytest.approx((1 + low) / (1 - GAP) - 1)
    assert all(math.isnan(end) for end in list(result)[2].true_regret)
    row = score("go-to-goal", result)
    chosen = [episode.true_regret for episode in known if episode.success]
    assert row.true_regret.episodes == len(chosen) > 0
    assert row.true_regret.low == np.median([low for low, _ in chosen])
    assert row.true_regret.high == np.median([high for _, high in chosen])
    print_scores(compare({"go-to-goal": GoToGoal}, ScenarioBank(proved), environment=EASY, progress=False))
    assert f"% ({len(chosen)} episode" in capsys.readouterr().out
    unknown = evaluate(GoToGoal, ScenarioBank(built), environment=EASY, progress=False)
    assert score("go-to-goal", unknown).true_regret.episodes == 0


def test_the_commands(bank_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["bank", "show", str(bank_file)]) == 0
    assert "lower bounds" not in capsys.readouterr().out
    out = tmp_path / "bounds.json"
    arguments = ["bank", "prove", str(bank_file), "--gap", "0.4", "--workers", "1", "--count", "2", "--json", str(out)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "2 of 3 scenarios" in printed
    assert "median 40.00 %" in printed
    rows = json.loads(out.read_text())
    assert [row["index"] for row in rows] == [0, 1]
    assert main(["bank", "show", str(bank_file), "--json", str(out)]) == 0
    assert "gap at most" in capsys.readouterr().out
    shown = json.loads(out.read_text())
    scenarios = shown["scenarios"] if isinstance(shown, dict) else shown
    assert scenarios[0]["lower_bound"] == rows[0]["value"]
    assert scenarios[2]["lower_bound"] is None
    assert main(arguments) == 0
    assert "already" in capsys.readouterr().out
