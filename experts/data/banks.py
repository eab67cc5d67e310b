"""Building of scenario banks: scenarios with certified optima, in parallel and resumable."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from joblib import Parallel

import leapnav
from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.bank import VERSION, BankError, ScenarioBank, collection_name, digest
from leapnav.envs.scenarios.bank_writing import BankEntry, point_times, write_bank
from leapnav.envs.scenarios.families import ALL, CustomFamily, find_family, sample_scenario, task_of
from leapnav.envs.scenarios.files import PathLike, check_collection, read_scenarios
from leapnav.envs.scenarios.scenario import TIME_LIMIT_FACTOR, Scenario
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.data.store import Arrays, Job, ResumableStore, discard
from leapnav.experts.optimum import Optimum, find_optimum
from leapnav.experts.pools import process_pool


class Rejection(Enum):
    """Why a scenario is not admitted to a bank. The values are part of the bank files."""

    NO_OPTIMUM = "no certified optimum"
    UNRESOLVED = "a cheaper solution was not certified"


def judge(optimum: Optimum) -> Rejection | None:
    """The reason why an optimum is no safe reference, None if it is safe.

    A safe reference is certified, hence without collision and without a conjugate point, and the search found no
    cheaper solution that lacks a certificate.
    """
    if not optimum.success:
        return Rejection.NO_OPTIMUM
    return Rejection.UNRESOLVED if optimum.doubts else None


@dataclass(frozen=True)
class Result:
    """What is known of a solved scenario: why it is rejected, and why its optimum is doubtful; empty texts if not."""

    rejected: str
    doubt: str


class ScenarioDraws(Protocol):
    """The scenarios that a bank is built from, by number."""

    @property
    def available(self) -> int | None:
        """The number of scenarios; None without a limit."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """JSON values that determine the scenarios, among them `family` and `seed` of the bank."""
        ...

    def job(self, number: int) -> Job:
        """Return the function that solves a scenario, see `solve_for_bank`."""
        ...

    def describe(self, results: Mapping[int, Result]) -> dict[str, Any] | None:
        """Return the attribute `given` of the bank."""
        ...


@dataclass(frozen=True)
class RandomDraws:
    """Random scenarios of a family; draw k uses a generator with the seed (seed, k)."""

    family: str | CustomFamily
    seed: int
    robot: RobotModel
    horizon: str
    obstacles: str = "cost"
    available: int | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """See `ScenarioDraws`."""
        name = self.family if isinstance(self.family, str) else self.family.name
        # Without the defaults, as before there were other robots.
        robot = {} if self.robot == Unicycle() else {"robot": self.robot.model_dump(mode="json", exclude_none=True)}
        horizon = {} if self.horizon == "fixed" else {"horizon": self.horizon}
        obstacles = {} if self.obstacles == "cost" else {"obstacles": self.obstacles}
        return {"family": name, "seed": self.seed, **robot, **horizon, **obstacles}

    def job(self, number: int) -> Job:
        """See `ScenarioDraws`."""
        return partial(draw, number, self.family, self.seed, self.robot, self.horizon, self.obstacles)

    def describe(self, results: Mapping[int, Result]) -> None:
        """See `ScenarioDraws`."""


@dataclass(frozen=True)
class GivenScenarios:
    """Scenarios of one's own, under a name."""

    name: str
    scenarios: tuple[Scenario, ...]
    doubtful: bool = False
    origin: str = ""
    licence: str = ""

    @property
    def available(self) -> int:
        """See `ScenarioDraws`."""
        return len(self.scenarios)

    @property
    def settings(self) -> dict[str, Any]:
        """See `ScenarioDraws`."""
        texts = "\n".join(scenario.to_json() for scenario in self.scenarios)
        doubtful = {"doubtful": True} if self.doubtful else {}
        return {"family": self.name, "seed": 0, "scenarios": digest(texts.encode()), **doubtful}

    def job(self, number: int) -> Job:
        """See `ScenarioDraws`."""
        return partial(solve_for_bank, self.scenarios[number], self.doubtful)

    def describe(self, results: Mapping[int, Result]) -> dict[str, Any]:
        """See `ScenarioDraws`."""
        named = {self.scenarios[number].name: result for number, result in results.items()}
        rejected = {name: result.rejected for name, result in named.items() if result.rejected}
        found = {"scenarios": self.settings["scenarios"], "rejected": rejected}
        if self.doubtful:
            found["doubtful"] = {name: result.doubt for name, result in named.items() if result.doubt}
        return {**found, "origin": self.origin, "licence": self.licence}


