import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import ROBOTS, best_known, scenario_fields
from scipy.integrate import solve_ivp

from leapnav.envs import FAMILIES, Scenario, ScenarioBank, Unicycle, sample_scenario
from leapnav.experts import Status, find_optima, find_optimum, solve
from leapnav.experts.hard_limits import follow_best
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice, is_connected

BEST_KNOWN = best_known()


@pytest.mark.parametrize(("scenario", "cost"), BEST_KNOWN, ids=[s.name for s, _ in BEST_KNOWN])
def test_the_best_known_cost_is_reached(scenario, cost):
    extremal = find_optimum(scenario)
    assert extremal.success, (extremal.status, extremal.certificate)
    assert extremal.cost <= cost * 1.001
    assert extremal.certificate.residual <= 1e-8


@pytest.mark.parametrize("family", FAMILIES)
def test_fresh_scenarios_are_solved_and_certified(family):
    for seed in range(3):
        extremal = find_optimum(sample_scenario(family, 9000 + seed))
        assert extremal.success, (seed, extremal.status, extremal.certificate)
        certificate = extremal.certificate
        assert certificate.residual <= 1e-8
        assert certificate.defect <= 1e-8
        assert certificate.hamiltonian_drift <= 3e-8  # not a check of the certificate
        assert certificate.clearance > 0
        assert certificate.conjugate_point is None


