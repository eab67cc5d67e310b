"""What is observed: the parts of an observation, their spaces, and the kernel that fills them for many robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import float32, float64, int64, njit, types

from leapnav.envs.driving import SPIN, TIME, VX
from leapnav.envs.scenario import GOAL, HORIZON
from leapnav.envs.sensing import FASTEST, MOTION_ENTRIES, WALL_ENTRIES, observe, scan
from leapnav.envs.settings import Settings

# Bounds that no scenario of a sensible size reaches; values beyond are clipped.
FARTHEST, LONGEST = 1000.0, 10_000.0
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
        pose = (-FARTHEST, -FARTHEST, -1.0, -1.0), (FARTHEST, FARTHEST, 1.0, 1.0)
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
    robots, bodies, state, tasks, fields, noise, noise_rows, settings, beams, scratch, survey, row, bounds, out
):
    """`observe` for robots, given by number."""
    for i in robots:
        left = tasks[i, HORIZON] - state[i, TIME]
        drawn = noise[i, noise_rows[i], FIRST_SENSED:] if noise.shape[2] > 0 else noise[i, 0]
        observe(
            bodies[i, 0:3],
            state[i, VX : SPIN + 1],
            tasks[i, GOAL : GOAL + 3],
            left,
            fields[i],
            drawn,
            settings,
            beams,
            scratch,
            survey,
            row,
            bounds,
            out[i],
        )
