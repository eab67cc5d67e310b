"""Robots with a trailer: the footprint with a joint, the hitch angle as a state, and its limits."""

import json
import math

import numpy as np
import pytest

from leapnav.envs import Box, NavigateEnv, Scenario, ScenarioError, Trailer, Unicycle
from leapnav.envs.field.clearance import footprint_clearance, footprint_clearances
from leapnav.envs.field.proximity import footprint_proximities
from leapnav.experts import OptimalControlProblem, find_optimum

ROBOT = {
    "model": "trailer",
    "footprint": {"box": {"length": 0.6, "width": 0.3, "offset": 0.15}},
    "wheelbase": 0.35,
    "hitch_length": 0.5,
    "trailer": {"box": {"length": 0.4, "width": 0.24, "offset": -0.05}},
}
WALLS = [
    {"polygon": {"vertices": [[2.5, 0], [3, 0], [3, 1.8], [2.5, 1.8]]}},
    {"circle": {"center": [3.2, 3.3], "radius": 0.3}},
    {"capsule": {"start": [4.4, 1.0], "end": [5.0, 1.2], "radius": 0.2}},
]


def task(**changes):
    fields = {"arena": [0, 0, 6, 4], "robot": ROBOT, "start": [1.5, 1, 0], "goal": [4.5, 3, 1.57], "horizon": 6.0}
    return Scenario.from_dict({**fields, "obstacles": WALLS, **changes})


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    low, high = (0.3, 0.3, -math.pi, -1.5, -1.2), (5.7, 3.7, math.pi, 1.5, 1.2)
    return rng.uniform(low, high, (count, 5))


def test_robot_and_trailer_are_two_boxes_at_their_poses():
    scenario, states = task(), random_states(300)
    towed = Unicycle(footprint=Box(length=0.4, width=0.24, offset=-0.55)).outline()  # the hitch is its reference point
    alone = Unicycle(footprint=Box(length=0.6, width=0.3, offset=0.15)).outline()
    poses = states[:, :3].copy()
    first = footprint_clearances(poses, alone, scenario.field)
    costs = footprint_proximities(poses, alone, scenario.field)
    poses[:, 2] += states[:, 4]
    second = footprint_clearances(poses, towed, scenario.field)
    costs += footprint_proximities(poses, towed, scenario.field)
    found = footprint_clearances(states, scenario.outline, scenario.field)
    assert np.array_equal(found, np.minimum(first, second))
    assert (second < first).sum() > 50  # the trailer counts
    free = found > 0.01
    assert footprint_proximities(states, scenario.outline, scenario.field)[free] == pytest.approx(costs[free], rel=1e-9)


def test_derivatives_of_the_state_cost_with_a_joint():
    problem = OptimalControlProblem.from_scenario(task())
    function, arrays, n = problem.compiled_dynamics.state_cost, problem.arrays, 5

    def evaluate(q):
        gradient, hessian = np.zeros(n), np.zeros((n, n))
        value = function(np.ascontiguousarray(q), arrays.data, arrays.field, gradient, hessian)
        return value, gradient, hessian

    checked, step = 0, 1e-6
    for state in random_states(60, seed=1):
        if footprint_clearance(state, problem.outline, arrays.field)[0] < 0.02:
            continue
        _, gradient, hessian = evaluate(state)
        ends = [(evaluate(state + step * e), evaluate(state - step * e)) for e in np.eye(n)]
        slopes = [(above[0] - below[0]) / (2 * step) for above, below in ends]
        curvatures = [(above[1] - below[1]) / (2 * step) for above, below in ends]
        scale = max(1.0, np.abs(hessian).max())
        assert gradient == pytest.approx(slopes, rel=1e-5, abs=1e-6 * scale)
        assert hessian == pytest.approx(np.array(curvatures), rel=1e-4, abs=1e-4 * scale)
        checked += abs(gradient[4]) > 1e-6
    assert checked > 10


def test_the_hitch_angle_of_an_optimum_is_within_its_limits():
    changes = {"start": [2.2, 2.8, 0], "goal": [4.5, 2.4, -2.2], "obstacles": []}
    free = find_optimum(task(**changes))
    assert free.success and np.abs(free.states[:, 4]).max() > 0.7
    limited = find_optimum(task(**changes, robot={**ROBOT, "max_hitch_angle": 0.6}))
    assert limited.success and np.abs(limited.states[:, 4]).max() < 0.6
    assert limited.cost > free.cost


