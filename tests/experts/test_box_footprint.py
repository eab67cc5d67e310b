"""The search for robots with a rectangular footprint."""

import math

import numpy as np
import pytest
from helpers import info_of_plan

from leapnav.envs import Box, Capsule, Cost, Obstacle, Polygon, Scenario, Unicycle, sample_scenario
from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.robots.footprints import corners_of
from leapnav.experts import OptimalControlProblem, find_optimum, minimum_time, solve

BOX = Box(length=0.5, width=0.25)


def wall_with_gap(width, start, goal, weight=0.0, **options):
    low, high = 2 - width / 2, 2 + width / 2
    walls = [[(2.9, 0.0), (3.1, 0.0), (3.1, low), (2.9, low)], [(2.9, high), (3.1, high), (3.1, 4.0), (2.9, 4.0)]]
    return Scenario(
        arena=(0, 0, 6, 4),
        robot=Unicycle(footprint=BOX),
        start=start,
        goal=goal,
        horizon=10.0,
        obstacles=tuple(Obstacle(polygon=Polygon(vertices=tuple(wall))) for wall in walls),
        cost=Cost(proximity_weight=weight),
        **options,
    )


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def overlap(first, second):
    """Whether two convex polygons overlap, by their edges: independent of the kernels."""
    for one, other in ((first, second), (second, first)):
        for a, b in zip(one, np.roll(one, -1, axis=0), strict=True):
            normal = np.array([b[1] - a[1], a[0] - b[0]]) * (1 if cross(one[1] - one[0], one[2] - one[1]) > 0 else -1)
            if min((point - a) @ normal for point in other) > 0:
                return False
    return True


def touches(scenario, states):
    vertices = [part.rounded_polygon()[0] for obstacle in scenario.obstacles for part in obstacle.shape.parts()]
    return any(overlap(corners_of(scenario.outline[0], q), polygon) for q in states for polygon in vertices)


@pytest.mark.slow
def test_a_rectangle_passes_a_gap_that_is_hardly_wider():
    scenario = wall_with_gap(0.26, (1.5, 2.0, 0.0), (4.5, 2.0, 0.0))
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.barrier <= 1e-3
    assert optimum.cost == pytest.approx(3.0**2 / 10 / 2, rel=1e-3)  # straight ahead
    assert optimum.certificate.clearance == pytest.approx(0.005, abs=1e-6)
    assert not touches(scenario, optimum.evaluate(np.linspace(0, 10, 801))[0])


@pytest.mark.slow
def test_a_rectangle_passes_corners_on_its_way_through_a_gap():
    scenario = wall_with_gap(0.3, (1.5, 1.0, 0.5), (4.5, 3.0, 0.5))
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.barrier <= 1e-3 and 0 < optimum.certificate.clearance < 1e-3
    assert not touches(scenario, optimum.evaluate(np.linspace(0, 10, 2001))[0])


@pytest.mark.parametrize("obstacles", ["cost", pytest.param("hard", marks=pytest.mark.slow)])
def test_fresh_scenarios_with_a_rectangle(obstacles):
    for seed in range(8):
        scenario = sample_scenario("polygons", 60_000 + seed, robot=Unicycle(footprint=BOX), obstacles=obstacles)
        optimum = find_optimum(scenario, "medium")
        assert optimum.success
        states = optimum.evaluate(np.linspace(0, optimum.horizon, 401))[0]
        assert footprint_clearances(np.ascontiguousarray(states), scenario.outline, scenario.field).min() > 0
        assert not touches(scenario, states)


def test_the_environment_charges_the_cost_of_the_optimum():
    scenario = sample_scenario("polygons", 60_003, robot=Unicycle(footprint=BOX))
    optimum = find_optimum(scenario)
    info = info_of_plan(optimum, scenario)
    assert info["is_success"] and info["cost"] == pytest.approx(optimum.cost, rel=5e-3)


@pytest.mark.parametrize("method", ["multiple_shooting", "leapfrog", "collocation"])
def test_the_methods_solve_a_scenario_with_a_rectangle(method):
    capsule = {"capsule": {"start": [2.6, 2.0], "end": [3.4, 2.6], "radius": 0.15}}
    scenario = Scenario.from_dict(
        {
            "arena": [0, 0, 6, 4],
            "robot": {"model": "unicycle", "footprint": {"box": {"length": 0.5, "width": 0.25}}},
            "start": [1.0, 1.0, 0.3],
            "goal": [5.0, 2.0, 0.3],
            "horizon": 8.0,
            "obstacles": [capsule],
        }
    )
    expected = find_optimum(scenario)
    found = solve(scenario, method, guess=expected)
    assert found.success and found.cost == pytest.approx(expected.cost, rel=1e-6)
    assert isinstance(scenario.obstacles[0].shape, Capsule)


def test_a_robot_that_cannot_stop_turns_as_tightly_as_it_can():
    # A half turn with the radius 0.5 m between walls 1.7 m apart, in which the turns of a coarse lattice do not fit.
    robot = Unicycle(footprint=BOX, speed=(0.25, 0.5), turn_rate=(-0.5, 0.5))
    scenario = Scenario(
        arena=(0, 0, 1.7, 4),
        robot=robot,
        start=(0.3, 1.0, math.pi / 2),
        goal=(1.4, 1.0, -math.pi / 2),
        horizon=None,
        obstacles=(),
        cost=Cost(time_weight=1.0, speed_weight=4.0, turn_weight=4.0, proximity_weight=0.0, proximity_scale=0.02),
    )
    found = minimum_time(scenario, 0.02)
    assert found.extremal.success
    # The half turn at the largest turn rate takes 2 pi seconds.
    assert 2 * math.pi - 1e-9 < found.horizon < 2 * math.pi + 0.5


def test_the_footprint_of_a_problem_is_checked():
    scenario = wall_with_gap(0.5, (1.5, 2.0, 0.0), (4.5, 2.0, 0.0))
    problem = OptimalControlProblem.from_scenario(scenario)
    assert problem.footprint == BOX and problem.outline.tolist() == [[-0.25, 0.25, 0.125, 0.0, 0]]
    for footprint in ((), ((0.0, 0.2),), np.zeros((1, 2))):
        with pytest.raises(ValueError, match="footprint: expected discs or a box"):
            OptimalControlProblem(
                problem.system, problem.start, problem.goal, 5.0, (1.0, 1.0), field=problem.field, footprint=footprint
            )
