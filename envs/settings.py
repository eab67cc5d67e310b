"""Settings of the environments: the arguments shared by the single and the vector form, validated."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self, cast

import numpy as np
from numba import from_dtype

from leapnav.envs.robots import RobotModel
from leapnav.envs.robots.base import MODELS
from leapnav.envs.utils.validation import (
    check_at_least,
    check_choice,
    check_flag,
    check_fraction,
    check_integer,
    check_not_negative,
    check_positive,
    is_number,
    suggestion,
)

OBSERVATIONS = "lidar", "state", "map", "geodesic"
WITH_VELOCITIES = "map", "geodesic"  # observations that can contain the velocities of obstacles
REWARDS, ACTUATIONS = ("cost", "shaped"), ("velocity", "motor")
GOAL_REWARDS, HORIZONS = ("sparse", "cost"), ("fixed", "free")
OBSTACLE_KINDS = "cost", "hard"  # see `Cost.obstacles`
# Arguments that determine what is observed.
SENSORS = (
    *("observation", "lidar_beams", "lidar_range", "lidar_fov", "map_obstacles", "map_vertices"),
    *("velocities", "history", "previous_action"),
)
FULL_CIRCLE = 2 * math.pi  # rad
MIN_FOV, FOV_ROUNDING = 1e-3, 1e-6  # rad, smallest field of view, and rounding of a given full circle
MIN_PERIOD, CONTROL_PERIOD = 1e-4, 0.05  # s, the shortest and the default control period
MAX_COUNT = 10_000  # beams, obstacles in the map, vertices of each, or control periods of the history


@dataclass(frozen=True)
class Motor:
    """Parameters of the robot's body, motors and tyres, for `actuation="motor"`, which needs the robot "unicycle".

    Mass, moment of inertia and friction also determine the contacts of robots without motors, and the track their wheel
    slip, see `Disturbance`.

    Attributes:
        mass: mass (kg).
        moment: moment of inertia (kg m^2).
        track: distance between the wheels (m).
        wheel_force: maximum force of each wheel's motor (N).
        response: time constant of the motors' speed control (s).
        grip: coefficient of friction of the tyres in the lateral direction; they slip when it is exceeded.
        friction: coefficient of friction between the robot's rim and an obstacle or wall in contact.

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
            check_positive(f"motor: {name}", getattr(self, name))
        for name in ("grip", "friction"):
            check_not_negative(f"motor: {name}", getattr(self, name))


@dataclass(frozen=True)
class Disturbance:
    """Noise on actuation and sensing, sampled in each control period from a generator of the environment's own.

    Attributes:
        actuation: standard deviation of the executed speed and turn rate, relative to the commanded ones.
        slip: scale of the wheel slip: each wheel loses the fraction `slip * |n|` of its distance, n standard normal.
        sensing: standard deviation of the sensed position (m) and heading (rad), relative to which the goal and the map
            are observed, and of the lidar ranges (m), which are measured from the true pose. The detours of the
            geodesic observation belong to the sensed pose and to the ranges without noise.

    """

    actuation: float = 0.0
    slip: float = 0.0
    sensing: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            check_not_negative(f"disturbance: {field.name}", getattr(self, field.name))


UNDISTURBED = Disturbance()


