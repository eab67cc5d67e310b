"""The commands `watch`, `doctor` and `compile`."""

import json
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers import FastClock, failing

from leapnav.cli import main
from leapnav.envs import ScenarioBank


def test_watch_films_the_policy(tmp_path, capsys, monkeypatch):
    import imageio.v3 as iio

    video = tmp_path / "rooms.mp4"
    arguments = ["watch", "--family", "rooms", "--index", "11", "--episodes", "2", "--video", str(video)]
    assert main(arguments) == 0
    first, second, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"rooms-1-11: success after [\d.]+ s, cost [\d.]+, optimum for the state reached [\d.]+", first)
    assert second.startswith("rooms-1-12: success")
    assert last == f"wrote {video}"
    frames = iio.imread(video)
    bank = ScenarioBank.shipped("rooms", "test")
    assert len(frames) == pytest.approx(20 * (bank[11].horizon + bank[12].horizon), abs=5)
    assert frames.shape[1:] == (640, 600, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["rooms.mp4"]


def test_watch_opens_a_window(capsys, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", FastClock)
    arguments = ["watch", "--family", "open", "--policy", "random", "--episodes", "1", "--actuation", "motor"]
    assert main([*arguments, "--disturbance", "0.1"]) == 0
    assert re.match(r"open-1-\d+: (missed the goal|collision) after", capsys.readouterr().out)


def test_closing_the_window_ends_the_watching(capsys, monkeypatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", FastClock)
    monkeypatch.setattr("pygame.event.get", lambda: [pygame.event.Event(pygame.QUIT)])
    assert main(["watch", "--policy", "random"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--video", "film.gif"], "film.gif: expected a name that ends in .mp4"),
        (["--video", "nowhere/film.mp4"], "nowhere/film.mp4: the directory does not exist"),
        (["--video", "film.mp4", "--index", "199"], "index: the bank has scenarios 0 to 199, got 199 to 201"),
        (["--video", "film.mp4", "--index", "3", "--split", "fresh"], "index: fresh scenarios have no index"),
        (["--video", "film.mp4", "--episodes", "0"], "episodes: expected at least 1, got 0"),
        (["--video", "film.mp4", "--family", "moon"], "family: expected one of open, .*got 'moon'"),
        (["--video", "film.mp4", "--policy", "nowhere"], "nowhere: no such policy"),
        (["--video", "film.mp4", "--disturbance", "-1"], "disturbance: expected a number >= 0, got -1.0"),
    ],
)
def test_bad_arguments_of_watch_are_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, line = failing(["watch", *arguments], capsys)
    assert code == 2
    assert re.match(f"leapnav: {message}", line)
    assert not list(tmp_path.iterdir())


def test_without_a_display_or_moviepy_watch_names_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.setattr("pygame.display.init", lambda: None)
    monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    assert main(["watch"]) == 2
    assert "--video FILE.mp4 writes a video instead" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "moviepy", None)
    assert main(["watch", "--video", str(tmp_path / "film.mp4")]) == 2
    assert 'pip install "leapnav[video]"' in capsys.readouterr().err


def test_doctor_reports_versions_and_passed_checks(tmp_path, capsys):
    assert main(["doctor", "--json", str(tmp_path / "doctor.json")]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^torch +2\.", out, re.MULTILINE)
    assert out.count("ok    ") == 4
    found = json.loads((tmp_path / "doctor.json").read_text())
    assert found["versions"]["leapnav"] == version("leapnav")
    assert "missing" not in found["versions"].values()
    assert all(check["passed"] for check in found["checks"])


def test_doctor_reports_failed_checks(capsys, monkeypatch):
    monkeypatch.setattr("leapnav.training.policies.files.SHIPPED", Path("/nowhere"))
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert re.search(r"FAILED  load a policy .*: \w+Error: .*clutter", out)
    assert "ok      drive the expert" in out


def test_what_is_compiled_is_not_compiled_again(tmp_path, capsys):
    assert main(["compile"]) == 0  # compiles what no other test has compiled yet
    assert "cache: " in capsys.readouterr().out
    assert main(["compile", "--json", str(tmp_path / "compiled.json")]) == 0
    assert re.match(r"compiled 0 kernels in [\d.]+ s; cache: ", capsys.readouterr().out)
    found = json.loads((tmp_path / "compiled.json").read_text())
    assert found["compiled"] == 0
    assert Path(found["cache"]).is_dir()
    assert failing(["compile", "--jobs", "0"], capsys) == (2, "leapnav: jobs: expected an integer >= 1, got 0\n")


def test_kernels_are_compiled_without_the_packages_of_extras():
    extras = ("casadi", "dask", "distributed", "moviepy", "onnx", "onnxruntime", "sb3_contrib", "starlette", "yaml")
    code = (
        f"import sys\nsys.modules.update(dict.fromkeys({extras}))\n"  # importing them raises ModuleNotFoundError
        "from leapnav.commands.installation.compile import compile_missing\n"
        "print(compile_missing()['compiled'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().isdigit()
