"""Small multiples and animations of an optimum over time."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.colors import OPTIMUM
from leapnav.envs.utils.validation import check_at_least, check_positive
from leapnav.experts.plotting.scenes import draw_robot, draw_scenario
from leapnav.experts.problem.extremal import Extremal

SIDE, TITLE = 3.2, 0.3  # inches: width of a scene, height of its title
N_POINTS = 200  # of the path
AFTERWARDS = 1.0  # s for which the last picture of an animation stays


def draw_moment(axes: Axes, scenario: Scenario, extremal: Extremal, time: float) -> None:
    """Draw robot and obstacles at a time (s), the path up to then, and the rest of it fainter."""
    draw_scenario(axes, scenario, time)
    for start, end, alpha in ((0.0, time, 1.0), (time, extremal.horizon, 0.3)):
        if end > start:
            points = extremal.interpolate(np.linspace(start, end, N_POINTS))[:, :2]
            axes.plot(*points.T, color=OPTIMUM, linewidth=1.5, alpha=alpha)
    draw_robot(axes, extremal.interpolate(np.array([time]))[0], scenario.outline, OPTIMUM)


def plot_moments(
    scenario: Scenario,
    extremals: Sequence[Extremal],
    path: str | os.PathLike[str],
    *,
    count: int = 4,
    titles: Sequence[str] = (),
) -> None:
    """Write small multiples to a file: a row for each extremal, with scenes at evenly spaced times.

    Args:
        scenario: the scenario.
        extremals: extremals of the scenario.
        path: the file, of an image format.
        count: number of times, at least 2.
        titles: of the rows; without them the costs.

    Raises:
        ValueError: there is no extremal, or one has no path.

    """
    check_at_least("count", count, 2)
    _check_paths(extremals)
    shape = len(extremals), count
    x_min, y_min, x_max, y_max = scenario.arena
    height = SIDE * (y_max - y_min) / (x_max - x_min) + TITLE
    figure = Figure(figsize=(SIDE * count, height * len(extremals)), layout="constrained")
    panels = figure.subplots(*shape, squeeze=False)
    for row, extremal in enumerate(extremals):
        title = titles[row] if titles else f"J = {extremal.cost:.4f}"
        for axes, time in zip(panels[row], np.linspace(0.0, extremal.horizon, count), strict=True):
            draw_moment(axes, scenario, extremal, float(time))
            axes.set_title(f"{title}, {time:.1f} s" if time == 0.0 else f"{time:.1f} s", fontsize=10)
    figure.savefig(path, dpi=100)


def animate_extremal(
    extremal: Extremal, path: str | os.PathLike[str], scenario: Scenario, *, frames_per_second: float = 10.0
) -> None:
    """Write an extremal as an animation in real time, in the format GIF.

    Args:
        extremal: the extremal.
        path: the file, with the extension .gif.
        scenario: its scenario.
        frames_per_second: of the animation; GIF has steps of 0.01 s.

    Raises:
        ValueError: the extremal has no path, or the file has another extension.

    """
    from PIL import Image  # a dependency of Matplotlib, imported here because few programs need it

    check_positive("frames_per_second", frames_per_second)
    _check_paths([extremal])
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"path: expected the extension .gif, got {os.fspath(path)!r}")
    pictures = []
    for time in np.linspace(0.0, extremal.horizon, max(math.ceil(extremal.horizon * frames_per_second), 2)):
        figure = Figure(figsize=(1.5 * SIDE, 1.5 * SIDE + 0.2), layout="constrained")
        axes = figure.subplots()
        draw_moment(axes, scenario, extremal, float(time))
        axes.set_title(f"J = {extremal.cost:.4f}, {time:.1f} s", fontsize=10)
        pictures.append(_picture(figure))
    step = 10 * round(100.0 / frames_per_second)  # ms
    durations = [step] * (len(pictures) - 1) + [round(1000 * AFTERWARDS)]
    first, *others = (Image.fromarray(picture) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def _picture(figure: Figure) -> np.ndarray:
    """Return a figure as an image (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _check_paths(extremals: Sequence[Extremal]) -> None:
    """Raise ValueError unless there are extremals, and all have a path."""
    if not extremals:
        raise ValueError("extremals: expected at least one, got none")
    for extremal in extremals:
        if len(extremal.times) == 0:
            raise ValueError(f"there is no path: {extremal.status.value}")
