"""Frames of an episode, drawn by pygame, with or without a window."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pygame

from leapnav.envs import driving
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.fleet import Fleet
from leapnav.envs.scenario import Scenario
from leapnav.envs.tasks import scenario_of

SIZE, STATUS = 600, 40  # pixels: the longer side of the arena, and the line of text below it
SUPERSAMPLING = 2  # drawn larger and scaled down, which smooths the edges
BACKGROUND, FLOOR, WALL = (255, 255, 255), (250, 250, 248), (60, 64, 72)
OBSTACLE, EDGE = (184, 190, 200), (120, 126, 138)
ROBOT, CRASHED, WHEEL, NOSE = (38, 98, 171), (192, 57, 43), (20, 30, 50), (255, 255, 255)
GOAL, TRAIL, OPTIMUM, RAY = (34, 139, 84), (38, 98, 171), (236, 164, 92), (236, 200, 194)
LIDAR, TEXT, OPTIMUM_TEXT = (222, 120, 120), (60, 64, 72), (186, 108, 34)

Place = Callable[[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Scene:
    """What a frame shows.

    Attributes:
        scenario: arena, obstacles, goal and the robot's size.
        pose: x, y (m), heading (rad).
        trail: the poses so far.
        optimum (N, 3): the reference path, None if it is not known.
        ranges: lidar ranges (m), counter-clockwise from straight ahead; none without a lidar.
        lidar_range: m, the largest.
        cost, reference_cost: so far, and of the optimum.
        time: s so far.
        collided: whether the robot has touched something.

    """

    scenario: Scenario
    pose: tuple[float, float, float]
    trail: Sequence[tuple[float, float, float]] = ()
    optimum: np.ndarray | None = None
    ranges: Sequence[float] = ()
    lidar_range: float = math.inf
    cost: float = 0.0
    reference_cost: float | None = None
    time: float = 0.0
    collided: bool = False


def scene_of(
    fleet: Fleet,
    robot: int,
    choice: Scenario | int,
    bank: ScenarioBank | None,
    trail: list[tuple[float, float, float]],
) -> Scene:
    """What a frame of one robot's episode shows."""
    optimum, reference_cost = None, None
    if bank is not None and isinstance(choice, int):
        optimum, reference_cost = bank.states(choice), float(bank.costs[choice])
    row = fleet.state[robot]
    return Scene(
        scenario=scenario_of(choice, bank),
        pose=tuple(fleet.poses[robot].tolist()),
        trail=trail,
        optimum=optimum,
        ranges=fleet.ranges(robot).tolist(),
        lidar_range=fleet.settings.lidar_range,
        cost=float(row[driving.COST]),
        reference_cost=reference_cost,
        time=float(row[driving.TIME]),
        collided=bool(row[driving.COLLIDED]),
    )


