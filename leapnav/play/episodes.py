"""Episodes on the page of `leapnav play`: a policy or a person drives, and the regret compares it with the optimum."""

from __future__ import annotations

import math
import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np

from leapnav.envs.keys import driving_controls
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.validation import is_finite_number
from leapnav.experts.data.demonstrations import state_of
from leapnav.experts.optimum import find_reached_optimum

MAX_DRIVE_HORIZON = 300.0  # s
MAX_COMMANDS = 100  # of a request


def play_policy(scenario: Scenario, policy: str) -> dict[str, Any]:
    """Play an episode of a policy.

    Args:
        scenario: the scenario.
        policy: name or directory of the policy, see `leapnav.training.scoring.policy_specs`.

    Returns:
        A dictionary: `policy`, `states` (x, y (m), heading (rad), further states) at intervals of `period` (s), `time`
        (s) of the last state, `success`, `missed` (what was not reached), `collision`, `stopped` (whether the episode
        ended early without a collision), `cost`, and `regret` of a success, see the function `regret`.

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


class Driving:
    """An episode that a person drives.

    Args:
        scenario: the scenario.

    Attributes:
        id: text that identifies the episode.

    Raises:
        ValueError: the horizon is too long.

    """

    def __init__(self, scenario: Scenario) -> None:
        from leapnav.envs.navigation import NavigateEnv

        check_horizon(scenario)
        self.id = secrets.token_hex(8)
        self._env = NavigateEnv(scenario=scenario, observation="state")
        self._info = self._env.reset(seed=0)[1]
        self._states, self._done = [_pose(self._info)], False
        self._ahead, self._left = driving_controls(type(scenario.robot))

    def described(self) -> dict[str, Any]:
        """Return the content of the response to a start.

        A dictionary: `id`; `states`, with the first pose; `period` (s) of a command; `limit` (s) of the episode;
        `max_commands` of a request.
        """
        env = self._env
        limit = env.scenario.episode_limit
        return {
            "id": self.id,
            "states": self._states[:1],
            "period": env.control_period,
            "limit": limit,
            "max_commands": MAX_COMMANDS,
        }

    def step(self, commands: Any) -> dict[str, Any]:
        """Execute commands, each for one control period, until the end of the episode.

        Args:
            commands: a list of pairs from -1 to 1: ahead and to the left.

        Returns:
            A dictionary: `states`, the poses that follow; `done`, whether the episode has ended.

        Raises:
            ValueError: the commands are invalid.

        """
        count = len(self._states)
        for ahead, left in check_commands(commands):
            if self._done:
                break
            action = np.clip(ahead * self._ahead + left * self._left, -1.0, 1.0)
            _, _, terminated, truncated, self._info = self._env.step(action)
            self._states.append(_pose(self._info))
            self._done = terminated or truncated
        return {"states": self._states[count:], "done": self._done}

    def finish(self) -> dict[str, Any]:
        """Return the episode as `play_policy` does; `policy` is "you". An unfinished episode is `stopped`."""
        settings = self._env.settings
        return {"policy": "you", **_describe(self._env.scenario, self._info, self._states, self._done, settings)}


def check_horizon(scenario: Scenario) -> None:
    """Raise ValueError if the horizon is too long for an episode on the page."""
    field = "horizon" if scenario.horizon is not None else "time_limit"
    if (limit := scenario.episode_limit) > MAX_DRIVE_HORIZON:
        raise ValueError(f"{field}: expected at most {MAX_DRIVE_HORIZON:g} s for an episode, got {limit:g}")


def check_commands(commands: Any) -> np.ndarray:
    """Return the commands of a request as an array (N, 2).

    Raises:
        ValueError: they are not 1 to `MAX_COMMANDS` pairs of numbers from -1 to 1.

    """
    if not isinstance(commands, list) or not 1 <= len(commands) <= MAX_COMMANDS:
        count = len(commands) if isinstance(commands, list) else type(commands).__name__
        raise ValueError(f"commands: expected 1 to {MAX_COMMANDS} pairs of numbers, got {count}")
    for i, command in enumerate(commands):
        is_pair = isinstance(command, list) and len(command) == 2 and all(is_finite_number(value) for value in command)
        if not is_pair or max(map(abs, command)) > 1.0:
            raise ValueError(f"commands[{i}]: expected two numbers from -1 to 1, got {str(command)[:40]}")
    return np.array(commands, dtype=np.float32)


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
    return _describe(scenario, info, states, done, env.settings)


def _describe(
    scenario: Scenario, info: dict[str, Any], states: list[list[float]], done: bool, settings: EnvironmentSettings
) -> dict[str, Any]:
    """Return the content of a response, see `play_policy`."""
    success = done and bool(info["is_success"])
    return {
        "states": states,
        "period": settings.control_period,
        "time": float(info["time"]),
        "success": success,
        "missed": None if success else _missed(scenario, states[-1], settings),
        "collision": bool(info["collision"]),
        "stopped": not done,
        "cost": float(info["cost"]),
        "regret": regret(scenario, state_of(info), float(info["cost"])) if success else None,
    }


def _missed(scenario: Scenario, pose: Sequence[float], settings: EnvironmentSettings) -> str:
    """Return what an episode without success did not reach."""
    distance, heading = math.dist(pose[:2], scenario.goal[:2]), scenario.goal[2]
    if distance > settings.position_tolerance:
        return f"the goal by {distance:.2f} m"
    turn = 0.0 if heading is None else math.remainder(pose[2] - heading, 2 * math.pi)
    return "the heading of the goal" if abs(turn) > settings.heading_tolerance else "the motion of the goal"


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
    """Return x, y, heading and further states, of which the page draws the hitch angle, the last one of a trailer."""
    return [float(value) for value in (*info["pose"], *info.get("motion", ()))]