def test_the_certificate_agrees_with_an_independent_integrator():
    """Each half second of the optimum, re-integrated by SciPy from its own dense states and costates."""
    for scenario, _ in BEST_KNOWN[::5]:
        extremal = find_optimum(scenario)
        extremal_flow = extremal.problem.arrays.flow
        dz, empty = np.empty(6), np.empty((6, 0))

        def flow(_, y, record=extremal_flow, dz=dz, empty=empty):
            running = record.function(y[:6], record.data, record.field, empty, dz, empty)
            return np.append(dz, running)

        times = np.append(np.arange(0, scenario.horizon, 0.5), scenario.horizon)
        states, _, costates = extremal.evaluate(times)
        total = 0.0
        for k in range(len(times) - 1):
            start = np.concatenate([states[k], costates[k], [0.0]])
            end = solve_ivp(flow, times[k : k + 2], start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
            assert end[:6] == pytest.approx(np.concatenate([states[k + 1], costates[k + 1]]), abs=1e-7)
            total += end[6]
        assert total == pytest.approx(extremal.cost, rel=1e-8)


def test_the_optimum_of_the_mirrored_scenario_is_the_mirrored_optimum():
    scenario = BEST_KNOWN[1][0]
    fields = scenario.to_dict()

    def mirror(pose):
        return [10.0 - pose[0], pose[1], np.pi - pose[2]]

    fields["start"], fields["goal"] = mirror(fields["start"]), mirror(fields["goal"])
    for obstacle in fields["obstacles"]:
        x, y = obstacle["circle"]["center"]
        obstacle["circle"]["center"] = [10.0 - x, y]
    assert find_optimum(Scenario.from_dict(fields)).cost == pytest.approx(find_optimum(scenario).cost, rel=1e-8)


def test_the_optimum_backwards_in_time_costs_the_same():
    scenario = BEST_KNOWN[2][0]
    fields = scenario.to_dict()
    fields["start"], fields["goal"] = fields["goal"], fields["start"]
    assert find_optimum(Scenario.from_dict(fields)).cost == pytest.approx(find_optimum(scenario).cost, rel=1e-8)


def test_the_same_scenario_gives_the_same_optimum_bit_for_bit():
    scenario = BEST_KNOWN[3][0]
    one, other = find_optimum(scenario), find_optimum(scenario)
    assert one.states.tobytes() == other.states.tobytes()
    assert one.cost == other.cost


@pytest.mark.parametrize("scale", [2e-3, 1e-3, 5e-4])
def test_an_obstacle_with_a_very_small_proximity_scale_is_avoided(scale):
    """Inside it the proximity cost is 1e40 and more, beyond any integer; the search once did not end."""
    scenario = Scenario.from_discs(
        [[7.0, 5.0, 1.0]],
        arena=(0.0, 0.0, 10.0, 10.0),
        start=(5.0, 5.0, 0.0),
        goal=(9.0, 5.0, 0.0),
        horizon=5.0,
        cost={"proximity_scale": scale},
    )
    optimum = find_optimum(scenario)
    assert optimum.success
    assert 3.15 < optimum.cost < 3.19


def test_the_work_for_alternatives_is_limited(monkeypatch):
    """Among hundreds of obstacles the alternatives would take most of the time; the optimum does not depend on them."""
    scenario = sample_scenario("clutter", 2)
    optimum = find_optimum(scenario)
    monkeypatch.setattr("leapnav.experts.optimum.ALTERNATIVES_BUDGET", 1)
    hasty = find_optimum(scenario)
    assert hasty.cost == optimum.cost
    assert [a.cost for a in hasty.alternatives] == [a.cost for a in optimum.alternatives[: len(hasty.alternatives)]]
    assert 1 <= len(hasty.alternatives) < len(optimum.alternatives)


def first_candidate(lattice):
    return next(CandidateSearch(lattice).candidates())


def test_candidates_are_distinct_and_in_order():
    candidates = [c for c, _ in zip(CandidateSearch(Lattice(BEST_KNOWN[0][0])).candidates(), range(6), strict=False)]
    assert [c.cost for c in candidates] == sorted(c.cost for c in candidates)
    for candidate in candidates:
        assert candidate.times[-1] == pytest.approx(BEST_KNOWN[0][0].horizon)
        assert candidate.poses[0] == pytest.approx(BEST_KNOWN[0][0].start)
        turn = candidate.poses[-1, 2] - BEST_KNOWN[0][0].goal[2]
        assert turn == pytest.approx(2 * np.pi * round(turn / (2 * np.pi)))


def test_other_arenas_and_robots_are_solved_too():
    # Three times larger in every length: the same problem in another unit.
    scenario = BEST_KNOWN[0][0]
    fields = scenario.to_dict()
    factor = 3.0
    fields["arena"] = [-5.0, -7.0, -5.0 + 10 * factor, -7.0 + 10 * factor]

    def move(point):
        return [-5.0 + factor * point[0], -7.0 + factor * point[1], *point[2:]]

    fields["start"], fields["goal"] = move(fields["start"]), move(fields["goal"])
    for obstacle in fields["obstacles"]:
        obstacle["circle"] = {
            "center": move(obstacle["circle"]["center"]),
            "radius": factor * obstacle["circle"]["radius"],
        }
    fields["robot"] |= {"radius": factor * 0.25, "max_speed": factor * 2.0}
    fields["cost"] |= {"proximity_scale": factor * 0.1, "speed_weight": 1.0 / factor**2}
    scaled = find_optimum(Scenario.from_dict(fields))
    assert scaled.success
    assert scaled.cost == pytest.approx(find_optimum(scenario).cost, rel=1e-9)


def changed(**changes):
    return Scenario.from_dict(scenario_fields(**changes))


@pytest.mark.parametrize(
    "scenario",
    [
        changed(obstacles=[], start=[1, 1, 0.0], goal=[1, 1.1, 0.0], horizon=5.0),
        changed(obstacles=[], start=[1, 1, 0.0], goal=[1, 1, 3.0], horizon=5.0),
        changed(obstacles=[], start=[0.5, 0.5, 0.0], goal=[1.5, 1.5, 0.0], horizon=5.0, arena=[0, 0, 2, 2]),
        changed(goal=[8.0, 8.0, 50.0]),
        changed(horizon=100.0),
    ],
    ids=["beside", "turn", "small arena", "many turns", "long horizon"],
)
def test_unusual_scenarios_are_solved_too(scenario):
    assert find_optimum(scenario).success


@pytest.mark.parametrize(
    ("scenario", "status"),
    [
        (changed(horizon=3.0), Status.HORIZON_TOO_SHORT),
        (changed(horizon=1e-9), Status.HORIZON_TOO_SHORT),
        (changed(obstacles=[{"polygon": {"vertices": [[4.9, 0], [5.1, 0], [5.1, 10], [4.9, 10]]}}]), Status.NO_PATH),
        # A passage of 0.4 m, for a robot of 0.5 m.
        (
            changed(
                obstacles=[
                    {"polygon": {"vertices": [[4.9, 0], [5.1, 0], [5.1, 4.8], [4.9, 4.8]]}},
                    {"polygon": {"vertices": [[4.9, 5.2], [5.1, 5.2], [5.1, 10], [4.9, 10]]}},
                ]
            ),
            Status.NO_PATH,
        ),
    ],
    ids=["too fast", "no time", "wall", "passage too narrow"],
)
def test_the_status_of_a_failure_is_its_reason(scenario, status):
    extremal = find_optimum(scenario)
    assert extremal.status is status
    assert not extremal.success


def test_a_goal_at_the_start_is_no_crash_and_no_wrong_success():
    extremal = find_optimum(changed(start=[1, 1, 0.0], goal=[1, 1, 0.0]))
    assert extremal.status is not Status.NO_PATH
    assert not extremal.success or extremal.certificate.residual <= 1e-8


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="effort: expected one of low, medium, high, got 'all'"):
        find_optimum(BEST_KNOWN[0][0], "all")


