"""The environment `leapnav/Navigate-v0`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from leapnav.envs.checks import check_actions, check_options, check_render_mode
from leapnav.envs.keys import keys_to_action
from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import ScenarioSource, WithSpec, get_scenario, reference_infos
from leapnav.envs.settings import EnvironmentSettings, takes_settings
from leapnav.envs.simulation.simulator import BatchSimulator
from leapnav.envs.simulation.state import Episode
from leapnav.envs.utils.validation import check_flag

if TYPE_CHECKING:
    from leapnav.envs.simulation.rendering import Window

NOISE_STREAM = 1  # of the environment's seed; the stream of the scenarios is the seed itself


class NavigateEnv(WithSpec, gym.Env[Any, np.ndarray]):  # type: ignore[misc] (`spec` is a property)
    r"""A wheeled robot drives to a goal pose among obstacles, in a fixed or a free time and at minimum cost.

    ## Description
    The robot has a fixed time, the horizon, to reach the goal pose without a collision. The reward is minus the running
    cost of an optimal control problem, with penalties for a collision and for missing the goal. The return of an
    optimal policy is therefore `-J*`, up to terms of second order in the control period, where `J*` is the minimum cost
    of the scenario. `leapnav.experts.find_optimum` computes the best known value of `J*`, and scenario banks store it.

    With `horizon="free"`, the time is part of the cost, with the time weight of the scenario, and an episode ends when
    the robot reaches the goal pose.

    The argument `robot` selects the model of the robot: `"unicycle"`, `"differential_drive"`, `"car"`,
    `"dynamic_car"`, `"dynamic_unicycle"`, `"trailer"`, `"unicycle_trailer"` or one's own, see
    `leapnav.envs.RobotModel`. The tables of this page describe the unicycle; for other robots the action and the part
    `motion` of the observation differ.

    With `actuation="velocity"`, the robot follows the exact path of each action, for the unicycle a circular arc.
    pymunk integrates the motion of robots with `actuation="motor"`, and simulates the part of a control period after a
    contact if the episode continues.

    `gym.make_vec("leapnav/Navigate-v0", num_envs=1024)` simulates many robots in one process, see `NavigateVectorEnv`.
    `leapnav/NavigateGoal-v0` is the same task for goal-conditioned learners, see `NavigateGoalEnv`.

    ## Action space
    `Box(-1, 1, (m,), float32)` for a robot with m controls: -1 is the lowest and 1 the highest value of each
    control. The action is held for one control period. Values outside the bounds are clipped. For the unicycle, unless
    its limits are intervals (`speed`, `turn_rate`):

    | Index | Action | Unit | -1 | +1 |
    |---|---|---|---|---|
    | 0 | speed | m/s | `-max_speed` (backwards) | `max_speed` |
    | 1 | turn rate | rad/s | `-max_turn_rate` (clockwise) | `max_turn_rate` |

    With `actuation="velocity"`, the robot reaches the commanded speed and turn rate immediately. With `"motor"`, it has
    mass and inertia: motors with a limited force drive the wheels towards the commanded motion, and the tyres can slip
    sideways, see `Motor`.

    ## Observation space
    `Box(n, float32)`: the following parts, concatenated. With `dict_observation=True`, a `Dict` with one `Box` for each
    part. Values outside the range are clipped.

    | Part | Index in the part | Observation | Unit | Range |
    |---|---|---|---|---|
    | `goal` | 0, 1 | goal position in the robot's frame: ahead, to the left | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the goal heading relative to the robot's heading; 0, 0 if the goal heading is free | 1 | -1 to 1 |
    | `goal` (fixed horizon only) | 4 | time left | s | 0 to 10000 |
    | | 5, 6 | goal position divided by the time left: ahead, to the left | m/s | -20 to 20 |
    | | 7 | distance to the goal divided by the time left | m/s | 0 to 20 |
    | | 8 | angle to the goal heading divided by the time left; 0 if the goal heading is free | rad/s | -20 to 20 |
    | `motion` (robots with further states) | k | further state k of the robot's model, such as speed and turn rate; a heading relative to that of the robot | | -20 to 20 |
    | `motion` (`"motor"` only) | 0, 1 | velocity in the robot's frame: ahead, to the left | m/s | -20 to 20 |
    | | 2 | turn rate | rad/s | -20 to 20 |
    | `action` (`previous_action=True` only) | k | the last action; 0 at the start of an episode | 1 | -1 to 1 |
    | `lidar` (`"lidar"` and `"geodesic"`) | k | range of beam k from the robot's centre, counter-clockwise from straight ahead, or from the right end of the field of view | m | 0 to `lidar_range` |
    | `detours` (`"geodesic"` only) | k | how much longer than the shortest path to the goal a path is that starts along beam k, for 0.25 m or more, or as far as there is room | m | 0 to 3 |
    | `distance` (`"geodesic"` only) | 0 | geodesic distance: length of the shortest path among the obstacles to the goal position | m | 0 to 2000 |
    | `velocities` (`"geodesic"` with `velocities=True`) | k | velocity of the obstacle that beam k meets, in the robot's frame: all components ahead, then all to the left; 0 if it does not move | m/s | -20 to 20 |
    | `walls` (`"map"` only) | 0 to 3 | distances to the left, bottom, right and top wall of the arena | m | -1000 to 1000 |
    | | 4, 5 | cosine and sine of the heading | 1 | -1 to 1 |
    | `obstacles` (`"map"` only) | per obstacle: 0 | 1; in a row without an obstacle, all entries are 0 | 1 | 0 to 1 |
    | | 1 | radius of a disc or a capsule, 0 for a polygon | m | 0 to 1000 |
    | | 2 ... | vertices in the robot's frame: ahead, to the left; for a disc, its centre; for a capsule, its ends; repeated to fill the row | m | -1000 to 1000 |
    | `velocities` (`"map"` with `velocities=True`) | 2k, 2k + 1 | velocity of obstacle k in the robot's frame: ahead, to the left | m/s | -20 to 20 |

    With `history=(0.4, 1.2)`, the observations 0.4 s and 1.2 s before follow in this order, each with all parts; before
    the start of an episode, its first observation is used.

    `observation="lidar"` contains `lidar_beams` ranges. `"map"` contains the `map_obstacles` nearest discs, capsules
    and polygons, in order of distance, with `map_vertices` vertices each. `"state"` contains neither; it suits
    scenarios without obstacles.

    `"geodesic"` contains, in addition to the ranges, what a global planner on the complete map provides: the distance to
    the goal among the obstacles, and the detour in the direction of each beam. Both are lengths in a metric that
    increases with the proximity cost, see `leapnav.envs.geodesics`. With lidar alone, an obstacle behind another one
    cannot be observed.

    ## Rewards
    With `reward="cost"`, the return is `-J` minus the penalties. The `info` contains the parts of each reward:

    | Part | Value | When |
    |---|---|---|
    | `reward_effort` | minus the integral of the running cost without the proximity cost over the step, for the unicycle 1/2 (speed_weight v^2 + turn_weight omega^2) | always |
    | `reward_proximity` | minus the integral of the proximity cost Phi over the step, with a relative error of at most 1e-4 (1e-3 in rare steps that end in a collision) | always |
    | `reward_time` | minus the time weight times the duration of the step | free horizon |
    | `reward_collision` | `-collision_penalty` | at the first collision of the episode |
    | `reward_miss` | `-miss_penalty`; with `graded_miss` times min(1, 0.2 + 0.1 (distance (m) + heading error (rad) from the goal)) | if the episode terminates without reaching the goal, at the horizon or by a collision |
    | `reward_shaping` (`reward="shaped"` only) | `discount` times the potential after the step, minus the potential before it | always |

    The reward is the sum of the parts, times `reward_scale`. With a constant penalty, a learner has no information about
    the goal until it reaches it by chance, and the cost favours standing still: use `graded_miss=True` to learn without
    demonstrations. The return of a success is the same.

    v and omega are the actual speed and turn rate, which differ from the commanded ones with motors, in contact and
    with noise.

    `reward="shaped"` adds potential-based shaping. It leaves the optimal policy unchanged if `discount` is the
    learner's discount factor (Ng, Harada and Russell, 1999). The potential is minus the cost of following the reference
    path at constant speed, or a straight line to the goal if there is no reference. It is at least `-miss_penalty`, and
    0 after the termination of the episode.

    ## Starting state
    The start of the scenario; at rest with `"motor"`. The scenario of an episode is the first of these that is given:

    1. `options["scenario"]` of `reset`: a `Scenario`, a dict with the structure of a scenario file, JSON text, or the
       path of a file;
    2. the scenario with the index `options["index"]` in the bank;
    3. the argument `scenario`;
    4. a random scenario of the bank, or with `split="fresh"` a new random scenario of the family.

    ## Episode end
    The episode is `terminated` at the horizon, which is part of the task (the time left is observed), or at a
    collision. It is never `truncated`. With `terminate_on_collision=False`, the robot slides along the
    obstacle, as simulated by pymunk, or pushes it if it has a `mass`, and the episode continues until the horizon; Phi
    is large in contact, 100 times the proximity weight with the default scale. The episode is a success if, at the horizon, the robot is within `position_tolerance`
    and `heading_tolerance` of the goal and has not collided. Further states of the robot with a goal, such as the speed
    of the dynamic unicycle, must be within `motion_tolerance` of it.

    With `horizon="free"`, the episode is `terminated` at the end of the first step after which the robot is within the
    tolerances of the goal, or at a collision. It is `truncated` at the time limit of the scenario, which is not
    observed: 3 times the duration of the optimum in a bank, 3 times an estimate of it in a fresh scenario of a family,
    see `Scenario.time_limit` for others. A truncated episode has no penalty. The task is not discounted, so a learner
    needs a discount factor close to 1: with 0.99 per step of 0.05 s, standing still costs less than driving.

    ## Info
    | Key | Content |
    |---|---|
    | `cost` | J so far |
    | `clearance` | smallest clearance during the step (m), with an error of at most 1 mm or 2 %, whichever is larger |
    | `collision` | whether the robot has collided in this episode |
    | `is_success` | whether the episode is a success |
    | `time` | time since the start of the episode (s) |
    | `pose` (3,) | x, y (m), heading (rad, unwrapped) |
    | `motion` (n - 3,) | further states of the robot, if its model has any |
    | `goal_distance`, `heading_error` | distance of the pose from the goal (m), and difference of the headings (rad), 0 if that of the goal is free |
    | `reward_effort`, ... | see Rewards |
    | `index`, `reference_cost` | with a bank: index of the scenario, and cost of its optimum; -1 and NaN for a scenario that is not from the bank |
    | `lower_bound` | with a bank: proved lower bound of the cost, -infinity if none is known |

    All infos have the same keys, after a reset and after a step. The scenario of the episode is `env.unwrapped.scenario`.

    ## Arguments
    | Argument | Default | Meaning |
    |---|---|---|
    | `family` | None | family of the scenarios, `"clutter"` unless `scenario` or `bank` is given, see `leapnav.envs.FAMILIES`; `"all"` samples the family for each episode, with `split="fresh"` only |
    | `scenario` | None | the scenario of all episodes |
    | `split` | `"train"` | the family's included bank, `"train"` (400 scenarios) or `"test"` (200), with known optima; `"fresh"` samples a new scenario for each episode (2 ms); the default is `"fresh"` for the family `"all"` |
    | `bank` | None | a `ScenarioBank` or its file, see `leapnav bank build` |
    | `horizon` | None | `"fixed"` or `"free"`; None for that of the scenario or the bank, otherwise `"fixed"` |
    | `obstacles` | None | `"cost"` or `"hard"`, for scenarios with the proximity weight 0; None for that of the scenario or the bank, otherwise `"cost"`. Included banks with `"hard"` have the split `"test"` only |
    | `robot` | None | name of the robot's model, a dict of its fields with `model`, or a `RobotModel`; None for that of the scenario or the bank, otherwise the unicycle. Without an included bank for the robot, scenarios are fresh |
    | `observation` | `"lidar"` | `"lidar"`, `"state"`, `"map"` or `"geodesic"` |
    | `velocities` | | whether `"map"` and `"geodesic"` contain the velocities of obstacles; by default if obstacles of the family, the bank or the scenario move. Lidar alone has none, see `history` |
    | `reward` | `"cost"` | `"cost"` or `"shaped"` |
    | `actuation` | `"velocity"` | `"velocity"` or `"motor"` |
    | `disturbance` | None | noise on actuation and sensing: a `Disturbance` or a dict of its attributes; a number d means `actuation` d, `slip` d and `sensing` d / 10 |
    | `motor` | None | parameters for `"motor"`: a `Motor` or a dict of its attributes |
    | `dict_observation` | False | whether observations are dictionaries of the parts, for `MultiInputPolicy` |
    | `control_period` | 0.05 | duration of an action (s); the last period of an episode ends at the horizon |
    | `position_tolerance` | 0.1 | tolerance of success (m) |
    | `heading_tolerance` | 0.1 | tolerance of success (rad) |
    | `motion_tolerance` | 0.1 | tolerance of success of further states (in their units) |
    | `collision_penalty`, `miss_penalty` | 50 | should exceed the cost of the optimum, or else not moving is optimal; 50 is sufficient for the families |
    | `graded_miss` | False | whether the penalty of a miss is smaller near the goal, see Rewards |
    | `reward_scale` | 1 | factor of all rewards |
    | `discount` | 0.99 | discount factor of the learner, for `"shaped"` |
    | `terminate_on_collision` | True | whether a collision ends the episode |
    | `lidar_beams`, `lidar_range` | 32, 10 | number of beams, and maximum range (m) |
    | `lidar_fov` | 2 pi | field of view (rad), symmetric about straight ahead; a smaller one begins and ends with a beam |
    | `history` | () | ages of earlier observations in the observation, increasing (s); rounded to control periods |
    | `previous_action` | False | whether the observation contains the last action |
    | `map_obstacles`, `map_vertices` | 8, 8 | number of discs, capsules and polygons in the map, and of vertices of each; more vertices are an error |
    | `render_mode` | None | `"rgb_array"` or `"human"` |
    | `show_optimum` | False | whether frames contain the optimum of a scenario of a bank, and its cost; leave it off where frames are observed |

    ## Errors
    `ValueError` for an invalid argument; the message states its name and value. `ScenarioError`, a `ValueError`, for an
    invalid `scenario`. `FileNotFoundError` if the file of `bank` does not exist. `BankError`, a `ValueError`, if it is
    not a bank or has another format version. `ResetNeeded` for a step before the first reset or after the end of an
    episode.

    ## Version history
    * v0: initial version.
    """  # noqa: E501 (tables)

    # Gymnasium declares it without ClassVar.
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012
    _goal_conditioned = False

    @takes_settings
    def __init__(
        self,
        family: str | None = None,
        scenario: Scenario | Mapping[str, Any] | str | None = None,
        *,
        split: str | None = None,
        bank: ScenarioBank | str | os.PathLike[str] | None = None,
        robot: RobotModel | Mapping[str, Any] | str | None = None,
        horizon: str | None = None,
        obstacles: str | None = None,
        render_mode: str | None = None,
        show_optimum: bool = False,
        **settings: Any,
    ) -> None:
        self._source = ScenarioSource(family, scenario, split, bank, robot, horizon, obstacles)
        self.settings = EnvironmentSettings.of(self, self._source, settings)
        check_render_mode(render_mode, self.metadata["render_modes"])
        check_flag("show_optimum", show_optimum)
        self.render_mode, self._show_optimum = render_mode, bool(show_optimum)
        # Real time, also for the wrappers that record videos.
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.settings.control_period))}
        self._simulator = BatchSimulator(1, self.settings)
        self.observation_space = self._simulator.layout.space
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self._source.robot.sizes()[1],), np.float32)
        self._action_shape = self._source.robot.sizes()[1:]
        self._simulator.check(self._source.scenario, self.bank)
        self._choice: Scenario | int | None = None
        self._reference: dict[str, Any] = {}  # of the scenario in the bank, see Info
        self._playing = np.zeros(1, dtype=bool)
        self._noise_generator: np.random.Generator | None = None
        self._trail: list[tuple[float, float, float]] = []
        self._window: Window | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of the scenarios and of the noise; None continues the random streams.
            options: {"scenario": scenario}, or with a bank {"index": index}, selects the scenario.

        Raises:
            ScenarioError: the scenario is invalid.
            IndexError: the index is out of range.
            ValueError: an unknown or invalid option.

        """
        options = options or {}
        check_options(options, "scenario", "index")
        choice = self._source.select(options.get("scenario"), options.get("index"))
        if choice is not None:
            self._simulator.check(choice, self.bank)
        super().reset(seed=seed)  # all checks are done: a failed reset changes nothing
        if choice is None:
            choice = self._source.draw(self.np_random)
        if self.settings.disturbed and (seed is not None or self._noise_generator is None):
            self._noise_generator = make_noise_generator(self.np_random_seed)
        generators = [] if self._noise_generator is None else [self._noise_generator]
        self._simulator.reset([0], [choice], self.bank, generators)
        self._choice = choice
        self._playing[0] = True
        self._trail = [self.pose]
        if self.bank is not None:
            self._reference = reference_infos(choice, self.bank)
        info, observation = self._info(self._simulator.episode(0)), self._observe()
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold an action for one control period.

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode; the state is unchanged then.
            ValueError: the action is not m finite numbers; the state is unchanged then.

        """
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before the first step")
        if not self._playing[0]:
            raise gym.error.ResetNeeded("the episode has ended; reset the environment before the next step")
        values = check_actions(action, self._action_shape)
        self._simulator.step(values.reshape(1, -1), self._playing)
        if self.render_mode is not None:
            self._trail.append(self.pose)
        episode = self._simulator.episode(0)
        observation, info = self._observe(), self._info(episode)
        terminated, truncated = episode.terminated, episode.truncated
        self._playing[0] = not (terminated or truncated)
        if self.render_mode == "human":
            self.render()
        return observation, episode.reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Render the scene.

        Returns:
            For "rgb_array" a frame of uint8, (640, 600, 3) for a square arena. For "human" None; a window shows it.

        Raises:
            ResetNeeded: before the first reset.

        """
        if self.render_mode is None:
            gym.logger.warn('render() needs a render_mode, for example gym.make(..., render_mode="rgb_array")')
            return None
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before rendering it")
        from leapnav.envs.simulation.rendering import Window, draw_scene, make_scene  # imports pygame

        frame = draw_scene(
            make_scene(self._simulator, 0, self._choice, self.bank, self._trail, show_optimum=self._show_optimum)
        )
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window(self.metadata["render_fps"])
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def get_keys_to_action(self) -> dict[str | tuple[str | int, ...], np.ndarray]:
        """Return the actions of keys, with which `gymnasium.utils.play.play` lets a person drive.

        W and S or the arrow keys drive forwards and backwards, A and D or the arrow keys turn, at half of the limits;
        for other robots than those with speeds as controls, they are the first two controls.
        """
        return keys_to_action(self.settings.model)

    @property
    def family(self) -> str:
        """The family of the scenarios."""
        return self._source.family

    @property
    def source(self) -> ScenarioSource:
        """The source of the scenarios, with their robot."""
        return self._source

    @property
    def bank(self) -> ScenarioBank | None:
        """The bank of the scenarios, or None."""
        return self._source.bank

    @property
    def scenario(self) -> Scenario:
        """The scenario of the current episode."""
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before reading its scenario")
        return get_scenario(self._choice, self.bank)

    @property
    def index(self) -> int | None:
        """The index of the current scenario in the bank, None if it is not from a bank."""
        return self._choice if isinstance(self._choice, int) else None

    @property
    def control_period(self) -> float:
        """Duration of an action (s)."""
        return self.settings.control_period

    @property
    def pose(self) -> tuple[float, float, float]:
        """The robot's x, y (m) and heading (rad, unwrapped)."""
        x, y, heading = self._simulator.states[0, :3].tolist()
        return x, y, heading

    @property
    def state(self) -> np.ndarray:
        """The robot's state (n,): the pose and the further states of its model."""
        return self._simulator.states[0].copy()

    @property
    def time(self) -> float:
        """Time since the start of the episode (s)."""
        return float(self._simulator.episodes["time"][0])

    @property
    def window_closed(self) -> bool:
        """Whether the user has closed the window of `render_mode="human"`."""
        return self._window is not None and self._window.closed

    @property
    def at_goal(self) -> bool:
        """Whether the robot's pose equals the goal, within the tolerances."""
        return self._simulator.at_goal(0)

    def _observe(self) -> Any:
        out = np.empty((1, self._simulator.layout.size), np.float32)
        self._simulator.observe(out)
        return self._simulator.layout.divide(out[0])

    def _info(self, episode: Episode) -> dict[str, Any]:
        """Return the info of a reset or of a step."""
        state = self._simulator.states[0]
        info: dict[str, Any] = {
            "cost": episode.cost,
            "clearance": episode.clearance,
            "time": episode.time,
            "collision": episode.collided,
            "is_success": episode.success,
            "pose": state[:3].copy(),
            "goal_distance": episode.goal_distance,
            "heading_error": episode.heading_error,
            "reward_effort": -episode.effort,
            "reward_proximity": -episode.proximity,
            "reward_collision": -episode.collision,
            "reward_miss": -episode.miss,
            **self._reference,
        }
        if self.settings.free_horizon:
            info["reward_time"] = -episode.time_cost
        if self.settings.shaped:
            info["reward_shaping"] = episode.shaping
        if len(state) > 3:
            info["motion"] = state[3:].copy()
        return info

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_window": None}  # windows cannot be pickled


def make_noise_generator(seed: int | None) -> np.random.Generator:
    """Return the generator of the noise of an environment with this seed."""
    return np.random.default_rng(None if seed is None or seed < 0 else (seed, NOISE_STREAM))
