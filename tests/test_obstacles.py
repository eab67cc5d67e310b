import math

import numpy as np
import pytest
from helpers import best_known, scenario_fields

from leapnav.envs import Obstacle, Polygon, Scenario, Unicycle
from leapnav.envs.shapes.clearance import clearance, clearances
from leapnav.envs.shapes.proximity import proximity, proximity_value, proximity_values
from leapnav.envs.shapes.proximity_grid import MAX_EXPONENT, MIN_EXPONENT, exponential
from leapnav.envs.simulation.arcs import follow_arc

SCENARIOS = [best_known()[i][0] for i in (0, 11, 15, 17, 20)]  # discs, polygons, rooms, slalom


def plain_proximity(scenario, x, y):
    """The formulas of the design, without protection against overflow."""
    cost, radius = scenario.cost, scenario.robot.radius
    k, sigma = cost.proximity_weight, cost.proximity_scale
    x_min, y_min, x_max, y_max = scenario.arena
    total = sum(k * math.exp(-(d - radius) / sigma) for d in (x - x_min, x_max - x, y - y_min, y_max - y))
    for obstacle in scenario.obstacles:
        if obstacle.circle:
            cx, cy = obstacle.circle.center
            distance = math.sqrt((x - cx) ** 2 + (y - cy) ** 2 + 1e-6)
            total += k * math.exp(-(distance - obstacle.circle.radius - radius) / sigma)
        else:
            v = np.array(obstacle.polygon.vertices)
            centre = v.mean(axis=0)
            total_weight = 0.0
            for a, b in zip(v, np.roll(v, -1, axis=0), strict=True):
                normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
                normal *= np.sign(normal @ (a - centre))
                total_weight += math.exp((normal @ (np.array([x, y]) - a) - radius) / sigma)
            total += k / total_weight
    return total


def points(scenario, count, seed=0):
    x_min, y_min, x_max, y_max = scenario.arena
    return np.random.default_rng(seed).uniform((x_min, y_min), (x_max, y_max), (count, 2))


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_the_proximity_cost_is_the_formula(scenario):
    left_out = 1e-13 * scenario.cost.proximity_weight * (len(scenario.obstacles) + 4)  # each term below CUTOFF
    for x, y in points(scenario, 100):
        formula = plain_proximity(scenario, x, y)
        assert proximity(x, y, scenario.field)[0] == pytest.approx(formula, rel=1e-9, abs=left_out)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_gradient_and_hessian_agree_with_finite_differences(scenario):
    h = 1e-5
    for x, y in points(scenario, 100):
        _, gx, gy, hxx, hxy, hyy = values = proximity(x, y, scenario.field)
        right, left = (proximity(x + s, y, scenario.field) for s in (h, -h))
        above, below = (proximity(x, y + s, scenario.field) for s in (h, -h))
        differences = [(a[i] - b[i]) / (2 * h) for a, b, i in ((right, left, 0), (above, below, 0))]
        differences += [(right[1] - left[1]) / (2 * h), (right[2] - left[2]) / (2 * h), (above[2] - below[2]) / (2 * h)]
        # The difference quotient's own error, relative to the largest derivative there.
        assert [gx, gy, hxx, hxy, hyy] == pytest.approx(differences, rel=1e-5, abs=1e-6 * max(1, *map(abs, values)))


