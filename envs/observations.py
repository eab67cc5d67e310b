"""What is observed: the parts of an observation, their spaces, and the kernel that fills them for many robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import float32, float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.envs.driving import SPIN, TIME, VX, VY
from leapnav.envs.scenario import GOAL, HORIZON, LARGEST
from leapnav.envs.sensing import WALL_ENTRIES, scan, survey
from leapnav.envs.settings import (
    GOAL_CONDITIONED,
    LIDAR_RANGE,
    MOTORS,
    OBSERVATION,
    OBSERVATIONS,
    OBSTACLES,
    PERIOD,
    SENSING_NOISE,
    VERTICES,
    Settings,
)

# Entries of the parts; the environments' docstrings say what they mean.
GOAL_ENTRIES, MOTION_ENTRIES, POSE_ENTRIES = 9, 3, 4
TIME_LEFT = 4  # place in the goal's part
# Bounds that no scenario of a sensible size reaches; values beyond are clipped.
FARTHEST, LONGEST, FASTEST = 1000.0, 10_000.0, 20.0
LIDAR, MAP = OBSERVATIONS.index("lidar"), OBSERVATIONS.index("map")
FIRST_SENSED = 4  # column of the noise, after what disturbs the wheels


@dataclass(frozen=True)
class Part:
    """A named stretch of the observation, with its bounds."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]


def _parts(settings: Settings) -> list[Part]:
    parts = []
    if settings.goal_conditioned:
        # Places, unlike ways to go, must not be clipped: clipped goals would look achieved.
        pose = (-LARGEST, -LARGEST, -1.0, -1.0), (LARGEST, LARGEST, 1.0, 1.0)
        parts += [Part("achieved_goal", *pose), Part("desired_goal", *pose), Part("time", (0.0,), (LONGEST,))]
    else:
        low = (-FARTHEST, -FARTHEST, -1.0, -1.0, 0.0, -FASTEST, -FASTEST, 0.0, -FASTEST)
        parts.append(Part("goal", low, (FARTHEST, FARTHEST, 1.0, 1.0, LONGEST, *[FASTEST] * 4)))
    if settings.motors:
        parts.append(Part("motion", (-FASTEST,) * MOTION_ENTRIES, (FASTEST,) * MOTION_ENTRIES))
    if settings.observation == "lidar":
        beams = settings.lidar_beams
        parts.append(Part("lidar", (0.0,) * beams, (settings.lidar_range,) * beams))
    elif settings.observation == "map":
        low = (-FARTHEST,) * 4 + (-1.0, -1.0)
        parts.append(Part("walls", low, (FARTHEST,) * 4 + (1.0, 1.0)))
        vertices, count = 2 * settings.map_vertices, settings.map_obstacles
        low, high = (0.0, 0.0) + (-FARTHEST,) * vertices, (1.0, FARTHEST) + (FARTHEST,) * vertices
        parts.append(Part("obstacles", low * count, high * count))
    return [part for part in parts if part.low]


class Layout:
    """The observation of one setting: its spaces, and how the flat row that the kernels fill is divided.

    Attributes:
        space: of one robot's observation.
        size: entries of the flat row.

    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        parts = _parts(settings)
        self.bounds = np.array(
            [[v for part in parts for v in part.low], [v for part in parts for v in part.high]], dtype=np.float32
        )
        self.size = self.bounds.shape[1]
        angles = 2 * math.pi * np.arange(settings.lidar_beams) / max(settings.lidar_beams, 1)
        self._beams = np.stack([np.cos(angles), np.sin(angles)])
        self._scratch = np.zeros((5, settings.lidar_beams))
        survey = WALL_ENTRIES + settings.map_obstacles * (2 + 2 * settings.map_vertices)
        self._survey, self._row = np.zeros(survey), np.zeros(self.size)
        ends = np.cumsum([len(part.low) for part in parts]).tolist()
        slices = {part.name: slice(end - len(part.low), end) for part, end in zip(parts, ends, strict=True)}
        self._slices: dict[str, slice] | None = None
        if settings.goal_conditioned:  # what is no goal is one box, as learners for goals expect
            first = ends[1]
            goals = {name: slices[name] for name in ("achieved_goal", "desired_goal")}
            self._slices = {"observation": slice(first, self.size), **goals}
        elif settings.dict_observation:
            self._slices = slices
        self.space: spaces.Space[Any] = self._space()

    def _space(self) -> spaces.Space[Any]:
        low, high = self.bounds
        if self._slices is None:
            return spaces.Box(low, high, dtype=np.float32)
        boxes: dict[str, spaces.Space[Any]] = {}
        for name, part in self._slices.items():
            boxes[name] = spaces.Box(low[part], high[part], dtype=np.float32)
        return spaces.Dict(boxes)

    def divide(self, flat: np.ndarray) -> Any:
        """Flat observations (..., size) as the space has them."""
        if self._slices is None:
            return flat
        return {name: np.ascontiguousarray(flat[..., part]) for name, part in self._slices.items()}

    def scan(self, pose: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Lidar ranges (m) at a pose, empty without a lidar."""
        if self._settings.observation != "lidar":
            return np.empty(0)
        scan(
            pose[0],
            pose[1],
            math.cos(pose[2]),
            math.sin(pose[2]),
            field,
            self._settings.lidar_range,
            self._beams,
            self._scratch,
        )
        return self._scratch[2].copy()

    def fill(
        self,
        robots: np.ndarray,
        bodies: np.ndarray,
        state: np.ndarray,
        tasks: np.ndarray,
        fields: np.ndarray,
        noise: np.ndarray,
        noise_rows: np.ndarray,
        packed: np.ndarray,
        out: np.ndarray,
    ) -> None:
        """Writes the flat observations of robots, given by number, into their rows of `out`."""
        scratch = self._beams, self._scratch, self._survey, self._row, self.bounds
        observe_robots(robots, bodies, state, tasks, fields, noise, noise_rows, packed, *scratch, out)


