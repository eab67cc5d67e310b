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
from leapnav.envs.kernels.types import tuple_of

# Distance (scales) below which the barrier continues as a quadratic polynomial, for discs and for rectangles. A stored
# path in single precision may lie below it: with 5e-5 for discs, multiple shooting fails from 28 of 800 stored paths,
# with 5e-4 from 6. The corner of a rectangle passes a vertex at a smaller distance: with 5e-4 for rectangles, the
# continuation to hard obstacles stalls in gaps that are 12 and 20 % wider than the robot.
CONTACT, CORNER_CONTACT = 5e-4, 5e-5


@kernel(tuple_of(*[float64] * 3)(float64, float64), forceinline=True)
def barrier(s, contact):
    """Return b(s), with a relative error of 1e-12, and its first and second derivative.

    Below `contact` it is a quadratic polynomial.
    """
    inside = s if s > contact else contact
    b = 1.0 / (math.exp(inside) - 1.0)
    slope = -b * (1.0 + b)
    bend = -slope * (1.0 + 2.0 * b)
    beyond = s - inside  # zero above `contact`
    return b + beyond * (slope + 0.5 * beyond * bend), slope + beyond * bend, bend
