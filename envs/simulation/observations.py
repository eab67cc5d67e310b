"""Observations: their parts, the observation spaces, and the kernel that computes them for many robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numba import float32, types

from leapnav.envs.geodesics import MAX_DETOUR, geodesic_detours, geodesic_distance
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import FLAGS, INTEGERS, MATRIX, NOTHING, VECTOR
from leapnav.envs.scenarios.scenario import GOAL, HORIZON
from leapnav.envs.settings import (
    FREE_HORIZON,
    GOAL_CONDITIONED,
    LIDAR_RANGE,
    MOTORS,
    N_CONTROLS,
    OBSERVATION,
    OBSERVATIONS,
    OBSTACLES,
    PERIOD,
    SENSING_NOISE,
    VERTICES,
    EnvironmentSettings,
)
from leapnav.envs.shapes.field import header_of
from leapnav.envs.simulation.sensing import WALL_ENTRIES, map_surroundings, scan
from leapnav.envs.simulation.state import PACKED_STATE, SPIN, TIME, VX, VY, SimulationState, field_of
from leapnav.envs.utils.records import MAX_MAGNITUDE

# Number of entries of the parts, which are documented in `NavigateEnv`. If the horizon is free, the goal part has no
# time left and nothing that depends on it.
GOAL_ENTRIES, FREE_GOAL_ENTRIES, MOTION_ENTRIES, POSE_ENTRIES = 9, 4, 3, 4
TIME_LEFT = 4  # index in the goal part of a fixed horizon
# Bounds of the observation spaces (m, s, m/s or rad/s), which scenarios of realistic size do not reach.
MAX_DISTANCE, MAX_TIME, MAX_RATE = 1000.0, 10_000.0, 20.0
MAX_GEODESIC = 2000.0  # bound of the geodesic distance (m), by which the observation is recognised
LIDAR, MAP, GEODESIC = (OBSERVATIONS.index(name) for name in ("lidar", "map", "geodesic"))


@dataclass(frozen=True)
class Part:
    """A named part of the observation, with its bounds."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]


def _parts(settings: EnvironmentSettings) -> list[Part]:
    parts = []
    if settings.goal_conditioned:
        # Absolute positions must not be clipped, or distant poses would equal distant goals.
        pose = (-MAX_MAGNITUDE, -MAX_MAGNITUDE, -1.0, -1.0), (MAX_MAGNITUDE, MAX_MAGNITUDE, 1.0, 1.0)
        parts += [Part("achieved_goal", *pose), Part("desired_goal", *pose)]
        if not settings.free_horizon:
            parts.append(Part("time", (0.0,), (MAX_TIME,)))
    else:
        low = (-MAX_DISTANCE, -MAX_DISTANCE, -1.0, -1.0, 0.0, -MAX_RATE, -MAX_RATE, 0.0, -MAX_RATE)
        high = (MAX_DISTANCE, MAX_DISTANCE, 1.0, 1.0, MAX_TIME, *[MAX_RATE] * 4)
        count = goal_entries(settings)
        parts.append(Part("goal", low[:count], high[:count]))
    entries = motion_entries(settings)
    if entries:
        parts.append(Part("motion", (-MAX_RATE,) * entries, (MAX_RATE,) * entries))
    if settings.has_lidar:
        beams = settings.lidar_beams
        parts.append(Part("lidar", (0.0,) * beams, (settings.lidar_range,) * beams))
        if settings.observation == "geodesic":
            parts.append(Part("detours", (0.0,) * beams, (MAX_DETOUR,) * beams))
            parts.append(Part("distance", (0.0,), (MAX_GEODESIC,)))
    elif settings.observation == "map":
        low = (-MAX_DISTANCE,) * 4 + (-1.0, -1.0)
        parts.append(Part("walls", low, (MAX_DISTANCE,) * 4 + (1.0, 1.0)))
        vertices, count = 2 * settings.map_vertices, settings.map_obstacles
        low, high = (0.0, 0.0) + (-MAX_DISTANCE,) * vertices, (1.0, MAX_DISTANCE) + (MAX_DISTANCE,) * vertices
        parts.append(Part("obstacles", low * count, high * count))
    return [part for part in parts if part.low]


def goal_entries(settings: EnvironmentSettings) -> int:
    """Return the number of entries of the part `goal`."""
    return FREE_GOAL_ENTRIES if settings.free_horizon else GOAL_ENTRIES


