"""Demonstrations by the thousand: solved in parallel, kept in shards when finished, and written as one dataset."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed, parallel_config
from tqdm.auto import tqdm

import leapnav
from leapnav.envs.families import check_family, sample_scenario
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenario import Scenario
from leapnav.experts.demonstrations import (
    Demonstration,
    demonstrate,
    demonstrate_disturbed,
    iterate_demonstrations,
    open_dataset,
    recovery,
    write_dataset,
)
from leapnav.experts.extremal import Extremal
from leapnav.experts.optimum import find_optimum
from leapnav.experts.shards import Shards

VERSION = 1  # of the shards
LEAST_SEED = 2  # the scenarios of seeds 0 and 1 are the first ones of the training and the test banks that ship
SHARD = 16  # scenarios
DASK_TIMEOUT = 30  # s to wait for a scheduler and its workers
WORK, DONE = ".rollout", ".rollout-done"  # folders of what is not finished, and of what is only to be removed
RECORD = "rollout.json"  # what a finished rollout is, beside its dataset
# Arrays of a demonstration, and whether they have an entry more than there are steps.
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
    """What `rollout` did: demonstrations written, scenarios without a certified optimum, replays that failed."""

    demonstrations: int
    unsolved: int
    failed_replays: int
    steps: int


def rollout(
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    seed: int = 1000,
    recoveries: int = 0,
    noise: float = 0.0,
    workers: int = 1,
    dask: str | None = None,
    force: bool = False,
    progress: bool = True,
) -> RolloutSummary:
    """Samples scenarios, finds their optima, drives them, and writes a Minari dataset.

    What is finished is kept in `out`: a rollout that was stopped, however rudely, goes on where it was when it is
    called again with the same arguments, and its dataset is that of one that was not stopped. One that is finished is
    not made again.

    Args:
        family: family of the scenarios.
        count: how many scenarios; scenario i has seed `seed + i` (those without a certified optimum are replaced by
            following ones). Seeds 0 and 1 are refused: their scenarios are in the banks that ship, one of them in the
            test split.
        out: folder, a root of Minari datasets: `load_demonstrations(out)` reads it, and with the environment variable
            MINARI_DATASETS_PATH set to it, `minari.load_dataset(dataset_id(family))`.
        recoveries: for each scenario, demonstrations that start from states pushed off its optimum.
        noise: standard deviation of what is added to the executed actions (in [-1, 1]); the expert acts in closed loop
            then, and its own actions are the dataset's, so that they show how to recover.
        workers: processes; their number changes nothing in the dataset.
        dask: address of a Dask scheduler (`tcp://host:8786`), whose workers do the work instead; they need leapnav, but
            not this folder. Needs the extra `cluster`.
        force: replace a dataset or an unfinished rollout that `out` holds.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is impossible, a shard is damaged, or `out` holds an unfinished rollout of other
            arguments.
        FileExistsError: `out` holds something already, if only a rollout of other arguments.
        OSError: `out` cannot be written, or there is no such scheduler; what is finished is kept.
        ModuleNotFoundError: `dask` without the extra `cluster`.

    """
    check_family(family)
    for name, value, least in (
        ("count", count, 1),
        ("recoveries", recoveries, 0),
        ("workers", workers, 1),
        ("seed", seed, LEAST_SEED),
        ("noise", noise, 0.0),
    ):
        if not (math.isfinite(value) and value >= least):
            raise ValueError(f"{name}: expected at least {least}, got {value!r}")
    folder = Path(out).absolute()
    settings = {
        "version": VERSION,
        "software": leapnav.__version__,
        "family": family,
        "seed": seed,
        "recoveries": recoveries,
        "noise": float(noise),
    }
    finished = None if force else _finished(folder, {**settings, "count": count})
    if finished is not None:
        return finished
    _prepare(folder, force)
    shards = Shards(folder / WORK, settings)  # not of the count: a longer rollout goes on where a shorter one was
    try:
        with _backend(workers, dask) as pool:
            parts = _solve(shards, pool, family, count, seed, recoveries, float(noise), progress)
        summary = _write(shards, parts, folder, family, count)
        record = {**settings, "count": count, "summary": asdict(summary)}
        (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n")
    finally:
        shards.close()
    # At once: shards that are removed one by one would look like a rollout to go on with.
    (folder / WORK).rename(folder / DONE)
    shutil.rmtree(folder / DONE)
    return summary


@dataclass(frozen=True)
class Replay:
    """How far a dataset is from what the environment does: largest deviations over all steps.

    Attributes:
        episodes: how many were replayed.
        observation, reward, state: largest absolute deviation.
        worst: number of the episode with the largest one, None if there are no episodes.

    """

    episodes: int
    observation: float
    reward: float
    state: float
    worst: int | None


def check_dataset(folder: str | os.PathLike[str], *, progress: bool = True) -> Replay:
    """Plays the executed actions of a dataset in the environment again.

    An episode of another length counts as an infinite deviation.

    Raises:
        FileNotFoundError, ValueError: see `load_demonstrations`.

    """
    total = open_dataset(folder).total_episodes
    env = NavigateEnv(split="fresh")
    largest, worst, episodes = np.zeros(3), None, 0
    for number, demonstration in enumerate(
        tqdm(iterate_demonstrations(folder), total=total, desc="Replaying", unit="episode", disable=not progress)
    ):
        found = _replay(env, demonstration)
        if worst is None or found.max() > largest.max():
            worst = number
        largest, episodes = np.maximum(largest, found), number + 1
    observation, reward, state = largest.tolist()
    return Replay(episodes, observation, reward, state, worst)


def _replay(env: NavigateEnv, demonstration: Demonstration) -> np.ndarray:
    """Largest deviation of observations, rewards and states."""
    observation, info = env.reset(options={"scenario": demonstration.scenario})
    observations, rewards, states, terminated = [observation], [], [info["pose"]], False
    for action in demonstration.executed:
        if terminated:
            break
        observation, reward, terminated, _, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        states.append(info["pose"])
    if not terminated or len(rewards) != len(demonstration.rewards):
        return np.full(3, np.inf)
    pairs = (
        (observations, demonstration.observations),
        (rewards, demonstration.rewards),
        (states, demonstration.states),
    )
    return np.array([np.abs(np.subtract(one, other)).max() for one, other in pairs])


def _finished(folder: Path, settings: dict[str, Any]) -> RolloutSummary | None:
    """What a finished rollout did, None if the folder holds none."""
    shutil.rmtree(folder / DONE, ignore_errors=True)
    if not (folder / RECORD).is_file() or (folder / WORK).exists() or not (folder / "leapnav").is_dir():
        return None
    try:
        record = json.loads((folder / RECORD).read_text())
        summary = RolloutSummary(**record.pop("summary"))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{folder / RECORD}: damaged: {error!r}") from None
    for name, value in settings.items():
        if record.get(name) != value:
            raise FileExistsError(
                f"{folder}: holds a rollout whose {name} is {record.get(name)!r}, got {value!r}; choose another "
                "folder, or replace it with force"
            )
    return summary


def _prepare(folder: Path, force: bool) -> None:
    """Makes the folder, or refuses it."""
    content = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if force and content and content <= {WORK, DONE, RECORD, "leapnav"}:  # what a rollout makes, and nothing else
        shutil.rmtree(folder)
        content = set()
    # A dataset beside the shards was moved there just before the end of a run that was stopped.
    ours = {WORK, RECORD, "leapnav"} if WORK in content else set()
    if (folder.exists() and not folder.is_dir()) or content - ours:
        raise FileExistsError(f"{folder}: exists and is not empty; choose another folder or remove it")
    folder.mkdir(parents=True, exist_ok=True)  # before the work: an impossible place is told at once


@contextmanager
def _backend(workers: int, dask: str | None) -> Iterator[Parallel]:
    """What runs tasks: processes of this machine, or the workers of a Dask scheduler."""
    if dask is None:
        yield Parallel(n_jobs=workers, return_as="generator_unordered")
        return
    try:
        from dask.distributed import Client
    except ImportError:
        raise ModuleNotFoundError('a Dask cluster needs dask: pip install "leapnav[cluster]"') from None
    with Client(dask, timeout=DASK_TIMEOUT), parallel_config(backend="dask", wait_for_workers_timeout=DASK_TIMEOUT):
        # One task for each shard: a worker that is lost takes no more than these with it, and they are done again.
        yield Parallel(n_jobs=-1, return_as="generator_unordered", batch_size=cast(Any, 1))


def _solve(
    shards: Shards,
    pool: Parallel,
    family: str,
    count: int,
    seed: int,
    recoveries: int,
    noise: float,
    progress: bool,
) -> int:
    """Makes the shards that are missing; returns how many hold `count` solved scenarios."""
    solved: dict[int, int] = {}
    parts = 0
    with tqdm(total=count, desc=f"Solving {family}", unit="scenario", disable=not progress) as bar:
        while sum(solved.values()) < count:  # once, and again for the few that had no certified optimum
            first, parts = parts, parts + math.ceil((count - sum(solved.values())) / SHARD)
            missing = []
            for number in range(first, parts):
                if number in shards:
                    solved[number] = int(shards.read(number)["solved"].sum())
                    bar.update(solved[number])
                else:
                    missing.append(number)
            bar.unpause()  # the rate is of what is solved now
            tasks = (delayed(_shard)(number, family, seed, recoveries, noise) for number in missing)
            for number, arrays in cast(Iterator[tuple[int, dict[str, np.ndarray]]], pool(tasks)):
                shards.write(number, arrays)
                solved[number] = int(arrays["solved"].sum())
                bar.update(solved[number])
    return parts


def _write(shards: Shards, parts: int, folder: Path, family: str, count: int) -> RolloutSummary:
    """Writes the dataset of the first `count` solved scenarios, beside its place, and moves it there whole."""
    totals = {"demonstrations": 0, "unsolved": 0, "failed": 0, "steps": 0}

    def demonstrations() -> Iterator[Demonstration]:
        solved = 0
        for number in range(parts):
            arrays = shards.read(number)
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

    root = folder / WORK / "root"
    shutil.rmtree(root, ignore_errors=True)  # of a run that was stopped here
    write_dataset(demonstrations(), root, family)
    shutil.rmtree(folder / "leapnav", ignore_errors=True)  # the same one, see `_prepare`
    (root / "leapnav").replace(folder / "leapnav")
    return RolloutSummary(totals["demonstrations"], totals["unsolved"], totals["failed"], totals["steps"])


def _shard(number: int, family: str, seed: int, recoveries: int, noise: float) -> tuple[int, dict[str, np.ndarray]]:
    first = seed + number * SHARD
    return number, _pack([_of_seed(family, s, recoveries, noise) for s in range(first, first + SHARD)])


def _of_seed(family: str, seed: int, recoveries: int, noise: float) -> list[Demonstration]:
    """The demonstrations of one scenario, its optimum first; empty if it has no certified optimum."""
    scenario = sample_scenario(family, seed)
    extremal = find_optimum(scenario)
    if not extremal.success:
        return []
    tasks: list[tuple[Scenario, Extremal]] = [(scenario, extremal)]
    # Streams of their own: neither recoveries nor noise change anything in the scenarios.
    rng = np.random.default_rng([seed, 1])
    for number in range(recoveries):
        pushed = recovery(scenario, extremal, rng, f"{scenario.name}-recovery-{number}")
        if pushed is not None:
            tasks.append(pushed)
    env = NavigateEnv(family, split="fresh")
    disturbances = np.random.default_rng([seed, 2])
    found = []
    for task in tasks:
        driven = demonstrate(env, *task) if noise == 0.0 else demonstrate_disturbed(env, *task, noise, disturbances)
        found.append(replace(driven, seed=seed))
    return found


def _pack(scenarios: list[list[Demonstration]]) -> dict[str, np.ndarray]:
    """The demonstrations of scenarios as arrays; of a scenario whose optimum fails in the environment none is kept."""
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


def _unpack(arrays: dict[str, np.ndarray]) -> Iterator[list[Demonstration]]:
    """The inverse of `_pack`, scenario by scenario."""
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
