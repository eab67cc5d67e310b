"""The factor by which all times of a path with a free horizon change."""

from __future__ import annotations

import math


def time_factor(cost: float, slope: float, smallest: float) -> float:
    """Return the factor s that minimises a cost of the form E / s + P s, limited to [smallest, 1 / smallest].

    The cost of a system without drift has this form if the path is fixed.

    Args:
        cost: the cost at s = 1, E + P.
        slope: its derivative at s = 1, P - E, the integral of the Hamiltonian.
        smallest: lower limit of the factor, in (0, 1).

    """
    if not cost > abs(slope):  # the cost is not of this form
        return smallest if slope > 0 else 1.0 / smallest
    return min(max(math.sqrt((cost - slope) / (cost + slope)), smallest), 1.0 / smallest)
