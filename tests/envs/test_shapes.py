"""Obstacle shapes: every property is tested for each shape of one list, of which the last is defined here."""

import json
import math
import pickle
from typing import ClassVar

import numpy as np
import pygame
import pytest
from helpers import scenario_fields
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline

from leapnav.envs import Capsule, Circle, NavigateEnv, Obstacle, Polygon, Scenario, ScenarioError, Shape
from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.distance import part_geometry
from leapnav.envs.field.layout import parts_in
from leapnav.envs.field.packing import MAX_PARTS_WITHOUT_GRID, blend_fields, obstacle_centres
from leapnav.envs.field.proximity import proximity, proximity_value, proximity_values
from leapnav.envs.field.sampling import OFFSET, PointGrid, sample_grid
from leapnav.envs.shapes import register
from leapnav.envs.shapes.base import KINDS
from leapnav.envs.simulation.rendering import Scene, draw_scene
from leapnav.envs.simulation.sensing import scan
from leapnav.envs.utils.colors import OBSTACLE
from leapnav.envs.utils.records import Point, Positive
from leapnav.experts import find_optimum
from leapnav.experts.plotting.scenes import draw_scenario
from leapnav.experts.search.path_class import path_sides


class Key(Shape):
    """A key: a disc, a capsule and a polygon, which overlap."""

    kind: ClassVar = "key"

    center: Point
    radius: Positive

    def parts(self):
        (x, y), r = self.center, self.radius
        bit = Polygon(vertices=((x + r, y), (x + r, y - 2 * r), (x + 2 * r, y - 2 * r), (x + 2 * r, y)))
        return bit, Capsule(start=(x, y), end=(x + 2 * r, y), radius=r / 2), Circle(center=(x, y), radius=r)


SHAPES = [
    Circle(center=(4.0, 3.0), radius=0.7),
    Polygon(vertices=((3.2, 2.4), (4.9, 2.7), (4.6, 3.6), (3.5, 3.5))),
    Capsule(start=(3.4, 2.5), end=(4.6, 3.4), radius=0.3),
    Key(center=(3.6, 3.1), radius=0.5),
]


@pytest.fixture(autouse=True)
def _key():
    register(Key)  # until the end of each test, see conftest.py


each_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
ROBOT = 0.25


def scenario_of(*shapes, **fields):
    """A scenario 8 m x 6 m with obstacles given as shapes."""
    fields = {"arena": [0, 0, 8, 6], "start": [1, 3, 0], "goal": [7, 3, 0], "horizon": 8, **fields}
    obstacles = tuple(Obstacle(**{shape.kind: shape}) for shape in shapes)
    return Scenario.from_dict(scenario_fields(**{**fields, "obstacles": []})).model_copy(
        update={"obstacles": obstacles}
    )


def points(count, seed=0):
    return np.random.default_rng(seed).uniform((1.5, 0.8), (6.5, 5.2), (count, 2))


def distance_to(shape, x, y):
    """Signed distance (m), negative inside, by brute force over the segments of the parts."""
    return min(part_distance(part, np.array([x, y])) for part in shape.parts())


def part_distance(part, point):
    vertices, radius = part.rounded_polygon()
    edges = np.roll(vertices, -1, axis=0) - vertices
    offsets = point - vertices
    fraction = np.clip(np.sum(offsets * edges, axis=1) / np.maximum(np.sum(edges**2, axis=1), 1e-300), 0, 1)
    nearest = np.linalg.norm(offsets - fraction[:, None] * edges, axis=1).min()
    return (-nearest if len(vertices) > 2 and Outline(vertices).contains_point(point) else nearest) - radius


@each_shape
def test_the_outline_is_on_the_boundary(shape):
    for part in shape.parts():
        for point in part.outline():
            assert part_distance(part, point) == pytest.approx(0, abs=1e-9)


@each_shape
def test_the_clearance_is_the_exact_distance(shape):
    field = scenario_of(shape).field
    for x, y in points(300):
        distance, nearest = clearance(x, y, field)
        wall, expected = min(x, 8 - x, y, 6 - y), distance_to(shape, x, y)
        assert distance == pytest.approx(min(wall, expected) - ROBOT, abs=1e-12)
        assert nearest == (0 if expected < wall else -1)


