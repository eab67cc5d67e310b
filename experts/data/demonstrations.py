"""Demonstrations: optima executed in the environment, and the Minari datasets that store them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from minari.data_collector import EpisodeBuffer

from leapnav.envs.episodes import play_episode
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.kernels.types import constant
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import CONTROL_PERIOD
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.data.datasets import Task, dataset_id, open_dataset, write_episodes
from leapnav.experts.hard_limits import without_barrier
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solve import solve

# A recovery starts from a perturbed state of the optimum.
PERTURBATION = np.array([0.15, 0.15, 0.3])  # standard deviations (m, m, rad)
MOTION_PERTURBATION = 0.1  # standard deviation of the further states (in their units)
PERTURBATION_DECAY = 0.5  # s; time constant with which the initial guess returns to the optimum
MIN_RECOVERY_TIME = 1.0  # s between the perturbation and the horizon; with less time the robot could not recover
MIN_RECOVERY_CLEARANCE = 0.02  # m
# A recovery that costs more than this factor times the remaining cost of the optimum, plus this summand, follows
# another local optimum and is dropped.
MAX_RECOVERY_COST = (2.0, 1.0)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode of the expert in the environment, K steps.

    Attributes:
        scenario: the scenario of the episode.
        observations: (K + 1, d).
        actions: (K, m), of the expert.
        executed: (K, m), the executed actions; with noise they differ from the expert's.
        rewards: (K,).
        states: (K + 1, n), x, y (m), heading (rad) and further states, as simulated.
        costates: (K + 1, n), of the optimum.
        cost_to_go: (K + 1,), of the optimum; the first entry is the reference cost J*.
        running_cost: (K,), cost of each environment step.
        is_success: whether the episode ended in success.
        seed: seed of the scenario, None if it has none.

    """

    scenario: Scenario
    observations: np.ndarray
    actions: np.ndarray
    executed: np.ndarray
    rewards: np.ndarray
    states: np.ndarray
    costates: np.ndarray
    cost_to_go: np.ndarray
    running_cost: np.ndarray
    is_success: bool
    seed: int | None = None

    @property
    def path(self) -> Trajectory:
        """States and costates at the ends of the control periods."""
        times = np.minimum(CONTROL_PERIOD * np.arange(len(self.states)), self.scenario.episode_limit)
        return Trajectory(times, self.states, self.costates)

    @property
    def reference_cost(self) -> float:
        """Cost J* of the scenario's optimum."""
        return float(self.cost_to_go[0])


def demonstrate(env: gym.Env, scenario: Scenario, extremal: Extremal) -> Demonstration:
    """Execute an optimum in the environment, without feedback; with feedback if the obstacles are hard.

    The optimum is about 1 mm away from hard obstacles, less than the error of the path without feedback.
    """
    inner = env.unwrapped
    assert isinstance(inner, NavigateEnv)
    if scenario.cost.obstacles == "hard":
        return demonstrate_disturbed(env, scenario, extremal, 0.0, np.random.default_rng(0))
    actions = plan_actions(extremal, scenario, inner.control_period)
    driven = _drive(env, scenario, lambda step: (actions[step], actions[step]) if step < len(actions) else None)
    times = np.minimum(inner.control_period * np.arange(len(driven["states"])), extremal.horizon)
    costates, cost_to_go = extremal.evaluate(times)[2], np.asarray(extremal.cost_to_go(times))
    costates = costates[:, : driven["states"].shape[1]]  # without that of the time
    return Demonstration(scenario=scenario, costates=costates, cost_to_go=cost_to_go, **driven)


