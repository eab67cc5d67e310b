import math
from itertools import pairwise

import numpy as np
import pytest
from helpers import best_known, scenario_fields

from leapnav.envs import Circle, Obstacle, Polygon, Scenario, Unicycle
from leapnav.envs.field.barrier import CONTACT, barrier
from leapnav.envs.field.clearance import clearance, clearances
from leapnav.envs.field.proximity import (
    disc_features,
    footprint_features,
    proximity,
    proximity_value,
    proximity_values,
)
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.simulation import paths

SCENARIOS = [best_known()[i][0] for i in (0, 11, 15, 17, 20)]  # discs, polygons, rooms, slalom


def plain_barrier(s):
    """1 / (exp(s) - 1), and below CONTACT the quadratic polynomial with the same derivatives there."""
    b = 1 / math.expm1(max(s, CONTACT))
    slope, bend = -b * (1 + b), b * (1 + b) * (1 + 2 * b)
    return b + min(s - CONTACT, 0) * slope + min(s - CONTACT, 0) ** 2 * bend / 2


def polygon_distance(vertices, point):
    """Signed distance to a convex polygon: to the nearest segment, or inside to the nearest line."""
    edges = np.roll(vertices, -1, axis=0) - vertices
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    normals *= np.sign(np.sum(normals * (vertices - vertices.mean(axis=0)), axis=1))[:, None]
    heights = np.sum(normals * (point - vertices), axis=1)
    if heights.max() <= 0:
        return heights.max()
    fraction = np.clip(np.sum((point - vertices) * edges, axis=1) / np.sum(edges**2, axis=1), 0, 1)
    return np.linalg.norm(point - vertices - fraction[:, None] * edges, axis=1).min()


def plain_proximity(scenario, x, y):
    """The formulas of the theory, without limits of the distance."""
    cost, radius = scenario.cost, scenario.robot.radius
    x_min, y_min, x_max, y_max = scenario.arena
    distances = [x - x_min, x_max - x, y - y_min, y_max - y]
    for obstacle in scenario.obstacles:
        if obstacle.circle:
            distances.append(math.dist((x, y), obstacle.circle.center) - obstacle.circle.radius)
        else:
            distances.append(polygon_distance(np.array(obstacle.polygon.vertices), np.array([x, y])))
    return cost.proximity_weight * sum(plain_barrier((d - radius) / cost.proximity_scale) for d in distances)


def points(scenario, count, seed=0):
    x_min, y_min, x_max, y_max = scenario.arena
    return np.random.default_rng(seed).uniform((x_min, y_min), (x_max, y_max), (count, 2))


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_the_proximity_cost_is_the_formula(scenario):
    left_out = 1e-13 * scenario.cost.proximity_weight * (len(scenario.obstacles) + 4)  # each term below CUTOFF
    for x, y in points(scenario, 100):
        formula = plain_proximity(scenario, x, y)
        assert proximity(x, y, scenario.field)[0] == pytest.approx(formula, rel=1e-11, abs=left_out)


@pytest.mark.parametrize("count", [11, 12, 13, 15, 16, 17, 40])
def test_the_proximity_cost_is_the_formula_among_many_obstacles(count):
    rng = np.random.default_rng(count)
    angles, distances = rng.uniform(0.0, 2 * math.pi, count), rng.uniform(0.5, 1.5, count)
    discs = np.column_stack([3.0 + distances * np.cos(angles), 3.0 + distances * np.sin(angles), np.full(count, 0.1)])
    scenario = Scenario.from_discs(
        discs, start=(0.5, 0.5, 0.0), goal=(5.5, 5.5, 0.0), horizon=9.0, arena=(0.0, 0.0, 6.0, 6.0)
    )
    for x, y in rng.uniform(2.8, 3.2, (20, 2)):
        assert proximity(x, y, scenario.field)[0] == pytest.approx(plain_proximity(scenario, x, y), rel=1e-11)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_gradient_and_hessian_agree_with_finite_differences(scenario):
    for x, y in points(scenario, 200):
        # In proportion to the distance near contact, where the derivatives are large.
        h = 1e-4 * min(max(abs(clearance(x, y, scenario.field)[0]), 1e-3), 0.1)
        _, gx, gy, hxx, hxy, hyy = values = proximity(x, y, scenario.field)
        right, left = (proximity(x + s, y, scenario.field) for s in (h, -h))
        above, below = (proximity(x, y + s, scenario.field) for s in (h, -h))
        differences = [(a[i] - b[i]) / (2 * h) for a, b, i in ((right, left, 0), (above, below, 0))]
        differences += [(right[1] - left[1]) / (2 * h), (right[2] - left[2]) / (2 * h), (above[2] - below[2]) / (2 * h)]
        # The difference quotient's own error, relative to the largest derivative there.
        assert [gx, gy, hxx, hxy, hyy] == pytest.approx(differences, rel=1e-5, abs=1e-6 * max(1, *map(abs, values)))


