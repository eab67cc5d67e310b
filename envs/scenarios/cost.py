"""Weights of the running cost of a scenario."""

from __future__ import annotations

import math

from leapnav.envs.robots import RobotModel
from leapnav.envs.utils.records import Frozen, NotNegative, Positive


class Cost(Frozen):
    """Weights of the running cost c + 1/2 (speed_weight v^2 + turn_weight omega^2) + Phi(q), see the robot's model.

    The time weight c is the cost per second. With the proximity weight 0, the obstacles are hard constraints: they cost
    nothing, but a path must not touch them.
    """

    speed_weight: Positive = 1.0
    turn_weight: Positive = 0.5
    proximity_weight: NotNegative = 1.0
    proximity_scale: Positive = 0.1
    time_weight: NotNegative = 0.0

    @property
    def obstacles(self) -> str:
        """Whether the obstacles are "hard" constraints and cost nothing, or have a proximity "cost"."""
        return "hard" if self.proximity_weight == 0 else "cost"


def cruise_speed(robot: RobotModel, cost: Cost) -> float:
    """Return the speed (m/s) at which c = 1/2 speed_weight v^2, within the limits of the robot.

    An optimum with a free horizon has H = 0, hence this speed on a straight line without obstacles.
    """
    optimal = math.sqrt(2.0 * cost.time_weight / robot.metric(cost)[0])
    return min(max(optimal, robot.slowest_speed()), robot.speed_limits()[0])
