"""Episodes on the page of `leapnav play`: a policy or a person drives, and the regret compares it with the optimum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import is_finite_number
from leapnav.experts.data.demonstrations import state_of
from leapnav.experts.optimum import find_reached_optimum

MAX_DRIVE_HORIZON = 300.0  # s
CONTROL_PERIOD = 0.05  # s, of a person's actions: the default of the environment
MAX_ACTION = 1.0


def play_policy(scenario: Scenario, policy: str) -> dict[str, Any]:
    """Play an episode of a policy.

    Args:
        scenario: the scenario.
        policy: name or directory of the policy, see `leapnav.training.scoring.policy_specs`.

    Returns:
        A dictionary: `policy`, `states` (x, y (m), heading (rad)) at intervals of `period` (s), `time` (s) of the last
        state, `success`, `collision`, `stopped` (whether the episode ended early without a collision), `cost`, and
        `regret` of a success, see the function `regret`.

    Raises:
        ValueError: the horizon is too long.

    """
    from leapnav.envs.episodes import act_with
    from leapnav.envs.navigation import NavigateEnv
    from leapnav.training.policies.files import policy_environment
    from leapnav.training.scoring.policy_specs import BASELINES, make_policy_from_spec

    check_horizon(scenario)
    env = NavigateEnv(scenario=scenario, **({} if policy in BASELINES else policy_environment(policy)))
    return {"policy": policy, **_play(scenario, env, act_with(make_policy_from_spec(policy, env)))}


def replay_actions(scenario: Scenario, actions: Any) -> dict[str, Any]:
    """Replay the actions of a person.

    Args:
        scenario: the scenario.
        actions: a list of pairs (speed, turn rate) as fractions of the robot's limits, one per control period. A list
            that ends before the horizon, or before the goal if the horizon is free, ends the episode as `stopped`.

    Returns:
        As `play_policy`; `policy` is "you".

    Raises:
        ValueError: the horizon is too long, or the actions are invalid.

    """
    from leapnav.envs.episodes import replay
    from leapnav.envs.navigation import NavigateEnv

    check_horizon(scenario)
    limit = MAX_DRIVE_HORIZON if scenario.horizon is None else scenario.horizon
    array = check_actions(actions, math.ceil(limit / CONTROL_PERIOD - 1e-9))
    env = NavigateEnv(scenario=scenario, observation="state", control_period=CONTROL_PERIOD)
    return {"policy": "you", **_play(scenario, env, replay(array))}


def check_horizon(scenario: Scenario) -> None:
    """Raise ValueError if the horizon is too long for an episode on the page."""
    field = "horizon" if scenario.horizon is not None else "time_limit"
    if (limit := scenario.episode_limit) > MAX_DRIVE_HORIZON:
        raise ValueError(f"{field}: expected at most {MAX_DRIVE_HORIZON:g} s for an episode, got {limit:g}")


def check_actions(actions: Any, max_count: int) -> np.ndarray:
    """Return a request's actions as an array (N, 2).

    Raises:
        ValueError: they are not 1 to `max_count` pairs of numbers from -1 to 1.

    """
    if not isinstance(actions, list) or not 1 <= len(actions) <= max_count:
        count = len(actions) if isinstance(actions, list) else type(actions).__name__
        raise ValueError(f"actions: expected 1 to {max_count} pairs of numbers, got {count}")
    for i, action in enumerate(actions):
        is_pair = isinstance(action, list) and len(action) == 2 and all(is_finite_number(value) for value in action)
        if not is_pair or max(map(abs, action)) > MAX_ACTION:
            raise ValueError(f"actions[{i}]: expected two numbers from -1 to 1, got {str(action)[:40]}")
    return np.array(actions, dtype=np.float32)


def _play(scenario: Scenario, env: Any, act: Any) -> dict[str, Any]:
    """Play an episode, close the environment and describe the episode."""
    from leapnav.envs.episodes import play_episode

    try:
        _, info, steps = play_episode(env, act, seed=0)
        states, done = [_pose(info)], False
        for step in steps:
            info, done = step.info, step.done
            states.append(_pose(info))
    finally:
        env.close()
    return _describe(scenario, info, states, done, env.settings.control_period)


def _describe(
    scenario: Scenario, info: dict[str, Any], states: list[list[float]], done: bool, period: float
) -> dict[str, Any]:
    """Return the content of a response, see `play_policy`."""
    success = done and bool(info["is_success"])
    return {
        "states": states,
        "period": period,
        "time": float(info["time"]),
        "success": success,
        "collision": bool(info["collision"]),
        "stopped": not done,
        "cost": float(info["cost"]),
        "regret": regret(scenario, state_of(info), float(info["cost"])) if success else None,
    }


def regret(scenario: Scenario, state: Sequence[float] | np.ndarray, cost: float) -> float | None:
    """Return (J - J*)/J* of a successful episode, with the optimum J* for the state that it reached.

    Args:
        scenario: the scenario of the episode.
        state: the last state: x, y (m), heading (rad), further states of the robot.
        cost: J of the episode.

    Returns:
        The regret. It is negative if the search did not find an optimum as good as the episode. None if no optimum for
        the state is certified.

    """
    try:
        optimum = find_reached_optimum(scenario, state, cost)
    except ScenarioError:  # the state is in contact with an obstacle, up to rounding
        return None
    return (cost - optimum.cost) / optimum.cost if optimum.success and optimum.cost > 0 else None


def _pose(info: dict[str, Any]) -> list[float]:
    return [float(value) for value in info["pose"]]
