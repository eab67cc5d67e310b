"""A car and a unicycle with a trailer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numba import float64
from pydantic import Field, model_validator

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots.base import ADVANCE_SIGNATURE, CostWeights, Dynamics, RobotModel, Symmetry, register
from leapnav.envs.robots.car import Car
from leapnav.envs.robots.car import advance as advance_car
from leapnav.envs.robots.footprints import Disc, Footprint, outline_of
from leapnav.envs.robots.unicycle import Unicycle
from leapnav.envs.robots.unicycle import advance as advance_unicycle
from leapnav.envs.utils.records import Interval, Positive

STEPS = 40.0  # Runge-Kutta steps per radian, or per length of the hitch: an error below 1e-9 rad in a period of 0.05 s
HITCH_LABEL = r"$\beta$ (rad)"
HitchAngle = Annotated[float, Field(gt=0, lt=math.pi)]


@kernel(float64(float64, float64, float64, float64, float64, float64))
def advance_hitch(hitch, pull, turn_rate, steering, steering_rate, h):
    """Hitch angle (rad) after a time, by the classical Runge-Kutta method: beta' = -pull sin(beta) - theta'.

    Args:
        hitch: hitch angle (rad).
        pull: speed divided by the length of the hitch (1/s).
        turn_rate: turn rate (rad/s) of the robot at the largest steering, theta' = turn_rate sin(steering).
        steering, steering_rate: state of the steering (rad), and its rate (rad/s).
        h: time (s).

    """
    steps = max(1.0, math.ceil(STEPS * h * (abs(pull) + abs(turn_rate) + abs(steering_rate))))
    step = h / steps
    for k in range(int(steps)):
        first = turn_rate * math.sin(steering + steering_rate * step * k)
        middle = turn_rate * math.sin(steering + steering_rate * step * (k + 0.5))
        last = turn_rate * math.sin(steering + steering_rate * step * (k + 1))
        k1 = -pull * math.sin(hitch) - first
        k2 = -pull * math.sin(hitch + step / 2.0 * k1) - middle
        k3 = -pull * math.sin(hitch + step / 2.0 * k2) - middle
        k4 = -pull * math.sin(hitch + step * k3) - last
        hitch += step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return hitch


@kernel(ADVANCE_SIGNATURE)
def advance_car_and_trailer(q, u, h, parameters, new):
    """Follow the path of the car exactly, and integrate the hitch angle to 1e-9 rad."""
    hitch = advance_hitch(q[4], u[0] / parameters[1], u[0] * parameters[0], q[3], u[1], h)
    advance_car(q, u, h, parameters, new)
    new[4] = hitch


@kernel(ADVANCE_SIGNATURE)
def advance_unicycle_and_trailer(q, u, h, parameters, new):
    """Follow an arc exactly, and integrate the hitch angle to 1e-9 rad."""
    hitch = advance_hitch(q[3], u[0] / parameters[0], u[1], math.pi / 2.0, 0.0, h)
    advance_unicycle(q, u, h, parameters, new)
    new[3] = hitch


class _Towing(RobotModel):
    """What robots with a trailer have in common: the hitch angle as the last state, and the trailer's footprint."""

    goal_motion: ClassVar[tuple[float | None, ...]] = (None,)
    limited_states: ClassVar[tuple[str, ...]] = ("hitch_angle",)
    reversal: ClassVar[Symmetry | None] = None  # the trailer is not at the other end of the robot

    hitch_length: Positive = 0.6
    trailer: Footprint = (Disc(radius=0.2),)
    max_hitch_angle: HitchAngle | None = None
    hitch_angle: Interval | None = None

    @model_validator(mode="after")
    def _check_hitch_angle(self) -> Self:
        if self.hitch_angle is not None and not -math.pi < self.hitch_angle[0] < 0.0 < self.hitch_angle[1] < math.pi:
            raise ValueError(
                f"hitch_angle: expected an interval in (-pi, pi) that contains 0 inside, got {list(self.hitch_angle)}"
            )
        return self

    def outline(self) -> np.ndarray:
        trailer = outline_of(self.trailer, ahead=-self.hitch_length, joint=len(self.state_names) - 1)
        return constant(np.concatenate([super().outline(), trailer]))

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:
        return (*super().parameters(cost), self.hitch_length)

    def lift(self, times: np.ndarray, poses: np.ndarray, start: Sequence[float]) -> np.ndarray:
        """Return the path with the hitch angles that result from it, from 0 at the end of each part driven backwards.

        Backwards, the hitch angle is unstable, so that these parts are followed in reverse.
        """
        states = super().lift(times, poses, start)
        states = poses if states is None else states
        step, turn = np.diff(poses, axis=0), np.diff(poses[:, 2])
        middle = (poses[1:, 2] + poses[:-1, 2]) / 2
        along = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
        hitch = np.zeros(len(poses))
        hitch[0] = start[-1]
        for k in np.flatnonzero(along < 0.0)[::-1].tolist():
            hitch[k] = self._towed(float(hitch[k + 1]), -float(along[k]), -float(turn[k]))
        for k in np.flatnonzero(along >= 0.0).tolist():
            hitch[k + 1] = self._towed(float(hitch[k]), float(along[k]), float(turn[k]))
        return np.column_stack([states, hitch])

    def _towed(self, hitch: float, ahead: float, turn: float) -> float:
        """Return the hitch angle (rad) after half of a turn (rad), a distance ahead (m), and the other half."""
        hitch = 2.0 * math.atan(math.tan((hitch - turn / 2) / 2) * math.exp(-ahead / self.hitch_length))
        return hitch - turn / 2


