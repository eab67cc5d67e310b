"""The vector environments: many robots simulated together in one process."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

from leapnav.envs.checks import check_actions, check_options, check_render_mode
from leapnav.envs.goals import GoalConditioned
from leapnav.envs.navigation import make_noise_generator
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import (
    LevelOutcome,
    LevelSampler,
    ScenarioSource,
    WithSpec,
    check_sampler,
    draw_level,
    get_scenario,
    reference_infos,
)
from leapnav.envs.settings import EnvironmentSettings, takes_settings
from leapnav.envs.simulation.simulator import BatchSimulator
from leapnav.envs.utils.validation import check_flag, check_integer, is_integer

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode as AutoresetMode
else:
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:  # Gymnasium 1.0, which d3rlpy requires

        class AutoresetMode(Enum):
            """The enum that Gymnasium provides since version 1.1."""

            NEXT_STEP = "NextStep"
            SAME_STEP = "SameStep"
            DISABLED = "Disabled"


class NavigateVectorEnv(WithSpec, VectorEnv[Any, np.ndarray, np.ndarray]):  # type: ignore[misc] (`spec` is a property)
    """`NavigateEnv` for many robots. The episodes of each are identical to those of a single environment.

    Infos are arrays with masks, as in Gymnasium; `pose` is (num_envs, 3). The scenarios of the episodes are the
    property `scenarios`.

    Args:
        num_envs: number of robots.
        family, scenario, split, bank, robot, horizon, obstacles: see `NavigateEnv`.
        sampler: chooses the scenario of the bank for each episode, and is told its outcome; needs a bank. The `spec` of
            an environment with a sampler has no form in JSON.
        autoreset_mode: an `AutoresetMode` or its value. "NextStep": the step after the end of an episode starts the
            next one. "SameStep": the last step starts the next episode, and `infos["final_obs"]` and
            `infos["final_info"]` describe the end. "Disabled": `reset(options={"reset_mask": mask})` starts it.
        max_episode_steps: number of steps after which an episode is truncated; None for no other end than those of
            `NavigateEnv`.
        render_mode: None or "rgb_array"; `render` returns a frame of each robot.
        show_optimum: see `NavigateEnv`.
        settings: the other arguments of `NavigateEnv`.

    Raises:
        TypeError: an argument is unknown.
        ValueError, ScenarioError, FileNotFoundError, BankError: see `NavigateEnv`.

    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    _goal_conditioned = False

    @takes_settings
    def __init__(
        self,
        num_envs: int = 1,
        family: str | None = None,
        scenario: Any = None,
        *,
        split: str | None = None,
        bank: Any = None,
        robot: Any = None,
        horizon: Any = None,
        obstacles: Any = None,
        sampler: LevelSampler | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        show_optimum: bool = False,
        **settings: Any,
    ) -> None:
        self.num_envs = check_integer("num_envs", num_envs, 1)
        self._max_steps = (
            None if max_episode_steps is None else check_integer("max_episode_steps", max_episode_steps, 1)
        )
        self._source = ScenarioSource(family, scenario, split, bank, robot, horizon, obstacles)
        if sampler is not None and self._source.bank is None:
            raise ValueError("sampler: expected an environment with a bank, got one of fresh or fixed scenarios")
        self._sampler = sampler
        if sampler is not None:
            check_sampler(sampler, self._source.bank)
        self.settings = EnvironmentSettings.of(self, self._source, settings)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode: expected one of {modes}, got {autoreset_mode!r}") from None
        check_render_mode(render_mode, self.metadata["render_modes"])
        fps = max(1, round(1 / self.settings.control_period))
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode, "render_fps": fps}
        check_flag("show_optimum", show_optimum)
        self.render_mode, self._show_optimum = render_mode, bool(show_optimum)
        self._simulator = BatchSimulator(self.num_envs, self.settings)
        self.single_observation_space = self._simulator.layout.space
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (self._source.robot.sizes()[1],), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._simulator.check(self._source.scenario, self.bank)
        self._choices: list[Scenario | int | None] = [None] * self.num_envs
        self._references: dict[str, np.ndarray] = {}  # of the scenarios in the bank, see `NavigateEnv`
        if self.bank is not None:
            kinds = {"index": np.int64, "reference_cost": np.float64, "lower_bound": np.float64}
            self._references = {name: np.zeros(self.num_envs, kind) for name, kind in kinds.items()}
        self._seeds: list[int] = [-1] * self.num_envs
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._noise_generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._all_robots, self._no_robots = np.ones(self.num_envs, dtype=bool), np.zeros(self.num_envs, dtype=bool)
        self._trails: list[list[tuple[float, float, float]]] = [[] for _ in range(self.num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: seed of the first robot, incremented for each following robot; or a list of one per robot.
            options: "scenario" and "index": one value for all robots, or a list of one per robot; "reset_mask"
                (num_envs,), bool: the robots that start an episode, by default all.

        Raises:
            ValueError, ScenarioError, IndexError: see `NavigateEnv.reset`.

        """
        options = options or {}
        check_options(options, "scenario", "index", "reset_mask")
        mask = self._check_mask(options.get("reset_mask"))
        if not mask.all() and any(
            choice is None for choice, chosen in zip(self._choices, mask, strict=True) if not chosen
        ):
            raise gym.error.ResetNeeded("reset_mask: reset all robots once before resetting some of them")
        seeds = self._check_seeds(seed)
        robots = np.flatnonzero(mask)
        scenarios, indices = (self._broadcast(name, options.get(name)) for name in ("scenario", "index"))
        selected = [self._source.select(scenarios[i], indices[i]) for i in robots.tolist()]
        for choice in selected:
            if choice is not None:
                self._simulator.check(choice, self.bank)
        for i in robots.tolist():  # all checks are done: a failed reset changes nothing
            if seeds[i] is not None or self._generators[i] is None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
                self._noise_generators[i] = make_noise_generator(self._seeds[i]) if self.settings.disturbed else None
        self._start(robots, selected)
        return self._simulator.layout.divide(self._flat_observations()), self._infos(mask)

    def _check_mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options: reset_mask: expected bool of shape ({self.num_envs},) and at least one True, "
                f"got {mask.dtype} of shape {mask.shape}"
            )
        return mask

    def _check_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Return one seed per robot."""
        if seed is None or is_integer(seed):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        elif isinstance(seed, (list, tuple, np.ndarray)):
            seeds = list(seed)
        else:
            raise ValueError(f"seed: expected an integer or a list of them, got {seed!r}")
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected one for each of {self.num_envs} robots, got {len(seeds)}")
        return [None if value is None else check_integer("seed", value, 0) for value in seeds]

    def _broadcast(self, name: str, value: Any) -> list[Any]:
        """Return one value of an option per robot."""
        if isinstance(value, (list, tuple, np.ndarray)):
            if len(value) != self.num_envs:
                raise ValueError(f"options: {name}: expected one for each of {self.num_envs} robots, got {len(value)}")
            return list(value)
        return [value] * self.num_envs

    def _start(self, robots: np.ndarray, selected: Sequence[Scenario | int | None] | None = None) -> None:
        """Start episodes of robots, given by index, with the selected or random scenarios."""
        indices = robots.tolist()
        choices = []
        for k, i in enumerate(indices):
            generator = self._generators[i]
            assert generator is not None  # seeded at the first reset
            choice = None if selected is None else selected[k]
            choices.append(draw_level(self._source, self._sampler, generator) if choice is None else choice)
        noise = [self._noise_generators[i] for i in indices] if self.settings.disturbed else []
        self._simulator.reset(robots, choices, self.bank, noise)
        for i, choice in zip(indices, choices, strict=True):
            self._choices[i] = choice
            if self.bank is not None:
                for name, value in reference_infos(choice, self.bank).items():
                    self._references[name][i] = value
        self._ended[robots] = False
        if self.render_mode is not None:
            for i in indices:
                self._trails[i] = [tuple(self._simulator.states[i, :3].tolist())]

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold each robot's action for one control period.

        Raises:
            ResetNeeded: before the first reset, or without autoreset after the end of an episode.
            ValueError: the actions are not finite numbers (num_envs, m); the state is unchanged then.

        """
        if self._choices[0] is None:
            raise gym.error.ResetNeeded("reset the environment before the first step")
        values = check_actions(actions, (self.num_envs, self.settings.model.sizes()[1]))
        restarting = self._ended.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED and restarting.any():
            raise gym.error.ResetNeeded(f"robot {int(np.argmax(restarting))}: its episode has ended; reset it first")
        simulator, episodes = self._simulator, self._simulator.episodes
        simulator.step(values, ~restarting)
        if self._max_steps is not None:
            is_late = (episodes["steps"] >= self._max_steps) & ~episodes["terminated"] & ~restarting
            episodes["truncated"][is_late] = True
        if self.render_mode is not None:
            for i in np.flatnonzero(~restarting).tolist():
                self._trails[i].append(tuple(simulator.states[i, :3].tolist()))
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and restarting.any():
            self._start(np.flatnonzero(restarting))
        else:
            restarting = self._no_robots
        terminated, truncated = episodes["terminated"].copy(), episodes["truncated"].copy()
        ended = terminated | truncated
        if self._sampler is not None:
            self._record_outcomes(self._sampler, ended & ~restarting)
        flat = self._flat_observations()
        rewards = self._rewards(flat, ended, restarting)
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            robots = np.flatnonzero(ended)
            observations = np.full(self.num_envs, None, dtype=object)
            for i in robots.tolist():
                observations[i] = simulator.layout.divide(flat[i].copy())
            infos = {"final_obs": observations, "_final_obs": ended.copy()}
            infos["final_info"], infos["_final_info"] = self._infos(ended), ended.copy()
            self._start(robots)
            simulator.observe(flat, robots)
            restarting = ended
        self._ended = (self._no_robots if self.autoreset_mode is AutoresetMode.SAME_STEP else ended).copy()
        infos.update(self._infos(self._all_robots))
        return simulator.layout.divide(flat), rewards, terminated, truncated, infos

    def _record_outcomes(self, sampler: LevelSampler, ended: np.ndarray) -> None:
        """Tell the sampler the outcomes of the episodes that have ended."""
        bank = self.bank
        assert bank is not None  # required for a sampler
        for i in np.flatnonzero(ended).tolist():
            index, episode = self._choices[i], self._simulator.episode(i)
            if not isinstance(index, int):  # selected by a reset
                continue
            collision = episode.collided
            missed = self.settings.miss_penalty * (episode.miss > 0.0)  # in full, also if it is graded
            value = -episode.cost - self.settings.collision_penalty * collision - missed
            regret = -float(bank.costs[index]) - value
            sampler.record(LevelOutcome(index, episode.success, collision, value, regret))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a frame of each robot, see `NavigateEnv.render`."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a render_mode, for example gym.make_vec(..., render_mode="rgb_array")')
            return None
        if self._choices[0] is None:
            raise gym.error.ResetNeeded("reset the environment before rendering it")
        return tuple(self._frame(i) for i in range(self.num_envs))

    def _frame(self, i: int) -> np.ndarray:
        from leapnav.envs.simulation.rendering import draw_scene, make_scene  # imports pygame

        choice = self._choices[i]
        assert choice is not None  # checked by `render`
        return draw_scene(
            make_scene(self._simulator, i, choice, self.bank, self._trails[i], show_optimum=self._show_optimum)
        )

    @property
    def family(self) -> str:
        """The family of the scenarios."""
        return self._source.family

    @property
    def source(self) -> ScenarioSource:
        """The source of the scenarios, from which workers in other processes can draw."""
        return self._source

    @property
    def bank(self) -> ScenarioBank | None:
        """The bank of the scenarios, or None."""
        return self._source.bank

    @property
    def sampler(self) -> LevelSampler | None:
        """The sampler of the levels, or None."""
        return self._sampler

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The current scenario of each robot."""
        return tuple(get_scenario(choice, self.bank) for choice in self._choices if choice is not None)

    @property
    def indices(self) -> tuple[int | None, ...]:
        """The index of each robot's current scenario in the bank, None if it is not from a bank."""
        return tuple(choice if isinstance(choice, int) else None for choice in self._choices)

    @property
    def control_period(self) -> float:
        """Duration of an action (s)."""
        return self.settings.control_period

    @property
    def times(self) -> np.ndarray:
        """Time since the start of each robot's episode (num_envs,) (s)."""
        return self._simulator.episodes["time"].copy()

    @property
    def poses(self) -> np.ndarray:
        """x, y (m) and heading (rad, unwrapped) of each robot, (num_envs, 3)."""
        return self._simulator.states[:, :3].copy()

    @property
    def states(self) -> np.ndarray:
        """The state of each robot (num_envs, n): the pose and the further states of its model."""
        return self._simulator.states.copy()

    @property
    def np_random(self) -> tuple[np.random.Generator | None, ...]:  # type: ignore[override] (the same in Gymnasium)
        """The random generator of each robot's scenarios."""
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each robot's generator, -1 before the first reset."""
        return tuple(self._seeds)

    def _flat_observations(self) -> np.ndarray:
        flat = np.empty((self.num_envs, self._simulator.layout.size), np.float32)
        self._simulator.observe(flat)
        return flat

    def _rewards(self, flat: np.ndarray, ended: np.ndarray, restarted: np.ndarray) -> np.ndarray:
        return self._simulator.episodes["reward"].copy()

    def _infos(self, mask: np.ndarray) -> dict[str, Any]:
        """Return the infos of the robots in `mask`."""
        episodes, states = self._simulator.episodes, self._simulator.states
        names = {"cost": "cost", "clearance": "clearance", "time": "time"}
        names |= {"collision": "collided", "is_success": "success"}
        names |= {name: name for name in ("goal_distance", "heading_error")}
        values: dict[str, Any] = {name: episodes[field].copy() for name, field in names.items()}
        values["pose"] = states[:, :3].copy()
        if states.shape[1] > 3:
            values["motion"] = states[:, 3:].copy()
        values |= {f"reward_{name}": -episodes[name] for name in ("effort", "proximity", "collision", "miss")}
        if self.settings.free_horizon:
            values["reward_time"] = -episodes["time_cost"]
        if self.settings.shaped:
            values["reward_shaping"] = episodes["shaping"].copy()
        values |= {name: column.copy() for name, column in self._references.items()}
        return _add_masks(values, mask)


class NavigateGoalVectorEnv(GoalConditioned, NavigateVectorEnv):
    """`NavigateGoalEnv` for many robots, see `NavigateVectorEnv`."""

    _goal_conditioned = True

    def __init__(self, num_envs: int = 1, *args: Any, reward: str = "sparse", **arguments: Any) -> None:
        super().__init__(num_envs, *args, reward=reward, **arguments)

    def _rewards(self, flat: np.ndarray, ended: np.ndarray, restarted: np.ndarray) -> np.ndarray:
        observation = self._simulator.layout.divide(flat)
        infos: Any = None
        if self.settings.reward == "cost":
            batch = self._infos(np.ones(self.num_envs, dtype=bool))
            infos = [select_robot(batch, i) for i in range(self.num_envs)]
        rewards = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], infos)
        return np.where(restarted, 0.0, rewards)

    def _infos(self, mask: np.ndarray) -> dict[str, Any]:
        episodes = self._simulator.episodes
        ends = {"terminated": episodes["terminated"].copy(), "at_horizon": episodes["steps"] >= episodes["last_step"]}
        return {**super()._infos(mask), **_add_masks(ends, mask)}


def _add_masks(values: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return infos in Gymnasium's vector format: each key with a mask of the robots that have it."""
    masks = {f"_{name}": mask.copy() for name in values}
    return {**values, **masks}


def select_robot(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """Return the info of one robot from the infos of all."""
    info = {}
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        if mask is None or not mask[i]:  # a mask itself, or an entry that the robot does not have
            continue
        if isinstance(values, dict):  # those of the end of an episode
            info[name] = select_robot(values, i)
        else:
            info[name] = values[i].item() if isinstance(values[i], np.generic) else values[i]
    return info
