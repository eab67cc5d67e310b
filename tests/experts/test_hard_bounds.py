"""Lower bounds at a small proximity weight and with hard obstacles."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers import DISC_AND_TRIANGLE as SCENARIO

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts import check_proof, find_optimum, lower_bound
from leapnav.experts.proofs.proof import ProofError


@pytest.mark.parametrize(
    ("weight", "horizon", "gap"),
    [(0.0, 6.5, 0.1), (0.0, None, 0.1), (0.01, None, 0.1), pytest.param(0.01, 6.5, 0.1, marks=pytest.mark.slow)],
)
def test_obstacles_may_cost_nothing_or_little(weight: float, horizon: float | None, gap: float):
    """With the proximity weight 0 only the collision-free paths count; their cost excludes the barrier."""
    cost = {"proximity_weight": weight, "time_weight": 0.5 if horizon is None else 0.0}
    scenario = Scenario.from_dict(SCENARIO.to_dict() | {"horizon": horizon, "cost": cost})
    optimum = find_optimum(scenario)
    assert optimum.success
    found = lower_bound(scenario, optimum, gap=gap)
    assert found.gap == pytest.approx(gap, abs=2e-3)
    assert found.duality_gap < 2e-3
    assert check_proof(found.proof) == found.value
    assert all(found.value <= local.cost for local in (optimum, *optimum.alternatives))


def test_a_passage_that_is_too_narrow_is_blocked_at_no_proximity_cost():
    """The bound excludes the straight path through a wall with a gap that is narrower than the robot."""
    blocks = (
        {"polygon": {"vertices": ((2.3, low), (2.7, low), (2.7, high), (2.3, high))}}
        for low, high in ((1.2, 2.26), (2.74, 3.8))
    )
    fields = SCENARIO.to_dict() | {"start": [0.8, 2.5, 0.0], "goal": [4.2, 2.5, 0.0], "cost": {"proximity_weight": 0.0}}
    scenario = Scenario.from_dict(fields | {"obstacles": ()})
    straight = find_optimum(scenario)
    blocked = Scenario.from_dict(fields | {"obstacles": tuple(blocks)})
    found = lower_bound(blocked, gap=0.25)
    assert found.gap == pytest.approx(0.25, abs=1e-6)
    assert found.value > 1.3 * straight.cost
    assert check_proof(found.proof) == found.value
    with pytest.raises(ProofError):
        check_proof(replace(found.proof, scenario=scenario))