def draw_scene(scene: Scene) -> np.ndarray:
    """A frame (height, width, 3) of uint8, both sides even, as video encoders want them."""
    scenario = scene.scenario
    x_min, y_min, x_max, y_max = scenario.arena
    margin = 0.02 * max(x_max - x_min, y_max - y_min)
    scale = SUPERSAMPLING * SIZE / (max(x_max - x_min, y_max - y_min) + 2 * margin)
    width = 2 * SUPERSAMPLING * math.ceil((x_max - x_min + 2 * margin) * scale / (2 * SUPERSAMPLING) - 1e-6)
    height = 2 * SUPERSAMPLING * math.ceil((y_max - y_min + 2 * margin) * scale / (2 * SUPERSAMPLING) - 1e-6)
    canvas = pygame.Surface((width, height))
    canvas.fill(BACKGROUND)

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - x_min + margin) * scale, height - (y - y_min + margin) * scale

    line = max(1, round(0.03 * scale))
    corner, opposite = at(x_min, y_max), at(x_max, y_min)
    frame = pygame.Rect(*corner, opposite[0] - corner[0], opposite[1] - corner[1])
    pygame.draw.rect(canvas, FLOOR, frame)
    beams = _lidar_ends(at, scene)
    for end, _ in beams:
        pygame.draw.line(canvas, RAY, at(*scene.pose[:2]), end, max(1, line // 2))
    for obstacle in scenario.obstacles:
        if obstacle.circle is not None:
            center, radius = at(*obstacle.circle.center), obstacle.circle.radius * scale
            pygame.draw.circle(canvas, OBSTACLE, center, radius)
            pygame.draw.circle(canvas, EDGE, center, radius, line)
        elif obstacle.polygon is not None:
            corners = [at(*vertex) for vertex in obstacle.polygon.vertices]
            pygame.draw.polygon(canvas, OBSTACLE, corners)
            pygame.draw.polygon(canvas, EDGE, corners, line)
    pygame.draw.rect(canvas, WALL, frame, 2 * line)
    for end, hit in beams:
        if hit:
            pygame.draw.circle(canvas, LIDAR, end, 1.5 * line)

    if scene.optimum is not None:
        _draw_path(canvas, OPTIMUM, [at(x, y) for x, y in scene.optimum[:, :2].tolist()], 2 * line)
    radius = scenario.robot.radius
    goal = scenario.goal
    pygame.draw.circle(canvas, GOAL, at(goal[0], goal[1]), radius * scale, 2 * line)
    if goal[2] is not None:
        _draw_arrow(canvas, GOAL, at, (goal[0], goal[1], goal[2]), radius, 2 * line)
    _draw_path(canvas, TRAIL, [at(x, y) for x, y, _ in scene.trail], 2 * line)
    _draw_robot(canvas, CRASHED if scene.collided else ROBOT, at, scene.pose, radius, scale)
    small = pygame.transform.smoothscale(canvas, (width // SUPERSAMPLING, height // SUPERSAMPLING))
    whole = pygame.Surface((small.get_width(), small.get_height() + STATUS))
    whole.fill(BACKGROUND)
    whole.blit(small, (0, 0))
    _draw_status(whole, scene, small.get_height())
    return np.ascontiguousarray(np.transpose(pygame.surfarray.array3d(whole), (1, 0, 2)))


def _lidar_ends(at: Place, scene: Scene) -> list[tuple[tuple[float, float], bool]]:
    """Where each beam ends on the canvas, and whether it has hit something."""
    x, y, heading = scene.pose
    angles = [heading + 2 * math.pi * k / len(scene.ranges) for k in range(len(scene.ranges))]
    return [
        (at(x + reach * math.cos(angle), y + reach * math.sin(angle)), reach < scene.lidar_range)
        for angle, reach in zip(angles, scene.ranges, strict=True)
    ]


def _draw_path(
    canvas: pygame.Surface, color: tuple[int, int, int], points: list[tuple[float, float]], width: int
) -> None:
    if len(points) > 1:
        pygame.draw.lines(canvas, color, False, points, width)
        for point in points:  # rounds the joints, which pygame leaves open
            pygame.draw.circle(canvas, color, point, width / 2)


def _draw_arrow(
    canvas: pygame.Surface,
    color: tuple[int, int, int],
    at: Place,
    pose: tuple[float, float, float],
    length: float,
    line: int,
) -> None:
    x, y, heading = pose
    tip = x + 1.7 * length * math.cos(heading), y + 1.7 * length * math.sin(heading)
    pygame.draw.line(canvas, color, at(x, y), at(*tip), line)
    barbs = [
        (tip[0] + 0.5 * length * math.cos(heading + turn), tip[1] + 0.5 * length * math.sin(heading + turn))
        for turn in (math.radians(150), -math.radians(150))
    ]
    pygame.draw.polygon(canvas, color, [at(*tip), *(at(*barb) for barb in barbs)])


def _draw_robot(
    canvas: pygame.Surface,
    color: tuple[int, int, int],
    at: Place,
    pose: tuple[float, float, float],
    radius: float,
    scale: float,
) -> None:
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)

    def outline(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [at(x + radius * (a * cos - b * sin), y + radius * (a * sin + b * cos)) for a, b in corners]

    pygame.draw.circle(canvas, color, at(x, y), radius * scale)
    for side in (-0.75, 0.75):  # wheels
        wheel = [(a, side + b) for a, b in ((-0.4, -0.12), (0.4, -0.12), (0.4, 0.12), (-0.4, 0.12))]
        pygame.draw.polygon(canvas, WHEEL, outline(wheel))
    pygame.draw.polygon(canvas, NOSE, outline([(0.9, 0.0), (0.35, 0.3), (0.35, -0.3)]))


def _draw_status(canvas: pygame.Surface, scene: Scene, top: int) -> None:
    left = max(scene.scenario.horizon - scene.time, 0.0)
    texts = [f"time left {left:.1f} s", f"cost {scene.cost:.2f}"]
    if scene.reference_cost is not None:
        texts.append(f"optimum {scene.reference_cost:.2f}")
    font = _font(max(10, min(20, canvas.get_width() // 28)))
    column = canvas.get_width() / len(texts)
    for number, text in enumerate(texts):
        image = font.render(text, True, OPTIMUM_TEXT if number == 2 else TEXT)
        place = column * (number + 0.5) - image.get_width() / 2, top + (STATUS - image.get_height()) / 2
        canvas.blit(image, place)


@cache
def _font(size: int) -> pygame.font.Font:
    pygame.font.init()
    return pygame.font.Font(None, size + 4)


class Window:
    """A window that shows frames at an even pace.

    Args:
        fps: frames per second.

    Attributes:
        closed: whether the user has closed it.

    """

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._surface: pygame.Surface | None = None
        self._clock = pygame.time.Clock()
        self.closed = False

    def show(self, frame: np.ndarray) -> None:
        """Shows a frame."""
        size = frame.shape[1], frame.shape[0]
        if self._surface is None or self._surface.get_size() != size:
            pygame.display.init()
            pygame.display.set_caption("leapnav")
            self._surface = pygame.display.set_mode(size)
        self._surface.blit(pygame.surfarray.make_surface(np.transpose(frame, (1, 0, 2))), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)
        self.closed |= any(event.type == pygame.QUIT for event in pygame.event.get())

    def close(self) -> None:
        """Closes the window."""
        if self._surface is not None:
            pygame.display.quit()
            self._surface = None
