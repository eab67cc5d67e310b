"""The `kernel` decorator: one declared signature, compiled at first use, cached on disk.

A kernel has the kernels that it calls compiled into it, but Numba's cache compares the source of the kernel's own file
only ("Caching Limitations" in https://numba.readthedocs.io/en/stable/developer/caching.html). The machine code of a
module's kernels is therefore kept in a directory that is named after the source of the module and of every module of
leapnav that it imports, directly or not.

Kernels may also be declared outside of leapnav. For such a module, imports of modules beside it and below its directory
are followed, too. Kernels without a source file, such as those of an interactive session, are compiled but not cached.
"""

from __future__ import annotations

import ast
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any, NamedTuple

import numba
import platformdirs
from numba import types

from leapnav.envs.kernels import progress
from leapnav.envs.kernels.numba_internals import Kernel

PACKAGE = "leapnav"
# LLVM's highest level takes a quarter longer to compile and gives the same or slightly longer run times.
OPTIMISATION_LEVEL = 1
# Modules that do not change the machine code, although every kernel imports them.
WITHOUT_EFFECT = frozenset({"leapnav.envs.kernels.compilation", "leapnav.envs.kernels.progress"})


def kernel(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Declare a function that Numba compiles when it is first called.

    Args:
        signature: Numba's types of the result and the arguments, see `leapnav.envs.kernels.types`.
        options: further options of `numba.njit`, such as `fastmath`. Division by zero gives infinity or NaN, and the
            interpreter lock is released.

    Raises:
        TypeError: the function is nested in another one. In machine code a kernel is identified by its module, its
            name and a number that a process counts up. Two kernels of one name, one of them compiled here and the
            other loaded from the cache of a process that counted differently, may get the same number, and one of
            them would then be called for both.

    """

    def declare(function: Callable[..., Any]) -> Kernel:
        if "<" in function.__qualname__:
            raise TypeError(f"{function.__qualname__}: a kernel needs a name that is unique in its module")
        return Kernel(function, signature, {"error_model": "numpy", "nogil": True, **options}, _compilation)

    return declare


def record_type(record: type[NamedTuple], **fields: types.Type) -> types.NamedTuple | types.NamedUniTuple:
    """The Numba type of a `NamedTuple` that kernels take as one argument.

    Args:
        record: the class; its instances must hold exactly these types when they are passed from Python.
        fields: the Numba type of each field, in the order of the class.

    Raises:
        TypeError: the fields are not those of the class.

    """
    names: tuple[str, ...] = getattr(record, "_fields", ())
    if tuple(fields) != names:
        raise TypeError(f"{record.__name__}: expected the fields {', '.join(names)}, got {', '.join(fields)}")
    members = tuple(fields.values())
    is_uniform = len(set(members)) == 1  # which Numba distinguishes
    found = types.NamedUniTuple(members[0], len(members), record) if is_uniform else types.NamedTuple(members, record)
    record.numba_record_type = found  # type: ignore[attr-defined]
    return found


@contextmanager
def _compilation(compiled: Kernel) -> Iterator[tuple[Path | None, int | None]]:
    """Yield cache directory and optimisation level (NUMBA_OPT takes precedence), and report the progress."""
    directory = cache_directory(compiled.py_func.__module__)
    with progress.compiling(compiled, is_cached=directory is not None and compiled.is_cached(directory)):
        yield directory, None if "NUMBA_OPT" in os.environ else OPTIMISATION_LEVEL


def cache_directory(module: str) -> Path | None:
    """The directory that keeps the machine code of a module's kernels; None for a module without a source file."""
    if _file(module) is None:
        return None
    return kernel_cache() / f"{module.removeprefix(f'{PACKAGE}.')}-{source_stamp(module)[:12]}"


def kernel_cache() -> Path:
    """The directory below which all kernels are kept: NUMBA_CACHE_DIR, or `cache_root()`."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen else cache_root() / f"numba-{numba.__version__}"


def cache_root() -> Path:
    """The directory of everything that leapnav compiles: LEAPNAV_CACHE_DIR, or the user's cache directory.

    A directory that cannot be written is replaced by a temporary one, for this process.
    """
    root = requested_cache_root()
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError:
        return _temporary_directory()
    return root if os.access(root, os.W_OK) else _temporary_directory()


def requested_cache_root() -> Path:
    """`cache_root` as it is chosen, whether or not it can be written."""
    return Path(os.environ.get("LEAPNAV_CACHE_DIR") or platformdirs.user_cache_dir(PACKAGE, appauthor=False))


@cache
def _temporary_directory() -> Path:
    return Path(tempfile.mkdtemp(prefix=f"{PACKAGE}-"))


@cache
def source_stamp(module: str) -> str:
    """A hash of the source of a module and of all modules that it imports, see `_imports`, directly or not."""
    stamp = hashlib.sha256()
    for name in sorted(_imported({module}, module) - WITHOUT_EFFECT):
        stamp.update(_source(name))
    return stamp.hexdigest()


def _imported(found: set[str], module: str) -> set[str]:
    """Adds to `found` the modules that a module imports, see `_imports`, directly or not."""
    for name in _imports(module):
        if name not in found:
            found.add(name)
            _imported(found, name)
    return found


@cache
def _imports(module: str) -> frozenset[str]:
    """The modules that a module imports at its top level, in whatever form: those of leapnav, and those beside it."""
    file = _file(module)
    assert file is not None
    package = module if file.stem == "__init__" else module.rpartition(".")[0]
    candidates: set[str] = set()
    for node in ast.parse(_source(module)).body:
        if isinstance(node, ast.Import):
            candidates.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            name = resolve_name("." * node.level + (node.module or ""), package)
            candidates.add(name)
            candidates.update(f"{name}.{alias.name}" for alias in node.names)
    return frozenset(name for name in candidates if _is_followed(name, module))


def _is_followed(name: str, module: str) -> bool:
    """Whether an import of a module may change the machine code: a module of leapnav, or one beside the module."""
    top = name.partition(".")[0]
    if top == PACKAGE:
        return name != PACKAGE and _file(name) is not None
    if module.partition(".")[0] == PACKAGE or top in sys.stdlib_module_names:
        return False
    beside, file = _file(top), _file(module)
    if beside is None or file is None or "site-packages" in beside.parts:
        return False
    return beside.is_relative_to(file.parents[module.count(".")]) and _file(name) is not None


@cache
def _file(module: str) -> Path | None:
    """The source file of a module, or None."""
    loaded = sys.modules.get(module)
    try:
        # A script is not found by its name, `__main__`.
        spec = find_spec(module) if getattr(loaded, "__spec__", None) is not None or loaded is None else None
    except (ModuleNotFoundError, ValueError):  # a name in a module, not a module in a package
        return None
    origin = spec.origin if spec is not None else getattr(loaded, "__file__", None)
    return Path(origin) if origin is not None and origin.endswith(".py") and Path(origin).exists() else None


@cache
def _source(module: str) -> bytes:
    file = _file(module)
    assert file is not None
    return file.read_bytes()
