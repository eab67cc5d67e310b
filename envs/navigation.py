"""The environment `leapnav/Navigate-v0`, and `leapnav/NavigateGoal-v0` for learners that choose their goals."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from leapnav.envs import driving
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.fleet import Fleet
from leapnav.envs.goals import GoalConditioned
from leapnav.envs.scenario import Scenario
from leapnav.envs.settings import Disturbance, Motor, Settings
from leapnav.envs.tasks import Tasks, scenario_of

if TYPE_CHECKING:
    from leapnav.envs.rendering import Window

__all__ = ["NavigateEnv", "NavigateGoalEnv"]

DISTURBANCE_STREAM = 1  # of the environment's seed


class NavigateEnv(gym.Env[Any, np.ndarray]):
    r"""A two-wheeled robot drives to a pose among obstacles, on time and at the least cost.

    ## Description
    The robot has a fixed time, the horizon, to reach a pose without touching anything. What it pays is the cost of the
    optimal control problem, so the optimum that `leapnav.experts.find_optimum` finds is the return of the best possible
    policy, up to the square of the control period. pymunk moves the robot; in `actuation="velocity"` the exact arc of
    each command is driven while nothing is touched.

    `gym.make_vec("leapnav/Navigate-v0", num_envs=1024)` steps many robots at once, see `NavigateVectorEnv`;
    `leapnav/NavigateGoal-v0` is the same task for learners that choose their goals, see `NavigateGoalEnv`.

    ## Action space
    `Box(-1, 1, (2,), float32)`, held for one control period (values outside are clipped):

    | Index | Action | Unit | -1 | +1 |
    |---|---|---|---|---|
    | 0 | speed | m/s | `-max_speed` (backwards) | `max_speed` |
    | 1 | turn rate | rad/s | `-max_turn_rate` (clockwise) | `max_turn_rate` |

    With `actuation="velocity"` the robot moves so at once. With `"motor"` it has mass and inertia: its wheels' motors
    work towards the commanded motion with limited force, and its tyres can slip sideways, see `Motor`.

    ## Observation space
    `Box(n, float32)` of these parts, one after the other, or with `dict_observation=True` a `Dict` of them. Values
    beyond the range are clipped.

    | Part | Index in the part | Observation | Unit | Range |
    |---|---|---|---|---|
    | `goal` | 0, 1 | goal position in the robot's frame: ahead, to the left | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the goal heading minus the heading; 0, 0 if it is free | 1 | -1 to 1 |
    | | 4 | time left | s | 0 to 10000 |
    | | 5, 6 | velocity needed to arrive on time in a straight line: ahead, to the left | m/s | -20 to 20 |
    | | 7 | speed needed to arrive on time in a straight line | m/s | 0 to 20 |
    | | 8 | turn rate needed to arrive on time with the goal heading | rad/s | -20 to 20 |
    | `motion` (`"motor"` only) | 0, 1 | velocity: ahead, to the left | m/s | -20 to 20 |
    | | 2 | turn rate | rad/s | -20 to 20 |
    | `lidar` (`"lidar"` only) | k | range of beam k from the robot's centre, counter-clockwise from ahead | m | 0 to `lidar_range` |
    | `walls` (`"map"` only) | 0 to 3 | distances to the walls: left, bottom, right, top of the arena | m | -1000 to 1000 |
    | | 4, 5 | cosine and sine of the heading | 1 | -1 to 1 |
    | `obstacles` (`"map"` only) | per obstacle: 0 | 1 if there is one, else the row is zeros | 1 | 0 to 1 |
    | | 1 | radius by which its outline is rounded: a disc's radius, 0 for a polygon | m | 0 to 1000 |
    | | 2 ... | vertices in the robot's frame: ahead, to the left; a disc's is its centre; repeated to fill up | m | -1000 to 1000 |

    `observation="lidar"` has `lidar_beams` ranges, `"map"` the `map_obstacles` nearest obstacles, nearest first, of
    `map_vertices` vertices each, and `"state"` neither: it suits tasks without obstacles, and tests.

    ## Rewards
    With `reward="cost"` the return is `-J` minus the penalties; `info["reward_parts"]` has the parts of each step:

    | Part | Value | When |
    |---|---|---|
    | `effort` | minus the integral of 1/2 (speed_weight v^2 + turn_weight omega^2) | always |
    | `proximity` | minus the integral of Phi, the scenario's proximity cost | always |
    | `collision` | `-collision_penalty` | the first time that something is touched |
    | `miss` | `-miss_penalty` | the episode ends away from the goal, by the horizon or by a touch |
    | `shaping` (`reward="shaped"` only) | `discount` times the potential after the step, minus the one before | always |

    `reward="shaped"` adds the last: potential-based shaping, which leaves the optimal policy as it is (Ng, Harada and
    Russell, 1999) if `discount` is the learner's. The potential is minus the cost of driving at an even pace along the
    reference path (without a reference, straight) to the goal, at least `-miss_penalty`, and 0 once the episode is over.
    v and omega are those driven: in `"motor"`, in contact and under a disturbance not quite those commanded.

    ## Starting state
    The scenario's start, at rest in `"motor"`. The scenario is `options["scenario"]` (a `Scenario`, a dict in the
    layout of its file, its JSON text, or the file), else the argument `scenario`; else number `options["index"]` of the bank, or
    one that the environment's own generator draws from it; with `split="fresh"` that generator makes a new one.

    ## Episode end
    `terminated` at the horizon, which is part of the task (the time left is observed), or when something is touched:
    the robot stops there. With `terminate_on_collision=False` it goes on in contact, as pymunk has it, and the episode
    ends at the horizon. Never `truncated`. The episode is a success if at the horizon the robot stands within
    `position_tolerance` and `heading_tolerance` of the goal and has touched nothing.

    ## Info
    `cost` (J so far), `clearance` (m, the smallest during the step, to a millimetre or 2 %), `collision` (touched
    something in this episode), `is_success`, `time` (s), `pose` (x, y, unwrapped heading) and `reward_parts`; after a
    reset also `scenario`, and with a bank `index` and `reference_cost`, the cost of its optimum.

    ## Arguments
    | Argument | Default | Meaning |
    |---|---|---|
    | `family` | `"clutter"` | family of scenarios, see `leapnav.envs.FAMILIES`; `"all"` draws the family too, for `split="fresh"`, its default |
    | `scenario` | None | the one scenario of all episodes |
    | `split` | `"train"` | the family's bank that ships with leapnav, `"train"` (400 scenarios) or `"test"` (200), with known optima; `"fresh"` makes a new scenario (2 ms) for each episode |
    | `bank` | None | a `ScenarioBank` or its file, see `leapnav bank build` |
    | `observation` | `"lidar"` | `"lidar"`, `"state"` or `"map"` |
    | `reward` | `"cost"` | `"cost"` or `"shaped"` |
    | `actuation` | `"velocity"` | `"velocity"` or `"motor"` |
    | `disturbance` | None | noise on motion and sensing: a `Disturbance` or a dict of its attributes; a number d stands for `actuation` d, `slip` d and `sensing` d / 10 |
    | `motor` | None | for `"motor"`: a `Motor` or a dict of its attributes |
    | `dict_observation` | False | a `Dict` of the parts, for `MultiInputPolicy` |
    | `control_period` | 0.05 | s that an action is held; the last period of an episode ends at the horizon |
    | `position_tolerance` | 0.1 | m, of success |
    | `heading_tolerance` | 0.1 | rad, of success |
    | `collision_penalty`, `miss_penalty` | 50 | should exceed the optimum's cost, or standing still pays; 50 does, for the families |
    | `discount` | 0.99 | of the learner, for `"shaped"` |
    | `terminate_on_collision` | True | whether a touch ends the episode |
    | `lidar_beams`, `lidar_range` | 32, 10 | number of beams, and m |
    | `map_obstacles`, `map_vertices` | 8, 8 | obstacles in the map, and vertices of each; a polygon with more is refused |
    | `render_mode` | None | `"rgb_array"` or `"human"` |

    ## Errors
    `ValueError` names the argument that is impossible, and its value; `ScenarioError` (one too) says what is wrong with
    `scenario`; `FileNotFoundError` and `BankError` that `bank` is missing, no bank, or of another version.

    ## Version history
    * v0: initial version.
    """  # noqa: E501 (tables)

    # Gymnasium declares it without ClassVar.
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012
    _goal_conditioned = False

    def __init__(
        self,
        family: str = "clutter",
        scenario: Scenario | Mapping[str, Any] | str | None = None,
        *,
        split: str | None = None,
        bank: ScenarioBank | str | os.PathLike[str] | None = None,
        observation: str = "lidar",
        reward: str = "cost",
        actuation: str = "velocity",
        disturbance: Disturbance | Mapping[str, float] | float | None = None,
        motor: Motor | Mapping[str, float] | None = None,
        dict_observation: bool = False,
        control_period: float = 0.05,
        position_tolerance: float = 0.1,
        heading_tolerance: float = 0.1,
        collision_penalty: float = 50.0,
        miss_penalty: float = 50.0,
        discount: float = 0.99,
        terminate_on_collision: bool = True,
        lidar_beams: int = 32,
        lidar_range: float = 10.0,
        map_obstacles: int = 8,
        map_vertices: int = 8,
        render_mode: str | None = None,
    ) -> None:
        self._tasks = Tasks(family, scenario, split, bank)
        self.settings = Settings(
            observation=observation,
            reward=reward,
            actuation=actuation,
            disturbance=disturbance,  # type: ignore[arg-type] (the settings take every form)
            motor=motor,  # type: ignore[arg-type]
            dict_observation=dict_observation,
            control_period=control_period,
            position_tolerance=position_tolerance,
            heading_tolerance=heading_tolerance,
            collision_penalty=collision_penalty,
            miss_penalty=miss_penalty,
            discount=discount,
            terminate_on_collision=terminate_on_collision,
            lidar_beams=lidar_beams,
            lidar_range=lidar_range,
            map_obstacles=map_obstacles,
            map_vertices=map_vertices,
            goal_conditioned=self._goal_conditioned,
        )
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        # In real time; kept for the wrappers that write videos.
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / control_period))}
        self._fleet = Fleet(1, self.settings)
        self.observation_space = self._fleet.layout.space
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._fleet.check(self._tasks.scenario, self.bank)
        self._choice: Scenario | int | None = None
        self._playing = np.zeros(1, dtype=bool)
        self._noise_generator: np.random.Generator | None = None
        self._trail: list[tuple[float, float, float]] = []
        self._window: Window | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; `options={"scenario": ...}`, or with a bank `{"index": ...}`, chooses its scenario.

        Raises:
            ScenarioError: the scenario is not a valid one.
            IndexError: the bank has fewer scenarios.
            ValueError: an unknown or impossible option.

        """
        options = options or {}
        check_options(options, "scenario", "index")
        choice = self._tasks.given(options.get("scenario"), options.get("index"))
        if choice is not None:
            self._fleet.check(choice, self.bank)
        super().reset(seed=seed)  # nothing can fail from here on
        if choice is None:
            choice = self._tasks.draw(self.np_random)
        if self.settings.disturbed and (seed is not None or self._noise_generator is None):
            self._noise_generator = disturbance_generator(self.np_random_seed)
        generators = [] if self._noise_generator is None else [self._noise_generator]
        self._fleet.begin([0], [choice], self.bank, generators)
        self._choice = choice
        self._playing[0] = True
        self._trail = [self.pose]
        info = self._info()
        info["scenario"] = self.scenario
        if isinstance(choice, int) and self.bank is not None:
            info["index"], info["reference_cost"] = choice, float(self.bank.costs[choice])
        observation = self._observe()
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Holds an action for one control period; after the end of an episode nothing moves and nothing is paid.

        Raises:
            ResetNeeded: before the first reset.
            ValueError: the action is not two finite numbers; nothing has changed then.

        """
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before the first step")
        self._fleet.step(check_actions(action, (2,)).reshape(1, 2), self._playing)
        if self.render_mode is not None:
            self._trail.append(self.pose)
        row = self._fleet.state[0]
        observation, info = self._observe(), self._info()
        terminated = bool(row[driving.TERMINATED])
        self._playing[0] = not terminated
        if self.render_mode == "human":
            self.render()
        return observation, float(row[driving.REWARD]), terminated, False, info

    def render(self) -> np.ndarray | None:
        """The scene: an array (640, 600, 3) of uint8 for "rgb_array" (as wide as the arena asks), a window for "human".

        Raises:
            ResetNeeded: before the first reset.

        """
        if self.render_mode is None:
            gym.logger.warn('render() needs a render_mode, for example gym.make(..., render_mode="rgb_array")')
            return None
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before rendering it")
        from leapnav.envs.rendering import Window, draw_scene, scene_of  # pygame loads only for those who look

        frame = draw_scene(scene_of(self._fleet, 0, self._choice, self.bank, self._trail))
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window(self.metadata["render_fps"])
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    @property
    def family(self) -> str:
        """The family of the scenarios."""
        return self._tasks.family

    @property
    def bank(self) -> ScenarioBank | None:
        """The bank of the scenarios, None if they come from elsewhere."""
        return self._tasks.bank

    @property
    def scenario(self) -> Scenario:
        """The scenario of the episode."""
        if self._choice is None:
            raise gym.error.ResetNeeded("reset the environment before its scenario is asked for")
        return scenario_of(self._choice, self.bank)

    @property
    def index(self) -> int | None:
        """The number of the episode's scenario in the bank, None if it is from elsewhere."""
        return self._choice if isinstance(self._choice, int) else None

    @property
    def control_period(self) -> float:
        """How long an action is held, in s."""
        return self.settings.control_period

    @property
    def pose(self) -> tuple[float, float, float]:
        """(x, y, heading) in m and rad, the heading unwrapped."""
        x, y, heading = self._fleet.poses[0].tolist()
        return x, y, heading

    @property
    def time(self) -> float:
        """Seconds since the start of the episode."""
        return float(self._fleet.state[0, driving.TIME])

    @property
    def window_closed(self) -> bool:
        """Whether the user has closed the window of `render_mode="human"`."""
        return self._window is not None and self._window.closed

    @property
    def at_goal(self) -> bool:
        """Whether the robot's pose is the goal's, within the tolerances."""
        return self._fleet.at_goal(0)

    def _observe(self) -> Any:
        out = np.empty((1, self._fleet.layout.size), np.float32)
        self._fleet.observe(out)
        return self._fleet.layout.divide(out[0])

    def _info(self) -> dict[str, Any]:
        row = self._fleet.state[0].tolist()
        parts = {name: -row[column] for name, column in driving.PARTS.items()}
        if self.settings.reward == "shaped":
            parts["shaping"] = row[driving.SHAPING]
        info: dict[str, Any] = {name: row[column] for name, column in driving.INFOS.items()}
        for name, column in driving.FLAGS.items():
            info[name] = row[column] != 0.0
        info["pose"], info["reward_parts"] = self.pose, parts
        return info

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_window": None}  # a window stays where it is


