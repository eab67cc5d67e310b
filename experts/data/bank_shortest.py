"""Shortest paths and minimum times of the scenarios of a bank, the denominators of SPL and SCT."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import leapnav
from leapnav.envs.scenarios.bank import BankError, ScenarioBank
from leapnav.envs.scenarios.bank_writing import add_datasets
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.data.bank_bounds import bank_digest, open_bank
from leapnav.experts.data.store import Arrays, ResumableStore, discard
from leapnav.experts.minimum_length import minimum_length
from leapnav.experts.minimum_time import minimum_time
from leapnav.experts.pools import process_pool
from leapnav.experts.problem.extremal import SolveError

TOLERANCE = 0.01  # of the minimum times


@dataclass(frozen=True)
class Shortest:
    """The result of `find_shortest` for one scenario; NaN where no path was found.

    Attributes:
        index, name: the scenario.
        length: length (m) of the shortest path.
        time: minimum time (s).

    """

    index: int
    name: str
    length: float
    time: float


def find_shortest(path: str | os.PathLike[str], *, workers: int = 1, progress: bool = True) -> list[Shortest]:
    """Find the shortest path and the minimum time of each scenario of a bank, and store their values in the bank.

    Both are those of the robot with its footprint and its limits among obstacles that must not be touched, from the
    start to the goal of the scenario, whatever its horizon. They are the denominators of the success weighted by path
    length and by completion time. The results of finished scenarios are in the directory `<path>.shortest` until the
    bank is written. After any interruption, including SIGKILL, the same call resumes.

    Args:
        path: the file of the bank.
        workers: number of processes.
        progress: show a progress bar.

    Raises:
        ValueError: `workers` is below 1.
        BankError: the file is no bank, or the directory belongs to another bank, is damaged or is in use.
        OSError: the bank cannot be written.

    """
    check_at_least("workers", workers, 1)
    path = Path(path).resolve()
    bank = ScenarioBank(path)
    identity = bank_digest(bank)
    if not os.access(path, os.W_OK):  # before hours of work
        raise PermissionError(f"{path}: cannot be written")
    settings = {"software": leapnav.__version__, "bank": identity, "tolerance": TOLERANCE}
    found = []
    with (
        ResumableStore(path.with_name(f"{path.name}.shortest"), "shortest-paths", settings, BankError) as store,
        process_pool(workers, pre_dispatch="2 * n_jobs") as pool,
        progress_bar(total=len(bank), label="Searching", unit="scenarios", show=progress) as bar,
    ):
        jobs = store.complete(range(len(bank)), lambda index: partial(_search, path, identity, index), pool, bar)
        for index, arrays in jobs:
            found.append(Shortest(index, bank[index].name, *arrays["numbers"].tolist()))
            advance(bar, True)
        found.sort(key=lambda one: one.index)
        open_bank(path, identity)
        add_datasets(path, **_columns(found))
    discard(store.directory)
    return found


def _columns(found: Sequence[Shortest]) -> dict[str, np.ndarray]:
    return {
        "shortest_lengths": np.array([one.length for one in found]),
        "shortest_times": np.array([one.time for one in found]),
    }


def _search(path: Path, identity: str, index: int) -> Arrays:
    return {"numbers": np.array(shortest(open_bank(path, identity)[index]))}


def shortest(scenario: Scenario) -> tuple[float, float]:
    """Return the length (m) of the shortest path and the minimum time (s) of a scenario without contact; NaN if none.

    A path of minimum time may be shorter than the shortest one that was found, and is then used for both.
    """
    cost = scenario.cost.model_copy(update={"proximity_weight": 0.0, "time_weight": 1.0})
    free = scenario.model_copy(update={"horizon": None, "time_limit": None, "cost": cost})
    length = time = math.nan
    with suppress(SolveError):
        fastest = minimum_time(free, TOLERANCE)
        time = fastest.horizon
        steps = np.diff(fastest.extremal.evaluate(np.linspace(0.0, time, 2001))[0][:, :2], axis=0)
        length = float(np.hypot(*steps.T).sum())
    with suppress(SolveError):
        length = float(np.fmin(length, minimum_length(free).length))
    return length, time
