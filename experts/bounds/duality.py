"""The energy E of a lower bound with a fixed horizon, and what no energy can prove.

The bound is at most d(E) - (E - c) T, where d(E) is the minimum of J + (E - c) T over paths of any duration T: the
minimum cost with a free horizon and the time weight E. It is a concave function of E with the slope T(E) - T, where
T(E) is the duration of that minimum, and its maximum is the convex envelope of T -> J*(T) at T. It equals J*(T) unless
T lies under a common tangent of two branches, between whose durations T(E) jumps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.optimum import Optimum, find_optimum

CLOSE = 1e-3  # relative duality gap below which the energy of the optimum is kept
MAX_STEPS, STEP, TOLERANCE = 12, 1.3, 1e-3  # of the search for the best energy: factors, and relative width of its end


class Dual(NamedTuple):
    """The best energy that was found.

    Attributes:
        energy: E.
        gap: estimate of the relative duality gap, at least 0: no E proves a smaller gap, if the best known paths with a
            free horizon are the optima.

    """

    energy: float
    gap: float


def best_energy(scenario: Scenario, cost: float, energy: float) -> Dual:
    """Return the energy with the largest bound.

    Args:
        scenario: a scenario with a fixed horizon.
        cost: cost of its optimum.
        energy: kinetic energy minus proximity cost on its optimum, positive.

    """
    assert scenario.horizon is not None
    weight = scenario.cost.time_weight
    best = Dual(energy, math.inf)
    low, high = 0.0, math.inf
    for _ in range(MAX_STEPS):
        relaxed = free_optimum(scenario, energy)
        if not relaxed.success:
            break
        gap = max(0.0, 1.0 - (relaxed.cost - (energy - weight) * scenario.horizon) / cost)
        if gap < best.gap:
            best = Dual(energy, gap)
        if best.gap < CLOSE:
            break
        if relaxed.horizon > scenario.horizon:
            low = energy
        else:
            high = energy
        if high < low * (1 + TOLERANCE):
            break
        if low == 0.0:
            energy /= STEP
        else:
            energy = low * STEP if math.isinf(high) else (low + high) / 2
    return best if math.isfinite(best.gap) else Dual(best.energy, 0.0)


def free_optimum(scenario: Scenario, energy: float) -> Optimum:
    """Return the optimum with a free horizon and the time weight `energy`."""
    fields = {name: getattr(scenario, name) for name in type(scenario).model_fields}
    cost = scenario.cost.model_copy(update={"time_weight": energy})
    return find_optimum(Scenario(**{**fields, "horizon": None, "cost": cost}))
