"""Frames of the environment, drawn by pygame without a window."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pygame

from leapnav.envs.scenario import Scenario

SIZE = 600  # pixels, the longer side of the frame
SUPERSAMPLING = 2  # drawn larger and scaled down, which smooths the edges
BACKGROUND, WALL, OBSTACLE, EDGE = (250, 250, 248), (60, 64, 72), (176, 182, 192), (120, 126, 138)
ROBOT, WHEEL, GOAL, TRAIL = (38, 98, 171), (20, 30, 50), (34, 139, 84), (38, 98, 171)


def draw_scene(
    scenario: Scenario,
    pose: tuple[float, float, float],
    trail: Sequence[tuple[float, float, float]] = (),
) -> np.ndarray:
    """A frame (height, width, 3) of uint8: obstacles, goal, the path so far and the robot."""
    x_min, y_min, x_max, y_max = scenario.arena
    margin = 0.02 * max(x_max - x_min, y_max - y_min)
    scale = SUPERSAMPLING * SIZE / (max(x_max - x_min, y_max - y_min) + 2 * margin)
    width = round((x_max - x_min + 2 * margin) * scale)
    height = round((y_max - y_min + 2 * margin) * scale)
    canvas = pygame.Surface((width, height))
    canvas.fill(BACKGROUND)

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - x_min + margin) * scale, height - (y - y_min + margin) * scale

    line = max(1, round(0.03 * scale))
    for obstacle in scenario.obstacles:
        if obstacle.circle is not None:
            center, radius = at(*obstacle.circle.center), obstacle.circle.radius * scale
            pygame.draw.circle(canvas, OBSTACLE, center, radius)
            pygame.draw.circle(canvas, EDGE, center, radius, line)
        elif obstacle.polygon is not None:
            corners = [at(*vertex) for vertex in obstacle.polygon.vertices]
            pygame.draw.polygon(canvas, OBSTACLE, corners)
            pygame.draw.polygon(canvas, EDGE, corners, line)
    corner, opposite = at(x_min, y_max), at(x_max, y_min)
    frame = pygame.Rect(*corner, opposite[0] - corner[0], opposite[1] - corner[1])
    pygame.draw.rect(canvas, WALL, frame, 2 * line)

    radius = scenario.robot.radius
    goal = scenario.goal
    pygame.draw.circle(canvas, GOAL, at(goal[0], goal[1]), radius * scale, 2 * line)
    if goal[2] is not None:
        _draw_arrow(canvas, GOAL, at, (goal[0], goal[1], goal[2]), radius, 2 * line)
    if len(trail) > 1:
        pygame.draw.lines(canvas, TRAIL, False, [at(x, y) for x, y, _ in trail], 2 * line)
    _draw_robot(canvas, at, pose, radius, scale, line)
    small = pygame.transform.smoothscale(canvas, (width // SUPERSAMPLING, height // SUPERSAMPLING))
    return np.ascontiguousarray(np.transpose(pygame.surfarray.array3d(small), (1, 0, 2)))


def _draw_arrow(canvas, color, at, pose, length, line) -> None:
    x, y, heading = pose
    tip = x + 1.7 * length * math.cos(heading), y + 1.7 * length * math.sin(heading)
    pygame.draw.line(canvas, color, at(x, y), at(*tip), line)
    barbs = [
        (tip[0] + 0.5 * length * math.cos(heading + turn), tip[1] + 0.5 * length * math.sin(heading + turn))
        for turn in (math.radians(150), -math.radians(150))
    ]
    pygame.draw.polygon(canvas, color, [at(*tip), *(at(*barb) for barb in barbs)])


def _draw_robot(canvas, at, pose, radius, scale, line) -> None:
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    pygame.draw.circle(canvas, ROBOT, at(x, y), radius * scale)
    for side in (-0.75, 0.75):  # wheels
        corners = [
            at(x + radius * (along * cos - side * sin), y + radius * (along * sin + side * cos))
            for along, side in ((-0.4, side - 0.12), (0.4, side - 0.12), (0.4, side + 0.12), (-0.4, side + 0.12))
        ]
        pygame.draw.polygon(canvas, WHEEL, corners)
    nose = [
        at(x + radius * (a * cos - b * sin), y + radius * (a * sin + b * cos))
        for a, b in ((0.9, 0.0), (0.35, 0.3), (0.35, -0.3))
    ]
    pygame.draw.polygon(canvas, (255, 255, 255), nose)