def test_another_path_class_is_searched_if_all_first_candidates_collide():
    extremal = find_optimum(sample_scenario("clutter", 40_040))
    assert extremal.success, extremal
    assert extremal.certificate.clearance > 0


def test_a_passage_slightly_too_narrow_does_not_exhaust_the_search():
    """Nearly all first candidates lead through a passage 0.14 m too narrow, where Newton's method mostly fails."""
    extremal = find_optimum(sample_scenario("polygons", 2_000_188))
    assert extremal.success, extremal


def test_walls_with_many_passages_slightly_too_narrow_are_avoided():
    """100 combinations of passages are on the straight line, and all are too narrow."""
    discs = [(x, y, 0.3) for x in (3.0, 5.0, 7.0) for y in np.arange(0.35, 8.5, 0.95)]
    robot = Unicycle(radius=0.2)
    scenario = Scenario.from_discs(
        discs, start=(1, 4, 0), goal=(9, 4, None), horizon=16, arena=(0, 0, 10, 10), robot=robot
    )
    optimum = find_optimum(scenario)
    assert optimum.success
    for x in (3.0, 5.0, 7.0):
        assert optimum.states[np.abs(optimum.states[:, 0] - x).argmin(), 1] > 8.4


def test_candidates_elsewhere_leave_the_first_ones():
    search = CandidateSearch(Lattice(BEST_KNOWN[0][0]))
    first = [c.poses for c in search.take(6)]
    others = [c.poses for c in search.take_elsewhere(4)]
    assert others
    known = np.concatenate(first)[:, :2]
    for poses in others:
        distances = np.linalg.norm(poses[:, None, :2] - known, axis=2).min(axis=1)
        assert distances.max() > 0.7
        known = np.concatenate([known, poses[:, :2]])


def test_a_partial_search_finds_the_same_candidates():
    for scenario, _ in BEST_KNOWN[::6]:
        lattice = Lattice(scenario)
        whole, partial = CandidateSearch(lattice), CandidateSearch(lattice, partial=True)
        assert partial.limit < whole.limit
        within = partial.take(100, partial.limit)
        assert within and max(c.cost for c in within) <= partial.limit < whole.limit  # nothing was extended
        for found in (within, partial.take(4)):
            for candidate, other in zip(found, whole.take(len(found)), strict=True):
                np.testing.assert_array_equal(candidate.poses, other.poses)
        assert partial.limit == whole.limit and len(partial.taken) == len(whole.taken)


def test_a_passage_hardly_wider_than_the_spacing_is_found():
    """Between the corner of a box and the wall, 0.12 m wider than the robot; the detour costs 4.04."""
    box = {"polygon": {"vertices": [[7.7916, 0.6194], [8.1972, 1.0661], [6.7359, 2.3929], [6.3303, 1.9462]]}}
    start, goal = [5.2894, 0.9761, 2.3663], [9.3039, 0.8405, -2.2572]
    scenario = Scenario.from_dict(scenario_fields(obstacles=[box], start=start, goal=goal, horizon=7.1))
    optimum = find_optimum(scenario)
    assert optimum.cost == pytest.approx(2.9689, rel=1e-4)
    assert optimum.driving_modes == ("backward",)


@pytest.mark.parametrize(("seed", "cost"), [(700_000, 4.80888), (710_085, 6.20218)])
def test_a_first_path_through_a_closed_passage_does_not_degenerate_the_metric(seed, cost):
    """Such a path takes nearly the horizon even at E = 0, and at E = 0 the metric is degenerate."""
    assert find_optimum(sample_scenario("clutter", seed)).cost <= cost


def test_a_goal_beside_an_island_of_the_lattice_is_reached():
    """One of the four cells around the goal is enclosed: no path leads from there to the start."""
    ring = [
        {"circle": {"center": [7.0 + 0.16 * np.cos(a), 7.0 + 0.16 * np.sin(a)], "radius": 0.09}}
        for a in np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    ]
    fields = scenario_fields(obstacles=ring, start=[1.0, 1.0, 0.0], goal=[6.803, 6.803, 0.0])
    fields["robot"] |= {"radius": 0.02}
    assert find_optimum(Scenario.from_dict(fields)).success


