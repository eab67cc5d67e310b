"""Layouts of the built-in families whose obstacles move."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from leapnav.envs.scenarios.layouts.at_rest import rooms_of
from leapnav.envs.scenarios.layouts.crowd import CLOSEST, simulate_crowd
from leapnav.envs.scenarios.layouts.layout import ScenarioLayout, point, rectangle, rounded
from leapnav.envs.scenarios.obstacle import Obstacle, ObstaclePath
from leapnav.envs.shapes import Capsule, Circle

ACROSS = (0.6, 1.0, 1.2, 9.0), (8.8, 1.0, 9.4, 9.0)  # regions of start and goal on two sides of the arena
TRAFFIC_TIME = 15.0  # s, at least the horizon of a path across the arena
DOOR_TIME = 40.0  # s, the longest horizon
SLIDING_TIME = 1.0  # s in which a door opens or closes
RECORDED_TIME, RECORDED_STEP = 20.0, 0.8  # s, of the paths of a crowd
RECORDED_DECIMALS = 2  # of positions in a recording


def _crossing(rng: np.random.Generator) -> ScenarioLayout:
    """4 to 8 discs at constant velocities (0.3 to 1.2 m/s) in all directions, between start and goal."""
    obstacles = []
    for _ in range(rng.integers(4, 9)):
        speed, angle, time = rng.uniform(0.3, 1.2), rng.uniform(-math.pi, math.pi), rng.uniform(1.0, 10.0)
        velocity = point(speed * np.array([math.cos(angle), math.sin(angle)]))
        center = point(rng.uniform((2.5, 2.0), (7.5, 8.0)) - time * np.array(velocity))
        obstacles.append(
            Obstacle(circle=Circle(center=center, radius=rounded(rng.uniform(0.25, 0.6))), velocity=velocity)
        )
    return ScenarioLayout(obstacles, *ACROSS)


def _traffic(rng: np.random.Generator) -> ScenarioLayout:
    """A road with 2 to 4 lanes between start and goal, alternately in both directions, of different speeds."""
    count, up = int(rng.integers(2, 5)), bool(rng.integers(2))
    obstacles = []
    for x in 5.0 + 1.2 * (np.arange(count) - (count - 1) / 2.0):
        speed = rng.uniform(0.4, 1.2)
        # From one end of the arena to the other one, and what arrives within the time.
        y, end = -rng.uniform(0.0, 4.0), 10.0 + speed * TRAFFIC_TIME
        while y < end:
            length = rng.uniform(0.3, 0.9)
            ends = [point(np.array([x, 10.0 - at if up else at])) for at in (10.0 - y, 10.0 - y - length)]
            shape = Capsule(start=ends[0], end=ends[1], radius=0.35)
            obstacles.append(Obstacle(capsule=shape, velocity=(0.0, rounded(-speed if up else speed))))
            y += length + 0.7 + rng.uniform(1.5, 4.0)
        up = not up
    return ScenarioLayout(obstacles, *ACROSS)


def _doors(rng: np.random.Generator) -> ScenarioLayout:
    """The rooms of `rooms` with sliding doors, which are open for 2.5 to 4 s, then closed for 1 to 3 s, and so on."""
    walls, openings = rooms_of(rng)
    doors = []
    for axis, low, high in openings:
        corners = (4.95, low, 5.05, high) if axis == 1 else (low, 4.95, high, 5.05)
        shift = (high - low) * (1.0 if low > 5.0 else -1.0)  # away from the centre
        is_open, closed = rng.uniform(2.5, 4.0), rng.uniform(1.0, 3.0)
        durations = np.tile([is_open, SLIDING_TIME, closed, SLIDING_TIME], 10)
        times = np.cumsum(np.append(-rng.uniform(0.0, is_open + closed + 2.0 * SLIDING_TIME), durations))
        times = times[times < DOOR_TIME]
        # The shape is given where the door is at its first point, in the wall.
        moved = np.where(np.arange(len(times)) % 4 < 2, 0.0, -shift)
        offset = np.array([0.0, shift]) if axis == 1 else np.array([shift, 0.0])
        points = [point(np.array([0.0, m]) if axis == 1 else np.array([m, 0.0])) for m in moved]
        x_min, y_min, x_max, y_max = np.array(corners) + np.tile(offset, 2)
        shape = rectangle(x_min, y_min, x_max, y_max).shape
        path = ObstaclePath(times=tuple(map(rounded, times)), points=tuple(points))
        doors.append(Obstacle(polygon=shape, path=path))
    return ScenarioLayout([*walls, *doors], waiting=4.0)


def _crowd(rng: np.random.Generator) -> ScenarioLayout:
    """8 to 12 pedestrians of a social-force model, which do not see the robot, as a recording with a step of 0.8 s."""
    times = np.arange(0.0, RECORDED_TIME + 0.5 * RECORDED_STEP, RECORDED_STEP).round(1)
    paths = simulate_crowd(rng, int(rng.integers(8, 13)), times).round(RECORDED_DECIMALS)
    obstacles = []
    for points in paths.transpose(1, 0, 2).tolist():
        path = ObstaclePath(times=tuple(times.tolist()), points=tuple((x, y) for x, y in points))
        obstacles.append(Obstacle(circle=Circle(center=path.points[0], radius=CLOSEST / 2), path=path))
    return ScenarioLayout(obstacles)


MOVING_LAYOUTS: dict[str, Callable[[np.random.Generator], ScenarioLayout]] = {
    "crossing": _crossing,
    "traffic": _traffic,
    "crowd": _crowd,
    "doors": _doors,
}
