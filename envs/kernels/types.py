"""Numba types of the kernels' arguments. Every array is C-contiguous."""

from __future__ import annotations

from numba import boolean, float64, int8, int32, int64, types

VECTOR = float64[::1]
MATRIX = float64[:, ::1]
CUBE = float64[:, :, ::1]
# A read-only vector; a writable one is accepted too.
CONSTANT = types.Array(float64, 1, "C", readonly=True)
CONSTANT_MATRIX = types.Array(float64, 2, "C", readonly=True)
FLAGS = types.Array(boolean, 1, "C")
INTEGERS = int64[::1]
INDICES = int32[::1]
LINKS = int32[:, ::1]
SIGNS = int8[:, ::1]
NOTHING = types.none


def tuple_of(*members: types.Type) -> types.Type:
    """The type of a tuple: a `UniTuple` if all members are of one type."""
    if len(set(members)) == 1:
        return types.UniTuple(members[0], len(members))
    return types.Tuple(members)
