"""Where commands write."""

from __future__ import annotations

from pathlib import Path

PICTURES = (".png", ".pdf", ".svg")


def check_outputs(json: Path | None, plot: Path | None) -> None:
    """Checks the files of --json and --plot: a place that cannot be written to is told before the work, not after.

    Raises:
        FileNotFoundError, IsADirectoryError: there is no such folder, or it is one.
        ValueError: the picture's name ends in no format that can be drawn.

    """
    for path in (json, plot):
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(f"{path}: its folder does not exist")
        if path is not None and path.is_dir():
            raise IsADirectoryError(f"{path}: is a folder")
    if plot is not None and plot.suffix not in PICTURES:
        raise ValueError(f"{plot}: expected a name that ends in {', '.join(PICTURES)}")
