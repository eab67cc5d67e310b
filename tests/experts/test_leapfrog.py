from dataclasses import replace

import numpy as np
import pytest
from helpers import best_known, known_problems

from leapnav.envs import sample_scenario
from leapnav.experts import Trajectory, find_optimum, solve
from leapnav.experts.numerics.integrator import propagate

SCENARIOS = {s.name: (s, cost) for s, cost in best_known()}


def state_defect(problem, times, nodes):
    """Return the largest defect of the states at the nodes, boundary conditions included."""
    n, arrays = problem.system.n, problem.arrays
    found = [np.abs(nodes[0, :n] - arrays.start).max()]
    found.append(np.abs(np.where(arrays.free, nodes[-1, n:], nodes[-1, :n] - arrays.goal)).max())
    for k in range(len(times) - 1):
        z, none = nodes[k].copy(), np.empty((2 * n, 0))
        propagate(arrays.flow, z, none, times[k + 1] - times[k], 1e-13, 0.0, False)
        found.append(np.abs(z[:n] - nodes[k + 1, :n]).max())
    return max(found)


@pytest.mark.parametrize("polish", [True, False])
@pytest.mark.parametrize("order", ["sequential", "red_black"])
@pytest.mark.parametrize("update", ["mean_time", "half_cost"])
@pytest.mark.parametrize(
    "name", ["clutter-3", "polygons-9", *(pytest.param(f"clutter-{k}", marks=pytest.mark.slow) for k in (0, 9))]
)
def test_every_path_of_leapfrog_is_feasible_and_its_cost_never_rises(name, update, order, polish):
    scenario, _ = SCENARIOS[name]
    extremal = solve(scenario, method="leapfrog", update=update, order=order, polish=polish)
    assert extremal.success
    sweeps = [row for row in extremal.history if row.phase in ("sweep", "reduce")]
    assert len(sweeps) >= 2
    assert np.all(np.diff([row.cost for row in sweeps]) <= 1e-12)
    assert extremal.cost <= sweeps[-1].cost + 1e-8
    for row in sweeps:
        assert len(row.times) == row.segments + 1
        assert np.all(np.diff(row.times) > 0)
        # Along arcs of several seconds, which occur only after nodes were removed, rounding errors grow by 1e4.
        assert state_defect(extremal.problem, row.times, row.nodes) <= (1e-9 if polish else 1e-8)
        assert row.residual == pytest.approx(state_defect(extremal.problem, row.times, row.nodes), abs=1e-9)
    if update == "half_cost":
        assert not np.allclose(sweeps[1].times, sweeps[0].times)
    if not polish:
        assert min(row.segments for row in sweeps) <= 4


@pytest.mark.parametrize("name", ["clutter-0", "clutter-9", "rooms-11", "slalom-4"])
def test_leapfrog_and_multiple_shooting_find_the_same_extremal_of_a_scenario(name):
    scenario, _ = SCENARIOS[name]
    reference = find_optimum(scenario)
    assert reference.success
    again = solve(scenario, method="multiple_shooting", guess=reference)
    assert again.cost == pytest.approx(reference.cost, rel=1e-9)
    leapfrog = solve(scenario, method="leapfrog", guess=Trajectory(reference.times, reference.states))
    assert leapfrog.success
    assert leapfrog.cost == pytest.approx(reference.cost, rel=1e-9)


@pytest.mark.slow
def test_a_hundred_scenarios_feasible_at_every_sweep_and_cheaper_with_each():
    certified = 0
    for seed in range(600, 700):
        extremal = solve(sample_scenario("clutter", seed=seed), method="leapfrog")
        sweeps = [row for row in extremal.history if row.phase in ("sweep", "reduce")]
        assert np.all(np.diff([row.cost for row in sweeps]) <= 1e-12)
        assert max(row.residual for row in sweeps) <= 1e-9
        assert max(state_defect(extremal.problem, row.times, row.nodes) for row in sweeps) <= 1e-9
        if extremal.success:
            certified += 1
            assert extremal.certificate.hamiltonian_drift <= 1e-8
            assert extremal.cost <= sweeps[-1].cost + 1e-8
    # The others are in contact with an obstacle, or are saddles; find_optimum takes another path there.
    assert certified >= 95


def test_nodes_are_removed_when_a_sweep_gains_nothing():
    # The first path costs 10,000 times as much as the optimum, and some of its nodes cannot be moved.
    (entry,) = (
        entry for entry in known_problems() if entry.name == "cart-pole-swing-up" and entry.method == "leapfrog"
    )
    extremal = solve(replace(entry.problem, control_bounds=None), "leapfrog")
    assert extremal.success
    phases = [row.phase for row in extremal.history]
    assert "reduce" in phases[: phases.index("newton")]
    assert phases.count("sweep") < 16