def has_time_left(high: np.ndarray) -> bool:
    """Return whether flat observations with the upper bounds `high` contain the time left, at the index TIME_LEFT."""
    return len(high) >= GOAL_ENTRIES and tuple(high[TIME_LEFT : TIME_LEFT + 2].tolist()) == (MAX_TIME, MAX_RATE)


def has_geodesics(high: np.ndarray) -> bool:
    """Return whether flat observations with the upper bounds `high` end with detours and the geodesic distance."""
    return float(high[-1]) == MAX_GEODESIC


def motion_entries(settings: EnvironmentSettings) -> int:
    """Return the number of entries of the part `motion`."""
    return MOTION_ENTRIES if settings.motors else settings.model.sizes()[0] - 3


class ObservationBuffers(NamedTuple):
    """Constants and working memory of `observe_robots`.

    Attributes:
        beams (2, n), scratch (3, 2 n): see `leapnav.envs.simulation.sensing.scan`.
        detours (n,): output of `leapnav.envs.geodesics.geodesic_detours`.
        surroundings: output of `leapnav.envs.simulation.sensing.map_surroundings`; empty without a map.
        row (size,): an observation before it is rounded to float32.
        bounds (2, size): lower and upper bounds, float32.
        is_heading (n - 3,): which further states of the robot are headings, bool.

    """

    beams: np.ndarray
    scratch: np.ndarray
    detours: np.ndarray
    surroundings: np.ndarray
    row: np.ndarray
    bounds: np.ndarray
    is_heading: np.ndarray


OBSERVATION_BUFFERS = record_type(
    ObservationBuffers,
    beams=MATRIX,
    scratch=MATRIX,
    detours=VECTOR,
    surroundings=VECTOR,
    row=VECTOR,
    bounds=float32[:, ::1],
    is_heading=FLAGS,
)
PACKED_BUFFERS = types.Tuple(OBSERVATION_BUFFERS.types)