@dataclass(frozen=True)
class EnvironmentSettings:
    """The arguments of `NavigateEnv`, which documents them, without those that select scenarios.

    Attributes:
        goal_conditioned: whether the environment is `NavigateGoalEnv` or its vector form.

    Raises:
        ValueError: an argument is invalid; the message states its name and value.

    """

    robot: str = "unicycle"
    horizon: str = "fixed"
    observation: str = "lidar"
    reward: str = "cost"
    actuation: str = "velocity"
    disturbance: Disturbance = UNDISTURBED
    motor: Motor = Motor()
    dict_observation: bool = False
    control_period: float = CONTROL_PERIOD
    position_tolerance: float = 0.1
    heading_tolerance: float = 0.1
    motion_tolerance: float = 0.1
    collision_penalty: float = 50.0
    miss_penalty: float = 50.0
    graded_miss: bool = False
    reward_scale: float = 1.0
    discount: float = 0.99
    terminate_on_collision: bool = True
    lidar_beams: int = 32
    lidar_range: float = 10.0
    lidar_fov: float = FULL_CIRCLE
    map_obstacles: int = 8
    map_vertices: int = 8
    velocities: bool = False
    history: tuple[float, ...] = ()
    previous_action: bool = False
    goal_conditioned: bool = False

    def __post_init__(self) -> None:
        check_choice("robot", self.robot, MODELS)
        check_choice("horizon", self.horizon, HORIZONS)
        check_choice("observation", self.observation, OBSERVATIONS)
        check_choice("reward", self.reward, GOAL_REWARDS if self.goal_conditioned else REWARDS)
        check_choice("actuation", self.actuation, ACTUATIONS)
        for name in (
            "control_period",
            "position_tolerance",
            "heading_tolerance",
            "motion_tolerance",
            "lidar_range",
            "lidar_fov",
            "reward_scale",
        ):
            check_positive(name, getattr(self, name))
        for name in ("collision_penalty", "miss_penalty"):
            check_not_negative(name, getattr(self, name))
        check_at_least("control_period", self.control_period, MIN_PERIOD, unit="s")
        check_fraction("discount", self.discount, zero=False)
        fov = float(self.lidar_fov)
        if not MIN_FOV <= fov <= FULL_CIRCLE + FOV_ROUNDING:
            raise ValueError(f"lidar_fov: expected an angle in [{MIN_FOV:g}, 2 pi] rad, got {fov!r}")
        object.__setattr__(self, "lidar_fov", FULL_CIRCLE if fov > FULL_CIRCLE - FOV_ROUNDING else fov)
        for name, minimum in (("lidar_beams", 0), ("map_obstacles", 1), ("map_vertices", 3)):
            check_integer(name, getattr(self, name), minimum, MAX_COUNT)
        for name in ("terminate_on_collision", "graded_miss", "dict_observation", "previous_action", "velocities"):
            check_flag(name, getattr(self, name))
        if self.velocities and self.observation not in WITH_VELOCITIES:
            raise ValueError(f"velocities: expected False for the observation {self.observation!r}, got True")
        if self.motors and self.robot != "unicycle":
            raise ValueError(f"actuation: 'motor' needs the robot 'unicycle', got {self.robot!r}")
        if self.goal_conditioned and any(value is not None for value in self.model.goal_motion):
            raise ValueError(
                f"robot: the goal of a goal-conditioned environment is a pose, but {self.robot!r} has goals for its "
                "other states; use leapnav/Navigate-v0"
            )
        if (
            self.goal_conditioned
            and self.free_horizon
            and self.observation == "state"
            and not self.motors
            and self.model.sizes()[0] == 3
        ):
            raise ValueError(
                "observation: with a free horizon, a goal-conditioned environment needs 'lidar' or 'map', got 'state'"
            )
        if self.goal_conditioned and self.graded_miss:
            raise ValueError("graded_miss: expected False for a goal-conditioned environment, got True")
        if self.goal_conditioned and self.observation == "geodesic":
            raise ValueError(
                "observation: geodesic distances depend on the goal, which a goal-conditioned learner replaces; "
                "expected 'lidar', 'state' or 'map', got 'geodesic'"
            )
        object.__setattr__(self, "history", self._checked_history())
        object.__setattr__(self, "disturbance", _as_disturbance(self.disturbance))
        object.__setattr__(self, "motor", _as_dataclass("motor", Motor, self.motor))

    def _checked_history(self) -> tuple[float, ...]:
        """Return the history as a tuple of floats, after a check."""
        given, longest = self.history, MAX_COUNT * self.control_period
        if not isinstance(cast(object, given), (tuple, list)) or not all(is_number(age) for age in given):
            raise ValueError(f"history: expected a sequence of ages in seconds, got {given!r}")
        ages = tuple(map(float, given))
        if not all(before < age <= longest for before, age in zip((0.0, *ages), ages, strict=False)):
            raise ValueError(f"history: expected increasing ages in (0, {longest:g}] s, got {given!r}")
        if ages and round(ages[0] / self.control_period) < 1:
            raise ValueError(f"history: expected ages of at least one control period, got {ages[0]:g}")
        option = "history" if ages else "previous_action"
        if (self.dict_observation or self.goal_conditioned) and (ages or self.previous_action):
            kind = "dictionaries" if self.dict_observation else "those of a goal-conditioned environment"
            raise ValueError(
                f"{option}: expected the default, because observations are {kind}, got {getattr(self, option)!r}"
            )
        return ages

    @property
    def lags(self) -> tuple[int, ...]:
        """The ages of the history in control periods."""
        return tuple(round(age / self.control_period) for age in self.history)

    @classmethod
    def of(cls, env: Any, source: Any, arguments: Mapping[str, Any]) -> Self:
        """Return the settings of an environment.

        Args:
            env: the environment, whose class is named in errors and has `_goal_conditioned`.
            source: its `ScenarioSource`, which determines the robot and the kind of the horizon, and whether velocities
                are observed unless they are given.
            arguments: the other arguments.

        Raises:
            TypeError: an argument is unknown.
            ValueError: an argument is invalid.

        """
        for name in arguments:
            if name not in ARGUMENTS:
                near = suggestion(name, ARGUMENTS)
                raise TypeError(f"{type(env).__name__}: got an unexpected keyword argument {name!r}{near}")
        given = dict(arguments)
        if given.get("observation") in WITH_VELOCITIES:
            given.setdefault("velocities", source.moves)
        kinds = {"robot": source.robot.model, "horizon": source.horizon}
        return cls(**kinds, **given, goal_conditioned=env._goal_conditioned)

    @property
    def model(self) -> type[RobotModel]:
        """The class of the robot's model."""
        return MODELS[self.robot]

    @property
    def has_lidar(self) -> bool:
        """Whether lidar ranges are observed."""
        return self.observation in ("lidar", "geodesic")

    @property
    def has_full_circle(self) -> bool:
        """Whether the beams of the lidar are distributed over the full circle."""
        return self.lidar_fov == FULL_CIRCLE

    @property
    def beam_angles(self) -> np.ndarray:
        """Angles (rad) of the beams, counter-clockwise from straight ahead, shape (lidar_beams,).

        On the full circle the first beam points straight ahead. In a smaller field of view the first and the last beam
        are at its right and left end.
        """
        count, half = self.lidar_beams, self.lidar_fov / 2
        if self.has_full_circle:
            return FULL_CIRCLE * np.arange(count) / max(count, 1)
        return np.linspace(-half, half, count) if count > 1 else np.zeros(count)

    @property
    def sensors(self) -> str:
        """What is observed, in words, such as "lidar, 32 beams"."""
        view = "" if self.has_full_circle else f" in {math.degrees(self.lidar_fov):.0f} degrees"
        words = {
            "lidar": f"lidar, {self.lidar_beams} beams{view}",
            "geodesic": f"lidar and geodesic distances, {self.lidar_beams} beams{view}",
            "map": f"map of {self.map_obstacles} obstacles",
            "state": "goal and motion",
        }
        further = [("velocities of obstacles", self.velocities), ("last action", self.previous_action)]
        ages = [f"observations of {', '.join(f'{age:g}' for age in self.history)} s before"] if self.history else []
        period = [] if self.control_period == CONTROL_PERIOD else [f"every {self.control_period:g} s"]
        return ", ".join([words[self.observation], *(text for text, given in further if given), *ages, *period])

    @property
    def free_horizon(self) -> bool:
        """Whether an episode ends when the robot reaches the goal, instead of after a fixed time."""
        return self.horizon == "free"

    @property
    def disturbed(self) -> bool:
        """Whether there is any noise."""
        return self.disturbance != UNDISTURBED

    @property
    def motors(self) -> bool:
        """Whether the robot is driven by forces."""
        return self.actuation == "motor"

    @property
    def shaped(self) -> bool:
        """Whether the reward is shaped."""
        return self.reward == "shaped"

    @property
    def commands_motion(self) -> bool:
        """Whether the controls are speed and turn rate."""
        return self.model.control_names == ("speed", "turn_rate")

    @property
    def heading_states(self) -> int:
        """The further states that are headings in the plane: the sum of 2^k over their indices k."""
        return sum(1 << k for k, name in enumerate(self.model.state_names) if name in self.model.heading_states)

    def packed(self) -> np.ndarray:
        """Return the settings as an array of one record of SETTINGS, which the kernels read."""
        return np.array([_values(self, SETTINGS)], SETTINGS)


