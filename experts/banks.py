"""Building scenario banks: random scenarios whose optima are certified and beyond doubt, in parallel, resumable."""

from __future__ import annotations

import base64
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from tqdm.auto import tqdm

import leapnav
from leapnav.envs.bank import VERSION, BankEntry, BankError, ScenarioBank, point_times, write_bank
from leapnav.envs.families import FAMILIES, sample_scenario
from leapnav.experts.extremal import Status
from leapnav.experts.optimum import Optimum, find_optimum

if sys.platform == "win32":
    fcntl = None
else:
    import fcntl

RECORD = {"draw", "scenario", "cost", "second_cost", "certificate", "states", "controls", "costates"}
# A task at a time: what a process has in hand is lost if it is killed. (Declared as a string, taken as a number too.)
ONE = cast(str, 1)


class Rejection(Enum):
    """Why a scenario is not admitted to a bank. The value is what tables print."""

    NO_OPTIMUM = "no certified optimum"
    TOUCHING = "a cheaper extremal touches"
    UNRESOLVED = "a cheaper solution was not certified"


def judge(optimum: Optimum) -> Rejection | None:
    """Whether an optimum is a safe reference: None if it is.

    It must be certified, so clear of every obstacle and without a conjugate point; and no cheaper solution may have
    been found that cuts in only slightly (the true optimum would then touch) or that has no certificate otherwise.
    """
    if not optimum.success:
        return Rejection.NO_OPTIMUM
    if any(doubt.status is Status.COLLISION for doubt in optimum.doubts):
        return Rejection.TOUCHING
    return Rejection.UNRESOLVED if optimum.doubts else None


def build_bank(
    family: str,
    count: int,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    workers: int = 1,
    progress: bool = True,
) -> ScenarioBank:
    """Draws random scenarios, finds their optima, and writes those that are admitted to a bank.

    Each finished scenario is noted in a journal beside the bank, so a build that was stopped, however rudely, goes on
    where it was when started again, and gives the same file as one that was not. Neither the number of workers nor
    interruptions change a bit of it.

    Args:
        family: family of the scenarios.
        count: how many scenarios the bank is to hold.
        out: the bank's file. One that is complete already is returned as it is.
        seed: of the bank; draw k is of the generator seeded with (seed, k).
        workers: processes.
        progress: show a progress bar.

    Raises:
        ValueError: an argument is impossible.
        BankError: `out` or its journal holds something else.
        OSError: `out` cannot be written.

    """
    if family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family!r}")
    for name, value, least in (("count", count, 1), ("workers", workers, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value!r}")
    target = Path(out)
    if target.is_dir():
        raise IsADirectoryError(f"{target}: is a folder")
    if target.exists():
        return _complete(target, family, count, seed)
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"{target.parent}: no such folder")
    header = {"format": VERSION, "software": leapnav.__version__, "family": family, "seed": seed}
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=ONE, pre_dispatch="4 * n_jobs")
    with _Journal(target.with_name(f"{target.name}.journal"), header) as journal:
        # The bank holds the first scenarios that are admitted: as many as are missing are drawn, until none is.
        drawn, admitted = 0, journal.admitted(count)
        with tqdm(
            total=count, initial=len(admitted), desc=f"Building {family}", unit="scenario", disable=not progress
        ) as bar:
            while drawn == 0 or len(admitted) < count:
                drawn += count - (0 if drawn == 0 else len(admitted))
                numbers = [number for number in range(drawn) if number not in journal.records]
                results = pool(delayed(draw)(family, seed, number) for number in numbers)
                for record in cast(Iterator[dict[str, Any]], results):
                    journal.add(record)
                    bar.update(record["rejected"] is None)
                admitted = journal.admitted(drawn)
        rejected = Counter(str(journal.records[number]["rejected"]) for number in range(drawn))
        del rejected["None"]
        write_bank(
            target,
            [_entry(record) for record in admitted],
            family=family,
            seed=seed,
            drawn=drawn,
            rejected=rejected,
            software=leapnav.__version__,
        )
        journal.path.unlink()
    return ScenarioBank(target)


