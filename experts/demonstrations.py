"""Demonstrations: optima driven in the environment, and the Minari datasets that hold them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any, cast

import gymnasium as gym
import minari
import numpy as np
from joblib import Parallel, delayed
from minari.data_collector import EpisodeBuffer
from tqdm.auto import tqdm

import leapnav
from leapnav.envs.families import FAMILIES, sample_scenario
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.obstacles import clearance
from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal
from leapnav.experts.optimum import find_optimum
from leapnav.experts.policy import plan_actions
from leapnav.experts.problem import Path
from leapnav.experts.solve import solve

ENVIRONMENT = "leapnav/Navigate-v0"
# A recovery starts from a state of the optimum pushed by this much (m, m, rad; standard deviations).
PUSH = np.array([0.15, 0.15, 0.3])
PUSH_FADES = 0.5  # s over which the guess returns to the optimum
LAST_PUSH = 1.0  # s before the horizon: later the robot could not recover
PUSH_CLEARANCE = 0.02  # m
# A pushed robot whose solution costs this much more than the rest of the optimum has left for another local optimum.
RECOVERY_COST = (2.0, 1.0)  # factor, summand


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode of the expert in the environment, K steps.

    observations (K + 1, d), actions (K, 2), rewards (K,), states (K + 1, 3) as driven; from the optimum: costates
    (K + 1, 3) and cost_to_go (K + 1,), whose first entry is the reference cost J*. `running_cost` (K,) is what the
    environment charged in each step.
    """

    scenario: Scenario
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    states: np.ndarray
    costates: np.ndarray
    cost_to_go: np.ndarray
    running_cost: np.ndarray
    is_success: bool

    @property
    def path(self) -> Path:
        """The optimum at the control periods' ends, with costates."""
        times = np.linspace(0.0, self.scenario.horizon, len(self.states))
        return Path(times, self.states, self.costates)

    @property
    def reference_cost(self) -> float:
        """J*, the cost of the scenario's optimum."""
        return float(self.cost_to_go[0])


@dataclass(frozen=True)
class RolloutSummary:
    """What `rollout` did: demonstrations written, scenarios without a certified optimum, replays that failed."""

    demonstrations: int
    unsolved: int
    failed_replays: int
    steps: int


def demonstrate(env: gym.Env, scenario: Scenario, extremal: Extremal) -> Demonstration:
    """Drives an optimum through the environment."""
    inner = env.unwrapped
    assert isinstance(inner, NavigateEnv)
    actions = plan_actions(extremal, scenario, inner.control_period)
    observation, info = env.reset(options={"scenario": scenario})
    observations, rewards, poses, costs = [observation], [], [info["pose"]], [0.0]
    for action in actions:
        observation, reward, terminated, _, info = env.step(action)
        observations.append(observation)
        rewards.append(float(reward))
        poses.append(info["pose"])
        costs.append(info["cost"])
        if terminated:
            break
    steps = len(rewards)
    times = np.minimum(inner.control_period * np.arange(steps + 1), scenario.horizon)
    return Demonstration(
        scenario=scenario,
        observations=np.stack(observations),
        actions=actions[:steps],
        rewards=np.array(rewards),
        states=np.array(poses),
        costates=extremal.evaluate(times)[2],
        cost_to_go=np.asarray(extremal.cost_to_go(times)),
        running_cost=np.diff(costs),
        is_success=bool(info["is_success"]),
    )


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


def _demonstrations_of_seed(family: str, seed: int, recoveries: int) -> list[Demonstration]:
    """The demonstrations of one scenario, its optimum first; empty if it has no certified optimum."""
    scenario = sample_scenario(family, seed)
    extremal = find_optimum(scenario)
    if not extremal.success:
        return []
    env = NavigateEnv(family, split="fresh")
    found = [demonstrate(env, scenario, extremal)]
    # A stream of its own: recoveries change nothing in the scenarios.
    rng = np.random.default_rng([seed, 1])
    for number in range(recoveries):
        pushed = recovery(scenario, extremal, rng, f"{scenario.name}-recovery-{number}")
        if pushed is not None:
            found.append(demonstrate(env, *pushed))
    return found