@each_shape
def test_the_cost_is_the_sum_over_the_parts(shape):
    other = Circle(center=(2.0, 4.5), radius=0.4)
    both, empty = scenario_of(shape, other), scenario_of()
    sigma, k = both.cost.proximity_scale, both.cost.proximity_weight
    for x, y in points(200):
        distances = [part_distance(part, np.array([x, y])) - ROBOT for part in (*shape.parts(), other)]
        if min(distances) < 1e-3:
            continue
        expected = proximity(x, y, empty.field)[0] + k * sum(1 / math.expm1(d / sigma) for d in distances)
        assert proximity(x, y, both.field)[0] == pytest.approx(expected, rel=1e-12, abs=1e-12)
        value = proximity_values(x - 0.05, y, x, y, x, y + 0.05, ROBOT, both.field)
        assert proximity_value(x, y, ROBOT, both.field) == pytest.approx(value[1], rel=1e-8, abs=1e-8)
        assert value[1] == pytest.approx(expected, rel=1e-8, abs=1e-8)
        assert value[2] == pytest.approx(proximity(x, y + 0.05, both.field)[0], rel=1e-8, abs=1e-8)


@each_shape
def test_a_term_is_skipped_only_where_it_is_negligible(shape):
    with_shape, empty = scenario_of(shape, arena=[-40, -40, 40, 40]), scenario_of(arena=[-40, -40, 40, 40])
    for x, y in np.random.default_rng(1).uniform(-8, 12, (2000, 2)):
        distances = [part_distance(part, np.array([x, y])) - ROBOT for part in shape.parts()]
        if min(distances) > 1e-3:
            found = proximity(x, y, with_shape.field)[0] - proximity(x, y, empty.field)[0]
            assert found == pytest.approx(sum(1 / math.expm1(d / 0.1) for d in distances), rel=1e-9, abs=1e-12)


@each_shape
def test_cost_and_clearance_on_a_grid_of_points_are_those_of_single_points(shape):
    field = scenario_of(shape).field
    phi, free = sample_grid(field, (0.0, 0.0, 0.0, ROBOT), 0.0, PointGrid(2.5, 1.5, 0.25, 12, 12), 2.0)
    for i, j in np.ndindex(12, 12):
        x, y = 2.5 + 0.25 * i, 1.5 + 0.25 * j
        distances = [part_distance(part, np.array([x, y])) for part in shape.parts()] + [x, 8 - x, y, 6 - y]
        expected = sum(1 / math.expm1((max(d - ROBOT, 0.0) + 0.25 * OFFSET) / 0.1) for d in distances)
        assert phi[i, j] == pytest.approx(expected, rel=1e-6, abs=1e-6)
        assert free[i, j] == pytest.approx(min(clearance(x, y, field)[0], 2.0), abs=1e-9)


def lidar(scenario, x, y, heading, count=64, reach=5.0):
    """Angles in the plane and ranges of the beams."""
    turn = 2 * math.pi * np.arange(count) / count
    scratch = np.zeros((3, 2 * count))
    beams = np.ascontiguousarray(np.stack([np.cos(turn), np.sin(turn)]))
    scan(x, y, heading, 0.0, scenario.field, (reach, 2 * np.pi), beams, scratch)
    return heading + turn, scratch[2, :count].copy()


@each_shape
@pytest.mark.parametrize("count", [16, 25])
def test_lidar_ranges_end_at_the_boundary(shape, count):
    scenario = scenario_of(shape)
    hits = 0
    for pose in ((2.0, 2.0, 0.4), (5.6, 4.0, -2.0), (4.0, 4.4, 0.0)):
        for angle, found in zip(*lidar(scenario, *pose, count), strict=True):
            ray = [
                pose[0] + np.linspace(0, found, 100) * np.cos(angle),
                pose[1] + np.linspace(0, found, 100) * np.sin(angle),
            ]
            distances = [distance_to(shape, x, y) for x, y in zip(*ray, strict=True)]
            x, y = ray[0][-1], ray[1][-1]
            assert min(distances) > -1e-9
            assert found == 5.0 or min(abs(distances[-1]), abs(min(x, 8 - x, y, 6 - y))) < 1e-9
            hits += abs(distances[-1]) < 1e-9
    assert hits > 5


@each_shape
def test_a_lidar_inside_an_obstacle_measures_zero(shape):
    vertices, _ = shape.parts()[0].rounded_polygon()
    assert (lidar(scenario_of(shape), *vertices.mean(axis=0), 0.3)[1] == 0).all()


def test_no_ray_passes_between_two_edges_of_a_polygon():
    rng = np.random.default_rng(0)
    for _ in range(200):
        x, y = rng.uniform((3.5, 1.0), (4.5, 5.0))
        diamond = Polygon(vertices=((x - 0.4, y), (x, y - 0.3), (x + 0.4, y), (x, y + 0.3)))
        assert lidar(scenario_of(diamond), x - 1.5, y, 0.0, 4)[1][0] == pytest.approx(1.1)


