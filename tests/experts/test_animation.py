"""Small multiples and animations of optima among moving obstacles."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from leapnav.envs import sample_scenario
from leapnav.experts import find_optimum, solve
from leapnav.experts.plotting.animation import animate_extremal, plot_moments
from leapnav.experts.problem.certificate import failure
from leapnav.experts.problem.extremal import Status


@pytest.fixture(scope="module")
def scenario():
    return sample_scenario("crossing", 3)


@pytest.fixture(scope="module")
def optimum(scenario):
    return find_optimum(scenario)


def test_an_animation_takes_as_long_as_the_path_and_shows_the_motion(scenario, optimum, tmp_path):
    animate_extremal(optimum, tmp_path / "path.gif", scenario, frames_per_second=2.0)
    with Image.open(tmp_path / "path.gif") as image:
        assert image.n_frames == np.ceil(2.0 * scenario.horizon)
        durations, frames = [], []
        for frame in range(image.n_frames):
            image.seek(frame)
            durations.append(image.info["duration"])
            frames.append(np.asarray(image.convert("RGB")).copy())
    assert sum(durations[:-1]) == pytest.approx(1000 * scenario.horizon, abs=600) and durations[-1] == 1000
    assert all((a != b).any() for a, b in pairwise(frames))


def test_small_multiples_have_a_row_for_each_optimum(scenario, optimum, tmp_path):
    plot_moments(scenario, [optimum], tmp_path / "one.png", count=3)
    plot_moments(scenario, [optimum, optimum.alternatives[0]], tmp_path / "two.png", count=3, titles=["a", "b"])
    with Image.open(tmp_path / "one.png") as one, Image.open(tmp_path / "two.png") as two:
        assert two.width == one.width and two.height == pytest.approx(2 * one.height, abs=2)


def test_invalid_arguments_are_named(scenario, optimum, tmp_path):
    with pytest.raises(ValueError, match=r"path: expected the extension .gif, got '.*a.mp4'"):
        animate_extremal(optimum, tmp_path / "a.mp4", scenario)
    with pytest.raises(ValueError, match="extremals: expected at least one, got none"):
        plot_moments(scenario, [], tmp_path / "a.png")
    nothing = failure(solve(scenario, "multiple_shooting").problem, Status.NO_PATH)
    with pytest.raises(ValueError, match="there is no path"):
        animate_extremal(nothing, tmp_path / "a.gif", scenario)