def demonstrate_disturbed(
    env: gym.Env, scenario: Scenario, extremal: Extremal, noise: float, rng: np.random.Generator
) -> Demonstration:
    """Execute an optimum with feedback and with noise on the actions, and record the expert's own actions.

    Where the goal cannot be reached from the disturbed state, costate and cost-to-go are NaN, and the expert continues
    with the previous solution.

    Args:
        env: an environment of `leapnav/Navigate-v0`.
        scenario: the scenario of the episode.
        extremal: its optimum.
        noise: standard deviation of the noise that is added to the actions, which are in [-1, 1].
        rng: generator of the noise.

    """
    inner = env.unwrapped
    assert isinstance(inner, NavigateEnv)
    feedback = Feedback(scenario, extremal)
    robot = scenario.robot
    costates, costs = [], []

    def label() -> None:
        state, now = inner.state, inner.time
        cost, costate = np.nan, np.full(len(state), np.nan)
        if feedback.update(state, now):
            with suppress(ValueError):  # no solution with the tighter tolerance of a value
                cost, costate = feedback.value(state, now)
        costs.append(cost)
        costates.append(costate)

    def decide(step: int) -> tuple[np.ndarray, np.ndarray]:
        label()
        ahead = min(inner.control_period, scenario.episode_limit - inner.time) / 2
        action = np.clip(robot.actions(feedback.control(inner.time + ahead)), -1.0, 1.0).astype(np.float32)
        executed = np.clip(action + noise * rng.standard_normal(len(action)), -1.0, 1.0).astype(np.float32)
        return action, executed

    driven = _drive(env, scenario, decide)
    if scenario.horizon is None:  # the episode ends within the tolerances of the goal
        label()
    else:
        costs.append(0.0)
        costates.append(feedback.final_costate)
    return Demonstration(scenario=scenario, costates=np.array(costates), cost_to_go=np.array(costs), **driven)


def _drive(
    env: gym.Env, scenario: Scenario, decide: Callable[[int], tuple[np.ndarray, np.ndarray] | None]
) -> dict[str, Any]:
    """Play one episode; `decide(step)` returns the action to record and the action to execute, or None to stop."""
    actions: list[np.ndarray] = []

    def act(observation: Any, info: dict[str, Any]) -> np.ndarray | None:
        decided = decide(len(actions))
        if decided is None:
            return None
        action, executed = decided
        actions.append(action)
        return executed

    observation, info, steps = play_episode(env, act, options={"scenario": scenario})
    transitions = list(steps)
    return {
        "observations": np.stack([observation, *(step.observation for step in transitions)]),
        "actions": np.stack(actions),
        "executed": np.stack([step.action for step in transitions]),
        "rewards": np.array([step.reward for step in transitions]),
        "states": np.array([state_of(info), *(state_of(step.info) for step in transitions)]),
        "running_cost": np.diff([0.0, *(step.info["cost"] for step in transitions)]),
        "is_success": bool(transitions[-1].info["is_success"]),
    }


def state_of(info: dict[str, Any]) -> np.ndarray:
    """Return the robot's state (n,) from the info of a step."""
    return np.array([*info["pose"], *info.get("motion", ())])


def recovery(
    scenario: Scenario, extremal: Extremal, rng: np.random.Generator, name: str
) -> tuple[Scenario, Extremal] | None:
    """Solve the rest of a scenario from a perturbed state of its optimum.

    Args:
        scenario: the scenario.
        extremal: its optimum.
        rng: generator of the time and the size of the perturbation.
        name: name of the new scenario.

    Returns:
        The new scenario and its extremal; None if there is no suitable one.

    """
    time = rng.uniform(0.0, max(extremal.horizon - MIN_RECOVERY_TIME, 0.0))
    n = scenario.robot.sizes()[0]
    perturbation = rng.normal(size=n) * np.append(PERTURBATION, np.full(n - 3, MOTION_PERTURBATION))
    state = extremal.evaluate(time)[0][:n] + perturbation
    at_time = constant(np.append(state, time))
    if footprint_clearance(at_time, scenario.outline, scenario.field)[0] < MIN_RECOVERY_CLEARANCE or time == 0.0:
        return None
    rest = scenario.from_state(state, time).model_copy(update={"name": name})
    times = np.concatenate([[0.0], extremal.times[extremal.times > time + 1e-6] - time])
    states, costates = (values[:, :n] for values in extremal.evaluate(times + time)[::2])
    times[-1] = extremal.horizon - time
    states += perturbation * np.exp(-times / PERTURBATION_DECAY)[:, None]
    problem = OptimalControlProblem.from_scenario(rest).with_barrier(extremal.problem.barrier_weight)
    guess = Trajectory(times, states, costates)
    solution = without_barrier(solve(problem, "multiple_shooting", guess=guess))
    factor, summand = MAX_RECOVERY_COST
    if not solution.success or solution.cost > factor * float(extremal.cost_to_go(time)) + summand:
        return None
    return rest, solution