@pytest.mark.parametrize("others", [0, 20], ids=["no grid", "grid"])
def test_the_number_of_the_closest_features_changes_where_the_hessian_jumps(others):
    box = Obstacle(polygon=Polygon(vertices=((4.5, 4.7), (5.5, 4.7), (5.5, 5.3), (4.5, 5.3))))
    discs = [Obstacle(circle=Circle(center=(19.0, 0.5 + k / 2), radius=0.1)) for k in range(others)]
    field = Scenario(arena=(0, 0, 20, 20), start=(1, 1, 0), goal=(9, 9, 0), horizon=20, obstacles=[box, *discs]).field
    angles = np.linspace(0.1, 0.1 + 2 * math.pi, 4000)
    path = 5.0 + 1.2 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    numbers = np.array([disc_features(x, y, 0.25, field) for x, y in path])
    assert len(set(numbers)) == 8  # four edges, four vertices
    hessians = np.array([proximity(x, y, field)[3:] for x, y in path])
    steps = np.abs(np.diff(hessians, axis=0)).max(axis=1)
    changes = np.flatnonzero(np.diff(numbers))
    assert len(changes) == 8
    assert steps[changes].min() > 10 * np.median(steps)
    assert set(np.argsort(steps)[-8:]) == set(changes)
    assert disc_features(15.0, 15.0, 0.25, field) == 0  # far away
    # A footprint changes with each of its discs.
    data = np.array([0.0, 0.0, 0.0, 0.25, 0.0, 0.3, 0.3, 0.0, 0.25, 0.0])
    whole = [footprint_features(x, y, 0.4, 0, data, 0, field) for x, y in path]
    dx, dy = 0.3 * math.cos(0.4), 0.3 * math.sin(0.4)
    parts = [(disc_features(x, y, 0.25, field), disc_features(x + dx, y + dy, 0.25, field)) for x, y in path]
    assert len(set(whole)) == len(set(parts)) > 8
    assert [a != b for a, b in pairwise(whole)] == [a != b for a, b in pairwise(parts)]


def test_the_barrier_function_and_its_derivatives():
    for s in np.geomspace(CONTACT * 1.001, 300.0, 2000):
        b = 1 / math.expm1(s)
        expected = b, -b * (1 + b), b * (1 + b) * (1 + 2 * b)
        assert barrier(s, CONTACT) == pytest.approx(expected, rel=1e-14, abs=2e-15)
    for s in (0.3, 2.0):
        h = 1e-4
        (left, right), (_, slope, bend) = (barrier(s + sign * h, CONTACT) for sign in (-1, 1)), barrier(s, CONTACT)
        assert [slope, bend] == pytest.approx(np.subtract(right, left)[:2] / (2 * h), rel=1e-6)


@pytest.mark.parametrize("contact", [CONTACT, 0.1])
def test_the_barrier_continues_below_contact_as_a_polynomial_that_decreases(contact):
    at, below = barrier(contact * (1 + 1e-9), contact), barrier(contact * (1 - 1e-9), contact)
    assert at == pytest.approx(below, rel=1e-7)  # twice continuously differentiable
    inside = np.array([barrier(s, contact) for s in np.linspace(-50.0, contact, 1001)])
    assert np.isfinite(inside).all()
    assert (inside[:, 1] < 0).all()
    assert (np.diff(inside[:, 0]) < 0).all()
    assert inside[:, 2] == pytest.approx(at[2], rel=1e-7)


def test_the_cost_inside_an_obstacle_decreases_outwards():
    """A guess in collision is moved out by the descent."""
    disc = {"circle": {"center": [5, 5], "radius": 1.0}}
    box = {"polygon": {"vertices": [[4, 4], [6, 4], [6, 6], [4, 6]]}}
    bar = {"capsule": {"start": [4, 5], "end": [6, 5], "radius": 0.5}}
    for obstacle in (disc, box, bar):
        scenario = Scenario.from_dict(scenario_fields(obstacles=[obstacle]))
        for turn in np.linspace(0.1, 6.3, 20):
            outwards = np.array([math.cos(turn), math.sin(turn)])
            path = (5, 5) + np.linspace(0.05, 2.5, 200)[:, None] * outwards
            path = path[[clearance(x, y, scenario.field)[0] < 0 for x, y in path]]
            found = np.array([proximity(x, y, scenario.field) for x, y in path])
            assert np.isfinite(found).all()
            assert (np.diff(found[:, 0]) <= 0).all()
            assert (found[:, 1:3] @ outwards <= 0).all()


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
            expected, rel=1e-9, abs=1e-8
        )
        found = proximity_values(*three[0], *three[1], *three[2], scenario.robot.radius, scenario.field)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-8)