@pytest.mark.parametrize("gap", [1e-4, 1e-3, 1e-2])
def test_poses_in_a_corner_are_connected(gap):
    near, far = 0.25 + gap, 9.75 - gap
    assert is_connected(changed(obstacles=[], start=[near, near, -2.3], goal=[far, far, 2.0]))


def test_the_search_ends_for_a_very_small_turn_weight():
    assert find_optimum(changed(cost={"turn_weight": 1e-3})).success
    lattice = Lattice(changed(cost={"turn_weight": 1e-7}))
    assert first_candidate(lattice).cost > 0


def test_far_walls_change_neither_the_optimum_nor_the_cells():
    fields = sample_scenario("clutter", 2).to_dict()
    costs = []
    for reach in (50.0, 100_000.0):
        fields["arena"] = [-reach, -reach, 10.0 + reach, 10.0 + reach]
        costs.append(find_optimum(Scenario.from_dict(fields)).cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)
    assert Lattice(Scenario.from_dict(fields)).cell == pytest.approx(0.2)


def test_a_detour_beyond_the_cropped_lattice_is_found():
    wall = [{"polygon": {"vertices": [[4.0, -99.0], [6.0, -99.0], [6.0, 32.0], [4.0, 32.0]]}}]
    fields = scenario_fields(arena=[-100, -100, 100, 100], obstacles=wall, horizon=80.0)
    assert Lattice(Scenario.from_dict(fields)).cropped
    optimum = find_optimum(Scenario.from_dict(fields))
    assert optimum.success
    assert optimum.states[:, 1].max() > 32.0


def test_a_direct_path_that_has_not_converged_may_lead_to_the_optimum():
    """Its cost, 5 % higher than that of the best extremal so far, is not reliable."""
    bank = ScenarioBank.shipped("clutter", "test", "dynamic_unicycle")
    assert find_optimum(bank[78], "medium").cost == pytest.approx(bank.costs[78], rel=1e-9)


@pytest.mark.parametrize(
    ("family", "robot"), [("clutter", "unicycle"), ("rooms", "unicycle"), ("slalom", "unicycle"), ("clutter", "car")]
)
def test_the_search_without_alternatives_finds_the_same_optimum(family, robot):
    bank = ScenarioBank.shipped(family, "test", robot)
    omitted = 0
    for index in range(0, len(bank), 25):
        best = find_optimum(bank[index], "medium")
        whole = find_optimum(bank[index])
        assert best.cost == pytest.approx(whole.cost, rel=1e-9)
        omitted += len(whole.alternatives) - len(best.alternatives)
    assert omitted > 0


def test_the_optima_of_many_scenarios_do_not_depend_on_the_number_of_processes():
    scenarios = [sample_scenario("clutter", seed) for seed in range(4)]
    scenarios.append(scenarios[0].model_copy(update={"horizon": 0.1}))
    one, two = (find_optima(scenarios, workers=workers, progress=False) for workers in (1, 2))
    assert [optimum.to_dict() for optimum in one] == [optimum.to_dict() for optimum in two]
    assert [optimum.cost for optimum in one[:4]] == [find_optimum(scenario).cost for scenario in scenarios[:4]]
    assert one[-1].status is Status.HORIZON_TOO_SHORT
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        find_optima(scenarios, workers=0)
    with pytest.raises(TypeError, match="problem: expected a Scenario"):
        find_optima([None], progress=False)


HARD_FAMILIES = ["clutter", "polygons", "rooms", "slalom"]


