"""The dynamic unicycle: a robot with inertia, commanded by its accelerations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from numba import float64
from pydantic import model_validator

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import NOTHING, VECTOR
from leapnav.envs.robots.arcs import GAUSS_NODES, GAUSS_WEIGHTS, MAX_PANEL_TURN, rotation, until_limit
from leapnav.envs.robots.base import (
    ADVANCE_SIGNATURE,
    POSE,
    STATE_COST_SIGNATURE,
    CostWeights,
    Dynamics,
    RobotModel,
    Symmetry,
    magnitude,
    register,
)
from leapnav.envs.robots.unicycle import POSE_LABELS
from leapnav.envs.utils.records import MAX_MAGNITUDE, Interval, Positive


@kernel(NOTHING(VECTOR, float64, float64, float64, VECTOR), forceinline=True)
def _accelerate(q, acceleration, angular, h, new):
    """Integrate exactly: speed, turn rate and heading in closed form, the position by Gauss's rule."""
    x, y, heading, speed, turn_rate = q[0], q[1], q[2], q[3], q[4]
    panels = math.ceil((abs(turn_rate) + abs(angular) * h) * h / MAX_PANEL_TURN)
    panels = max(panels, 1)
    dx = dy = 0.0  # along and across the heading at the start
    for panel in range(panels):
        for k in range(len(GAUSS_NODES)):
            t = (panel + GAUSS_NODES[k]) / panels * h
            along, across = rotation((turn_rate + 0.5 * angular * t) * t)
            driven = GAUSS_WEIGHTS[k] * (speed + acceleration * t)
            dx += driven * along
            dy += driven * across
    panel_time, cos, sin = h / panels, math.cos(heading), math.sin(heading)
    new[0], new[1] = x + panel_time * (cos * dx - sin * dy), y + panel_time * (sin * dx + cos * dy)
    new[2] = heading + (turn_rate + 0.5 * angular * h) * h
    new[3], new[4] = speed + acceleration * h, turn_rate + angular * h


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    """Accelerate; the speed and the turn rate stay at their limits."""
    for i in range(5):
        new[i] = q[i]
    left = h
    for _ in range(3):  # up to the limits of both
        acceleration, first = until_limit(new[3], u[0], parameters[2], parameters[3], left)
        angular, second = until_limit(new[4], u[1], parameters[4], parameters[5], left)
        step = min(first, second)
        _accelerate(new, acceleration, angular, step, new)
        left -= step
        if left <= 0.0:
            break
        if first == step:
            new[3] = parameters[3] if u[0] > 0.0 else parameters[2]
        if second == step:
            new[4] = parameters[5] if u[1] > 0.0 else parameters[4]


@kernel(STATE_COST_SIGNATURE)
def state_cost(q, parameters):
    """Return the cost of speed and turn rate."""
    return 0.5 * (parameters[0] * q[3] * q[3] + parameters[1] * q[4] * q[4])


