"""Rendering of episodes with pygame, to arrays or to a window."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pygame

from leapnav.envs.field.packing import parts_at
from leapnav.envs.robots.footprints import axis_of, corners_of
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import get_scenario
from leapnav.envs.shapes import Capsule
from leapnav.envs.simulation.simulator import BatchSimulator
from leapnav.envs.utils.colors import EDGE, FAILURE, GOAL, OBSTACLE, OPTIMUM, POLICY, WALL

SIZE, STATUS_HEIGHT = 600, 40  # pixels: longer side of the arena, and height of the status line below it
SUPERSAMPLING = 2  # frames are drawn at this multiple of their size and scaled down, which smooths the edges
WHITE, FLOOR, WHEEL, RAY, BEAM_END = "#ffffff", "#fafaf8", "#141e32", "#ecc8c2", "#de7878"

ToPixels = Callable[[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Scene:
    """The content of a frame.

    Attributes:
        scenario: the scenario of the episode.
        field: the packed obstacle field, in which obstacles may have moved.
        state: state (n,) of the robot; the first three entries are x, y (m) and the heading (rad).
        trail: the poses of the episode so far.
        optimum (N, 3): the reference path, or None.
        ranges: lidar ranges (m); empty without a lidar.
        beam_angles: their angles (rad), counter-clockwise from straight ahead.
        lidar_range: maximum range (m).
        cost: cost of the episode so far.
        reference_cost: cost of the optimum, or None.
        time: time since the start of the episode (s).
        collided: whether the robot has collided.

    """

    scenario: Scenario
    field: np.ndarray
    state: tuple[float, ...]
    trail: Sequence[tuple[float, float, float]] = ()
    optimum: np.ndarray | None = None
    ranges: Sequence[float] = ()
    beam_angles: Sequence[float] = ()
    lidar_range: float = math.inf
    cost: float = 0.0
    reference_cost: float | None = None
    time: float = 0.0
    collided: bool = False


def make_scene(
    simulator: BatchSimulator,
    robot: int,
    choice: Scenario | int,
    bank: ScenarioBank | None,
    trail: list[tuple[float, float, float]],
    *,
    show_optimum: bool,
) -> Scene:
    """Return the scene of one robot's episode, with the optimum of a scenario of the bank if it is to be shown."""
    optimum, reference_cost = None, None
    if show_optimum and bank is not None and isinstance(choice, int):
        optimum, reference_cost = bank.states(choice), float(bank.costs[choice])
    episode = simulator.episode(robot)
    return Scene(
        scenario=get_scenario(choice, bank),
        field=simulator.fields[robot],
        state=tuple(simulator.states[robot].tolist()),
        trail=trail,
        optimum=optimum,
        ranges=simulator.ranges(robot).tolist(),
        beam_angles=simulator.settings.beam_angles.tolist(),
        lidar_range=simulator.settings.lidar_range,
        cost=episode.cost,
        reference_cost=reference_cost,
        time=episode.time,
        collided=episode.collided,
    )


