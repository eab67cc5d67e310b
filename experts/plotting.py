"""Pictures of scenarios and paths, on Matplotlib axes."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal

OBSTACLE, EDGE, WALL, START, GOAL, OPTIMUM = "#c3c8d1", "#7a8190", "#3c4048", "#2662ab", "#22804f", "#1a1a1a"
ROBOTS_DRAWN = 9  # along a path, evenly spaced in time


def draw_scenario(axes: Axes, scenario: Scenario) -> None:
    """Arena, obstacles, start and goal, in metres and to scale."""
    x_min, y_min, x_max, y_max = scenario.arena
    for obstacle in scenario.obstacles:
        if obstacle.circle is not None:
            axes.add_patch(Circle(obstacle.circle.center, obstacle.circle.radius, facecolor=OBSTACLE, edgecolor=EDGE))
        elif obstacle.polygon is not None:
            axes.add_patch(Polygon(np.array(obstacle.polygon.vertices), facecolor=OBSTACLE, edgecolor=EDGE))
    axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, edgecolor=WALL, linewidth=1.5))
    for pose, color in ((scenario.start, START), (scenario.goal, GOAL)):
        draw_robot(axes, pose, scenario.robot.radius, color)
    margin = 0.02 * (x_max - x_min)
    axes.set(xlim=(x_min - margin, x_max + margin), ylim=(y_min - margin, y_max + margin), aspect="equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def draw_robot(axes: Axes, pose: Any, radius: float, color: str, **style: Any) -> None:
    """The robot's rim, and a line from its centre along its heading unless that is None."""
    x, y, heading = pose
    axes.add_patch(Circle((x, y), radius, fill=False, edgecolor=color, **{"linewidth": 1.4, **style}))
    if heading is not None:
        tip = x + 1.6 * radius * np.cos(heading), y + 1.6 * radius * np.sin(heading)
        axes.plot([x, tip[0]], [y, tip[1]], color=color, **{"linewidth": 1.8, **style})


def plot_solution(scenario: Scenario, extremal: Extremal, path: str | os.PathLike[str]) -> None:
    """Writes a picture of an extremal: the path over the obstacles, and controls and costates over time.

    Raises:
        ValueError: the extremal has no path, or the file's ending is no picture format.

    """
    if len(extremal.times) == 0:
        raise ValueError(f"there is no path to draw: {extremal.status.value}")
    figure = Figure(figsize=(10.5, 5.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
    plane = figure.add_subplot(grid[:, 0])
    draw_scenario(plane, scenario)
    plane.plot(extremal.states[:, 0], extremal.states[:, 1], color=OPTIMUM, linewidth=1.8)
    for pose in extremal.evaluate(np.linspace(0.0, scenario.horizon, ROBOTS_DRAWN + 2)[1:-1])[0]:
        draw_robot(plane, pose, scenario.robot.radius, OPTIMUM, alpha=0.3)
    plane.set_title(f"{scenario.name}: J = {extremal.cost:.4f}, {extremal.status.name}")
    speed, turn, costates = (figure.add_subplot(grid[row, 1]) for row in range(3))
    speed.plot(extremal.times, extremal.controls[:, 0], color=START)
    speed.set_ylabel("speed (m/s)")
    turn.plot(extremal.times, extremal.controls[:, 1], color=START)
    turn.set_ylabel("turn rate (rad/s)")
    for values, label in zip(extremal.costates.T, ("x", "y", "θ"), strict=True):
        costates.plot(extremal.times, values, label=rf"$\lambda_{{{label}}}$" if label != "θ" else r"$\lambda_\theta$")
    costates.set(ylabel="costates", xlabel="time (s)")
    costates.legend(loc="best", fontsize=8, ncols=3)
    for axes in (speed, turn, costates):
        axes.grid(alpha=0.3)
        axes.set_xlim(0.0, scenario.horizon)
    figure.savefig(path, dpi=150)