def test_clearance_names_the_nearest_obstacle():
    scenario = SCENARIOS[0]
    for number, obstacle in enumerate(scenario.obstacles):
        distance, nearest = clearance(*obstacle.circle.center, scenario.field)
        assert nearest == number
        assert distance == pytest.approx(-obstacle.circle.radius - scenario.robot.radius)
    assert clearance(0.0, 5.0, scenario.field)[1] == -1  # the wall


UNICYCLE = paths.RobotMotion(
    FunctionPointer(Unicycle.advance, paths.ADVANCE_FUNCTION),
    FunctionPointer(paths.no_state_cost, paths.STATE_COST_FUNCTION),
)


def drive_arc(scenario, x, y, heading, distance, turn):
    """Drive along an arc in one second; see `drive_path`, without the state cost."""
    q, u, outline = np.array([x, y, heading]), np.array([distance, turn]), scenario.robot.outline().copy()
    path = paths.Path(UNICYCLE, q, u, np.zeros(0), outline, scenario.field, 1.0, np.zeros((5, 3)))
    return paths.drive_path(path, clearance(x, y, scenario.field)[0], np.zeros(3))[:4]


def arc_points(x, y, heading, distance, turn, fractions):
    chord = distance * fractions * np.sinc(turn * fractions / (2 * np.pi))
    middle = heading + turn * fractions / 2
    return np.stack([x + chord * np.cos(middle), y + chord * np.sin(middle)], axis=-1)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_the_clearance_of_an_arc_is_the_smallest_of_its_points(scenario):
    rng = np.random.default_rng(3)
    fraction = np.linspace(0, 1, 5001)
    for x, y in points(scenario, 40, seed=1):
        heading, distance, turn = rng.uniform(-3, 3), rng.uniform(-1, 1), rng.uniform(-2, 2)
        arc = arc_points(x, y, heading, distance, turn, fraction)
        lowest = clearances(arc, scenario.field).min()
        before = clearance(x, y, scenario.field)[0]
        found, driven, after, _ = drive_arc(scenario, x, y, heading, distance, turn)
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


def accurate_mean(scenario, arc):
    """Mean of Phi along an arc, by Gauss rules over panels graded towards both ends and the smallest clearance."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    trial = np.linspace(0, 1, 2001)
    clearances_ = clearances(arc_points(*arc, trial), scenario.field)
    steps = np.concatenate([[0.0], 1.5 ** -np.arange(45.0)])
    centres = 0.0, trial[np.argmin(clearances_)], 1.0
    ends = np.unique(np.clip([c + sign * steps for c in centres for sign in (-1, 1)], 0, 1))
    total = 0.0
    for a, b in pairwise(ends):
        for node, weight in zip(nodes, weights, strict=True):
            point = arc_points(*arc, (a + b) / 2 + (b - a) / 2 * node)
            total += (b - a) / 2 * weight * proximity(*point, scenario.field)[0]
    return total


def test_the_proximity_cost_of_an_arc_is_accurate_near_obstacles_and_up_to_a_contact():
    rng = np.random.default_rng(0)
    scenario = Scenario.from_dict(
        scenario_fields(
            obstacles=[
                {"circle": {"center": [5, 5], "radius": 0.5}},
                {"polygon": {"vertices": [[5.4, 5], [7, 4.5], [7, 5.5]]}},
            ]
        )
    )
    errors = {True: [], False: []}
    for _ in range(120):
        distance, turn = 0.75 + 10 ** rng.uniform(-4, -0.5), rng.uniform(0.8, 5.5)
        x, y = 5 + distance * math.cos(turn), 5 + distance * math.sin(turn)
        arc = x, y, rng.uniform(-np.pi, np.pi), rng.uniform(0.01, 0.15), rng.uniform(-0.4, 0.4)
        _, fraction, _, found = drive_arc(scenario, *arc)
        arc = *arc[:3], arc[3] * fraction, arc[4] * fraction
        errors[fraction < 1].append(abs(found / fraction / accurate_mean(scenario, arc) - 1))
    assert min(map(len, errors.values())) > 24
    assert max(errors[False]) < 1e-4
    assert max(errors[True]) < 2e-3
    assert np.quantile(errors[True], 0.95) < 1e-4


def test_a_very_long_arc_through_a_wall_terminates():
    lowest, driven, _, _ = drive_arc(SCENARIOS[0], 5.0, 5.0, 0.3, 1e9, 0.0)
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
    lowest, driven, _, _ = drive_arc(scenario, 1.0, 5.0, 0.0, 8.0, 0.0)
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


@pytest.mark.parametrize(("count", "size"), [(40, 12.0), (100, 40.0), (200, 200.0)])
def test_a_grid_of_obstacles_changes_nothing(count, size):
    scenario = many_obstacles(count, size)
    rng = np.random.default_rng(1)
    # Also outside the arena, where an integrator may evaluate it.
    for x, y in rng.uniform(-6.0, size + 6.0, (100, 2)):
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
