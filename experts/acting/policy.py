"""The expert as a policy, with the interface of Stable-Baselines3."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.unwrapping import Situation, action_scale, situations, unwrap
from leapnav.envs.utils.validation import as_matrix, as_vector, check_choice
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.acting.gains import Gains
from leapnav.experts.optimum import EFFORTS, Effort, find_optimum
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import Trajectory

FEEDBACKS = ("resolve", "gains", "none")
MIN_THREADED_ROBOTS = 8  # with fewer robots, threads cost more time than they save


class NoOptimumError(RuntimeError):
    """The expert has no certified optimum of a scenario. The message contains the scenario and the solver's status.

    Attributes:
        scenario: the scenario.

    """

    scenario: Scenario

    def __init__(self, message: str, scenario: Scenario) -> None:
        super().__init__(message)
        self.scenario = scenario


def plan_actions(extremal: Extremal, scenario: Scenario, control_period: float) -> np.ndarray:
    """The optimum as actions (K, m) in [-1, 1], one per control period of the environment.

    Each action is the optimal control in the middle of its period; for a robot with further states it is the mean over
    the period, with which the states that integrate a control have no error. The environment integrates held controls
    exactly, so the error of the resulting path is of second order in the control period. If the horizon is free, the
    episode usually ends before the last actions, within the tolerances of the goal.
    """
    horizon = extremal.horizon if scenario.horizon is None else scenario.horizon
    count = max(1, math.ceil(horizon / control_period - 1e-6))
    starts = control_period * np.arange(count)
    ends = np.minimum(starts + control_period, horizon)
    middles = (starts + ends) / 2
    controls = extremal.evaluate(middles)[1]
    if scenario.robot.sizes()[0] > 3:  # Simpson's rule
        controls = (extremal.evaluate(starts)[1] + 4.0 * controls + extremal.evaluate(ends)[1]) / 6.0
    return scenario.robot.actions(controls).astype(np.float32)


@dataclass
class _Robot:
    """The solution of one robot's episode.

    Attributes:
        solved: whether the last action is that of a solution from the state at its time.
        progress: time (s) of the point of the extremal to which the gains apply.

    """

    scenario: Scenario
    time: float
    middle: np.ndarray
    half: np.ndarray
    feedback: Feedback
    gains: Gains | None
    solved: bool = False
    progress: float = 0.0


def _check_reference(scenario: Scenario, path: Trajectory) -> Trajectory:
    """Return the optimum of a scenario as arrays that kernels can read."""
    n = len(scenario.robot.state_names)
    times = as_vector("references: times", path.times)
    states = as_matrix("references: states", path.states, len(times), n)
    costates = None if path.costates is None else as_matrix("references: costates", path.costates, len(times), n)
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError(f"references: times: expected at least two increasing numbers, got {times}")
    return Trajectory(times, states, costates)


class ExpertPolicy:
    """Optimal policy for all robots of an environment, from any state.

    Args:
        env: the environment that the actions are for: `NavigateEnv` or `NavigateVectorEnv`, wrapped or not, or a
            Stable-Baselines3 `VecEnv` of them. Scenarios, states and times are read from it; the observations given to
            `predict` are ignored. The actions are those of the wrapped environment, also with `RescaleAction`.
        references: known optima of scenarios, with costates. The optima of a bank are read from the bank; all others
            are computed at the first step of an episode.
        feedback: "resolve": at each step the optimal control from the current state and time, re-solved from the
            solution of the previous step, or found by a new search if that fails. "gains": neighbouring-extremal gains
            along the optimum from the start, much faster, and accurate close to that optimum. "none": the optimum
            from the start, without feedback.
        effort: effort of the searches, see `find_optimum`.
        workers: number of threads for several robots; None uses one per core.

    Raises:
        TypeError: the environment is not one of leapnav's.
        ValueError: `feedback` or `effort` is unknown, a reference has a wrong shape, or the environment has an action
            wrapper other than `RescaleAction` and `ClipAction`.

    """

    def __init__(
        self,
        env: Any,
        references: Mapping[Scenario, Trajectory] | None = None,
        *,
        feedback: Literal["resolve", "gains", "none"] = "resolve",
        effort: Effort = "medium",
        workers: int | None = None,
    ) -> None:
        check_choice("feedback", feedback, FEEDBACKS)
        check_choice("effort", effort, EFFORTS)
        self._effort: Effort = effort
        self._envs, self._is_batch = unwrap(env), hasattr(env, "num_envs")
        self._factor, self._offset = action_scale(env)
        self._n, self._m = self._envs[0].settings.model.sizes()
        self._references = {s: _check_reference(s, path) for s, path in (references or {}).items()}
        self._feedback = feedback
        self._workers = workers or os.cpu_count() or 1
        self._robots: list[_Robot | None] = [None] * sum(getattr(inner, "num_envs", 1) for inner in self._envs)

    def drives(self, env: Any) -> bool:
        """Whether the policy belongs to an environment."""
        others = unwrap(env)
        return len(self._envs) == len(others) and all(map(operator.is_, self._envs, others))

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of an equal expert for another environment."""
        return {"feedback": self._feedback, "effort": self._effort}

    @property
    def searches(self) -> int:
        """Number of new searches in the robots' current episodes."""
        return sum(robot.feedback.searches for robot in self._robots if robot is not None)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for the environment's current step, and `state` unchanged.

        Actions have shape (m,), or (N, m) for a vector environment.

        Raises:
            NoOptimumError: a scenario has no certified optimum.

        """
        found = self._factor * np.array(self._each(self._act, situations(self._envs))) + self._offset
        actions = found.astype(np.float32)
        return (actions if self._is_batch else cast(np.ndarray, actions[0])), state

    def value(self, state: Any = None, time: Any = None) -> Any:
        """Return the cost-to-go J* from the robots' states, or from other states in their episodes.

        It is the cost of the local optimum that continues the robot's current one. After a small disturbance this is
        still the best optimum, after a large one it may not be.

        Args:
            state: states of the robots, shape (n,), or (N, n) for several robots; None: the current states.
            time: s since the start of the episode, a number or (N,); None: the current times. If the horizon is free,
                the value depends on the state alone.

        Returns:
            A float, or shape (N,) for several robots.

        Raises:
            ValueError: no optimum was found from a state.
            NoOptimumError: a scenario has no certified optimum.

        """
        values = [value for value, _ in self._ask(state, time)]
        return np.array(values) if len(values) > 1 else values[0]

    def costate(self, state: Any = None, time: Any = None) -> np.ndarray:
        """Return the gradient of `value` with respect to the state, (n,) or (N, n); arguments and errors as there."""
        costates = [costate for _, costate in self._ask(state, time)]
        return np.array(costates) if len(costates) > 1 else costates[0]

    def labels(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the cost-to-go (N,) and costate (N, n) that the last `predict` computed.

        They are accurate to 1e-6, and NaN if the goal could not be reached. All are NaN unless the feedback is
        "resolve".
        """
        found = [
            robot.feedback.stored if robot is not None and robot.solved else (math.nan, np.full(self._n, math.nan))
            for robot in self._robots
        ]
        return np.array([cost for cost, _ in found]), np.array([costate for _, costate in found])

    def _ask(self, state: Any, time: Any) -> list[tuple[float, np.ndarray]]:
        found = situations(self._envs)
        count = len(found)
        if state is not None:
            states = np.asarray(state, dtype=float)
            shape = count, self._n
            if states.shape not in (shape, shape[1:]) or not np.isfinite(states).all():
                raise ValueError(f"state: expected finite numbers of shape {shape}, got {state!r}")
            found = [replace(s, state=p) for s, p in zip(found, np.broadcast_to(states, shape), strict=True)]
        times = [s.time for s in found] if time is None else np.broadcast_to(time, (count,)).tolist()
        for situation, t in zip(found, times, strict=True):
            end = math.inf if situation.scenario.horizon is None else situation.scenario.horizon
            if not 0.0 <= t < end:
                raise ValueError(f"time: expected a number from 0 to {end:g}, got {t!r}")

        def ask(i: int, situation: Situation) -> tuple[float, np.ndarray]:
            return self._robot(i, situation).feedback.value(situation.state, times[i])

        return self._each(ask, found)

    def _act(self, i: int, situation: Situation) -> np.ndarray:
        left = situation.scenario.episode_limit - situation.time
        if left <= 0.0:  # the episode has ended
            return np.zeros(self._m)
        robot = self._robot(i, situation)
        ahead = min(situation.period, left) / 2
        if robot.gains is not None:
            is_free = situation.scenario.horizon is None
            point = robot.feedback.with_time(situation.state, situation.time)
            robot.progress = robot.gains.closest(point, robot.progress) if is_free else situation.time
            control = robot.gains.control(point, robot.progress, ahead)
        else:
            if self._feedback == "resolve":
                robot.solved = robot.feedback.update(situation.state, situation.time)
            control = robot.feedback.control(situation.time + ahead)
        return (control - robot.middle) / robot.half

    def _robot(self, i: int, situation: Situation) -> _Robot:
        """The solution of a robot's episode; a new episode is looked up or solved."""
        robot = self._robots[i]
        if robot is not None and robot.scenario is situation.scenario and situation.time >= robot.time:
            robot.time = situation.time
            return robot
        scenario = situation.scenario
        path = self._references.get(scenario)
        if path is None and situation.bank is not None and situation.index is not None:
            reference = situation.bank.reference(situation.index)
            path = Trajectory(reference.times, reference.states.astype(float), reference.costates.astype(float))
        if path is None:
            optimum = find_optimum(scenario, self._effort)
            if not optimum.success:
                message = f"scenario {scenario.name!r}: {optimum.status.name}: {optimum.status.value}"
                raise NoOptimumError(message, scenario)
            path = optimum
        try:
            feedback = Feedback(scenario, path, effort=self._effort)
            gains = feedback.gains() if self._feedback == "gains" else None
        except (ValueError, FloatingPointError) as error:
            raise NoOptimumError(str(error), scenario) from None
        robot = _Robot(scenario, situation.time, *scenario.robot.action_scale(), feedback, gains)
        self._robots[i] = robot
        return robot

    def _each(self, function: Callable[[int, Situation], Any], situations: list[Situation]) -> list[Any]:
        """Call a function for all robots, in threads; the kernels release the global interpreter lock."""
        numbered = list(enumerate(situations))
        if len(numbered) < MIN_THREADED_ROBOTS or self._workers == 1:
            return [function(i, situation) for i, situation in numbered]
        size = math.ceil(len(numbered) / self._workers)
        parts = [numbered[first : first + size] for first in range(0, len(numbered), size)]
        with ThreadPoolExecutor(self._workers) as pool:
            values = pool.map(lambda part: [function(i, situation) for i, situation in part], parts)
            return [value for part in values for value in part]
