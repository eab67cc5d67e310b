"""Minimum time against the closed forms of Dubins' car, Reeds and Shepp's car and the differential drive."""

import math

import numpy as np
import pytest
import sympy as sp
from helpers import scenario_fields
from shortest_words import balkcom_mason, dubins, end_of, family_of, reeds_shepp

from leapnav.envs import Scenario, sample_scenario
from leapnav.envs.robots import DynamicUnicycle, Unicycle
from leapnav.envs.shapes import Circle
from leapnav.experts import ControlAffineSystem, OptimalControlProblem, minimum_time
from leapnav.experts.problem.system import differential_drive, unicycle
from leapnav.experts.solvers.piecewise import piecewise_paths

X, Y, HEADING = sp.symbols("x y theta")
DUBINS = ControlAffineSystem(
    (X, Y, HEADING),
    (sp.cos(HEADING), sp.sin(HEADING), 0),
    ((0, 0, 1),),
    angles=(HEADING,),
    position=(X, Y),
    heading=HEADING,
)
# A goal to which each word is the shortest.
DUBINS_GOALS = {
    "LRL": (-0.62, -0.48, 2.98),
    "LSL": (-2.65, -0.5, -1.35),
    "LSR": (4.54, 0.44, -0.58),
    "RLR": (0.57, 2.43, 1.1),
    "RSL": (0.37, 0.82, 0.96),
    "RSR": (-2.52, -1.95, 0.35),
}
REEDS_SHEPP_GOALS = {
    "CC|C": (1.35, -0.4, 0.85),
    "CC|CC": (0.02, 0.53, -0.28),
    "CSC": (4.54, 0.44, -0.58),
    "CSC|C": (-2.65, -0.5, -1.35),
    "C|CC": (0.37, 0.82, 0.96),
    "C|CC|C": (-0.53, 0.69, 0.03),
    "C|CSC": (-0.25, -2.36, 1.13),
    "C|CSC|C": (1.09, -4.41, 0.04),
    "C|C|C": (-0.62, -0.48, 2.98),
}


def dubins_problem(goal):
    return OptimalControlProblem(DUBINS, (0, 0, 0), goal, None, (1.0,), time_weight=1.0, control_bounds=((-1, 1),))


def reeds_shepp_problem(goal):
    """The speed and the turn rate are in a square, the convex hull of the controls of Reeds and Shepp's car.

    The minimum times are the same (H. J. Sussmann and G. Tang, Shortest paths for the Reeds-Shepp car, 1991).
    """
    bounds = ((-1, 1), (-1, 1))
    return OptimalControlProblem(unicycle(), (0, 0, 0), goal, None, (1.0, 1.0), time_weight=1.0, control_bounds=bounds)


def drive_problem(goal):
    return OptimalControlProblem(
        differential_drive(),
        (0, 0, 0),
        goal,
        None,
        (1.0, 1.0),
        time_weight=1.0,
        control_bounds=((-1, 1), (-1, 1)),
        parameters=(2.0,),
    )


def check(problem, shortest):
    found = minimum_time(problem)
    assert shortest * (1 - 1e-9) <= found.horizon <= shortest * (1 + 1e-4)
    assert found.lower_bound <= shortest
    assert found.tolerance <= 1e-3
    return found


def random_goals(count, seed=0):
    rng = np.random.default_rng(seed)
    scales = rng.choice([0.5, 1.0, 2.0, 4.0], size=count)
    return [
        (*(float(v) for v in scale * rng.normal(size=2)), float(rng.uniform(-math.pi, math.pi))) for scale in scales
    ]


@pytest.mark.parametrize("word", DUBINS_GOALS)
def test_the_minimum_time_of_each_word_of_dubins(word):
    lengths = dubins(DUBINS_GOALS[word])
    assert min(lengths, key=lengths.get) == word
    check(dubins_problem(DUBINS_GOALS[word]), lengths[word])


@pytest.mark.parametrize("family", REEDS_SHEPP_GOALS)
def test_the_minimum_time_of_each_family_of_reeds_and_shepp(family):
    lengths = reeds_shepp(REEDS_SHEPP_GOALS[family])
    shortest = min(lengths, key=lengths.get)
    assert family_of(shortest) == family
    check(reeds_shepp_problem(REEDS_SHEPP_GOALS[family]), lengths[shortest])


@pytest.mark.parametrize(
    "goal", [(0, 1, 0), *(pytest.param(goal, marks=pytest.mark.slow) for goal in ((0.3, 0.1, 2.5), (3, 1, 0.5)))]
)
def test_the_minimum_time_of_the_differential_drive(goal):
    check(drive_problem(goal), balkcom_mason(goal, starts=10))


@pytest.mark.slow
@pytest.mark.parametrize("goal", random_goals(20))
def test_the_minimum_times_of_random_goals(goal):
    check(dubins_problem(goal), min(dubins(goal).values()))
    check(reeds_shepp_problem(goal), min(reeds_shepp(goal).values()))
    check(drive_problem(goal), balkcom_mason(goal, starts=10))


