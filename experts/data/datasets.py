"""Minari datasets of episodes: their environments, reference scores, names and files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

import leapnav
from leapnav.envs.episodes import play_episode
from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.bank import ScenarioBank, collection_name
from leapnav.envs.scenarios.families import ALL, ALL_FAMILIES, MAX_HORIZON
from leapnav.envs.scenarios.scenario import TIME_LIMIT_FACTOR, Scenario
from leapnav.envs.settings import CONTROL_PERIOD
from leapnav.envs.utils.files import digest

ENVIRONMENT = "leapnav/Navigate-v0"
CHECKSUM = "leapnav_sha256"  # key of the metadata: checksum of the data file
WORK = ".rollout"  # directory of an unfinished rollout
# Step limit of a dataset's environment. No episode reaches it, but d3rlpy requires a limit.
MAX_STEPS = {
    "fixed": ceil(MAX_HORIZON / CONTROL_PERIOD) + 1,
    "free": ceil(TIME_LIMIT_FACTOR * MAX_HORIZON / CONTROL_PERIOD) + 1,
}
STEPS_FACTOR = 10  # for families with larger arenas, and those whose horizons are not known
N_SCORED = 100  # scenarios from which the score of random actions is computed


@dataclass(frozen=True)
class Task:
    """What is recorded in a dataset.

    Attributes:
        family: family of the scenarios.
        robot: the robot.
        horizon: "fixed" or "free".
        obstacles: "cost" or "hard".
        environment: further arguments of the environment, such as `observation`.

    """

    family: str
    robot: RobotModel = field(default_factory=Unicycle)
    horizon: str = "fixed"
    obstacles: str = "cost"
    environment: Mapping[str, Any] = field(default_factory=dict)

    def make_env(self) -> gym.Env:
        """Return the environment of the dataset, which plays the training scenarios or fresh ones."""
        arguments: dict[str, Any] = {"split": "fresh"} if self._other else {}
        return self._make(**self._other, **arguments)

    def make_eval_env(self) -> gym.Env:
        """Return the environment for evaluations: the test bank, or fresh scenarios if none is included."""
        return self.make_env() if self.test_bank is None else self._make(**self._other, split="test")

    @property
    def test_bank(self) -> ScenarioBank | None:
        """The included test bank; None if there is none."""
        kinds = self.horizon, self.obstacles
        names = ScenarioBank.shipped_families(self.robot.model, *kinds)
        if self.robot != type(self.robot)() or self.family not in names:
            return None
        return ScenarioBank.shipped(self.family, "test", self.robot.model, *kinds)

    @property
    def _other(self) -> dict[str, Any]:
        """The arguments of the environment that are not the default."""
        arguments: dict[str, Any] = {} if self.horizon == "fixed" else {"horizon": self.horizon}
        if self.obstacles != "cost":
            arguments["obstacles"] = self.obstacles
        if self.robot != Unicycle():
            fields = self.robot.model_dump(mode="json", exclude_none=True)
            arguments["robot"] = self.robot.model if self.robot == type(self.robot)() else fields
        return arguments

    def _make(self, **arguments: Any) -> gym.Env:
        limit = MAX_STEPS[self.horizon] * (1 if self.family in (*ALL_FAMILIES, ALL) else STEPS_FACTOR)
        limit = ceil(limit * CONTROL_PERIOD / self.environment.get("control_period", CONTROL_PERIOD))
        given = {**self.environment, **arguments}
        return gym.make(ENVIRONMENT, family=self.family, max_episode_steps=limit, **given)


def write_episodes(
    episodes: Iterable[tuple[Scenario, float, EpisodeBuffer]],
    root: Path,
    name: str,
    task: Task,
    *,
    algorithm: str,
    description: str,
) -> None:
    """Write a Minari dataset.

    Its reference scores, for `minari.get_normalized_score`, are the mean returns of uniformly random actions and of the
    optimum in its `eval_env`: in the included test bank, or in the scenarios of the dataset if there is none.

    Args:
        episodes: scenario, reference cost and content of each episode; consumed one by one.
        root: root directory of Minari datasets.
        name: the dataset id, see `dataset_id`.
        task: what is recorded.
        algorithm, description: metadata.

    """
    env, eval_env, bank = task.make_env(), task.make_eval_env(), task.test_bank
    scenarios: dict[str, Scenario] = {}
    costs: list[float] = []

    def buffers() -> Iterator[EpisodeBuffer]:
        for scenario, cost, buffer in episodes:
            costs.append(cost)
            if len(scenarios) < N_SCORED:
                scenarios[scenario.name] = scenario
            yield buffer

    with minari_root(str(root)):
        dataset = minari.create_dataset_from_buffers(
            name,
            cast(list[EpisodeBuffer], buffers()),  # Minari declares a list, but any iterable works
            env=env,
            eval_env=eval_env,
            algorithm_name=algorithm,
            author="leapnav",
            author_email="",
            code_permalink="",
            description=description,
            requirements=[f"leapnav=={leapnav.__version__}"],
        )
        scored = list(scenarios.values()) if bank is None else bank[:N_SCORED]
        scores = {
            "ref_min_score": _random_score(env, scored),
            "ref_max_score": -float(np.mean(costs if bank is None else bank.costs)),
        }
        dataset.storage.update_metadata({**scores, CHECKSUM: digest(_data_file(dataset))})


def _random_score(env: gym.Env, scenarios: Sequence[Scenario]) -> float:
    """Mean return of uniformly random actions."""
    rng = np.random.default_rng(0)
    total = 0.0
    for scenario in scenarios:
        _, _, steps = play_episode(
            env,
            lambda *_: rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32),
            options={"scenario": scenario},
        )
        for step in steps:
            total += step.reward
    return total / len(scenarios)


def dataset_id(
    family: str, robot: str = "unicycle", horizon: str = "fixed", obstacles: str = "cost", policy: str = "expert"
) -> str:
    """The Minari dataset id of a family, for a robot, kinds of horizon and obstacles, and the recorded policy."""
    return f"leapnav/{collection_name(family, robot, horizon, obstacles)}/{policy}-v0"


@contextmanager
def minari_root(directory: str) -> Iterator[None]:
    """Set Minari's root directory, for which only an environment variable exists."""
    name = "MINARI_DATASETS_PATH"
    before = os.environ.get(name)
    os.environ[name] = directory
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def open_dataset(folder: str | os.PathLike[str]) -> minari.MinariDataset:
    """Open the only Minari dataset below a directory.

    Raises:
        FileNotFoundError: there is no dataset, an unfinished one, or more than one.
        ValueError: the dataset was not written by `rollout`, or has changed since.

    """
    if (Path(folder) / WORK).exists():
        raise FileNotFoundError(f"{os.fspath(folder)}: an unfinished rollout; repeat its command to finish it")
    found = sorted(path.parent for path in Path(folder).glob("**/data/metadata.json"))
    if len(found) != 1:
        raise FileNotFoundError(f"{os.fspath(folder)}: expected one Minari dataset, found {len(found)}")
    try:
        dataset = minari.MinariDataset(found[0])
        expected = dataset.storage.metadata.get(CHECKSUM)
    except OSError:
        raise
    except Exception as error:  # damaged metadata may raise any error in Minari and Gymnasium
        raise ValueError(f"{found[0] / 'metadata.json'}: not that of a dataset: {error!r}") from None
    if expected is None:
        raise ValueError(f"{found[0]}: expected a dataset written by leapnav rollout, got one without a checksum")
    if digest(_data_file(dataset)) != expected:
        raise ValueError(f"{_data_file(dataset)}: damaged, or changed since it was written")
    return dataset


def _data_file(dataset: minari.MinariDataset) -> Path:
    return Path(dataset.storage.data_path) / "main_data.hdf5"