def build_bank(
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    robot: RobotModel | Mapping[str, Any] | str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
) -> ScenarioBank:
    """Draw random scenarios, find their optima, and write the admitted ones to a bank.

    The result of each finished scenario is stored in the directory `<out>.build`. A build resumes after any
    interruption, including SIGKILL, when it is called again with the same arguments. The bank is bitwise
    identical regardless of interruptions and of the number of workers.

    Args:
        family: family of the scenarios.
        count: number of scenarios in the bank.
        out: file of the bank. A complete bank is returned unchanged.
        robot: name of a robot model, a dict of its fields with `model`, or a robot; robot, horizon and obstacles that
            are not given are as in `rollout`.
        horizon: "fixed" or "free", see `sample_scenario`. The time limit of a scenario with a free horizon is 3 times
            the duration of its optimum.
        obstacles: "cost" or "hard", see `sample_scenario`.
        seed: seed of the bank; draw k uses a generator with the seed (seed, k).
        workers: number of processes.
        dask: address of a Dask scheduler (`tcp://host:8786`) whose workers are used instead of local processes; they
            need leapnav, but no access to `out`.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is invalid.
        BankError: `out` is another bank, or its build directory belongs to another build, is damaged or is in use.
        OSError: `out` cannot be written, or the scheduler cannot be reached; finished scenarios are kept.
        ModuleNotFoundError: `dask` is given, and the extra `cluster` is not installed.

    """
    if family == ALL:
        raise ValueError(f"family: expected one family, got {family!r}")
    chosen = find_family(family)
    body, horizon, obstacles = task_of(chosen, robot, horizon, obstacles)
    check_at_least("count", count, 1)
    check_at_least("seed", seed, 0)
    draws = RandomDraws(chosen, seed, body, horizon, obstacles)
    task = {"robot": body, "horizon": horizon, "obstacles": obstacles}
    expected = {"family": family, "seed": seed, "count": count, **task}
    return _build(draws, count, Path(out), expected, workers=workers, dask=dask, progress=progress)


def build_bank_of(
    scenarios: PathLike | Sequence[Scenario | PathLike],
    out: str | os.PathLike[str],
    *,
    doubtful: bool = False,
    origin: str = "",
    licence: str = "",
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
) -> ScenarioBank:
    """Find the optima of given scenarios, and write the admitted ones to a bank.

    The name of the file, without its ending, is the `family` of the bank; its `rejected_scenarios` are the names of the
    scenarios that were not admitted, with the reasons. Interruptions and the number of workers do not change the bank,
    see `build_bank`.

    Args:
        scenarios: scenarios with the same robot model and kinds of horizon and obstacles; or their files, see
            `read_scenarios`.
        out: file of the bank. A complete bank of these scenarios is returned unchanged.
        doubtful: also admit scenarios with a certified optimum for which the search found a cheaper solution that
            touches an obstacle or was not certified; the `doubtful` of `bank.given` are their names, with the reasons.
        origin, licence: where the scenarios come from and their licence, for the data card.
        workers, dask, progress: see `build_bank`.

    Raises:
        ScenarioError: a scenario is invalid, or cannot be in a bank; two have the same name.
        ValueError, BankError, OSError, ModuleNotFoundError: see `build_bank`.

    """
    target = Path(out)
    given = [scenarios] if isinstance(scenarios, (str, os.PathLike)) else list(scenarios)
    files = [one for one in given if not isinstance(one, Scenario)]
    found = [one for one in given if isinstance(one, Scenario)] + (read_scenarios(files) if files else [])
    check_collection(found)
    draws = GivenScenarios(target.stem, tuple(found), doubtful, origin, licence)
    expected = {"family": draws.name, "scenarios": draws.settings["scenarios"], "doubtful": doubtful}
    return _build(draws, len(found), target, expected, workers=workers, dask=dask, progress=progress)


def _build(
    draws: ScenarioDraws,
    count: int,
    target: Path,
    expected: Mapping[str, Any],
    *,
    workers: int,
    dask: str | None,
    progress: bool,
) -> ScenarioBank:
    """Build a bank of up to `count` scenarios, unless the expected one is complete."""
    check_at_least("workers", workers, 1)
    if target.is_dir():
        raise IsADirectoryError(f"{target}: is a directory")
    if target.exists():
        return _complete(target, expected)
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"{target.parent}: no such directory")
    settings = {"version": VERSION, "software": leapnav.__version__, **draws.settings}
    with (
        ResumableStore(_build_directory(target), "bank", settings, BankError) as store,
        process_pool(workers, dask) as pool,
    ):
        results = _solve(store, pool, draws, count, progress)
        entries = [_entry(number, store.read(number)) for number, result in results.items() if not result.rejected]
        write_bank(
            target,
            entries,
            family=settings["family"],
            seed=settings["seed"],
            drawn=len(results),
            rejected=Counter(result.rejected for result in results.values() if result.rejected),
            software=leapnav.__version__,
            given=draws.describe(results),
        )
    discard(store.directory)
    return ScenarioBank(target)


