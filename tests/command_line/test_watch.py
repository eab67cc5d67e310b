"""The command `watch`."""

import re
import sys

import pytest
from helpers import FastClock, failing

from leapnav.cli import main
from leapnav.envs import ScenarioBank


def test_watch_films_the_policy(tmp_path, capsys, monkeypatch):
    import imageio.v3 as iio

    video = tmp_path / "open.mp4"
    arguments = ["watch", "--family", "open", "--index", "11", "--episodes", "1", "--video", str(video)]
    assert main(arguments) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"open-1-11: success after [\d.]+ s, cost [\d.]+, optimum for the state reached [\d.]+", first)
    assert last == f"wrote {video}"
    frames = iio.imread(video)
    bank = ScenarioBank.shipped("open", "test")
    assert len(frames) == pytest.approx(20 * bank[11].horizon, abs=5)
    assert frames.shape[1:] == (640, 600, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["open.mp4"]


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


def test_without_a_display_or_moviepy_watch_names_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.setattr("pygame.display.init", lambda: None)
    monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    assert main(["watch"]) == 2
    assert "--video FILE.mp4 writes a video instead" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "moviepy", None)
    assert main(["watch", "--video", str(tmp_path / "film.mp4")]) == 2
    assert 'pip install "leapnav[video]"' in capsys.readouterr().err


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
