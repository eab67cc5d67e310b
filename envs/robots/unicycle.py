"""The unicycle: a robot with two driven wheels, commanded by speed and turn rate."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import model_validator

from leapnav.envs.kernels import kernel
from leapnav.envs.robots.arcs import advance_arc
from leapnav.envs.robots.base import (
    ADVANCE_SIGNATURE,
    CostWeights,
    Dynamics,
    RobotModel,
    Symmetry,
    magnitude,
    register,
)
from leapnav.envs.robots.moves import Moves, curved_moves, driving_modes, rotating_moves
from leapnav.envs.utils.records import Interval, Positive

MAX_LATTICE_CELL = 0.25  # smallest turning radii, of a robot that cannot stop
POSE_LABELS = ("$x$ (m)", "$y$ (m)", r"$\theta$ (rad)")


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    """Follow a circular arc."""
    new[0], new[1], new[2] = advance_arc(q[0], q[1], q[2], u[0] * h, u[1] * h)


@register
class Unicycle(RobotModel):
    """A robot that drives along its heading and rotates in place: q = (x, y, theta), u = (v, omega).

    x' = v cos(theta), y' = v sin(theta), theta' = omega, with the cost 1/2 (speed_weight v^2 + turn_weight omega^2).

    Args:
        model: "unicycle".
        radius, footprint: see `RobotModel`.
        max_speed, speed: largest speed (m/s), forwards and backwards, or instead (lowest, highest) speed. With a
            positive lowest speed the robot can neither stop nor reverse nor rotate in place.
        max_turn_rate, turn_rate: largest turn rate (rad/s), to either side, or instead (lowest, highest).

    """

    control_names: ClassVar[tuple[str, ...]] = ("speed", "turn_rate")
    control_units: ClassVar[tuple[str, ...]] = ("m/s", "rad/s")
    advance: ClassVar = advance
    mirror: ClassVar[Symmetry | None] = Symmetry((), ((1, 0), (0, -1)))
    reversal: ClassVar[Symmetry | None] = Symmetry((), ((-1, 0), (0, 1)))
    is_kinematic: ClassVar[bool] = True
    limited: ClassVar[tuple[str, ...]] = ("speed", "turn_rate")

    model: Literal["unicycle"] = "unicycle"
    max_speed: Positive = 2.0
    speed: Interval | None = None
    max_turn_rate: Positive = 3.0
    turn_rate: Interval | None = None

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102 (the interface is documented in the base class)
        import sympy as sp

        x, y, theta = sp.symbols("x y theta")
        return Dynamics(
            state=(x, y, theta),
            drift=(0, 0, 0),
            fields=((sp.cos(theta), sp.sin(theta), 0), (0, 0, 1)),
            labels=(*POSE_LABELS, "$v$ (m/s)", r"$\omega$ (rad/s)"),
        )

    @model_validator(mode="after")
    def _check_turn_rate(self) -> Self:
        low, high = self.interval("turn_rate")
        if not low < 0.0 < high:
            raise ValueError(f"turn_rate: expected an interval that contains 0 inside, got {[low, high]}")
        return self

    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return cost.speed_weight, cost.turn_weight

    def speed_limits(self) -> tuple[float, float]:  # noqa: D102
        return magnitude(self.interval("speed")), magnitude(self.interval("turn_rate"))

    def lattice_moves(self, cell: float, speed_weight: float, turn_weight: float) -> Moves:  # noqa: D102
        modes = driving_modes(self.interval("speed"))
        if self.slowest_speed() == 0.0:
            return rotating_moves(cell, speed_weight, turn_weight, modes)
        return curved_moves(cell, speed_weight, turn_weight, self._turning_radii, modes)

    def max_lattice_cell(self) -> float:  # noqa: D102
        return MAX_LATTICE_CELL * min(self._turning_radii) if self.slowest_speed() > 0.0 else math.inf

    @property
    def _turning_radii(self) -> tuple[float, float]:
        """Smallest turning radii (m) to the left and to the right."""
        right, left = self.interval("turn_rate")
        return self.slowest_speed() / left, -self.slowest_speed() / right
