"""The environment `leapnav/Navigate-v0`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numba import float64, njit, types

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import FAMILIES, sample_scenario
from leapnav.envs.obstacles import clearance, proximity, sinc
from leapnav.envs.physics import World
from leapnav.envs.scenario import Scenario, ScenarioError
from leapnav.envs.sensing import POSE_ENTRIES, observe

# Bounds of the observation that no scenario of a sensible size reaches; values beyond are clipped.
FARTHEST, LONGEST, FASTEST = 1000.0, 10_000.0, 20.0
SHORTEST_PERIOD = 1e-4  # s
_field = types.Array(types.float64, 1, "C", readonly=True)


class NavigateEnv(gym.Env[np.ndarray, np.ndarray]):
    r"""A two-wheeled robot drives to a pose among obstacles, on time and at the least cost.

    ## Description
    The robot has a fixed time, the horizon, to reach a pose without touching anything. What it pays is the cost of the
    optimal control problem, so the optimum that `leapnav.experts.find_optimum` finds is the return of the best possible
    policy, up to the square of the control period. pymunk moves the robot; the exact arc of each command is driven
    while nothing is touched.

    ## Action space
    `Box(-1, 1, (2,), float32)`, held for one control period (values outside are clipped):

    | Index | Action | -1 | +1 |
    |---|---|---|---|
    | 0 | speed | `-max_speed` (backwards) | `max_speed` |
    | 1 | turn rate | `-max_turn_rate` (clockwise) | `max_turn_rate` |

    ## Observation space
    `Box(9 + lidar_beams, float32)`:

    | Index | Observation | Unit | Range |
    |---|---|---|---|
    | 0, 1 | goal position in the robot's frame: ahead, to the left | m | -1000 to 1000 |
    | 2, 3 | cosine and sine of the goal heading minus the heading; 0, 0 if the goal heading is free | 1 | -1 to 1 |
    | 4 | time left | s | 0 to 10000 |
    | 5, 6 | velocity needed to arrive on time in a straight line: ahead, to the left | m/s | -20 to 20 |
    | 7 | speed needed to arrive on time in a straight line | m/s | 0 to 20 |
    | 8 | turn rate needed to arrive on time with the goal heading | rad/s | -20 to 20 |
    | 9 ... | lidar: distance from the robot's centre, counter-clockwise from straight ahead | m | 0 to `lidar_range` |

    ## Rewards
    The return is `-J` minus the penalties; `info["reward_parts"]` has the parts of each step:

    | Part | Value | When |
    |---|---|---|
    | `effort` | minus the integral of 1/2 (speed_weight v^2 + turn_weight omega^2) | always |
    | `proximity` | minus the integral of Phi, the scenario's proximity cost | always |
    | `collision` | `-collision_penalty` | the first time that something is touched |
    | `miss` | `-miss_penalty` | the episode ends away from the goal, by the horizon or by a touch |

    ## Starting state
    The scenario's start. The scenario is `options["scenario"]` (a `Scenario`, a dict in the layout of its file, or its
    JSON text), else the argument `scenario`, else, with a bank, number `options["index"]` of it or one drawn by the
    environment's own generator, else a fresh one of the argument `family` drawn by that generator.

    ## Episode end
    `terminated` at the horizon, which is part of the task (the time left is observed), or when something is touched
    (unless `terminate_on_collision=False`; the robot then goes on in contact). Never `truncated`.
    The episode is a success if at the horizon the robot stands within `position_tolerance` and `heading_tolerance` of
    the goal and has touched nothing.

    ## Info
    `cost` (J so far), `clearance` (m, smallest during the step), `collision`, `is_success`, `time` (s), `pose`
    (x, y, unwrapped heading) and `reward_parts`; after a reset also `scenario`, and with a bank `index` and
    `reference_cost`, the cost of its optimum.

    ## Arguments
    * `family`: family of random scenarios, see `leapnav.envs.FAMILIES`.
    * `scenario`: the one scenario of all episodes, instead of a family.
    * `split`: `"train"` or `"test"`: scenarios of the family's bank that ships with leapnav, with known optima.
    * `bank`: scenarios of this bank (a `ScenarioBank` or its file) instead of a family.
    * `control_period` (s): how long an action is held. The last period of an episode ends at the horizon.
    * `position_tolerance` (m), `heading_tolerance` (rad): of success.
    * `collision_penalty`, `miss_penalty`: should be larger than the optimum's cost, or standing still pays; 50 is, for
      the families.
    * `terminate_on_collision`: whether a touch ends the episode.
    * `lidar_beams`, `lidar_range` (m).
    * `render_mode`: `"rgb_array"` or None.

    ## Version history
    * v0: initial version.
    """

    # Gymnasium declares it without ClassVar.
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        family: str = "clutter",
        scenario: Scenario | Mapping[str, Any] | str | None = None,
        *,
        split: str | None = None,
        bank: ScenarioBank | str | os.PathLike[str] | None = None,
        control_period: float = 0.05,
        position_tolerance: float = 0.1,
        heading_tolerance: float = 0.1,
        collision_penalty: float = 50.0,
        miss_penalty: float = 50.0,
        terminate_on_collision: bool = True,
        lidar_beams: int = 32,
        lidar_range: float = 10.0,
        render_mode: str | None = None,
    ) -> None:
        if family not in FAMILIES:
            raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family!r}")
        for name, value in (
            ("control_period", control_period),
            ("position_tolerance", position_tolerance),
            ("heading_tolerance", heading_tolerance),
            ("lidar_range", lidar_range),
        ):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive number, got {value!r}")
        for name, value in (("collision_penalty", collision_penalty), ("miss_penalty", miss_penalty)):
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected a number >= 0, got {value!r}")
        if control_period < SHORTEST_PERIOD:
            raise ValueError(f"control_period: expected at least {SHORTEST_PERIOD} s, got {control_period!r}")
        if not isinstance(lidar_beams, int) or lidar_beams < 0:
            raise ValueError(f"lidar_beams: expected an integer >= 0, got {lidar_beams!r}")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}")
        given = [
            name for name, value in (("scenario", scenario), ("split", split), ("bank", bank)) if value is not None
        ]
        if len(given) > 1:
            raise ValueError(f"{given[1]}: cannot be combined with {given[0]}")
        if split is not None:
            bank = ScenarioBank.shipped(family, split)
        self.family = family
        self.fixed_scenario = None if scenario is None else _as_scenario(scenario)
        self.bank = bank if bank is None or isinstance(bank, ScenarioBank) else ScenarioBank(bank)
        self.control_period = float(control_period)
        self.position_tolerance = float(position_tolerance)
        self.heading_tolerance = float(heading_tolerance)
        self.collision_penalty = float(collision_penalty)
        self.miss_penalty = float(miss_penalty)
        self.terminate_on_collision = terminate_on_collision
        self.lidar_beams = lidar_beams
        self.lidar_range = float(lidar_range)
        self.render_mode = render_mode

        low = [-FARTHEST, -FARTHEST, -1, -1, 0, -FASTEST, -FASTEST, 0, -FASTEST, *[0.0] * self.lidar_beams]
        high = [FARTHEST, FARTHEST, 1, 1, LONGEST, FASTEST, FASTEST, FASTEST, FASTEST]
        high += [self.lidar_range] * self.lidar_beams
        self.observation_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._low, self._high = self.observation_space.low, self.observation_space.high

        self.scenario: Scenario
        self._world: World | None = None
        self._steps = 0
        self._cost = 0.0
        self._collided = False
        self._trail: list[tuple[float, float, float]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; `options={"scenario": ...}`, or with a bank `{"index": ...}`, chooses its scenario.

        Raises:
            ScenarioError: the scenario is not a valid one.
            IndexError: the bank has fewer scenarios.
            ValueError: an unknown or impossible option.

        """
        super().reset(seed=seed)
        extra = self._choose_scenario(options or {})
        self._begin()
        info = self._info(clearance(self.pose[0], self.pose[1], self.scenario.field)[0], False, dict(_NO_REWARD))
        return self._observation(), {**info, "scenario": self.scenario, **extra}

    def _choose_scenario(self, options: dict[str, Any]) -> dict[str, Any]:
        """Sets the episode's scenario; returns what `info` says of it if it comes from a bank."""
        unknown = set(options) - {"scenario", "index"}
        if unknown:
            raise ValueError(f"options: expected 'scenario' or 'index', got {sorted(unknown)[0]!r}")
        chosen, index = options.get("scenario"), options.get("index")
        if index is not None and (chosen is not None or self.bank is None):
            raise ValueError(f"options: 'index' needs a bank and no 'scenario', got {index!r}")
        if chosen is None and self.bank is not None:
            if index is None:
                index = int(self.np_random.integers(len(self.bank)))
            elif isinstance(index, bool) or not isinstance(index, (int, np.integer)):
                raise ValueError(f"options: index: expected an integer, got {index!r}")
            self.scenario = self.bank[int(index)]
            index = int(index) % len(self.bank)
            return {"index": index, "reference_cost": float(self.bank.costs[index])}
        chosen = self.fixed_scenario if chosen is None else chosen
        self.scenario = sample_scenario(self.family, self.np_random) if chosen is None else _as_scenario(chosen)
        return {}

    def _begin(self) -> None:
        scenario = self.scenario
        goal = scenario.goal
        self._goal = goal[0], goal[1], math.nan if goal[2] is None else goal[2]
        self._limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
        self._weights = scenario.cost.speed_weight, scenario.cost.turn_weight
        # A remainder of less than a millionth of a period is rounding of the horizon, not a period of its own.
        self.episode_steps = max(1, math.ceil(scenario.horizon / self.control_period - 1e-6))
        self._world = World(scenario)
        self._steps = 0
        self._cost = 0.0
        self._collided = False
        self._pose = self._world.pose
        self._trail = [self._pose]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds an action for one control period."""
        if self._world is None:
            raise gym.error.ResetNeeded("reset the environment before the first step")
        if len(action) != 2:
            raise ValueError(f"action: expected two finite numbers, got {action!r}")
        speed = min(max(float(action[0]), -1.0), 1.0) * self._limits[0]
        turn_rate = min(max(float(action[1]), -1.0), 1.0) * self._limits[1]
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            raise ValueError(f"action: expected two finite numbers, got {action!r}")
        duration = max(min(self.control_period, self.scenario.horizon - self.time), 0.0)
        x, y, heading = self._pose
        field = self.scenario.field
        nearest, touched = self._world.drive(speed, turn_rate, duration)
        self._pose = self._world.pose
        self._trail.append(self._pose)
        self._steps += 1
        last = self._steps >= self.episode_steps

        effort = 0.5 * (self._weights[0] * speed**2 + self._weights[1] * turn_rate**2) * duration
        if touched:  # the body did not follow the arc
            near = duration * (proximity(x, y, field)[0] + proximity(self._pose[0], self._pose[1], field)[0]) / 2
        else:
            near = arc_proximity(x, y, heading, speed * duration, turn_rate * duration, field) * duration
        self._cost += effort + near
        first_touch = touched and not self._collided
        self._collided = self._collided or touched
        success = last and not self._collided and self.at_goal
        terminated = last or (self._collided and self.terminate_on_collision)
        parts = {
            "effort": -effort,
            "proximity": -near,
            "collision": -self.collision_penalty if first_touch else 0.0,
            "miss": -self.miss_penalty if terminated and not (last and self.at_goal) else 0.0,
        }
        reward = parts["effort"] + parts["proximity"] + parts["collision"] + parts["miss"]
        return self._observation(), reward, terminated, False, self._info(nearest, success, parts)

    def render(self) -> np.ndarray | None:
        """The scene as an array (600, 600, 3) of uint8, for `render_mode="rgb_array"`."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a render_mode, for example gym.make(..., render_mode="rgb_array")')
            return None
        if self._world is None:
            raise gym.error.ResetNeeded("reset the environment before rendering it")
        from leapnav.envs.rendering import draw_scene  # pygame loads only for those who look

        return draw_scene(self.scenario, self._pose, self._trail)

    @property
    def pose(self) -> tuple[float, float, float]:
        """(x, y, heading) in m and rad, the heading unwrapped."""
        return self._pose

    @property
    def time(self) -> float:
        """Seconds since the start of the episode."""
        return min(self._steps * self.control_period, self.scenario.horizon)

    @property
    def at_goal(self) -> bool:
        """Whether the robot's pose is the goal's, within the tolerances."""
        x, y, heading = self._pose
        near = math.hypot(x - self._goal[0], y - self._goal[1]) <= self.position_tolerance
        turned = self.scenario.goal[2] is None or (
            abs(math.remainder(heading - self._goal[2], 2 * math.pi)) <= self.heading_tolerance
        )
        return near and turned

    def _observation(self) -> np.ndarray:
        observation = np.empty(POSE_ENTRIES + self.lidar_beams, np.float32)
        left = self.scenario.horizon - self.time
        observe(
            *self._pose,
            *self._goal,
            left,
            self.control_period,
            FASTEST,
            self.scenario.field,
            self.lidar_range,
            observation,
        )
        return np.clip(observation, self._low, self._high, out=observation)

    def _info(self, nearest: float, success: bool, parts: dict[str, float]) -> dict[str, Any]:
        return {
            "cost": self._cost,
            "clearance": nearest,
            "collision": self._collided,
            "is_success": success,
            "time": self.time,
            "pose": self._pose,
            "reward_parts": parts,
        }


_NO_REWARD = {"effort": 0.0, "proximity": 0.0, "collision": 0.0, "miss": 0.0}


def _as_scenario(value: Scenario | Mapping[str, Any] | str) -> Scenario:
    if isinstance(value, Scenario):
        return value
    if isinstance(value, Mapping):
        return Scenario.from_dict(dict(value))
    if isinstance(value, str):  # as datasets store it
        return Scenario.from_json(value)
    raise ScenarioError(f"scenario: expected a Scenario, a dict or JSON text, got {type(value).__name__}")


@njit(float64(float64, float64, float64, float64, float64, _field), cache=True, error_model="numpy", nogil=True)
def arc_proximity(x, y, heading, distance, turn, field):
    """Mean of Phi along an arc, by the three-point Gauss rule."""
    total = 0.0
    for share, weight in ((0.1127016653792583, 5 / 18), (0.5, 8 / 18), (0.8872983346207417, 5 / 18)):
        chord = distance * share * sinc(turn * share / 2)
        middle = heading + turn * share / 2
        total += weight * proximity(x + chord * math.cos(middle), y + chord * math.sin(middle), field)[0]
    return total
