"""Number of threads of torch during training and evaluation."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch as th

VARIABLE = "LEAPNAV_TORCH_THREADS"

P = ParamSpec("P")
R = TypeVar("R")


def limit_threads(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function during which torch uses one thread, or the number in LEAPNAV_TORCH_THREADS.

    The networks are so small that several threads mostly wait for each other, and on a busy machine for other
    processes. The previous number of threads is restored afterwards.

    Raises:
        ValueError: when the function is called: LEAPNAV_TORCH_THREADS is not a positive integer.

    """

    @functools.wraps(function)
    def limited(*arguments: P.args, **options: P.kwargs) -> R:
        before = th.get_num_threads()
        th.set_num_threads(_requested())
        try:
            return function(*arguments, **options)
        finally:
            th.set_num_threads(before)

    return limited


def _requested() -> int:
    text = os.environ.get(VARIABLE, "1")
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{VARIABLE}: expected a positive integer, got {text!r}")
    return int(text)
