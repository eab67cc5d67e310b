"""The `kernel` decorator: Numba's `njit` with a declared signature, and the cache that keeps the machine code.

The kernels that a kernel calls are compiled into it, but Numba's cache compares the source of its own file only
("Caching Limitations" in https://numba.readthedocs.io/en/stable/developer/caching.html). The machine code of a kernel
is therefore kept in a directory named after its bytecode, its constants, and those of the kernels that it calls.
"""

from __future__ import annotations

import builtins
import dis
import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numba
import platformdirs
from numba import types
from numba.extending import typeof_impl


class Declaration(NamedTuple):
    """What is declared of a kernel.

    Attributes:
        signature: its signature.
        directory: its cache directory.
        callees: the kernels that it calls.

    """

    signature: Any
    directory: Path
    callees: tuple[Any, ...]


DECLARATIONS: dict[Any, Declaration] = {}  # of all kernels of the imported modules; callees come first


def kernel(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Declare a function that Numba compiles when it is first called, or in advance, see `prepare`.

    Args:
        signature: Numba's types of the result and the arguments, such as `float64(float64)`, see
            `leapnav.envs.kernels.types`. Other arguments are possible, but the function is then compiled again.
        options: further options of `numba.njit`, such as `forceinline`. Division by zero gives infinity or NaN, and the
            interpreter lock is released.

    Raises:
        TypeError: the function is nested in another one. In machine code a kernel is identified by its module, its
            name and a number that a process counts up, so that two kernels of one name may be confused.
        NameError: the function uses a name that is defined below it, or a module of leapnav as a whole. Changes there
            would not be noticed.

    """

    def declare(function: Callable[..., Any]) -> Any:
        name = f"{function.__module__}.{function.__qualname__}"
        if "<" in name:
            raise TypeError(f"{name}: a kernel needs a name that is unique in its module")
        used = _globals(function)
        code = function.__code__
        content = signature, code.co_filename, code.co_code, *code.co_consts, *options.items(), *used.items()
        stamp = hashlib.sha256(_describe(content).encode()).hexdigest()[:16]
        directory = kernel_cache() / f"{name.removeprefix('leapnav.')}-{stamp}"
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(directory)  # type: ignore[attr-defined]
        try:
            compiled = numba.njit(cache=Path(code.co_filename).is_file(), error_model="numpy", nogil=True, **options)(
                function
            )
        finally:
            numba.config.CACHE_DIR = before  # type: ignore[attr-defined]
        callees = tuple(dict.fromkeys(filter(_is_kernel, used.values())))
        DECLARATIONS[compiled] = Declaration(signature, directory, callees)
        return compiled

    return declare


def record_type(record: type[NamedTuple], **fields: types.Type) -> Any:
    """Return the Numba type of a `NamedTuple` whose fields have these types, in the order of the class."""
    assert tuple(fields) == record._fields, (record, fields)
    declared = types.BaseTuple.from_types(tuple(fields.values()), record)
    typeof_impl.register(record)(lambda *_: declared)  # Numba would derive the types of the members in every call
    return declared


def kernels_of(*modules: str) -> list[Any]:
    """Return the kernels of the imported modules with these names, and of those below them."""
    names = tuple(f"{module}." for module in modules)
    return [one for one in DECLARATIONS if f"{one.py_func.__module__}.".startswith(names)]


def _globals(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the global names that a function uses, with their values."""
    scope: dict[str, Any] = function.__globals__
    names = {i.argval for i in dis.get_instructions(function) if i.opname == "LOAD_GLOBAL"} - set(dir(builtins))
    for name in names:
        value = scope.get(name)
        if name not in scope or (isinstance(value, ModuleType) and value.__name__.startswith("leapnav")):
            raise NameError(f"{function.__qualname__}: {name} must be a kernel or a constant defined above it")
    return {name: scope[name] for name in sorted(names)}


def _is_kernel(value: Any) -> bool:
    return callable(value) and value in DECLARATIONS


def _describe(value: Any) -> str:
    """Return a text that changes with the value of a constant, or with what a kernel computes."""
    if _is_kernel(value):
        return DECLARATIONS[value].directory.name
    if isinstance(value, tuple):
        return repr([_describe(one) for one in value])
    if isinstance(value, set | frozenset):  # whose order differs between processes
        return repr(sorted(map(_describe, value)))
    if callable(value) or isinstance(value, ModuleType):
        return repr(getattr(value, "_fields", getattr(value, "__name__", value)))
    return repr(value)


def kernel_cache() -> Path:
    """The directory below which all kernels are kept: NUMBA_CACHE_DIR, or a part of `cache_root()`."""
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
    return Path(os.environ.get("LEAPNAV_CACHE_DIR") or platformdirs.user_cache_dir("leapnav", appauthor=False))


@cache
def _temporary_directory() -> Path:
    return Path(tempfile.mkdtemp(prefix="leapnav-"))
