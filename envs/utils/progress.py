"""Progress bars: tqdm at a terminal or in a notebook, elsewhere a line every 10 s."""

from __future__ import annotations

import sys
from threading import RLock
from time import monotonic
from typing import Any

from tqdm.asyncio import tqdm_asyncio
from tqdm.auto import tqdm
from tqdm.std import tqdm as text_bar

# Always units per second: tqdm would write "2.17s/ episodes" for slow ones.
FORMAT = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_noinv_fmt}{postfix}]"
INTERVAL = 10.0  # s between two lines where standard error is no terminal


class _Lines(text_bar):
    """A bar that prints a line every `INTERVAL` seconds and one at the end, for log files and pipes."""

    def __init__(self, **arguments: Any) -> None:
        self._printed = monotonic()  # a short task prints its last line only
        super().__init__(**arguments)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Print a line if the last one is old enough."""
        if monotonic() - self._printed >= INTERVAL:
            self._print(str(self))

    def close(self) -> None:
        """Print the last line."""
        if not self.disable:
            self._print(str(self))
            self.sp = None  # with which tqdm would print the bar again
        super().close()

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
        self._printed = monotonic()


# The lock that tqdm would create contains a semaphore. A worker process that is stopped does not release it, and Python
# warns about it at the end.
_Lines.set_lock(RLock())


def progress_bar(*, total: int, label: str, unit: str, initial: int = 0, show: bool = True) -> text_bar[Any]:
    """Return a progress bar on standard error, a context manager.

    Args:
        total: number of units.
        label: what is in progress.
        unit: name of the units, plural.
        initial: number of units that were done before.
        show: False returns a bar that prints nothing.

    """
    is_notebook = tqdm is not tqdm_asyncio  # tqdm.auto selects a widget there
    kind = tqdm if show and (is_notebook or sys.stderr.isatty()) else _Lines
    return kind(
        total=total,
        desc=label,
        unit=f" {unit}",
        initial=initial,
        disable=not show,
        dynamic_ncols=True,
        bar_format=None if is_notebook else FORMAT,
    )


def advance(bar: text_bar[Any], n: int) -> None:
    """Advance a bar by at most the units that remain: parts of a computation may contain more than were asked for."""
    bar.update(n if bar.total is None else max(0, min(n, int(bar.total) - bar.n)))


def stop_early(bar: text_bar[Any], reason: str) -> None:
    """Complete a bar whose remaining units are not needed, and print the reason beside it."""
    if bar.disable:
        return
    bar.total = bar.n
    bar.set_description_str(f"{bar.desc.removesuffix(': ')}: {reason}")
