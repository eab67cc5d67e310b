"""Compiling many kernels in advance, in parallel processes that fill the cache."""

from __future__ import annotations

import importlib.util
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any

from filelock import FileLock, Timeout

from leapnav.envs.kernels.decorator import DECLARATIONS, cache_root
from leapnav.envs.utils.progress import progress_bar

# Kernels for each process that is started, which takes two seconds. The eight kernels of a problem are compiled by this
# process: two others take as long, and 1.5 times the CPU time.
MIN_KERNELS = 16
MIN_SHOWN = 6  # kernels, whose progress is shown
# Level of LLVM's optimisation. At level 2, all kernels compile in 0.77 of the time of level 3, the default, and are as
# fast. At level 1 they compile in 0.73 of the time, but the checks of proofs take 1.2 times as long.
LLVM_LEVEL = "2"
PAUSE = 0.1  # s, while other processes compile
GENERATED = "leapnav_generated"  # package of the modules in the cache directory
_FOUND: set[Any] = set()  # kernels that are known to be in the cache, or were compiled by this process
LABEL = "Compiling, once per installation"
WORK = "import sys; from leapnav.envs.kernels import compilation; compilation.work(*sys.argv[1:])"


def prepare(*kernels: Any, jobs: int | None = None) -> int:
    """Compile kernels and those that they call, unless they are in the cache.

    Many kernels are compiled by several processes. Processes that need them at the same time share the work.

    Args:
        kernels: the kernels.
        jobs: number of processes; None for one per core.

    Returns:
        The number of kernels that were not in the cache.

    """
    waiting = missing(kernels)
    names = [f"{one.py_func.__module__}:{one.py_func.__qualname__}" for one in waiting]
    importable = [name for name in names if name.startswith(("leapnav.", f"{GENERATED}."))]
    command = [sys.executable, "-P", "-c", WORK, *importable]
    count = min(jobs or usable_cores(), math.ceil(len(waiting) / MIN_KERNELS)) if len(waiting) >= MIN_KERNELS else 0
    is_shown = count > 0 or len(waiting) >= MIN_SHOWN
    environment = {"NUMBA_OPT": LLVM_LEVEL, **os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    quiet = subprocess.DEVNULL
    helpers = [subprocess.Popen(command, stdout=quiet, stderr=quiet, env=environment) for _ in range(count)]
    try:
        with progress_bar(total=len(names), label=LABEL, unit="kernels", show=is_shown) as bar:
            while any(helper.poll() is None for helper in helpers):
                time.sleep(PAUSE)
                waiting = missing(waiting)
                bar.update(len(names) - len(waiting) - bar.n)
            # Few kernels, those that other processes cannot import, and those that failed, to raise the error
            _fill(waiting, bar.update)
    finally:
        for helper in helpers:
            helper.kill()
            helper.wait()
    return len(names)


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def missing(kernels: Any) -> list[Any]:
    """Return the kernels, among these and those that they call, that are not in the cache; callees come first."""
    needed: set[Any] = set()
    unvisited = list(kernels)
    while unvisited:
        one = unvisited.pop()
        if one not in needed:
            needed.add(one)
            unvisited += DECLARATIONS[one].callees
    return [one for one in DECLARATIONS if one in needed and not is_cached(one)]


def is_cached(one: Any) -> bool:
    """Return whether the cache contains machine code of a kernel."""
    if one not in _FOUND and next(DECLARATIONS[one].directory.rglob("*.nbi"), None) is not None:
        _FOUND.add(one)
    return one in _FOUND


def work(*names: str) -> None:
    """Compile the kernels with these names ("module:function"); run by the processes that `prepare` starts."""
    found = []
    for module, _, function in (name.partition(":") for name in names):
        is_generated = module.startswith(f"{GENERATED}.")
        found.append(getattr(import_generated(module) if is_generated else import_module(module), function))
    _fill(found)


def import_generated(name: str) -> ModuleType:
    """Import a generated module, of the package GENERATED, from the cache directory."""
    path = cache_root() / f"{name.removeprefix(GENERATED + '.')}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _fill(waiting: list[Any], on_compiled: Callable[[int], Any] = lambda _: None) -> None:
    """Compile kernels, callees first, apart from those that another process compiles meanwhile.

    `on_compiled` is called with 1 after each kernel.
    """
    while waiting:
        remaining: list[Any] = []
        for one in waiting:
            if is_cached(one) or (all(map(is_cached, DECLARATIONS[one].callees)) and _compile(one)):
                on_compiled(1)
            else:
                remaining.append(one)
        if len(remaining) == len(waiting):
            time.sleep(PAUSE)
        waiting = remaining


def _compile(one: Any) -> bool:
    """Compile a kernel, and return True, unless another process is compiling it."""
    signature, directory, callees = DECLARATIONS[one]
    try:
        with FileLock(directory / "lock", timeout=0):
            for callee in callees:  # otherwise Numba would compile them for the exact types of the arguments
                callee.compile(DECLARATIONS[callee].signature.args)
                callee.disable_compile()
            one.compile(signature.args)
    except Timeout:
        return False
    finally:
        for callee in callees:
            callee.disable_compile(False)
    _FOUND.add(one)  # also a kernel of a notebook, for which there is no cache
    return True
