"""Moving obstacles: scenario files, positions over time, proximity cost with derivatives, sensing and contacts."""

import math

import numpy as np
import pytest
from helpers import scenario_fields

from leapnav.envs import NavigateEnv, NavigateVectorEnv, Scenario, ScenarioError
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.layout import read_header
from leapnav.envs.field.moving import moving_disc_proximity, moving_footprint_proximity
from leapnav.envs.field.packing import check_field, displacements, field_parts, parts_at, replace_parts
from leapnav.envs.field.proximity import footprint_value, proximity

CIRCLE = {"center": [4.0, 4.0], "radius": 0.5}
PATH = {"times": [1.0, 3.0, 5.0], "points": [[4.0, 4.0], [6.0, 4.0], [6.0, 7.0]]}
TRIANGLE = {"vertices": [[6.0, 2.0], [7.0, 2.2], [6.4, 3.0]]}


def task(obstacles, **changes):
    return Scenario.from_dict(scenario_fields(obstacles=obstacles, **changes))


def test_a_path_is_linear_between_its_points_and_ends_at_rest():
    scenario = task([{"circle": CIRCLE, "path": PATH}])
    (obstacle,) = scenario.obstacles
    at = displacements(obstacle.knots, np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 9.0]))
    np.testing.assert_allclose(at, [[0, 0], [0, 0], [0, 0], [1, 0], [2, 0], [2, 1.5], [2, 3], [2, 3]])
    assert Scenario.from_dict(scenario.to_dict()) == scenario
    assert scenario.moves


def test_an_obstacle_that_does_not_move_is_at_rest():
    still = task([{"circle": CIRCLE, "velocity": [0.0, 0.0]}])
    assert not still.moves
    np.testing.assert_array_equal(still.field, task([{"circle": CIRCLE}]).field)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"velocity": [1.0]}, r"obstacles\[0\].velocity"),
        ({"velocity": [1.0, 0.0], "mass": 2.0}, "only one of 'mass' and 'velocity'"),
        ({"path": {"times": [0, 0], "points": [[4, 4], [5, 4]]}}, "expected at least two increasing numbers"),
        ({"path": {"times": [0, 1], "points": [[4, 4]]}}, "points: expected 2, one for each time, got 1"),
        ({"path": {"times": [0, 1], "points": [[3, 4], [5, 4]]}}, "expected the center"),
    ],
)
def test_invalid_motions_are_named(options, message):
    with pytest.raises(ScenarioError, match=message):
        task([{"circle": CIRCLE, **options}])


def test_start_and_goal_are_checked_when_the_robot_is_there():
    approaching = {"circle": CIRCLE, "velocity": [0.4, 0.4]}
    with pytest.raises(ScenarioError, match=r"goal: \(8, 8\) is inside obstacles\[0\]"):
        task([approaching], horizon=10.0)
    assert task([approaching], horizon=5.0).moves
    assert task([approaching], horizon=None, cost={"time_weight": 1.0}).moves