@pytest.mark.slow
def test_the_closed_forms_agree_with_each_other():
    for x, y, heading in random_goals(50, 1):
        length = min(reeds_shepp((x, y, heading)).values())
        # Cusps, and controls in the convex hull, do not make a path longer.
        assert length <= min(dubins((x, y, heading)).values()) + 1e-9
        for mirrored in ((x, -y, -heading), (-x, y, -heading)):
            assert min(reeds_shepp(mirrored).values()) == pytest.approx(length, rel=1e-9)
    assert balkcom_mason((0, 1, 0), starts=10) == pytest.approx(2 * math.pi / 3 + math.sqrt(3), rel=1e-8)
    # The half turn of a car without obstacles: three arcs of 60 degrees.
    assert min(reeds_shepp((0, 0, math.pi)).values()) == pytest.approx(math.pi, rel=1e-9)


def test_paths_of_few_pieces_end_at_the_goal():
    goal = DUBINS_GOALS["LRL"]
    paths = piecewise_paths(dubins_problem(goal))
    shortest = min(dubins(goal).values())
    assert paths[0].time == pytest.approx(shortest, rel=5e-3)
    assert [path.time for path in paths] == sorted(path.time for path in paths)
    for path in paths:
        pieces = tuple(
            ({-1: "R", 0: "S", 1: "L"}[int(control)], float(duration))
            for control, duration in zip(path.controls[:, 0], path.durations, strict=True)
        )
        x, y, heading = end_of(pieces)
        # The midpoint rule with few steps is not exact on arcs.
        assert math.hypot(x - goal[0], y - goal[1]) < 0.1
        assert abs(math.remainder(heading - goal[2], 2 * math.pi)) < 1e-2


def test_a_robot_that_cannot_stop_finds_the_word_of_dubins():
    goal = DUBINS_GOALS["LRL"]
    scenario = Scenario(
        arena=(-20, -20, 20, 20),
        robot=Unicycle(speed=(1.0, 1.001), max_turn_rate=1.0),
        start=(0, 0, 0),
        goal=goal,
        horizon=None,
        cost={"time_weight": 1.0},
    )
    assert minimum_time(scenario).horizon == pytest.approx(min(dubins(goal).values()), rel=1e-3)


def test_the_pieces_of_a_path_of_dubins_are_those_of_its_word():
    found = minimum_time(dubins_problem(DUBINS_GOALS["LSR"]))
    assert [piece.kind for piece in found.pieces] == ["turn", "straight", "turn"]
    left, line, right = found.pieces
    assert left.turn > 0 > right.turn and abs(line.turn) < 0.1
    assert sum(piece.duration for piece in found.pieces) == pytest.approx(found.horizon, rel=1e-9)
    assert sum(piece.length for piece in found.pieces) == pytest.approx(found.horizon, rel=1e-3)
    text = str(found)
    assert "straight" in text and f"time {found.horizon:.6g} s" in text


def test_contact_with_a_hard_obstacle_is_a_piece():
    scenario = Scenario(
        arena=(0, 0, 6, 4),
        robot=Unicycle(radius=0.25, max_speed=1.0, max_turn_rate=2.0),
        start=(1, 2, 0),
        goal=(5, 2, 0),
        horizon=None,
        obstacles=({"circle": Circle(center=(3, 2.1), radius=0.5)},),
        cost={"time_weight": 1.0, "proximity_weight": 0.0},
    )
    found = minimum_time(scenario, 1e-2)
    assert [piece.obstacle for piece in found.pieces if piece.kind == "contact"] == ["obstacles[0]"]
    assert "obstacles[0]" in str(found)


def test_without_a_pose_the_controls_are_printed():
    x, v = sp.symbols("x v")
    system = ControlAffineSystem((x, v), (v, 0), ((0, 1),))
    problem = OptimalControlProblem(system, (0, 0), (1, 0), 1.0, (1.0,), control_bounds=((-1, 1),))
    found = minimum_time(problem)
    assert found.pieces == () and "controls 1" in str(found)


@pytest.mark.slow
def test_the_best_of_several_paths_has_at_most_the_time_of_the_optimum():
    for seed in range(4):
        scenario = sample_scenario("clutter", seed, obstacles="hard")
        scenario = scenario.model_copy(
            update={"horizon": None, "cost": scenario.cost.model_copy(update={"time_weight": 1.0})}
        )
        found = minimum_time(scenario, 1e-2)
        assert found.tolerance == pytest.approx(1e-2) and found.extremal.certificate.clearance > 0


def test_the_weights_of_speed_and_turn_rate_do_not_change_the_minimum_time():
    """From rest to rest over a distance d with the acceleration a: 2 sqrt(d / a)."""
    robot = DynamicUnicycle(max_acceleration=1.0, max_angular_acceleration=2.0)
    times = []
    for weight in (0.01, 1.0):
        fields = scenario_fields(start=[1, 1, 0], goal=[5, 1, 0], robot=robot, obstacles=[], horizon=None)
        fields["cost"] = {"time_weight": 1.0, "speed_weight": weight, "turn_weight": weight, "proximity_weight": 0.0}
        times.append(minimum_time(Scenario.from_dict(fields), 1e-2).horizon)
    assert times == pytest.approx([4.0, 4.0], rel=1e-2)
