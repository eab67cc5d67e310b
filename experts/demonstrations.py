"""Demonstrations: optima driven in the environment, and the Minari datasets that hold them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, cast

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

import leapnav
from leapnav.envs.families import LONGEST_HORIZON
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.obstacles import clearance
from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal
from leapnav.experts.feedback import Feedback
from leapnav.experts.methods import solve
from leapnav.experts.policy import plan_actions
from leapnav.experts.problem import Path

ENVIRONMENT = "leapnav/Navigate-v0"
CONTROL_PERIOD = 0.05  # s, the environment's by default, in which demonstrations are driven
# A recovery starts from a state of the optimum pushed by this much (m, m, rad; standard deviations).
PUSH = np.array([0.15, 0.15, 0.3])
PUSH_FADES = 0.5  # s over which the guess returns to the optimum
LAST_PUSH = 1.0  # s before the horizon: later the robot could not recover
PUSH_CLEARANCE = 0.02  # m
# Of a dataset's environment. No episode is as long, but d3rlpy insists on a limit.
MOST_STEPS = math.ceil(LONGEST_HORIZON / CONTROL_PERIOD) + 1
SCORED = 100  # scenarios that random actions are scored on
# A pushed robot whose solution costs this much more than the rest of the optimum has left for another local optimum.
RECOVERY_COST = (2.0, 1.0)  # factor, summand


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode of the expert in the environment, K steps.

    observations (K + 1, d), actions (K, 2) of the expert and those executed, rewards (K,), states (K + 1, 3) as driven;
    from the optimum: costates (K + 1, 3) and cost_to_go (K + 1,), whose first entry is the reference cost J*.
    `running_cost` (K,) is what the environment charged in each step. `seed` is the scenario's, None if it has none.
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
    def path(self) -> Path:
        """The optimum at the control periods' ends, with costates."""
        times = np.minimum(CONTROL_PERIOD * np.arange(len(self.states)), self.scenario.horizon)
        return Path(times, self.states, self.costates)

    @property
    def reference_cost(self) -> float:
        """J*, the cost of the scenario's optimum."""
        return float(self.cost_to_go[0])


def demonstrate(env: gym.Env, scenario: Scenario, extremal: Extremal) -> Demonstration:
    """Drives an optimum through the environment."""
    inner = env.unwrapped
    assert isinstance(inner, NavigateEnv)
    actions = plan_actions(extremal, scenario, inner.control_period)

    def decide(step: int) -> tuple[np.ndarray, np.ndarray]:
        return actions[step], actions[step]

    driven = _drive(env, scenario, decide)
    times = np.minimum(inner.control_period * np.arange(len(driven["states"])), scenario.horizon)
    costates, cost_to_go = extremal.evaluate(times)[2], np.asarray(extremal.cost_to_go(times))
    return Demonstration(scenario=scenario, costates=costates, cost_to_go=cost_to_go, **driven)


def demonstrate_disturbed(
    env: gym.Env, scenario: Scenario, extremal: Extremal, noise: float, rng: np.random.Generator
) -> Demonstration:
    """Drives with noise on the actions; the expert's own, in closed loop, are recorded.

    Where the noise puts the goal out of reach, costate and cost-to-go are NaN and the expert goes on as before.

    Args:
        env: an environment of `leapnav/Navigate-v0`.
        scenario: the task.
        extremal: its optimum.
        noise: standard deviation of what is added to the actions (in [-1, 1]).
        rng: draws it.

    """
    inner = env.unwrapped
    assert isinstance(inner, NavigateEnv)
    feedback = Feedback(scenario, Path(extremal.times, extremal.states, extremal.costates))
    limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
    costates, costs = [], []

    def decide(step: int) -> tuple[np.ndarray, np.ndarray]:
        state, now = np.array(inner.pose), inner.time
        if feedback.update(state, now):
            cost, costate = feedback.value(state, now)
        else:  # the goal is out of reach from there
            cost, costate = np.nan, np.full(3, np.nan)
        costs.append(cost)
        costates.append(costate)
        ahead = min(inner.control_period, scenario.horizon - inner.time) / 2
        action = np.clip(feedback.control(inner.time + ahead) / limits, -1.0, 1.0).astype(np.float32)
        executed = np.clip(action + noise * rng.standard_normal(2), -1.0, 1.0).astype(np.float32)
        return action, executed

    driven = _drive(env, scenario, decide)
    costs.append(0.0)
    costates.append(feedback.final_costate)
    return Demonstration(scenario=scenario, costates=np.array(costates), cost_to_go=np.array(costs), **driven)