# The settings that are arguments of the environments under the same name.
ARGUMENTS = {f.name: f for f in fields(EnvironmentSettings) if f.name not in ("robot", "horizon", "goal_conditioned")}


def takes_settings(function: Callable[..., None]) -> Callable[..., None]:
    """Decorate a constructor with the keyword arguments `**settings`: its signature shows them with their defaults."""
    own = inspect.signature(function)
    parameters = [one for one in own.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
    shown = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
        for name, f in ARGUMENTS.items()
    ]
    function.__signature__ = own.replace(parameters=[*parameters, *shown])  # type: ignore[attr-defined]
    return function


def _values(record: Any, dtype: np.dtype) -> tuple[Any, ...]:
    """Return the values of an object's attributes that a dtype names."""
    values = ((getattr(record, name), dtype[name]) for name in dtype.names or ())
    return tuple(_values(value, kind) if kind.names else value for value, kind in values)


MOTOR, DISTURBANCE = (np.dtype([(f.name, "f8") for f in fields(kind)]) for kind in (Motor, Disturbance))
# The numbers and flags of the settings.
SETTINGS = np.dtype(
    [(f.name, f.type) for f in fields(EnvironmentSettings) if f.type in ("int", "float", "bool")]
    + [(name, "bool") for name in ("free_horizon", "motors", "shaped", "commands_motion")]
    + [("heading_states", "i8"), ("motor", MOTOR), ("disturbance", DISTURBANCE)],
    align=True,
)
MOTOR_TYPE = from_dtype(MOTOR)


def _as_disturbance(value: Any) -> Disturbance:
    if is_number(value):
        check_not_negative("disturbance", value)
        size = float(value)
        return Disturbance(actuation=size, slip=size, sensing=size / 10)
    return _as_dataclass("disturbance", Disturbance, value)


def _as_dataclass(name: str, kind: type, value: Any) -> Any:
    """Return the dataclass `kind` for an instance of it, a dict of its attributes, or None (the defaults)."""
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
