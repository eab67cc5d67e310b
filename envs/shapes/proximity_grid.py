"""The proximity cost of a packed field with a grid, which fields with many obstacles have (kernels).

A cell of the grid lists, column by column, the obstacles that contribute somewhere in it, so that the compiler
vectorizes the loops over them. exp() is implemented here for the same reason: that of the C library is scalar. The
compiler chooses the order of the sums, so the last bits depend on the processor. The order in
`leapnav.envs.shapes.proximity`, which is used without a grid, is fixed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.numba_internals import carray, power_of_two, scratch_buffer
from leapnav.envs.kernels.types import CONSTANT, tuple_of
from leapnav.envs.shapes.circle import circle_derivatives, softened_distance
from leapnav.envs.shapes.field import GRID, LANES
from leapnav.envs.shapes.polygon import polygon_derivatives

# exp(x) = 2^k exp(r), with an integer k and |r| <= log(2) / 2. A double above 2^52 is an integer, and its last bits are
# those of k.
MIN_EXPONENT, MAX_EXPONENT = -708.0, 690.0  # neither exp() nor the sum of many values leaves the range of a double
INTEGER_SHIFT = 1.5 * 2.0**52
BIAS = 1023.0  # of a double's exponent
LOG2_HIGH = 0.693145751953125  # few bits, so that its product with k is exact
LOG2_LOW = 1.42860682030941723212e-6
SUMS = 6  # over the edges of a polygon: weights, times normals, times products of normals
BUFFER = SUMS * LANES


# Products and sums may be fused but not reordered, since INTEGER_SHIFT is added and subtracted again.
@kernel(float64(float64), fastmath={"contract"})
def exponential(x):
    """Return exp(x) with a relative error of 1e-15; x is clipped to [MIN_EXPONENT, MAX_EXPONENT]."""
    x = MIN_EXPONENT if x < MIN_EXPONENT else x
    x = MAX_EXPONENT if x > MAX_EXPONENT else x
    shifted = x * (1.0 / math.log(2.0)) + (INTEGER_SHIFT + BIAS)
    k = shifted - (INTEGER_SHIFT + BIAS)
    r = (x - k * LOG2_HIGH) - k * LOG2_LOW
    # The series of exp(r), grouped so that the products are independent of each other.
    square = r * r
    fourth = square * square
    low = (1.0 + r) + square * (1.0 / 2.0 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + square * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + square * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    highest = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0)
    series = low + fourth * (middle + fourth * (high + fourth * highest))
    return series * power_of_two(shifted)


@kernel(
    tuple_of(*[float64] * 6)(float64, float64, float64, CONSTANT),
    fastmath={"contract", "nsz", "reassoc"},
)
def grid_proximity(x, y, radius, field):
    """Return, for a disc of a radius (m), (Phi, Phi_x, Phi_y, Phi_xx, Phi_xy, Phi_yy) of the circles and polygons."""
    k, steepness = field[0], 1.0 / field[1]
    grid = np.uint64(field[GRID])
    columns, lines = int(field[grid + 3]), int(field[grid + 4])
    column = min(max(int((x - field[grid]) / field[grid + 2]), 0), columns - 1)
    line = min(max(int((y - field[grid + 1]) / field[grid + 2]), 0), lines - 1)
    # Unsigned, because the check for negative indices, which count from the end, prevents vectorization.
    at = grid + np.uint64(field[grid + np.uint64(5 + column * lines + line)])
    circles, polygons, edges = np.uint64(field[at]), np.uint64(field[at + 1]), np.uint64(field[at + 2])
    at += np.uint64(3)
    value = gx = gy = hxx = hxy = hyy = 0.0
    for i in range(circles):
        dx, dy = x - field[at + i], y - field[at + circles + i]
        smooth = softened_distance(dx, dy)
        term = exponential((field[at + circles + circles + i] + radius - smooth) * steepness)
        ax, ay, bxx, bxy, byy = circle_derivatives(dx, dy, smooth, term, steepness)
        value += term
        gx -= ax
        gy -= ay
        hxx += bxx
        hxy += bxy
        hyy += byy
    at += np.uint64(3) * circles
    sums = carray(scratch_buffer(BUFFER), BUFFER)
    for first in range(np.uint64(0), polygons, np.uint64(LANES)):
        for i in range(BUFFER):
            sums[i] = 0.0
        row = at + first
        for _ in range(edges):
            for lane in range(LANES):
                i = np.uint64(lane)
                nx, ny = field[row + i], field[row + polygons + i]
                distance = nx * x + ny * y - field[row + polygons + polygons + i]
                # No shift by the largest distance is needed, because `exponential` does not overflow.
                weight = exponential((distance - radius) * steepness)
                sums[i] += weight
                sums[LANES + i] += weight * nx
                sums[2 * LANES + i] += weight * ny
                sums[3 * LANES + i] += weight * nx * nx
                sums[4 * LANES + i] += weight * nx * ny
                sums[5 * LANES + i] += weight * ny * ny
            row += np.uint64(3) * polygons
        for lane in range(LANES):
            i = np.uint64(lane)
            term = 1.0 / sums[i]
            mx, my = sums[LANES + i] * term, sums[2 * LANES + i] * term
            sxx, sxy, syy = sums[3 * LANES + i] * term, sums[4 * LANES + i] * term, sums[5 * LANES + i] * term
            ax, ay, bxx, bxy, byy = polygon_derivatives(mx, my, sxx, sxy, syy, term, steepness)
            value += term
            gx -= ax
            gy -= ay
            hxx += bxx
            hxy += bxy
            hyy += byy
    return k * value, k * gx, k * gy, k * hxx, k * hxy, k * hyy
