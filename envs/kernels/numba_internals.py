"""Everything of Numba and llvmlite that is not their public interface, in one place.

`pyproject.toml` bounds both packages from above; `tests/test_kernels.py` says what to check when a bound is raised.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import float64, int64, types
from numba.core import cgutils
from numba.core.boxing import unbox_tuple
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.extending import NativeValue, intrinsic, unbox
from numba.np.arrayobj import populate_array
from numba.np.numpy_support import carray

__all__ = [
    "FunctionPointer",
    "Kernel",
    "carray",
    "matrix_of",
    "part_of",
    "scratch_buffer",
    "vector_at",
]

_CONFIG: Any = import_module("numba.core.config")  # the module behind `numba.config`


class Kernel(CPUDispatcher):
    """A function with one declared signature that is compiled, or loaded from the cache, when it is first needed.

    `numba.njit` with a signature compiles at once, and without one compiles for whatever types it is called with. This
    dispatcher does neither: a call, from Python or from another kernel that is being compiled, makes it ready.

    Args:
        function: the Python function.
        signature: the declared signature.
        options: options of `numba.njit`.
        compilation: a context manager around the compilation; it receives the kernel and yields the cache directory
            (None: no cache) and LLVM's optimisation level (None: Numba's own).

    """

    def __init__(
        self,
        function: Callable[..., Any],
        signature: Any,
        options: dict[str, Any],
        compilation: Callable[[Kernel], AbstractContextManager[tuple[Path | None, int | None]]],
    ) -> None:
        super().__init__(function, targetoptions={**options, "nopython": True, "boundscheck": None})
        self.declared_signature = signature
        self._compilation = compilation
        self.is_ready = False

    def prepare(self) -> None:
        """Compiles the kernel, or loads it from the cache, if that has not been done in this process."""
        if self.is_ready:
            return
        with global_compiler_lock:
            if self.is_ready:
                return
            with self._compilation(self) as (directory, level), _optimised(level):
                if directory is not None:
                    self._cache = _KernelCache(self.py_func, directory)
                self.compile(self.declared_signature)
            self.disable_compile()
            self.is_ready = True

    def is_cached(self, directory: Path) -> bool:
        """Whether a cache directory holds machine code of the kernel (perhaps of another processor)."""
        return (directory / f"{_file_name(self.py_func)}.nbi").exists()

    @property
    def callees(self) -> list[Kernel]:
        """The kernels that this one calls by their global names."""
        function = self.py_func
        found = (function.__globals__.get(name) for name in function.__code__.co_names)
        return [value for value in found if isinstance(value, Kernel)]

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Called by Numba while it infers the types of a kernel that calls this one."""
        self.prepare()
        return super().get_call_template(args, kws)

    def get_compile_result(self, sig: Any) -> Any:
        """Called by Numba when the kernel is taken as a function pointer."""
        self.prepare()
        return super().get_compile_result(sig)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        # Called by Numba's C code, which then calls what is returned with the same arguments.
        self.prepare()
        return self

    def typeof_pyval(self, val: Any) -> Any:
        """The Numba type of an argument that is not a number or an array.

        The members of a record are not looked at: that takes longer than many kernels run. Unboxing checks them.
        """
        declared = getattr(type(val), "numba_record_type", None)
        return super().typeof_pyval(val) if declared is None else declared

    def __reduce__(self) -> Any:
        # By name, as functions are pickled.
        return named, (self.py_func.__module__, self.py_func.__qualname__)


def named(module: str, name: str) -> Any:
    """An object by the name of its module and its own."""
    return functools.reduce(getattr, name.split("."), import_module(module))


@contextmanager
def _optimised(level: int | None) -> Iterator[None]:
    """LLVM's optimisation level, a global setting of Numba's, while a kernel is compiled."""
    before = _CONFIG.OPT
    if level is not None:
        _CONFIG.OPT = type(before)(level)
    try:
        yield
    finally:
        _CONFIG.OPT = before


class _Directory:
    """The locator of a cache: the directory is given, and its name stands for the source."""

    def __init__(self, function: Callable[..., Any], directory: Path) -> None:
        self._directory, self._py_file = directory, function.__code__.co_filename

    def get_cache_path(self) -> str:
        return str(self._directory)

    def ensure_cache_path(self) -> None:
        self._directory.mkdir(parents=True, exist_ok=True)


class _KernelCacheImpl(CompileResultCacheImpl):
    def __init__(self, function: Callable[..., Any], directory: Path) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Directory(function, directory)
        self._filename_base = _file_name(function)


