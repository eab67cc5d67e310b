"""The least effort of optimal actions with a free horizon."""

from __future__ import annotations

from leapnav.envs.scenarios.scenario import Scenario


def effort_weights(scenario: Scenario) -> tuple[float, ...] | None:
    """Return the weights (m,) w of the squared actions with which an optimal action a has sum(w a^2) >= 1.

    None if the horizon is fixed, if the robot has drift or a state cost, or if 0 is not in the middle of its limits.
    """
    robot, cost = scenario.robot, scenario.cost
    dynamics = type(robot).dynamics()
    middle, half = robot.action_scale()
    if scenario.horizon is not None or any(dynamics.drift) or dynamics.state_cost != 0 or middle.any():
        return None
    largest = [r * u**2 for r, u in zip(robot.control_weight(cost), half.tolist(), strict=True)]
    # If a limit is below the optimal speed, the effort at that limit is smaller.
    least = min(2.0 * cost.time_weight, *largest)
    return tuple(value / least for value in largest)
