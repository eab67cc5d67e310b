"""The proximity cost among so many obstacles that they have a grid, as a compiled kernel that takes several at a time.

A cell of the grid holds what is felt somewhere in it as columns of numbers, so that a loop over them becomes vector
instructions. exp() is written out for that: that of the C library takes one number at a time. The compiler orders the
sums, so that the last bits depend on the processor; `leapnav.envs.obstacles` keeps to one order where no grid is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import float64, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from leapnav.envs.compiling import njit
from leapnav.envs.fields import GRID, LANES

# exp(x) = 2^k exp(r), with k whole and |r| <= log(2) / 2. A float beyond 2^52 is whole and holds k in its last bits.
LOWEST, HIGHEST = -708.0, 690.0  # so that neither exp() nor the sum of many leaves the floats
WHOLE = 1.5 * 2.0**52
BIAS = 1023.0  # of a float's exponent
LOG2_HIGH = 0.693145751953125  # few bits, so that k times it is exact
LOG2_LOW = 1.42860682030941723212e-6
SUMS = 6  # over a polygon's edges: weights, with normals, with their products
_field = types.Array(types.float64, 1, "C", readonly=True)


def _as_exponent(context: Any, shifted: Any) -> Any:
    """2^k from the float k + BIAS + WHOLE: its last bits become the exponent."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(64))
        return builder.bitcast(builder.shl(bits, ir.Constant(ir.IntType(64), 52)), ir.DoubleType())

    return float64(float64), generate


_power_of_two: Any = intrinsic(_as_exponent)


def _room(context: Any) -> Any:
    """Room for SUMS numbers of LANES polygons, which costs nothing to get."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        room = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), SUMS * LANES))
        return builder.bitcast(room, ir.DoubleType().as_pointer())

    return types.CPointer(float64)(), generate


_on_the_stack: Any = intrinsic(_room)


# Products and sums may be fused, but not reordered: WHOLE is added to be taken off again.
@njit(float64(float64), cache=True, error_model="numpy", nogil=True, fastmath={"contract"})
def exponential(x):
    """exp(x) to 1e-15; beyond the exponents of a float as at their ends."""
    x = LOWEST if x < LOWEST else x
    x = HIGHEST if x > HIGHEST else x
    shifted = x * (1.0 / math.log(2.0)) + (WHOLE + BIAS)
    k = shifted - (WHOLE + BIAS)
    r = (x - k * LOG2_HIGH) - k * LOG2_LOW
    # exp(r) by its series, in pairs of terms, so that the products do not wait for one another.
    square = r * r
    fourth = square * square
    low = (1.0 + r) + square * (1.0 / 2.0 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + square * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + square * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    highest = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0)
    series = low + fourth * (middle + fourth * (high + fourth * highest))
    return series * _power_of_two(shifted)


@njit(
    types.UniTuple(float64, 6)(float64, float64, _field),
    cache=True,
    error_model="numpy",
    nogil=True,
    fastmath={"contract", "nsz", "reassoc"},
)
def crowd_proximity(x, y, field):
    """(Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy) of the obstacles in a grid; the walls are not in it."""
    k, steepness, radius = field[0], 1.0 / field[1], field[2]
    grid = np.uint64(field[GRID])
    columns, lines = int(field[grid + 3]), int(field[grid + 4])
    column = min(max(int((x - field[grid]) / field[grid + 2]), 0), columns - 1)
    line = min(max(int((y - field[grid + 1]) / field[grid + 2]), 0), lines - 1)
    # Unsigned, for a number that may be negative counts from the end, and asking about it ends the vectors.
    at = grid + np.uint64(field[grid + np.uint64(5 + column * lines + line)])
    circles, polygons, edges = np.uint64(field[at]), np.uint64(field[at + 1]), np.uint64(field[at + 2])
    at += np.uint64(3)
    value = gx = gy = hxx = hxy = hyy = 0.0
    for i in range(circles):
        dx, dy = x - field[at + i], y - field[at + circles + i]
        smooth = math.sqrt(dx * dx + dy * dy + 1e-6)  # differentiable at the centre
        term = exponential((field[at + circles + circles + i] + radius - smooth) * steepness)
        inverse = 1.0 / smooth
        nx, ny = dx * inverse, dy * inverse
        curl = term * inverse
        bend = term * steepness + curl
        value += term
        gx -= term * nx
        gy -= term * ny
        hxx += bend * nx * nx - curl
        hxy += bend * nx * ny
        hyy += bend * ny * ny - curl
    at += np.uint64(3) * circles
    sums = carray(_on_the_stack(), SUMS * LANES)
    for first in range(np.uint64(0), polygons, np.uint64(LANES)):
        for i in range(SUMS * LANES):
            sums[i] = 0.0
        row = at + first
        for _ in range(edges):
            for lane in range(LANES):
                i = np.uint64(lane)
                nx, ny = field[row + i], field[row + polygons + i]
                distance = nx * x + ny * y - field[row + polygons + polygons + i]
                # Not shifted by the largest distance, as it has to be for exp(): this one does not overflow.
                share = exponential((distance - radius) * steepness)
                sums[i] += share
                sums[LANES + i] += share * nx
                sums[2 * LANES + i] += share * ny
                sums[3 * LANES + i] += share * nx * nx
                sums[4 * LANES + i] += share * nx * ny
                sums[5 * LANES + i] += share * ny * ny
            row += np.uint64(3) * polygons
        for lane in range(LANES):
            i = np.uint64(lane)
            term = 1.0 / sums[i]
            ax, ay = sums[LANES + i] * term, sums[2 * LANES + i] * term
            bend = term * steepness
            value += term
            gx -= term * ax
            gy -= term * ay
            hxx += bend * (2.0 * ax * ax - sums[3 * LANES + i] * term)
            hxy += bend * (2.0 * ax * ay - sums[4 * LANES + i] * term)
            hyy += bend * (2.0 * ay * ay - sums[5 * LANES + i] * term)
    slope = k * steepness
    return k * value, slope * gx, slope * gy, slope * hxx, slope * hxy, slope * hyy
