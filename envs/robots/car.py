"""The car: the kinematic bicycle with a limited steering angle and steering rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from numba import float64
from pydantic import Field

from leapnav.envs.kernels import kernel
from leapnav.envs.robots.arcs import GAUSS_NODES, GAUSS_WEIGHTS, MAX_PANEL_TURN, rotation
from leapnav.envs.robots.base import (
    ADVANCE_SIGNATURE,
    POSE,
    CostWeights,
    Dynamics,
    RobotModel,
    Symmetry,
    magnitude,
    register,
)
from leapnav.envs.robots.moves import Moves, curved_moves, driving_modes
from leapnav.envs.robots.unicycle import POSE_LABELS
from leapnav.envs.utils.records import Interval, Positive

MAX_LATTICE_CELL = 0.25  # minimum turning radii: larger cells would make the lattice's turns much too wide


@kernel(float64(float64, float64, float64))
def mean_sine(sine, cosine, x):
    """Return the mean of sin(s + y) for y from 0 to x, from sin(s) and cos(s)."""
    square = x * x
    if square > MAX_PANEL_TURN**2:
        along, across = math.sin(x) / x, (1.0 - math.cos(x)) / x
    else:  # series with errors below 1e-11
        along = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        across = 0.5 * x * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)))
    return sine * along + cosine * across


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    """Integrate exactly: the heading in closed form, the position by Gauss's rule."""
    x, y, heading, steering = q[0], q[1], q[2], q[3]
    speed, rate, curvature = u[0], u[1], parameters[0]
    sine, cosine = math.sin(steering), math.cos(steering)
    scale = speed * curvature
    panels = max(math.ceil(abs(scale * h) / MAX_PANEL_TURN), math.ceil(abs(rate * h) / MAX_PANEL_TURN))
    panels = max(panels, 1)
    dx = dy = 0.0  # along and across the heading at the start
    for panel in range(panels):
        for k in range(len(GAUSS_NODES)):
            t = (panel + GAUSS_NODES[k]) / panels * h
            along, across = rotation(scale * t * mean_sine(sine, cosine, rate * t))
            dx += GAUSS_WEIGHTS[k] * along
            dy += GAUSS_WEIGHTS[k] * across
    distance, cos, sin = speed * h / panels, math.cos(heading), math.sin(heading)
    new[0], new[1] = x + distance * (cos * dx - sin * dy), y + distance * (sin * dx + cos * dy)
    new[2] = heading + scale * h * mean_sine(sine, cosine, rate * h)
    new[3] = steering + rate * h


@register
class Car(RobotModel):
    """A car with the kinematics of a bicycle: q = (x, y, theta, s), u = (v, s').

    (x, y) is the middle of the rear axle, x' = v cos(theta), y' = v sin(theta), theta' = v tan(delta) / wheelbase. The
    steering angle delta is limited through the steering state s, tan(delta) = tan(max_steering) sin(s), so that no
    state constraint is needed. The running cost is 1/2 (speed_weight v^2 + steering_weight s'^2).

    Args:
        model: "car".
        radius, footprint: see `RobotModel`.
        wheelbase: distance between the axles (m).
        max_steering: largest steering angle (rad), below pi / 2.
        max_speed, speed: largest speed (m/s), forwards and backwards, or instead (lowest, highest) speed; a positive
            lowest speed means that the car can neither stop nor reverse.
        max_steering_rate, steering_rate: largest rate of the steering state (rad/s), or (lowest, highest).
        steering_weight: cost weight of the squared rate of the steering state.

    """

    state_names: ClassVar[tuple[str, ...]] = (*POSE, "steering")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "rad")
    control_names: ClassVar[tuple[str, ...]] = ("speed", "steering_rate")
    control_units: ClassVar[tuple[str, ...]] = ("m/s", "rad/s")
    goal_motion: ClassVar[tuple[float | None, ...]] = (None,)
    cost_fields: ClassVar[tuple[str, ...]] = ("speed_weight",)
    advance: ClassVar = advance
    mirror: ClassVar[Symmetry | None] = Symmetry((-1,), ((1, 0), (0, -1)))
    # With the negated speed, the same turn rate needs the opposite steering.
    reversal: ClassVar[Symmetry | None] = Symmetry((-1,), ((-1, 0), (0, -1)))
    is_kinematic: ClassVar[bool] = True

    limited: ClassVar[tuple[str, ...]] = ("speed", "steering_rate")

    model: Literal["car"] = "car"
    wheelbase: Positive = 0.5
    max_steering: Annotated[float, Field(gt=0, lt=math.pi / 2)] = 0.6
    max_speed: Positive = 2.0
    speed: Interval | None = None
    max_steering_rate: Positive = 4.0
    steering_rate: Interval | None = None
    steering_weight: Positive = 0.2

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102 (the interface is documented in the base class)
        import sympy as sp

        x, y, theta, s, curvature = sp.symbols("x y theta s curvature")
        return Dynamics(
            state=(x, y, theta, s),
            drift=(0, 0, 0, 0),
            fields=((sp.cos(theta), sp.sin(theta), curvature * sp.sin(s), 0), (0, 0, 0, 1)),
            parameters=(curvature,),
            labels=(*POSE_LABELS, "$s$ (rad)", "$v$ (m/s)", r"$\dot s$ (rad/s)"),
        )

    @property
    def max_curvature(self) -> float:
        """Largest curvature of the path (1/m)."""
        return math.tan(self.max_steering) / self.wheelbase

    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return cost.speed_weight, self.steering_weight

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return (self.max_curvature,)

    def metric(self, cost: CostWeights) -> tuple[float, float]:  # noqa: D102
        # The cost of rotation is that of the arcs, which the moves contain; a part of it for changes at start and goal.
        return cost.speed_weight, 0.25 * cost.speed_weight / self.max_curvature**2

    def speed_limits(self) -> tuple[float, float]:  # noqa: D102
        speed = magnitude(self.interval("speed"))
        return speed, speed * self.max_curvature

    def lattice_moves(self, cell: float, speed_weight: float, turn_weight: float) -> Moves:  # noqa: D102
        radius = 1.0 / self.max_curvature
        return curved_moves(cell, speed_weight, 0.0, (radius, radius), modes=driving_modes(self.interval("speed")))

    def max_lattice_cell(self) -> float:  # noqa: D102
        return MAX_LATTICE_CELL / self.max_curvature

    def lift(self, times: np.ndarray, poses: np.ndarray, start: Sequence[float]) -> np.ndarray:
        """Return the path with the steering of its curvature, limited and smoothed."""
        step = np.diff(poses, axis=0)
        middle = (poses[1:, 2] + poses[:-1, 2]) / 2
        along = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
        distance = np.hypot(step[:, 0], step[:, 1])
        curvature = np.where(along < 0, -1.0, 1.0) * step[:, 2] / np.maximum(distance, 1e-9)
        sine = np.clip(curvature / self.max_curvature, -1.0, 1.0)
        # Means over three steps: a lattice path alternates between straight and curved moves.
        sine = np.convolve(np.pad(sine, 1, mode="edge"), np.full(3, 1 / 3), mode="valid")
        steering = np.arcsin(np.interp(times, (times[1:] + times[:-1]) / 2, sine))
        steering[0] = start[3]
        return np.column_stack([poses, steering])
