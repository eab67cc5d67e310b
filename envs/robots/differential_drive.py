"""The differential drive: a robot with two driven wheels, commanded by their speeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from leapnav.envs.kernels import kernel
from leapnav.envs.robots.arcs import advance_arc
from leapnav.envs.robots.base import (
    ADVANCE_SIGNATURE,
    CostWeights,
    Dynamics,
    RobotModel,
    Symmetry,
    least_magnitude,
    magnitude,
    register,
)
from leapnav.envs.robots.moves import Moves, curved_moves, driving_modes, rotating_moves
from leapnav.envs.robots.unicycle import POSE_LABELS
from leapnav.envs.utils.records import Interval, Positive


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    """Follow a circular arc."""
    distance, turn = 0.5 * (u[0] + u[1]) * h, (u[1] - u[0]) / parameters[0] * h
    new[0], new[1], new[2] = advance_arc(q[0], q[1], q[2], distance, turn)


@register
class DifferentialDrive(RobotModel):
    """A robot whose controls are the speeds of its wheels: q = (x, y, theta), u = (left, right).

    x' = v cos(theta), y' = v sin(theta), theta' = omega with v = (left + right) / 2 and omega = (right - left) / track.
    The running cost is 1/2 (speed_weight / 2) (left^2 + right^2) = 1/2 (speed_weight v^2 + turn_weight omega^2) with
    turn_weight = speed_weight track^2 / 4.

    Args:
        model: "differential_drive".
        radius, footprint: see `RobotModel`.
        max_wheel_speed, wheel_speed: largest speed of each wheel (m/s), forwards and backwards, or instead (lowest,
            highest).
        track: distance between the wheels (m).

    """

    control_names: ClassVar[tuple[str, ...]] = ("left_wheel_speed", "right_wheel_speed")
    control_units: ClassVar[tuple[str, ...]] = ("m/s", "m/s")
    cost_fields: ClassVar[tuple[str, ...]] = ("speed_weight",)
    advance: ClassVar = advance
    mirror: ClassVar[Symmetry | None] = Symmetry((), ((0, 1), (1, 0)))
    reversal: ClassVar[Symmetry | None] = Symmetry((), ((0, -1), (-1, 0)))
    key_controls: ClassVar[tuple[tuple[float, ...], tuple[float, ...]] | None] = ((1, 1), (-1, 1))
    is_kinematic: ClassVar[bool] = True
    limited: ClassVar[tuple[str, ...]] = ("wheel_speed",)

    model: Literal["differential_drive"] = "differential_drive"
    max_wheel_speed: Positive = 2.0
    wheel_speed: Interval | None = None
    track: Positive = 0.4

    @classmethod
    def dynamics(cls) -> Dynamics:  # noqa: D102 (the interface is documented in the base class)
        import sympy as sp

        x, y, theta, track = sp.symbols("x y theta track")
        return Dynamics(
            state=(x, y, theta),
            drift=(0, 0, 0),
            fields=(
                (sp.cos(theta) / 2, sp.sin(theta) / 2, -1 / track),
                (sp.cos(theta) / 2, sp.sin(theta) / 2, 1 / track),
            ),
            parameters=(track,),
            labels=(*POSE_LABELS, "left wheel (m/s)", "right wheel (m/s)"),
        )

    def limits(self) -> Sequence[tuple[float, float]]:  # noqa: D102
        return [self.interval("wheel_speed")] * 2

    def control_weight(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return cost.speed_weight / 2, cost.speed_weight / 2

    def parameters(self, cost: CostWeights) -> tuple[float, ...]:  # noqa: D102
        return (self.track,)

    def metric(self, cost: CostWeights) -> tuple[float, float]:  # noqa: D102
        return cost.speed_weight, cost.speed_weight * self.track**2 / 4

    def speed_limits(self) -> tuple[float, float]:  # noqa: D102
        low, high = self.interval("wheel_speed")
        return magnitude((low, high)), (high - low) / self.track

    def slowest_speed(self) -> float:  # noqa: D102
        return least_magnitude(self.interval("wheel_speed"))

    def lattice_moves(self, cell: float, speed_weight: float, turn_weight: float) -> Moves:  # noqa: D102
        low, high = self.interval("wheel_speed")
        if low < 0.0 < high:
            return rotating_moves(cell, speed_weight, turn_weight)
        radius = abs(high + low) / (high - low) * self.track / 2  # with one wheel at each limit
        return curved_moves(cell, speed_weight, turn_weight, (radius, radius), modes=driving_modes((low, high)))