@njit(
    types.none(
        int64[::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, :, ::1],
        int64[::1],
        float64[::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[::1],
        float64[::1],
        float32[:, ::1],
        float32[:, ::1],
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def observe_robots(
    robots, bodies, state, tasks, fields, noise, noise_rows, settings, beams, scratch, surveyed, row, bounds, out
):
    """Fills the rows of `out` of robots, given by number, with what the environments' docstrings describe.

    Args:
        robots: numbers.
        bodies, state, tasks, fields: see `Fleet`.
        noise, noise_rows: standard normal, and which row of it is each robot's; unread without sensing noise.
        settings: see `leapnav.envs.settings`.
        beams, scratch: see `scan`.
        surveyed, row: room for `survey`, and for an observation before it is rounded.
        bounds (2, n): the lowest and highest values.

    """
    deviation = settings[SENSING_NOISE]
    goal_conditioned, motors = settings[GOAL_CONDITIONED] != 0.0, settings[MOTORS] != 0.0
    has_lidar, has_map = settings[OBSERVATION] == LIDAR, settings[OBSERVATION] == MAP
    count = beams.shape[1]
    for i in robots:
        x, y, heading = bodies[i, 0], bodies[i, 1], bodies[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        if has_lidar and count > 0:  # from where the robot is, not where it thinks that it is
            scan(x, y, cos, sin, fields[i], settings[LIDAR_RANGE], beams, scratch)
        # Goals that are achieved are not disturbed: they decide the reward.
        if deviation != 0.0 and not goal_conditioned:
            drawn = noise[i, noise_rows[i]]
            x += deviation * drawn[FIRST_SENSED]
            y += deviation * drawn[FIRST_SENSED + 1]
            heading += deviation * drawn[FIRST_SENSED + 2]
            cos, sin = math.cos(heading), math.sin(heading)
        goal_x, goal_y, goal_heading = tasks[i, GOAL], tasks[i, GOAL + 1], tasks[i, GOAL + 2]
        free = math.isnan(goal_heading)
        time_left = tasks[i, HORIZON] - state[i, TIME]
        if goal_conditioned:
            row[0], row[1], row[2], row[3] = x, y, cos, sin
            row[4], row[5] = goal_x, goal_y
            row[6] = 0.0 if free else math.cos(goal_heading)
            row[7] = 0.0 if free else math.sin(goal_heading)
            row[8] = time_left
            at = 2 * POSE_ENTRIES + 1
        else:
            dx, dy = goal_x - x, goal_y - y
            ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
            turn = 0.0 if free else (goal_heading - heading + math.pi) % (2 * math.pi) - math.pi
            time = max(time_left, settings[PERIOD])
            row[0], row[1] = ahead, left
            row[2] = 0.0 if free else math.cos(turn)
            row[3] = 0.0 if free else math.sin(turn)
            row[4] = time_left
            row[5], row[6] = ahead / time, left / time
            row[7] = math.sqrt(dx * dx + dy * dy) / time
            row[8] = turn / time
            at = GOAL_ENTRIES
        if motors:
            row[at] = cos * state[i, VX] + sin * state[i, VY]
            row[at + 1] = cos * state[i, VY] - sin * state[i, VX]
            row[at + 2] = state[i, SPIN]
            at += MOTION_ENTRIES
        if has_lidar and count > 0:
            for k in range(count):
                row[at + k] = scratch[2, k]
            if deviation != 0.0:
                for k in range(count):
                    row[at + k] += deviation * noise[i, noise_rows[i], FIRST_SENSED + 3 + k]
        elif has_map:
            survey(x, y, cos, sin, fields[i], int(settings[OBSTACLES]), int(settings[VERTICES]), surveyed)
            row[at:] = surveyed
        for k in range(len(row)):
            value = np.float32(row[k])
            value = bounds[0, k] if value < bounds[0, k] else value
            out[i, k] = bounds[1, k] if value > bounds[1, k] else value
