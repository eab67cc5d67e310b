"""The barrier function of the proximity cost and of the limits of states (kernels).

b(s) = 1 / (exp(s) - 1) of a distance s in units of the scale: exp(-s) far away, 1 / s near contact. No path of finite
cost comes into contact. Its derivatives are b' = -b (1 + b) and b'' = b (1 + b) (1 + 2 b). Below a smallest distance,
by default CONTACT, it continues as a quadratic polynomial, so that an initial guess in collision has a finite cost that
decreases outwards.
"""

from __future__ import annotations

import math

from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.numba_internals import power_of_two
from leapnav.envs.kernels.types import tuple_of

CONTACT = 5e-4  # scales, below which the barrier continues as a quadratic polynomial

# exp(x) = 2^k exp(r), with an integer k and |r| <= log(2) / 2. A double above 2^52 is an integer, and its last bits are
# those of k.
MIN_EXPONENT = -708.0  # of the smallest double with full precision
INTEGER_SHIFT = 1.5 * 2.0**52
BIAS = 1023.0  # of a double's exponent
LOG2_HIGH = 0.693145751953125  # few bits, so that its product with k is exact
LOG2_LOW = 1.42860682030941723212e-6


# exp() of the C library is scalar, and prevents that loops over obstacles are vectorized. Products and sums may be
# fused but not reordered, since INTEGER_SHIFT is added and subtracted again.
@kernel(tuple_of(*[float64] * 2)(float64), fastmath={"contract"})
def exponential(x):
    """Return exp(x) and exp(x) - 1 with relative errors of 1e-15, for x <= 0; x is at least MIN_EXPONENT."""
    x = MIN_EXPONENT if x < MIN_EXPONENT else x
    shifted = x * (1.0 / math.log(2.0)) + (INTEGER_SHIFT + BIAS)
    k = shifted - (INTEGER_SHIFT + BIAS)
    r = (x - k * LOG2_HIGH) - k * LOG2_LOW
    # The series of exp(r) - 1, grouped so that the products are independent of each other.
    square = r * r
    fourth = square * square
    low = r + square * (1.0 / 2.0 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + square * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + square * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    highest = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0)
    series = low + fourth * (middle + fourth * (high + fourth * highest))
    power = power_of_two(shifted)
    return power + power * series, (power - 1.0) + power * series


@kernel(tuple_of(*[float64] * 3)(float64, float64), fastmath={"contract"})
def barrier(s, contact):
    """Return b(s) and its first and second derivative; below `contact` it is a quadratic polynomial."""
    inside = s if s > contact else contact
    e, minus_one = exponential(-inside)
    b = e / -minus_one
    slope = -b * (1.0 + b)
    bend = -slope * (1.0 + 2.0 * b)
    beyond = s - inside  # zero above `contact`
    return b + beyond * (slope + 0.5 * beyond * bend), slope + beyond * bend, bend


@kernel(float64(float64, float64))
def barrier_value(s, contact):
    """Return b(s), as `barrier` to 1e-12, in less time."""
    if s < contact:
        return barrier(s, contact)[0]
    return 1.0 / (math.exp(s) - 1.0)
