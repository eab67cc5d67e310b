"""What has no equivalent in Numba's public interface, with the time that it saves.

Views: a slice counts references, atomically. With slices instead of views, a search takes 1.1 of the time.
Function pointers: Numba accepts a kernel as an argument of another kernel, but resolves its type in every call.
Records by their places: Numba takes about 0.1 us for each array of a call from Python, half of a step of one robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from llvmlite import ir
from numba import (
    carray,  # pyright: ignore[reportPrivateImportUsage] (it is public)
    float64,
    int64,
    typeof,
    types,
)
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from leapnav.envs.kernels.compilation import prepare

__all__ = [
    "FunctionPointer",
    "carray",
    "function_at",
    "matrix_of",
    "part_of",
    "places_of",
    "record_at",
    "records_of",
    "scratch_buffer",
    "vector_at",
    "writable",
]


class FunctionPointer:
    """A kernel as the argument of another kernel: its type and its address."""

    def __init__(self, kernel: Any, kind: types.FunctionType) -> None:
        self._numba_type_ = kind
        self._kernel = kernel  # keeps the code alive

    @cached_property
    def address(self) -> int:
        """The address; the kernel is compiled when it is first needed."""
        prepare(self._kernel)  # which compiles no callee for literals
        self._kernel.compile(self._numba_type_.signature.args)
        result = self._kernel.get_compile_result(self._numba_type_.signature)
        return types.CompileResultWAP(result).__wrapper_address__()

    def __wrapper_address__(self) -> int:
        return self.address

    def __call__(self, *arguments: Any) -> Any:
        """Call the function from Python."""
        return self._kernel(*arguments)


def places_of(record: Sequence[np.ndarray], declared: Any) -> np.ndarray:
    """Return the addresses and the shapes (k, 4), int64, of the arrays of a record.

    The caller keeps the arrays alive, and replaces none while a kernel runs in another thread.

    Raises:
        TypeError: an array is not of its declared type, not in C order, or read-only.

    """
    places = np.zeros((len(record), 4), np.int64)
    for place, array, member in zip(places, record, declared.types, strict=True):
        found: Any = typeof(array)
        if (found.dtype, found.ndim, found.layout) != (member.dtype, member.ndim, "C") or not array.flags.writeable:
            raise TypeError(f"expected a writable {member}, got {found}")
        place[: 1 + array.ndim] = array.ctypes.data, *array.shape
    return places


def writable(record: Any) -> Any:
    """Return a record with copies of its read-only arrays, as those of another process may be."""
    return record._make(array if array.flags.writeable else np.array(array) for array in record)


def _view(context: Any, builder: Any, array: Any, data: Any, shape: list[Any]) -> Any:
    """Return an array in C order that does not own its memory."""
    view = context.make_array(array)(context, builder)
    item = context.get_data_type(array.dtype)
    itemsize = context.get_constant(types.intp, context.get_abi_sizeof(item))
    strides = [itemsize]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.bitcast(data, item.as_pointer())
    populate_array(view, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return view._getvalue()


def _typed_view(array: Any, dtype: Any, lengths: int, *others: Any) -> tuple[Any, Any]:
    """Return signature and code of a view: (array in C order, index of its first element, shape) -> view."""
    view = types.Array(dtype, lengths, "C", readonly=not array.mutable)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        whole = context.make_array(array)(context, builder, arguments[0])
        data = builder.gep(whole.data, [arguments[1]])
        return _view(context, builder, view, data, list(arguments[2 : 2 + lengths]))

    return view(array, *[int64] * (1 + lengths), *others), generate


def _typed_part_of(context: Any, array: Any, start: Any, count: Any) -> Any:
    return _typed_view(array, array.dtype, 1)


def _typed_records_of(context: Any, array: Any, start: Any, count: Any, dtype: Any) -> Any:
    return _typed_view(array, dtype.dtype, 1, dtype)


def _typed_matrix_of(context: Any, array: Any, start: Any, rows: Any, columns: Any) -> Any:
    return _typed_view(array, array.dtype, 2)


def _typed_vector_at(context: Any, address: Any, length: Any) -> Any:
    array = types.Array(float64, 1, "C", readonly=True)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())
        return _view(context, builder, array, data, [arguments[1]])

    return array(int64, int64), generate


def _typed_record_at(context: Any, places: Any, declared: Any) -> Any:
    record = declared.instance_type

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table, members = context.make_array(places)(context, builder, arguments[0]).data, []
        for k, array in enumerate(record.types):
            entries = [context.get_constant(types.intp, 4 * k + j) for j in range(1 + array.ndim)]
            address, *shape = [builder.load(builder.gep(table, [entry])) for entry in entries]
            members.append(_view(context, builder, array, builder.inttoptr(address, cgutils.voidptr_t), shape))
        return context.make_tuple(builder, record, members)

    return record(places, declared), generate


def _typed_function_at(context: Any, address: Any, kind: Any) -> Any:
    function = kind.instance_type

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = cgutils.create_struct_proxy(function)(context, builder)  # its other members are null
        pointer.c_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
        return pointer._getvalue()

    return function(int64, kind), generate


def _typed_scratch_buffer(context: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        buffer = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), count.literal_value))
        return builder.bitcast(buffer, ir.DoubleType().as_pointer())

    return types.CPointer(float64)(count), generate


# In kernels: the vector (count,), or the matrix (rows, columns), of an array's elements in C order from `start`; the
# records of a NumPy dtype in the memory of an array, from the index `start` of its elements; the vector of floats at an
# address that the caller keeps alive; the named tuple of a type whose arrays are at `places_of`; the function of a type
# at the address of a `FunctionPointer`; a buffer of floats on the stack, of a literal length.
part_of: Any = intrinsic(_typed_part_of)
records_of: Any = intrinsic(_typed_records_of)
matrix_of: Any = intrinsic(_typed_matrix_of)
vector_at: Any = intrinsic(_typed_vector_at)
record_at: Any = intrinsic(_typed_record_at)
function_at: Any = intrinsic(_typed_function_at)
scratch_buffer: Any = intrinsic(prefer_literal=True)(_typed_scratch_buffer)
