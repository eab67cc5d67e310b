"""Layouts of random scenarios: obstacles, and the regions of start and goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.shapes import Polygon

ARENA = (0.0, 0.0, 10.0, 10.0)
POSE_MARGIN = 0.5  # m between the walls and the regions of start and goal
DECIMALS = 4  # of every sampled number, so that scenario files stay short

Area = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max


@dataclass(frozen=True)
class ScenarioLayout:
    """The obstacles of a random scenario, and the regions in which start and goal are sampled.

    Attributes:
        obstacles: the obstacles.
        start, goal: x_min, y_min, x_max, y_max (m) of the regions; None: the arena without a margin of 0.5 m.
        arena: x_min, y_min, x_max, y_max (m) of the walls.
        waiting: s that are added to the horizon, for waiting.

    """

    obstacles: Sequence[Obstacle]
    start: Area | None = None
    goal: Area | None = None
    arena: Area = ARENA
    waiting: float = 0.0

    @property
    def regions(self) -> np.ndarray:
        """The regions of start and goal (2, 4)."""
        x_min, y_min, x_max, y_max = self.arena
        inside = (x_min + POSE_MARGIN, y_min + POSE_MARGIN, x_max - POSE_MARGIN, y_max - POSE_MARGIN)
        return np.array([self.start or inside, self.goal or inside])


def rounded(value: float) -> float:
    """Round a sampled number to `DECIMALS`."""
    return round(float(value), DECIMALS)


def rectangle(x_min: float, y_min: float, x_max: float, y_max: float) -> Obstacle:
    """Return a rectangle that is parallel to the axes."""
    return polygon(np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]))


def polygon(vertices: np.ndarray) -> Obstacle:
    """Return a polygon with vertices (n, 2), which are rounded."""
    return Obstacle(polygon=Polygon(vertices=tuple(point(vertex) for vertex in vertices)))


def point(values: np.ndarray) -> tuple[float, float]:
    """Return a rounded position (2,)."""
    return rounded(values[0]), rounded(values[1])
