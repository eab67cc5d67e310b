"""Observations: their parts and entries, the observation spaces, and the kernel that computes them for many robots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numba import float32, from_dtype

from leapnav.envs.field.layout import header_of
from leapnav.envs.geodesics import MAX_DETOUR, geodesic_detours, geodesic_distance
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import places_of, record_at, writable
from leapnav.envs.kernels.types import FLAGS, INTEGERS, MATRIX, NOTHING, PLACES, VECTOR
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.sensing import beam_velocities, map_surroundings, scan
from leapnav.envs.simulation.state import SIMULATION, field_of, row_of
from leapnav.envs.simulation.stepping import wrapped
from leapnav.envs.utils.records import MAX_MAGNITUDE

# Bounds of the observation spaces (m, s, m/s or rad/s), which scenarios of realistic size do not reach.
MAX_DISTANCE, MAX_TIME, MAX_RATE, MAX_GEODESIC = 1000.0, 10_000.0, 20.0, 2000.0


@dataclass(frozen=True)
class Entry:
    """One number of an observation or an action.

    Attributes:
        name: part and meaning, such as "goal.ahead".
        unit: unit, "1" for a number without one.
        low, high: bounds; values outside are clipped.

    """

    name: str
    unit: str
    low: float
    high: float


_DISTANCE, _COSINE, _RATE = ("m", -MAX_DISTANCE, MAX_DISTANCE), ("1", -1.0, 1.0), (-MAX_RATE, MAX_RATE)
_POSE = (("m", -MAX_MAGNITUDE, MAX_MAGNITUDE),) * 2 + (_COSINE,) * 2
_GOAL = (
    Entry("goal.ahead", *_DISTANCE),
    Entry("goal.left", *_DISTANCE),
    Entry("goal.cos_heading_error", *_COSINE),
    Entry("goal.sin_heading_error", *_COSINE),
)
# With a fixed horizon, the part `goal` also contains the time left and what depends on it.
_TIMED_GOAL = (
    *_GOAL,
    Entry("goal.time_left", "s", 0.0, MAX_TIME),
    Entry("goal.needed_speed_ahead", "m/s", *_RATE),
    Entry("goal.needed_speed_left", "m/s", *_RATE),
    Entry("goal.needed_speed", "m/s", 0.0, MAX_RATE),
    Entry("goal.needed_turn_rate", "rad/s", *_RATE),
)
_MOTION = (("speed_ahead", "m/s"), ("speed_left", "m/s"), ("turn_rate", "rad/s"))
GOAL_ENTRIES, FREE_GOAL_ENTRIES, MOTION_ENTRIES = len(_TIMED_GOAL), len(_GOAL), len(_MOTION)
TIME_LEFT = len(_GOAL)  # index in the goal part of a fixed horizon


def _parts(settings: EnvironmentSettings) -> Iterator[tuple[str, list[Entry]]]:
    """Yield the names and entries of the parts of an observation, which `NavigateEnv` documents, in order."""
    if settings.goal_conditioned:
        # Absolute positions must not be clipped, or distant poses would equal distant goals.
        for part in ("achieved_goal", "desired_goal"):
            names = ("x", "y", "cos_heading", "sin_heading")
            yield part, [Entry(f"{part}.{name}", *kind) for name, kind in zip(names, _POSE, strict=True)]
        if not settings.free_horizon:
            yield "time", [Entry("time.time_left", "s", 0.0, MAX_TIME)]
    else:
        yield "goal", list(_GOAL if settings.free_horizon else _TIMED_GOAL)
    model = settings.model
    motion = _MOTION if settings.motors else tuple(zip(model.state_names[3:], model.state_units[3:], strict=True))
    yield "motion", [Entry(f"motion.{name}", unit, *_RATE) for name, unit in motion]
    if settings.previous_action:
        yield "action", [Entry(f"action[{k}]", *_COSINE) for k in range(model.sizes()[1])]
    beams = settings.lidar_beams
    angles = [f"{math.degrees(angle):g} deg counter-clockwise from ahead" for angle in settings.beam_angles]
    if settings.has_lidar:
        yield "lidar", [Entry(f"lidar[{k}], {at}", "m", 0.0, settings.lidar_range) for k, at in enumerate(angles)]
    if settings.observation == "geodesic":
        yield "detours", [Entry(f"detours[{k}], {at}", "m", 0.0, MAX_DETOUR) for k, at in enumerate(angles)]
        yield "distance", [Entry("distance", "m", 0.0, MAX_GEODESIC)]
        if settings.velocities:
            sides = ("ahead", "left")
            yield (
                "velocities",
                [Entry(f"velocities.{side}[{k}]", "m/s", *_RATE) for side in sides for k in range(beams)],
            )
    elif settings.observation == "map":
        sides = [Entry(f"walls.{side}", *_DISTANCE) for side in ("left", "bottom", "right", "top")]
        yield "walls", [*sides, Entry("walls.cos_heading", *_COSINE), Entry("walls.sin_heading", *_COSINE)]
        obstacles = []
        for k in range(settings.map_obstacles):
            obstacles.append(Entry(f"obstacles[{k}].exists", "1", 0.0, 1.0))
            obstacles.append(Entry(f"obstacles[{k}].radius", "m", 0.0, MAX_DISTANCE))
            for vertex in range(settings.map_vertices):
                name = f"obstacles[{k}].vertices[{vertex}]"
                obstacles += [Entry(f"{name}.{side}", *_DISTANCE) for side in ("ahead", "left")]
        yield "obstacles", obstacles
        if settings.velocities:
            names = [f"velocities[{k}].{side}" for k in range(settings.map_obstacles) for side in ("ahead", "left")]
            yield "velocities", [Entry(name, "m/s", *_RATE) for name in names]


def observation_entries(settings: EnvironmentSettings) -> list[Entry]:
    """Return the entries of a flat observation of `NavigateEnv`, in order.

    Raises:
        ValueError: the observations of these settings are dictionaries.

    """
    if settings.dict_observation or settings.goal_conditioned:
        raise ValueError("environment: expected flat observations, got dict_observation or a goal-conditioned one")
    current = [entry for _, entries in _parts(settings) for entry in entries]
    earlier = [replace(one, name=f"{one.name}, {age:g} s before") for age in settings.history for one in current]
    return current + earlier


def parts_of(space: spaces.Box) -> dict[str, slice]:
    """Return the parts of the current observation in a space of `NavigateEnv` with a lidar.

    With a history, earlier observations with the same parts follow, each of `frame_size(space)` entries.
    Stable-Baselines3 passes nothing but the space to a features extractor, so the bounds are compared with those of the
    entries of each part.

    Raises:
        ValueError: the space contains other parts, such as a map.

    """
    bounds = _bounds_of(space)[: frame_size(space)]
    end = GOAL_ENTRIES if bounds[TIME_LEFT:GOAL_ENTRIES] == _bounds(_TIMED_GOAL[TIME_LEFT:]) else FREE_GOAL_ENTRIES
    parts = {"goal": slice(0, end)}
    first = end
    while end < len(bounds) and bounds[end] == _RATE:
        end += 1
    parts["motion"], first = slice(first, end), end
    while end < len(bounds) and bounds[end] == (-1.0, 1.0):
        end += 1
    if end > first:
        parts["action"] = slice(first, end)
    last = len(bounds)
    while last > end and bounds[last - 1] == _RATE:
        last -= 1
    if last < len(bounds):
        parts["velocities"], bounds = slice(last, len(bounds)), bounds[:last]
    beams = len(bounds) - end
    if bounds[-1:] == [(0.0, MAX_GEODESIC)]:
        middle = end + beams // 2
        parts["detours"], parts["distance"] = slice(middle, len(bounds) - 1), slice(len(bounds) - 1, len(bounds))
        beams //= 2
    if any(low < 0.0 for low, _ in bounds[end:]):
        raise ValueError("observation_space: expected goal, motion, lidar and detours, got other parts, such as a map")
    return {**parts, "lidar": slice(end, end + beams)}


def frame_size(space: spaces.Box) -> int:
    """Return the number of entries of the current observation in a flat space, the smallest period of its bounds."""
    bounds = _bounds_of(space)
    count = len(bounds)
    return next(n for n in range(1, count + 1) if count % n == 0 and bounds == bounds[:n] * (count // n))


def _bounds_of(space: spaces.Box) -> list[tuple[float, float]]:
    return list(zip(space.low.tolist(), space.high.tolist(), strict=True))


def _bounds(entries: Sequence[Entry]) -> list[tuple[float, float]]:
    return [(entry.low, entry.high) for entry in entries]


# Index of the first entry of each part of an observation, -1 for a part that it does not have.
OFFSETS = np.dtype(
    [
        (name, "i8")
        for name in (
            *("achieved_goal", "desired_goal", "time", "goal", "motion", "action"),
            *("lidar", "detours", "distance", "walls", "obstacles", "velocities"),
        )
    ]
)


class ObservationBuffers(NamedTuple):
    """Constants and working memory of `observe_robots`.

    Attributes:
        offsets (1,): record of OFFSETS.
        beams (2, n), scratch (3, 2 n): see `leapnav.envs.simulation.sensing.scan`.
        detours (n,): output of `leapnav.envs.geodesics.geodesic_detours`.
        row (d,): the current observation before it is rounded to float32.
        bounds (2, d): lower and upper bounds, float32.
        is_heading (n - 3,): which further states of the robot are headings, bool.
        actions (count, m): the last action of each robot, 0 at the start of an episode.
        frames (count, K, d): the last K observations of each robot, that of step k in row k % K, float32.
        lags (h,): the control periods between the observations of the history and the current one.

    """

    offsets: np.ndarray
    beams: np.ndarray
    scratch: np.ndarray
    detours: np.ndarray
    row: np.ndarray
    bounds: np.ndarray
    is_heading: np.ndarray
    actions: np.ndarray
    frames: np.ndarray
    lags: np.ndarray


BUFFERS = record_type(
    ObservationBuffers,
    offsets=from_dtype(OFFSETS)[::1],
    beams=MATRIX,
    scratch=MATRIX,
    detours=VECTOR,
    row=VECTOR,
    bounds=float32[:, ::1],
    is_heading=FLAGS,
    actions=MATRIX,
    frames=float32[:, :, ::1],
    lags=INTEGERS,
)


class ObservationLayout:
    """The observation space for given settings, and the division of flat observations into parts.

    Args:
        settings: settings of the environment.
        count: number of robots that are observed.

    Attributes:
        space: observation space of one robot.
        size: number of entries of a flat observation.
        frame: number of entries of the current observation, which those of the history follow.
        parts: the entries of each part of the current observation.
        actions (count, m): the last action of each robot.

    """

    def __init__(self, settings: EnvironmentSettings, count: int = 0) -> None:
        self._settings = settings
        self.parts: dict[str, slice] = {}
        entries: list[Entry] = []
        for name, added in _parts(settings):
            if added:
                self.parts[name] = slice(len(entries), len(entries) + len(added))
                entries += added
        self.frame, lags = len(entries), np.array(settings.lags, dtype=np.int64)
        self.size = self.frame * (1 + len(lags))
        self.actions = np.zeros((count, settings.model.sizes()[1]))
        self._bounds = np.array([[one.low for one in entries], [one.high for one in entries]], np.float32)
        angles = settings.beam_angles
        further = settings.model.state_names[3:]
        offsets = [self.parts[name].start if name in self.parts else -1 for name in OFFSETS.names or ()]
        self._buffers = ObservationBuffers(
            offsets=np.array([tuple(offsets)], OFFSETS),
            beams=np.stack([np.cos(angles), np.sin(angles)]),
            scratch=np.zeros((3, 2 * settings.lidar_beams)),
            detours=np.zeros(settings.lidar_beams),
            row=np.zeros(self.frame),
            bounds=self._bounds,
            is_heading=np.array([name in settings.model.heading_states for name in further], dtype=bool),
            actions=self.actions,
            frames=np.zeros((count, 1 + lags.max(initial=-1), self.frame), np.float32),
            lags=lags,
        )
        self._places = places_of(self._buffers, BUFFERS)
        self._slices: dict[str, slice] | None = self.parts if settings.dict_observation else None
        if settings.goal_conditioned:  # the other parts form one box, as goal-conditioned learners expect
            goals = {name: self.parts[name] for name in ("achieved_goal", "desired_goal")}
            self._slices = {"observation": slice(goals["desired_goal"].stop, self.size), **goals}
        self.space: spaces.Space[Any] = self._space()

    def _space(self) -> spaces.Space[Any]:
        if self._slices is None:
            low, high = np.tile(self._bounds, 1 + len(self._settings.history))
            return spaces.Box(low, high, dtype=np.float32)
        low, high = self._bounds
        boxes: dict[str, spaces.Space[Any]] = {}
        for name, part in self._slices.items():
            boxes[name] = spaces.Box(low[part], high[part], dtype=np.float32)
        return spaces.Dict(boxes)

    def divide(self, flat: np.ndarray) -> Any:
        """Return flat observations (..., size) in the structure of the space."""
        if self._slices is None:
            return flat
        return {name: np.ascontiguousarray(flat[..., part]) for name, part in self._slices.items()}

    def scan(self, pose: np.ndarray, time: float, field: np.ndarray) -> np.ndarray:
        """Return the lidar ranges (m) at a pose; empty without a lidar."""
        if not self._settings.has_lidar:
            return np.empty(0)
        x, y, heading = pose[:3].tolist()
        buffers = self._buffers
        view = self._settings.lidar_range, self._settings.lidar_fov
        scan(x, y, heading, time, field, view, buffers.beams, buffers.scratch)
        return buffers.scratch[2, : self._settings.lidar_beams].copy()

    def fill(self, robots: np.ndarray, places: np.ndarray, out: np.ndarray) -> None:
        """Write the flat observations of robots, given by index, to their rows of `out`, see `observe_robots`."""
        observe_robots(robots, places, self._places, out)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._buffers = writable(self._buffers)
        self.actions, self._places = self._buffers.actions, places_of(self._buffers, BUFFERS)


@kernel(NOTHING(INTEGERS, PLACES, PLACES, float32[:, ::1]))
def observe_robots(robots, places, buffer_places, out):
    """Compute the flat observations of robots, see `NavigateEnv` and `NavigateGoalEnv`.

    Args:
        robots: indices of the robots.
        places: of the episodes, see `places_of`. The noise is used only if the settings have sensing noise.
        buffer_places: of the `ObservationBuffers`.
        out (count, size): the rows of the robots are overwritten; float32. A robot with a history must be observed at
            each step of its episode.

    """
    sim, buffers = record_at(places, SIMULATION), record_at(buffer_places, BUFFERS)
    settings, at = sim.settings[0], buffers.offsets[0]
    beams, scratch, row, bounds = buffers.beams, buffers.scratch, buffers.row, buffers.bounds
    deviation, n_beams = settings.disturbance.sensing, beams.shape[1]
    sensing = 2 * sim.controls.shape[1]  # first column of the sensing noise, after that of the actuation
    for i in robots:
        episode, state, field = sim.episodes[i], row_of(sim.states, i), field_of(sim.fields, i)
        x, y, heading = state[0], state[1], state[2]
        cos, sin = math.cos(heading), math.sin(heading)
        noise = sim.noise[i, episode.steps % sim.noise.shape[1]]
        if at.lidar >= 0:  # from the true pose, not from the sensed one
            view = settings.lidar_range, settings.lidar_fov
            scan(x, y, heading, episode.time, field, view, beams, scratch)
        # Achieved goals are observed without noise, because they determine the reward.
        if deviation != 0.0 and not settings.goal_conditioned:
            x += deviation * noise[sensing]
            y += deviation * noise[sensing + 1]
            heading += deviation * noise[sensing + 2]
            cos, sin = math.cos(heading), math.sin(heading)
        goal_x, goal_y, goal_heading = sim.goals[i, 0], sim.goals[i, 1], sim.goals[i, 2]
        free = math.isnan(goal_heading)
        time_left = episode.horizon - episode.time
        if at.achieved_goal >= 0:
            pose, goal = row[at.achieved_goal :], row[at.desired_goal :]
            pose[0], pose[1], pose[2], pose[3] = x, y, cos, sin
            goal[0], goal[1] = goal_x, goal_y
            goal[2] = 0.0 if free else math.cos(goal_heading)
            goal[3] = 0.0 if free else math.sin(goal_heading)
        if at.time >= 0:
            row[at.time] = time_left
        if at.goal >= 0:
            goal, dx, dy = row[at.goal :], goal_x - x, goal_y - y
            ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
            turn = 0.0 if free else wrapped(goal_heading - heading)
            goal[0], goal[1] = ahead, left
            goal[2] = 0.0 if free else math.cos(turn)
            goal[3] = 0.0 if free else math.sin(turn)
            if not settings.free_horizon:
                time = max(time_left, settings.control_period)
                goal[TIME_LEFT] = time_left
                goal[TIME_LEFT + 1], goal[TIME_LEFT + 2] = ahead / time, left / time
                goal[TIME_LEFT + 3] = math.sqrt(dx * dx + dy * dy) / time
                goal[TIME_LEFT + 4] = turn / time
        if settings.motors:
            row[at.motion] = cos * episode.vx + sin * episode.vy
            row[at.motion + 1] = cos * episode.vy - sin * episode.vx
            row[at.motion + 2] = episode.spin
        for k in range(len(buffers.is_heading)):
            row[at.motion + k] = wrapped(state[3 + k] - heading) if buffers.is_heading[k] else state[3 + k]
        if at.action >= 0:
            for k in range(buffers.actions.shape[1]):
                row[at.action + k] = buffers.actions[i, k]
        if at.lidar >= 0:
            for k in range(n_beams):
                row[at.lidar + k] = scratch[2, k]
                if deviation != 0.0:
                    row[at.lidar + k] += deviation * noise[sensing + 3 + k]
        if at.distance >= 0:
            detours, radius = buffers.detours, header_of(field).radius
            geodesic_detours(x, y, heading, sim.maps[i], radius, beams, scratch[2], detours)
            for k in range(n_beams):
                row[at.detours + k] = detours[k]
            row[at.distance] = geodesic_distance(x, y, sim.maps[i])
        if at.walls >= 0:
            surroundings = row[at.walls :]
            obstacles, vertices = settings.map_obstacles, settings.map_vertices
            map_surroundings(x, y, heading, episode.time, field, obstacles, vertices, surroundings)
        elif at.velocities >= 0:
            seen = row[at.velocities :]
            beam_velocities(sim.states[i], episode.time, field, settings.lidar_fov, beams, scratch, seen)
        for k in range(len(row)):
            value = np.float32(row[k])
            value = bounds[0, k] if value < bounds[0, k] else value
            out[i, k] = bounds[1, k] if value > bounds[1, k] else value
        size, lags, frames = len(row), buffers.lags, buffers.frames
        for k in range(size if len(lags) > 0 else 0):
            frames[i, episode.steps % frames.shape[1], k] = out[i, k]
            for h in range(len(lags)):
                out[i, (h + 1) * size + k] = frames[i, max(episode.steps - lags[h], 0) % frames.shape[1], k]
