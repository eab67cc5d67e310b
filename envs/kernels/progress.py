"""A line on standard error while kernels are compiled, which takes seconds and happens once per installation."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from time import monotonic

from leapnav.envs.kernels.numba_internals import Kernel

TITLE = "leapnav: compiling"  # beginning of each line
INTERVAL = 5.0  # s between two lines where standard error is no terminal


class _Progress:
    """Counts the kernels that this process compiles or waits for. Used under Numba's compiler lock only."""

    def __init__(self) -> None:
        self.expected: set[Kernel] = set()
        self.compiled: set[Kernel] = set()
        self._reported = -INTERVAL
        self._is_announced = False

    def report(self, advise: bool) -> None:
        """Writes how far the compilation is: in place on a terminal, elsewhere as lines."""
        count, total, now = len(self.compiled), len(self.expected), monotonic()
        text = f"{TITLE}, once per installation: {count} of {total} kernels"
        if sys.stderr.isatty():
            print(f"\r{text} ", end="\n" if count == total else "", file=sys.stderr)
        elif not self._is_announced or now - self._reported >= INTERVAL:
            advice = "" if self._is_announced or not advise else "; `leapnav compile` compiles all in advance"
            print(f"{text}{advice}", file=sys.stderr)
            self._reported = now
        self._is_announced = True
        sys.stderr.flush()


_PROGRESS = _Progress()


@contextmanager
def counted(kernels: Iterable[Kernel], advise: bool = True) -> Iterator[Callable[[Kernel], None]]:
    """Adds kernels to the total, and yields what to call when one of them is compiled.

    With `advise`, the first line mentions `leapnav compile`.
    """
    _PROGRESS.expected.update(kernels)
    _PROGRESS.report(advise)

    def done(one: Kernel) -> None:
        _PROGRESS.compiled.add(one)
        _PROGRESS.report(advise)

    yield done


@contextmanager
def compiling(compiled: Kernel, *, is_cached: bool) -> Iterator[None]:
    """Reports that a kernel is compiled, unless it only has to be loaded from the cache."""
    if is_cached:
        yield
        return
    with counted([compiled]) as done:
        yield
        done(compiled)
