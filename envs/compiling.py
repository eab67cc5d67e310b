"""Numba's `njit` with a cache that knows what a kernel is made of.

A kernel has those it calls compiled into it, but Numba's cache looks at a kernel's own file only: after a change in
another one, of a developer or of a new version, it would go on with the old code ("Caching Limitations" in
https://numba.readthedocs.io/en/stable/developer/caching.html). So the kernels of a module are kept in a folder that is
named after its source and that of all modules whose kernels and constants it imports.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from typing import Any

import numba
import platformdirs

IMPORT = re.compile(rb"^from (leapnav\.[\w.]+) import ", re.MULTILINE)
_CONFIG: Any = import_module("numba.core.config")  # which is `numba.config`
_LOCK = RLock()
KERNEL = re.compile(rb"^ *@njit\(", re.MULTILINE)


def njit(*arguments: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` for a kernel of leapnav.

    Raises:
        TypeError: the function is nested in another one. In machine code a kernel is known by its module, its name and
            a number that a process counts up; two kernels of one name, one of them compiled here and the other found
            in the cache of a process that counted otherwise, may get the same number, and then one is called for both.

    """

    def compile_(function: Callable[..., Any]) -> Any:
        if "<" in function.__qualname__:
            raise TypeError(f"{function.__qualname__}: a kernel needs a name that no other has in its module")
        # Numba settles where a function is cached when it is decorated, from this setting alone.
        with _LOCK:
            chosen = _CONFIG.CACHE_DIR
            folder = kernel_directory(function, chosen)
            if not folder.exists():
                _say_what_takes_so_long()
            _CONFIG.CACHE_DIR = str(folder)
            try:
                return numba.njit(*arguments, **options)(function)
            finally:
                _CONFIG.CACHE_DIR = chosen

    return compile_


def kernel_directory(function: Callable[..., Any], chosen: str) -> Path:
    """Where the kernels of a function's module are kept: as `chosen`, beside the module, or in the user's cache."""
    source = Path(inspect.getfile(function))
    if chosen:
        folder = Path(chosen)
    else:
        folder = source.parent / "__pycache__"
        if not os.access(folder if folder.exists() else source.parent, os.W_OK):
            folder = Path(platformdirs.user_cache_dir("leapnav", appauthor=False))
    return folder / f"{source.stem}-{source_stamp(function.__module__)[:12]}"


@cache
def _say_what_takes_so_long() -> None:
    """Once in a process, and only to somebody who looks at it."""
    if sys.stderr.isatty():
        print("leapnav: compiling, once after an installation: about a minute", file=sys.stderr)


@cache
def source_stamp(name: str) -> str:
    """A hash of the source of a module, and of what it imports from leapnav if it has kernels."""
    spec = find_spec(name)
    assert spec is not None and spec.origin is not None
    source = Path(spec.origin).read_bytes()
    stamp = hashlib.sha256(source)
    if KERNEL.search(source):
        for imported in IMPORT.findall(source):
            stamp.update(source_stamp(imported.decode()).encode())
    return stamp.hexdigest()