def test_the_field_at_a_time_has_the_obstacles_there():
    scenario = task([{"circle": CIRCLE, "path": PATH}, {"polygon": TRIANGLE, "velocity": [-0.5, 0.3]}])
    rng = np.random.default_rng(0)
    for time in (0.0, 1.7, 4.2, 8.0):
        still = replace_parts(scenario.field, parts_at(scenario.field, time))
        for x, y in rng.uniform(1, 9, size=(20, 2)):
            q = np.array([x, y, 0.3])
            timed = np.append(q, time)
            assert footprint_clearance(timed, scenario.outline, scenario.field) == pytest.approx(
                footprint_clearance(q, scenario.outline, still), abs=1e-12
            )
            value = footprint_value(timed, scenario.outline, scenario.field)
            assert value == pytest.approx(footprint_value(q, scenario.outline, still), abs=1e-8)
            moving = moving_disc_proximity(x, y, time, 0.25, scenario.field)[0]
            whole = proximity(x, y, scenario.field)[0] + moving  # the first has the walls only
            assert whole == pytest.approx(proximity(x, y, still)[0], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("footprint", [None, {"box": {"length": 0.6, "width": 0.3, "offset": 0.1}}])
def test_derivatives_agree_with_finite_differences(footprint):
    robot = {"model": "unicycle", **({"footprint": footprint} if footprint else {"radius": 0.25})}
    scenario = task([{"circle": CIRCLE, "path": PATH}, {"polygon": TRIANGLE, "velocity": [-0.5, 0.3]}], robot=robot)
    data = scenario.outline.ravel()

    def evaluate(z):
        if footprint is None:
            phi, *rest = moving_disc_proximity(z[0], z[1], z[3], 0.25, scenario.field)
            gradient = np.insert(rest[:3], 2, 0.0)
            hessian = np.zeros((4, 4))
            for (a, b), value in zip(((0, 0), (0, 1), (0, 3), (1, 1), (1, 3), (3, 3)), rest[3:], strict=True):
                hessian[a, b] = hessian[b, a] = value
            return phi, gradient, hessian
        phi, *rest = moving_footprint_proximity(*z, 0, data, 0, scenario.field)
        hessian = np.zeros((4, 4))
        hessian[np.triu_indices(4)] = rest[4:]
        return phi, np.array(rest[:4]), hessian + np.triu(hessian, 1).T

    rng, h = np.random.default_rng(1), 1e-5
    for _ in range(100):
        z = np.append(rng.uniform(3, 7.5, size=2), [rng.uniform(-3, 3), rng.uniform(0.2, 6)])
        if footprint_clearance(z, scenario.outline, scenario.field)[0] < 0.02:
            continue
        _, gradient, hessian = evaluate(z)
        for k, step in enumerate(h * np.eye(4)):
            above, below = evaluate(z + step), evaluate(z - step)
            size = 1e-4 * (1e-3 + np.abs(hessian).max())
            assert gradient[k] == pytest.approx((above[0] - below[0]) / (2 * h), abs=size)
            if np.abs(above[2] - below[2]).max() < 1e-2 * np.abs(hessian).max():  # no closest feature changes
                np.testing.assert_allclose(hessian[k], (above[1] - below[1]) / (2 * h), atol=size)


def test_the_packed_field_is_checked():
    scenario = task([{"circle": CIRCLE, "path": PATH}, {"circle": {"center": [2, 6], "radius": 0.3}}])
    assert check_field(scenario.field) is not None
    assert [len(part.knots) for part in field_parts(scenario.field)] == [0, 3]
    broken = scenario.field.copy()
    read_header(broken)["knots"] = 2
    with pytest.raises(ValueError, match="not a packed field"):
        check_field(broken)


def test_the_rest_of_a_scenario_has_the_obstacles_where_they_are():
    scenario = task(
        [{"circle": CIRCLE, "path": PATH}, {"circle": {"center": [2, 6], "radius": 0.3}, "velocity": [0.2, 0]}]
    )
    rest = scenario.from_state((1.0, 1.0, 0.0), 2.5)
    for time in (0.0, 1.0, 4.0):
        for one, other in zip(parts_at(scenario.field, 2.5 + time), parts_at(rest.field, time), strict=True):
            np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-9)


def drive(scenario, actions, **options):
    env = NavigateEnv("clutter", observation="lidar", **options)
    env.reset(options={"scenario": scenario})
    rows, infos = [], []
    for action in actions:
        observation, _, terminated, truncated, info = env.step(np.array(action, dtype=np.float32))
        rows.append(observation)
        infos.append(info)
        if terminated or truncated:
            break
    return rows, infos, env


