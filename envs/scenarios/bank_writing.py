"""Writing of scenario banks, see `leapnav.envs.scenarios.bank` for the format."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leapnav.envs.robots import Unicycle
from leapnav.envs.scenarios.bank import (
    FORMAT,
    GIVEN,
    TYPES,
    VERSION,
    attribute_bytes,
    digest,
)
from leapnav.envs.scenarios.banks.checks import count_points
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.files import atomic_path


@dataclass(frozen=True, eq=False)
class BankEntry:
    """The data of one scenario in a bank.

    Attributes:
        scenario: the scenario as JSON text.
        draw: index of the random draw that produced it.
        cost, second_cost, certificate, states, controls, costates: see `Reference`.
        horizon: duration of the optimum (s) if the horizon is free, otherwise None.

    """

    scenario: str
    draw: int
    cost: float
    second_cost: float | None
    certificate: tuple[float, float, float, float]
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    horizon: float | None = None


def point_times(horizon: float) -> np.ndarray:
    """Return the times (N,) at which a bank stores the points of an optimum (s)."""
    return np.linspace(0.0, horizon, int(count_points(np.array(horizon))))


def write_bank(
    path: str | os.PathLike[str],
    entries: Sequence[BankEntry],
    *,
    family: str,
    seed: int,
    drawn: int,
    rejected: Mapping[str, int],
    software: str,
    given: Mapping[str, Any] | None = None,
) -> None:
    """Write a bank atomically; the same arguments give the same bytes.

    Args:
        path: the file.
        entries: the scenarios with their optima.
        family, seed, drawn, rejected, software, given: see `ScenarioBank`.

    Raises:
        ValueError: the scenarios have different robot models, kinds of horizon or kinds of obstacles.

    """
    import h5py

    texts = [entry.scenario.encode() for entry in entries]
    scenarios = [Scenario.from_json(entry.scenario) for entry in entries]
    for name, values in (
        ("robot model", {scenario.robot.model for scenario in scenarios}),
        ("kind of horizon", {scenario.horizon_kind for scenario in scenarios}),
        ("kind of obstacles", {scenario.cost.obstacles for scenario in scenarios}),
    ):
        if len(values) > 1:
            raise ValueError(f"entries: expected one {name} for all scenarios, got {', '.join(sorted(values))}")
    n, m = type(scenarios[0].robot).sizes() if scenarios else Unicycle.sizes()
    columns: dict[str, Any] = {
        "scenarios": np.frombuffer(b"".join(texts), dtype="u1"),
        "scenario_ends": np.cumsum([len(text) for text in texts]),
        "horizons": [
            entry.horizon if scenario.horizon is None else scenario.horizon
            for entry, scenario in zip(entries, scenarios, strict=True)
        ],
        "draws": [entry.draw for entry in entries],
        "costs": [entry.cost for entry in entries],
        "second_costs": [math.nan if entry.second_cost is None else entry.second_cost for entry in entries],
        "certificates": np.array([entry.certificate for entry in entries]).reshape(-1, 4),
        "path_ends": np.cumsum([len(entry.states) for entry in entries]),
        "states": np.concatenate([np.empty((0, n)), *(entry.states for entry in entries)]),
        "controls": np.concatenate([np.empty((0, m)), *(entry.controls for entry in entries)]),
        "costates": np.concatenate([np.empty((0, n)), *(entry.costates for entry in entries)]),
    }
    arrays = {name: np.asarray(values, dtype=TYPES[name]) for name, values in columns.items()}
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        "family": family,
        "seed": seed,
        "drawn": drawn,
        "rejected": json.dumps(dict(sorted(rejected.items()))),
        "software": software,
        **({} if given is None else {GIVEN: json.dumps(given, sort_keys=True)}),
    }
    checksums = {name: digest(array) for name, array in arrays.items()}
    # Alignment in the file makes the memory-mapped arrays aligned.
    with (
        atomic_path(path) as partial,
        h5py.File(partial, "w", alignment_threshold=1, alignment_interval=64) as file,
    ):
        for name, value in attributes.items():
            file.attrs[name] = value
        file.attrs["checksums"] = json.dumps({**checksums, "attributes": digest(attribute_bytes(attributes))})
        for name, array in arrays.items():
            file.create_dataset(name, data=array)


def add_datasets(path: str | os.PathLike[str], **arrays: np.ndarray) -> None:
    """Add datasets of `ADDED` to a bank, or replace them, atomically.

    Args:
        path: the file of the bank, or a link to it.
        arrays: a number (n,) for each scenario, by the name of the dataset, see `ScenarioBank`.

    Raises:
        ValueError: the number of values is not that of the scenarios.
        OSError: the file cannot be written.

    """
    import h5py

    target = Path(path).resolve()
    if not os.access(target, os.W_OK):
        raise PermissionError(f"{target}: cannot be written")
    with atomic_path(target) as partial:
        shutil.copy(target, partial)
        with h5py.File(partial, "r+", alignment_threshold=1, alignment_interval=64) as file:
            costs: Any = file["costs"]
            count = len(costs)
            checksums = json.loads(str(file.attrs["checksums"]))
            for name, values in arrays.items():
                if values.shape != (count,):
                    raise ValueError(f"{name}: expected the shape ({count},), got {values.shape}")
                array = values.astype(TYPES[name])
                if name in file:
                    del file[name]
                file.create_dataset(name, data=array)
                checksums[name] = digest(array)
            file.attrs["checksums"] = json.dumps(checksums)
