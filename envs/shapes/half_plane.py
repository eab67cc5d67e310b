"""Half-planes: the four walls of the arena (kernel)."""

from __future__ import annotations

from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT
from leapnav.envs.shapes.field import ARENA


@kernel(float64(float64, float64, CONSTANT, int64))
def wall_distance(x, y, field, side):
    """Distance (m) to a wall, positive inside the arena; `side` is 0 to 3 for x_min, y_min, x_max, y_max."""
    sign = 1.0 if side < 2 else -1.0
    return sign * ((x if side % 2 == 0 else y) - field[ARENA + side])
