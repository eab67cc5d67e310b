import io
import sys

import pytest

from leapnav.envs.utils import progress
from leapnav.envs.utils.progress import advance, progress_bar, stop_early


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress, "monotonic", lambda: now[0])
    return now


def test_off_a_terminal_a_line_is_printed_every_ten_seconds_and_one_at_the_end(capsys, clock):
    with progress_bar(total=100, label="Counting", unit="numbers") as bar:
        for _ in range(100):
            clock[0] += 0.3
            bar.update()
            bar.refresh()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("Counting: ") for line in lines)
    assert "100/100" in lines[-1] and "numbers" in lines[-1]


def test_a_bar_does_not_exceed_its_total(capsys):
    with progress_bar(total=200, label="Solving", unit="scenarios") as bar:
        for _ in range(26):
            advance(bar, 8)  # the last part is larger than what remains
    assert "200/200" in capsys.readouterr().err


def test_a_bar_that_stops_early_gives_the_reason(capsys):
    with progress_bar(total=10, label="Cloning", unit="batches") as bar:
        bar.update(4)
        stop_early(bar, "stopped after 2 of 5 epochs")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("Cloning: stopped after 2 of 5 epochs: 100%") and "4/4" in line


def test_a_terminal_shows_a_bar_in_place_and_a_hidden_bar_prints_nothing(monkeypatch, capsys):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress_bar(total=3, label="Counting", unit="numbers") as bar:
        bar.update(3)
    assert "\r" in terminal.getvalue()
    monkeypatch.undo()
    with progress_bar(total=3, label="Counting", unit="numbers", show=False) as bar:
        bar.update(2)
        stop_early(bar, "unnecessary")
    assert capsys.readouterr().err == ""


def test_a_bar_that_prints_nothing_has_no_semaphore():
    """A worker process is stopped without releasing its semaphores, and Python warns about them at the end."""
    with progress_bar(total=1, label="Counting", unit="numbers", show=False) as bar:
        assert not hasattr(bar.get_lock(), "mp_lock")
