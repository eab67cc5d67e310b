"""Linear interpolation of paths (kernel)."""

from __future__ import annotations

import numpy as np

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import MATRIX, VECTOR


@kernel(MATRIX(VECTOR, VECTOR, MATRIX))
def interpolate(at, times, rows):
    """Interpolate the rows (N, n) of a path at times (N,) linearly, as `np.interp` does with each column.

    Args:
        at: (K,), times; fastest in ascending order. Before the first and after the last time, the path is constant.
        times: (N,), increasing.
        rows: (N, n).

    """
    last, columns = len(times) - 1, rows.shape[1]
    result = np.empty((len(at), columns))
    k = 0
    for i in range(len(at)):
        if at[i] < times[k]:
            k = 0
        while k < last and times[k + 1] <= at[i]:
            k += 1
        for j in range(columns):
            if k == last or at[i] <= times[k]:
                result[i, j] = rows[k, j]
            else:
                slope = (rows[k + 1, j] - rows[k, j]) / (times[k + 1] - times[k])
                result[i, j] = slope * (at[i] - times[k]) + rows[k, j]
    return result
