"""The dynamic car: a car with inertia, commanded by its acceleration and the rate of its steering."""

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
    Symmetry,
    register,
)
from leapnav.envs.robots.car import Car
from leapnav.envs.robots.unicycle import POSE_LABELS
from leapnav.envs.utils.records import Interval, Positive


@kernel(float64(float64, float64, float64, float64, float64))
def _turned(speed, acceleration, steering, rate, t):
    """Return the integral of v sin(s) over a time t, by Gauss's rule."""
    total = 0.0
    for j in range(len(GAUSS_NODES)):
        at = GAUSS_NODES[j] * t
        total += GAUSS_WEIGHTS[j] * (speed + acceleration * at) * math.sin(steering + rate * at)
    return total * t


@kernel(NOTHING(VECTOR, float64, float64, float64, float64, VECTOR))
def _accelerate(q, acceleration, rate, h, curvature, new):
    """Integrate to 1e-9: speed and steering in closed form, heading and position by Gauss's rule; `new` may be `q`."""
    largest = (abs(q[4]) + abs(acceleration) * h) * curvature * h
    panels = max(math.ceil(max(largest, abs(rate) * h) / MAX_PANEL_TURN), 1)
    x, y, heading, steering, speed = q[0], q[1], q[2], q[3], q[4]
    part = h / panels
    for _ in range(panels):
        dx = dy = 0.0  # along and across the heading at the start
        for k in range(len(GAUSS_NODES)):
            t = GAUSS_NODES[k] * part
            along, across = rotation(curvature * _turned(speed, acceleration, steering, rate, t))
            driven = GAUSS_WEIGHTS[k] * part * (speed + acceleration * t)
            dx += driven * along
            dy += driven * across
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = x + cos * dx - sin * dy, y + sin * dx + cos * dy
        heading += curvature * _turned(speed, acceleration, steering, rate, part)
        steering, speed = steering + rate * part, speed + acceleration * part
    new[0], new[1], new[2], new[3], new[4] = x, y, heading, steering, speed


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    """Accelerate; the speed stays at its limits."""
    acceleration, first = until_limit(q[4], u[0], parameters[2], parameters[3], h)
    _accelerate(q, acceleration, u[1], first, parameters[0], new)
    if first < h:
        new[4] = parameters[3] if acceleration > 0.0 else parameters[2]
        _accelerate(new, 0.0, u[1], h - first, parameters[0], new)


@kernel(STATE_COST_SIGNATURE)
def state_cost(q, parameters):
    """Return the cost of the speed."""
    return 0.5 * parameters[1] * q[4] * q[4]


@register
class DynamicCar(Car):
    """A car with inertia: q = (x, y, theta, s, v), u = (v', s').

    It starts at rest and has to be at rest at the horizon. Its motion is that of `Car`, whose speed v is a state here.
    The running cost is 1/2 (speed_weight v^2 + acceleration_weight v'^2 + steering_weight s'^2).

    Args:
        model: "dynamic_car".
        max_acceleration, acceleration: largest acceleration (m/s^2) along the heading, or instead (lowest, highest).
        acceleration_weight: cost weight of the squared acceleration.
        max_speed, speed: largest speed (m/s), forwards and backwards, or instead (lowest, highest), with 0 inside. The
            car does not accelerate beyond it.
        radius, footprint, wheelbase, max_steering, max_steering_rate, steering_rate, steering_weight: see `Car`.

    """

    state_names: ClassVar[tuple[str, ...]] = (*POSE, "steering", "speed")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "rad", "m/s")
    control_names: ClassVar[tuple[str, ...]] = ("acceleration", "steering_rate")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s")
    goal_motion: ClassVar[tuple[float | None, ...]] = (None, 0.0)
    velocity_states: ClassVar[tuple[str, ...]] = ("speed",)
    advance: ClassVar = advance
    state_cost: ClassVar = state_cost
    mirror: ClassVar[Symmetry | None] = Symmetry((-1, 1), ((1, 0), (0, -1)))
    reversal: ClassVar[Symmetry | None] = Symmetry((-1, -1), ((-1, 0), (0, -1)))
    is_kinematic: ClassVar[bool] = False
    limited: ClassVar[tuple[str, ...]] = ("acceleration", "steering_rate")
    limited_states: ClassVar[tuple[str, ...]] = ("speed",)

    model: Literal["dynamic_car"] = "dynamic_car"  # type: ignore[assignment]
    max_acceleration: Positive = 3.0
    acceleration: Interval | None = None
    acceleration_weight: Positive = 0.1

    @model_validator(mode="after")
    def _check_rest(self) -> Self:
        low, high = self.interval("speed")
        if not low < 0.0 < high:
            raise ValueError(f"speed: expected an interval that contains 0 inside, got {[low, high]}")
        return self

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102 (the interface is documented in the base class)
        import sympy as sp

        x, y, theta, s, v, curvature, speed_weight = sp.symbols("x y theta s v curvature speed_weight")
        limits = sp.symbols("speed_low speed_high")  # only `advance` uses them
        return Dynamics(
            state=(x, y, theta, s, v),
            drift=(v * sp.cos(theta), v * sp.sin(theta), curvature * v * sp.sin(s), 0, 0),
            fields=((0, 0, 0, 0, 1), (0, 0, 0, 1, 0)),
            parameters=(curvature, speed_weight, *limits),
            state_cost=speed_weight * v**2 / 2,
            labels=(*POSE_LABELS, "$s$ (rad)", "$v$ (m/s)", r"$\dot v$ (m/s$^2$)", r"$\dot s$ (rad/s)"),
        )

    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return self.acceleration_weight, self.steering_weight

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return (self.max_curvature, cost.speed_weight, *self.interval("speed"))

    def kinematic(self) -> Car:
        """Return the car without inertia."""
        names = set(Car.model_fields) & self.model_fields_set - {"model"}
        return Car(**{name: getattr(self, name) for name in names})

    def lift(self, times: np.ndarray, poses: np.ndarray, start: Sequence[float]) -> np.ndarray:
        """Return the path with the steering of its curvature and the speed of its motion, at rest at its ends."""
        states = super().lift(times, poses, start)
        step, middle = np.diff(poses, axis=0), (poses[1:, 2] + poses[:-1, 2]) / 2
        along = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / np.diff(times)
        speed = np.interp(times, (times[1:] + times[:-1]) / 2, along)
        speed[0], speed[-1] = start[4], 0.0
        return np.column_stack([states, speed])
