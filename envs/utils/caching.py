"""A cache of function results that threads share."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from threading import RLock
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
Result = TypeVar("Result")


def computed_once(maxsize: int | None = None) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Cache the results of a function, each of which is computed by one thread while the others wait.

    `functools.lru_cache` computes a result several times if several threads ask for it at once.

    Args:
        maxsize: number of results that are kept; None for all.

    """

    def decorate(function: Callable[P, Result]) -> Callable[P, Result]:
        cached, lock = lru_cache(maxsize)(function), RLock()

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> Result:
            with lock:
                return cached(*args, **kwargs)

        return call

    return decorate
