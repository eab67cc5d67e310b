"""A navigation task: arena, robot, obstacles, start, goal, horizon and cost weights.

A `Scenario` is immutable and validated on construction. The same object is the environment's task and, through
`leapnav.experts`, the optimal control problem. Units are metres, seconds and radians throughout.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, SerializeAsAny, ValidationError, field_validator, model_validator

from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.packing import field_parts, pack_field, replace_parts
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots import Box, Disc, RobotModel, Unicycle
from leapnav.envs.robots.base import robot_class
from leapnav.envs.robots.footprints import sizes_of
from leapnav.envs.scenarios.cost import Cost, cruise_speed
from leapnav.envs.scenarios.faults import (
    ScenarioError,
    check_headings,
    fault,
    one_line,
    read_text,
    shorten,
    unique_keys,
)
from leapnav.envs.scenarios.maps import check_discs, disc_arena, read_movingai, rectangle_vertices
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.shapes import Circle, Polygon
from leapnav.envs.shapes.base import KINDS
from leapnav.envs.utils.json_utils import parse_json
from leapnav.envs.utils.records import Finite, Frozen, Positive
from leapnav.envs.utils.validation import as_vector, check_positive

N_HEADINGS = 73  # at which the clearance of a robot with a free heading is evaluated
TIME_LIMIT_FACTOR = 3.0  # time limit of an episode, as a multiple of the duration of the optimum


class Task(NamedTuple):
    """What the simulation reads of a scenario for a robot with n states, m controls and p parameters, besides the time.

    Attributes:
        start, goal (n,): states at time 0 and at the end; NaN for a state that is free at the goal.
        middles, halves, weights (m,): middles and half widths of the intervals of the controls; weights of the squares.
        parameters (p,): parameters of the robot's model.

    """

    start: np.ndarray
    goal: np.ndarray
    middles: np.ndarray
    halves: np.ndarray
    weights: np.ndarray
    parameters: np.ndarray


class Scenario(Frozen):
    """A navigation task. Immutable; scenarios with equal fields are equal.

    Args:
        name: label used in messages and tables.
        arena: (x_min, y_min, x_max, y_max), the positions of the walls (m).
        robot: model, footprint and limits of the robot, a model of `leapnav.envs.robots`.
        start: pose (x, y, heading) at time 0.
        goal: pose (x, y, heading) at the horizon; a heading of None is free.
        horizon: duration of the task (s); None if it is free, with a positive time weight.
        time_limit: time after which an environment truncates an episode if the horizon is free (s). None for 3 times
            the time in which the robot drives the sum of the arena's side lengths at `cruise_speed`.
        obstacles: the obstacles, which may overlap; each has one shape, see `Obstacle`.
        cost: weights of the running cost.
        start_motion: further states of the robot at time 0, such as speed and turn rate; None for zeros.
        goal_motion: further states at the horizon, each a number or None if it is free; None for those of the model.

    Raises:
        ScenarioError: a field is missing, unknown, not finite or invalid.

    """

    name: str = "scenario"
    arena: tuple[Finite, Finite, Finite, Finite]
    robot: SerializeAsAny[RobotModel] = Unicycle()
    start: tuple[Finite, Finite, Finite]
    goal: tuple[Finite, Finite, Finite | None]
    horizon: Positive | None
    time_limit: Positive | None = None
    obstacles: tuple[Obstacle, ...] = ()
    cost: Cost = Cost()
    start_motion: tuple[Finite, ...] | None = None
    goal_motion: tuple[Finite | None, ...] | None = None

    def __init__(self, /, **fields: Any) -> None:
        faults: list[str] = []
        if isinstance(robot := fields.get("robot"), Mapping):
            fields["robot"], faults = _read_robot(robot)
        try:
            super().__init__(**fields)
        except ValidationError as error:
            faults += [fault(details, _known_fields) for details in error.errors(include_url=False)]
        if faults:
            raise ScenarioError(one_line(fields.get("name", "scenario"), faults)) from None

    @field_validator("arena")
    @classmethod
    def _check_arena(cls, arena: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        x_min, y_min, x_max, y_max = arena
        if x_min >= x_max or y_min >= y_max:
            raise ValueError("the arena needs x_min < x_max and y_min < y_max")
        return arena

    @model_validator(mode="after")
    def _check_robot(self) -> Self:
        name, robot = self.robot.model, self.robot
        for field in ("start_motion", "goal_motion"):
            robot.check_motion(field, getattr(self, field))
        for field in ("speed_weight", "turn_weight"):
            value = getattr(self.cost, field)
            if field not in robot.cost_fields and value != Cost.model_fields[field].default:
                raise ValueError(f"cost.{field}: not used by the robot {name!r}, got {value:g}")
        return self

    @model_validator(mode="after")
    def _check_horizon(self) -> Self:
        if self.horizon is None and self.cost.time_weight == 0:
            raise ValueError("cost.time_weight: expected a positive number, since the horizon is free, got 0")
        if self.horizon is not None and self.time_limit is not None:
            raise ValueError(f"time_limit: expected None, since the horizon is fixed, got {self.time_limit:g}")
        return self

    @model_validator(mode="after")
    def _check_poses_are_free(self) -> Self:
        names = [f"obstacles[{i}]" for i in range(len(self.obstacles))] + ["the arena wall"]
        faults = []
        at_rest = [part for part in field_parts(self.field) if not len(part.knots)] if self.moves else []
        for end, given, time in (("start", self.start_state, 0.0), ("goal", self.goal_state, self.horizon)):
            # Whether a moving obstacle is at the goal when the robot arrives is not known if the horizon is free.
            field = self.field if time is not None or not self.moves else replace_parts(self.field, at_rest)
            state = np.array([*(value or 0.0 for value in given), time or 0.0])
            distance, nearest = footprint_clearance(constant(state), self.outline, field)
            free = [k for k in {2, *self.outline[:, 4].astype(int)} - {0} if given[k] is None]
            circle = np.linspace(-np.pi, np.pi, N_HEADINGS)
            for angles in product(circle, repeat=len(free)) if free and not distance > 0 else ():
                state[free] = angles  # at some heading and hitch angle there must be no contact
                distance, nearest = max((distance, nearest), footprint_clearance(constant(state), self.outline, field))
            if not distance > 0:
                faults.append(
                    f"{end}: ({state[0]:g}, {state[1]:g}) is inside {names[nearest]} (clearance {distance:.3g} m)"
                )
        if faults:
            raise ValueError("; ".join(faults))
        return self

    @cached_property
    def field(self) -> np.ndarray:
        """The packed obstacle field, see `leapnav.envs.field.layout` (read-only)."""
        obstacles, weights = self.obstacles, (self.cost.proximity_weight, self.cost.proximity_scale)
        shapes, motions = [one.shape for one in obstacles], [one.knots for one in obstacles]
        clock = self.robot.sizes()[0]
        return pack_field(shapes, self.arena, sizes_of(self.outline), *weights, motions=motions, clock=clock)

    @property
    def moves(self) -> bool:
        """Whether an obstacle moves by itself."""
        return any(len(obstacle.knots) for obstacle in self.obstacles)

    @cached_property
    def outline(self) -> np.ndarray:
        """The robot's footprint (K, 5), see `leapnav.envs.robots.footprints.outline_of` (read-only)."""
        return self.robot.outline()

    @property
    def start_state(self) -> tuple[float, ...]:
        """The state (n,) of the robot at time 0."""
        n = self.robot.sizes()[0]
        return (*self.start, *((0.0,) * (n - 3) if self.start_motion is None else self.start_motion))

    @property
    def goal_state(self) -> tuple[float | None, ...]:
        """The state (n,) of the robot at the horizon; None where it is free."""
        return (*self.goal, *(self.robot.goal_motion if self.goal_motion is None else self.goal_motion))

    @property
    def horizon_kind(self) -> str:
        """Whether the horizon is "fixed" or "free"."""
        return "free" if self.horizon is None else "fixed"

    @property
    def cruise_speed(self) -> float:
        """Speed (m/s) of an optimum with a free horizon on a straight line without obstacles, at most the limit."""
        return cruise_speed(self.robot, self.cost)

    @property
    def episode_limit(self) -> float:
        """Time after which an episode ends (s): the horizon, or the time limit if the horizon is free."""
        if self.horizon is not None:
            return self.horizon
        if self.time_limit is not None:
            return self.time_limit
        x_min, y_min, x_max, y_max = self.arena
        return TIME_LIMIT_FACTOR * (x_max - x_min + y_max - y_min) / self.cruise_speed

    @cached_property
    def task(self) -> Task:
        """The task as arrays for the simulation and for banks (read-only).

        Raises:
            ScenarioError: the horizon is fixed, and the time has a weight.

        """
        bot, cost = self.robot, self.cost
        if self.horizon is not None and cost.time_weight:
            message = f"cost.time_weight: environments and banks with a fixed horizon need 0, got {cost.time_weight:g}"
            raise ScenarioError(one_line(self.name, [message]))
        vectors = self.start_state, self.goal_state, *bot.action_scale(), bot.control_weight(cost), bot.parameters(cost)
        return Task(*map(constant, vectors))

    def from_state(self, state: Sequence[float] | np.ndarray, time: float) -> Self:
        """Return the rest of the scenario from a state (n,) of the robot at a time (s).

        Raises:
            ScenarioError: the robot is in contact with an obstacle, or no time is left.
            ValueError: the state has another length, or is not finite.

        """
        x, y, heading, *motion = as_vector("state", state, len(self.robot.state_names)).tolist()
        obstacles = tuple(obstacle.after(time) for obstacle in self.obstacles)
        update: dict[str, Any] = {"start": (x, y, heading), "obstacles": obstacles}
        if self.horizon is not None:
            update["horizon"] = float(self.horizon - time)
        if motion:
            update["start_motion"] = tuple(motion)
        return self.model_copy(update=update)

    def to_state(self, state: Sequence[float] | np.ndarray) -> Self:
        """Return the scenario with a state (n,) as its goal; states that are free at the goal stay free.

        Raises:
            ScenarioError: the robot is in contact with an obstacle at the state.
            ValueError: the state has another length, or is not finite.

        """
        x, y, heading, *motion = as_vector("state", state, len(self.robot.state_names)).tolist()
        update: dict[str, Any] = {
            "goal": (x, y, None if self.goal[2] is None else math.remainder(heading, 2 * math.pi))
        }
        if motion:
            fixed = zip(motion, self.goal_state[3:], strict=True)
            update["goal_motion"] = tuple(None if goal is None else value for value, goal in fixed)
        return self.model_copy(update=update)

    def __eq__(self, other: object) -> bool:
        # pydantic would compare the cached arrays, too.
        return isinstance(other, Scenario) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in type(self).model_fields)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with some fields changed, which is validated."""
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**fields, **(update or {})})

    def __getstate__(self) -> dict[Any, Any]:
        state = super().__getstate__()
        # Arrays are writeable after unpickling, so the packed ones are computed again instead.
        return {
            **state,
            "__dict__": {k: v for k, v in state["__dict__"].items() if k not in ("field", "outline", "task")},
        }

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the scenario as JSON text, and write it to `path` if one is given."""
        text = json.dumps(self.to_dict())
        if path is not None:
            Path(path).write_text(text + "\n", encoding="utf-8")
        return text

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as dictionaries, lists and numbers, with the structure of the scenario file."""
        fields = self.model_dump(mode="json", exclude_none=True)
        if self.horizon is None:
            fields["horizon"] = None
        if self.cost.time_weight == 0:
            del fields["cost"]["time_weight"]
        return fields

    @classmethod
    def from_dict(cls, fields: Any) -> Scenario:
        """Return the scenario of a dictionary, the inverse of `to_dict`.

        Raises:
            ScenarioError: see the class.

        """
        if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
            raise ScenarioError(f"a scenario is a JSON object, got {shorten(fields)}")
        try:
            return cls(**fields)
        except RecursionError:
            raise ScenarioError(f"Scenario {shorten(fields.get('name'))}: the fields are nested too deeply") from None

    @classmethod
    def from_json(cls, path_or_text: str | Path) -> Scenario:
        """Read a scenario from a file, or from JSON text (recognised by its opening brace).

        Raises:
            ScenarioError: the text is not JSON, a heading in a file is beyond +-2 pi, or see the class.
            OSError: the file cannot be read.

        """
        is_text = isinstance(path_or_text, str) and path_or_text.lstrip().startswith("{")
        source, text = ("text", str(path_or_text)) if is_text else (str(path_or_text), None)
        try:
            text = read_text(Path(path_or_text)) if text is None else text
            fields = json.loads(text, object_pairs_hook=unique_keys)
        except ScenarioError:
            raise
        except (ValueError, RecursionError) as error:  # syntax, encoding, numbers with too many digits, nesting
            raise ScenarioError(f"scenario {source}: not valid JSON: {error}") from None
        scenario = cls.from_dict(fields)
        if not is_text:  # written by hand, perhaps in degrees
            check_headings(scenario.name, scenario.start, scenario.goal)
        return scenario

    @classmethod
    def from_discs(
        cls,
        discs: Any,
        *,
        start: tuple[float, float, float],
        goal: tuple[float, float, float | None],
        horizon: float | None,
        arena: tuple[float, float, float, float] | None = None,
        **fields: Any,
    ) -> Scenario:
        """Return a scenario whose obstacles are discs.

        Args:
            discs (n, 3): x, y and radius of each disc (m).
            start, goal, horizon: see the class.
            arena: see the class; None for the smallest arena with 1 m around the discs, the start and the goal.
            fields: name, robot and cost, see the class.

        Raises:
            ScenarioError: see the class.
            ValueError: a disc is invalid.

        """
        array = check_discs(discs)
        obstacles = tuple(Obstacle(circle=Circle(center=(x, y), radius=radius)) for x, y, radius in array.tolist())
        arena = arena or disc_arena(array, (start[:2], goal[:2]))
        return cls(arena=arena, start=start, goal=goal, horizon=horizon, obstacles=obstacles, **fields)

    @classmethod
    def from_movingai(
        cls,
        path: str | os.PathLike[str],
        *,
        start: tuple[float, float, float],
        goal: tuple[float, float, float | None],
        horizon: float | None,
        cell_size: float = 1.0,
        **fields: Any,
    ) -> Scenario:
        """Return a scenario on a grid map of the Moving AI Lab.

        Blocked cells are merged into few rectangles. Those without a free neighbour cannot be reached and may be
        omitted. The lower left corner of the map is (0, 0): in units of the cell size, the cell in column c of line l,
        both counted from 0 and l from the top, extends from x = c to c + 1 and from y = height - 1 - l to height - l.

        Args:
            path: the map file (`.map`).
            start, goal, horizon: see the class, in metres and seconds.
            cell_size: side length of a cell (m).
            fields: name (by default that of the file), robot and cost, see the class.

        Raises:
            OSError: the file cannot be read.
            ScenarioError: see the class.
            ValueError: the file is not a valid map, or `cell_size` is not positive.

        """
        check_positive("cell_size", cell_size)
        blocked = read_movingai(path)
        height, width = blocked.shape
        fields.setdefault("name", Path(path).stem)
        obstacles = [Obstacle(polygon=Polygon(vertices=part)) for part in rectangle_vertices(blocked, cell_size)]
        arena = (0.0, 0.0, cell_size * width, cell_size * height)
        scenario = cls(arena=arena, start=start, goal=goal, horizon=horizon, obstacles=tuple(obstacles), **fields)
        # Validation has checked the poses against the obstacles, but some blocked cells are omitted from those.
        for name, (x, y, _) in (("start", scenario.start), ("goal", scenario.goal)):
            if blocked[height - 1 - int(y / cell_size), int(x / cell_size)]:
                raise ScenarioError(
                    f"Scenario {scenario.name!r}: {name}: ({x:g}, {y:g}) is in a blocked cell of {path}"
                )
        return scenario


def check_robot(value: RobotModel | Mapping[str, Any] | str) -> RobotModel:
    """Return a robot given by the name of its model, a dict of its fields with `model` or its JSON text, or itself.

    Raises:
        ValueError: it is invalid; the message names the field and the value.

    """
    if isinstance(value, str):
        value = parse_json("robot", value) if value.lstrip().startswith("{") else {"model": value}
    if not isinstance(value, (RobotModel, Mapping)):
        raise ValueError(f"robot: expected the name of a model, a dict of its fields or a robot, got {shorten(value)}")
    robot, faults = (value, []) if isinstance(value, RobotModel) else _read_robot(value)
    if faults:
        raise ValueError("; ".join(faults))
    return robot


def _read_robot(fields: Mapping[str, Any]) -> tuple[RobotModel, list[str]]:
    """Return a robot from its fields, with the faults; with faults, another robot."""
    try:
        model = robot_class(fields.get("model", "unicycle"))
    except ValueError as error:
        return Unicycle(), [f"robot.model: {error}"]
    try:
        return model(**dict(fields)), []
    except ValidationError as error:
        return Unicycle(), [
            fault(details, partial(_known_fields, robot=model), ("robot",))
            for details in error.errors(include_url=False)
        ]


def _known_fields(location: Sequence[Any], robot: type[RobotModel] = Unicycle) -> tuple[str, ...]:
    """Return the fields of the part of a scenario at a location."""
    parts: dict[Any, type[BaseModel]] = {"robot": robot, "footprint": Disc, "box": Box, "cost": Cost, **KINDS}
    names = [key for key in location if isinstance(key, str)]
    model = parts.get(names[-1]) if names else Scenario
    return tuple(KINDS) if model is None else tuple(model.model_fields)