@register
class DynamicUnicycle(RobotModel):
    """A unicycle with inertia: q = (x, y, theta, v, omega), u = (v', omega').

    It starts at rest and has to be at rest at the horizon. The running cost is 1/2 (speed_weight v^2 + turn_weight
    omega^2 + acceleration_weight v'^2 + angular_acceleration_weight omega'^2).

    Args:
        model: "dynamic_unicycle".
        radius, footprint: see `RobotModel`.
        max_acceleration, acceleration: largest acceleration (m/s^2) along the heading, or instead (lowest, highest).
        max_angular_acceleration, angular_acceleration: largest angular acceleration (rad/s^2), or (lowest, highest).
        acceleration_weight: cost weight of the squared acceleration.
        angular_acceleration_weight: cost weight of the squared angular acceleration.
        max_speed, speed: largest speed (m/s), or instead (lowest, highest), with 0 inside; None for no limit. The robot
            does not accelerate beyond it.
        max_turn_rate, turn_rate: the same for the turn rate (rad/s).

    """

    state_names: ClassVar[tuple[str, ...]] = (*POSE, "speed", "turn_rate")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s", "rad/s")
    control_names: ClassVar[tuple[str, ...]] = ("acceleration", "angular_acceleration")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s^2")
    goal_motion: ClassVar[tuple[float | None, ...]] = (0.0, 0.0)
    velocity_states: ClassVar[tuple[str, ...]] = ("speed", "turn_rate")
    advance: ClassVar = advance
    state_cost: ClassVar = state_cost
    mirror: ClassVar[Symmetry | None] = Symmetry((1, -1), ((1, 0), (0, -1)))
    reversal: ClassVar[Symmetry | None] = Symmetry((-1, 1), ((-1, 0), (0, 1)))
    limited: ClassVar[tuple[str, ...]] = ("acceleration", "angular_acceleration")
    limited_states: ClassVar[tuple[str, ...]] = ("speed", "turn_rate")

    model: Literal["dynamic_unicycle"] = "dynamic_unicycle"
    max_acceleration: Positive = 3.0
    acceleration: Interval | None = None
    max_angular_acceleration: Positive = 12.0
    angular_acceleration: Interval | None = None
    acceleration_weight: Positive = 0.1
    angular_acceleration_weight: Positive = 0.02
    max_speed: Positive | None = None
    speed: Interval | None = None
    max_turn_rate: Positive | None = None
    turn_rate: Interval | None = None

    @model_validator(mode="after")
    def _check_rest(self) -> Self:
        for name, pair in zip(self.state_names, self.state_bounds() or (), strict=False):
            if pair is not None and not pair[0] < 0.0 < pair[1]:
                raise ValueError(f"{name}: expected an interval that contains 0 inside, got {list(pair)}")
        return self

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102 (the interface is documented in the base class)
        import sympy as sp

        x, y, theta, v, omega = sp.symbols("x y theta v omega")
        weights = speed_weight, turn_weight = sp.symbols("speed_weight turn_weight")
        limits = sp.symbols("speed_low speed_high turn_rate_low turn_rate_high")  # only `advance` uses them
        labels = ("$v$ (m/s)", r"$\omega$ (rad/s)", r"$\dot v$ (m/s$^2$)", r"$\dot\omega$ (rad/s$^2$)")
        return Dynamics(
            state=(x, y, theta, v, omega),
            drift=(v * sp.cos(theta), v * sp.sin(theta), omega, 0, 0),
            fields=((0, 0, 0, 1, 0), (0, 0, 0, 0, 1)),
            parameters=(*weights, *limits),
            state_cost=(speed_weight * v**2 + turn_weight * omega**2) / 2,
            labels=(*POSE_LABELS, *labels),
        )

    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return self.acceleration_weight, self.angular_acceleration_weight

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        speed, turn_rate = (self.state_bounds() or (None,) * 5)[3:]
        free = -MAX_MAGNITUDE, MAX_MAGNITUDE
        return cost.speed_weight, cost.turn_weight, *(speed or free), *(turn_rate or free)

    def speed_limits(self) -> tuple[float, float]:  # noqa: D102
        speed, turn_rate = (self.state_bounds() or (None,) * 5)[3:]
        free = -math.inf, math.inf
        return magnitude(speed or free), magnitude(turn_rate or free)

    def lift(self, times: np.ndarray, poses: np.ndarray, start: Sequence[float]) -> np.ndarray:
        """Return the path with the speed and turn rate of its motion, at rest at its ends."""
        step, interval = np.diff(poses, axis=0), np.diff(times)
        middle = (poses[1:, 2] + poses[:-1, 2]) / 2
        speed = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / interval
        motion = []
        for k, values in enumerate((speed, step[:, 2] / interval)):
            at_times = np.interp(times, (times[1:] + times[:-1]) / 2, values)
            at_times[0], at_times[-1] = start[3 + k], 0.0
            motion.append(at_times)
        return np.column_stack([poses, *motion])