@pytest.mark.parametrize("family", HARD_FAMILIES)
@pytest.mark.parametrize("count", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_the_optimal_cost_decreases_with_the_proximity_weight(family, count):
    """A path that is the best for one weight costs less with a smaller one; all keep their distance from obstacles."""
    for seed in range(11, 11 + count):
        scenario, costs = sample_scenario(family, seed), []
        for weight in (1.0, 0.1, 0.01, 0.0):
            optimum = find_optimum(with_weight(scenario, weight), "medium")
            assert optimum.success and optimum.certificate.clearance > 0
            assert optimum.barrier <= (1e-3 if weight == 0.0 else 0.0)
            costs.append(optimum.cost)
        assert (np.diff(costs) < 0.0).all()


def test_the_cost_of_the_hard_problem_excludes_the_barrier():
    scenario = with_weight(sample_scenario("rooms", 11), 0.0)
    for tolerance in (1e-2, 1e-4):
        optimum = find_optimum(scenario, "medium", barrier_tolerance=tolerance)
        times = np.linspace(0.0, optimum.horizon, 20_001)
        controls = optimum.evaluate(times)[1]
        effort = 0.5 * (controls**2) @ np.array(optimum.problem.control_weight)
        assert optimum.cost == pytest.approx(np.trapezoid(effort, times), rel=1e-6)
        assert 0.0 < optimum.barrier <= tolerance
        assert optimum.cost_to_go(0.0) == pytest.approx(optimum.cost)
        assert optimum.cost_to_go(optimum.horizon) == pytest.approx(0.0, abs=1e-9)


def test_the_hard_optimum_does_not_depend_on_the_scale_of_the_barrier():
    scenario = sample_scenario("clutter", 12)
    costs = []
    for scale in (0.05, 0.1, 0.2):
        cost = scenario.cost.model_copy(update={"proximity_weight": 0.0, "proximity_scale": scale})
        found = find_optimum(scenario.model_copy(update={"cost": cost}), barrier_tolerance=1e-4)
        costs.append(found.cost)
    assert costs[1:] == pytest.approx(costs[:1] * 2, rel=2e-4)


def test_the_hard_optimum_around_a_disc_is_the_shortest_path():
    """With a small turn weight the path is taut: two tangents and an arc around the disc and the robot."""
    disc, radius, distance = 1.0, 0.25, 3.0
    fields = scenario_fields(
        arena=[0, 0, 10, 10],
        obstacles=[{"circle": {"center": [5.0, 5.0], "radius": disc}}],
        start=[5.0 - distance, 5.0, 0.0],
        goal=[5.0 + distance, 5.0, None],
        horizon=10.0,
    )
    fields["start"][2] = math.asin((disc + radius) / distance)  # along the tangent
    fields["cost"] = {"speed_weight": 1.0, "turn_weight": 1e-3, "proximity_weight": 0.0, "proximity_scale": 0.1}
    optimum = find_optimum(Scenario.from_dict(fields))
    around = disc + radius
    tangent = math.sqrt(distance**2 - around**2)
    length = 2 * tangent + around * (math.pi - 2 * math.acos(around / distance))
    assert optimum.success
    assert optimum.cost == pytest.approx(0.5 * length**2 / 10.0, rel=5e-3)


@pytest.mark.parametrize(
    "robot", [pytest.param(name, marks=pytest.mark.slow) if name == "dynamic_car" else name for name in ROBOTS]
)
def test_a_large_time_weight_leads_to_no_collision(robot):
    scenario = sample_scenario("clutter", 21, robot=robot, horizon="free")
    cost = scenario.cost.model_copy(update={"time_weight": 16.0})
    assert find_optimum(scenario.model_copy(update={"cost": cost}), "low").success


def test_the_search_is_repeated_where_the_continuation_stalls(monkeypatch):
    scenario = with_weight(sample_scenario("clutter", 13), 0.0)
    expected, weights = find_optimum(scenario), []

    def stalls_first(extremals, *arguments, **options):
        weights.append(extremals[0].problem.barrier_weight)
        if len(weights) == 1:
            return [replace(extremals[0], status=Status.STALLED)]
        return follow_best(extremals, *arguments, **options)

    monkeypatch.setattr("leapnav.experts.optimum.follow_best", stalls_first)
    found = find_optimum(scenario)
    assert found.success and found.barrier <= 1e-3
    assert found.cost == pytest.approx(expected.cost, rel=1e-3)
    assert weights[1] == pytest.approx(0.09 * weights[0])


def test_the_methods_solve_a_scenario_with_hard_obstacles():
    scenario = with_weight(sample_scenario("clutter", 13), 0.0)
    expected = find_optimum(scenario, "medium")
    for method in ("multiple_shooting", "leapfrog", "collocation"):
        found = solve(scenario, method)
        assert found.success and found.barrier <= 1e-3
        assert found.cost == pytest.approx(expected.cost, rel=2e-3)
    again = solve(scenario, "multiple_shooting", guess=expected)
    assert again.success and again.cost == pytest.approx(expected.cost, rel=1e-6)


def with_weight(scenario, weight):
    cost = scenario.cost.model_copy(update={"proximity_weight": weight})
    return scenario.model_copy(update={"cost": cost})