def draw(family: str, seed: int, number: int) -> dict[str, Any]:
    """One random scenario with its optimum, as the journal notes it."""
    scenario = sample_scenario(family, np.random.default_rng([seed, number]))
    scenario = scenario.model_copy(update={"name": f"{family}-{seed}-{number}"})
    optimum = find_optimum(scenario)
    rejection = judge(optimum)
    if rejection is not None:
        return {"draw": number, "rejected": rejection.value}
    certificate = optimum.certificate
    assert certificate is not None
    states, controls, costates = optimum.evaluate(point_times(scenario.horizon))
    return {
        "draw": number,
        "rejected": None,
        "scenario": scenario.to_json(),
        "cost": optimum.cost,
        "second_cost": optimum.alternatives[0].cost if optimum.alternatives else None,
        "certificate": [
            certificate.residual,
            certificate.defect,
            certificate.hamiltonian_drift,
            certificate.clearance,
        ],
        **{
            name: base64.b64encode(values.astype("<f4").tobytes()).decode()
            for name, values in (("states", states), ("controls", controls), ("costates", costates))
        },
    }


def _entry(record: dict[str, Any]) -> BankEntry:
    paths = {
        name: np.frombuffer(base64.b64decode(record[name]), "<f4").reshape(-1, width)
        for name, width in (("states", 3), ("controls", 2), ("costates", 3))
    }
    return BankEntry(
        scenario=record["scenario"],
        draw=record["draw"],
        cost=record["cost"],
        second_cost=record["second_cost"],
        certificate=tuple(record["certificate"]),
        **paths,
    )


def _complete(target: Path, family: str, count: int, seed: int) -> ScenarioBank:
    """The bank at `target`, if it is the one that is asked for."""
    bank = ScenarioBank(target)
    wanted = {"family": family, "seed": seed, "count": count, "software": leapnav.__version__}
    found = {"family": bank.family, "seed": bank.seed, "count": len(bank), "software": bank.software}
    for name, value in wanted.items():
        if found[name] != value:
            raise BankError(f"{target}: exists, with {name} {found[name]!r} instead of {value!r}; choose another name")
    # What a build leaves that is killed between its last two steps.
    target.with_name(f"{target.name}.journal").unlink(missing_ok=True)
    return bank


class _Journal:
    """A file of JSON lines, a header and then a record for every finished draw; an unfinished last line is dropped."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        self.path, self._header = path, header
        self.records: dict[int, dict[str, Any]] = {}

    def __enter__(self) -> _Journal:
        self._file = self.path.open("ab")
        try:
            self._lock()
            whole = self._read()
            self._file.truncate(whole)
            if whole == 0:
                self._write(self._header)
        except BaseException:
            self._file.close()
            raise
        return self

    def _lock(self) -> None:
        """Keeps other builds away from the journal until it is closed, or this process ends."""
        if fcntl is not None:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BankError(f"{self.path}: another process is building this bank") from None

    def _read(self) -> int:
        """Reads what a build before noted; returns the length of its whole lines in bytes."""
        whole = 0
        for number, line in enumerate(self.path.read_bytes().splitlines(keepends=True), start=1):
            fault = BankError(f"{self.path}: line {number} is no record of a build; remove the file")
            if not line.endswith(b"\n"):
                if number == 1 and not json.dumps(self._header).encode().startswith(line):
                    raise fault
                break
            whole += len(line)
            try:
                record = json.loads(line)
                if number > 1:
                    if record["rejected"] is None and not record.keys() >= RECORD:
                        raise fault
                    self.records[record["draw"]] = record
                    continue
                different = [name for name, value in self._header.items() if record[name] != value]
            except (ValueError, KeyError, TypeError, AttributeError):
                raise fault from None
            if different:
                raise BankError(
                    f"{self.path}: of a build with {different[0]} {record[different[0]]!r} instead of "
                    f"{self._header[different[0]]!r}; finish that one, or remove the file"
                )
        return whole

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, record: dict[str, Any]) -> None:
        """Notes a finished draw."""
        self.records[record["draw"]] = record
        self._write(record)

    def admitted(self, drawn: int) -> list[dict[str, Any]]:
        """The records of the first `drawn` draws that were admitted, in order."""
        records = [self.records[number] for number in range(drawn) if number in self.records]
        return [record for record in records if record["rejected"] is None]

    def _write(self, record: dict[str, Any]) -> None:
        self._file.write(json.dumps(record, allow_nan=False).encode() + b"\n")
        # To the system at once: what it holds survives the end of this process.
        self._file.flush()
