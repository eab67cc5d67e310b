"""Scenario banks: files of scenarios with their certified optima, memory-mapped.

A bank is an HDF5 file with contiguous, uncompressed, little-endian datasets, so any HDF5 reader opens it and this one
maps it into memory. With n scenarios and N_i points of the i-th optimum, evenly spaced in time from 0 to the horizon:

| Dataset | Shape, type | Content |
|---|---|---|
| `scenarios` | (bytes,) uint8 | the scenarios' JSON texts, one after the other |
| `scenario_ends` | (n,) int64 | where each text ends |
| `tasks` | (n, 11) float64 | start (3), goal (3, heading NaN if free), horizon, limits (2), weights (2) |
| `fields` | (sum of the lengths,) float64 | the scenarios' obstacles, packed, see `leapnav.envs.fields` |
| `field_ends` | (n,) int64 | where each field ends |
| `draws` | (n,) int64 | number of the random draw that gave the scenario |
| `costs` | (n,) float64 | J* |
| `second_costs` | (n,) float64 | J of the second-best local optimum found, NaN if there is none |
| `certificates` | (n, 4) float64 | boundary residual, defect, drift of H, clearance (m) |
| `path_ends` | (n,) int64 | where each optimum's points end |
| `states` | (sum of N_i, 3) float32 | x, y (m), heading (rad, unwrapped) |
| `controls` | (sum of N_i, 2) float32 | speed (m/s), turn rate (rad/s) |
| `costates` | (sum of N_i, 3) float32 | lambda, the gradient of the cost-to-go |

Attributes of the file: `format` ("leapnav-bank"), `version` (3), `family`, `seed`, `drawn` (how many scenarios were
drawn for the n that were admitted), `rejected` (JSON: how many were not, by reason) and `software` (the leapnav version
that built it).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, overload

import numpy as np

from leapnav.envs.scenario import TASK_COLUMNS, Scenario

FORMAT, VERSION = "leapnav-bank", 3
INTERVAL = 0.1  # s between points of an optimum, at most
SPLITS = ("train", "test")
FOLDER = Path(__file__).parent / "banks"
_TYPES = {
    "scenarios": "u1",
    "scenario_ends": "<i8",
    "tasks": "<f8",
    "fields": "<f8",
    "field_ends": "<i8",
    "draws": "<i8",
    "costs": "<f8",
    "second_costs": "<f8",
    "certificates": "<f8",
    "path_ends": "<i8",
    "states": "<f4",
    "controls": "<f4",
    "costates": "<f4",
}

_WIDTHS = {"tasks": (TASK_COLUMNS,), "certificates": (4,), "states": (3,), "controls": (2,), "costates": (3,)}


class BankError(ValueError):
    """A file is no scenario bank, or one that this version cannot read. The message names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The certified optimum of a bank's scenario.

    Attributes:
        cost: J*.
        second_cost: J of the second-best local optimum found, None if there is none.
        certificate: boundary residual, defect, drift of H, clearance (m).
        times (N,): s, from 0 to the horizon.
        states (N, 3), controls (N, 2), costates (N, 3): float32.

    """

    cost: float
    second_cost: float | None
    certificate: tuple[float, float, float, float]
    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray


@dataclass(frozen=True, eq=False)
class BankEntry:
    """What a bank stores of one scenario; `Reference` explains the fields."""

    scenario: str
    draw: int
    cost: float
    second_cost: float | None
    certificate: tuple[float, float, float, float]
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray


class ScenarioBank(Sequence[Scenario]):
    """A bank as a sequence of scenarios, read when they are asked for; `reference(i)` has the optimum.

    Args:
        path: the file. Nothing but its header is read at first.

    Attributes:
        path: the file.
        family, seed: what the scenarios were drawn from.
        drawn: how many scenarios were drawn for those that were admitted.
        rejected: how many of them were not admitted, by reason.
        software: the version of leapnav that built the bank.
        costs (n,), second_costs (n,), certificates (n, 4), draws (n,), tasks (n, 11): see the module.

    Raises:
        FileNotFoundError: there is no such file.
        BankError: it is no bank, damaged, or of another version of the format.

    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()  # so that other processes find it, wherever they work
        self._open()

    def _open(self) -> None:
        import h5py  # takes longer to import than a bank to load, and not every user has one

        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such bank")
        try:
            with h5py.File(self.path, "r") as file:
                attributes: dict[str, Any] = dict(file.attrs)
                if attributes.get("format") != FORMAT:
                    raise BankError(f"{self.path}: an HDF5 file, but no scenario bank")
                if attributes.get("version") != VERSION:
                    raise BankError(
                        f"{self.path}: version {attributes.get('version')} of the format; this leapnav reads {VERSION}"
                    )
                places = {name: _place(file[name], name) for name in _TYPES}
            self.family, self.software = str(attributes["family"]), str(attributes["software"])
            self.seed, self.drawn = int(attributes["seed"]), int(attributes["drawn"])
            self.rejected: dict[str, int] = dict(json.loads(attributes["rejected"]))
            content = np.asarray(np.memmap(self.path, dtype="u1", mode="r"))
            arrays = {
                name: content[start : start + size].view(_TYPES[name]).reshape(shape)
                for name, (start, size, shape) in places.items()
            }
            _check_lengths(arrays)
        except BankError:
            raise
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            raise BankError(f"{self.path}: no scenario bank, or damaged: {' '.join(str(error).split())}") from None
        self._arrays = arrays
        self.costs, self.second_costs = arrays["costs"], arrays["second_costs"]
        self.certificates, self.draws = arrays["certificates"], arrays["draws"]
        self.tasks = arrays["tasks"]
        self._scenarios: dict[int, Scenario] = {}

    @classmethod
    def shipped(cls, family: str, split: str) -> ScenarioBank:
        """A bank that comes with the package; always the same object, so that all share what has been read.

        Args:
            family: one of `leapnav.envs.FAMILIES`.
            split: "train" or "test".

        Raises:
            ValueError: there is no such family or split.

        """
        families = sorted(path.name.removesuffix("-test.bank") for path in FOLDER.glob("*-test.bank"))
        if family not in families:
            raise ValueError(f"family: expected one of {', '.join(families)}, got {family!r}")
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}")
        return _shipped(family, split)

    def __len__(self) -> int:
        return len(self.costs)

    @overload
    def __getitem__(self, index: int) -> Scenario: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scenario]: ...
    def __getitem__(self, index: int | slice) -> Scenario | list[Scenario]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = self._number(index)
        if i not in self._scenarios:
            start, end = self._span("scenario_ends", i)
            try:
                self._scenarios[i] = Scenario.from_json(self._arrays["scenarios"][start:end].tobytes().decode())
            except ValueError as error:  # of the encoding, or of the scenario
                raise BankError(f"{self.path}: scenario {i}: damaged: {error}") from None
        return self._scenarios[i]

    def __iter__(self) -> Iterator[Scenario]:
        return (self[i] for i in range(len(self)))

    def reference(self, index: int) -> Reference:
        """The optimum of a scenario.

        Raises:
            IndexError: there are fewer scenarios.

        """
        i = self._number(index)
        start, end = self._span("path_ends", i)
        second = float(self.second_costs[i])
        residual, defect, drift, clearance = self.certificates[i].tolist()
        return Reference(
            cost=float(self.costs[i]),
            second_cost=None if math.isnan(second) else second,
            certificate=(residual, defect, drift, clearance),
            times=np.linspace(0.0, self[i].horizon, end - start),
            states=self.states(i),
            controls=self._arrays["controls"][start:end],
            costates=self._arrays["costates"][start:end],
        )

    def field(self, index: int) -> np.ndarray:
        """The packed obstacle field of a scenario, without a look at the scenario itself.

        Raises:
            IndexError: there are fewer scenarios.

        """
        start, end = self._span("field_ends", self._number(index))
        return self._arrays["fields"][start:end]

    def states(self, index: int) -> np.ndarray:
        """The states (N, 3) of a scenario's optimum alone, see `Reference`.

        Raises:
            IndexError: there are fewer scenarios.

        """
        start, end = self._span("path_ends", self._number(index))
        return self._arrays["states"][start:end]

    def _number(self, index: int) -> int:
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)):
            raise TypeError(f"index: expected an integer, got {index!r}")
        i = int(index) + len(self) if index < 0 else int(index)
        if not 0 <= i < len(self):
            raise IndexError(f"index: {self.path.name} has {len(self)} scenarios, got {index}")
        return i

    def _span(self, ends: str, i: int) -> tuple[int, int]:
        return (0 if i == 0 else int(self._arrays[ends][i - 1])), int(self._arrays[ends][i])

    def __repr__(self) -> str:
        return f"ScenarioBank({str(self.path)!r}, {len(self)} scenarios of {self.family})"

    def __getstate__(self) -> dict[str, Any]:
        # Another process maps the file itself.
        return {"path": self.path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path = state["path"]
        self._open()


@cache
def _shipped(family: str, split: str) -> ScenarioBank:
    return ScenarioBank(FOLDER / f"{family}-{split}.bank")


def _place(dataset: Any, name: str) -> tuple[int, int, tuple[int, ...]]:
    """Where a dataset lies in the file: first byte, number of bytes, and its shape."""
    if (
        dataset.dtype != np.dtype(_TYPES[name])
        or dataset.chunks is not None
        or dataset.shape[1:] != _WIDTHS.get(name, ())
    ):
        raise ValueError(f"{name}: not as the format has it")
    # A dataset without entries has no place.
    return dataset.id.get_offset() or 0, math.prod(dataset.shape) * dataset.dtype.itemsize, dataset.shape


def _check_lengths(arrays: Mapping[str, np.ndarray]) -> None:
    count = len(arrays["costs"])
    for name in ("scenario_ends", "tasks", "field_ends", "draws", "second_costs", "certificates", "path_ends"):
        if len(arrays[name]) != count:
            raise ValueError(f"{name}: {len(arrays[name])} entries for {count} scenarios")
    paths = ("states", "controls", "costates")
    for ends, contents in (("scenario_ends", ("scenarios",)), ("field_ends", ("fields",)), ("path_ends", paths)):
        last = int(arrays[ends][-1]) if count else 0
        if (np.diff(arrays[ends], prepend=0) <= 0).any() or any(len(arrays[name]) != last for name in contents):
            raise ValueError(f"{ends}: not the ends of {' and '.join(contents)}")


def point_times(horizon: float) -> np.ndarray:
    """Times (N,) of the points that a bank stores of an optimum, in s."""
    return np.linspace(0.0, horizon, math.ceil(horizon / INTERVAL - 1e-6) + 1)


def write_bank(
    path: str | os.PathLike[str],
    entries: Sequence[BankEntry],
    *,
    family: str,
    seed: int,
    drawn: int,
    rejected: Mapping[str, int],
    software: str,
) -> None:
    """Writes a bank; the same arguments give the same bytes, and an interruption leaves no half of a file."""
    import h5py

    texts = [entry.scenario.encode() for entry in entries]
    scenarios = [Scenario.from_json(entry.scenario) for entry in entries]
    arrays = {
        "scenarios": np.frombuffer(b"".join(texts), dtype="u1"),
        "scenario_ends": np.cumsum([len(text) for text in texts]),
        "tasks": np.array([scenario.task for scenario in scenarios]).reshape(-1, TASK_COLUMNS),
        "fields": np.concatenate([np.empty(0), *(scenario.field for scenario in scenarios)]),
        "field_ends": np.cumsum([len(scenario.field) for scenario in scenarios]),
        "draws": [entry.draw for entry in entries],
        "costs": [entry.cost for entry in entries],
        "second_costs": [math.nan if entry.second_cost is None else entry.second_cost for entry in entries],
        "certificates": np.array([entry.certificate for entry in entries]).reshape(-1, 4),
        "path_ends": np.cumsum([len(entry.states) for entry in entries]),
        "states": np.concatenate([np.empty((0, 3)), *(entry.states for entry in entries)]),
        "controls": np.concatenate([np.empty((0, 2)), *(entry.controls for entry in entries)]),
        "costates": np.concatenate([np.empty((0, 3)), *(entry.costates for entry in entries)]),
    }
    target = Path(path)
    name = target.with_name(f".{target.name}.partial")  # always the same: what a killed process leaves is overwritten
    try:
        # Aligned, so that the mapped arrays are.
        with h5py.File(name, "w", alignment_threshold=1, alignment_interval=64) as file:
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            file.attrs["family"], file.attrs["seed"] = family, seed
            file.attrs["drawn"], file.attrs["rejected"] = drawn, json.dumps(dict(sorted(rejected.items())))
            file.attrs["software"] = software
            for dataset, values in arrays.items():
                file.create_dataset(dataset, data=np.asarray(values, dtype=_TYPES[dataset]))
        name.replace(target)
    except BaseException:
        name.unlink(missing_ok=True)
        raise
