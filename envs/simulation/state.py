"""The episodes of many robots as arrays: the columns of the state, and the record that the kernels take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float32, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import vector_at
from leapnav.envs.kernels.types import CONSTANT, CUBE, INTEGERS, MATRIX, VECTOR
from leapnav.envs.shapes.field import pack_field

# Columns of the state.
(
    STEPS,  # control periods completed
    LAST_STEP,  # control periods in the episode
    TIME,  # s
    COST,  # J so far
    POSE_CLEARANCE,  # clearance of the pose, m
    CLEARANCE,  # smallest clearance during the period, m
    COLLIDED,  # whether there was a contact in the episode
    IN_CONTACT,  # whether there was a contact in the period
    REMAINING,  # time of the period after the first contact, s
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    SPEED,  # commanded speed (m/s) and turn rate (rad/s) of a robot that follows arcs, with actuation noise
    TURN_RATE,
    DURATION,  # of the period, s
    VX,  # velocity (m/s, m/s, rad/s) of a robot with motors
    VY,
    SPIN,
    EFFORT,  # parts of the reward of the period, as costs
    PROXIMITY,
    TIME_COST,
    COLLISION,
    MISS,
    SHAPING,
    REWARD,
    POTENTIAL,  # of the current state, for the shaped reward
    TIME_WEIGHT,  # cost per second, if the horizon is free
    COLUMNS,
) = range(28)

# What the infos contain: numbers, flags, and the parts of the reward (as costs).
INFOS = {"cost": COST, "clearance": CLEARANCE, "time": TIME}
FLAGS = {"collision": COLLIDED, "is_success": SUCCESS}
PARTS = {"effort": EFFORT, "proximity": PROXIMITY, "collision": COLLISION, "miss": MISS}
_TIMED_PARTS = {**PARTS, "time": TIME_COST}

N_GUIDE_POINTS = 17  # points along the reference path, for the potential


def guide_points(goal: np.ndarray, reference: np.ndarray | None) -> np.ndarray:
    """Return the guide points of a reference path (K, >= 2), see `SimulationState`; without one, only the goal."""
    guides = np.zeros((N_GUIDE_POINTS, 3))
    guides[:, :2] = goal
    if reference is not None:
        path = reference[:, :2].astype(float)
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        selected = np.linspace(0, len(path) - 1, N_GUIDE_POINTS).round().astype(int)
        guides[:, :2], guides[:, 2] = path[selected], length[-1] - length[selected]
    return guides


def parts(free_horizon: bool) -> dict[str, int]:
    """Return the columns of the parts of the reward."""
    return _TIMED_PARTS if free_horizon else PARTS


class SharedFields:
    """The packed obstacle field of each robot; robots with the same scenario share one array.

    Attributes:
        places (count, 2): address and length of each field, int64, see `field_of`.

    """

    def __init__(self, count: int) -> None:
        self._set([pack_field((), (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 1.0)] * count)

    def _set(self, fields: list[np.ndarray]) -> None:
        self._fields = fields
        self.places = np.zeros((len(fields), 2), np.int64)
        for i, field in enumerate(fields):
            self[i] = field

    def __getitem__(self, i: int) -> np.ndarray:
        return self._fields[i]

    def __setitem__(self, i: int, field: np.ndarray) -> None:
        assert field.dtype == np.float64 and field.flags.c_contiguous  # as kernels read it
        self._fields[i] = field  # keeps the memory at the address
        self.places[i] = field.ctypes.data, len(field)

    def __getstate__(self) -> list[np.ndarray]:
        return self._fields

    def __setstate__(self, fields: list[np.ndarray]) -> None:
        self._set(fields)


PLACES = int64[:, ::1]


@kernel(CONSTANT(PLACES, int64))
def field_of(places, i):
    """Return the packed obstacle field of robot i, see `SharedFields`."""
    return vector_at(places[i, 0], places[i, 1])


class SimulationState(NamedTuple):
    """The episodes of `count` robots.

    Attributes:
        bodies (count, 6 or 9): see `FreeBodies`.
        robots (count, n - 3 + m + 3 + 2 D): further states of the robot; controls of the period, with actuation noise;
            weights of squared speed and turn rate in the potential; the time weight; footprint of at most D discs, each
            with its offset along the heading and its radius (m), which is not positive if the disc is unused.
        state (count, COLUMNS): see the constants of this module.
        tasks (count, K): see `leapnav.envs.scenarios.scenario`.
        fields (count, 2): the places of the packed obstacle fields, see `field_of`.
        guides (count, N_GUIDE_POINTS, 3): points (m) of the reference path, and the path length (m) from
            each to the goal.
        noise (count, rows, columns): standard normal numbers.
        noise_rows (count,): the row of `noise` that each robot uses.
        maps (count, M): packed geodesic maps, see `leapnav.envs.geodesics`, float32; empty unless they are observed.
        settings (PACKED,): see `leapnav.envs.settings`.

    """

    bodies: np.ndarray
    robots: np.ndarray
    state: np.ndarray
    tasks: np.ndarray
    fields: np.ndarray
    guides: np.ndarray
    noise: np.ndarray
    noise_rows: np.ndarray
    maps: np.ndarray
    settings: np.ndarray


SIMULATION_STATE = record_type(
    SimulationState,
    bodies=MATRIX,
    robots=MATRIX,
    state=MATRIX,
    tasks=MATRIX,
    fields=PLACES,
    guides=CUBE,
    noise=CUBE,
    noise_rows=INTEGERS,
    maps=float32[:, ::1],
    settings=VECTOR,
)
# The same as a plain tuple, which Numba receives from Python in less time than a named one.
PACKED_STATE = types.Tuple(SIMULATION_STATE.types)
