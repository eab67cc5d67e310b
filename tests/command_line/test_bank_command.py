"""The commands of banks, and banks as arguments of others."""

import json

import pytest
from helpers import failing

from leapnav.cli import main


def test_a_custom_bank_can_be_played(tmp_path, capsys):
    bank = tmp_path / "mine.bank"
    arguments = ["bank", "build", "--family", "open", "--count", "3", "--seed", "5", "--workers", "1"]
    assert main([*arguments, "--out", str(bank)]) == 0
    assert main(["evaluate", "expert", "--bank", str(bank)]) == 0
    assert "3 scenarios" in capsys.readouterr().out


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
