"""The finished parts of a rollout: files that are written whole or not at all, and that know what they belong to."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # not on Windows, where nothing keeps two processes from one folder
    fcntl = None  # type: ignore[assignment]

FORMAT = "leapnav-rollout"


class Shards:
    """A folder of shards.

    Args:
        folder: made if there is none.
        settings: what the rollout is; a folder of another one is refused. JSON values.

    Raises:
        ValueError: the folder belongs to another rollout, or another process works in it.
        OSError: the folder cannot be written.

    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        self._header = json.dumps({"format": FORMAT, **settings}, sort_keys=True)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = (folder / "lock").open("w")
        if fcntl is not None:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{folder}: another process is at work on this rollout") from None
        manifest = folder / "rollout.json"
        if not manifest.exists():
            self._write(manifest, lambda path: path.write_text(self._header + "\n"))
        elif manifest.read_text() != self._header + "\n":
            raise ValueError(f"{manifest}: holds an unfinished rollout of other settings; finish or remove it")

    def path(self, number: int) -> Path:
        """The file of a shard."""
        return self.folder / f"shard-{number:06d}.npz"

    def __contains__(self, number: int) -> bool:
        return self.path(number).exists()

    def write(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes a shard; an interruption leaves either all of it or nothing."""
        header = np.frombuffer(f"{self._header} {number}".encode(), dtype="u1")

        def save(path: Path) -> None:
            with path.open("wb") as file:
                np.savez(file, header=header, allow_pickle=False, **arrays)

        self._write(self.path(number), save)

    def read(self, number: int) -> dict[str, np.ndarray]:
        """The arrays of a shard.

        Raises:
            ValueError: the file is damaged, or of another rollout; the message names it.

        """
        path = self.path(number)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = arrays.pop("header").tobytes().decode()
        except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: damaged: {error}; remove it to have it made again") from None
        if header != f"{self._header} {number}":
            raise ValueError(f"{path}: a shard of another rollout; remove it")
        return arrays

    def _write(self, path: Path, save: Any) -> None:
        partial = path.with_name(f".{path.name}.partial")
        try:
            save(partial)
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException as error:
            partial.unlink(missing_ok=True)
            if isinstance(error, OSError) and error.filename is None:  # of a full disk: say which
                raise OSError(error.errno, error.strerror, str(path)) from None
            raise

    def close(self) -> None:
        """Lets other processes in."""
        self._lock.close()