def _drive(env: gym.Env, scenario: Scenario, decide: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """One episode: `decide` gives the action of a step to record, and the one to execute."""
    observation, info = env.reset(options={"scenario": scenario})
    observations, poses, costs = [observation], [info["pose"]], [0.0]
    actions, executed, rewards = [], [], []
    terminated = False
    while not terminated:
        action, command = decide(len(actions))
        observation, reward, terminated, _, info = env.step(command)
        actions.append(action)
        executed.append(command)
        observations.append(observation)
        rewards.append(float(reward))
        poses.append(info["pose"])
        costs.append(info["cost"])
    return {
        "observations": np.stack(observations),
        "actions": np.stack(actions),
        "executed": np.stack(executed),
        "rewards": np.array(rewards),
        "states": np.array(poses),
        "running_cost": np.diff(costs),
        "is_success": bool(info["is_success"]),
    }


def recovery(
    scenario: Scenario, extremal: Extremal, rng: np.random.Generator, name: str
) -> tuple[Scenario, Extremal] | None:
    """The optimum from a state pushed off another optimum, re-solved from there; None if that is not possible."""
    pushed_at = rng.uniform(0.0, max(scenario.horizon - LAST_PUSH, 0.0))
    push = rng.normal(size=3) * PUSH
    state = extremal.evaluate(pushed_at)[0] + push
    if clearance(state[0], state[1], scenario.field)[0] < PUSH_CLEARANCE or pushed_at == 0.0:
        return None
    task = Scenario(
        name=name,
        arena=scenario.arena,
        robot=scenario.robot,
        start=tuple(state.tolist()),
        goal=scenario.goal,
        horizon=float(scenario.horizon - pushed_at),
        obstacles=scenario.obstacles,
        cost=scenario.cost,
    )
    times = np.concatenate([[0.0], extremal.times[extremal.times > pushed_at + 1e-6] - pushed_at])
    states, _, costates = extremal.evaluate(times + pushed_at)
    times[-1] = task.horizon
    states += push * np.exp(-times / PUSH_FADES)[:, None]
    solution = solve(task, "multiple_shooting", guess=Path(times, states, costates))
    factor, summand = RECOVERY_COST
    if not solution.success or solution.cost > factor * float(extremal.cost_to_go(pushed_at)) + summand:
        return None
    return task, solution


def write_dataset(demonstrations: Iterable[Demonstration], root: FilePath, family: str) -> None:
    """Writes a Minari dataset below the folder `root`, with scenario, state, costate and cost-to-go of every step.

    An episode's scenario is its `options["scenario"]`, so that Minari's `env.reset(options=...)` plays it again. The
    demonstrations are taken one by one, so there may be more than memory holds.
    """
    env = gym.make(ENVIRONMENT, family=family, max_episode_steps=MOST_STEPS)
    scenarios: list[Scenario] = []
    returns: list[float] = []

    def episodes() -> Iterator[EpisodeBuffer]:
        for number, demonstration in enumerate(demonstrations):
            returns.append(-demonstration.reference_cost)
            if number < SCORED:
                scenarios.append(demonstration.scenario)
            yield _episode(number, demonstration)

    with _minari_root(str(root)):
        dataset = minari.create_dataset_from_buffers(
            dataset_id(family),
            cast(list[EpisodeBuffer], episodes()),  # Minari declares a list, and goes through it once
            env=env,
            eval_env=env,
            algorithm_name="leapnav.experts.find_optimum",
            author="leapnav",
            author_email="",
            code_permalink="",
            description="Certified optima driven in the environment. Infos: state (x, y, heading), control (speed, "
            "turn rate), executed_action, costate, cost_to_go, running_cost, reference_cost; the episode's scenario is "
            "options['scenario'] as JSON. Reference scores: random actions and the optimum.",
            requirements=[f"leapnav=={leapnav.__version__}"],
        )
        scores = {"ref_min_score": _random_score(env, scenarios), "ref_max_score": float(np.mean(returns))}
        dataset.storage.update_metadata(scores)


def _random_score(env: gym.Env, scenarios: Sequence[Scenario]) -> float:
    """Mean return of random actions."""
    rng = np.random.default_rng(0)
    total = 0.0
    for scenario in scenarios:
        env.reset(options={"scenario": scenario})
        terminated = False
        while not terminated:
            _, reward, terminated, _, _ = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))
            total += float(reward)
    return total / len(scenarios)


