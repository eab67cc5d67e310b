"""Where commands write."""

from __future__ import annotations

import json as encoder
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

PICTURES, VIDEOS, PAGES = (".png", ".pdf", ".svg"), (".mp4",), (".html",)
STDOUT = Path("-")
_reserved: ContextVar[TextIO | None] = ContextVar("reserved", default=None)


def check_outputs(
    json: Path | None = None, plot: Path | None = None, video: Path | None = None, page: Path | None = None
) -> None:
    """Checks the files that a command is to write: what cannot be written is told before the work, not after.

    Raises:
        FileNotFoundError, IsADirectoryError: there is no such folder, or it is one.
        ValueError: the name ends in no format that can be written.

    """
    for path in (None if json == STDOUT else json, plot, video, page):
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(f"{path}: its folder does not exist")
        if path is not None and path.is_dir():
            raise IsADirectoryError(f"{path}: is a folder")
    for path, formats in ((plot, PICTURES), (video, VIDEOS), (page, PAGES)):
        if path is not None and path.suffix not in formats:
            raise ValueError(f"{path}: expected a name that ends in {', '.join(formats)}")


@contextmanager
def reserved_for_json(json: Path | None) -> Iterator[None]:
    """Where JSON goes to standard output, all else that a command prints goes to standard error."""
    if json != STDOUT:
        yield
        return
    token = _reserved.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _reserved.reset(token)


def write_json(content: Any, path: Path | None) -> None:
    """Writes what a command found, and says where; with the path "-" to standard output, and with None nowhere.

    Numbers that are not finite become null.
    """
    if path is None:
        return
    from leapnav.experts.plain import finite  # whoever asks for help need not load the solvers

    text = encoder.dumps(finite(content), allow_nan=False)
    if path == STDOUT:
        print(text, file=_reserved.get() or sys.stdout)
        return
    path.write_text(text + "\n")
    print(f"wrote {path}")
