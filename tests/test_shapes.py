"""Obstacle shapes: every property is tested for each shape of one list, of which the last is defined here."""

import json
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
import pygame
import pytest
from helpers import scenario_fields
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline

from leapnav.envs import Capsule, Circle, NavigateEnv, Obstacle, Polygon, Scenario, ScenarioError, Shape
from leapnav.envs.kernels import kernel
from leapnav.envs.shapes import register
from leapnav.envs.shapes.base import DISTANCE_SIGNATURE, KINDS, SMOOTH_DISTANCE_SIGNATURE, kind_number
from leapnav.envs.shapes.clearance import clearance
from leapnav.envs.shapes.field import MAX_OBSTACLES_WITHOUT_GRID, blend_fields, check_field, obstacle_centres
from leapnav.envs.shapes.proximity import proximity, proximity_value, proximity_values
from leapnav.envs.shapes.sampling import PointGrid, sample_grid
from leapnav.envs.simulation.rendering import Scene, draw_scene
from leapnav.envs.simulation.sensing import scan
from leapnav.envs.utils.colors import OBSTACLE
from leapnav.envs.utils.records import Point, Positive
from leapnav.experts import find_optimum
from leapnav.experts.plotting import draw_scenario
from leapnav.experts.search.path_class import path_sides

ROOT = Path(__file__).parent


@kernel(DISTANCE_SIGNATURE)
def lame_curve_distance(x, y, values):
    """The distance to a convex shape is the largest one to its tangents: a search over their angles."""
    x, y, a, b = abs(x - values[0]), abs(y - values[1]), values[2], values[3]
    best, angle, width = -np.inf, math.pi / 4, math.pi / 4
    for _ in range(10):
        middle = angle
        for k in range(-4, 5):
            trial = min(max(middle + k * width / 4, 0.0), math.pi / 2)
            c, s = math.cos(trial), math.sin(trial)
            found = x * c + y * s - ((a * c) ** (4 / 3) + (b * s) ** (4 / 3)) ** 0.75
            if found > best:
                best, angle = found, trial
        width /= 3
    return best


@kernel(SMOOTH_DISTANCE_SIGNATURE)
def lame_curve_smooth_distance(x, y, scale, values):
    """Gauge function (u^4 + v^4)^(1/4) - 1, times the smaller half-axis."""
    a, b = values[2], values[3]
    u, v, m = (x - values[0]) / a, (y - values[1]) / b, min(a, b)
    g = (u**4 + v**4 + 1e-6) ** 0.25
    gu, gv, bend = u**3 / g**3, v**3 / g**3, 3 / g**7
    guu, guv, gvv = bend * u**2 * (v**4 + 1e-6), -bend * u**3 * v**3, bend * v**2 * (u**4 + 1e-6)
    return m * (g - 1), m * gu / a, m * gv / b, m * guu / a**2, m * guv / (a * b), m * gvv / b**2


class LameCurve(Shape):
    """A superellipse, ((x - x_0) / a)^4 + ((y - y_0) / b)^4 = 1."""

    kind: ClassVar = "lame_curve"
    distance: ClassVar = lame_curve_distance
    smooth_distance: ClassVar = lame_curve_smooth_distance

    center: Point
    half_axes: tuple[Positive, Positive]

    def values(self):
        return (*self.center, *self.half_axes)

    def outline(self):
        turn = np.linspace(0, 2 * np.pi, 97)[:-1]
        unit = np.column_stack([np.cos(turn), np.sin(turn)])
        return np.array(self.center) + np.array(self.half_axes) * np.sign(unit) * np.sqrt(np.abs(unit))


SHAPES = [
    Circle(center=(4.0, 3.0), radius=0.7),
    Polygon(vertices=((3.2, 2.4), (4.9, 2.7), (4.6, 3.6), (3.5, 3.5))),
    Capsule(start=(3.4, 2.5), end=(4.6, 3.4), radius=0.3),
    LameCurve(center=(4.0, 3.0), half_axes=(0.9, 0.6)),
]


@pytest.fixture(autouse=True)
def _lame_curve():
    register(LameCurve)  # until the end of each test, see conftest.py


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


def outline_distance(shape, x, y):
    """Signed distance to the polygon of the outline, by brute force."""
    vertices = shape.outline()
    edges = np.roll(vertices, -1, axis=0) - vertices
    offsets = np.array([x, y]) - vertices
    part = np.clip(np.sum(offsets * edges, axis=1) / np.maximum(np.sum(edges**2, axis=1), 1e-300), 0, 1)
    nearest = np.linalg.norm(offsets - part[:, None] * edges, axis=1).min()
    return -nearest if Outline(vertices).contains_point((x, y)) else nearest


