"""The examples run as their users run them, with arguments that make them short; whether they learn is not tested."""

import os
import re
import runpy
import subprocess
import sys

import pytest
from helpers import ROOT

D3RLPY = ROOT / ".venv" / "examples"  # `make test` installs it there
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
    """In a process of its own: d3rlpy brings other versions of packages that the tests use."""
    if not D3RLPY.exists():
        pytest.skip("d3rlpy is not installed; `make test-all` installs it")
    path = os.pathsep.join(filter(None, [str(D3RLPY), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "offline_rl.py"), *words("offline_rl", tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert re.search(rf"(^|\n){EXAMPLES['offline_rl'][1]}$", done.stdout), done.stdout