def drive(scenario, **settings):
    """Drive straight on until the episode ends, and return the smallest distance of the rim, and the last info."""
    env = NavigateEnv(scenario=scenario, observation="state", **settings)
    env.reset(seed=0)
    lowest = math.inf
    while True:
        _, _, terminated, truncated, _ = env.step(np.array([1.0, 0.0]))
        lowest = min(lowest, clearance(*env.unwrapped.pose[:2], scenario.field)[0])
        if terminated or truncated:
            return lowest, terminated, env.unwrapped.pose


@each_shape
def test_an_episode_ends_at_the_contact(shape):
    lowest, terminated, (x, y, _) = drive(scenario_of(shape))
    assert terminated
    assert lowest == pytest.approx(0, abs=1e-3)
    assert distance_to(shape, x, y) == pytest.approx(ROBOT, abs=1e-3)


@each_shape
def test_a_robot_in_contact_does_not_penetrate(shape):
    lowest, _, _ = drive(scenario_of(shape), terminate_on_collision=False)
    assert -1e-5 < lowest < 5e-3


@each_shape
def test_the_optimum_is_certified_and_free(shape):
    optimum = find_optimum(scenario_of(shape))
    assert optimum.success
    times = np.linspace(0, 8, 400)
    path = optimum.interpolate(times)
    distances = [distance_to(shape, x, y) for x, y in path[:, :2]]
    assert min(distances) > ROBOT
    field = optimum.problem.field
    (x, y), sides = obstacle_centres(field, np.zeros(1))[0, 0], path_sides(times, path[:, :2], field)
    above = path[np.argmin(abs(path[:, 0] - x)), 1] > y
    assert sides == ("right" if above else "left",)


@each_shape
def test_scenarios_are_read_as_written(shape):
    scenario = scenario_of(shape)
    text = scenario.to_json()
    assert Scenario.from_json(text) == scenario
    assert hash(Scenario.from_json(text)) == hash(scenario)
    assert list(json.loads(text)["obstacles"][0]) == [shape.kind]
    assert np.array_equal(pickle.loads(pickle.dumps(scenario)).field, scenario.field)
    assert scenario.obstacles[0].shape == shape
    assert (scenario.obstacles[0].circle is None) == (shape.kind != "circle")
    (((x, y),),) = obstacle_centres(scenario.field, np.zeros(1))
    assert distance_to(shape, x, y) < 0


@each_shape
def test_frames_and_plots_show_it(shape):
    color = pygame.Color(OBSTACLE)
    with_shape, empty = (draw_scene(Scene(s, s.field, s.start)) for s in (scenario_of(shape), scenario_of()))
    found = np.all(with_shape == (color.r, color.g, color.b), axis=2).sum()
    inside = np.mean([distance_to(shape, x, y) < 0 for x, y in points(4000)])
    area = inside * 5.0 * 4.4
    assert found == pytest.approx(area * (600 / (8 * 1.04)) ** 2, rel=0.25)  # without the edges of the parts
    assert not np.all(empty == (color.r, color.g, color.b), axis=2).any()
    axes = Figure().add_subplot()
    draw_scenario(axes, scenario_of(shape))
    boxes = [patch.get_path().get_extents(patch.get_patch_transform()).extents for patch in axes.patches]
    for part in shape.parts():
        expected = [*part.outline().min(axis=0), *part.outline().max(axis=0)]
        assert any(box == pytest.approx(expected, abs=5e-3) for box in boxes)


@each_shape
def test_more_obstacles_than_without_a_grid_change_nothing(shape):
    rng = np.random.default_rng(0)
    centers = [(x, y) for x, y in rng.uniform((0, 0), (8, 6), (40, 2)).tolist() if abs(y - 3) > 1][:20]
    circles = [Circle(center=center, radius=0.2) for center in centers]
    many = scenario_of(*circles[:10], shape, *circles[10:])
    parts = [scenario_of(shape), scenario_of(*circles[:10]), scenario_of(*circles[10:])]
    walls = scenario_of()
    assert len(circles) > MAX_PARTS_WITHOUT_GRID
    for x, y in points(200):
        expected = sum(np.array(proximity(x, y, part.field)) for part in parts)
        expected -= 2 * np.array(proximity(x, y, walls.field))
        assert proximity(x, y, many.field) == pytest.approx(expected, rel=1e-9, abs=1e-7)
        distance, nearest = clearance(x, y, many.field)
        assert distance == min(clearance(x, y, part.field)[0] for part in parts)
        assert (nearest == 10) == (distance == clearance(x, y, parts[0].field)[0] < clearance(x, y, walls.field)[0])


