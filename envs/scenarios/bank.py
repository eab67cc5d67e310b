"""Scenario banks: memory-mapped files of scenarios with their certified optima.

A bank is an HDF5 file with contiguous, uncompressed, little-endian datasets. Any HDF5 reader can open it; this one maps
it into memory. All scenarios of a bank have the same robot model, with n_q states and n_u controls. With n scenarios and
N_i points of the i-th optimum, evenly spaced in time from 0 to its duration:

| Dataset | Shape, type | Content |
|---|---|---|
| `scenarios` | (bytes,) uint8 | the scenarios as JSON text, concatenated |
| `scenario_ends` | (n,) int64 | the end of each text |
| `horizons` | (n,) float64 | durations of the optima (s) |
| `draws` | (n,) int64 | index of the random draw that produced the scenario |
| `costs` | (n,) float64 | J* |
| `second_costs` | (n,) float64 | J of the second-best local optimum found, NaN if there is none |
| `certificates` | (n, 4) float64 | boundary residual, defect, drift of H, clearance (m) |
| `path_ends` | (n,) int64 | the end of the points of each optimum |
| `states` | (sum of N_i, n_q) float32 | x, y (m), heading (rad, unwrapped), further states |
| `controls` | (sum of N_i, n_u) float32 | for the unicycle speed (m/s), turn rate (rad/s) |
| `costates` | (sum of N_i, n_q) float32 | lambda, the gradient of the cost-to-go |
| `lower_bounds` | (n,) float64 | proved lower bounds of the cost, NaN where none is known; only after `leapnav bank prove` |
| `shortest_lengths` | (n,) float64 | lengths (m) of the shortest paths, NaN where none is known; only after `leapnav bank shortest` |
| `shortest_times` | (n,) float64 | minimum times (s), likewise |

Attributes of the file: `format` ("leapnav-bank"), `version` (6), `family`, `seed`, `drawn` (number of scenarios drawn,
of which n were admitted), `rejected` (JSON: the number of rejected scenarios by reason), `software` (the version of
leapnav that built the bank), `given` (only of a bank of given scenarios; JSON: `scenarios`, their digest, and
`rejected` and `doubtful`, the reasons by name) and `checksums` (JSON: the BLAKE2b digest of each dataset, and under
`attributes` that of the other attributes).

A bank contains nothing in the form in which kernels read it: obstacle fields and tasks are made from the validated
scenarios. The optima are checked by `leapnav.envs.scenarios.banks.checks`.
"""  # noqa: E501 (tables)

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.banks.checks import (
    Reference,
    check_attributes,
    check_lengths,
    check_optimum,
    check_values,
)
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import OBSTACLE_KINDS
from leapnav.envs.utils.caching import computed_once
from leapnav.envs.utils.validation import check_choice, is_integer

FORMAT, VERSION = "leapnav-bank", 6
# Bytes. Larger texts and paths are verified when they are first read, because that takes 1 s per GB; the others on
# opening.
MAX_VERIFIED_ON_OPENING = 32_000_000
SPLITS = ("train", "test")
BANK_DIRECTORY = Path(__file__).parent / "banks"  # of the included banks
TYPES = {
    "scenarios": "u1",
    "scenario_ends": "<i8",
    "horizons": "<f8",
    "draws": "<i8",
    "costs": "<f8",
    "second_costs": "<f8",
    "certificates": "<f8",
    "path_ends": "<i8",
    "states": "<f4",
    "controls": "<f4",
    "costates": "<f4",
    "lower_bounds": "<f8",
    "shortest_lengths": "<f8",
    "shortest_times": "<f8",
}
ADDED = ("lower_bounds", "shortest_lengths", "shortest_times")  # datasets that not all banks have
GIVEN = "given"  # an attribute that not all banks have
_TABLES = ("certificates", "states", "controls", "costates")  # datasets with columns
_CONTENTS = {"scenario_ends": ("scenarios",), "path_ends": ("states", "controls", "costates")}
_DIVIDED = tuple(name for names in _CONTENTS.values() for name in names)  # datasets with several entries per scenario


class BankError(ValueError):
    """A file is not a scenario bank, is damaged, or has another format version. The message names file and fault."""


