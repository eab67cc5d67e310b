"""Manoeuvres in narrow places: hybrid A*, adaptive meshes, and the optima that they lead to."""

import math

import numpy as np
import pytest

from leapnav.envs import Box, Car, Cost, DynamicCar, Obstacle, Polygon, Scenario, Trailer, sample_scenario
from leapnav.envs.field.clearance import path_clearance
from leapnav.envs.robots.footprints import corners_of
from leapnav.experts import OptimalControlProblem, find_optimum, minimum_time
from leapnav.experts.search.local_optima import LocalOptima
from leapnav.experts.search.manoeuvres import manoeuvres
from leapnav.experts.transcription.adaptive import settle

LENGTH, WIDTH = 4.7, 1.94
CAR = Car(
    footprint=Box(length=LENGTH, width=WIDTH, offset=1.4),
    wheelbase=2.8,
    max_steering=0.75,
    max_speed=2.5,
    max_steering_rate=0.54,
    steering_weight=1.0,
)

SOFT = Cost(time_weight=1.0, speed_weight=0.16, proximity_weight=1.0, proximity_scale=0.05)
HARD = Cost(time_weight=1.0, speed_weight=0.16, proximity_weight=0.0, proximity_scale=0.05)
DYNAMIC_CAR = DynamicCar(
    footprint=CAR.footprint,
    wheelbase=2.8,
    max_steering=0.75,
    max_speed=2.5,
    max_steering_rate=0.54,
    steering_weight=1.0,
    max_acceleration=1.0,
)


def rectangle(x, y, length, width):
    vertices = ((x, y), (x + length, y), (x + length, y + width), (x, y + width))
    return Obstacle(polygon=Polygon(vertices=vertices))


def parallel_parking(spare, **options):
    """A gap between two parked cars that is longer than the car by `spare` (m), at a kerb."""
    gap = LENGTH + spare
    return Scenario(
        arena=(-12, -4, 12, 9),
        start=(-6.0, 2.2, 0.1),
        goal=(-1.4, -WIDTH / 2 - 0.25, 0.0),
        obstacles=(
            rectangle(-gap / 2 - LENGTH, -WIDTH - 0.2, LENGTH, WIDTH),
            rectangle(gap / 2, -WIDTH - 0.2, LENGTH, WIDTH),
            rectangle(-12, -2.9, 24, 0.4),
            rectangle(-12, 7.0, 24, 0.4),
        ),
        **{"robot": CAR, "horizon": None, "cost": SOFT, **options},
    )


def overlaps(corners, rectangle):
    """Whether a convex polygon (4, 2) overlaps an axis-parallel rectangle, by separating axes."""
    low, high = rectangle.min(axis=0), rectangle.max(axis=0)
    if (corners.max(axis=0) <= low).any() or (corners.min(axis=0) >= high).any():
        return False
    edges = np.diff(np.vstack([corners, corners[:1]]), axis=0)[:2]
    for normal in np.column_stack([-edges[:, 1], edges[:, 0]]):
        first, second = corners @ normal, rectangle @ normal
        if first.max() <= second.min() or second.max() <= first.min():
            return False
    return True


@pytest.fixture(scope="module")
def scenario():
    return parallel_parking(1.3)


@pytest.fixture(scope="module")
def guess(scenario):
    return next(manoeuvres(scenario))


def test_a_manoeuvre_follows_the_dynamics_without_contact(scenario, guess):
    problem = OptimalControlProblem.from_scenario(scenario)
    drift, fields = problem.dynamics((guess.states[1:] + guess.states[:-1]) / 2)
    rates = drift + np.einsum("kij,kj->ki", fields, guess.controls)
    np.testing.assert_allclose(np.diff(guess.states, axis=0), rates * np.diff(guess.times)[:, None], atol=1e-5)
    assert path_clearance(guess.states, scenario.outline, scenario.field) > 0.02
    np.testing.assert_allclose(guess.states[-1, :2], scenario.goal[:2], atol=1e-9)
    assert math.dist(guess.states[0, :2], scenario.start[:2]) < 0.2
    low, high = np.transpose(scenario.robot.control_bounds())
    assert (guess.controls > low).all() and (guess.controls < high).all()


def test_a_car_parks_in_a_gap_that_is_hardly_longer(scenario, guess):
    optima = LocalOptima(scenario, OptimalControlProblem.from_scenario(scenario), 1.0)
    optima.add_manoeuvres([guess])
    (optimum,) = optima.certified
    assert optimum.certificate.clearance > 0 and 15.0 < optimum.cost < 20.0
    states = optimum.evaluate(np.linspace(0, optimum.horizon, 2001))[0]
    parked = [np.array(obstacle.polygon.vertices) for obstacle in scenario.obstacles]
    assert not any(overlaps(corners_of(scenario.outline[0], q), polygon) for q in states for polygon in parked)
    assert np.count_nonzero(np.diff(np.sign(optimum.controls[:, 0])) != 0) >= 2  # it changes the driving mode