def _episode(number: int, demonstration: Demonstration) -> EpisodeBuffer:
    steps = len(demonstration.actions)
    terminations = np.zeros(steps, dtype=bool)
    terminations[-1] = True
    robot = demonstration.scenario.robot
    controls = demonstration.actions * np.array([robot.max_speed, robot.max_turn_rate])
    return EpisodeBuffer(
        id=number,
        seed=demonstration.seed,
        options={"scenario": demonstration.scenario.to_json()},
        # Minari declares lists, and takes arrays as well.
        observations=cast(list[Any], demonstration.observations),
        actions=cast(list[Any], demonstration.actions),
        rewards=demonstration.rewards.tolist(),
        terminations=terminations.tolist(),
        truncations=[False] * steps,
        # Infos have an entry more than there are actions: the last control is held, nothing is charged at first.
        infos={
            "state": demonstration.states,
            "control": np.concatenate([controls, controls[-1:]]),
            "executed_action": np.concatenate([demonstration.executed, demonstration.executed[-1:]]),
            "costate": demonstration.costates,
            "cost_to_go": demonstration.cost_to_go,
            "running_cost": np.concatenate([[0.0], demonstration.running_cost]),
            "reference_cost": np.full(steps + 1, demonstration.reference_cost),
        },
    )


def dataset_id(family: str) -> str:
    """The Minari name of a family's demonstrations."""
    return f"leapnav/{family}/expert-v0"


@contextmanager
def _minari_root(folder: str) -> Iterator[None]:
    """Minari takes the root of its datasets from the environment only."""
    name = "MINARI_DATASETS_PATH"
    before = os.environ.get(name)
    os.environ[name] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def open_dataset(folder: str | os.PathLike[str]) -> minari.MinariDataset:
    """The one Minari dataset under a folder.

    Raises:
        FileNotFoundError: there is none, or more than one.

    """
    found = sorted(path.parent for path in FilePath(folder).glob("**/data/metadata.json"))
    if len(found) != 1:
        raise FileNotFoundError(f"{os.fspath(folder)}: expected one Minari dataset, found {len(found)}")
    return minari.MinariDataset(found[0])


def load_demonstrations(folder: str | os.PathLike[str]) -> list[Demonstration]:
    """The demonstrations that `rollout` wrote, all in memory.

    Raises:
        FileNotFoundError, ValueError: see `iterate_demonstrations`.

    """
    return list(iterate_demonstrations(folder))


def iterate_demonstrations(folder: str | os.PathLike[str]) -> Iterator[Demonstration]:
    """The demonstrations that `rollout` wrote, one by one.

    Raises:
        FileNotFoundError: see `open_dataset`.
        ValueError: the dataset holds something else; the message names what is missing.

    """
    dataset = open_dataset(folder)
    for episode, metadata in zip(
        dataset.iterate_episodes(), dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True
    ):
        infos = episode.infos or {}
        missing = sorted({"state", "executed_action", "costate", "cost_to_go", "running_cost"} - set(infos))
        text = (metadata.get("options") or {}).get("scenario")
        if missing or text is None:
            raise ValueError(
                f"{os.fspath(folder)}: episode {episode.id} has no {missing[0] if missing else 'scenario'}"
            )
        yield (
            Demonstration(
                scenario=Scenario.from_json(str(text)),
                observations=episode.observations,
                actions=episode.actions,
                executed=infos["executed_action"][:-1],
                rewards=np.asarray(episode.rewards),
                states=infos["state"],
                costates=infos["costate"],
                cost_to_go=infos["cost_to_go"],
                running_cost=infos["running_cost"][1:],
                is_success=True,  # `rollout` writes no others
                seed=metadata.get("seed"),
            )
        )
