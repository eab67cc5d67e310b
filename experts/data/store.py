"""Resumable storage of the finished parts of a long computation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from tqdm.std import tqdm

from leapnav.envs.utils.files import atomic_path, exclusive, write_text

Arrays = Mapping[str, np.ndarray]
Job = Callable[[], Arrays]
DISCARDED = "-done"  # added to the name of a directory that is being removed


class ResumableStore:
    """A directory of shards, open to one process at a time; each shard is complete or absent.

    After any interruption, including SIGKILL, a computation opens the directory with the same settings and computes
    only the missing shards. Use it as a context manager, which holds a lock file.

    Args:
        directory: created if it is missing.
        kind: name of the computation, such as "rollout"; used in error messages and for the manifest, `<kind>.json`.
        settings: JSON values that determine the content of the shards; a directory with other settings is refused.
        error: type of the exceptions for a directory or shard that cannot be used.
        advice: end of the message about another unfinished computation in the directory.

    Raises:
        ValueError: (or `error`) on entering: the directory has other settings, or another process uses it.
        OSError: on entering: the directory cannot be written.

    """

    def __init__(
        self,
        directory: Path,
        kind: str,
        settings: Mapping[str, Any],
        error: type[ValueError] = ValueError,
        advice: str = "",
    ) -> None:
        self.directory, self.kind = directory, kind
        self._advice = advice
        self._header = json.dumps({"format": f"leapnav-{kind}", **settings}, sort_keys=True)
        self._error = error
        self._open = ExitStack()

    def __enter__(self) -> ResumableStore:
        self.directory.mkdir(parents=True, exist_ok=True)
        busy = self._error(f"{self.directory}: another process is at work on this {self.kind}")
        with ExitStack() as stack:
            stack.enter_context(exclusive(self.directory / "lock", busy))
            for leftover in self.directory.glob(".*.partial"):  # of a process that was killed while it wrote a file
                leftover.unlink()
            self._check_manifest()
            self._open = stack.pop_all()
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is not None and not any(self.directory.glob("shard-*.npz")):  # perhaps the settings are wrong
            (self.directory / f"{self.kind}.json").unlink(missing_ok=True)
        self._open.close()

    def _check_manifest(self) -> None:
        """Write the manifest, or compare the settings with those of the existing one."""
        manifest = self.directory / f"{self.kind}.json"
        if not manifest.exists():
            write_text(manifest, self._header + "\n")
            return
        try:
            found: dict[str, Any] = dict(json.loads(manifest.read_bytes()))
        except (ValueError, TypeError) as error:
            raise self._error(f"{manifest}: damaged: {error}; remove {self.directory}") from None
        expected: dict[str, Any] = json.loads(self._header)
        for name in sorted(found.keys() | expected.keys()):
            if found.get(name) != expected.get(name):
                raise self._error(
                    f"{manifest}: holds an unfinished {self.kind} of other settings: {name} is {found.get(name)!r}, "
                    f"got {expected.get(name)!r}; finish that one, or remove {self.directory}{self._advice}"
                )

    def path(self, number: int) -> Path:
        """The file of a shard."""
        return self.directory / f"shard-{number:06d}.npz"

    def __contains__(self, number: int) -> bool:
        return self.path(number).exists()

    def write(self, number: int, arrays: Arrays) -> None:
        """Write a shard.

        Raises:
            OSError: the file cannot be written; the exception names it.

        """
        header = np.frombuffer(f"{self._header} {number}".encode(), dtype="u1")
        with atomic_path(self.path(number)) as partial, partial.open("wb") as file:
            np.savez(file, header=header, allow_pickle=False, **arrays)

    def read(self, number: int) -> dict[str, np.ndarray]:
        """The arrays of a shard.

        Raises:
            ValueError: (or `error`) the file is damaged, or belongs to another computation; the message names it.

        """
        path = self.path(number)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = arrays.pop("header").tobytes().decode()
        except Exception as error:  # a damaged archive raises exceptions of many types
            raise self._error(f"{path}: damaged: {error}; remove it to compute it again") from None
        if header != f"{self._header} {number}":
            raise self._error(f"{path}: a shard of another {self.kind}; remove it")
        return arrays

    def complete(
        self, numbers: Iterable[int], job: Callable[[int], Job], pool: Parallel, bar: tqdm[Any]
    ) -> Iterator[tuple[int, Arrays]]:
        """Yield all shards of `numbers`: those that are stored first, then the missing ones as they are finished.

        Args:
            numbers: indices of the shards.
            job: returns a function without arguments that computes the arrays of a shard in a process of the pool.
            pool: see `leapnav.experts.pools.process_pool`.
            bar: progress bar; its rate is measured from the first computation on.

        """
        missing: list[int] = []
        for number in numbers:
            if number in self:
                yield number, self.read(number)
            else:
                missing.append(number)
        bar.unpause()
        tasks = (delayed(_numbered)(job(number), number) for number in missing)
        for number, arrays in cast(Iterator[tuple[int, Arrays]], pool(tasks)):
            self.write(number, arrays)
            yield number, arrays


def discard(directory: Path) -> None:
    """Remove the directory of a store that is no longer needed.

    It is renamed first: a directory from which only some shards have been removed would look like an unfinished store.
    """
    discarded = directory.with_name(directory.name + DISCARDED)
    shutil.rmtree(discarded, ignore_errors=True)
    if directory.is_dir():
        directory.rename(discarded)
        shutil.rmtree(discarded)


def _numbered(job: Job, number: int) -> tuple[int, Arrays]:
    return number, job()
