"""Output files, JSON and the exit code of failure, shared by the commands."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

FAILED = 1  # exit code of a command that ran to its end with a negative result
PICTURES, ANIMATIONS, VIDEOS, PAGES = (".png", ".pdf", ".svg"), (".gif",), (".mp4",), (".html",)
STDOUT = Path("-")
_json_stream: ContextVar[TextIO | None] = ContextVar("json_stream", default=None)


def check_outputs(
    json: Path | None = None,
    plot: Path | None = None,
    video: Path | None = None,
    page: Path | None = None,
    onnx: Path | None = None,
    animation: Path | None = None,
) -> None:
    """Check that the output files of a command can be written, before its work begins.

    Args:
        json: JSON file, "-" for standard output.
        plot: picture.
        video: video.
        page: HTML page.
        onnx: ONNX file.
        animation: animation.

    Raises:
        FileNotFoundError: the directory of a file does not exist.
        IsADirectoryError: a file is a directory.
        ValueError: the suffix of a file is not one of the supported formats.

    """
    for path in (None if json == STDOUT else json, plot, video, page, onnx, animation):
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(f"{path}: the directory does not exist")
        if path is not None and path.is_dir():
            raise IsADirectoryError(f"{path}: is a directory")
    kinds = (plot, PICTURES), (animation, ANIMATIONS), (video, VIDEOS), (page, PAGES), (onnx, (".onnx",))
    for path, formats in kinds:
        if path is not None and path.suffix not in formats:
            raise ValueError(f"{path}: expected a name that ends in {', '.join(formats)}")


@contextmanager
def json_on_stdout(json: Path | None) -> Iterator[None]:
    """Redirect everything but JSON to standard error while JSON goes to standard output.

    Args:
        json: the command's JSON file; nothing is redirected unless it is "-".

    """
    if json != STDOUT:
        yield
        return
    token = _json_stream.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _json_stream.reset(token)


def write_json(content: Any, path: Path | None) -> None:
    """Write the result of a command as JSON. NaN and infinity become null.

    Args:
        content: dictionaries, lists, numbers, strings, dataclasses, paths.
        path: the file; "-" writes to standard output, None writes nothing.

    """
    if path is None:
        return
    from leapnav.envs.utils.json_utils import encode

    if path == STDOUT:
        print(encode(content), file=_json_stream.get() or sys.stdout)
        return
    path.write_text(encode(content) + "\n", encoding="utf-8")  # not atomic: it may be a pipe or a device
    print(f"wrote {path}")