class ObservationLayout:
    """The observation space for given settings, and the division of flat observations into parts.

    Args:
        settings: settings of the environment.

    Attributes:
        space: observation space of one robot.
        size: number of entries of a flat observation.
        bounds (2, size): lower and upper bounds, float32.

    """

    def __init__(self, settings: EnvironmentSettings) -> None:
        self._settings = settings
        parts = _parts(settings)
        self.bounds = np.array(
            [[v for part in parts for v in part.low], [v for part in parts for v in part.high]], dtype=np.float32
        )
        self.size = self.bounds.shape[1]
        angles = 2 * math.pi * np.arange(settings.lidar_beams) / max(settings.lidar_beams, 1)
        map_entries = WALL_ENTRIES + settings.map_obstacles * (2 + 2 * settings.map_vertices)
        self._buffers = ObservationBuffers(
            beams=np.stack([np.cos(angles), np.sin(angles)]),
            scratch=np.zeros((3, 2 * settings.lidar_beams)),
            detours=np.zeros(settings.lidar_beams),
            surroundings=np.zeros(map_entries if settings.observation == "map" else 0),
            row=np.zeros(self.size),
            bounds=self.bounds,
            is_heading=np.array(
                [name in settings.model.heading_states for name in settings.model.state_names[3:]], dtype=bool
            ),
        )
        self._packed_buffers = tuple(self._buffers)
        ends = np.cumsum([len(part.low) for part in parts]).tolist()
        slices = {part.name: slice(end - len(part.low), end) for part, end in zip(parts, ends, strict=True)}
        self._slices: dict[str, slice] | None = None
        if settings.goal_conditioned:  # the other parts form one box, as goal-conditioned learners expect
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
        """Return flat observations (..., size) in the structure of the space."""
        if self._slices is None:
            return flat
        return {name: np.ascontiguousarray(flat[..., part]) for name, part in self._slices.items()}

    def scan(self, pose: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return the lidar ranges (m) at a pose; empty without a lidar."""
        if not self._settings.has_lidar:
            return np.empty(0)
        x, y, heading = pose[:3].tolist()
        buffers = self._buffers
        cos, sin = math.cos(heading), math.sin(heading)
        scan(x, y, cos, sin, field, self._settings.lidar_range, buffers.beams, buffers.scratch)
        return buffers.scratch[2, : self._settings.lidar_beams].copy()

    def fill(self, robots: np.ndarray, sim: tuple[np.ndarray, ...], out: np.ndarray) -> None:
        """Write the flat observations of robots, given by index, to their rows of `out`."""
        observe_robots(robots, sim, self._packed_buffers, out)


@kernel(NOTHING(INTEGERS, PACKED_STATE, PACKED_BUFFERS, float32[:, ::1]))
def observe_robots(robots, packed, packed_buffers, out):
    """Compute the flat observations of robots, see `NavigateEnv` and `NavigateGoalEnv`.

    Args:
        robots: indices of the robots.
        packed: the episodes. The noise is used only if the settings have sensing noise.
        packed_buffers: see `ObservationBuffers`.
        out (count, size): the rows of the robots are overwritten; float32.

    """
    sim, buffers = SimulationState(*packed), ObservationBuffers(*packed_buffers)
    bodies, state, tasks, settings, noise = sim.bodies, sim.state, sim.tasks, sim.settings, sim.noise
    beams, scratch, surroundings = buffers.beams, buffers.scratch, buffers.surroundings
    row, bounds = buffers.row, buffers.bounds
    deviation = settings[SENSING_NOISE]
    goal_conditioned, motors = settings[GOAL_CONDITIONED] != 0.0, settings[MOTORS] != 0.0
    free_horizon = settings[FREE_HORIZON] != 0.0
    has_map, has_geodesics = settings[OBSERVATION] == MAP, settings[OBSERVATION] == GEODESIC
    has_lidar = settings[OBSERVATION] == LIDAR or has_geodesics
    count = beams.shape[1]
    sensing = 2 * int(settings[N_CONTROLS])  # first column of the sensing noise, after that of the actuation
    for i in robots:
        x, y, heading = bodies[i, 0], bodies[i, 1], bodies[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        if has_lidar and count > 0:  # from the true pose, not from the sensed one
            scan(x, y, cos, sin, field_of(sim.fields, i), settings[LIDAR_RANGE], beams, scratch)
        # Achieved goals are observed without noise, because they determine the reward.
        if deviation != 0.0 and not goal_conditioned:
            drawn = sim.noise_rows[i]
            x += deviation * noise[i, drawn, sensing]
            y += deviation * noise[i, drawn, sensing + 1]
            heading += deviation * noise[i, drawn, sensing + 2]
            cos, sin = math.cos(heading), math.sin(heading)
        goal_x, goal_y, goal_heading = tasks[i, GOAL], tasks[i, GOAL + 1], tasks[i, GOAL + 2]
        free = math.isnan(goal_heading)
        time_left = tasks[i, HORIZON] - state[i, TIME]
        if goal_conditioned:
            row[0], row[1], row[2], row[3] = x, y, cos, sin
            row[4], row[5] = goal_x, goal_y
            row[6] = 0.0 if free else math.cos(goal_heading)
            row[7] = 0.0 if free else math.sin(goal_heading)
            at = 2 * POSE_ENTRIES
            if not free_horizon:
                row[at] = time_left
                at += 1
        else:
            dx, dy = goal_x - x, goal_y - y
            ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
            turn = 0.0 if free else (goal_heading - heading + math.pi) % (2 * math.pi) - math.pi
            row[0], row[1] = ahead, left
            row[2] = 0.0 if free else math.cos(turn)
            row[3] = 0.0 if free else math.sin(turn)
            at = FREE_GOAL_ENTRIES
            if not free_horizon:
                time = max(time_left, settings[PERIOD])
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
        for k in range(len(buffers.is_heading)):
            value = sim.robots[i, k]
            if buffers.is_heading[k]:
                value = (value - heading + math.pi) % (2 * math.pi) - math.pi
            row[at] = value
            at += 1
        if has_lidar and count > 0:
            for k in range(count):
                row[at + k] = scratch[2, k]
            if deviation != 0.0:
                for k in range(count):
                    row[at + k] += deviation * noise[i, sim.noise_rows[i], sensing + 3 + k]
            at += count
        if has_geodesics:
            geodesic_detours(
                x,
                y,
                heading,
                sim.maps[i],
                header_of(field_of(sim.fields, i)).radius,
                beams,
                scratch[2],
                buffers.detours,
            )
            for k in range(count):
                row[at + k] = buffers.detours[k]
            row[at + count] = geodesic_distance(x, y, sim.maps[i])
        elif has_map:
            obstacles, vertices = int(settings[OBSTACLES]), int(settings[VERTICES])
            map_surroundings(x, y, cos, sin, field_of(sim.fields, i), obstacles, vertices, surroundings)
            for k in range(len(surroundings)):
                row[at + k] = surroundings[k]
        for k in range(len(row)):
            value = np.float32(row[k])
            value = bounds[0, k] if value < bounds[0, k] else value
            out[i, k] = bounds[1, k] if value > bounds[1, k] else value