@pytest.mark.slow
def test_the_search_finds_the_manoeuvre(scenario):
    optimum = find_optimum(scenario)
    assert optimum.success and 15.0 < optimum.cost < 20.0


@pytest.mark.slow
def test_the_minimum_time_of_tight_parking_is_found():
    """The barrier decreases together with the control weights; Newton's method stalls if it is small from the start."""
    found = minimum_time(parallel_parking(1.2, robot=DYNAMIC_CAR, cost=HARD), 0.05)
    assert found.tolerance <= 0.05
    assert found.extremal.certificate.clearance > 0
    assert found.extremal.barrier <= 1e-3
    assert found.horizon < find_optimum(parallel_parking(1.2, robot=DYNAMIC_CAR, cost=HARD)).horizon


def test_a_door_is_passed_where_newtons_method_stalls_on_a_fixed_mesh():
    """A disc of radius 0.21 m and a door of 0.45 m, from the side."""
    left, right = ([[2.9, a], [3.1, a], [3.1, b], [2.9, b]] for a, b in ((0, 2.775), (3.225, 6)))
    scenario = Scenario.from_dict(
        {
            "arena": [0, 0, 6, 6],
            "robot": {"model": "unicycle", "radius": 0.21},
            "start": [1.5, 1.5, math.pi / 2],
            "goal": [4.5, 4.5, math.pi / 2],
            "horizon": 15,
            "obstacles": [{"polygon": {"vertices": left}}, {"polygon": {"vertices": right}}],
        }
    )
    optimum = find_optimum(scenario)
    assert optimum.success
    assert optimum.doubts == ()
    assert optimum.cost == pytest.approx(4.2145477, rel=1e-6)  # of `solve` from the same lattice


def test_meshes_are_fine_at_contacts_and_change_slowly(scenario, guess):
    problem = OptimalControlProblem.from_scenario(scenario).with_winding_of(guess.states)
    coarse, fine = (path for path, _ in zip(settle(problem, guess, 1.0), range(2), strict=False))
    for path, factor in ((coarse, 1.0), (fine, 0.5)):
        steps = np.diff(path.times)
        assert steps.max() <= 1.01 * factor * path.times[-1] / 150
        assert steps.min() < 0.2 * steps.max()
        assert np.abs(np.diff(steps) / steps[1:]).max() < 0.2 * factor
    assert abs(fine.slope(problem)) < 0.03 * fine.cost  # the derivative with respect to the horizon


def test_a_fixed_horizon_is_kept():
    scenario = parallel_parking(2.5, horizon=18.0)
    problem, paths = OptimalControlProblem.from_scenario(scenario), []
    for guess in manoeuvres(scenario):
        paths = list(settle(problem.with_winding_of(guess.states), guess, 1.0))
        break
    assert paths and all(path.times[-1] == pytest.approx(18.0, rel=1e-12) for path in paths)


def test_a_dynamic_car_brakes_before_it_changes_its_steering():
    robot = DynamicCar(**{**CAR.model_dump(exclude={"model"}), "footprint": CAR.footprint, "max_acceleration": 1.0})
    scenario = parallel_parking(1.3, robot=robot)
    guess = next(manoeuvres(scenario))
    steers = guess.controls[:, 1] != 0
    assert np.abs(guess.states[:-1][steers, 4]).max() < 1e-9 and np.abs(guess.controls[:, 0]).max() <= 0.7 + 1e-9
    problem = OptimalControlProblem.from_scenario(scenario)
    drift, fields = problem.dynamics((guess.states[1:] + guess.states[:-1]) / 2)
    rates = drift + np.einsum("kij,kj->ki", fields, guess.controls)
    np.testing.assert_allclose(np.diff(guess.states, axis=0), rates * np.diff(guess.times)[:, None], atol=1e-4)


@pytest.mark.parametrize(
    "robot",
    [
        Car(steering_rate=(0.0, 1.0)),  # it steers to one side only
        Car(speed=(0.2, 1.0)),  # it cannot stop
        DynamicCar(acceleration=(0.0, 1.0)),  # it cannot slow down
        Trailer(),
    ],
)
def test_there_are_no_manoeuvres_of_cars_without_all_controls(robot):
    assert not list(manoeuvres(sample_scenario("clutter", 1, robot)))


def test_there_are_no_manoeuvres_of_other_robots_or_across_large_arenas():
    assert not list(manoeuvres(sample_scenario("clutter", 1)))
    far = Scenario(arena=(0, 0, 300, 300), robot=CAR, start=(10, 10, 0), goal=(290, 290, 0), horizon=300.0)
    assert not list(manoeuvres(far))
