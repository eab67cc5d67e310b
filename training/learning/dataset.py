"""Samples of the expert as arrays to learn from."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.families import is_built_in
from leapnav.envs.scenarios.scenario import Scenario, check_robot
from leapnav.envs.scenarios.sources import ScenarioSource
from leapnav.envs.settings import CONTROL_PERIOD, SENSORS, EnvironmentSettings
from leapnav.envs.simulation.observations import TIME_LEFT
from leapnav.envs.simulation.observer import Observer
from leapnav.envs.unwrapping import unwrap
from leapnav.envs.utils.files import atomic_path
from leapnav.experts.data.datasets import ENVIRONMENT, open_dataset
from leapnav.experts.data.demonstrations import Demonstration
from leapnav.training.policies.symmetries import Transformation, symmetries

FORMAT = 3  # version of the file format
# Arguments of the environment that select the scenarios; the meaning of an observation does not depend on them.
SCENARIO_ARGUMENTS = ("family", "split", "bank", "scenario", "robot", "horizon", "obstacles")


@dataclass(frozen=True, eq=False)
class Dataset:
    """N samples: observations, and the expert's actions and values at the same states.

    Attributes:
        observations (N, d): float32.
        actions (N, m): the expert's actions, float32, in [-1, 1].
        returns (N,): expert's return from the sample to the end of the episode (-cost-to-go); NaN if unknown.
        costates (N, n): gradient of the cost-to-go with respect to the state; NaN if unknown.
        states (N, n): x, y (m), heading (rad) and further states of the robot.
        times (N,): time since the start of the episode (s).
        executed (N, m): the actions that were executed, float32; NaN if unknown.
        rewards (N,): the rewards of the executed actions; NaN if unknown.
        episodes (N,): int64, index of the sample's scenario in `scenarios`.
        scenarios: the scenarios of the episodes, as JSON.
        settings: settings of the environment of the observations.

    Raises:
        ValueError: there are no samples, the shapes are inconsistent, or observations or actions are not finite.

    """

    observations: np.ndarray
    actions: np.ndarray
    returns: np.ndarray
    costates: np.ndarray
    states: np.ndarray
    times: np.ndarray
    executed: np.ndarray
    rewards: np.ndarray
    episodes: np.ndarray
    scenarios: tuple[str, ...]
    settings: EnvironmentSettings = field(default_factory=EnvironmentSettings)

    def __post_init__(self) -> None:
        count = len(self.observations)
        if count == 0:
            raise ValueError("dataset: expected at least one sample, got none")
        n, m = self.settings.model.sizes()
        for name, kind in _SHAPES.items():
            shape = {"scalar": (), "state": (n,), "control": (m,)}[kind]
            found = getattr(self, name).shape
            if found != (count, *shape):
                raise ValueError(f"dataset: {name}: expected the shape {(count, *shape)}, got {found}")
        for name in ("observations", "actions"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"dataset: {name}: expected finite numbers")

    def __len__(self) -> int:
        return len(self.observations)

    def __getitem__(self, chosen: np.ndarray | slice) -> Dataset:
        """Select samples by an index array, a mask or a slice."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})

    def observed(self, settings: Any) -> Dataset:
        """Return the same samples with the observations of other sensors, without noise.

        The history of a sample and its last action are those of the samples before it in its episode.

        Args:
            settings: the `EnvironmentSettings` of an environment with these sensors, the environment itself, or a
                Stable-Baselines3 algorithm with it. Only the settings of the sensors are used.

        Raises:
            TypeError: the environment is not one of leapnav, or the algorithm has none.
            ValueError: the environment has another actuation, whose state the samples do not contain.

        """
        if not isinstance(settings, EnvironmentSettings):
            env = settings.get_env() if isinstance(settings, BaseAlgorithm) else settings
            settings = unwrap(env)[0].settings
        if settings.actuation != self.settings.actuation:
            expected, given = self.settings.actuation, settings.actuation
            raise ValueError(f"actuation: expected that of the samples, {expected!r}, got {given!r}")
        settings = replace(self.settings, **{name: getattr(settings, name) for name in SENSORS})
        if settings == self.settings:
            return self
        parsed = [Scenario.from_json(text) for text in self.scenarios]
        scenarios = [parsed[episode] for episode in self.episodes.tolist()]
        starts = np.append(True, (np.diff(self.episodes) != 0) | (np.diff(self.times) > 1.5 * settings.control_period))
        previous = np.where(starts[:, None], 0.0, np.nan_to_num(np.roll(self.executed, 1, axis=0)))
        first = np.maximum.accumulate(np.where(starts, np.arange(len(self)), 0))
        observations = Observer(settings).observe(scenarios, self.states, self.times, previous, first)
        return replace(self, observations=observations, settings=settings)

    @cached_property
    def _scenario_fields(self) -> list[dict[str, Any]]:
        # Without the validation of `Scenario`, which would dominate the time.
        return [json.loads(text) for text in self.scenarios]

    @property
    def families(self) -> list[str]:
        """The families of the scenarios, according to their names."""
        return sorted({re.sub(r"(-\d+)+$", "", fields["name"]) for fields in self._scenario_fields})

    def warn_of_other(self, source: ScenarioSource, stacklevel: int = 3) -> None:
        """Warn if the samples are of another robot, or of other families, than the scenarios of an environment.

        Args:
            source: the scenarios of the environment.
            stacklevel: see `warnings.warn`.

        """
        robots = list({json.dumps(fields["robot"]): fields["robot"] for fields in self._scenario_fields}.values())
        differences = check_robot(robots[0]).differences(source.robot) if len(robots) == 1 else []
        if differences:
            text = "; ".join(differences)
            warnings.warn(f"dataset: demonstrations of another robot: {text}", stacklevel=stacklevel)
        if is_built_in(source.family) and source.family not in self.families:
            families = ", ".join(self.families)
            warnings.warn(f"dataset: demonstrations of {families}, here {source.family}", stacklevel=stacklevel)

    @property
    def halves(self) -> np.ndarray:
        """Half widths (N, m) of the intervals of the controls of each sample's robot: the controls per unit action."""
        return self._per_sample([robot.action_scale()[1] for robot, _ in self._robots])

    @property
    def controls(self) -> np.ndarray:
        """Controls (N, m) of the actions."""
        return self._per_sample([robot.action_scale()[0] for robot, _ in self._robots]) + self.halves * self.actions

    @property
    def weights(self) -> np.ndarray:
        """Cost weights (N, m) of the controls of each sample's scenario."""
        return self._per_sample([robot.control_weight(cost) for robot, cost in self._robots])

    @property
    def parameters(self) -> np.ndarray:
        """Parameters (N, k) of the dynamics of each sample's robot."""
        return self._per_sample([robot.parameters(cost) for robot, cost in self._robots])

    @property
    def time_left(self) -> np.ndarray:
        """Time (N,) until the expert reaches the goal (s); with a free horizon, an estimate from the cost-to-go.

        An optimum with a free horizon has H = 0, hence a running cost of 2 (c + Phi), which is at least 2 c.
        """
        if not self.settings.free_horizon:
            return self.observations[:, TIME_LEFT]
        return -self.returns / (2.0 * self._per_sample([cost.time_weight for _, cost in self._robots]))

    @property
    def symmetries(self) -> tuple[Transformation, ...]:
        """The symmetries that the observations and all robots have."""
        return symmetries(self.settings, (robot for robot, _ in self._robots))

    @cached_property
    def _robots(self) -> list[tuple[RobotModel, Cost]]:
        """The robot and the cost of each of `scenarios`."""
        return [(check_robot(fields["robot"]), Cost(**fields["cost"])) for fields in self._scenario_fields]

    @cached_property
    def course_texts(self) -> list[str]:
        """Obstacles and goal of each of `scenarios`, as JSON."""
        # Hashes of these texts decide the validation split, so their format must not change.
        return [json.dumps([fields["obstacles"], fields["goal"]]) for fields in self._scenario_fields]

    def _per_sample(self, values: list[Any]) -> np.ndarray:
        return np.array(values)[self.episodes]

    @classmethod
    def joined(cls, parts: Sequence[Dataset]) -> Dataset:
        """Concatenate datasets.

        Raises:
            ValueError: there are none, or their environments have different settings.

        """
        if not parts:
            raise ValueError("datasets: expected at least one, got none")
        if len(parts) == 1:
            return parts[0]
        for part in parts[1:]:
            if part.settings == parts[0].settings:
                continue
            for name, value in asdict(part.settings).items():
                if value != (first := asdict(parts[0].settings)[name]):
                    raise ValueError(f"datasets: {name}: expected the same for all, got {first!r} and {value!r}")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        offsets = np.cumsum([0, *(len(part.scenarios) for part in parts[:-1])])
        columns["episodes"] = np.concatenate([p.episodes + o for p, o in zip(parts, offsets, strict=True)])
        scenarios = tuple(text for part in parts for text in part.scenarios)
        return cls(**columns, scenarios=scenarios, settings=parts[0].settings)

    @classmethod
    def of(cls, source: Dataset | str | os.PathLike[str] | Sequence[Any]) -> Dataset:
        """Convert any supported source to a dataset.

        Args:
            source: a dataset, a directory written by `leapnav rollout`, a sequence of demonstrations, or a sequence of
                these sources, which are concatenated.

        Raises:
            FileNotFoundError: a directory contains no dataset.
            ValueError: a dataset is empty, damaged, or of another environment.

        """
        if isinstance(source, Dataset):
            return source
        if isinstance(source, (str, os.PathLike)):
            return cls._read(Path(source))
        parts = list(source)
        if not parts:
            raise ValueError("dataset: expected at least one demonstration, got none")
        if all(isinstance(part, Demonstration) for part in parts):
            return cls._stack(_from_demonstration(part) for part in parts)
        return cls.joined([cls.of(part) for part in parts])

    @classmethod
    def _read(cls, directory: Path) -> Dataset:
        dataset = open_dataset(directory)
        environment = dataset.env_spec.id if dataset.env_spec is not None else None
        if environment != ENVIRONMENT:
            raise ValueError(f"{directory}: expected a dataset of {ENVIRONMENT}, got one of {environment}")
        assert dataset.env_spec is not None  # checked above
        arguments = dataset.env_spec.kwargs or {}
        differing = [f"{name}={value!r}" for name, value in arguments.items() if name not in SCENARIO_ARGUMENTS]
        if differing:
            raise ValueError(
                f"{directory}: expected a dataset of {environment} with its defaults, got {', '.join(differing)}"
            )
        metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
        return cls._stack(
            _from_episode(directory, episode, info)
            for episode, info in zip(dataset.iterate_episodes(), metadata, strict=True)
        )

    @classmethod
    def _stack(cls, episodes: Iterable[tuple[str, dict[str, np.ndarray]]]) -> Dataset:
        columns: dict[str, list[np.ndarray]] = {name: [] for name in _COLUMNS}
        scenarios: list[str] = []
        for text, episode in episodes:
            for name, values in episode.items():
                columns[name].append(values)
            columns["episodes"].append(np.full(len(episode["actions"]), len(scenarios)))
            scenarios.append(text)
        if not scenarios:
            raise ValueError("dataset: expected at least one episode, got none")
        arrays: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
        fields = json.loads(scenarios[0])
        horizon = "free" if fields["horizon"] is None else "fixed"
        settings = EnvironmentSettings(robot=fields["robot"]["model"], horizon=horizon)
        return cls(**arrays, scenarios=tuple(scenarios), settings=settings)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the dataset to a file, atomically."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in _COLUMNS}
        settings = json.dumps(asdict(self.settings))
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.savez(file, format=FORMAT, settings=settings, scenarios=np.array(self.scenarios), **columns)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Dataset:
        """Read a file written by `save`.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged or has another format.

        """
        if Path(path).is_file() and not is_zipfile(path):  # the message of NumPy would be about pickle files
            raise ValueError(f"{os.fspath(path)}: not a dataset file")
        try:
            with np.load(path, allow_pickle=False) as file:
                if (version := int(file["format"])) != FORMAT:
                    raise ValueError(f"format: expected {FORMAT}, got {version}")
                settings = EnvironmentSettings(**json.loads(str(file["settings"])))
                columns = {name: file[name] for name in _COLUMNS}
                return cls(**columns, scenarios=tuple(file["scenarios"].tolist()), settings=settings)
        except FileNotFoundError:
            raise
        except Exception as error:  # zipfile, zlib and NumPy raise many types for a damaged file
            raise ValueError(f"{os.fspath(path)}: not a dataset file: {' '.join(str(error).split())}") from None