def write_dataset(
    demonstrations: Iterable[Demonstration],
    root: Path,
    family: str,
    robot: RobotModel,
    horizon: str = "fixed",
    obstacles: str = "cost",
) -> None:
    """Write a Minari dataset with state, costate and cost-to-go of every step.

    The scenario of an episode is its `options["scenario"]`, so `env.reset(options=...)` with the options that Minari
    stores starts the same episode again.

    Args:
        demonstrations: consumed one by one; they need not fit into memory together.
        root: root directory of Minari datasets.
        family: family of the scenarios.
        robot: the robot.
        horizon: "fixed" or "free".
        obstacles: "cost" or "hard".

    """
    write_episodes(
        (
            (demonstration.scenario, demonstration.reference_cost, _episode(number, demonstration))
            for number, demonstration in enumerate(demonstrations)
        ),
        root,
        dataset_id(family, robot.model, horizon, obstacles),
        Task(family, robot, horizon, obstacles),
        algorithm="leapnav.experts.find_optimum",
        description="Certified optima driven in the environment. Infos: state (x, y, heading, further states of the "
        "robot), control, expert_action, costate, cost_to_go, running_cost, reference_cost; the episode's scenario is "
        "options['scenario'] as JSON. The actions are the executed ones; the expert's without noise are in the infos. "
        "Reference scores: random actions and the optimum in the scenarios of eval_env.",
    )


def _episode(number: int, demonstration: Demonstration) -> EpisodeBuffer:
    steps = len(demonstration.actions)
    terminations = np.zeros(steps, dtype=bool)
    terminations[-1] = True
    controls = demonstration.scenario.robot.controls(demonstration.actions)
    return EpisodeBuffer(
        id=number,
        seed=demonstration.seed,
        options={"scenario": demonstration.scenario.to_json()},
        # Minari declares lists, but arrays work as well.
        observations=cast(list[Any], demonstration.observations),
        actions=cast(list[Any], demonstration.executed),
        rewards=demonstration.rewards.tolist(),
        terminations=terminations.tolist(),
        truncations=[False] * steps,
        # Infos have one entry more than the actions: the last control is repeated, the first running cost is zero.
        infos={
            "state": demonstration.states,
            "control": np.concatenate([controls, controls[-1:]]),
            "expert_action": np.concatenate([demonstration.actions, demonstration.actions[-1:]]),
            "costate": demonstration.costates,
            "cost_to_go": demonstration.cost_to_go,
            "running_cost": np.concatenate([[0.0], demonstration.running_cost]),
            "reference_cost": np.full(steps + 1, demonstration.reference_cost),
        },
    )


def load_demonstrations(folder: str | os.PathLike[str]) -> list[Demonstration]:
    """Load all demonstrations of a dataset written by `rollout` into memory.

    Raises:
        FileNotFoundError, ValueError: see `iterate_demonstrations`.

    """
    return list(iterate_demonstrations(folder))


def iterate_demonstrations(folder: str | os.PathLike[str]) -> Iterator[Demonstration]:
    """Yield the demonstrations of a dataset written by `rollout`.

    Raises:
        FileNotFoundError: see `open_dataset`.
        ValueError: the dataset was not written by `rollout`; the message names a missing entry.

    """
    dataset = open_dataset(folder)
    for episode, metadata in zip(
        dataset.iterate_episodes(), dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True
    ):
        infos = episode.infos or {}
        missing = sorted({"state", "expert_action", "costate", "cost_to_go", "running_cost"} - set(infos))
        text = (metadata.get("options") or {}).get("scenario")
        if missing or text is None:
            raise ValueError(
                f"{os.fspath(folder)}: episode {episode.id} has no {missing[0] if missing else 'scenario'}"
            )
        yield (
            Demonstration(
                scenario=Scenario.from_json(str(text)),
                observations=episode.observations,
                actions=infos["expert_action"][:-1],
                executed=episode.actions,
                rewards=np.asarray(episode.rewards),
                states=infos["state"],
                costates=infos["costate"],
                cost_to_go=infos["cost_to_go"],
                running_cost=infos["running_cost"][1:],
                is_success=True,  # `rollout` writes successful episodes only
                seed=metadata.get("seed"),
            )
        )