def test_an_obstacle_that_runs_into_a_standing_robot_is_a_collision():
    approaching = {"circle": {"center": [4.0, 1.0], "radius": 0.5}, "velocity": [-1.0, 0.0]}
    scenario = task([approaching], start=[1.0, 1.0, 0.0])
    _, infos, _ = drive(scenario, [(0.0, 0.0)] * 50)
    # The rim of the robot is at x = 1.25, that of the disc at 3.5 - t.
    assert infos[-1]["collision"]
    assert infos[-2]["time"] < 2.25 <= infos[-1]["time"] + 1e-9
    later = [info for info in infos[:-1] if info["time"] > 1.6]  # before, the wall is nearer
    for info in later:
        assert info["clearance"] == pytest.approx(2.25 - info["time"], rel=0.02, abs=1e-3)


def test_a_fast_obstacle_is_not_missed_between_two_steps():
    """It crosses the robot within one control period."""
    fast = {"circle": {"center": [4.0, 1.0], "radius": 0.05}, "velocity": [-100.0, 0.0]}
    scenario = task([fast], start=[1.0, 1.0, 0.0])
    _, infos, _ = drive(scenario, [(0.0, 0.0)] * 5)
    assert len(infos) == 1
    assert infos[0]["collision"]


def test_the_lidar_sees_where_the_obstacle_is():
    leaving = {"circle": {"center": [3.0, 1.0], "radius": 0.5}, "velocity": [0.5, 0.0]}
    scenario = task([leaving], start=[1.0, 1.0, 0.0])
    _, infos, env = drive(scenario, [(0.0, 0.0)] * 10)
    assert env.unwrapped._simulator.ranges(0)[0] == pytest.approx(1.5 + 0.5 * infos[-1]["time"], abs=1e-9)


@pytest.mark.parametrize("actuation", ["velocity", "motor"])
def test_a_robot_that_stays_in_the_way_is_pushed(actuation):
    """After the collision the episode goes on."""
    approaching = {"circle": {"center": [4.0, 2.0], "radius": 0.5}, "velocity": [-1.0, 0.0]}
    scenario = task([approaching], start=[2.0, 2.0, 0.0], arena=[-5, 0, 10, 10])
    options = {"terminate_on_collision": False, "actuation": actuation}
    _, infos, env = drive(scenario, [(0.0, 0.0)] * 60, **options)
    assert infos[-1]["collision"]
    robot, disc = env.unwrapped.pose[0], 4.0 - infos[-1]["time"]
    assert robot < 1.9
    assert robot <= disc - 0.75 + 5e-3  # never inside the disc


def test_the_cost_of_standing_beside_a_passing_obstacle_is_its_integral():
    passing = {"circle": {"center": [3.0, 2.0], "radius": 0.5}, "velocity": [-1.0, 0.0]}
    scenario = task([passing], start=[1.0, 1.0, 0.0])
    _, infos, _ = drive(scenario, [(0.0, 0.0)] * 20)
    end = infos[-1]["time"]
    times = np.linspace(0.0, end, 20_001)
    values = [footprint_value(np.array([1.0, 1.0, 0.0, t]), scenario.outline, scenario.field) for t in times]
    assert infos[-1]["cost"] == pytest.approx(np.trapezoid(values, times), rel=2e-4)
    assert math.isclose(end, 20 * infos[0]["time"])


SCENE = [
    {"circle": {"center": [3.0, 1.0], "radius": 0.5}, "velocity": [0.0, 0.5]},
    {"polygon": {"vertices": [[1.0, 3.0], [2.0, 3.0], [1.5, 4.0]]}},
    {"capsule": {"start": [-1.0, 0.5], "end": [-1.0, 1.5], "radius": 0.3}, "velocity": [-0.2, 0.1]},
]


