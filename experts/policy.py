"""The expert as a policy, with the interface of Stable-Baselines3."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenario import Scenario
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.experts.extremal import Extremal
from leapnav.experts.feedback import Feedback, Gains
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem import Path

FEEDBACKS = ("resolve", "gains", "none")
FEWEST_ROBOTS = 8  # for which threads are worth their while


class NoOptimumError(RuntimeError):
    """The expert has no certified optimum of a scenario. The message names the scenario and the solver's status.

    Attributes:
        scenario: which one.

    """

    def __init__(self, message: str, scenario: Scenario) -> None:
        super().__init__(message)
        self.scenario = scenario


def plan_actions(extremal: Extremal, scenario: Scenario, control_period: float) -> np.ndarray:
    """The optimum as actions (K, 2) in [-1, 1], one for each control period of the environment.

    Each is the optimal control in the middle of its period, which the exact arcs turn back into the optimum up to the
    square of the period.
    """
    count = max(1, math.ceil(scenario.horizon / control_period - 1e-6))
    starts = control_period * np.arange(count)
    middles = (starts + np.minimum(starts + control_period, scenario.horizon)) / 2
    limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
    return (extremal.evaluate(middles)[1] / limits).astype(np.float32)


@dataclass(frozen=True)
class _Situation:
    """Where a robot is."""

    scenario: Scenario
    index: int | None
    bank: ScenarioBank | None
    pose: np.ndarray
    time: float
    period: float


@dataclass
class _Robot:
    """What the expert knows of one robot's episode."""

    scenario: Scenario
    time: float
    limits: np.ndarray
    feedback: Feedback
    gains: Gains | None
    label: tuple[float, np.ndarray] = (math.nan, np.full(3, math.nan))  # cost-to-go and costate of the last action


