"""Help, choices, completion and interruptions of the command line."""

import re
import shutil
import subprocess
import sys
import warnings
from typing import get_args

import pytest

from leapnav.cli import COMMANDS, DESCRIPTION, _warnings_in_one_line, main
from leapnav.commands.options import Family, FamilyOrAll, Horizon, PolicyName, parse_environment
from leapnav.envs import FAMILIES
from leapnav.envs.settings import HORIZONS
from leapnav.training import shipped_policies
from leapnav.training.policies.files import BASELINES


def test_the_choices_shown_are_those_that_exist():
    assert get_args(get_args(Family)[0]) == tuple(FAMILIES)
    assert get_args(get_args(FamilyOrAll)[0]) == (*FAMILIES, "all")
    assert get_args(Horizon) == HORIZONS
    names = get_args(get_args(PolicyName)[0])
    assert sorted(names) == sorted([*BASELINES, *shipped_policies()])


def completed(script, *words):
    """The completions of the last word in bash."""
    code = (
        f"source {script}; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; "
        'F=$(complete -p leapnav | sed "s/.*-F \\([^ ]*\\).*/\\1/"); $F; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True, cwd=script.parent)
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_commands_and_choices_are_completed(tmp_path, capfd):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "leapnav.bash"
    script.write_text(capfd.readouterr().out)
    assert completed(script, "leapnav", "rollout", "--horizon", "fr") == ["free"]
    assert completed(script, "leapnav", "bank", "ver") == ["verify"]
    assert "evaluate" in completed(script, "leapnav", "e")


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["rollout", "--out", "demos"], "the same command resumes where it stopped"),
        (["bank", "build", "--out", "x.bank"], "the same command resumes where it stopped"),
        (["train", "bc", "--out", "run"], "leapnav train bc --out run --resume continues from the last checkpoint"),
        (["demo", "--out", "demo"], "the same command resumes; finished steps are not repeated"),
        (["evaluate", "expert"], ""),
    ],
)
def test_an_interruption_says_how_to_resume(words, hint, tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    for name in (
        "leapnav.experts.data.rollouts.rollout",
        "leapnav.experts.data.banks.build_bank",
        "leapnav.training.runs.imitation.train_bc",
        "leapnav.commands.demo.run_demo",
        "leapnav.training.scoring.comparison.compare_policies",
    ):
        monkeypatch.setattr(name, interrupt)
    assert main(words) == 130
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == f"leapnav: interrupted{f'; {hint}' if hint else ''}"


def test_an_interrupted_kernel_is_an_interruption(tmp_path, monkeypatch, capsys):
    """Its result with an exception set is a SystemError, whose cause is the interruption."""

    def stopped(*_, **__):
        raise SystemError("a kernel returned a result with an exception set") from cause

    monkeypatch.setattr("leapnav.experts.data.rollouts.rollout", stopped)
    cause = KeyboardInterrupt()
    assert main(["rollout", "--out", str(tmp_path / "demos")]) == 130
    assert "interrupted; the same command resumes" in capsys.readouterr().err
    cause = None
    with pytest.raises(SystemError):
        main(["rollout", "--out", str(tmp_path / "demos")])


def test_arguments_of_the_environment_are_json_or_text():
    assert parse_environment([]) is None
    found = parse_environment(["observation=map", "map_obstacles=3", "dict_observation=true"])
    assert found == {"observation": "map", "map_obstacles": 3, "dict_observation": True}


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS), ["train", "ppo"], ["bank", "build"]])
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command, "--help"])
    assert end.value.code in (0, None)
    assert " ".join(["usage: leapnav", *command]) in capsys.readouterr().out


def test_help_is_wrapped_only_at_the_width_of_the_terminal(capsys):
    with pytest.raises(SystemExit):
        main(["train", "dagger", "--help"])
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    first = lines.index("--lidar-beams {None}|INT") + 1
    assert all(len(line) > 50 for line in lines[first : first + 3]), lines[first : first + 4]


def test_the_overview_names_each_command_once_in_a_group():
    groups = re.findall(r": ([a-z, ]+)\.", DESCRIPTION.partition("\n")[2])
    assert sorted(name for group in groups for name in group.split(", ")) == sorted(COMMANDS)


def test_the_package_is_a_command():
    done = subprocess.run([sys.executable, "-m", "leapnav", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "usage: leapnav" in done.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell, capsys):
    with pytest.raises(SystemExit) as end:
        main(["--tyro-print-completion", shell])
    printed = capsys.readouterr().out
    assert end.value.code in (0, None)
    assert all(word in printed for word in ("solve", "evaluate", "--episodes-plot", "play"))


def test_a_warning_to_the_user_is_one_line_without_a_place():
    with _warnings_in_one_line():
        assert warnings.formatwarning("text", UserWarning, "file.py", 3) == "leapnav: warning: text\n"
        assert "file.py:3: DeprecationWarning" in warnings.formatwarning("text", DeprecationWarning, "file.py", 3)
    assert "file.py:3: UserWarning" in warnings.formatwarning("text", UserWarning, "file.py", 3)