def draw_scene(scene: Scene) -> np.ndarray:
    """Return a frame (height, width, 3) of uint8; both sides are even, as video encoders require."""
    scenario = scene.scenario
    x_min, y_min, x_max, y_max = scenario.arena
    margin = 0.02 * max(x_max - x_min, y_max - y_min)
    scale = SUPERSAMPLING * SIZE / (max(x_max - x_min, y_max - y_min) + 2 * margin)
    width = 2 * SUPERSAMPLING * math.ceil((x_max - x_min + 2 * margin) * scale / (2 * SUPERSAMPLING) - 1e-6)
    height = 2 * SUPERSAMPLING * math.ceil((y_max - y_min + 2 * margin) * scale / (2 * SUPERSAMPLING) - 1e-6)
    canvas = pygame.Surface((width, height))
    canvas.fill(WHITE)

    def to_pixels(x: float, y: float) -> tuple[float, float]:
        return (x - x_min + margin) * scale, height - (y - y_min + margin) * scale

    line = max(1, round(0.03 * scale))
    corner, opposite = to_pixels(x_min, y_max), to_pixels(x_max, y_min)
    frame = pygame.Rect(*corner, opposite[0] - corner[0], opposite[1] - corner[1])
    pygame.draw.rect(canvas, FLOOR, frame)
    beams = _lidar_ends(to_pixels, scene)
    for end, _ in beams:
        pygame.draw.line(canvas, RAY, to_pixels(*scene.state[:2]), end, max(1, line // 2))
    for vertices, rounding, *_ in parts_at(scene.field, scene.time):
        if len(vertices) == 1:
            center, radius = to_pixels(*vertices[0].tolist()), rounding * scale
            pygame.draw.circle(canvas, OBSTACLE, center, radius)
            pygame.draw.circle(canvas, EDGE, center, radius, line)
        else:
            ends = map(tuple, vertices.tolist())
            outline = (
                vertices if rounding == 0.0 else Capsule(start=next(ends), end=next(ends), radius=rounding).outline()
            )
            corners = [to_pixels(*vertex) for vertex in outline.tolist()]
            pygame.draw.polygon(canvas, OBSTACLE, corners)
            pygame.draw.polygon(canvas, EDGE, corners, line)
    pygame.draw.rect(canvas, WALL, frame, 2 * line)
    for end, hit in beams:
        if hit:
            pygame.draw.circle(canvas, BEAM_END, end, 1.5 * line)

    if scene.optimum is not None:
        _draw_path(canvas, OPTIMUM, [to_pixels(x, y) for x, y in scene.optimum[:, :2].tolist()], 2 * line)
    goal = scenario.goal
    at_goal = [value or 0.0 for value in scenario.goal_state]
    _draw_outline(canvas, GOAL, to_pixels, at_goal, scenario.outline, scale, 2 * line)
    if goal[2] is not None:
        _draw_arrow(canvas, GOAL, to_pixels, at_goal[:3], _smallest_radius(scenario.outline), 2 * line)
    _draw_path(canvas, POLICY, [to_pixels(x, y) for x, y, _ in scene.trail], 2 * line)
    _draw_robot(canvas, FAILURE if scene.collided else POLICY, to_pixels, scene.state, scenario.outline, scale)
    small = pygame.transform.smoothscale(canvas, (width // SUPERSAMPLING, height // SUPERSAMPLING))
    whole = pygame.Surface((small.get_width(), small.get_height() + STATUS_HEIGHT))
    whole.fill(WHITE)
    whole.blit(small, (0, 0))
    _draw_status(whole, scene, small.get_height())
    return np.ascontiguousarray(np.transpose(pygame.surfarray.array3d(whole), (1, 0, 2)))


def _lidar_ends(to_pixels: ToPixels, scene: Scene) -> list[tuple[tuple[float, float], bool]]:
    """Return the end of each beam on the canvas (pixels), and whether it has hit an obstacle or a wall."""
    x, y, heading = scene.state[:3]
    angles = [heading + angle for angle in scene.beam_angles[: len(scene.ranges)]]
    return [
        (to_pixels(x + reach * math.cos(angle), y + reach * math.sin(angle)), reach < scene.lidar_range)
        for angle, reach in zip(angles, scene.ranges, strict=True)
    ]


def _draw_path(canvas: pygame.Surface, color: str, points: list[tuple[float, float]], width: int) -> None:
    if len(points) > 1:
        pygame.draw.lines(canvas, color, False, points, width)
        for point in points:  # rounds the joints, which pygame leaves open
            pygame.draw.circle(canvas, color, point, width / 2)


def _draw_arrow(
    canvas: pygame.Surface,
    color: str,
    to_pixels: ToPixels,
    pose: Sequence[float],
    length: float,
    line: int,
) -> None:
    x, y, heading = pose
    tip = x + 1.7 * length * math.cos(heading), y + 1.7 * length * math.sin(heading)
    pygame.draw.line(canvas, color, to_pixels(x, y), to_pixels(*tip), line)
    barbs = [
        (tip[0] + 0.5 * length * math.cos(heading + turn), tip[1] + 0.5 * length * math.sin(heading + turn))
        for turn in (math.radians(150), -math.radians(150))
    ]
    pygame.draw.polygon(canvas, color, [to_pixels(*tip), *(to_pixels(*barb) for barb in barbs)])


def _smallest_radius(outline: np.ndarray) -> float:
    """Return the radius (m) of the smallest disc in an outline, the unit of the symbols of a robot."""
    return float(outline[:, 2:4].sum(axis=1).min())


def _draw_outline(
    canvas: pygame.Surface,
    color: str,
    to_pixels: ToPixels,
    state: Sequence[float],
    outline: np.ndarray,
    scale: float,
    line: int = 0,
) -> None:
    """Draw the outline (K, 5) of a robot at a state, filled unless `line` is its width in pixels."""
    x, y = state[:2]
    for row in outline.tolist():
        (rear, front, _, radius, joint), axis = row, axis_of(row, state)
        if joint:  # the drawbar
            middle, width = (rear + front) / 2, line or max(1, round(radius or row[2] * scale / 4))
            end = x + middle * math.cos(axis), y + middle * math.sin(axis)
            pygame.draw.line(canvas, color, to_pixels(x, y), to_pixels(*end), width)
        if front > rear:
            corners = [to_pixels(*corner) for corner in corners_of(row, state).tolist()]
            pygame.draw.polygon(canvas, color, corners, line)
        else:
            centre = to_pixels(x + rear * math.cos(axis), y + rear * math.sin(axis))
            pygame.draw.circle(canvas, color, centre, radius * scale, line)


def _draw_robot(
    canvas: pygame.Surface,
    color: str,
    to_pixels: ToPixels,
    state: Sequence[float],
    robot: np.ndarray,
    scale: float,
) -> None:
    x, y, heading = state[:3]
    cos, sin = math.cos(heading), math.sin(heading)
    radius = _smallest_radius(robot)

    def outline(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [to_pixels(x + radius * (a * cos - b * sin), y + radius * (a * sin + b * cos)) for a, b in corners]

    _draw_outline(canvas, color, to_pixels, state, robot, scale)
    for side in (-0.75, 0.75):  # wheels
        wheel = [(a, side + b) for a, b in ((-0.4, -0.12), (0.4, -0.12), (0.4, 0.12), (-0.4, 0.12))]
        pygame.draw.polygon(canvas, WHEEL, outline(wheel))
    pygame.draw.polygon(canvas, WHITE, outline([(0.9, 0.0), (0.35, 0.3), (0.35, -0.3)]))


def _draw_status(canvas: pygame.Surface, scene: Scene, top: int) -> None:
    horizon = scene.scenario.horizon
    time = f"time {scene.time:.1f} s" if horizon is None else f"time left {max(horizon - scene.time, 0.0):.1f} s"
    texts = [time, f"cost {scene.cost:.2f}"]
    if scene.reference_cost is not None:
        texts.append(f"optimum {scene.reference_cost:.2f}")
    size = max(10, min(20, canvas.get_width() // 28))
    column = canvas.get_width() / len(texts)
    for number, text in enumerate(texts):
        image = _text(text, size, OPTIMUM if number == 2 else WALL)
        position = column * (number + 0.5) - image.get_width() / 2, top + (STATUS_HEIGHT - image.get_height()) / 2
        canvas.blit(image, position)


def _text(text: str, size: int, color: str) -> pygame.Surface:
    """Return a picture of a text."""
    try:
        return _font(size).render(text, True, color)
    except pygame.error:  # another program part has called pygame.quit(), which invalidates the fonts
        _font.cache_clear()
        return _font(size).render(text, True, color)


@cache
def _font(size: int) -> pygame.font.Font:
    pygame.font.init()
    return pygame.font.Font(None, size + 4)


class Window:
    """A window that shows frames at a constant rate.

    Args:
        fps: frames per second.

    Attributes:
        closed: whether the user has closed the window.

    """

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._surface: pygame.Surface | None = None
        self._clock = pygame.time.Clock()
        self.closed = False

    def show(self, frame: np.ndarray) -> None:
        """Show a frame."""
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
        """Close the window."""
        if self._surface is not None:
            pygame.display.quit()
            self._surface = None
