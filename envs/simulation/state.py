"""The episodes of many robots as arrays with named fields, and the record that the kernels take."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numba import float32, from_dtype, int64

from leapnav.envs.field.packing import pack_field
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import part_of, vector_at
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, PLACES, VECTOR
from leapnav.envs.settings import SETTINGS

N_GUIDE_POINTS = 17  # points along the reference path, for the potential


class Episode(NamedTuple):
    """The episode of one robot.

    Attributes:
        steps, last_step: control periods completed, and in the episode.
        time, horizon: time since the start, and at the end of the episode (s).
        time_weight: cost per second, if the horizon is free.
        speed_weight, turn_weight: weights of squared speed and turn rate in the potential of the shaped reward.
        potential: of the current state, for the shaped reward.
        cost: J so far.
        duration, remaining: of the period, and of its part after the first contact (s).
        vx, vy, spin: velocity (m/s, m/s, rad/s) of a robot with motors.
        pose_clearance, clearance: of the pose, and the smallest one during the period (m).
        goal_distance, heading_error: of the pose from the goal (m, rad); the error of a free heading is 0.
        effort, proximity, time_cost, collision, miss: parts of the reward of the period, as costs.
        shaping: part of the reward of the period.
        reward: the reward of the period.
        collided, in_contact: whether there was a contact in the episode, and in the period.
        success, terminated, truncated: see `NavigateEnv`.

    """

    steps: int
    last_step: int
    time: float
    horizon: float
    time_weight: float
    speed_weight: float
    turn_weight: float
    potential: float
    cost: float
    duration: float
    remaining: float
    vx: float
    vy: float
    spin: float
    pose_clearance: float
    clearance: float
    goal_distance: float
    heading_error: float
    effort: float
    proximity: float
    time_cost: float
    collision: float
    miss: float
    shaping: float
    reward: float
    collided: bool
    in_contact: bool
    success: bool
    terminated: bool
    truncated: bool


EPISODE = np.dtype(list(get_type_hints(Episode).items()), align=True)
# Reads a record in less time than NumPy.
EPISODE_FORMAT = struct.Struct("".join(EPISODE[name].char for name in Episode._fields))
EPISODES = from_dtype(EPISODE)[::1]


def guide_points(goal: np.ndarray, reference: np.ndarray | None) -> np.ndarray:
    """Return the guide points of a reference path (K, >= 2), see `Simulation`; without one, only the goal."""
    guides = np.zeros((N_GUIDE_POINTS, 3))
    guides[:, :2] = goal
    if reference is not None:
        path = reference[:, :2].astype(float)
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        selected = np.linspace(0, len(path) - 1, N_GUIDE_POINTS).round().astype(int)
        guides[:, :2], guides[:, 2] = path[selected], length[-1] - length[selected]
    return guides


class FieldStore:
    """The packed obstacle field of each robot; robots with the same scenario share one array.

    Attributes:
        places (count, 2): address and length of each field, int64, see `field_of`.

    """

    def __init__(self, count: int) -> None:
        self._set([pack_field((), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), 0.0, 1.0)] * count)

    def _set(self, fields: list[np.ndarray]) -> None:
        self._fields = fields
        self.places = np.zeros((len(fields), 2), np.int64)
        for i, field in enumerate(fields):
            self[i] = field

    def __getitem__(self, i: int) -> np.ndarray:
        return self._fields[i]

    def __setitem__(self, i: int, field: np.ndarray) -> None:
        assert field.dtype == np.float64 and field.flags.c_contiguous  # as kernels read it
        field.flags.writeable = False  # arrays are writable after unpickling
        self._fields[i] = field  # keeps the memory at the address
        self.places[i] = field.ctypes.data, len(field)

    def __getstate__(self) -> list[np.ndarray]:
        return self._fields

    def __setstate__(self, fields: list[np.ndarray]) -> None:
        self._set(fields)


@kernel(CONSTANT(PLACES, int64))
def field_of(places, i):
    """Return the packed obstacle field of robot i, see `FieldStore`."""
    return vector_at(places[i, 0], places[i, 1])


@kernel(VECTOR(MATRIX, int64))
def row_of(matrix, i):
    """Return row i of a matrix, a view."""
    return part_of(matrix, i * matrix.shape[1], matrix.shape[1])


class Simulation(NamedTuple):
    """The episodes of `count` robots with n states and m controls.

    Attributes:
        episodes (count,): records of `Episode`.
        states (count, n): x, y (m), heading (rad, unwrapped) and further states of the robots.
        controls (count, m): of the period, with actuation noise.
        goals (count, n): NaN for a state that is free at the goal.
        middles, halves (count, m): middles and half widths of the intervals of the controls.
        weights (count, m): weights of the squared controls.
        parameters (count, p): parameters of the robots' model.
        outlines (count, K, 5): footprints, see `leapnav.envs.robots.footprints.outline_of`; unused rows are zero.
        fields (count, 2): the places of the packed obstacle fields, see `field_of`.
        guides (count, N_GUIDE_POINTS, 3): points (m) of the reference path, and the path length (m) from
            each to the goal.
        noise (count, rows, columns): standard normal numbers; each period uses the next row.
        maps (count, M): packed geodesic maps, see `leapnav.envs.geodesics`, float32; empty unless they are observed.
        settings (1,): record of `leapnav.envs.settings.SETTINGS`.

    """

    episodes: Any
    states: np.ndarray
    controls: np.ndarray
    goals: np.ndarray
    middles: np.ndarray
    halves: np.ndarray
    weights: np.ndarray
    parameters: np.ndarray
    outlines: np.ndarray
    fields: np.ndarray
    guides: np.ndarray
    noise: np.ndarray
    maps: np.ndarray
    settings: Any


SIMULATION = record_type(
    Simulation,
    episodes=EPISODES,
    states=MATRIX,
    controls=MATRIX,
    goals=MATRIX,
    middles=MATRIX,
    halves=MATRIX,
    weights=MATRIX,
    parameters=MATRIX,
    outlines=CUBE,
    fields=PLACES,
    guides=CUBE,
    noise=CUBE,
    maps=float32[:, ::1],
    settings=from_dtype(SETTINGS)[::1],
)
