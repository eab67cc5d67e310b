"""Proved lower bounds for the scenarios of a bank, in parallel and resumable."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

import leapnav
from leapnav.envs.scenarios.bank import BankError, ScenarioBank, digest
from leapnav.envs.scenarios.bank_writing import add_datasets
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.bounds.lower_bound import lower_bound
from leapnav.experts.data.store import Arrays, ResumableStore, discard
from leapnav.experts.pools import process_pool
from leapnav.experts.proofs.checker import check_proof
from leapnav.experts.proofs.proof import ProofError, find_ends

ROUNDING = 1e-9  # relative error with which a gap counts as proved


@dataclass(frozen=True)
class BankBound:
    """The result of `prove_bank` for one scenario.

    Attributes:
        index, name: the scenario.
        value: the lower bound; NaN if there is none.
        gap: 1 - value / cost of the optimum.
        seconds, check_seconds: duration of the proof and of its check (s).
        resolution: spacing of the finest cells (m).
        duality_gap: estimate of the gap that remains because the horizon is fixed.
        fault: why there is no bound, or why the checker refused its proof; empty if there is one.

    """

    index: int
    name: str
    value: float
    gap: float
    seconds: float
    check_seconds: float
    resolution: float
    duality_gap: float
    fault: str


def prove_bank(
    path: str | os.PathLike[str],
    *,
    gap: float = 0.05,
    time_limit: float = 60.0,
    count: int | None = None,
    workers: int = 1,
    progress: bool = True,
) -> list[BankBound]:
    """Prove lower bounds for the scenarios of a bank, and store them in the bank.

    Scenarios with a bound of at most this gap are skipped, others are computed again. A bound is stored after its proof
    was checked with `check_proof`, and only if it is better than the present one. The results of finished scenarios are
    in the directory `<path>.bounds` until the bank is written. After any interruption, including SIGKILL, the same call
    resumes.

    Args:
        path: the file of the bank.
        gap: relative optimality gap to prove.
        time_limit: time for each scenario (s), see `lower_bound`.
        count: number of scenarios, from the first of the bank; None: all.
        workers: number of processes.
        progress: show a progress bar.

    Returns:
        The results of the scenarios that were not skipped.

    Raises:
        ValueError: an argument is out of range, or lower bounds cannot be proved for the scenarios of the bank.
        BankError: the file is no bank, or the directory belongs to other arguments, is damaged or is in use.
        OSError: the bank cannot be written.

    """
    if not 0.0 < gap < 1.0:
        raise ValueError(f"gap: expected a number between 0 and 1, got {gap!r}")
    if not time_limit > 0:
        raise ValueError(f"time_limit: expected a positive number (s), got {time_limit!r}")
    if count is not None:
        check_at_least("count", count, 1)
    check_at_least("workers", workers, 1)
    path = Path(path).resolve()
    identity = bank_digest(ScenarioBank(path))
    if not os.access(path, os.W_OK):  # before hours of work
        raise PermissionError(f"{path}: cannot be written")
    settings = {"software": leapnav.__version__, "bank": identity, "gap": gap, "time_limit": time_limit}
    compute = partial(prove, path=path, identity=identity, gap=gap, time_limit=time_limit)
    with (
        ResumableStore(path.with_name(f"{path.name}.bounds"), "bank-proof", settings, BankError) as store,
        process_pool(workers, pre_dispatch="2 * n_jobs") as pool,
    ):
        bank = open_bank(path, identity)
        bank.verify_checksums()
        chosen = np.arange(len(bank) if count is None else min(count, len(bank)))
        for index in chosen.tolist():
            try:
                find_ends(bank[index])
            except ValueError as error:
                raise ValueError(f"{path}: scenario {index}: {error}") from None
        proved = bank.lower_bounds >= (1.0 - gap * (1.0 + ROUNDING)) * bank.costs
        finished = [index for index in range(len(bank)) if index in store]  # also of a run with a larger count
        missing = sorted({*chosen[~proved[chosen]].tolist(), *finished})
        found: dict[int, BankBound] = {}
        with progress_bar(total=len(missing), label="Proving", unit="scenarios", show=progress) as bar:
            for index, arrays in store.complete(missing, lambda index: partial(compute, index), pool, bar):
                found[index] = _result(bank, index, arrays)
                advance(bar, True)
        if found:
            bounds = open_bank(path, identity).lower_bounds.copy()
            for index, bound in found.items():
                bounds[index] = np.fmax(bounds[index], bound.value)
            add_datasets(path, lower_bounds=bounds)
    discard(store.directory)
    return [found[index] for index in sorted(found)]


def prove(index: int, path: Path, identity: str, gap: float, time_limit: float) -> Arrays:
    """Prove a lower bound for a scenario of a bank, as arrays of a shard; "fault" is empty if there is one."""
    bank = open_bank(path, identity)
    scenario, reference = bank[index], bank.reference(index)
    try:
        bound = lower_bound(scenario, reference, gap, time_limit, threads=1)
    except ValueError as error:  # the horizon is too long, or the arena too large
        return {"fault": np.array(str(error))}
    start = perf_counter()
    try:
        value = check_proof(bound.proof)
    except ProofError as error:
        return {"fault": np.array(f"the checker refuses the proof: {error}")}
    numbers = [value, bound.seconds, perf_counter() - start, bound.resolution, bound.duality_gap]
    return {"fault": np.array(""), "numbers": np.array(numbers)}


def open_bank(path: Path, identity: str) -> ScenarioBank:
    """Open the bank.

    Raises:
        BankError: the file does not contain the same scenarios any more.

    """
    bank = ScenarioBank(path)
    if bank_digest(bank) != identity:
        raise BankError(f"{path}: the file was replaced by a bank with other scenarios")
    return bank


def _result(bank: ScenarioBank, index: int, arrays: Arrays) -> BankBound:
    name, fault = bank[index].name, str(arrays["fault"])
    if fault:
        return BankBound(index, name, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, fault)
    value, seconds, check_seconds, resolution, duality_gap = arrays["numbers"].tolist()
    gap = 1.0 - value / float(bank.costs[index])
    return BankBound(index, name, value, gap, seconds, check_seconds, resolution, duality_gap, "")


def bank_digest(bank: ScenarioBank) -> str:
    """Return a checksum of the scenarios and their optimal costs."""
    return digest("".join(bank.checksums[name] for name in ("scenarios", "costs")).encode())
