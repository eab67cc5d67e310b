"""Numba types of the kernels' arguments. Every array is C-contiguous."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float64, int8, int32, int64, types

VECTOR = float64[::1]
MATRIX = float64[:, ::1]
CUBE = float64[:, :, ::1]
# A read-only vector. Kernels also give writable ones to kernels, but Python has to call with `constant`; otherwise the
# kernel is compiled again.
CONSTANT = types.Array(float64, 1, "C", readonly=True)
CONSTANT_MATRIX = types.Array(float64, 2, "C", readonly=True)
FLAGS = types.Array(boolean, 1, "C")
INTEGERS = int64[::1]
INDICES = int32[::1]
LINKS = int32[:, ::1]
PLACES = int64[:, ::1]
SIGNS = int8[:, ::1]
NOTHING = types.none


def constant(values: Any) -> np.ndarray:
    """Return a `CONSTANT` or `CONSTANT_MATRIX`: a read-only view, or a copy of values of another type or order."""
    array = np.ascontiguousarray(values, dtype=np.float64).view()
    array.flags.writeable = False
    return array


def tuple_of(*members: types.Type) -> types.Type:
    """The type of a tuple: a `UniTuple` if all members are of one type."""
    if len(set(members)) == 1:
        return types.UniTuple(members[0], len(members))
    return types.Tuple(members)
