"""Building of scenario banks: random scenarios with certified optima, in parallel and resumable."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel

import leapnav
from leapnav.envs.robots import RobotModel, Unicycle
from leapnav.envs.scenarios.bank import VERSION, BankError, ScenarioBank
from leapnav.envs.scenarios.bank_writing import BankEntry, point_times, write_bank
from leapnav.envs.scenarios.families import ALL, CustomFamily, collection_name, find_family, sample_scenario
from leapnav.envs.scenarios.scenario import TIME_LIMIT_FACTOR, check_robot
from leapnav.envs.settings import HORIZONS
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_at_least, check_choice
from leapnav.experts.data.store import ONE, Arrays, ResumableStore, discard
from leapnav.experts.optimum import Optimum, find_optimum
from leapnav.experts.problem.extremal import Status


class Rejection(Enum):
    """Why a scenario is not admitted to a bank. The values are part of the bank files."""

    NO_OPTIMUM = "no certified optimum"
    COLLISION = "a cheaper extremal touches"
    UNRESOLVED = "a cheaper solution was not certified"


def judge(optimum: Optimum) -> Rejection | None:
    """The reason why an optimum is no safe reference, None if it is safe.

    A safe reference is certified, hence without collision and without a conjugate point, and the search found no
    cheaper solution that lacks a certificate. If a cheaper extremal cuts slightly into an obstacle, the true optimum
    may be a path in contact with that obstacle.
    """
    if not optimum.success:
        return Rejection.NO_OPTIMUM
    if any(doubt.status is Status.COLLISION for doubt in optimum.doubts):
        return Rejection.COLLISION
    return Rejection.UNRESOLVED if optimum.doubts else None


def build_bank(
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
    seed: int = 0,
    workers: int = 1,
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
        robot: name of a robot model, a dict of its fields with `model`, or a robot.
        horizon: "fixed" or "free", see `sample_scenario`. The time limit of a scenario with a free horizon is 3 times
            the duration of its optimum.
        seed: seed of the bank; draw k uses a generator with the seed (seed, k).
        workers: number of processes.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is invalid.
        BankError: `out` is another bank, or its build directory belongs to another build, is damaged or is in use.
        OSError: `out` cannot be written.

    """
    if family == ALL:
        raise ValueError(f"family: expected one family, got {family!r}")
    chosen = find_family(family)
    body = check_robot(robot)
    check_choice("horizon", horizon, HORIZONS)
    check_at_least("count", count, 1)
    check_at_least("workers", workers, 1)
    check_at_least("seed", seed, 0)
    target = Path(out)
    if target.is_dir():
        raise IsADirectoryError(f"{target}: is a directory")
    if target.exists():
        return _complete(target, family, count, seed, body, horizon)
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"{target.parent}: no such directory")
    settings = {"version": VERSION, "software": leapnav.__version__, "family": family, "seed": seed}
    if body != Unicycle():  # as before there were other robots
        settings["robot"] = body.model_dump(mode="json", exclude_none=True)
    if horizon != "fixed":
        settings["horizon"] = horizon
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=ONE, pre_dispatch="4 * n_jobs")
    with ResumableStore(_build_directory(target), "bank", settings, BankError) as store:
        compute = partial(draw, family=chosen, seed=seed, robot=body, horizon=horizon)
        reasons = _solve(store, pool, compute, count, progress)
        entries = [_entry(number, store.read(number)) for number, reason in reasons.items() if not reason]
        write_bank(
            target,
            entries,
            family=family,
            seed=seed,
            drawn=len(reasons),
            rejected=Counter(reason for reason in reasons.values() if reason),
            software=leapnav.__version__,
        )
    discard(store.directory)
    return ScenarioBank(target)


def draw(
    number: int, family: str | CustomFamily, seed: int, robot: RobotModel | None = None, horizon: str = "fixed"
) -> Arrays:
    """One random scenario with its optimum, as arrays of a shard; "rejected" is empty if it is admitted.

    Args:
        number: index of the draw.
        family: family of the scenario.
        seed: seed of the bank.
        robot: the robot; None for the unicycle.
        horizon: "fixed" or "free".

    """
    body = robot or Unicycle()
    scenario = sample_scenario(family, np.random.default_rng([seed, number]), body, horizon)
    name = collection_name(family if isinstance(family, str) else family.name, body.model, horizon)
    scenario = scenario.model_copy(update={"name": f"{name}-{seed}-{number}"})
    optimum = find_optimum(scenario)
    rejection = judge(optimum)
    if rejection is not None:
        return {"rejected": np.array(rejection.value)}
    certificate = optimum.certificate
    assert certificate is not None
    duration = optimum.horizon
    if scenario.horizon is None:
        scenario = scenario.model_copy(update={"time_limit": round(TIME_LIMIT_FACTOR * duration, 1)})
    states, controls, costates = (values.astype("<f4") for values in optimum.evaluate(point_times(duration)))
    return {
        "rejected": np.array(""),
        "scenario": np.frombuffer(scenario.to_json().encode(), dtype="u1"),
        **({"horizon": np.array(duration)} if scenario.horizon is None else {}),
        "cost": np.array(optimum.cost),
        "second_cost": np.array(optimum.alternatives[0].cost if optimum.alternatives else math.nan),
        "certificate": np.array(
            [certificate.residual, certificate.defect, certificate.hamiltonian_drift, certificate.clearance]
        ),
        "states": states,
        "controls": controls,
        "costates": costates,
    }


def _solve(
    store: ResumableStore, pool: Parallel, compute: Callable[[int], Arrays], count: int, progress: bool
) -> dict[int, str]:
    """Complete the draws until `count` scenarios are admitted; return each draw's reason of rejection, in order."""
    reasons: dict[int, str] = {}
    n_admitted = 0
    with progress_bar(total=count, label="Building the bank", unit="scenarios", show=progress) as bar:
        while n_admitted < count:
            # One draw for each missing scenario, so that the bank holds the first `count` admitted scenarios.
            numbers = range(len(reasons), len(reasons) + count - n_admitted)
            for number, arrays in store.complete(numbers, compute, pool, bar):
                reasons[number] = str(arrays["rejected"])
                advance(bar, not reasons[number])
            n_admitted = sum(not reason for reason in reasons.values())
    return dict(sorted(reasons.items()))


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


def _complete(target: Path, family: str, count: int, seed: int, robot: RobotModel, horizon: str) -> ScenarioBank:
    """The bank at `target`, if it is the requested one."""
    bank = ScenarioBank(target)
    expected: dict[str, Any] = {"family": family, "seed": seed, "count": count, "software": leapnav.__version__}
    found: dict[str, Any] = {"family": bank.family, "seed": bank.seed, "count": len(bank), "software": bank.software}
    expected["robot"], found["robot"] = robot, bank.robot
    expected["horizon"], found["horizon"] = horizon, bank.horizon
    for name, value in expected.items():
        if found[name] != value:
            raise BankError(f"{target}: exists, with {name} {found[name]!r} instead of {value!r}; choose another name")
    discard(_build_directory(target))  # left by a build that was interrupted after it had written the bank
    return bank


def _build_directory(target: Path) -> Path:
    return target.with_name(f"{target.name}.build")