class _KernelCache(FunctionCache):
    """The cache of one kernel. Numba's own depends on the path of the source file and on no other file."""

    def __init__(self, function: Callable[..., Any], directory: Path) -> None:
        self._name, self._py_func = repr(function), function
        self._impl = _KernelCacheImpl(function, directory)
        self._cache_path = str(directory)
        self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, "")
        self.enable()


def _file_name(function: Callable[..., Any]) -> str:
    return f"{function.__qualname__}.py{sys.version_info[0]}{sys.version_info[1]}"


class FunctionPointer:
    """A kernel as the argument of another kernel: its type and its address.

    Numba accepts the dispatcher itself, but then resolves its type in every call, which takes a tenth of the time of a
    short solve.
    """

    def __init__(self, dispatcher: Kernel, kind: types.FunctionType) -> None:
        self._numba_type_ = kind
        result = dispatcher.get_compile_result(kind.signature)
        self._address = types.CompileResultWAP(result).__wrapper_address__()
        self._dispatcher = dispatcher  # keeps the code alive

    def __wrapper_address__(self) -> int:
        return self._address

    def __call__(self, *arguments: Any) -> Any:
        """Calls the function from Python."""
        return self._dispatcher(*arguments)


def _view(context: Any, builder: Any, array: Any, data: Any, shape: list[Any]) -> Any:
    """Return an array of floats in C order that does not own its memory."""
    view = context.make_array(array)(context, builder)
    itemsize = ir.Constant(ir.IntType(64), 8)
    strides = [itemsize]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    populate_array(view, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return view._getvalue()


def _typed_view(array: Any, n_dimensions: int) -> tuple[Any, Any]:
    """Return signature and code of a view: (array in C order, index of its first element, shape) -> view."""
    view = types.Array(float64, n_dimensions, "C", readonly=not array.mutable)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        whole = context.make_array(array)(context, builder, arguments[0])
        return _view(context, builder, view, builder.gep(whole.data, [arguments[1]]), list(arguments[2:]))

    return view(array, *[int64] * (1 + n_dimensions)), generate


def _typed_part_of(context: Any, array: Any, start: Any, count: Any) -> Any:
    return _typed_view(array, 1)


def _typed_matrix_of(context: Any, array: Any, start: Any, rows: Any, columns: Any) -> Any:
    return _typed_view(array, 2)


# A slice counts references, atomically, which takes as long as some of the kernels that receive it.
part_of: Any = intrinsic(_typed_part_of)
"""In kernels: the vector (count,) of an array's elements in C order from `start`, without counting a reference."""

matrix_of: Any = intrinsic(_typed_matrix_of)
"""In kernels: the matrix (rows, columns) of an array's elements in C order from `start`, likewise."""


def _typed_vector_at(context: Any, address: Any, length: Any) -> Any:
    array = types.Array(float64, 1, "C", readonly=True)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())
        return _view(context, builder, array, data, [arguments[1]])

    return array(int64, int64), generate


vector_at: Any = intrinsic(_typed_vector_at)
"""In kernels: the vector of floats at an address, of a given length, which the caller keeps alive."""


def _typed_scratch_buffer(context: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        buffer = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), count.literal_value))
        return builder.bitcast(buffer, ir.DoubleType().as_pointer())

    return types.CPointer(float64)(count), generate


scratch_buffer: Any = intrinsic(prefer_literal=True)(_typed_scratch_buffer)
"""In kernels: a pointer to a buffer of floats on the stack, without an allocation; its length is a literal."""


@unbox(types.NamedTuple)
def _unbox_named_tuple(kind: Any, value: Any, c: Any) -> Any:
    """Unboxing of a named tuple. For the records of leapnav, without Numba's check of the class.

    The check unpickles the class in every call, which takes longer than many kernels run. `Kernel.typeof_pyval` has
    already compared the class.
    """
    if not hasattr(kind.instance_class, "numba_record_type"):
        return unbox_tuple(kind, value, c)
    failed = cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    members = []
    for i, member_type in enumerate(kind.types):
        member = c.unbox(member_type, c.pyapi.tuple_getitem(value, i))
        with c.builder.if_then(member.is_error, likely=False):
            c.builder.store(cgutils.true_bit, failed)
        members.append(member.value)
    return NativeValue(c.context.make_tuple(c.builder, kind, members), is_error=c.builder.load(failed))
