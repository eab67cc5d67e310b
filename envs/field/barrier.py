"""The barrier function of the proximity cost and of the limits of states (kernels).

b(s) = 1 / (exp(s) - 1) of a distance s in units of the scale: exp(-s) far away, 1 / s near contact. No path of finite
cost comes into contact. Its derivatives are b' = -b (1 + b) and b'' = b (1 + b) (1 + 2 b). Below a smallest distance,
by default CONTACT, it continues as a quadratic polynomial, so that an initial guess in collision has a finite cost that
decreases outwards.

exp(-s) - 1 is computed without a call of the C library, so that the compiler can vectorise a loop over obstacles:
u = exp(-s / 16) - 1 from its Taylor polynomial, and four times exp(2x) - 1 = u (2 + u).
"""

from __future__ import annotations

from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import tuple_of

# Distance (scales) below which the barrier continues as a quadratic polynomial, for discs and for rectangles. A stored
# path in single precision may lie below it: with 5e-5 for discs, multiple shooting fails from 28 of 800 stored paths,
# with 5e-4 from 6. The corner of a rectangle passes a vertex at a smaller distance: with 5e-4 for rectangles, the
# continuation to hard obstacles stalls in gaps that are 12 and 20 % wider than the robot.
CONTACT, CORNER_CONTACT = 5e-4, 5e-5
LARGEST_ARGUMENT = 40.0  # distance (scales) above which b has the value there, 2e-16


@kernel(float64(float64), forceinline=True, fastmath={"contract"})
def negative_expm1(s):
    """Return exp(-s) - 1 for s from 0 to LARGEST_ARGUMENT, with a relative error of 1e-15."""
    x = -0.0625 * s
    x2 = x * x
    x4 = x2 * x2
    low = (1.0 + x * (1 / 2)) + x2 * (1 / 6 + x * (1 / 24))
    middle = (1 / 120 + x * (1 / 720)) + x2 * (1 / 5040 + x * (1 / 40320))
    high = (1 / 362880 + x * (1 / 3628800)) + x2 * (1 / 39916800 + x * (1 / 479001600))
    u = x * (low + x4 * (middle + x4 * high))
    for _ in range(4):
        u *= 2.0 + u
    return u


@kernel(tuple_of(*[float64] * 3)(float64, float64), forceinline=True, fastmath={"contract"})
def barrier(s, contact):
    """Return b(s), with a relative error of 1e-14 or an absolute one of 2e-15, and its first and second derivative.

    Below `contact` it is a quadratic polynomial.
    """
    inside = s if s > contact else contact
    b = -1.0 - 1.0 / negative_expm1(inside if inside < LARGEST_ARGUMENT else LARGEST_ARGUMENT)
    slope = -b * (1.0 + b)
    bend = -slope * (1.0 + 2.0 * b)
    beyond = s - inside  # zero above `contact`
    return b + beyond * (slope + 0.5 * beyond * bend), slope + beyond * bend, bend
