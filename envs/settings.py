"""What the arguments of the environments mean, checked once and for all their forms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

OBSERVATIONS, REWARDS, ACTUATIONS = ("lidar", "state", "map"), ("cost", "shaped"), ("velocity", "motor")
GOAL_REWARDS = ("sparse", "cost")
SENSORS = ("observation", "lidar_beams", "lidar_range", "map_obstacles", "map_vertices")  # arguments that choose them
SHORTEST_PERIOD = 1e-4  # s
MOST = 10_000  # beams, obstacles or vertices

# Positions in the array that the kernels read.
(
    PERIOD,
    POSITION_TOLERANCE,
    HEADING_TOLERANCE,
    COLLISION_PENALTY,
    MISS_PENALTY,
    ENDS_ON_TOUCH,
    LIDAR_RANGE,
    SHAPED,
    DISCOUNT,
    MOTORS,
    MASS,
    MOMENT,
    TRACK,
    WHEEL_FORCE,
    RESPONSE,
    GRIP,
    ACTUATION_NOISE,
    SLIP,
    SENSING_NOISE,
    OBSERVATION,
    GOAL_CONDITIONED,
    OBSTACLES,
    VERTICES,
    PACKED,
) = range(24)


def _check_number(name: str, value: Any, *, positive: bool = False) -> None:
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and (value > 0 if positive else value >= 0)):
        raise ValueError(f"{name}: expected {'a positive number' if positive else 'a number >= 0'}, got {value!r}")


def _check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


@dataclass(frozen=True)
class Motor:
    """Body, wheels and ground of a robot that is driven by forces.

    Attributes:
        mass: kg.
        moment: of inertia, kg m^2.
        track: m between the wheels.
        wheel_force: N, the most that a wheel's motor exerts.
        response: s, the time constant of the motors' speed control.
        grip: coefficient of friction against sliding sideways; the tyres slip beyond it.
        friction: coefficient of friction of the robot's rim against what it touches.

    """

    mass: float = 10.0
    moment: float = 0.3
    track: float = 0.4
    wheel_force: float = 20.0
    response: float = 0.05
    grip: float = 0.6
    friction: float = 0.5

    def __post_init__(self) -> None:
        for name in ("mass", "moment", "track", "wheel_force", "response"):
            _check_number(f"motor: {name}", getattr(self, name), positive=True)
        for name in ("grip", "friction"):
            _check_number(f"motor: {name}", getattr(self, name))


@dataclass(frozen=True)
class Disturbance:
    """Noise on what the robot does and senses, drawn anew in each control period by the environment's own generator.

    Attributes:
        actuation: standard deviation of the driven speed and turn rate, relative to the commanded ones.
        slip: each wheel loses the share `slip * |n|` of its way, n standard normal.
        sensing: standard deviation of the sensed position (m) and heading (rad), from which the goal and the map are
            seen, and of the lidar's ranges (m), which it takes from where the robot is.

    """

    actuation: float = 0.0
    slip: float = 0.0
    sensing: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_number(f"disturbance: {field.name}", getattr(self, field.name))


@dataclass(frozen=True)
class Settings:
    """The arguments that `NavigateEnv` documents, but for those that choose scenarios.

    Raises:
        ValueError: an argument is impossible; the message names it and its value.

    """

    observation: str = "lidar"
    reward: str = "cost"
    actuation: str = "velocity"
    disturbance: Disturbance = Disturbance()
    motor: Motor = Motor()
    dict_observation: bool = False
    control_period: float = 0.05
    position_tolerance: float = 0.1
    heading_tolerance: float = 0.1
    collision_penalty: float = 50.0
    miss_penalty: float = 50.0
    discount: float = 0.99
    terminate_on_collision: bool = True
    lidar_beams: int = 32
    lidar_range: float = 10.0
    map_obstacles: int = 8
    map_vertices: int = 8
    goal_conditioned: bool = False

    def __post_init__(self) -> None:
        _check_choice("observation", self.observation, OBSERVATIONS)
        _check_choice("reward", self.reward, GOAL_REWARDS if self.goal_conditioned else REWARDS)
        _check_choice("actuation", self.actuation, ACTUATIONS)
        for name in ("control_period", "position_tolerance", "heading_tolerance", "lidar_range"):
            _check_number(name, getattr(self, name), positive=True)
        for name in ("collision_penalty", "miss_penalty"):
            _check_number(name, getattr(self, name))
        if self.control_period < SHORTEST_PERIOD:
            raise ValueError(f"control_period: expected at least {SHORTEST_PERIOD} s, got {self.control_period!r}")
        _check_number("discount", self.discount, positive=True)
        if self.discount > 1:
            raise ValueError(f"discount: expected a number in (0, 1], got {self.discount!r}")
        for name, least in (("lidar_beams", 0), ("map_obstacles", 1), ("map_vertices", 3)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= MOST:
                raise ValueError(f"{name}: expected an integer from {least} to {MOST}, got {value!r}")
        for name in ("terminate_on_collision", "dict_observation"):
            if not isinstance(getattr(self, name), (bool, np.bool_)):
                raise ValueError(f"{name}: expected True or False, got {getattr(self, name)!r}")
        object.__setattr__(self, "disturbance", _as_disturbance(self.disturbance))
        object.__setattr__(self, "motor", _as_part("motor", Motor, self.motor))

    @property
    def disturbed(self) -> bool:
        """Whether anything is disturbed."""
        return self.disturbance != Disturbance()

    @property
    def motors(self) -> bool:
        """Whether forces drive the robot."""
        return self.actuation == "motor"

    def packed(self) -> np.ndarray:
        """The settings as the kernels read them."""
        values = np.zeros(PACKED)
        values[PERIOD] = self.control_period
        values[POSITION_TOLERANCE], values[HEADING_TOLERANCE] = self.position_tolerance, self.heading_tolerance
        values[COLLISION_PENALTY], values[MISS_PENALTY] = self.collision_penalty, self.miss_penalty
        values[ENDS_ON_TOUCH], values[LIDAR_RANGE] = self.terminate_on_collision, self.lidar_range
        values[SHAPED], values[DISCOUNT] = self.reward == "shaped", self.discount
        motor, noise = self.motor, self.disturbance
        values[MOTORS], values[MASS], values[MOMENT], values[TRACK] = self.motors, motor.mass, motor.moment, motor.track
        values[WHEEL_FORCE], values[RESPONSE], values[GRIP] = motor.wheel_force, motor.response, motor.grip
        values[ACTUATION_NOISE], values[SLIP], values[SENSING_NOISE] = noise.actuation, noise.slip, noise.sensing
        values[OBSERVATION], values[GOAL_CONDITIONED] = OBSERVATIONS.index(self.observation), self.goal_conditioned
        values[OBSTACLES], values[VERTICES] = self.map_obstacles, self.map_vertices
        return values


def _as_disturbance(value: Any) -> Disturbance:
    if isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool):
        _check_number("disturbance", value)
        size = float(value)
        return Disturbance(actuation=size, slip=size, sensing=size / 10)
    return _as_part("disturbance", Disturbance, value)


def _as_part(name: str, kind: type, value: Any) -> Any:
    """A part of the settings, given as itself, by a dict of its attributes, or by None for the defaults."""
    if value is None:
        return kind()
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: expected {kind.__name__} or a dict of its attributes, got {value!r}")
    known = [field.name for field in fields(kind)]
    for key in value:
        if key not in known:
            raise ValueError(f"{name}: expected the attributes {', '.join(known)}, got {key!r}")
    return kind(**value)