@each_shape
def test_the_distance_is_that_to_the_outline(shape):
    values = np.array(shape.values())
    for x, y in points(300):
        assert type(shape).distance(x, y, values) == pytest.approx(outline_distance(shape, x, y), abs=4e-3)
    for x, y in shape.outline():
        assert type(shape).distance(x, y, values) == pytest.approx(0, abs=1e-8)


@each_shape
def test_the_derivatives_of_the_smooth_distance_agree_with_finite_differences(shape):
    values, h = np.array(shape.values()), 1e-5
    for x, y in points(200):
        if type(shape).distance(x, y, values) < -0.2:  # nearly singular at the centre
            continue
        _, *found = type(shape).smooth_distance(x, y, 0.1, values)
        right, left = (np.array(type(shape).smooth_distance(x + s, y, 0.1, values)) for s in (h, -h))
        above, below = (np.array(type(shape).smooth_distance(x, y + s, 0.1, values)) for s in (h, -h))
        along, up = (right - left) / (2 * h), (above - below) / (2 * h)
        assert found == pytest.approx([along[0], up[0], along[1], along[2], up[2]], abs=1e-6)
        assert up[1] == pytest.approx(along[2], abs=1e-6)


@each_shape
def test_the_cost_and_its_derivatives_are_the_sum_over_the_obstacles(shape):
    other = Circle(center=(2.0, 4.5), radius=0.4)
    both, alone, empty = scenario_of(shape, other), scenario_of(other), scenario_of()
    cost, values, sigma = both.cost, np.array(shape.values()), both.cost.proximity_scale
    for x, y in points(200):
        d, dx, dy, dxx, dxy, dyy = type(shape).smooth_distance(x, y, sigma, values)
        term = cost.proximity_weight * math.exp(-(d - ROBOT) / sigma)
        slopes = [-term * dx / sigma, -term * dy / sigma]
        bends = [term * (a * b / sigma - c) / sigma for a, b, c in ((dx, dx, dxx), (dx, dy, dxy), (dy, dy, dyy))]
        expected = np.array(proximity(x, y, alone.field)) + np.array([term, *slopes, *bends])
        assert proximity(x, y, both.field) == pytest.approx(expected, rel=1e-9, abs=1e-9)
        value = proximity_values(x - 0.05, y, x, y, x, y + 0.05, ROBOT, both.field)
        assert proximity_value(x, y, ROBOT, both.field) == pytest.approx(value[1], rel=1e-9, abs=1e-9)
        assert value[1] == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
        assert value[2] == pytest.approx(proximity(x, y + 0.05, both.field)[0], rel=1e-9, abs=1e-9)
        here = min(type(shape).distance(x, y, values), Circle.distance(x, y, np.array(other.values()))) - ROBOT
        assert clearance(x, y, both.field)[0] == pytest.approx(min(here, clearance(x, y, empty.field)[0]), abs=1e-9)


@each_shape
def test_a_term_is_skipped_only_where_it_is_negligible(shape):
    with_shape, empty = scenario_of(shape, arena=[-40, -40, 40, 40]), scenario_of(arena=[-40, -40, 40, 40])
    values = np.array(shape.values())
    for x, y in np.random.default_rng(1).uniform(-8, 12, (2000, 2)):
        term = math.exp(-(type(shape).smooth_distance(x, y, 0.1, values)[0] - ROBOT) / 0.1)
        found = proximity(x, y, with_shape.field)[0] - proximity(x, y, empty.field)[0]
        assert found == pytest.approx(term, rel=1e-9, abs=1e-12)


@each_shape
def test_cost_and_clearance_on_a_grid_of_points_are_those_of_single_points(shape):
    field = scenario_of(shape).field
    phi, free = sample_grid(field, ROBOT, PointGrid(2.5, 1.5, 0.25, 12, 12), 2.0)
    for i, j in np.ndindex(12, 12):
        x, y = 2.5 + 0.25 * i, 1.5 + 0.25 * j
        assert phi[i, j] == pytest.approx(proximity(x, y, field)[0], rel=1e-6, abs=1e-6)
        assert free[i, j] == pytest.approx(min(clearance(x, y, field)[0], 2.0), abs=1e-9)


def lidar(scenario, x, y, heading, count=64, reach=5.0):
    """Angles in the plane and ranges of the beams."""
    turn = 2 * math.pi * np.arange(count) / count
    scratch = np.zeros((3, 2 * count))
    beams = np.ascontiguousarray(np.stack([np.cos(turn), np.sin(turn)]))
    scan(x, y, math.cos(heading), math.sin(heading), scenario.field, reach, beams, scratch)
    return heading + turn, scratch[2, :count].copy()


