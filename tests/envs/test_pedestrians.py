"""Recordings of pedestrians: reading, obstacles of an episode, sampled scenarios, and the command."""

import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import Scenario
from leapnav.envs.field.packing import displacements
from leapnav.envs.worlds.pedestrians import read_pedestrians, sample_among_pedestrians

LINES = ["780 1 0.0 0.0", "790\t1\t0.4 0.0", "800, 1, 0.8, 0.0", "", "800 2 5 5", "810 2 5.0 5.2", "900.0 3 1 1"]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "street.txt"
    path.write_text("\n".join(LINES))
    return path


def crowd(path, people=6, steps=80):
    """A recording of pedestrians that cross an area of 12 m."""
    rng = np.random.default_rng(0)
    lines = []
    for person in range(people):
        start, end = rng.uniform(0, 12, (2, 2))
        for k in range(steps):
            x, y = start + (end - start) * k / (steps - 1)
            lines.append(f"{10 * k} {person} {x:.3f} {y:.3f}")
    path.write_text("\n".join(lines))
    return path


def test_positions_are_grouped_by_pedestrian_in_seconds(file):
    recording = read_pedestrians(file)
    assert recording.name == "street" and len(recording.tracks) == 2  # one position is no track
    np.testing.assert_allclose(recording.tracks[0], [[0, 0, 0], [0.4, 0.4, 0], [0.8, 0.8, 0]])
    np.testing.assert_allclose(recording.tracks[1], [[0.8, 5, 5], [1.2, 5, 5.2]])
    assert recording.duration == pytest.approx(1.2)
    assert recording.arena == (-1.0, -1.0, 6.0, 6.2)
    assert read_pedestrians(file, frames_per_second=10.0).duration == pytest.approx(3.0)


def test_pedestrians_walk_on_before_and_after_their_track(file):
    first, second = read_pedestrians(file).obstacles(0.4, 2.0)
    times = np.array([0.0, 0.4, 1.4, 2.0])
    at = np.array(first.circle.center) + displacements(first.knots, times)
    np.testing.assert_allclose(at, [[0.4, 0], [0.8, 0], [1.8, 0], [2.4, 0]], atol=1e-9)
    at = np.array(second.circle.center) + displacements(second.knots, times)
    np.testing.assert_allclose(at, [[5, 4.8], [5, 5.0], [5, 5.5], [5, 5.8]], atol=1e-9)
    (second,) = read_pedestrians(file).obstacles(0.9, 1.0)
    assert second.path.times[0] == pytest.approx(-0.1) and second.circle.center == (5.0, 5.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "line 1: expected 4 numbers \\(frame, pedestrian, x, y\\), got '1 2 3'"),
        ("1 1 0 0\n2 1 x 0", "line 2: expected 4 numbers"),
        ("1 1 0 nan", "line 1: expected finite numbers"),
        ("1 1 0 0\n1 1 2 2", "line 2: pedestrian 1 is in frame 1 twice"),
        ("1 1 0 0", "expected a pedestrian with at least two positions, got none"),
    ],
)
def test_faults_of_a_file_are_named(tmp_path, text, message):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_pedestrians(path)
    with pytest.raises(ValueError, match="frames_per_second"):
        read_pedestrians(path, frames_per_second=0.0)


def test_scenarios_are_sampled_in_space_and_time(tmp_path):
    recording = read_pedestrians(crowd(tmp_path / "crowd.txt"))
    scenarios = sample_among_pedestrians(recording, 3, seed=5)
    assert [one.name for one in scenarios] == ["crowd-5", "crowd-6", "crowd-7"]
    assert scenarios == sample_among_pedestrians(recording, 3, seed=5)
    for scenario in scenarios:
        assert scenario.moves and scenario.arena == recording.arena
        for obstacle in scenario.obstacles:
            assert obstacle.circle.radius == 0.25 and obstacle.path.times[0] <= 0.0


def test_the_command_writes_scenario_files(tmp_path, capsys):
    path = crowd(tmp_path / "crowd.txt")
    out = tmp_path / "scenarios"
    arguments = ["--out", str(out), "--count", "2", "--radius", "0.3", "--horizon", "free"]
    assert main(["worlds", "import", "pedestrians", str(path), *arguments]) == 0
    assert "wrote 2 scenarios" in capsys.readouterr().out
    for name in ("crowd-0", "crowd-1"):
        scenario = Scenario.from_json(out / f"{name}.json")
        assert scenario.horizon is None and scenario.obstacles[0].circle.radius == 0.3
