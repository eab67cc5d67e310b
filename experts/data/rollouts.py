"""Rollouts: datasets of many demonstrations, solved in parallel and resumable."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel

import leapnav
from leapnav.envs.episodes import play_episode, replay
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import find_family, sample_scenario, task_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.files import write_text
from leapnav.envs.utils.json_utils import encode
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.data.datasets import WORK, open_dataset
from leapnav.experts.data.demonstrations import (
    Demonstration,
    demonstrate,
    demonstrate_disturbed,
    iterate_demonstrations,
    recovery,
    state_of,
    write_dataset,
)
from leapnav.experts.data.store import DISCARDED, Arrays, ResumableStore, discard
from leapnav.experts.optimum import find_optimum
from leapnav.experts.pools import process_pool
from leapnav.experts.problem.extremal import Extremal

VERSION = 1  # format of the shards
MIN_SEED = 2  # seeds 0 and 1 give the first scenarios of the included training and test banks
SHARD_SIZE = 16  # scenarios per shard
FORCE = ", or use force=True (--force)"
DONE = WORK + DISCARDED  # the same directory while it is removed
RECORD = "rollout.json"  # arguments and summary of a finished rollout, beside its dataset
# Arrays of a demonstration, and whether they have one entry more than the number of steps.
_ARRAYS = {
    "observations": True,
    "actions": False,
    "executed": False,
    "rewards": False,
    "states": True,
    "costates": True,
    "cost_to_go": True,
    "running_cost": False,
}


@dataclass(frozen=True)
class RolloutSummary:
    """The result of `rollout`.

    Attributes:
        demonstrations: number of demonstrations in the dataset.
        unsolved: number of scenarios without a certified optimum.
        failed_replays: number of episodes that did not end in success.
        steps: number of environment steps in the dataset.

    """

    demonstrations: int
    unsolved: int
    failed_replays: int
    steps: int


def rollout(
    family: str | ScenarioBank,
    count: int,
    out: str | os.PathLike[str],
    *,
    robot: RobotModel | Mapping[str, Any] | str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
    seed: int = 1000,
    recoveries: int = 0,
    noise: float = 0.0,
    workers: int = 1,
    dask: str | None = None,
    force: bool = False,
    progress: bool = True,
) -> RolloutSummary:
    """Sample scenarios, find their optima, execute them, and write a Minari dataset.

    Finished parts are stored in `out`. A rollout resumes after any interruption, including SIGKILL, when it is called
    again with the same arguments; the dataset does not depend on interruptions. A finished rollout is not repeated.

    Args:
        family: family of the scenarios, or a bank.
        count: number of scenarios; scenario i has the seed `seed + i`. Scenarios without a certified optimum are
            replaced by following ones. Seeds 0 and 1 are refused: their scenarios are in the included banks, one of
            them in the test split.
        out: directory, a root of Minari datasets. Read it with `load_demonstrations(out)`; if the environment variable
            MINARI_DATASETS_PATH is set to it, also with `minari.load_dataset(dataset_id(family, robot, horizon,
            obstacles))`.
        robot: name of a robot model, a dict of its fields with `model`, or a robot.
        horizon: "fixed" or "free", see `sample_scenario`.
        obstacles: "cost" or "hard", see `sample_scenario`. Robot, horizon and obstacles that are not given are those of
            the stored scenarios if the family is a file, otherwise the unicycle, "fixed" and "cost".
        recoveries: number of additional demonstrations per scenario that start from perturbed states of the optimum.
        noise: standard deviation of the noise that is added to the executed actions, which are in [-1, 1]. The expert
            then acts in closed loop and the dataset contains its own actions, which show how to recover.
        workers: number of processes; the dataset does not depend on it.
        dask: address of a Dask scheduler (`tcp://host:8786`) whose workers are used instead of local processes. They
            need leapnav, but no access to `out`. Requires the extra `cluster`.
        force: replace a dataset or an unfinished rollout in `out`.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is invalid, a shard is damaged, or `out` holds an unfinished rollout with other
            arguments.
        FileExistsError: `out` holds other files, or a finished rollout with other arguments.
        OSError: `out` cannot be written, or the scheduler cannot be reached; finished parts are kept.
        ModuleNotFoundError: `dask` is given without the extra `cluster`.

    """
    family = str(family.path) if isinstance(family, ScenarioBank) else family
    chosen = find_family(family)
    body, horizon, obstacles = task_of(chosen, robot, horizon, obstacles)
    check_at_least("count", count, 1)
    check_at_least("recoveries", recoveries, 0)
    check_at_least("workers", workers, 1)
    check_at_least("seed", seed, MIN_SEED)
    check_at_least("noise", noise, 0.0)
    directory = Path(out).absolute()
    settings = {
        "version": VERSION,
        "software": leapnav.__version__,
        "family": family,
        "seed": seed,
        "recoveries": recoveries,
        "noise": float(noise),
    }
    if body != Unicycle():  # as before there were other robots
        settings["robot"] = body.model_dump(mode="json", exclude_none=True)
    if horizon != "fixed":
        settings["horizon"] = horizon
    if obstacles != "cost":
        settings["obstacles"] = obstacles
    finished = None if force else _finished(directory, {**settings, "count": count})
    if finished is not None:
        return finished
    _prepare(directory, force)
    # The settings of the store exclude `count`: a longer rollout continues a shorter one.
    with ResumableStore(directory / WORK, "rollout", settings, advice=FORCE) as store:
        sample = partial(sample_scenario, chosen, robot=body, horizon=horizon, obstacles=obstacles)
        compute = partial(_shard, sample=sample, seed=seed, recoveries=recoveries, noise=float(noise))
        with process_pool(workers, dask) as pool:
            n_shards = _solve(store, pool, compute, family, count, progress)
        write = partial(write_dataset, family=family, robot=body, horizon=horizon, obstacles=obstacles)
        summary = _write(store, n_shards, directory, count, write)
        record = {**settings, "count": count, "summary": asdict(summary)}
        write_text(directory / RECORD, encode(record, indent=1) + "\n")
    discard(store.directory)
    return summary


@dataclass(frozen=True)
class Replay:
    """The largest deviations between a dataset and the environment, over all steps.

    Attributes:
        episodes: number of replayed episodes.
        observation, reward, state: largest absolute deviations.
        worst: index of the episode with the largest deviation, None if there are no episodes.

    """

    episodes: int
    observation: float
    reward: float
    state: float
    worst: int | None


def check_dataset(folder: str | os.PathLike[str], *, progress: bool = True) -> Replay:
    """Replay the executed actions of a dataset in the environment, and compare.

    The deviation of an episode with another number of steps is infinite.

    Args:
        folder: directory of the dataset.
        progress: show a progress bar.

    Raises:
        FileNotFoundError, ValueError: see `iterate_demonstrations`.

    """
    total = open_dataset(folder).total_episodes
    env: NavigateEnv | None = None
    largest, worst, episodes = np.zeros(3), None, 0
    with progress_bar(total=total, label="Replaying", unit="episodes", show=progress) as bar:
        for number, demonstration in enumerate(iterate_demonstrations(folder)):
            scenario = demonstration.scenario
            env = env or NavigateEnv(split="fresh", robot=scenario.robot, horizon=scenario.horizon_kind)
            deviations = _replay(env, demonstration)
            if worst is None or deviations.max() > largest.max():
                worst = number
            largest, episodes = np.maximum(largest, deviations), number + 1
            bar.update()
    observation, reward, state = largest.tolist()
    return Replay(episodes, observation, reward, state, worst)


def _replay(env: NavigateEnv, demonstration: Demonstration) -> np.ndarray:
    """Largest deviations (3,) of the observations, rewards and states of an episode."""
    observation, info, steps = play_episode(
        env, replay(demonstration.executed), options={"scenario": demonstration.scenario}
    )
    transitions = list(steps)
    if not transitions or not transitions[-1].terminated or len(transitions) != len(demonstration.rewards):
        return np.full(3, np.inf)
    pairs = (
        ([observation, *(step.observation for step in transitions)], demonstration.observations),
        ([step.reward for step in transitions], demonstration.rewards),
        ([state_of(info), *(state_of(step.info) for step in transitions)], demonstration.states),
    )
    return np.array([np.abs(np.subtract(one, other)).max() for one, other in pairs])


def _finished(directory: Path, settings: dict[str, Any]) -> RolloutSummary | None:
    """The summary of a finished rollout, None if the directory holds none."""
    shutil.rmtree(directory / DONE, ignore_errors=True)
    record_file = directory / RECORD
    if not record_file.is_file() or (directory / WORK).exists() or not (directory / "leapnav").is_dir():
        return None
    try:
        record = json.loads(record_file.read_text(encoding="utf-8"))
        summary = RolloutSummary(**record.pop("summary"))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{record_file}: damaged: {error!r}") from None
    for name, value in settings.items():
        if record.get(name) != value:
            raise FileExistsError(
                f"{directory}: holds a rollout whose {name} is {record.get(name)!r}, got {value!r}; choose another "
                "directory, or replace it (force=True, --force)"
            )
    return summary


def _prepare(directory: Path, force: bool) -> None:
    """Create the directory, or refuse it because of its content."""
    content = {path.name for path in directory.iterdir()} if directory.is_dir() else set()
    if WORK in content:
        for leftover in directory.glob(f".{RECORD}.*.partial"):  # of a run that was killed while it wrote the record
            leftover.unlink()
            content.remove(leftover.name)
    if force and content and content <= {WORK, DONE, RECORD, "leapnav"}:  # files of a rollout only
        shutil.rmtree(directory)
        content = set()
    # A dataset beside the store is complete: the run was interrupted before it removed the store.
    expected = {WORK, RECORD, "leapnav"} if WORK in content else set()
    if (directory.exists() and not directory.is_dir()) or content - expected:
        raise FileExistsError(f"{directory}: exists and is not empty; choose another directory or remove it")
    directory.mkdir(parents=True, exist_ok=True)  # before the computation, so that an impossible path fails at once


def _solve(
    store: ResumableStore, pool: Parallel, compute: Callable[[int], Arrays], family: str, count: int, progress: bool
) -> int:
    """Complete shards until they hold `count` solved scenarios, and return the number of shards."""
    n_shards = n_solved = 0
    with progress_bar(total=count, label=f"Solving {family}", unit="scenarios", show=progress) as bar:
        while n_solved < count:  # repeated for the scenarios that had no certified optimum
            numbers = range(n_shards, n_shards + math.ceil((count - n_solved) / SHARD_SIZE))
            for _, arrays in store.complete(numbers, lambda number: partial(compute, number), pool, bar):
                solved = int(arrays["solved"].sum())
                n_solved += solved
                advance(bar, solved)
            n_shards = numbers.stop
    return n_shards


def _write(
    store: ResumableStore, n_shards: int, directory: Path, count: int, write: Callable[..., None]
) -> RolloutSummary:
    """Write the dataset of the first `count` solved scenarios in the work directory, then move it to its place."""
    totals = {"demonstrations": 0, "unsolved": 0, "failed": 0, "steps": 0}

    def demonstrations() -> Iterator[Demonstration]:
        solved = 0
        for number in range(n_shards):
            arrays = store.read(number)
            for kept, failed, found in zip(
                arrays["kept"].tolist(), arrays["failed"].tolist(), _unpack(arrays), strict=True
            ):
                if solved == count:
                    return
                totals["unsolved"] += kept == 0 and failed == 0
                totals["failed"] += failed
                solved += kept > 0
                for demonstration in found:
                    totals["demonstrations"] += 1
                    totals["steps"] += len(demonstration.actions)
                    yield demonstration

    root = directory / WORK / "root"
    shutil.rmtree(root, ignore_errors=True)  # left by a run that was interrupted here
    write(demonstrations(), root)
    shutil.rmtree(directory / "leapnav", ignore_errors=True)  # an earlier copy of the same dataset, see `_prepare`
    (root / "leapnav").replace(directory / "leapnav")
    return RolloutSummary(totals["demonstrations"], totals["unsolved"], totals["failed"], totals["steps"])


def _shard(number: int, seed: int, **arguments: Any) -> Arrays:
    first = seed + number * SHARD_SIZE
    return _pack([_demonstrations(seed=s, **arguments) for s in range(first, first + SHARD_SIZE)])


def _demonstrations(sample: Callable[[int], Scenario], seed: int, recoveries: int, noise: float) -> list[Demonstration]:
    """The demonstrations of one scenario, its optimum first; empty without a certified optimum."""
    scenario = sample(seed)
    optimum = find_optimum(scenario, "medium")
    if not optimum.success:
        return []
    episodes: list[tuple[Scenario, Extremal]] = [(scenario, optimum)]
    # Separate generators, so that neither recoveries nor noise change the scenarios.
    rng = np.random.default_rng([seed, 1])
    for number in range(recoveries):
        recovered = recovery(scenario, optimum, rng, f"{scenario.name}-recovery-{number}")
        if recovered is not None:
            episodes.append(recovered)
    env = NavigateEnv(scenario=scenario)
    noise_rng = np.random.default_rng([seed, 2])
    found = []
    for episode in episodes:
        driven = demonstrate(env, *episode) if noise == 0.0 else demonstrate_disturbed(env, *episode, noise, noise_rng)
        found.append(replace(driven, seed=seed))
    return found


def _pack(scenarios: list[list[Demonstration]]) -> dict[str, np.ndarray]:
    """The demonstrations of several scenarios as arrays of a shard.

    Only successful episodes are kept, and none of a scenario whose optimum is not successful in the environment.
    """
    kept = [[d for d in found if d.is_success] if found and found[0].is_success else [] for found in scenarios]
    demonstrations = [d for found in kept for d in found]
    texts = [d.scenario.to_json().encode() for d in demonstrations]
    arrays: dict[str, np.ndarray] = {
        "solved": np.array([bool(found) for found in kept]),
        "kept": np.array([len(found) for found in kept]),
        "failed": np.array([sum(not d.is_success for d in found) for found in scenarios]),
        "steps": np.array([len(d.actions) for d in demonstrations], dtype=np.int64),
        "seeds": np.array([d.seed for d in demonstrations], dtype=np.int64),
        "texts": np.frombuffer(b"".join(texts), dtype="u1"),
        "text_ends": np.cumsum([len(text) for text in texts], dtype=np.int64),
    }
    if demonstrations:
        for name in _ARRAYS:
            arrays[name] = np.concatenate([getattr(d, name) for d in demonstrations])
    return arrays


def _unpack(arrays: Arrays) -> Iterator[list[Demonstration]]:
    """Yield the demonstrations of each scenario, the inverse of `_pack`."""
    steps, number, text_start = arrays["steps"].tolist(), 0, 0
    starts = dict.fromkeys(_ARRAYS, 0)
    for kept in arrays["kept"].tolist():
        found = []
        for _ in range(kept):
            values: dict[str, Any] = {}
            for name, one_more in _ARRAYS.items():
                end = starts[name] + steps[number] + one_more
                values[name] = arrays[name][starts[name] : end]
                starts[name] = end
            text_end = int(arrays["text_ends"][number])
            scenario = Scenario.from_json(arrays["texts"][text_start:text_end].tobytes().decode())
            seed = int(arrays["seeds"][number])
            found.append(Demonstration(scenario=scenario, is_success=True, seed=seed, **values))
            text_start, number = text_end, number + 1
        yield found