def observed(observation, heading, **options):
    scenario = task(SCENE, start=[1.0, 1.0, heading], goal=[7.0, 7.0, 0.0], arena=[-5, -5, 10, 10])
    env = NavigateEnv(scenario=scenario, observation=observation, lidar_beams=64, **options)
    flat, _ = env.reset(seed=0)
    return {name: flat[part] for name, part in env._simulator.layout.parts.items()}, env


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_beams_have_the_velocity_of_what_they_meet(heading):
    parts, _ = observed("geodesic", heading)
    ahead, left = parts["velocities"].reshape(2, 64)
    angles = heading + 2 * math.pi * np.arange(64) / 64
    found = ahead * np.exp(1j * heading) + left * np.exp(1j * (heading + math.pi / 2))
    hits = np.array([1.0 + 1.0j]) + parts["lidar"] * np.exp(1j * angles)
    expected = np.zeros(64, complex)
    expected[np.abs(np.abs(hits - (3.0 + 1.0j)) - 0.5) < 1e-5] = 0.5j
    on_capsule = np.abs(np.abs(hits.real + 1.0) - 0.3) < 1e-5
    expected[on_capsule & (hits.imag > 0.5) & (hits.imag < 1.5)] = -0.2 + 0.1j
    met = expected != 0
    assert met.sum() > 8
    np.testing.assert_allclose(found[met], expected[met], atol=1e-6)
    assert (found[(np.abs(hits.real) > 4) | (hits.imag > 2.5)] == 0).all()  # walls, and what is at rest


def test_the_map_has_the_velocities_in_its_order():
    parts, _ = observed("map", math.pi / 2)
    rows = parts["obstacles"].reshape(8, 18)
    velocities = parts["velocities"].reshape(8, 2)
    assert rows[:3, 0].all() and not rows[3:].any() and not velocities[3:].any()
    by_radius = {round(float(radius), 3): velocity for radius, velocity in zip(rows[:3, 1], velocities, strict=False)}
    np.testing.assert_allclose(by_radius[0.5], [0.5, 0.0], atol=1e-6)  # upwards is ahead
    np.testing.assert_allclose(by_radius[0.3], [0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(by_radius[0.0], [0.0, 0.0])


def test_velocities_are_observed_where_obstacles_move_unless_it_is_said():
    assert observed("map", 0.0)[1].settings.velocities and observed("geodesic", 0.0)[1].settings.velocities
    assert "velocities" not in observed("map", 0.0, velocities=False)[0]
    assert "velocities" not in observed("lidar", 0.0)[0]
    at_rest = NavigateEnv("clutter", observation="map")
    assert not at_rest.settings.velocities
    assert (
        NavigateEnv("clutter", observation="map", velocities=True).observation_space.shape[0]
        == 16 + (at_rest.observation_space.shape[0])
    )
    assert NavigateEnv("crossing", observation="geodesic").settings.velocities
    with pytest.raises(ValueError, match="velocities: expected False for the observation 'lidar', got True"):
        NavigateEnv("crossing", velocities=True)


def test_the_geodesic_distance_is_that_among_obstacles_at_rest():
    parts, _ = observed("geodesic", 0.0)
    still = task([SCENE[1]], start=[1.0, 1.0, 0.0], goal=[7.0, 7.0, 0.0], arena=[-5, -5, 10, 10])
    flat, _ = NavigateEnv(scenario=still, observation="geodesic", lidar_beams=64).reset(seed=0)
    assert parts["distance"][0] == flat[-1]


@pytest.mark.parametrize("observation", ["lidar", "map", "geodesic"])
def test_vector_episodes_are_bitwise_those_of_single_environments(observation):
    options = {"family": "crowd", "split": "test", "observation": observation}
    venv = NavigateVectorEnv(4, **options)
    batch, _ = venv.reset(options={"index": [0, 1, 2, 3]})
    singles = [NavigateEnv(**options) for _ in range(4)]
    for k, env in enumerate(singles):
        assert (env.reset(options={"index": k})[0] == batch[k]).all()
    actions = np.random.default_rng(0).uniform(-1, 1, (25, 4, 2)).astype(np.float32)
    ended = np.zeros(4, bool)
    for action in actions:
        batch, rewards, terminated, truncated, _ = venv.step(action)
        for k, env in enumerate(singles):
            if not ended[k]:
                observation, reward, *_ = env.step(action[k])
                assert (observation == batch[k]).all() and reward == rewards[k]
        ended |= terminated | truncated