@each_shape
def test_lidar_ranges_end_at_the_boundary(shape):
    scenario, values = scenario_of(shape), np.array(shape.values())
    hits = 0
    for pose in ((2.0, 2.0, 0.4), (5.6, 4.0, -2.0), (4.0, 4.4, 0.0)):
        for angle, found in zip(*lidar(scenario, *pose), strict=True):
            ray = [
                pose[0] + np.linspace(0, found, 200) * np.cos(angle),
                pose[1] + np.linspace(0, found, 200) * np.sin(angle),
            ]
            distances = [type(shape).distance(x, y, values) for x, y in zip(*ray, strict=True)]
            x, y = ray[0][-1], ray[1][-1]
            assert min(distances) > -1e-9
            assert found == 5.0 or min(abs(distances[-1]), abs(min(x, 8 - x, y, 6 - y))) < 1e-9
            hits += abs(distances[-1]) < 1e-9
    assert hits > 20


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
    assert type(shape).distance(x, y, np.array(shape.values())) == pytest.approx(ROBOT, abs=1e-3)


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
    distances = [outline_distance(shape, x, y) for x, y in path[:, :2]]
    assert min(distances) > ROBOT
    sides = path_sides(path[:, :2], optimum.problem.field)
    above = path[np.argmin(abs(path[:, 0] - shape.centre()[0])), 1] > shape.centre()[1]
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
    assert obstacle_centres(scenario.field)[0] == pytest.approx(shape.centre())


@each_shape
def test_frames_and_plots_show_it(shape):
    color = pygame.Color(OBSTACLE)
    with_shape, empty = (draw_scene(Scene(s, s.start)) for s in (scenario_of(shape), scenario_of()))
    found = np.all(with_shape == (color.r, color.g, color.b), axis=2).sum()
    (x, y), (next_x, next_y) = shape.outline().T, np.roll(shape.outline(), -1, axis=0).T
    area = abs(np.sum(x * next_y - y * next_x)) / 2
    assert found == pytest.approx(area * (600 / (8 * 1.04)) ** 2, rel=0.15)  # without the edge
    assert not np.all(empty == (color.r, color.g, color.b), axis=2).any()
    axes = Figure().add_subplot()
    draw_scenario(axes, scenario_of(shape))
    x_min, y_min, x_max, y_max = shape.bounds()
    boxes = [patch.get_path().get_extents(patch.get_patch_transform()).extents for patch in axes.patches]
    assert any(box == pytest.approx((x_min, y_min, x_max, y_max), abs=5e-3) for box in boxes)


@each_shape
def test_more_obstacles_than_without_a_grid_change_nothing(shape):
    rng = np.random.default_rng(0)
    centers = [(x, y) for x, y in rng.uniform((0, 0), (8, 6), (40, 2)).tolist() if abs(y - 3) > 1][:20]
    circles = [Circle(center=center, radius=0.2) for center in centers]
    many = scenario_of(*circles[:10], shape, *circles[10:])
    parts = [scenario_of(shape), scenario_of(*circles[:10]), scenario_of(*circles[10:])]
    walls = scenario_of()
    assert len(circles) > MAX_OBSTACLES_WITHOUT_GRID
    for x, y in points(200):
        expected = sum(np.array(proximity(x, y, part.field)) for part in parts)
        expected -= 2 * np.array(proximity(x, y, walls.field))
        assert proximity(x, y, many.field) == pytest.approx(expected, rel=1e-9, abs=1e-7)
        distance, nearest = clearance(x, y, many.field)
        assert distance == min(clearance(x, y, part.field)[0] for part in parts)
        assert (nearest == 10) == (distance == clearance(x, y, parts[0].field)[0] < clearance(x, y, walls.field)[0])


def test_the_map_contains_a_capsule_exactly_and_the_outline_of_others():
    capsule = SHAPES[2]
    env = NavigateEnv(scenario=scenario_of(capsule, start=[1, 3, 0]), observation="map", map_vertices=4)
    observation, _ = env.reset(seed=0)
    # The robot is at (1, 3) with the heading 0, so that its frame is parallel to the arena's.
    found = observation[-80:-70]  # the first of 8 rows of 10
    expected = [1, 0.3, *(v - o for end in (capsule.start, capsule.end) * 2 for v, o in zip(end, (1, 3), strict=True))]
    assert found == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match="map_vertices: expected at least 96"):
        NavigateEnv(scenario=scenario_of(SHAPES[3]), observation="map").reset()


