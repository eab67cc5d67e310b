"""Many robots at once: the vector form of the environments of `leapnav.envs.navigation`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from enum import Enum
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

from leapnav.envs import driving
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.fleet import Fleet
from leapnav.envs.goals import GoalConditioned
from leapnav.envs.navigation import (
    check_actions,
    check_options,
    check_render_mode,
    disturbance_generator,
)
from leapnav.envs.scenario import Scenario
from leapnav.envs.settings import Settings
from leapnav.envs.tasks import Tasks, scenario_of

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode as AutoresetMode
else:
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:  # Gymnasium 1.0, which d3rlpy asks for

        class AutoresetMode(Enum):
            """As Gymnasium has it from 1.1 on."""

            NEXT_STEP = "NextStep"
            SAME_STEP = "SameStep"
            DISABLED = "Disabled"


class NavigateVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """`NavigateEnv` for many robots, stepped together; each one's episodes are those that it would have alone.

    Args:
        num_envs: number of robots.
        family, scenario, split, bank: see `NavigateEnv`.
        autoreset_mode: an `AutoresetMode` or its value. "NextStep": the step after an episode's end starts the next
            one. "SameStep": the last step starts it, and `infos["final_obs"]` and `infos["final_info"]` have the end.
            "Disabled": `reset(options={"reset_mask": mask})` starts it.
        render_mode: None or "rgb_array"; `render` returns a frame of each robot.
        settings: the other arguments of `NavigateEnv`.

    Infos are arrays with masks, as Gymnasium has them; `pose` is (num_envs, 3). Of a bank's scenarios a reset tells
    `index` and `reference_cost`; `scenarios` has the scenarios themselves.

    Raises:
        TypeError: there is no such argument.
        ValueError, ScenarioError, FileNotFoundError, BankError: as for `NavigateEnv`.

    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    _goal_conditioned = False

    def __init__(
        self,
        num_envs: int = 1,
        family: str = "clutter",
        scenario: Any = None,
        *,
        split: str | None = None,
        bank: Any = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs: expected an integer >= 1, got {num_envs!r}")
        for name in settings:
            if name not in KNOWN:
                raise TypeError(f"{type(self).__name__}: unexpected argument {name!r}")
        self._tasks = Tasks(family, scenario, split, bank)
        self.settings = Settings(**settings, goal_conditioned=self._goal_conditioned)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode: expected one of {modes}, got {autoreset_mode!r}") from None
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.num_envs = int(num_envs)
        fps = max(1, round(1 / self.settings.control_period))
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode, "render_fps": fps}
        self.render_mode = render_mode
        self._fleet = Fleet(self.num_envs, self.settings)
        self.single_observation_space = self._fleet.layout.space
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._fleet.check(self._tasks.scenario, self.bank)
        self._choices: list[Scenario | int | None] = [None] * self.num_envs
        self._seeds: list[int] = [-1] * self.num_envs
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._noise_generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._trails: list[list[tuple[float, float, float]]] = [[] for _ in range(self.num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: of the first robot, the next ones following; or one for each.
            options: "scenario" and "index", each for all robots or a list of one for each; "reset_mask" (num_envs,),
                bool: the robots that start, all if not given.

        Raises:
            ValueError, ScenarioError, IndexError: as `NavigateEnv.reset`.

        """
        options = options or {}
        check_options(options, "scenario", "index", "reset_mask")
        mask = self._mask(options.get("reset_mask"))
        if not mask.all() and any(
            choice is None for choice, chosen in zip(self._choices, mask, strict=True) if not chosen
        ):
            raise gym.error.ResetNeeded("reset_mask: reset all robots before some")
        seeds = self._seeds_of(seed)
        robots = np.flatnonzero(mask)
        scenarios, indices = (self._each(name, options.get(name)) for name in ("scenario", "index"))
        given = [self._tasks.given(scenarios[i], indices[i]) for i in robots.tolist()]
        for choice in given:
            if choice is not None:
                self._fleet.check(choice, self.bank)
        for i in robots.tolist():  # nothing can fail from here on
            if seeds[i] is not None or self._generators[i] is None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
                self._noise_generators[i] = disturbance_generator(self._seeds[i]) if self.settings.disturbed else None
        self._begin(robots, given)
        return self._fleet.layout.divide(self._flat_observations()), self._infos(mask, mask)

    def _mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options: reset_mask: expected bool of shape ({self.num_envs},) and at least one True, "
                f"got {mask.dtype} of shape {mask.shape}"
            )
        return mask

    def _seeds_of(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """A seed for each robot."""
        if seed is None or (isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        elif isinstance(seed, (list, tuple, np.ndarray)):
            seeds = list(seed)
        else:
            raise ValueError(f"seed: expected an integer or a list of them, got {seed!r}")
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected one for each of {self.num_envs} robots, got {len(seeds)}")
        for value in seeds:
            if value is not None and (isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0):
                raise ValueError(f"seed: expected integers >= 0, got {value!r}")
        return [None if value is None else int(value) for value in seeds]

    def _each(self, name: str, value: Any) -> list[Any]:
        if isinstance(value, (list, tuple, np.ndarray)):
            if len(value) != self.num_envs:
                raise ValueError(f"options: {name}: expected one for each of {self.num_envs} robots, got {len(value)}")
            return list(value)
        return [value] * self.num_envs

    def _begin(self, robots: np.ndarray, given: Sequence[Scenario | int | None] | None = None) -> None:
        """Starts episodes of robots, given by number, with the scenarios given or drawn."""
        numbers = robots.tolist()
        choices = []
        for k, i in enumerate(numbers):
            generator = self._generators[i]
            assert generator is not None  # seeded at the first reset
            choice = None if given is None else given[k]
            choices.append(self._tasks.draw(generator) if choice is None else choice)
        noise = [self._noise_generators[i] for i in numbers] if self.settings.disturbed else []
        self._fleet.begin(robots, choices, self.bank, noise)
        for i, choice in zip(numbers, choices, strict=True):
            self._choices[i] = choice
        self._ended[robots] = False
        if self.render_mode is not None:
            for i in numbers:
                self._trails[i] = [tuple(self._fleet.poses[i].tolist())]

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Holds each robot's action for one control period.

        Raises:
            ResetNeeded: before the first reset, or without autoreset after an episode's end.
            ValueError: the actions are not finite numbers (num_envs, 2); nothing has changed then.

        """
        if self._choices[0] is None:
            raise gym.error.ResetNeeded("reset the environment before the first step")
        values = check_actions(actions, (self.num_envs, 2))
        restarting = self._ended.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED and restarting.any():
            raise gym.error.ResetNeeded(f"robot {int(np.argmax(restarting))}: its episode has ended; reset it first")
        fleet, state = self._fleet, self._fleet.state
        fleet.step(values, ~restarting)
        if self.render_mode is not None:
            for i in np.flatnonzero(~restarting).tolist():
                self._trails[i].append(tuple(fleet.poses[i].tolist()))
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and restarting.any():
            self._begin(np.flatnonzero(restarting))
        else:
            restarting = _NOBODY
        ended = state[:, driving.TERMINATED] > 0
        flat = self._flat_observations()
        rewards = self._rewards(flat, ended, restarting)
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            robots = np.flatnonzero(ended)
            observations = np.full(self.num_envs, None, dtype=object)
            for i in robots.tolist():
                observations[i] = fleet.layout.divide(flat[i].copy())
            infos = {"final_obs": observations, "_final_obs": ended.copy()}
            infos["final_info"], infos["_final_info"] = self._infos(ended), ended.copy()
            self._begin(robots)
            fleet.observe(flat, robots)
            restarting = ended
        self._ended = ended.copy() if self.autoreset_mode is not AutoresetMode.SAME_STEP else _nobody(self.num_envs)
        infos.update(self._infos(_everybody(self.num_envs), restarting))
        truncated = np.zeros(self.num_envs, dtype=bool)
        return fleet.layout.divide(flat), rewards, ended, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A frame of each robot, see `NavigateEnv.render`."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a render_mode, for example gym.make_vec(..., render_mode="rgb_array")')
            return None
        if self._choices[0] is None:
            raise gym.error.ResetNeeded("reset the environment before rendering it")
        return tuple(self._frame(i) for i in range(self.num_envs))

    def _frame(self, i: int) -> np.ndarray:
        from leapnav.envs.rendering import draw_scene, scene_of  # pygame loads only for those who look

        choice = self._choices[i]
        assert choice is not None  # checked
        return draw_scene(scene_of(self._fleet, i, choice, self.bank, self._trails[i]))

    @property
    def family(self) -> str:
        """The family of the scenarios."""
        return self._tasks.family

    @property
    def bank(self) -> ScenarioBank | None:
        """The bank of the scenarios, None if they come from elsewhere."""
        return self._tasks.bank

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenario of each robot's episode."""
        return tuple(scenario_of(choice, self.bank) for choice in self._choices if choice is not None)

    @property
    def indices(self) -> tuple[int | None, ...]:
        """The number of each robot's scenario in the bank, None if it is from elsewhere."""
        return tuple(choice if isinstance(choice, int) else None for choice in self._choices)

    @property
    def control_period(self) -> float:
        """How long an action is held, in s."""
        return self.settings.control_period

    @property
    def times(self) -> np.ndarray:
        """Seconds (num_envs,) since the start of each robot's episode."""
        return self._fleet.state[:, driving.TIME].copy()

    @property
    def poses(self) -> np.ndarray:
        """x, y (m) and unwrapped heading (rad) of each robot, (num_envs, 3)."""
        return self._fleet.poses.copy()

    @property
    def np_random(self) -> tuple[np.random.Generator | None, ...]:  # type: ignore[override] (as Gymnasium's own)
        """The generator that draws each robot's scenarios."""
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each robot's generator, -1 before the first reset."""
        return tuple(self._seeds)

    def _flat_observations(self) -> np.ndarray:
        flat = np.empty((self.num_envs, self._fleet.layout.size), np.float32)
        self._fleet.observe(flat)
        return flat

    def _rewards(self, flat: np.ndarray, ended: np.ndarray, restarted: np.ndarray) -> np.ndarray:
        return self._fleet.state[:, driving.REWARD].copy()

    def _infos(self, told: np.ndarray, restarted: np.ndarray | None = None) -> dict[str, Any]:
        """The infos of the robots in the mask `told`, and of those in `restarted` what a reset says."""
        state = self._fleet.state
        values: dict[str, Any] = {name: state[:, column].copy() for name, column in driving.INFOS.items()}
        for name, column in driving.FLAGS.items():
            values[name] = state[:, column] != 0.0
        values["pose"] = self._fleet.poses.copy()
        parts = {name: -state[:, column] for name, column in driving.PARTS.items()}
        if self.settings.reward == "shaped":
            parts["shaping"] = state[:, driving.SHAPING].copy()
        values["reward_parts"] = _masked(parts, told)
        infos = _masked(values, told)
        if restarted is not None and restarted.any():
            infos.update(self._reset_infos(restarted))
        return infos

    def _reset_infos(self, restarted: np.ndarray) -> dict[str, Any]:
        """What a reset tells of its robots beside the rest: the scenario, or its number in the bank and its optimum."""
        numbers = np.zeros(self.num_envs, dtype=np.int64)
        costs = np.zeros(self.num_envs)
        scenarios = np.full(self.num_envs, None, dtype=object)
        known = np.zeros(self.num_envs, dtype=bool)
        for i in np.flatnonzero(restarted).tolist():
            choice = self._choices[i]
            if isinstance(choice, int):
                numbers[i], known[i] = choice, True
            else:
                scenarios[i] = choice
        infos: dict[str, Any] = {}
        if known.any():
            assert self.bank is not None  # numbers are of a bank
            costs[known] = self.bank.costs[numbers[known]]
            infos.update(_masked({"index": numbers, "reference_cost": costs}, known))
        if (restarted & ~known).any():
            infos.update(_masked({"scenario": scenarios}, restarted & ~known))
        return infos


class NavigateGoalVectorEnv(GoalConditioned, NavigateVectorEnv):
    """`NavigateGoalEnv` for many robots, see `NavigateVectorEnv`."""

    _goal_conditioned = True

    def __init__(self, num_envs: int = 1, *args: Any, reward: str = "sparse", **arguments: Any) -> None:
        super().__init__(num_envs, *args, reward=reward, **arguments)

    def _rewards(self, flat: np.ndarray, ended: np.ndarray, restarted: np.ndarray) -> np.ndarray:
        observation = self._fleet.layout.divide(flat)
        infos: Any = None
        if self.settings.reward == "cost":
            told = self._infos(_everybody(self.num_envs))
            infos = [row_of(told, i) for i in range(self.num_envs)]
        rewards = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], infos)
        return np.where(restarted, 0.0, rewards)

    def _infos(self, told: np.ndarray, restarted: np.ndarray | None = None) -> dict[str, Any]:
        state = self._fleet.state
        ends = {
            "terminated": state[:, driving.TERMINATED] > 0,
            "at_horizon": state[:, driving.STEPS] >= state[:, driving.LAST_STEP],
        }
        stepped = told if restarted is None else told & ~restarted
        infos = super()._infos(told, restarted)
        return {**infos, **_masked(ends, stepped)} if stepped.any() else infos


# Arguments that go through to the settings.
KNOWN = frozenset(field.name for field in fields(Settings)) - {"goal_conditioned"}
_NOBODY = np.zeros(1, dtype=bool)  # broadcasts


def _nobody(count: int) -> np.ndarray:
    return np.zeros(count, dtype=bool)


def _everybody(count: int) -> np.ndarray:
    return np.ones(count, dtype=bool)


def _masked(values: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Infos as Gymnasium has them: beside each entry, which robots have it."""
    masks = {f"_{name}": mask.copy() for name in values}
    return {**values, **masks}


def row_of(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """What the infos of all robots tell of one."""
    row = {}
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        if mask is None or not mask[i]:  # a mask itself, or not told
            continue
        if isinstance(values, dict):
            row[name] = row_of(values, i)
        else:
            row[name] = values[i].item() if isinstance(values[i], np.generic) else values[i]
    return row
