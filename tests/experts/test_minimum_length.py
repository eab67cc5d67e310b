"""Minimum length against closed forms, an independent visibility graph, and paths of Dubins' car."""

import math

import numpy as np
import pytest
from shortest_words import dubins, reeds_shepp
from visibility import shortest_length

from leapnav.envs import Scenario, sample_scenario
from leapnav.envs.robots import Box, Car, DifferentialDrive, Unicycle
from leapnav.envs.shapes import Circle, Polygon
from leapnav.experts import SolveError, Status, minimum_length
from leapnav.experts.plotting.extremals import plot_pieces

RADIUS = 0.25


def among(*shapes, robot=None, start=(1.0, 2.0, 0.5), goal=(5.0, 2.0, -0.5)):
    obstacles = [{shape.kind: shape} for shape in shapes]
    robot = Unicycle(radius=RADIUS) if robot is None else robot
    return Scenario(arena=(0, 0, 6, 4), robot=robot, start=start, goal=goal, horizon=10.0, obstacles=tuple(obstacles))


def in_the_open(robot, goal):
    return Scenario(arena=(-20, -20, 20, 20), robot=robot, start=(0, 0, 0), goal=goal, horizon=10.0)


def visible(scenario):
    """The shortest length of the independent visibility graph."""
    discs = [(*one.circle.center, one.circle.radius + scenario.robot.radius) for one in scenario.obstacles]
    return shortest_length(np.array(scenario.start[:2]), np.array(scenario.goal[:2]), np.array(discs).reshape(-1, 3))


@pytest.mark.parametrize("seed", range(8))
def test_the_length_is_that_of_a_visibility_graph(seed):
    scenario = sample_scenario("clutter", seed)
    found = minimum_length(scenario)
    assert found.length == pytest.approx(visible(scenario), rel=2e-4)
    assert found.tolerance == 0.0 and found.lower_bound == found.length


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8, 100))
def test_the_length_is_that_of_a_visibility_graph_in_more_scenarios(seed):
    test_the_length_is_that_of_a_visibility_graph(seed)


def test_around_a_disc_the_path_has_two_tangents_and_an_arc():
    found = minimum_length(among(Circle(center=(3, 2), radius=0.5)))
    reach, distance = 0.5 + RADIUS, 2.0
    angle = math.pi - 2 * math.acos(reach / distance)
    assert found.length == pytest.approx(2 * math.sqrt(distance**2 - reach**2) + reach * angle, rel=1e-9)
    assert [piece.kind for piece in found.pieces] == ["turn", "straight", "contact", "straight", "turn"]
    assert [piece.obstacle for piece in found.pieces] == [None, None, "obstacles[0]", None, None]
    assert sum(piece.length for piece in found.pieces) == pytest.approx(found.length, rel=1e-12)
    assert sum(piece.turn for piece in found.pieces) == pytest.approx(-1.0, abs=1e-9)
    assert "obstacles[0]" in str(found)


def test_the_poses_follow_the_pieces():
    scenario = among(Circle(center=(3, 2), radius=0.5))
    found = minimum_length(scenario)
    assert found.poses[0].tolist() == [1, 2, 0.5] and found.poses[-1].tolist() == pytest.approx([5, 2, -0.5])
    steps = np.diff(found.poses[:, :2], axis=0)
    lengths = np.hypot(*steps.T)
    assert lengths.sum() == pytest.approx(found.length, rel=1e-4)
    # The heading is the direction of the motion.
    moving = lengths > 0
    directions = np.arctan2(steps[moving, 1], steps[moving, 0])
    middles = 0.5 * (found.poses[1:, 2] + found.poses[:-1, 2])[moving]
    assert np.abs(np.remainder(directions - middles + math.pi, 2 * math.pi) - math.pi).max() < 1e-9
    distances = np.hypot(*(found.poses[:, :2] - (3, 2)).T)
    assert distances.min() == pytest.approx(0.5 + RADIUS, abs=1e-9)


def test_around_a_corner_the_path_has_an_arc_with_the_radius_of_the_robot():
    wall = Polygon(vertices=((2.9, 0.0), (3.1, 0.0), (3.1, 2.5), (2.9, 2.5)))
    found = minimum_length(among(wall))
    # To the tangent of the arc around the corner (2.9, 2.5), along the upper edge, and the same on the other side.
    across, up = 1.9, 0.5
    distance = math.hypot(across, up)
    turn = math.atan2(up, across) + math.asin(RADIUS / distance)
    expected = 2 * (math.sqrt(distance**2 - RADIUS**2) + RADIUS * turn) + 0.2
    assert found.length == pytest.approx(expected, rel=1e-9)
    assert [piece.kind for piece in found.pieces if piece.kind != "turn"] == [
        "straight", "contact", "straight", "contact", "straight"
    ]  # fmt: skip


def test_all_robots_that_rotate_in_place_have_the_same_length():
    shapes = Circle(center=(3, 2), radius=0.5), Circle(center=(3, 3.4), radius=0.3)
    slow, other = Unicycle(radius=RADIUS, max_speed=0.1), DifferentialDrive(radius=RADIUS)
    lengths = [minimum_length(among(*shapes, robot=robot)).length for robot in (slow, other)]
    assert lengths[0] == lengths[1]


def test_a_closed_passage_has_no_path():
    wall = Polygon(vertices=((2.9, -1.0), (3.1, -1.0), (3.1, 5.0), (2.9, 5.0)))
    with pytest.raises(SolveError) as error:
        minimum_length(among(wall))
    assert error.value.extremal.status is Status.NO_PATH


@pytest.mark.slow
def test_the_length_of_a_box_is_close_to_its_lower_bound():
    scenario = among(Circle(center=(3, 2.1), radius=0.5), robot=Unicycle(footprint=Box(length=0.5, width=0.3)))
    found = minimum_length(scenario, 5e-3)
    assert found.lower_bound < found.length < 1.01 * found.lower_bound
    assert found.tolerance == pytest.approx(found.length / found.lower_bound - 1)
    assert "contact" in [piece.kind for piece in found.pieces]
    assert found.extremal.certificate.clearance > 0


def test_the_length_of_a_robot_that_cannot_stop_is_that_of_dubins():
    goal = (1, 2, 1)
    found = minimum_length(in_the_open(Unicycle(speed=(0.5, 1.0), max_turn_rate=1.0), goal))
    shortest = 0.5 * min(dubins((2, 4, 1)).values())
    assert shortest * (1 - 1e-9) <= found.length <= shortest * (1 + 1e-3)
    assert found.lower_bound == pytest.approx(math.sqrt(5))


@pytest.mark.slow
def test_the_length_of_a_car_is_that_of_reeds_and_shepp():
    robot = Car()
    radius = 1 / robot.max_curvature
    for x, y, heading in ((1, 2, 1.0), (0.3, 1, 0.2)):
        found = minimum_length(in_the_open(robot, (x, y, heading)))
        shortest = radius * min(reeds_shepp((x / radius, y / radius, heading)).values())
        assert shortest * (1 - 1e-6) <= found.length <= shortest * (1 + 2e-3)


def test_the_pieces_are_drawn(tmp_path):
    scenario = among(Circle(center=(3, 2), radius=0.5))
    path = tmp_path / "pieces.png"
    plot_pieces(scenario, minimum_length(scenario).pieces, path)
    assert path.stat().st_size > 0


def test_invalid_arguments_of_the_minimum_length_are_named():
    with pytest.raises(TypeError, match="scenario: expected a Scenario"):
        minimum_length(None)
    with pytest.raises(ValueError, match="tol: expected a number below 1"):
        minimum_length(among(), tol=2)