def test_a_short_capsule_is_a_circle():
    circle = Circle(center=(4.0, 3.0), radius=0.5)
    for length in (0.0, 1e-11):
        capsule = Capsule(start=(4.0, 3.0), end=(4.0 + length, 3.0), radius=0.5)
        a, b = scenario_of(capsule), scenario_of(circle)
        for x, y in points(300):
            assert clearance(x, y, a.field)[0] == pytest.approx(clearance(x, y, b.field)[0], abs=1e-9)
            assert proximity(x, y, a.field) == pytest.approx(proximity(x, y, b.field), rel=1e-7, abs=1e-7)
        assert lidar(a, 2.0, 2.0, 0.4)[1] == pytest.approx(lidar(b, 2.0, 2.0, 0.4)[1], abs=1e-9)
    assert find_optimum(a).cost == pytest.approx(find_optimum(b).cost, rel=1e-7)


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
    with pytest.raises(TypeError, match="distance: expected a kernel of DISTANCE_SIGNATURE for 'plain'"):
        register(type("Plain", (Shape,), {"kind": "plain", "__annotations__": {"kind": ClassVar}}))
    assert set(KINDS) == {"circle", "polygon", "capsule", "lame_curve"}
    assert kind_number("capsule") == 3063  # stored in banks


def test_unknown_shapes_are_refused():
    fields = scenario_fields(obstacles=[{"capsul": {"start": [1, 1], "end": [2, 2], "radius": 1}}])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\]\.capsul: unknown field, .*did you mean 'capsule'"):
        Scenario.from_dict(fields)
    fields = scenario_fields(obstacles=[{"capsule": {"start": [1, 1], "end": [2, 2], "radius": -1}}])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\]\.capsule\.radius: expected a number > 0, got -1"):
        Scenario.from_dict(fields)
    field = scenario_of(SHAPES[3]).field.copy()
    check_field(field)
    field[field == -kind_number("lame_curve")] = -kind_number("unknown")
    with pytest.raises(ValueError, match=r"not registered in this process.*Import the file"):
        check_field(field)
    assert math.isnan(proximity(4.0, 3.0, field)[0])  # not a wrong value


PROCESS = """
import sys
import numpy as np
from leapnav.envs.shapes.proximity import proximity
from leapnav.envs.shapes.records import record_distance
{imports}
field = np.load(sys.argv[1])
found = proximity(float(sys.argv[2]), float(sys.argv[3]), field)
print(*map(repr, found), sum(record_distance.stats.cache_hits.values()), sep="\\n")
"""


@pytest.mark.parametrize("shape", SHAPES[2:], ids=lambda shape: shape.kind)
def test_cached_kernels_call_the_shape_in_another_process(shape, tmp_path):
    field = scenario_of(shape).field
    np.save(tmp_path / "field.npy", field)
    imports = "" if shape.kind == "capsule" else "import test_shapes; test_shapes.register(test_shapes.LameCurve)"
    code = PROCESS.format(imports=imports)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    expected = proximity(4.1, 3.9, field)  # compiles what is missing
    command = [sys.executable, "-c", code, tmp_path / "field.npy", "4.1", "3.9"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    *found, hits = map(eval, done.stdout.split())
    assert found == pytest.approx(expected, rel=1e-12)
    assert hits == 0  # called by others, whose code contains it


SCRIPT = """
import math
import sys
from typing import ClassVar
import numpy as np
from leapnav.envs import Circle, Obstacle, Scenario
from leapnav.envs.kernels import kernel
from leapnav.envs.shapes import register
from leapnav.envs.shapes.base import DISTANCE_SIGNATURE, SMOOTH_DISTANCE_SIGNATURE
from leapnav.envs.shapes.clearance import clearance
from beside import SCALE

@kernel(DISTANCE_SIGNATURE)
def distance(x, y, values):
    return SCALE * (math.hypot(x - values[0], y - values[1]) - values[2])

@register
class Disc(Circle):
    kind: ClassVar = "disc"
    distance: ClassVar = distance

obstacle = Obstacle(disc=Disc(center=(4.0, 3.0), radius=0.5))
scenario = Scenario(arena=(0.0, 0.0, 8.0, 6.0), start=(1.0, 3.0, 0.0), goal=(7.0, 3.0, 0.0), horizon=8.0,
                    obstacles=(obstacle,))
print(clearance(4.0, 4.0, scenario.field)[0], sum(distance.stats.cache_hits.values()))
"""


def test_kernels_of_a_script_are_cached_until_it_or_a_module_beside_it_changes(tmp_path):
    (tmp_path / "script.py").write_text(f"# {tmp_path}{SCRIPT}")  # not in the cache from an earlier test

    def result(*command, scale, **options):
        (tmp_path / "beside.py").write_text(f"SCALE = {scale}\n")
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, *command]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, **options
        )
        return done.stdout.split()

    name = str(tmp_path / "script.py")
    assert result(name, scale=1.0) == ["0.25", "0"]
    assert result(name, scale=1.0) == ["0.25", "1"]
    assert result(name, scale=2.0) == ["0.75", "0"]
    assert result("-", scale=1.0, input=SCRIPT) == ["0.25", "0"]  # without a source file
