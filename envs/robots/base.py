"""The interface of a robot model, and the registry of models by name.

A model is one file: its parameters, its dynamics for the expert (SymPy), its motion under held controls for the
simulation (a kernel), and the motion primitives of the search. `register` adds a model from outside the package.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numba import types
from pydantic import model_serializer, model_validator

from leapnav.envs.kernels.types import CONSTANT, NOTHING, VECTOR
from leapnav.envs.robots.footprints import Disc, Footprint, outline_of
from leapnav.envs.robots.moves import Moves, rotating_moves
from leapnav.envs.utils.records import Frozen, Positive
from leapnav.envs.utils.validation import suggestion

if TYPE_CHECKING:
    import sympy as sp

# advance(q, u, h, parameters, new): write the state (n,) after the controls u (m,) were held for the time h (s) to
# `new`. `new` may be `q`.
ADVANCE_SIGNATURE = NOTHING(VECTOR, VECTOR, types.float64, CONSTANT, VECTOR)
# state_cost(q, parameters) -> the part of the running cost that depends on the state, without the proximity cost.
STATE_COST_SIGNATURE = types.float64(VECTOR, CONSTANT)
POSE = ("x", "y", "heading")  # the first states of every robot


class CostWeights(Protocol):
    """The weights of the running cost that robot models read, see `leapnav.envs.Cost`."""

    @property
    def speed_weight(self) -> float: ...  # noqa: D102
    @property
    def turn_weight(self) -> float: ...  # noqa: D102


@dataclass(frozen=True)
class Dynamics:
    """The dynamics q' = a(q) + sum_j u_j b_j(q) of a model in SymPy symbols.

    Attributes:
        state: the n state symbols; the first three are x, y and the heading.
        drift: a(q), n expressions.
        fields: b_j(q), n expressions for each of the m controls.
        parameters: the symbols of the model's `parameters`.
        state_cost: part of the running cost that depends on the state, in the symbols of state and parameters.
        labels: names of the states and controls with units, in Matplotlib's mathtext.

    """

    state: tuple[sp.Symbol, ...]
    drift: tuple[Any, ...]
    fields: tuple[tuple[Any, ...], ...]
    parameters: tuple[sp.Symbol, ...] = ()
    state_cost: Any = 0
    labels: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Symmetry:
    """How a symmetry of the plane changes the motion of a robot.

    Attributes:
        motion: factors (n - 3) of the further states; a heading is relative to that of the robot.
        controls: rows (m, m) of the matrix that maps the controls.

    """

    motion: tuple[float, ...]
    controls: tuple[tuple[float, ...], ...]


def magnitude(interval: tuple[float, float]) -> float:
    """Return the largest absolute value in an interval."""
    return max(-interval[0], interval[1])


def least_magnitude(interval: tuple[float, float]) -> float:
    """Return the smallest absolute value in an interval."""
    return max(interval[0], -interval[1], 0.0)


class RobotModel(Frozen):
    """A wheeled robot: the base class of all models.

    The state is q = (x, y, heading, further states). Actions are in [-1, 1], from the lowest to the highest value of
    each control.

    Args:
        model: name of the model.
        radius: radius (m) of a robot that is one disc around (x, y).
        footprint: another outline, instead of `radius`: discs (`Disc`) along the robot's axis, or a rectangle (`Box`).

    Attributes:
        state_names: names of the n states, those of POSE first. Further states are observed as `motion`.
        control_names: names of the m controls.
        state_units, control_units: their units.
        goal_motion: goal values of the further states; None leaves a state free.
        limited: names of the limited quantities; `limits` returns their intervals unless a model overrides it. Each has
            two fields: the interval (lowest, highest), and the largest absolute value `max_...`, which is used if the
            interval is None.
        limited_states: the same for further states, whose limits are optional: without them, both fields are None.
        cost_fields: names of the weights of `leapnav.envs.Cost` that the model uses, besides the proximity cost.
        advance: kernel of ADVANCE_SIGNATURE, exact or to 1e-9.
        state_cost: kernel of STATE_COST_SIGNATURE, or None without a state cost.
        heading_states: names of the further states that are headings in the plane, such as that of a trailer. They are
            observed relative to the robot's heading, and their goals hold modulo 2 pi.
        mirror: the mirror image (left and right exchanged) of a path of the robot is also one, with these changes;
            None if that is no symmetry.
        reversal: the same for all headings rotated by 180 degrees: the robot follows the same path backwards.
        velocity_states: names of the further states, at most two, that are the speed and the turn rate, which a contact
            changes.
        key_controls: the two controls, relative to their limits, with which a person drives ahead and turns left; None
            for the first two.
        is_kinematic: whether a shortest path in the metric of the control weights, on the lattice of `lattice_moves`,
            approximates an optimum. Otherwise candidates are optimised for a kinematic robot first, and then lifted.

    """

    state_names: ClassVar[tuple[str, ...]] = POSE
    control_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad")
    control_units: ClassVar[tuple[str, ...]]
    goal_motion: ClassVar[tuple[float | None, ...]] = ()
    limited: ClassVar[tuple[str, ...]] = ()
    limited_states: ClassVar[tuple[str, ...]] = ()
    cost_fields: ClassVar[tuple[str, ...]] = ("speed_weight", "turn_weight")
    advance: ClassVar[Any]
    state_cost: ClassVar[Any] = None
    heading_states: ClassVar[tuple[str, ...]] = ()
    mirror: ClassVar[Symmetry | None] = None
    reversal: ClassVar[Symmetry | None] = None
    velocity_states: ClassVar[tuple[str, ...]] = ()
    key_controls: ClassVar[tuple[tuple[float, ...], tuple[float, ...]] | None] = None
    is_kinematic: ClassVar[bool] = False

    model: Any = ""  # a literal in each model
    radius: Positive = 0.25
    footprint: Footprint | None = None

    @model_validator(mode="after")
    def _check_alternatives(self) -> Self:
        if self.footprint is not None and "radius" in self.model_fields_set:
            raise ValueError("radius: cannot be combined with footprint, which has a size of its own")
        for name in self._intervals:
            if f"max_{name}" in self.model_fields_set:
                raise ValueError(f"max_{name}: cannot be combined with {name}, which has both limits")
        return self

    @model_serializer(mode="wrap")
    def _serialize(self, handler: Any) -> dict[str, Any]:
        fields = handler(self)
        if self.footprint is not None:
            del fields["radius"]
        for name in (*self.limited, *self.limited_states):
            fields.pop(f"max_{name}" if name in self._intervals else name, None)
            if fields.get(f"max_{name}", 0.0) is None:
                del fields[f"max_{name}"]
        return fields

    def differences(self, here: RobotModel) -> list[str]:
        """Return the parameters in which this robot differs from another one, as "radius 0.3, here 0.25"."""
        other = here.model_dump()
        return [
            f"{name} {value}, here {other.get(name)}"
            for name, value in self.model_dump().items()
            if value != other.get(name)
        ]

    @property
    def _intervals(self) -> list[str]:
        """Names of the limits that are given as intervals."""
        return [name for name in (*self.limited, *self.limited_states) if getattr(self, name) is not None]

    def interval(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest value of one of `limited`, or of `limited_states` with limits."""
        interval: tuple[float, float] | None = getattr(self, name)
        if interval is None:
            largest = float(getattr(self, f"max_{name}"))
            return -largest, largest
        return interval

    def state_bounds(self) -> tuple[tuple[float, float] | None, ...] | None:
        """Return the lowest and the highest value of each state, None without limits; None if no state has limits."""
        given = [n for n in self.limited_states if n in self._intervals or getattr(self, f"max_{n}") is not None]
        bounds = tuple(self.interval(name) if name in given else None for name in self.state_names)
        return bounds if given else None

    def check_motion(self, field: str, values: Sequence[float | None] | None) -> None:
        """Check the further states of a start or a goal; `field` is its name.

        Raises:
            ValueError: their number is wrong, or one is beyond its limits.

        """
        names = self.state_names[3:]
        if values is None:
            return
        if len(values) != len(names):
            expected = f"{len(names)} ({', '.join(names)})" if names else "0"
            raise ValueError(f"{field}: expected {expected} numbers for the robot {self.model!r}, got {values!r}")
        bounds = (self.state_bounds() or (None,) * len(self.state_names))[3:]
        for name, value, pair in zip(names, values, bounds, strict=True):
            low, high = pair or (-math.inf, math.inf)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{field}: expected a {name} from {low:g} to {high:g}, got {value:g}")

    @classmethod
    @abstractmethod
    def dynamics(cls) -> Dynamics:
        """Return the dynamics. SymPy is imported here, not with the module."""

    def limits(self) -> Sequence[float | tuple[float, float]]:
        """Return the limits of each control: (lowest, highest), or the largest absolute value."""
        return [self.interval(name) for name in self.limited]

    @abstractmethod
    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:
        """Return the weights (m,) of the squared controls in the running cost."""

    def control_bounds(self) -> np.ndarray:
        """Return the lowest and the highest value of each control, (m, 2)."""
        pairs = [limit if isinstance(limit, tuple) else (-limit, limit) for limit in self.limits()]
        return np.array(pairs, dtype=float)

    def action_scale(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `middle` and `half` (m,): the control is middle + half * action, with actions in [-1, 1]."""
        bounds = self.control_bounds()
        return bounds.mean(axis=1), (bounds[:, 1] - bounds[:, 0]) / 2

    def actions(self, controls: np.ndarray) -> np.ndarray:
        """Return the actions (..., m) of controls (..., m)."""
        middle, half = self.action_scale()
        return (controls - middle) / half

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the controls (..., m) of actions (..., m)."""
        middle, half = self.action_scale()
        return middle + half * actions

    def has_symmetric_limits(self, symmetry: Symmetry) -> bool:
        """Return whether a symmetry of the motion maps controls and states within their limits to such ones."""
        for factor, pair in zip(symmetry.motion, (self.state_bounds() or ())[3:], strict=False):
            if pair is not None and sorted((factor * pair[0], factor * pair[1])) != list(pair):
                return False
        bounds, matrix = self.control_bounds(), np.array(symmetry.controls, dtype=float)
        ends = np.sort(matrix[:, :, None] * bounds, axis=2)
        return bool(np.array_equal(ends.sum(axis=1), bounds))

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:
        """Return the values of the parameters of `dynamics`."""
        return ()

    def outline(self) -> np.ndarray:
        """Return the footprint as a read-only array (K, 5), see `leapnav.envs.robots.footprints.outline_of`."""
        return outline_of((Disc(radius=self.radius),) if self.footprint is None else self.footprint)

    def metric(self, cost: CostWeights) -> tuple[float, float]:
        """Return the weights of the squared speed and turn rate in the metric of the lattice."""
        return cost.speed_weight, cost.turn_weight

    def speed_limits(self) -> tuple[float, float]:
        """Return bounds of the speed (m/s) and of the turn rate (rad/s); infinite if there are none."""
        return math.inf, math.inf

    def turn_rates(self) -> tuple[float, float]:
        """Return the lowest (clockwise) and the highest turn rate (rad/s)."""
        if "turn_rate" in self.limited:
            return self.interval("turn_rate")
        return -self.speed_limits()[1], self.speed_limits()[1]

    def slowest_speed(self) -> float:
        """Return the smallest possible magnitude of the speed (m/s); it is positive if the robot cannot stop."""
        return least_magnitude(self.interval("speed")) if "speed" in self.limited else 0.0

    def lattice_moves(self, cell: float, speed_weight: float, turn_weight: float) -> Moves:
        """Return the motion primitives on a lattice with cells of the given side (m), in the given metric."""
        return rotating_moves(cell, speed_weight, turn_weight)

    def max_lattice_cell(self) -> float:
        """Return the largest side (m) of a cell with which the moves approximate the motion."""
        return math.inf

    def kinematic(self) -> RobotModel | None:
        """Return a kinematic robot on whose optima the search of this one is based; None for a unicycle."""
        return None

    def lift(self, times: np.ndarray, poses: np.ndarray, start: Sequence[float]) -> np.ndarray | None:
        """Return states (N, n) whose poses are those of a path.

        Args:
            times: (N,), s.
            poses: (N, 3), x, y (m) and unwrapped heading (rad).
            start: the initial state (n,).

        Returns:
            The states; None integrates the further states along the path.

        """
        return None

    @classmethod
    def sizes(cls) -> tuple[int, int]:
        """Return the numbers of states and of controls."""
        return len(cls.state_names), len(cls.control_names)

    @classmethod
    def name(cls) -> str:
        """Return the name of the model."""
        return str(cls.model_fields["model"].default)


MODELS: dict[str, type[RobotModel]] = {}


Model = TypeVar("Model", bound=RobotModel)


def register(model: type[Model]) -> type[Model]:
    """Register a robot model under the default of its field `model`; usable as a class decorator.

    Processes that read its scenarios must import the file that defines it.

    Raises:
        ValueError: another class has this name, or the names, units or signs have inconsistent lengths.

    """
    name = model.name()
    known = MODELS.get(name)
    if known is not None and known.__qualname__ != model.__qualname__:
        raise ValueError(f"model: {name!r} is the name of {known.__module__}.{known.__qualname__}")
    n, m = model.sizes()
    if model.state_names[:3] != POSE:
        raise ValueError(f"state_names: expected {', '.join(POSE)} first, got {model.state_names!r}")
    lengths: dict[str, tuple[tuple[Any, ...], int]] = {
        "state_units": (model.state_units, n),
        "control_units": (model.control_units, m),
        "goal_motion": (model.goal_motion, n - 3),
    }
    for attribute, symmetry in (("mirror", model.mirror), ("reversal", model.reversal)):
        if symmetry is not None:
            lengths[f"{attribute}.motion"] = symmetry.motion, n - 3
            lengths[f"{attribute}.controls"] = symmetry.controls, m
    for attribute, (values, length) in lengths.items():
        if len(values) != length:
            raise ValueError(f"{attribute}: expected {length} entries for {name!r}, got {values!r}")
    MODELS[name] = model
    return model


def robot_class(name: Any) -> type[RobotModel]:
    """Return the class of a model.

    Raises:
        ValueError: there is no such model.

    """
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"expected one of {', '.join(MODELS)}, got {name!r}{suggestion(name, MODELS)}")
    return MODELS[name]
