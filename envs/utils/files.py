"""Atomic writes, lock files and checksums."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path in the directory of `target`, and move it to `target` if the block raises no error.

    Any interruption, including SIGKILL, leaves either the old file or the complete new one. It may also leave a hidden
    file whose name ends in ".partial".

    Args:
        target: the file to write; its directory must exist.

    Raises:
        OSError: the file cannot be written; the error of a full disk names the target.

    """
    path = Path(target)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("r+b") as file:  # Windows synchronises only files that are open for writing
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def write_text(target: str | os.PathLike[str], text: str) -> None:
    """Write a text file atomically, see `atomic_path`."""
    with atomic_path(target) as partial:
        partial.write_text(text, encoding="utf-8")


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 checksum of a file as hexadecimal digits."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def exclusive(path: str | os.PathLike[str], error: Exception) -> Iterator[None]:
    """Hold a lock file during the block; raise `error` immediately if another process holds it."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise error from None
    try:
        yield
    finally:
        lock.release()