_SHAPES = {
    "actions": "control",
    "returns": "scalar",
    "costates": "state",
    "states": "state",
    "times": "scalar",
    "executed": "control",
    "rewards": "scalar",
    "episodes": "scalar",
}
_COLUMNS = ("observations", *_SHAPES)
_REQUIRED_INFOS = {"state", "costate", "cost_to_go", "expert_action"}


def _from_demonstration(demonstration: Demonstration) -> tuple[str, dict[str, np.ndarray]]:
    return demonstration.scenario.to_json(), {
        "observations": demonstration.observations[:-1],
        "actions": demonstration.actions,
        "returns": -demonstration.cost_to_go[:-1],
        "costates": demonstration.costates[:-1],
        "states": demonstration.states[:-1],
        "times": demonstration.path.times[:-1],
        "executed": demonstration.executed,
        "rewards": demonstration.rewards,
    }


def _from_episode(directory: Path, episode: Any, metadata: Mapping[str, Any]) -> tuple[str, dict[str, np.ndarray]]:
    infos, text = episode.infos or {}, (metadata.get("options") or {}).get("scenario")
    missing = sorted(_REQUIRED_INFOS - set(infos)) + ([] if text is not None else ["scenario"])
    if missing:
        raise ValueError(
            f"{directory}: episode {episode.id} has no {missing[0]}; write the dataset with `leapnav rollout`"
        )
    return str(text), {
        "observations": episode.observations[:-1],
        "actions": infos["expert_action"][:-1],
        "returns": -infos["cost_to_go"][:-1],
        "costates": infos["costate"][:-1],
        "states": infos["state"][:-1],
        "times": CONTROL_PERIOD * np.arange(len(episode.actions)),
        "executed": episode.actions,
        "rewards": episode.rewards,
    }