class ExpertPolicy:
    """Drives each robot of an environment optimally, from wherever it is.

    Args:
        env: the environment that the actions are for: `NavigateEnv` or `NavigateVectorEnv`, wrapped or not, or a
            Stable-Baselines3 `VecEnv` of them. The scenarios, poses and times are read from it; the observations that
            `predict` is given are not looked at.
        references: optima of scenarios that are known already (with costates); a bank's are read from it, and others
            are found at an episode's first step.
        feedback: "resolve": at each step the optimal control from the current state and time left, re-solved from the
            step before, or found by a new search where that fails. "gains": neighbouring-extremal gains along the
            optimum of the episode's start, a hundred times cheaper and good near it. "none": the optimum of the start,
            whatever happens.
        quick: search the most promising ways only, see `find_optimum`: for a teacher, who looks for many optima and can
            do without some of them.
        workers: threads for many robots; None for one on each core.

    Raises:
        TypeError: the environment is none of leapnav's.
        ValueError: there is no such feedback.

    """

    def __init__(
        self,
        env: Any,
        references: Mapping[Scenario, Path] | None = None,
        *,
        feedback: Literal["resolve", "gains", "none"] = "resolve",
        quick: bool = False,
        workers: int | None = None,
    ) -> None:
        if feedback not in FEEDBACKS:
            raise ValueError(f"feedback: expected one of {', '.join(FEEDBACKS)}, got {feedback!r}")
        self._quick = quick
        self._envs = _environments(env)
        self._references = dict(references or {})
        self._feedback = feedback
        self._workers = workers or os.cpu_count() or 1
        self._robots: list[_Robot | None] = [None] * sum(getattr(inner, "num_envs", 1) for inner in self._envs)

    def drives(self, env: Any) -> bool:
        """Whether these are the robots of an environment."""
        return all(one is other for one, other in zip(self._envs, _environments(env), strict=False))

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments that make another expert like this one."""
        return {"feedback": self._feedback, "quick": self._quick}

    @property
    def searches(self) -> int:
        """How many new searches the robots' current episodes needed."""
        return sum(robot.feedback.searches for robot in self._robots if robot is not None)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The actions for the environment's current step, (2,) or for many robots (N, 2), and the state unchanged.

        Raises:
            NoOptimumError: a scenario has no certified optimum.

        """
        actions = np.array(self._each(self._act, self._situations()), dtype=np.float32)
        batched = np.ndim(next(iter(observation.values())) if isinstance(observation, Mapping) else observation) > 1
        return (actions if batched else cast(np.ndarray, actions[0])), state

    def value(self, state: Any = None, time: Any = None) -> Any:
        """Cost-to-go J* from the robots' states, or from others in their episodes.

        It is that of the local optimum which continues the one that the robot is on: after a small push still the best
        one, after a large push maybe not.

        Args:
            state: x, y (m), heading (rad): (3,), or for many robots (N, 3); None for where they are.
            time: s since the start of the episode, a number or (N,); None for now.

        Returns:
            A float, or for many robots (N,).

        Raises:
            ValueError: there is no optimum from there.
            NoOptimumError: a scenario has no certified optimum.

        """
        values = [value for value, _ in self._ask(state, time)]
        return np.array(values) if len(values) > 1 else values[0]

    def costate(self, state: Any = None, time: Any = None) -> np.ndarray:
        """The gradient of `value` by the state, (3,) or for many robots (N, 3); arguments and errors are the same."""
        costates = [costate for _, costate in self._ask(state, time)]
        return np.array(costates) if len(costates) > 1 else costates[0]

    def labels(self) -> tuple[np.ndarray, np.ndarray]:
        """Cost-to-go (N,) and costate (N, 3) that the last `predict` acted on, at no further cost.

        They are good to 1e-6, and NaN where the goal was out of reach. With feedback other than "resolve" all are NaN.
        """
        found = [(math.nan, np.full(3, math.nan)) if robot is None else robot.label for robot in self._robots]
        return np.array([cost for cost, _ in found]), np.array([costate for _, costate in found])

    def _ask(self, state: Any, time: Any) -> list[tuple[float, np.ndarray]]:
        situations = self._situations()
        count = len(situations)
        if state is not None:
            states = np.asarray(state, dtype=float)
            if states.shape not in ((count, 3), (3,)) or not np.isfinite(states).all():
                raise ValueError(f"state: expected finite numbers of shape {(count, 3)}, got {state!r}")
            situations = [
                replace(s, pose=p) for s, p in zip(situations, np.broadcast_to(states, (count, 3)), strict=True)
            ]
        times = [s.time for s in situations] if time is None else np.broadcast_to(time, (count,)).tolist()
        for situation, t in zip(situations, times, strict=True):
            if not 0.0 <= t < situation.scenario.horizon:
                raise ValueError(f"time: expected a number from 0 to {situation.scenario.horizon:g}, got {t!r}")

        def ask(i: int, situation: _Situation) -> tuple[float, np.ndarray]:
            return self._robot(i, situation).feedback.value(situation.pose, times[i])

        return self._each(ask, situations)

    def _act(self, i: int, situation: _Situation) -> np.ndarray:
        left = situation.scenario.horizon - situation.time
        if left <= 0.0:  # an episode that has ended
            return np.zeros(2)
        robot = self._robot(i, situation)
        ahead = min(situation.period, left) / 2
        if robot.gains is not None:
            control = robot.gains.control(situation.pose, situation.time, ahead)
        else:
            if self._feedback == "resolve":
                solved = robot.feedback.update(situation.pose, situation.time)
                robot.label = robot.feedback.stored if solved else (math.nan, np.full(3, math.nan))
            control = robot.feedback.control(situation.time + ahead)
        return control / robot.limits

    def _robot(self, i: int, situation: _Situation) -> _Robot:
        """What is known of a robot's episode; a new one is looked up or solved."""
        robot = self._robots[i]
        if robot is not None and robot.scenario is situation.scenario and situation.time >= robot.time:
            robot.time = situation.time
            return robot
        scenario = situation.scenario
        path = self._references.get(scenario)
        if path is None and situation.bank is not None and situation.index is not None:
            reference = situation.bank.reference(situation.index)
            path = Path(reference.times, reference.states.astype(float), reference.costates.astype(float))
        if path is None:
            optimum = find_optimum(scenario, thorough=not self._quick)
            if not optimum.success:
                message = f"scenario {scenario.name!r}: {optimum.status.name}: {optimum.status.value}"
                raise NoOptimumError(message, scenario)
            path = Path(optimum.times, optimum.states, optimum.costates)
        try:
            feedback = Feedback(scenario, path, quick=self._quick)
        except ValueError as error:
            raise NoOptimumError(str(error), scenario) from None
        limits = np.array([scenario.robot.max_speed, scenario.robot.max_turn_rate])
        gains = feedback.gains() if self._feedback == "gains" else None
        robot = _Robot(scenario, situation.time, limits, feedback, gains)
        self._robots[i] = robot
        return robot

    def _situations(self) -> list[_Situation]:
        """Where each robot is."""
        found: list[_Situation] = []
        for env in self._envs:
            period, bank = env.control_period, env.bank
            if isinstance(env, NavigateEnv):
                found.append(_Situation(env.scenario, env.index, bank, np.array(env.pose), env.time, period))
            else:
                rows = zip(env.scenarios, env.indices, env.poses, env.times.tolist(), strict=True)
                found += [_Situation(scenario, i, bank, pose, time, period) for scenario, i, pose, time in rows]
        return found

    def _each(self, function: Callable[[int, _Situation], Any], situations: list[_Situation]) -> list[Any]:
        """The function's values for all robots; the kernels release the interpreter, so threads share the cores."""
        numbered = list(enumerate(situations))
        if len(numbered) < FEWEST_ROBOTS or self._workers == 1:
            return [function(i, situation) for i, situation in numbered]
        size = math.ceil(len(numbered) / self._workers)
        parts = [numbered[first : first + size] for first in range(0, len(numbered), size)]
        with ThreadPoolExecutor(self._workers) as pool:
            values = pool.map(lambda part: [function(i, situation) for i, situation in part], parts)
            return [value for part in values for value in part]


def _environments(env: Any) -> list[NavigateEnv | NavigateVectorEnv]:
    """The environments of leapnav inside one, however it is wrapped."""
    while hasattr(env, "venv"):  # Stable-Baselines3's wrappers, and leapnav's adapter
        env = env.venv
    env = getattr(env, "unwrapped", env)
    inner = [getattr(one, "unwrapped", one) for one in getattr(env, "envs", [env])]
    for one in inner:
        if not isinstance(one, (NavigateEnv, NavigateVectorEnv)):
            raise TypeError(f"env: expected leapnav's environment, got {type(one).__name__}")
    return inner
