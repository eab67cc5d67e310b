"""A rectangular footprint: exact distances, the proximity cost with derivatives, and the simulation."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from leapnav.envs import Box, Circle, Obstacle, Polygon, Scenario, ScenarioError, Unicycle
from leapnav.envs.field.clearance import footprint_clearance, footprint_clearances, obstacle_distance, path_clearance
from leapnav.envs.field.proximity import (
    footprint_features,
    footprint_proximities,
    footprint_proximity,
    footprint_value,
)
from leapnav.envs.field.sampling import OFFSET, PointGrid, sample_grid
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots.footprints import arm_of, corners_of, enclosed_radius, sizes_of
from leapnav.envs.shapes.capsule import Capsule

OBSTACLES = (
    Obstacle(circle=Circle(center=(3.0, 3.0), radius=0.5)),
    Obstacle(polygon=Polygon(vertices=((5.0, 5.0), (6.5, 5.2), (6.0, 6.4)))),
    Obstacle(capsule=Capsule(start=(2.0, 7.0), end=(3.0, 8.0), radius=0.2)),
    Obstacle(polygon=Polygon(vertices=((7.0, 2.0), (9.0, 2.0), (9.0, 3.0), (7.0, 3.0)))),
    Obstacle(polygon=Polygon(vertices=((4.0, 8.0), (4.02, 8.0), (4.02, 9.5), (4.0, 9.5)))),  # thinner than the robot
)


def scenario_with(others=0, box=None):
    small = [Obstacle(circle=Circle(center=(19.0, 0.5 + k / 2), radius=0.1)) for k in range(others)]
    return Scenario(
        arena=(0, 0, 20, 10) if others else (0, 0, 10, 10),
        robot=Unicycle(footprint=box or Box(length=0.8, width=0.4, offset=0.1)),
        start=(1.0, 1.0, 0.0),
        goal=(9.0, 9.0, 0.0),
        horizon=10.0,
        obstacles=(*OBSTACLES, *small),
    )


SCENARIO = scenario_with()


def poses(count, seed=0):
    return np.random.default_rng(seed).uniform((0.0, 0.0, -4.0), (10.0, 10.0, 4.0), (count, 3))


def outline_points(pose, spacing=2e-3):
    corners = corners_of(SCENARIO.outline[0], pose)
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    parts = [np.linspace(a, b, round(math.dist(a, b) / spacing), endpoint=False) for a, b in sides]
    return np.concatenate(parts)


def test_the_clearance_is_the_distance_of_the_closest_point_of_the_outline():
    for pose in poses(400):
        distances = [obstacle_distance(*point, 0.0, SCENARIO.field)[0] for point in outline_points(pose)]
        clearance, nearest = footprint_clearance(pose, SCENARIO.outline, SCENARIO.field)
        if clearance > 0:
            assert -1e-12 < min(distances) - clearance < 1e-4  # the points are 2 mm apart
            x, y = outline_points(pose)[int(np.argmin(distances))]
            assert nearest == obstacle_distance(x, y, 0.0, SCENARIO.field)[1]
        elif min(distances) > 0:  # an obstacle inside the robot, or one that crosses it
            assert clearance < 0


def test_an_overlap_is_the_smallest_translation_that_separates():
    checked = 0
    for pose in poses(3000, seed=1):
        clearance, nearest = footprint_clearance(pose, SCENARIO.outline, SCENARIO.field)
        if nearest in (1, 3, 4) and -0.05 < clearance < -1e-4:
            angles = np.linspace(0, 2 * np.pi, 721)
            for factor, is_free in ((0.97, False), (1.03, True)):
                shift = -clearance * factor * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
                moved = footprint_clearances(pose + shift, SCENARIO.outline, SCENARIO.field)
                assert (moved > 0).any() == is_free
                checked += 1
    assert checked > 40


@pytest.mark.parametrize("others", [0, 20], ids=["no grid", "grid"])
def test_derivatives_of_the_proximity_cost(others):
    scenario = scenario_with(others)
    data, checked = constant(scenario.outline.ravel()), 0
    for pose in poses(1500, seed=2):
        clearance = footprint_clearance(pose, scenario.outline, scenario.field)[0]
        step = 1e-4 * min(clearance, 0.1)
        around = [pose + step * sign * axis for axis in np.eye(3) for sign in (-1, 1)]
        if clearance < 1e-3 or len({footprint_features(*q, 0, data, 0, scenario.field) for q in around}) > 1:
            continue  # the second derivatives are discontinuous there
        phi, *rest = footprint_proximity(*pose, 0, data, 0, scenario.field)
        gradient, (xx, xy, xh, yy, yh, hh) = np.array(rest[:3]), rest[3:]
        hessian = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
        values = np.array([footprint_proximity(*q, 0, data, 0, scenario.field)[:4] for q in around])
        differences = (values[1::2] - values[::2]) / (2 * step)
        assert gradient == pytest.approx(differences[:, 0], rel=1e-5, abs=1e-6 * max(1, np.abs(gradient).max()))
        assert hessian == pytest.approx(differences[:, 1:], rel=1e-5, abs=1e-6 * max(1, np.abs(hessian).max()))
        assert footprint_value(constant(pose), scenario.outline, scenario.field) == phi
        assert footprint_proximities(pose[None], scenario.outline, scenario.field)[0] == phi
        checked += 1
    assert checked > 800


def test_a_corner_may_come_close_to_a_vertex():
    box = {"polygon": {"vertices": [[4, 4], [6, 4], [6, 6], [4, 6]]}}
    task = Scenario.from_dict(
        {
            "arena": [0, 0, 10, 10],
            "robot": {"model": "unicycle", "footprint": {"box": {"length": 0.6, "width": 0.4}}},
            "start": [1, 1, 0],
            "goal": [9, 9, 0],
            "horizon": 10,
            "obstacles": [box],
        }
    )
    for gap in (1e-2, 1e-3, 1e-4):  # along the diagonal, from the vertex (4, 4) to the corner
        pose = np.array([4 - 0.3 - gap * math.sqrt(0.5), 4 - 0.2 - gap * math.sqrt(0.5), 0.0])
        assert footprint_clearance(pose, task.outline, task.field)[0] == pytest.approx(gap)
        data = constant(task.outline.ravel())
        gradient = np.array(footprint_proximity(*pose, 0, data, 0, task.field)[1:4])
        value = lambda q, data=data: footprint_proximity(*q, 0, data, 0, task.field)[0]  # noqa: E731
        assert gradient == pytest.approx(approx_fprime(pose, value, 1e-6 * gap), rel=1e-4)


def test_the_features_change_where_the_second_derivatives_jump():
    data = constant(SCENARIO.outline.ravel())
    path = np.stack([np.linspace(4.0, 8.0, 6000), np.full(6000, 4.3), np.full(6000, 0.2)], axis=1)
    numbers = [footprint_features(*q, 0, data, 0, SCENARIO.field) for q in path]
    hessians = np.array([footprint_proximity(*q, 0, data, 0, SCENARIO.field)[4:] for q in path])
    steps = np.abs(np.diff(hessians, axis=0)).max(axis=1)
    changes = [k for k, (a, b) in enumerate(pairwise(numbers)) if a != b]
    jumps = np.flatnonzero(steps[1:-1] > 3 * np.maximum(steps[:-2], steps[2:])) + 1
    assert len(jumps) > 3 and set(jumps[steps[jumps] > 1e-3]) <= set(changes)


def test_cost_and_clearance_on_a_grid_of_points():
    row, heading, grid = tuple(SCENARIO.outline[0, :4].tolist()), 0.7, PointGrid(2.5, 1.5, 0.5, 12, 12)
    phi, closest = sample_grid(SCENARIO.field, row, heading, grid, 1.0)
    for i, j in np.ndindex(12, 12):
        x, y = 2.5 + 0.5 * i, 1.5 + 0.5 * j
        clearance, nearest = footprint_clearance(np.array([x, y, heading]), SCENARIO.outline, SCENARIO.field)
        assert closest[i, j] == pytest.approx(min(clearance, 1.0), abs=1e-9)
        if clearance < 1.0 and nearest >= 0:
            assert phi[i, j] >= 1 / math.expm1((max(clearance, 0.0) + 0.5 * OFFSET) / 0.1) * (1 - 1e-9)


def test_the_clearance_of_a_path_that_crosses_a_thin_wall():
    path = np.array([[3.9, 8.5, 0.0], [4.1, 8.6, 0.0]])
    assert path_clearance(path, SCENARIO.outline, SCENARIO.field) < 0


def test_sizes():
    outline = Unicycle(footprint=Box(length=2.0, width=1.0, offset=0.5)).outline()
    assert outline.tolist() == [[-0.5, 1.5, 0.5, 0.0, 0]]
    assert sizes_of(outline) == (0.5, pytest.approx(math.hypot(1.0, 0.5)))
    assert arm_of(outline) == pytest.approx(math.hypot(1.5, 0.5))
    assert enclosed_radius(outline) == 0.5
    assert enclosed_radius(Unicycle(footprint=Box(length=1.0, width=1.0, offset=0.7)).outline()) == pytest.approx(-0.2)


@pytest.mark.parametrize(
    ("footprint", "message"),
    [
        ({"box": {"length": 0.5}}, "robot.footprint.box.width: missing"),
        ({"box": {"length": 0.5, "width": -1}}, "robot.footprint.box.width: expected a number > 0, got -1"),
        ({"box": {"length": 1, "width": 1, "lenght": 2}}, "box.lenght: unknown field, got 2; did you mean 'length'"),
        ({"boxes": {}}, 'robot.footprint: expected discs or {"box": {"length": ..., "width": ...}}, got'),
        ([{"radius": 0.2, "offset": "a"}], r"robot.footprint\[0\].offset: expected a number, got 'a'"),
        (3, "robot.footprint: expected a list, got 3"),
    ],
)
def test_errors_name_field_and_value(footprint, message):
    fields = SCENARIO.to_dict()
    with pytest.raises(ScenarioError, match=message.replace("{", r"\{")):
        Scenario.from_dict({**fields, "robot": {"model": "unicycle", "footprint": footprint}})


def test_a_scenario_survives_json():
    text = SCENARIO.to_json()
    assert '"footprint": {"box": {"length": 0.8, "width": 0.4, "offset": 0.1}}' in text
    assert Scenario.from_json(text) == SCENARIO