def test_a_steep_barrier_is_not_taken_for_a_conjugate_point():
    """The sensitivities of this path are so small while it touches a corner that they look like a loss of rank."""
    robot = {
        "model": "trailer",
        "footprint": {"box": {"length": 0.5, "width": 0.25}},
        "wheelbase": 0.25,
        "max_steering": math.pi / 3,
        "speed": [-0.1, 0.5],
        "max_steering_rate": 10.0,
        "steering_weight": 0.01,
        "trailer": {"box": {"length": 0.3, "width": 0.25}},
        "hitch_length": 0.5,
    }
    boxes = [[[x - 0.25, 0.075], [x + 0.25, 0.075], [x + 0.25, 0.325], [x - 0.25, 0.325]] for x in (0.7, 2.7)]
    cost = {"time_weight": 1.0, "speed_weight": 4.0, "proximity_weight": 0.0, "proximity_scale": 0.02}
    scenario = Scenario.from_dict(
        {
            "arena": [0.0, -0.5, 3.5, 2.5],
            "robot": robot,
            "start": [0.7, 0.6, 0],
            "goal": [1.9, 0.2, 0],
            "start_motion": [0, 0],
            "goal_motion": [None, 0],
            "horizon": None,
            "obstacles": [{"polygon": {"vertices": vertices}} for vertices in boxes],
            "cost": cost,
        }
    )
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.certificate.clearance < 1e-3
    assert optimum.cost == pytest.approx(5.1405, rel=1e-3)


def test_in_contact_robot_and_trailer_are_one_rigid_body():
    env = NavigateEnv(scenario=task(start_motion=[0.0, 0.4]), terminate_on_collision=False)
    env.reset()
    infos = [env.step(np.array([0.8, 0.0], dtype=np.float32))[-1] for _ in range(60)]
    touching = [info for info in infos if info["collision"]]
    assert len(touching) > 5 and infos[0]["motion"][1] < 0.4  # it decays until the contact
    assert (
        np.ptp([info["motion"][1] for info in touching[1:]]) < 1e-2
    )  # between two contacts it may move by a millimetre
    states = np.array([[*info["pose"], *info["motion"]] for info in touching])
    assert footprint_clearances(states, env.scenario.outline, env.scenario.field).min() > -5e-3


def test_a_scenario_with_a_trailer_is_read_as_it_was_written():
    scenario = task(robot={**ROBOT, "hitch_angle": [-0.8, 1.0]}, start_motion=[0.1, 0.2])
    assert Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))) == scenario
    assert isinstance(scenario.robot, Trailer) and scenario.robot.state_bounds()[4] == (-0.8, 1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": {**ROBOT, "hitch_angle": [0.1, 1.0]}}, r"hitch_angle: expected an interval in \(-pi, pi\)"),
        ({"robot": {**ROBOT, "max_hitch_angle": 4.0}}, "robot.max_hitch_angle: expected a number < 3.14159"),
        ({"robot": {**ROBOT, "hitch_length": 0.0}}, "robot.hitch_length: expected"),
        ({"robot": {**ROBOT, "trailer": {"box": {"length": 1.0}}}}, "robot.trailer.box.width: missing"),
        ({"robot": {**ROBOT, "max_hitch_angle": 0.3}, "start_motion": [0, 0.5]}, "hitch_angle from -0.3 to 0.3, got 0"),
        ({"start": [0.7, 0.55, 0], "start_motion": [0, 1.4]}, r"start: \(0.7, 0.55\) is inside the arena wall"),
        ({"goal": [0.85, 0.55, 0], "goal_motion": [0, 1.4]}, r"goal: \(0.85, 0.55\) is inside the arena wall"),
    ],
)
def test_an_invalid_robot_with_a_trailer_is_named(changes, message):
    with pytest.raises(ScenarioError, match=message):
        task(**changes)


def test_a_goal_with_a_free_hitch_angle_needs_some_angle_without_contact():
    assert task(goal=[0.6, 0.55, 0.0]).goal_state == (0.6, 0.55, 0.0, None, None)  # straight behind it is the wall
    with pytest.raises(ScenarioError, match=r"goal: .* is inside the arena wall"):
        task(goal=[0.6, 0.55, 0.0], goal_motion=[None, 0.0])