def test_the_map_contains_each_part_in_order_of_distance():
    key = SHAPES[3]
    env = NavigateEnv(scenario=scenario_of(key, start=[1, 3, 0]), observation="map", map_vertices=4)
    observation, _ = env.reset(seed=0)
    # The robot is at (1, 3) with the heading 0, so that its frame is parallel to the arena's.
    bit, shank, bow = key.parts()
    rows = observation[-80:].reshape(8, 10)  # 1, the radius and the vertices
    for row, part in zip(rows, (bow, shank, bit), strict=False):
        vertices, radius = part.rounded_polygon()
        found = row[2:].reshape(4, 2)
        assert row[:2] == pytest.approx([1, radius], abs=1e-6)
        assert np.unique(found.round(5), axis=0) == pytest.approx(np.unique(vertices - (1, 3), axis=0), abs=1e-5)
    assert (rows[3:] == 0).all()
    turn = np.linspace(0, 2 * np.pi, 10)[:-1]
    nonagon = Polygon(vertices=tuple(zip(4 + np.cos(turn), 3 + np.sin(turn), strict=True)))
    with pytest.raises(ValueError, match="map_vertices: expected at least 9"):
        NavigateEnv(scenario=scenario_of(nonagon), observation="map").reset()


def test_a_short_capsule_is_a_circle():
    circle = Circle(center=(4.0, 3.0), radius=0.5)
    for length in (0.0, 1e-14, 1e-11):
        capsule = Capsule(start=(4.0, 3.0), end=(4.0 + length, 3.0), radius=0.5)
        a, b = scenario_of(capsule), scenario_of(circle)
        for x, y in points(300):
            assert clearance(x, y, a.field)[0] == pytest.approx(clearance(x, y, b.field)[0], abs=1e-9)
            assert proximity(x, y, a.field) == pytest.approx(proximity(x, y, b.field), rel=1e-7, abs=1e-7)
        assert lidar(a, 2.0, 2.0, 0.4)[1] == pytest.approx(lidar(b, 2.0, 2.0, 0.4)[1], abs=1e-9)
    assert find_optimum(a).cost == pytest.approx(find_optimum(b).cost, rel=1e-7)


def test_the_length_of_a_capsule_may_underflow():
    """The squares of the differences of its coordinates are zero."""
    fields = {"arena": [-4, -3, 4, 3], "start": [-3, 0, 0], "goal": [3, 0, 0]}
    tiny = scenario_of(Capsule(start=(0.0, 0.0), end=(1e-200, 0.0), radius=0.5), **fields)
    circle = scenario_of(Circle(center=(0.0, 0.0), radius=0.5), **fields)
    for x, y in points(100) - (4, 3):
        assert clearance(x, y, tiny.field)[0] == pytest.approx(clearance(x, y, circle.field)[0], abs=1e-12)