def draw(
    number: int,
    family: str | CustomFamily,
    seed: int,
    robot: RobotModel | None = None,
    horizon: str = "fixed",
    obstacles: str = "cost",
) -> Arrays:
    """One random scenario with its optimum, see `solve_for_bank`.

    Args:
        number: index of the draw.
        family: family of the scenario.
        seed: seed of the bank.
        robot: the robot; None for the unicycle.
        horizon: "fixed" or "free".
        obstacles: "cost" or "hard".

    """
    body = robot or Unicycle()
    scenario = sample_scenario(family, np.random.default_rng([seed, number]), body, horizon, obstacles)
    name = collection_name(family if isinstance(family, str) else family.name, body.model, horizon, obstacles)
    return solve_for_bank(scenario.model_copy(update={"name": f"{name}-{seed}-{number}", "time_limit": None}))


def solve_for_bank(scenario: Scenario, doubtful: bool = False) -> Arrays:
    """A scenario with its optimum, as arrays of a shard; "rejected" is empty if it is admitted.

    A doubtful optimum is admitted only on request, with the reason in "doubt". The time limit of a scenario with a free
    horizon and without a limit is 3 times the duration of its optimum.
    """
    optimum = find_optimum(scenario)
    rejection = judge(optimum)
    if rejection is not None and not (doubtful and optimum.success):
        return {"rejected": np.array(rejection.value)}
    certificate = optimum.certificate
    assert certificate is not None
    duration = optimum.horizon
    if scenario.horizon is None and scenario.time_limit is None:
        scenario = scenario.model_copy(update={"time_limit": round(TIME_LIMIT_FACTOR * duration, 1)})
    n = len(scenario.robot.state_names)  # the optimum has the time as a further state if obstacles move
    states, controls, costates = (values.astype("<f4") for values in optimum.evaluate(point_times(duration)))
    return {
        "rejected": np.array(""),
        **({} if rejection is None else {"doubt": np.array(rejection.value)}),
        "scenario": np.frombuffer(scenario.to_json().encode(), dtype="u1"),
        **({"horizon": np.array(duration)} if scenario.horizon is None else {}),
        "cost": np.array(optimum.cost),
        "second_cost": np.array(optimum.alternatives[0].cost if optimum.alternatives else math.nan),
        "certificate": np.array(
            [certificate.residual, certificate.defect, certificate.hamiltonian_drift, certificate.clearance]
        ),
        "states": states[:, :n],
        "controls": controls,
        "costates": costates[:, :n],
    }


def _solve(
    store: ResumableStore, pool: Parallel, draws: ScenarioDraws, count: int, progress: bool
) -> dict[int, Result]:
    """Solve scenarios until `count` are admitted or none is left; return the results in order."""
    results: dict[int, Result] = {}
    n_admitted, available = 0, math.inf if draws.available is None else draws.available
    with progress_bar(total=count, label="Building the bank", unit="scenarios", show=progress) as bar:
        while n_admitted < count and len(results) < available:
            # One for each missing scenario, so that the bank holds the first `count` admitted scenarios.
            numbers = range(len(results), len(results) + count - n_admitted)
            for number, arrays in store.complete(numbers, draws.job, pool, bar):
                results[number] = Result(str(arrays["rejected"]), str(arrays.get("doubt", "")))
                advance(bar, not results[number].rejected)
            n_admitted = sum(not result.rejected for result in results.values())
    return dict(sorted(results.items()))


def _entry(number: int, arrays: Arrays) -> BankEntry:
    residual, defect, drift, clearance = arrays["certificate"].tolist()
    second_cost = float(arrays["second_cost"])
    return BankEntry(
        scenario=arrays["scenario"].tobytes().decode(),
        draw=number,
        cost=float(arrays["cost"]),
        second_cost=None if math.isnan(second_cost) else second_cost,
        certificate=(residual, defect, drift, clearance),
        states=arrays["states"],
        controls=arrays["controls"],
        costates=arrays["costates"],
        horizon=float(arrays["horizon"]) if "horizon" in arrays else None,
    )


def _complete(target: Path, expected: Mapping[str, Any]) -> ScenarioBank:
    """The bank at `target`, if it is the requested one."""
    bank = ScenarioBank(target)
    found = {
        "family": bank.family,
        "seed": bank.seed,
        "count": len(bank),
        "robot": bank.robot,
        "horizon": bank.horizon,
        "obstacles": bank.obstacles,
        "scenarios": (bank.given or {}).get("scenarios"),
        "doubtful": "doubtful" in (bank.given or {}),
        "software": bank.software,
    }
    for name, value in {"scenarios": None, "doubtful": False, **expected, "software": leapnav.__version__}.items():
        if found[name] != value:
            raise BankError(f"{target}: exists, with {name} {found[name]!r} instead of {value!r}; choose another name")
    discard(_build_directory(target))  # left by a build that was interrupted after it had written the bank
    return bank


def _build_directory(target: Path) -> Path:
    return target.with_name(f"{target.name}.build")