class NavigateGoalEnv(GoalConditioned, NavigateEnv):
    """`NavigateEnv` for learners that choose their goals, such as hindsight experience replay.

    ## Observation space
    A `Dict` of three boxes, as Gymnasium-Robotics has it:

    | Key | Index | Observation | Unit | Range |
    |---|---|---|---|---|
    | `achieved_goal` | 0, 1 | position | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the heading | 1 | -1 to 1 |
    | `desired_goal` | 0, 1 | goal position | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the goal heading; 0, 0 if it is free | 1 | -1 to 1 |
    | `observation` | 0 | time left | s | 0 to 10000 |
    | | 1 ... | the parts of `NavigateEnv` but `goal` | | |

    ## Rewards
    | `reward` | Value |
    |---|---|
    | `"sparse"` (the default) | 1 in each step that ends at the goal, within the tolerances, else 0 |
    | `"cost"` | as in `NavigateEnv`; `compute_reward` then needs the infos of the steps |

    The sensing of a `Disturbance` blurs the lidar, not the goals, which decide the reward. The `info` of a step has
    `terminated` and `at_horizon` in addition. Everything else is as in `NavigateEnv`.
    """

    _goal_conditioned = True

    def __init__(self, *args: Any, reward: str = "sparse", **arguments: Any) -> None:
        super().__init__(*args, reward=reward, **arguments)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As `NavigateEnv.step`, with the reward of `compute_reward`."""
        playing = bool(self._playing[0])
        observation, _, terminated, truncated, info = super().step(action)
        info["terminated"], info["at_horizon"] = terminated, self._fleet.at_horizon(0)
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        reward = float(reward) if playing else 0.0
        return observation, reward, terminated, truncated, info


def check_render_mode(mode: str | None, modes: Sequence[str]) -> None:
    """Raises ValueError for a mode that is none of `modes`."""
    if mode is not None and mode not in modes:
        raise ValueError(f"render_mode: expected None or one of {', '.join(modes)}, got {mode!r}")


def check_options(options: Mapping[str, Any], *known: str) -> None:
    """Raises ValueError for an unknown option of a reset."""
    for name in options:
        if name not in known:
            names = " or ".join(repr(name) for name in known)
            raise ValueError(f"options: expected {names}, got {name!r}")


def check_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Actions as float64 of the shape wanted.

    Raises:
        ValueError: they are of another shape, or no numbers.

    """
    try:
        values = np.asarray(actions)
    except (TypeError, ValueError):  # rows of different lengths
        values = np.empty(0, dtype=object)
    if values.shape != shape or values.dtype.kind not in "fiu":
        wanted = "two finite numbers" if len(shape) == 1 else f"finite numbers of shape {shape}"
        many = values.ndim > 1 and values.dtype.kind in "fiu"
        raise ValueError(f"action: expected {wanted}, got {f'shape {values.shape}' if many else repr(actions)}")
    return np.ascontiguousarray(values, dtype=np.float64)


def disturbance_generator(seed: int | None) -> np.random.Generator:
    """The generator of the disturbances of an environment with this seed."""
    return np.random.default_rng(None if seed is None or seed < 0 else (seed, DISTURBANCE_STREAM))