def test_the_proximity_cost_does_not_overflow_far_inside_or_far_away():
    wide = [[2.0, 2.0], [98.0, 2.0], [98.0, 98.0], [2.0, 98.0]]
    scenario = Scenario(
        arena=(0.0, 0.0, 100.0, 100.0),
        start=(1.0, 1.0, 0.0),
        goal=(99.0, 99.0, 0.0),
        horizon=1.0,
        obstacles=({"polygon": {"vertices": tuple(map(tuple, wide))}},),
    )
    assert np.isfinite(proximity(99.0, 99.0, scenario.field)).all()
    assert np.isfinite(proximity(30.0, 50.0, scenario.field)).all()


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_clearance_is_the_distance_to_the_nearest_rim(scenario):
    rims = []
    for obstacle in scenario.obstacles:
        fraction = np.linspace(0, 1, 4001)[:, None]
        if obstacle.circle:
            turn = 2 * np.pi * fraction
            rims.append(obstacle.circle.center + obstacle.circle.radius * np.hstack([np.cos(turn), np.sin(turn)]))
        else:
            v = np.array(obstacle.polygon.vertices)
            rims += [a + fraction * (b - a) for a, b in zip(v, np.roll(v, -1, axis=0), strict=True)]
    x_min, y_min, x_max, y_max = scenario.arena
    for x, y in points(scenario, 60):
        distance, _ = clearance(x, y, scenario.field)
        if distance < 0:  # inside something: only the sign is compared
            continue
        walls = min(x - x_min, x_max - x, y - y_min, y_max - y)
        nearest = min(walls, *(np.hypot(*(rim - (x, y)).T).min() for rim in rims)) - scenario.robot.radius
        assert distance == pytest.approx(nearest, abs=2e-3)  # the points of the rim are 2 mm apart


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_values_alone_and_by_three_are_those_with_derivatives(scenario):
    rng = np.random.default_rng(5)
    for x, y in points(scenario, 200, seed=2):
        dx, dy = rng.normal(0, 0.2, 2)
        three = (x - dx, y - dy), (x, y), (x + dx, y + dy)
        expected = [proximity(*point, scenario.field)[0] for point in three]
        assert [proximity_value(*point, scenario.robot.radius, scenario.field) for point in three] == pytest.approx(
            expected, abs=1e-9
        )
        found = proximity_values(*three[0], *three[1], *three[2], scenario.robot.radius, scenario.field)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_clearance_names_the_nearest_obstacle():
    scenario = SCENARIOS[0]
    for number, obstacle in enumerate(scenario.obstacles):
        distance, nearest = clearance(*obstacle.circle.center, scenario.field)
        assert nearest == number
        assert distance == pytest.approx(-obstacle.circle.radius - scenario.robot.radius)
    assert clearance(0.0, 5.0, scenario.field)[1] == len(scenario.obstacles)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_the_clearance_of_an_arc_is_the_smallest_of_its_points(scenario):
    rng = np.random.default_rng(3)
    fraction = np.linspace(0, 1, 5001)
    for x, y in points(scenario, 40, seed=1):
        heading, distance, turn = rng.uniform(-3, 3), rng.uniform(-1, 1), rng.uniform(-2, 2)
        chord = distance * fraction * np.sinc(turn * fraction / (2 * np.pi))
        middle = heading + turn * fraction / 2
        arc = np.stack([x + chord * np.cos(middle), y + chord * np.sin(middle)], axis=1)
        lowest = clearances(arc, scenario.field).min()
        before = clearance(x, y, scenario.field)[0]
        found, driven, after = follow_arc(x, y, heading, distance, turn, before, scenario.field)
        free = clearances(arc, scenario.field) > 0
        if driven == 1.0:
            assert free.mean() > 0.99  # the rest overlaps by less than a millimetre
            assert lowest - 1e-9 <= found <= max(lowest, 0.0) * 1.03 + 2e-3
            assert after == pytest.approx(clearance(*arc[-1], scenario.field)[0])
        else:
            assert found <= 0
            assert lowest <= 1e-9
            assert driven == pytest.approx(fraction[np.argmin(free)], abs=2e-3)  # the first contact
            assert before <= 0 or 0 <= after < 1e-3


def test_a_very_long_arc_through_a_wall_terminates():
    lowest, driven, _ = follow_arc(5.0, 5.0, 0.3, 1e9, 0.0, 1.0, SCENARIOS[0].field)
    assert lowest <= 0
    assert driven < 1e-8


def test_an_arc_does_not_jump_a_thin_obstacle():
    scenario = Scenario(
        arena=(0.0, 0.0, 10.0, 10.0),
        start=(1.0, 5.0, 0.0),
        goal=(9.0, 5.0, 0.0),
        horizon=1.0,
        obstacles=({"polygon": {"vertices": ((5.0, 0.0), (5.01, 0.0), (5.01, 10.0), (5.0, 10.0))}},),
    )
    lowest, driven, _ = follow_arc(1.0, 5.0, 0.0, 8.0, 0.0, 0.75, scenario.field)
    assert lowest <= 0
    assert 8.0 * driven == pytest.approx(4.0 - 0.25, abs=1e-4)


