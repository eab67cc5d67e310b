"""Minari datasets of episodes of any policies, for offline reinforcement learning."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import delayed
from minari.data_collector import EpisodeBuffer

from leapnav.envs.episodes import Act, act_with, play_episode
from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import find_family, sample_scenario, task_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.data.datasets import Task, dataset_id, write_episodes
from leapnav.experts.data.demonstrations import state_of
from leapnav.experts.data.rollouts import MIN_SEED
from leapnav.experts.optimum import find_optimum
from leapnav.experts.pools import process_pool
from leapnav.training.scoring.policy_specs import PolicySpec, load_policy_spec, make_policy_from_spec
from leapnav.training.threads import limit_threads

BATCH = 64  # scenarios whose optima are searched at a time
PARTIAL = ".partial"  # directory of an unfinished dataset


@dataclass(frozen=True)
class RecordSummary:
    """The result of `record`.

    Attributes:
        name: the Minari dataset id.
        episodes, steps: numbers of episodes and environment steps.
        success: success rate.
        mean_return: mean return.
        unsolved: number of scenarios that were left out, because no certified optimum was found.

    """

    name: str
    episodes: int
    steps: int
    success: float
    mean_return: float
    unsolved: int


@limit_threads
def record(
    policies: str | Sequence[str],
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    name: str | None = None,
    robot: RobotModel | Mapping[str, Any] | str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 1000,
    noise: float = 0.0,
    workers: int = 1,
    dask: str | None = None,
    force: bool = False,
    progress: bool = True,
) -> RecordSummary:
    """Record episodes of policies as a Minari dataset, with the reference cost of each scenario.

    The scenarios are those of `rollout` with the same seed. Successes and failures are recorded. With several policies,
    each drives every n-th scenario. The infos contain state (x, y, heading, further states of the robot), running_cost,
    reference_cost and is_success; the scenario of an episode is its `options["scenario"]` as JSON.

    Args:
        policies: names of policies, see `leapnav evaluate --help`: "expert", "random" and the other baselines, included
            policies, directories of policies or runs, and models of Stable-Baselines3 (`.zip`).
        family: family of the scenarios.
        count: number of episodes.
        out: directory, a root of Minari datasets; it must be empty or absent.
        name: last part of the Minari dataset id; by default the name of the policy, or "mixed".
        robot, horizon, obstacles: see `rollout`.
        environment: arguments of the environment, such as `observation`; by default those of the policies.
        seed: first scenario seed; seed of the noise and of random policies.
        noise: standard deviation of the noise that is added to the actions, which are in [-1, 1].
        workers, dask: processes that search the optima, see `rollout`.
        force: replace a dataset in `out`.
        progress: show a progress bar.

    Raises:
        FileNotFoundError: there is no policy of a name.
        FileExistsError: `out` contains other files.
        ValueError: an argument is invalid, or the policies observe different things.

    """
    names = [policies] if isinstance(policies, str) else list(policies)
    if not names:
        raise ValueError("policies: expected at least one, got none")
    chosen = find_family(family)
    body, horizon, obstacles = task_of(chosen, robot, horizon, obstacles)
    check_at_least("count", count, 1)
    check_at_least("seed", seed, MIN_SEED)
    check_at_least("noise", noise, 0.0)
    check_at_least("workers", workers, 1)
    specs = [load_policy_spec(one, seed=seed, environment=environment) for one in names]
    task = Task(family, body, horizon, obstacles, _environment(specs, environment, body, horizon))
    label = name or (re.sub(r"[^A-Za-z0-9-]", "-", Path(names[0]).stem) if len(names) == 1 else "mixed")
    if not re.fullmatch(r"[A-Za-z0-9-]+", label):
        raise ValueError(f"name: expected letters, digits and hyphens, got {label!r}")
    directory = Path(out).absolute()
    _prepare(directory, force)
    found = dataset_id(family, body.model, horizon, obstacles, label)
    counts = {"unsolved": 0, "steps": 0}
    outcomes: list[tuple[bool, float]] = []
    env = task.make_env()
    drivers = [make_policy_from_spec(one, env, seed=seed) for one in names]

    def episodes() -> Iterator[tuple[Scenario, float, EpisodeBuffer]]:
        sample = partial(sample_scenario, chosen, robot=body, horizon=horizon, obstacles=obstacles)
        rng = np.random.default_rng(seed)
        with (
            process_pool(workers, dask, return_as="generator") as pool,
            progress_bar(total=count, label=f"Recording {family}", unit="episodes", show=progress) as bar,
        ):
            first = seed
            while len(outcomes) < count:
                seeds = range(first, first + min(BATCH, count - len(outcomes)))
                first = seeds.stop
                solved = cast(Iterator[tuple[Scenario, float | None]], pool(delayed(_solve)(sample, s) for s in seeds))
                for number, (scenario, cost) in zip(seeds, solved, strict=True):
                    if cost is None:
                        counts["unsolved"] += 1
                        continue
                    act = _with_noise(act_with(drivers[len(outcomes) % len(drivers)]), noise, rng)
                    buffer, is_success = _play(env, act, scenario, cost, len(outcomes), number)
                    outcomes.append((is_success, float(np.sum(buffer.rewards))))
                    counts["steps"] += len(buffer.rewards)
                    bar.update()
                    yield scenario, cost, buffer

    write_episodes(
        episodes(),
        directory / PARTIAL,
        found,
        task,
        algorithm=", ".join(names),
        description=f"Episodes of {', '.join(names)}; standard deviation of the noise of actions: {noise:g}. Infos: "
        "state (x, y, heading, further states of the robot), running_cost, reference_cost (of the best known optimum), "
        "is_success; the episode's scenario is options['scenario'] as JSON. Reference scores: random actions and the "
        "optimum in the scenarios of eval_env.",
    )
    (directory / PARTIAL / "leapnav").replace(directory / "leapnav")
    shutil.rmtree(directory / PARTIAL)
    success, mean_return = np.mean(np.array(outcomes, dtype=float), axis=0).tolist()
    return RecordSummary(found, len(outcomes), counts["steps"], success, mean_return, counts["unsolved"])


def _environment(
    specs: Sequence[PolicySpec], given: Mapping[str, Any] | None, robot: RobotModel, horizon: str
) -> dict[str, Any]:
    """Return the arguments of the environment that determine the observations of policies.

    Raises:
        ValueError: the policies observe different things, or drive another robot or with another horizon.

    """
    found = dict(given or {})
    for spec in specs:
        if spec.is_baseline:
            continue
        for field, value, expected in (("robot", spec.robot, robot.model), ("horizon", spec.horizon, horizon)):
            if value != expected:
                raise ValueError(f"{field}: expected {value!r}, which the policy {spec.name} drives, got {expected!r}")
        own = {key: value for key, value in spec.environment.items() if key not in ("robot", "horizon")}
        if found and own and found != own:
            raise ValueError(f"policies: expected policies that observe the same, got {found} and {own} ({spec.name})")
        found = own or found
    return found


def _prepare(directory: Path, force: bool) -> None:
    """Create the directory, or refuse it because of its content."""
    content = {path.name for path in directory.iterdir()} if directory.is_dir() else set()
    shutil.rmtree(directory / PARTIAL, ignore_errors=True)  # of a run that was interrupted
    if force and "leapnav" in content and content <= {PARTIAL, "leapnav"}:
        shutil.rmtree(directory / "leapnav")
        content = set()
    if (directory.exists() and not directory.is_dir()) or content - {PARTIAL}:
        raise FileExistsError(f"{directory}: exists and is not empty; choose another directory or remove it")
    directory.mkdir(parents=True, exist_ok=True)


def _solve(sample: partial[Scenario], seed: int) -> tuple[Scenario, float | None]:
    """Return a scenario and its optimal cost, or None without a certified optimum."""
    scenario = sample(seed)
    optimum = find_optimum(scenario, "medium")
    return scenario, optimum.cost if optimum.success else None


def _with_noise(act: Act, noise: float, rng: np.random.Generator) -> Act:
    """Return an `act` function whose actions have noise."""

    def disturbed(observation: Any, info: dict[str, Any]) -> np.ndarray | None:
        action = act(observation, info)
        if action is None or noise == 0.0:
            return action
        return np.clip(action + noise * rng.standard_normal(action.shape), -1.0, 1.0).astype(np.float32)

    return disturbed


def _play(env: Any, act: Act, scenario: Scenario, cost: float, number: int, seed: int) -> tuple[EpisodeBuffer, bool]:
    """Play an episode; return its content, and whether it ended in success."""
    observation, info, steps = play_episode(env, act, options={"scenario": scenario})
    transitions = list(steps)
    infos = [info, *(step.info for step in transitions)]
    buffer = EpisodeBuffer(
        id=number,
        seed=seed,
        options={"scenario": scenario.to_json()},
        observations=cast(list[Any], np.stack([observation, *(step.observation for step in transitions)])),
        actions=cast(list[Any], np.stack([step.action for step in transitions])),
        rewards=[step.reward for step in transitions],
        terminations=[step.terminated for step in transitions],
        truncations=[step.truncated for step in transitions],
        infos={
            "state": np.array([state_of(one) for one in infos]),
            "running_cost": np.diff([0.0, *(one["cost"] for one in infos)]),
            "reference_cost": np.full(len(infos), cost),
            "is_success": np.array([bool(one["is_success"]) for one in infos]),
        },
    )
    return buffer, bool(infos[-1]["is_success"])