def rollout(
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    recoveries: int = 0,
    workers: int = 1,
    progress: bool = True,
) -> RolloutSummary:
    """Samples scenarios, finds their optima, drives them, and writes a Minari dataset.

    Args:
        family: family of the scenarios.
        count: how many scenarios; scenario i has seed `seed + i` (those without a certified optimum are replaced).
        out: new folder, a root of Minari datasets: `load_demonstrations(out)` reads it, and with the environment
            variable MINARI_DATASETS_PATH set to it, `minari.load_dataset(dataset_id(family))`.
        recoveries: for each scenario, demonstrations that start from states pushed off its optimum.
        workers: processes.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is impossible.
        FileExistsError: `out` holds something already.

    """
    if family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family!r}")
    for name, value, least in (
        ("count", count, 1),
        ("recoveries", recoveries, 0),
        ("workers", workers, 1),
        ("seed", seed, 0),
    ):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value!r}")
    folder = FilePath(out).absolute()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder}: exists and is not empty; choose another folder or remove it")
    folder.parent.mkdir(parents=True, exist_ok=True)  # before the work: an impossible place is told at once
    found: list[Demonstration] = []
    solved = unsolved = failed = 0
    following = seed
    pool = Parallel(n_jobs=workers, return_as="generator")
    with tqdm(total=count, desc=f"Solving {family}", unit="scenario", disable=not progress) as bar:
        while solved < count:  # once, and again for the few that had no certified optimum
            seeds = range(following, following + count - solved)
            following = seeds.stop
            results = pool(delayed(_demonstrations_of_seed)(family, s, recoveries) for s in seeds)
            for demonstrations in cast(Iterator[list[Demonstration]], results):
                unsolved += not demonstrations
                failed += sum(not d.is_success for d in demonstrations)
                if demonstrations and demonstrations[0].is_success:
                    solved += 1
                    found += [d for d in demonstrations if d.is_success]
                    bar.update()
    write_demonstrations(found, folder, family)
    return RolloutSummary(len(found), unsolved, failed, sum(len(d.actions) for d in found))


def write_demonstrations(demonstrations: Sequence[Demonstration], folder: FilePath, family: str) -> None:
    """Writes a Minari dataset into `folder`, with scenario, states, costates and cost-to-go of every step.

    An episode's scenario is its `options["scenario"]`, so that Minari's `env.reset(options=...)` plays it again.
    """
    episodes = []
    for number, demonstration in enumerate(demonstrations):
        steps = len(demonstration.actions)
        terminations = np.zeros(steps, dtype=bool)
        terminations[-1] = True
        episodes.append(
            EpisodeBuffer(
                id=number,
                options={"scenario": demonstration.scenario.to_json()},
                # Minari declares lists, and takes arrays as well.
                observations=cast(list[Any], demonstration.observations),
                actions=cast(list[Any], demonstration.actions),
                rewards=demonstration.rewards.tolist(),
                terminations=terminations.tolist(),
                truncations=[False] * steps,
                infos={
                    "state": demonstration.states,
                    "costate": demonstration.costates,
                    "cost_to_go": demonstration.cost_to_go,
                    "running_cost": np.concatenate([[0.0], demonstration.running_cost]),
                },
            )
        )
    # Written beside its place and moved there whole: an interrupted run leaves no half of a dataset behind.
    with TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
        root = FilePath(scratch) / "root"
        env = gym.make(ENVIRONMENT, family=family)
        with _minari_root(str(root)):
            minari.create_dataset_from_buffers(
                dataset_id(family),
                episodes,
                env=env,
                eval_env=env,
                algorithm_name="leapnav.experts.find_optimum",
                author="leapnav",
                author_email="",
                code_permalink="",
                description="Certified optima driven in the environment. Infos: state (x, y, heading), "
                "costate, cost_to_go, running_cost; the episode's scenario is options['scenario'] as JSON.",
                requirements=[f"leapnav=={leapnav.__version__}"],
            )
        if folder.is_dir():
            folder.rmdir()  # empty, or `rollout` would have refused it
        root.rename(folder)


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
    """The demonstrations that `rollout` wrote.

    Raises:
        FileNotFoundError: see `open_dataset`.
        ValueError: the dataset holds something else; the message names what is missing.

    """
    dataset = open_dataset(folder)
    demonstrations = []
    for episode, metadata in zip(
        dataset.iterate_episodes(), dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True
    ):
        infos = episode.infos or {}
        missing = sorted({"state", "costate", "cost_to_go", "running_cost"} - set(infos))
        text = (metadata.get("options") or {}).get("scenario")
        if missing or text is None:
            raise ValueError(
                f"{os.fspath(folder)}: episode {episode.id} has no {missing[0] if missing else 'scenario'}"
            )
        demonstrations.append(
            Demonstration(
                scenario=Scenario.from_json(str(text)),
                observations=episode.observations,
                actions=episode.actions,
                rewards=np.asarray(episode.rewards),
                states=infos["state"],
                costates=infos["costate"],
                cost_to_go=infos["cost_to_go"],
                running_cost=infos["running_cost"][1:],
                is_success=True,  # `rollout` writes no others
            )
        )
    return demonstrations
