"""The examples run as their users run them, with arguments that make them short; whether they learn is not tested."""

import re
import runpy
import sys

import pytest
from helpers import ROOT, run_with_d3rlpy

SCORE = r"success \d+\.\d %, collision \d+\.\d %, SOC \d\.\d+"
# Arguments, and the last lines of the output.
EXAMPLES = {
    "own_robot": ("--plot {out}", r"certified: .*: J = 3\.165478; maximum angle at the hitch: 66 degrees\nwrote .*\n"),
    "wagon_robot": ("--plot {out}", r"certified: .*: J = \d+\.\d{6}\nwrote .*\n"),
    "compare_methods": ("--plot {out}", r".*\n(.*SUCCESS.*4\.625635716.*\n){3}.*\n(.*: J = 4\.625635716)\nwrote .*\n"),
    "alternatives": ("--plot {out}", r"the gate: certified: .*\n(J = +\d.*(forward|backward)\n){4,}wrote .*\n"),
    "cleanrl_ppo": (
        "--total-timesteps 3000 --num-envs 16 --num-steps 64 --test-scenarios 5 --levels plr",
        rf"( +\d.*\n)+{SCORE}\n",
    ),
    "ppo_from_scratch": ("--total-timesteps 1024 --count 3", r"success \d+\.\d % in \d+ episodes\n"),
    "caves": ("--count 1", r"caves-0: certified, horizon .* s, J = \d+\.\d+\n"),
    "offline_rl": ("--episodes 10 --steps 50 --test-scenarios 5", rf"(.*\n)*{SCORE}\n"),
}


def test_every_example_is_run():
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)


def words(name, tmp_path):
    return [word.format(out=tmp_path / "out.png") for word in EXAMPLES[name][0].split()]


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != "offline_rl"])
def test_the_example_runs(name, tmp_path, monkeypatch, capsys):
    path = str(ROOT / "examples" / f"{name}.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [path, *words(name, tmp_path)])
    runpy.run_path(path, run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(rf"(^|\n){EXAMPLES[name][1]}$", printed), printed


@pytest.mark.slow
def test_the_example_with_d3rlpy_runs(tmp_path):
    printed = run_with_d3rlpy("examples/offline_rl.py", words("offline_rl", tmp_path), tmp_path)
    assert re.search(rf"(^|\n){EXAMPLES['offline_rl'][1]}$", printed), printed
