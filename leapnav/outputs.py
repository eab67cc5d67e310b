"""Where commands write."""

from __future__ import annotations

from pathlib import Path

PICTURES, VIDEOS, PAGES = (".png", ".pdf", ".svg"), (".mp4",), (".html",)


def check_outputs(
    json: Path | None = None, plot: Path | None = None, video: Path | None = None, page: Path | None = None
) -> None:
    """Checks the files that a command is to write: what cannot be written is told before the work, not after.

    Raises:
        FileNotFoundError, IsADirectoryError: there is no such folder, or it is one.
        ValueError: the name ends in no format that can be written.

    """
    for path in (json, plot, video, page):
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(f"{path}: its folder does not exist")
        if path is not None and path.is_dir():
            raise IsADirectoryError(f"{path}: is a folder")
    for path, formats in ((plot, PICTURES), (video, VIDEOS), (page, PAGES)):
        if path is not None and path.suffix not in formats:
            raise ValueError(f"{path}: expected a name that ends in {', '.join(formats)}")
