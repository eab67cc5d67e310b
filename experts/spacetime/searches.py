"""The searches over position and time of a scenario, one for each duration that is tried."""

from __future__ import annotations

import math

from leapnav.envs.field.packing import with_weight
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.search.local_optima import LocalOptima
from leapnav.experts.spacetime.candidates import SpaceTimeSearch

# Durations of the paths if the horizon is free, in units of the time of a straight line (s), at least `SHORTEST`.
HORIZON_FACTORS, SHORTEST = (1.0, 1.4, 2.0), 1.0


def time_searches(
    scenario: Scenario, problem: OptimalControlProblem, budget: float = math.inf, sharpness: float = 1.0
) -> tuple[LocalOptima, list[SpaceTimeSearch]]:
    """Return an empty collection of local optima, and searches over position and time, one for each horizon tried.

    Args:
        scenario, problem, budget, sharpness: see `LocalOptima`.

    """
    horizons = [problem.horizon]
    if problem.horizon is None:
        duration = max(math.dist(scenario.start[:2], scenario.goal[:2]) / scenario.cruise_speed, SHORTEST)
        horizons = [factor * duration for factor in HORIZON_FACTORS]
    assert problem.field is not None
    field = with_weight(problem.field, problem.proximity_weight)
    searches = [SpaceTimeSearch(scenario, field, horizon) for horizon in horizons if horizon is not None]
    searches = [search for search in searches if search.cheapest < math.inf]
    energy = min((search.cheapest / search.horizon for search in searches), default=0.0)
    return LocalOptima(scenario, problem, energy, budget, sharpness), searches