def test_points_on_the_line_of_a_capsule_are_not_inside():
    """There, its two edges have the same distance, and rounding may give both the wrong sign."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        (a, b), beyond = rng.uniform((3, 2), (5, 4), (2, 2)), rng.uniform(0, 2)
        capsule = Capsule(start=tuple(a), end=tuple(b), radius=0.1)
        x, y = b + beyond * (b - a) / np.linalg.norm(b - a)
        assert clearance(x, y, scenario_of(capsule).field)[0] == pytest.approx(
            min(beyond - 0.1, x, 8 - x, y, 6 - y) - ROBOT, abs=1e-9
        )
        x, y = a + rng.uniform() * (b - a)
        assert clearance(x, y, scenario_of(capsule).field)[0] == pytest.approx(-0.1 - ROBOT, abs=1e-9)


def test_normals_on_edges_and_vertices_are_unit_vectors_outwards():
    polygon = SHAPES[1]
    field, vertices = scenario_of(polygon).field, np.array(polygon.vertices)
    centre = vertices.mean(axis=0)
    for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        for point in ((a + b) / 2, a + (a - centre) * 1e-2):
            distance, nx, ny, curvature = part_geometry(*point, 0.0, field, parts_in(field)[0])
            assert math.hypot(nx, ny) == pytest.approx(1)
            assert (point - centre) @ (nx, ny) > 0
            assert curvature == pytest.approx(0 if distance < 1e-9 else 1 / distance, rel=1e-6)
        distance, nx, ny, curvature = part_geometry(*a, 0.0, field, parts_in(field)[0])
        assert distance == pytest.approx(0, abs=1e-12)
        assert np.isfinite([nx, ny, curvature]).all()


def test_a_capsule_is_its_mirror_image():
    capsule = SHAPES[2]
    mirrored = Capsule(
        start=(8 - capsule.start[0], capsule.start[1]), end=(8 - capsule.end[0], capsule.end[1]), radius=0.3
    )
    exchanged = Capsule(start=capsule.end, end=capsule.start, radius=0.3)
    a, b, c = scenario_of(capsule), scenario_of(mirrored), scenario_of(exchanged)
    for x, y in points(300):
        value, gx, gy, hxx, hxy, hyy = proximity(x, y, a.field)
        expected = pytest.approx((value, -gx, gy, hxx, -hxy, hyy), rel=1e-9, abs=1e-9)
        assert proximity(8 - x, y, b.field) == expected
        assert proximity(x, y, c.field) == pytest.approx(proximity(x, y, a.field), rel=1e-9, abs=1e-9)
        assert clearance(8 - x, y, b.field)[0] == pytest.approx(clearance(x, y, a.field)[0], abs=1e-12)


def test_fields_with_the_same_kinds_are_blended():
    first, second = (scenario_of(Capsule(start=(3.0, 3.0), end=(4.0, y), radius=0.3)).field for y in (3.5, 4.5))
    between = scenario_of(Capsule(start=(3.0, 3.0), end=(4.0, 4.0), radius=0.3)).field
    blended = blend_fields(first, second, 0.5)
    for x, y in points(100):
        assert proximity(x, y, blended) == pytest.approx(proximity(x, y, between), rel=1e-9)
        assert clearance(x, y, blended) == pytest.approx(clearance(x, y, between))
    with pytest.raises(ValueError, match="same kinds"):
        blend_fields(first, scenario_of(SHAPES[3]).field, 0.5)


def test_a_shape_is_checked_when_it_is_registered():
    with pytest.raises(ValueError, match="kind: 'circle' is taken by"):
        register(type("Other", (Circle,), {}))
    with pytest.raises(TypeError, match="kind: expected a name for Nameless, got None"):
        register(type("Nameless", (Shape,), {"__annotations__": {}}))
    with pytest.raises(TypeError, match="parts: expected a method of Plain that returns the parts of 'plain'"):
        register(type("Plain", (Shape,), {"kind": "plain", "__annotations__": {"kind": ClassVar}}))
    assert set(KINDS) == {"circle", "polygon", "capsule", "key"}


class Heap(Shape):
    """Discs around points."""

    kind: ClassVar = "heap"

    centers: tuple[Point, ...]

    def parts(self):
        return tuple(Circle(center=center, radius=0.3) for center in self.centers)


class Nested(Shape):
    """Not a union of discs, capsules and polygons, but of a shape that is one."""

    kind: ClassVar = "nested"

    def parts(self):
        return (Heap(centers=((1.0, 1.0),)),)


def test_the_parts_of_a_shape_are_checked():
    register(Heap)
    register(Nested)
    for obstacle in ({"heap": {"centers": []}}, {"nested": {}}):
        with pytest.raises(ScenarioError, match=r"obstacles\[0\].*parts\(\): expected a tuple of Circle, Capsule and"):
            Scenario.from_dict(scenario_fields(obstacles=[obstacle]))
    thin = scenario_fields(obstacles=[{"key": {"center": [5, 5], "radius": 1e-300}}])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\].*strictly convex"):
        Scenario.from_dict(thin)


def test_paths_between_the_parts_of_a_shape_pass_it_on_the_side_of_its_first_part():
    register(Heap)
    field = scenario_of(Heap(centers=((4.0, 4.0), (4.0, 1.0)))).field
    ends = np.linspace(1, 7, 50)
    assert path_sides(ends, np.column_stack([ends, np.full(50, 3.0)]), field) == ("left",)
    assert path_sides(ends, np.column_stack([ends, np.full(50, 5.0)]), field) == ("right",)


def test_unknown_shapes_are_refused():
    fields = scenario_fields(obstacles=[{"capsul": {"start": [1, 1], "end": [2, 2], "radius": 1}}])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\]\.capsul: unknown field, .*did you mean 'capsule'"):
        Scenario.from_dict(fields)
    fields = scenario_fields(obstacles=[{"capsule": {"start": [1, 1], "end": [2, 2], "radius": -1}}])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\]\.capsule\.radius: expected a number > 0, got -1"):
        Scenario.from_dict(fields)
