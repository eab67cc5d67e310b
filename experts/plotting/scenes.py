"""Drawings of scenarios and robots with Matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle

from leapnav.envs.field.packing import displacements
from leapnav.envs.robots.footprints import axis_of, corners_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.colors import EDGE, GOAL, OBSTACLE, START, WALL

N_POSITIONS = 6  # of a moving obstacle, evenly spaced in time


def draw_scenario(axes: Axes, scenario: Scenario, time: float | None = None) -> None:
    """Draw arena, obstacles, start and goal in metres, with a bar that shows the scale.

    Args:
        axes: where to draw.
        scenario: the scenario.
        time: s, at which moving obstacles are drawn; None: at several times of the episode, ever fainter.

    """
    x_min, y_min, x_max, y_max = scenario.arena
    for obstacle in scenario.obstacles:
        times = np.array([0.0 if time is None else time])
        if time is None and len(obstacle.knots):
            times = np.linspace(0.0, scenario.episode_limit, N_POSITIONS)
        moved = displacements(obstacle.knots, times) if len(obstacle.knots) else np.zeros((1, 2))
        for part in obstacle.shape.parts():
            for k in range(len(times)):
                fill = {"facecolor": OBSTACLE, "edgecolor": EDGE, "alpha": 0.7**k}
                axes.add_patch(Polygon(part.outline() + moved[k], clip_on=True, **fill))
    axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, edgecolor=WALL, linewidth=1.5))
    for state, color in ((scenario.start_state, START), (scenario.goal_state, GOAL)):
        draw_robot(axes, state, scenario.outline, color)
    width = x_max - x_min
    margin, length = 0.02 * width, _round_length(width / 8)
    # A bar with its length, below the arena
    axes.plot([x_min, x_min + length], [y_min - 0.04 * width] * 2, color=WALL, linewidth=2.5, solid_capstyle="butt")
    label: dict[str, Any] = {"fontsize": "x-small", "color": WALL, "verticalalignment": "center"}
    axes.text(x_min + length + margin, y_min - 0.04 * width, f"{length:g} m", **label)
    axes.set(xlim=(x_min - margin, x_max + margin), ylim=(y_min - 0.07 * width, y_max + margin), aspect="equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _round_length(least: float) -> float:
    """Return the smallest of the lengths 1, 2 and 5 times a power of ten that is at least a given one."""
    power = 10.0 ** math.floor(math.log10(least))
    return power * next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least)


def draw_robot(axes: Axes, state: Sequence[float | None], outline: np.ndarray, color: str, **style: Any) -> None:
    """Draw the outline (K, 5) of a robot, and a line along its heading unless that is None."""
    q, heading = [value or 0.0 for value in state], state[2]
    x, y = q[:2]
    lines = {"fill": False, "edgecolor": color, "linewidth": 1.4, **style}
    for row in outline.tolist():
        (rear, front, _, radius, joint), axis = row, axis_of(row, q)
        cos, sin = math.cos(axis), math.sin(axis)
        if front > rear:
            axes.add_patch(Polygon(corners_of(row, q), **lines))
        else:
            axes.add_patch(Circle((x + rear * cos, y + rear * sin), radius, **lines))
        if joint:  # the drawbar
            axes.plot([x, x + front * cos], [y, y + front * sin], color=color, **{"linewidth": 1.4, **style})
    if heading is not None:
        cos, sin = math.cos(heading), math.sin(heading)
        reach = float((outline[:, 1] + 0.6 * outline[:, 2] + 1.6 * outline[:, 3]).max())
        axes.plot([x, x + reach * cos], [y, y + reach * sin], color=color, **{"linewidth": 1.8, **style})