def many_obstacles(count, size, seed=0):
    """Discs and boxes scattered over a square arena, at least 4 m from the corners of start and goal."""
    rng = np.random.default_rng(seed)
    obstacles = []
    while len(obstacles) < count:
        x, y = rng.uniform(1.0, size - 1.0, 2)
        if min(math.hypot(x, y), math.hypot(size - x, size - y)) < 4.0:
            continue
        if len(obstacles) % 2:
            obstacles.append({"circle": {"center": [x, y], "radius": rng.uniform(0.1, 0.6)}})
        else:
            a, b = rng.uniform(0.2, 1.0, 2)
            vertices = [[x - a, y - b], [x + a, y - b], [x + a, y + b], [x - a, y + b]]
            obstacles.append({"polygon": {"vertices": vertices}})
    fields = scenario_fields(arena=[0, 0, size, size], obstacles=obstacles, goal=[size - 1.0, size - 1.0, 0.0])
    return Scenario.from_dict(fields)


@pytest.mark.parametrize(("count", "size"), [(40, 12.0), (100, 40.0), (300, 60.0), (200, 200.0)])
def test_a_grid_of_obstacles_changes_nothing(count, size):
    scenario = many_obstacles(count, size)
    rng = np.random.default_rng(1)
    # Also outside the arena, where an integrator may evaluate it.
    for x, y in rng.uniform(-6.0, size + 6.0, (300, 2)):
        expected = np.zeros(6)
        for part in range(0, count, 10):
            alone = scenario.model_copy(update={"obstacles": scenario.obstacles[part : part + 10]})
            expected += proximity(x, y, alone.field)
        walls = np.array(proximity(x, y, scenario.model_copy(update={"obstacles": ()}).field))
        expected -= (len(range(0, count, 10)) - 1) * walls
        scale = 1.0 + np.abs(expected).max() + np.abs(walls).max()
        # A skipped term is below 1e-13, and its derivatives below 10 times that, for a scale of 0.1 m.
        tolerance = 1e-12 * scale * np.array([1.0, 10.0, 10.0, 100.0, 100.0, 100.0])
        assert (np.abs(np.array(proximity(x, y, scenario.field)) - expected) <= tolerance).all()


def test_the_exponential_of_the_grid_is_exp():
    x = np.concatenate([np.linspace(MIN_EXPONENT, MAX_EXPONENT, 20_001), np.linspace(-1.0, 1.0, 20_001)])
    found = np.array([exponential(value) for value in x])
    np.testing.assert_allclose(found, np.exp(x), rtol=2e-15)  # the reference is off by an ulp, too
    assert exponential(0.0) == 1.0
    assert exponential(-1e30) == exponential(MIN_EXPONENT) < 1e-300
    assert exponential(1e30) == exponential(MAX_EXPONENT) < math.inf
    assert math.isnan(exponential(math.nan))


def test_points_far_away_or_not_numbers_are_survived():
    scenario = many_obstacles(60, 20.0)
    for x, y in ((1e300, 0.0), (-1e300, 1e300), (math.inf, 0.0)):
        assert proximity(x, y, scenario.field)[0] == math.inf  # far behind a wall
    assert not proximity(math.nan, 1.0, scenario.field)[0] < 0


def test_lists_are_accepted_where_tuples_are_expected():
    square = [[4.0, 4.0], [5.0, 4.0], [5.0, 5.0], [4.0, 5.0]]
    lists = Scenario(
        arena=[0.0, 0.0, 10.0, 10.0],
        start=[1.0, 1.0, 0.0],
        goal=[9.0, 9.0, None],
        horizon=12.0,
        obstacles=[Obstacle(polygon=Polygon(vertices=square))],
        robot=Unicycle(footprint=[{"offset": 0.0, "radius": 0.2}]),
    )
    tuples = Scenario.from_json(lists.to_json())
    assert lists == tuples and hash(lists) == hash(tuples)
    assert isinstance(lists.obstacles, tuple) and isinstance(lists.obstacles[0].polygon.vertices[0], tuple)