@register
class Trailer(_Towing, Car):
    """A car with a trailer: q = (x, y, theta, s, beta), u = (v, s').

    The hitch is at (x, y), the middle of the car's rear axle. The trailer's axle is at the distance `hitch_length`
    behind it, in the direction of the heading theta + beta of the trailer; the hitch angle beta changes by beta' = -v
    sin(beta) / hitch_length - theta' (J.-P. Laumond, ed., Robot Motion Planning and Control, 1998, chapter 1). Driven
    backwards, the trailer folds up unless the car steers against that. In contact with obstacles, robot and trailer are
    one rigid body. The lidar does not see the trailer.

    Args:
        model: "trailer".
        hitch_length: distance (m) from the hitch to the trailer's axle.
        trailer: footprint of the trailer, discs or a rectangle, whose offsets are relative to the middle of its axle.
        max_hitch_angle, hitch_angle: largest hitch angle (rad), to both sides, or instead (lowest, highest); None for
            no limit. It is a limit of the search and of the scenarios; the simulation does not stop the robot there.
        radius, footprint, wheelbase, max_steering, max_speed, speed, max_steering_rate, steering_rate, steering_weight:
            see `Car`.

    """

    state_names: ClassVar[tuple[str, ...]] = (*Car.state_names, "hitch_angle")
    state_units: ClassVar[tuple[str, ...]] = (*Car.state_units, "rad")
    goal_motion: ClassVar[tuple[float | None, ...]] = (None, None)
    advance: ClassVar = advance_car_and_trailer
    mirror: ClassVar[Symmetry | None] = Symmetry((-1, -1), ((1, 0), (0, -1)))

    model: Literal["trailer"] = "trailer"  # pyright: ignore[reportIncompatibleVariableOverride]

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102
        return _towing(Car.dynamics())


@register
class UnicycleTrailer(_Towing, Unicycle):
    """A unicycle with a trailer: q = (x, y, theta, beta), u = (v, omega), see `Trailer`.

    Args:
        model: "unicycle_trailer".
        hitch_length, trailer, max_hitch_angle, hitch_angle: see `Trailer`.
        radius, footprint, max_speed, speed, max_turn_rate, turn_rate: see `Unicycle`.

    """

    state_names: ClassVar[tuple[str, ...]] = (*Unicycle.state_names, "hitch_angle")
    state_units: ClassVar[tuple[str, ...]] = (*Unicycle.state_units, "rad")
    advance: ClassVar = advance_unicycle_and_trailer
    mirror: ClassVar[Symmetry | None] = Symmetry((-1,), ((1, 0), (0, -1)))

    model: Literal["unicycle_trailer"] = "unicycle_trailer"  # pyright: ignore[reportIncompatibleVariableOverride]

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102
        return _towing(Unicycle.dynamics())


def _towing(robot: Dynamics) -> Dynamics:
    """Return the dynamics of a robot with a trailer."""
    import sympy as sp

    hitch, length = sp.symbols("beta hitch_length")
    n = len(robot.state)

    def rate(field: tuple[Any, ...], speed: Any) -> Any:
        return -speed * sp.sin(hitch) / length - field[2]

    ahead, turn = robot.fields
    return Dynamics(
        state=(*robot.state, hitch),
        drift=(*robot.drift, 0),
        fields=((*ahead, rate(ahead, 1)), (*turn, rate(turn, 0))),
        parameters=(*robot.parameters, length),
        labels=(*robot.labels[:n], HITCH_LABEL, *robot.labels[n:]),
    )
