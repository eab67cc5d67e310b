"""What the expert did, as arrays to learn from."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np

from leapnav.envs.observer import Observer
from leapnav.envs.scenario import Scenario
from leapnav.envs.settings import SENSORS, Settings
from leapnav.experts.demonstrations import CONTROL_PERIOD, ENVIRONMENT, Demonstration, open_dataset

FORMAT = 2  # of the files
EPISODES_ONLY = ("family", "split", "bank", "scenario")  # arguments that change what is played, not what is seen


@dataclass(frozen=True, eq=False)
class Dataset:
    """N samples of the expert: what was observed, and what the optimum does there.

    Attributes:
        observations (N, d): float32.
        actions (N, 2): the expert's, float32, in [-1, 1].
        returns (N,): of the rest of the episode, the expert driving on: minus the cost-to-go; NaN where unknown.
        costates (N, 3): gradient of the cost-to-go by x, y and heading; NaN where unknown.
        states (N, 3): x, y (m), heading (rad).
        times (N,): s since the start of the episode.
        executed (N, 2): the actions that were driven, float32; NaN where unknown.
        rewards (N,): for them; NaN where unknown.
        episodes (N,): int64, the sample's place in `scenarios`.
        scenarios: of the episodes, as JSON.
        settings: of the environment that the observations are of.

    Raises:
        ValueError: there are no samples, or the shapes do not fit.

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
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        count = len(self.observations)
        if count == 0:
            raise ValueError("dataset: expected at least one sample, got none")
        for name, shape in _SHAPES.items():
            found = getattr(self, name).shape
            if found != (count, *shape):
                raise ValueError(f"dataset: {name}: expected the shape {(count, *shape)}, got {found}")
        for name in ("observations", "actions"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"dataset: {name}: expected finite numbers")

    def __len__(self) -> int:
        return len(self.observations)

    def __getitem__(self, chosen: np.ndarray | slice) -> Dataset:
        """The samples that an index array, a mask or a slice chooses."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})

    def observed(self, settings: Settings) -> Dataset:
        """The same samples as robots with other sensors would have observed them, undisturbed.

        Args:
            settings: of their environment; only the sensors' count.

        Raises:
            ValueError: the robots are driven in another way, so that they would show more than the samples know.

        """
        if settings.actuation != self.settings.actuation:
            expected, given = self.settings.actuation, settings.actuation
            raise ValueError(f"actuation: the samples are of {expected!r}, got {given!r}")
        settings = replace(self.settings, **{name: getattr(settings, name) for name in SENSORS})
        if settings == self.settings:
            return self
        found = [Scenario.from_json(text) for text in self.scenarios]
        scenarios = [found[episode] for episode in self.episodes.tolist()]
        observations = Observer(settings).observe(scenarios, self.states, self.times)
        return replace(self, observations=observations, settings=settings)

    @cached_property
    def _tasks(self) -> list[dict[str, Any]]:
        # Not validated again, for that takes longer than everything else.
        return [json.loads(text) for text in self.scenarios]

    @property
    def limits(self) -> np.ndarray:
        """m/s and rad/s (N, 2) that the actions -1 and 1 stand for."""
        return self._of_tasks([[task["robot"][name] for name in _LIMITS] for task in self._tasks])

    @property
    def weights(self) -> np.ndarray:
        """Weights of the cost (N, 2), for speed and turn rate."""
        return self._of_tasks([[task["cost"][name] for name in _WEIGHTS] for task in self._tasks])

    @cached_property
    def course_texts(self) -> list[str]:
        """Obstacles and goal of each of `scenarios`, as JSON."""
        return [json.dumps([task["obstacles"], task["goal"]]) for task in self._tasks]

    def _of_tasks(self, values: list[Any]) -> np.ndarray:
        return np.array(values)[self.episodes]

    @classmethod
    def joined(cls, parts: Sequence[Dataset]) -> Dataset:
        """Several datasets as one.

        Raises:
            ValueError: there are none, or they were observed in different environments.

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
        """A dataset from any of its forms.

        Args:
            source: a dataset, a folder that `leapnav rollout` wrote, demonstrations, or several of these.

        Raises:
            FileNotFoundError: a folder holds no dataset.
            ValueError: a dataset is empty, damaged, or of another environment; the message says which and why.

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
    def _read(cls, folder: Path) -> Dataset:
        dataset = open_dataset(folder)
        environment = dataset.env_spec.id if dataset.env_spec is not None else None
        if environment != ENVIRONMENT:
            raise ValueError(f"{folder}: a dataset of {environment}; leapnav learns from {ENVIRONMENT}")
        assert dataset.env_spec is not None  # it has an id
        known = set(EPISODES_ONLY)
        differing = [f"{k}={v!r}" for k, v in (dataset.env_spec.kwargs or {}).items() if k not in known]
        if differing:
            raise ValueError(
                f"{folder}: a dataset of {environment} with {', '.join(differing)}; leapnav learns from its defaults"
            )
        metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
        return cls._stack(
            _from_episode(folder, episode, info)
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
        whole: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
        return cls(**whole, scenarios=tuple(scenarios))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a file; an interruption leaves no half of one."""
        target = Path(path)
        partial = target.with_name(f".{target.name}.partial")
        columns: dict[str, Any] = {name: getattr(self, name) for name in _COLUMNS}
        with partial.open("wb") as file:
            settings = json.dumps(asdict(self.settings))
            np.savez(file, format=FORMAT, settings=settings, scenarios=np.array(self.scenarios), **columns)
        partial.replace(target)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Dataset:
        """Reads what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is damaged, or of another format.

        """
        if Path(path).is_file() and not is_zipfile(path):  # of which numpy says that it might be a pickle
            raise ValueError(f"{os.fspath(path)}: not a dataset's file")
        try:
            with np.load(path, allow_pickle=False) as file:
                found = int(file["format"])
                if found != FORMAT:
                    raise ValueError(f"format {found}, this leapnav reads {FORMAT}")
                settings = Settings(**json.loads(str(file["settings"])))
                columns = {name: file[name] for name in _COLUMNS}
                return cls(**columns, scenarios=tuple(file["scenarios"].tolist()), settings=settings)
        except FileNotFoundError:
            raise
        except Exception as error:  # zipfile, zlib and numpy raise many kinds for a broken file
            raise ValueError(f"{os.fspath(path)}: not a dataset's file: {' '.join(str(error).split())}") from None