class ScenarioBank(Sequence[Scenario]):
    """A sequence of scenarios with their optima, see `reference`, read from a file on first access.

    Args:
        path: the file.

    Attributes:
        path: the file.
        family, seed: family and random seed of the scenarios.
        given: of a bank of given scenarios, `scenarios`, the digest of all of them, and the reasons by name why some
            were `rejected` or are `doubtful`, see `leapnav.experts.build_bank_of`; None if the scenarios are random.
        drawn: number of scenarios drawn or given, admitted or not.
        rejected: number of scenarios that were not admitted, by reason.
        software: version of leapnav that built the bank.
        costs (n,): optimal costs J*.
        second_costs (n,): costs of the second-best local optima found, NaN if there is none.
        certificates (n, 4): boundary residual, defect, drift of H, clearance (m).
        lower_bounds (n,): proved lower bounds of the cost, see `prove_bank` of
            `leapnav.experts.data.bank_bounds`; NaN where none is known.
        shortest_lengths, shortest_times (n,): lengths (m) of the shortest paths, and minimum times (s), without contact
            with obstacles, see `leapnav.experts.data.bank_shortest`; NaN where none is known.
        draws (n,): indices of the random draws that produced the scenarios.
        horizon: kind of the horizon of all scenarios, "fixed" or "free".
        obstacles: kind of the obstacles of all scenarios, "cost" or "hard", see `Cost.obstacles`.
        horizons (n,): durations of the optima (s).
        checksums: BLAKE2b digests of the datasets, and of the attributes.

    Raises:
        FileNotFoundError: there is no such file.
        BankError: the file is not a bank, is damaged, or has another format version. Scenarios and optima are checked
            when they are first read.

    """

    path: Path
    family: str
    software: str
    seed: int
    drawn: int
    rejected: dict[str, int]
    given: dict[str, Any] | None
    costs: np.ndarray
    second_costs: np.ndarray
    certificates: np.ndarray
    lower_bounds: np.ndarray
    shortest_lengths: np.ndarray
    shortest_times: np.ndarray
    draws: np.ndarray
    horizon: str
    obstacles: str
    horizons: np.ndarray

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()  # independent of the working directory, which differs between processes
        self._open()

    def _open(self) -> None:
        import h5py  # imported here because that takes longer than loading a bank, and not every program uses one

        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such bank")
        try:
            with h5py.File(self.path, "r") as file:
                attributes: dict[str, Any] = dict(file.attrs)
                if attributes.get("format") != FORMAT:
                    raise BankError(f"{self.path}: an HDF5 file, but not a scenario bank")
                if attributes.get("version") != VERSION:
                    raise BankError(
                        f"{self.path}: version {attributes.get('version')} of the format; this leapnav reads "
                        f"{VERSION}; build the bank again with `leapnav bank build`"
                    )
                locations = {name: _locate(file, name) for name in TYPES if name in file or name not in ADDED}
            rejected, checksums = json.loads(attributes["rejected"]), json.loads(attributes.pop("checksums"))
            given = json.loads(attributes[GIVEN]) if GIVEN in attributes else None
            content = np.asarray(np.memmap(self.path, dtype="u1", mode="r"))
            arrays = {
                name: content[start : start + size].view(TYPES[name]).reshape(shape)
                for name, (start, size, shape) in locations.items()
            }
            self.checksums: dict[str, str] = dict(checksums)
            self._verify("attributes", attribute_bytes(attributes))
            large = {name for name in _DIVIDED if arrays[name].nbytes > MAX_VERIFIED_ON_OPENING}
            for name in arrays.keys() - large:
                self._verify(name, arrays[name])
            check_lengths(arrays, _CONTENTS)
            check_attributes(attributes, rejected, given, len(arrays["costs"]))
            check_values(arrays, int(attributes["drawn"]))
        except BankError:
            raise
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            raise self._damaged(error) from None
        self._stored, self._verified = arrays, arrays.keys() - large
        self.family, self.software = attributes["family"], attributes["software"]
        self.seed, self.drawn = int(attributes["seed"]), int(attributes["drawn"])
        self.rejected, self.given = rejected, given
        self.costs, self.second_costs = arrays["costs"], arrays["second_costs"]
        self.certificates, self.draws = arrays["certificates"], arrays["draws"]
        self.horizons = arrays["horizons"]
        self.lower_bounds, self.shortest_lengths, self.shortest_times = (
            arrays.get(name, np.full(len(self.costs), math.nan)) for name in ADDED
        )
        self._scenarios: dict[int, Scenario] = {}
        self._checked: set[int] = set()  # scenarios whose optimum is checked
        self.horizon = self[0].horizon_kind if len(self) else "fixed"
        self.obstacles = self[0].cost.obstacles if len(self) else "cost"
        self._check_widths()

    @property
    def robot(self) -> RobotModel:
        """The robot of the first scenario, a unicycle in an empty bank."""
        return self[0].robot if len(self) else Unicycle()

    def _check_widths(self) -> None:
        """Raise BankError unless the numbers of columns are those of the robot."""
        n, m = self.robot.sizes()
        for name, width in {"states": n, "controls": m, "costates": n}.items():
            if (found := self._stored[name].shape[1]) != width:
                raise self._damaged(f"{name}: expected {width} columns, got {found}")

    def _damaged(self, fault: object) -> BankError:
        return BankError(f"{self.path}: not a scenario bank, or damaged: {' '.join(str(fault).split())}")

    def _verify(self, name: str, content: np.ndarray | bytes) -> None:
        """Compare the content of a dataset, or the attributes, with the stored checksum.

        Raises:
            BankError: they differ.

        """
        if digest(content) != self.checksums.get(name):
            raise BankError(f"{self.path}: damaged: the checksum of {name} differs; copy or build the bank again")

    def _array(self, name: str) -> np.ndarray:
        """Return a dataset, which is verified when it is first read."""
        if name not in self._verified:
            self._verify(name, self._stored[name])
            self._verified.add(name)
        return self._stored[name]

    def verify_checksums(self) -> None:
        """Verify all datasets, also the large ones that would be verified when they are first read.

        Raises:
            BankError: a dataset is damaged.

        """
        for name in self._stored:
            self._array(name)

    @classmethod
    def shipped_families(
        cls, robot: str = "unicycle", horizon: str = "fixed", obstacles: str = "cost", split: str = "test"
    ) -> list[str]:
        """Return the families of which banks for a robot and kinds of horizon and obstacles are in the package."""
        found = (path.name.removesuffix(f"-{split}.bank") for path in BANK_DIRECTORY.glob(f"*-{split}.bank"))
        prefix = collection_name("", robot, horizon, obstacles)
        return sorted(
            name.removeprefix(prefix)
            for name in found
            if name.startswith(prefix) and name.count("-") == prefix.count("-")
        )

    @classmethod
    def shipped(
        cls, family: str, split: str, robot: str = "unicycle", horizon: str = "fixed", obstacles: str = "cost"
    ) -> ScenarioBank:
        """Return a bank included in the package; repeated calls return the same object.

        Args:
            family: one of `leapnav.envs.FAMILIES`.
            split: "train" or "test".
            robot: model of the robot.
            horizon: "fixed" or "free".
            obstacles: "cost" or "hard".

        Raises:
            ValueError: there is no such bank.

        """
        check_choice("split", split, SPLITS)
        check_choice("obstacles", obstacles, OBSTACLE_KINDS)
        known = cls.shipped_families(robot, horizon, obstacles, split)
        if not known:
            raise ValueError(
                f"robot: expected one with included banks (horizon {horizon!r}, obstacles {obstacles!r}), got "
                f"{robot!r}; build a bank of its scenarios with leapnav bank build, and pass it as bank"
            )
        if family not in known:
            raise ValueError(
                f"family: expected one of {', '.join(known)}, of which banks are included, got {family!r}; build a "
                "bank of another family with leapnav bank build, and pass it as bank"
            )
        return _shipped(collection_name(family, robot, horizon, obstacles), split)

    def __len__(self) -> int:
        return len(self.costs)

    @overload
    def __getitem__(self, index: int) -> Scenario: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scenario]: ...
    def __getitem__(self, index: int | slice) -> Scenario | list[Scenario]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = self._check_index(index)
        if i not in self._scenarios:
            start, end = self._span("scenario_ends", i)
            try:
                scenario = Scenario.from_json(self._array("scenarios")[start:end].tobytes().decode())
                self._check_scenario(i, scenario)
            except BankError:
                raise
            except (ValueError, OSError) as error:  # the encoding or the scenario is invalid
                raise self._damaged(f"scenario {i}: {error}") from None
            self._scenarios.setdefault(i, scenario)  # threads get the same object
        return self._scenarios[i]

    def _check_scenario(self, i: int, scenario: Scenario) -> None:
        """Raise ValueError unless a scenario fits the bank, and can be a task of an environment."""
        _ = scenario.task  # refuses costs that an environment cannot have
        first = self[0] if i else scenario
        for name, found, expected in (
            ("robot.model", scenario.robot.model, first.robot.model),
            ("horizon", scenario.horizon_kind, first.horizon_kind),
            ("obstacles", scenario.cost.obstacles, first.cost.obstacles),
            ("horizon", scenario.horizon or float(self.horizons[i]), float(self.horizons[i])),
        ):
            if found != expected:
                raise ValueError(f"{name}: expected that of the bank, {expected!r}, got {found!r}")

    def __iter__(self) -> Iterator[Scenario]:
        return (self[i] for i in range(len(self)))

    def reference(self, index: int) -> Reference:
        """Return the optimum of a scenario.

        Raises:
            IndexError: the index is out of range.
            BankError: scenario or optimum are damaged, or do not fit each other.

        """
        i = self._check_index(index)
        start, end = self._span("path_ends", i)
        second, bound = float(self.second_costs[i]), float(self.lower_bounds[i])
        residual, defect, drift, clearance = self.certificates[i].tolist()
        reference = Reference(
            cost=float(self.costs[i]),
            second_cost=None if math.isnan(second) else second,
            certificate=(residual, defect, drift, clearance),
            times=np.linspace(0.0, float(self.horizons[i]), end - start),
            states=self._array("states")[start:end],
            controls=self._array("controls")[start:end],
            costates=self._array("costates")[start:end],
            lower_bound=None if math.isnan(bound) else bound,
        )
        if i not in self._checked:
            scenario = self[i]
            try:
                check_optimum(scenario, reference)
            except ValueError as error:
                raise self._damaged(f"scenario {i}: {error}") from None
            self._checked.add(i)
        return reference

    def states(self, index: int) -> np.ndarray:
        """Return the states (N, n_q) of the optimum of a scenario, see `reference`."""
        return self.reference(index).states

    def _check_index(self, index: int) -> int:
        """Return the index counted from the start."""
        if not is_integer(index):
            raise TypeError(f"index: expected an integer, got {index!r}")
        i = int(index) + len(self) if index < 0 else int(index)
        if not 0 <= i < len(self):
            raise IndexError(f"index: {self.path.name} has {len(self)} scenarios, got {index}")
        return i

    def _span(self, ends: str, i: int) -> tuple[int, int]:
        """Return start and end of the i-th entry of a concatenated dataset."""
        return (0 if i == 0 else int(self._array(ends)[i - 1])), int(self._array(ends)[i])

    def __repr__(self) -> str:
        return f"ScenarioBank({str(self.path)!r}, {len(self)} scenarios of {self.family})"

    def __getstate__(self) -> dict[str, Any]:
        # The file is mapped again when unpickled.
        return {"path": self.path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path = state["path"]
        self._open()


def collection_name(family: str, robot: str = "unicycle", horizon: str = "fixed", obstacles: str = "cost") -> str:
    """Return the name of the scenarios of a family for a robot and kinds of horizon and obstacles, "car-hard-clutter".

    The unicycle, a fixed horizon and obstacles with a proximity cost are not named. Other characters than letters,
    digits and underscores in the name of the family become underscores.
    """
    name = re.sub(r"[^A-Za-z0-9_]", "_", family)
    kinds = (robot, "unicycle"), (horizon, "fixed"), (obstacles, "cost")
    return "-".join([*(kind for kind, default in kinds if kind != default), name])


@computed_once()
def _shipped(name: str, split: str) -> ScenarioBank:
    return ScenarioBank(BANK_DIRECTORY / f"{name}-{split}.bank")


def digest(content: np.ndarray | bytes) -> str:
    """Return the BLAKE2b digest (16 bytes) of the bytes of an array."""
    data = content if isinstance(content, bytes) else np.ascontiguousarray(content).reshape(-1).view("u1").data
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def attribute_bytes(attributes: Mapping[str, Any]) -> bytes:
    """Return the attributes of a file, except the checksums, in a form that does not depend on their types in HDF5."""
    return json.dumps({name: str(value) for name, value in sorted(attributes.items())}).encode()


def _locate(file: Any, name: str) -> tuple[int, int, tuple[int, ...]]:
    """Return the first byte of a dataset in the file, its number of bytes, and its shape.

    Raises:
        ValueError: there is no such dataset, or it is not stored as the format requires.

    """
    import h5py

    is_here = isinstance(file.get(name, getlink=True), h5py.HardLink)  # other links can lead to other files
    dataset = file[name] if is_here else None
    if (
        not isinstance(dataset, h5py.Dataset)
        or dataset.dtype != np.dtype(TYPES[name])
        or dataset.chunks is not None
        or len(dataset.shape) != (2 if name in _TABLES else 1)
    ):
        raise ValueError(f"{name}: type or layout differs from the format")
    size, start = math.prod(dataset.shape) * dataset.dtype.itemsize, dataset.id.get_offset()
    if size == 0:  # such a dataset has no offset
        return 0, 0, dataset.shape
    if start is None or start % dataset.dtype.itemsize:
        raise ValueError(f"{name}: not stored in one aligned block of this file")
    return start, size, dataset.shape
