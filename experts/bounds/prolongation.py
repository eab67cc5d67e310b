"""Splines on the cells with half the spacing (kernels)."""

from __future__ import annotations

import numpy as np

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import NOTHING
from leapnav.experts.proofs.cells import BLOCK, EMPTY, LAYOUT, VALUES, Layout, gather


def prolonged(values: np.ndarray, layout: Layout, finer: Layout) -> np.ndarray:
    """Return the coefficients of the same spline on the cells with half the spacing, by inserting knots.

    Args:
        values (m, 8, 8, 8): coefficients.
        layout: the blocks of the coefficients.
        finer: the blocks of the result.

    Returns:
        Coefficients, float32; minus infinity if one that is needed is not stored.

    """
    result = np.full((len(finer.blocks), BLOCK, BLOCK, BLOCK), -np.inf, dtype=np.float32)
    _prolong(values, layout, finer, result)
    return result


@kernel(NOTHING(VALUES, LAYOUT, LAYOUT, VALUES))
def _prolong(values, layout, finer, result):
    """See `prolonged`; along each axis the weights are 3/4 for the parent and 1/4 for its nearer neighbour."""
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    half = BLOCK // 2
    for b in range(len(finer.blocks)):
        k0, i0, j0 = finer.blocks[b, 0], finer.blocks[b, 1], finer.blocks[b, 2]
        slot = layout.slots[k0 // 2, i0 // 2, j0 // 2]
        if slot < 0:
            continue
        gather(values, layout, slot, local)
        for k in range(BLOCK):
            a = k0 % 2 * half + k // 2 + 1
            da = 2 * (k % 2) - 1
            for i in range(BLOCK):
                p = i0 % 2 * half + i // 2 + 1
                dp = 2 * (i % 2) - 1
                for j in range(BLOCK):
                    q = j0 % 2 * half + j // 2 + 1
                    dq = 2 * (j % 2) - 1
                    total, largest = 0.0, -np.inf
                    for corner in range(8):
                        u, v, w = corner // 4, corner // 2 % 2, corner % 2
                        value = local[a + u * da, p + v * dp, q + w * dq]
                        total += 27.0 / 64.0 / 3.0 ** (u + v + w) * value
                        largest = max(largest, value)
                    if largest < 0.5 * EMPTY:
                        result[b, k, i, j] = total