_SHAPES = {
    "actions": (2,),
    "returns": (),
    "costates": (3,),
    "states": (3,),
    "times": (),
    "executed": (2,),
    "rewards": (),
    "episodes": (),
}
_COLUMNS = ("observations", *_SHAPES)
_LIMITS, _WEIGHTS = ("max_speed", "max_turn_rate"), ("speed_weight", "turn_weight")
_NEEDED = {"state", "costate", "cost_to_go", "executed_action"}  # of an episode's infos


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


def _from_episode(folder: Path, episode: Any, metadata: Mapping[str, Any]) -> tuple[str, dict[str, np.ndarray]]:
    infos, text = episode.infos or {}, (metadata.get("options") or {}).get("scenario")
    missing = sorted(_NEEDED - set(infos)) + ([] if text is not None else ["scenario"])
    if missing:
        raise ValueError(f"{folder}: episode {episode.id} has no {missing[0]}; `leapnav rollout` writes it")
    return str(text), {
        "observations": episode.observations[:-1],
        "actions": episode.actions,
        "returns": -infos["cost_to_go"][:-1],
        "costates": infos["costate"][:-1],
        "states": infos["state"][:-1],
        "times": CONTROL_PERIOD * np.arange(len(episode.actions)),
        "executed": infos["executed_action"][:-1],
        "rewards": episode.rewards,
    }
