"""Obstacles with a mass, which a robot pushes."""

import pickle

import numpy as np
import pytest

from leapnav.envs import Capsule, Circle, NavigateEnv, NavigateVectorEnv, Obstacle, Polygon, Scenario
from leapnav.envs.field.packing import field_parts
from leapnav.experts import find_optimum

SQUARE = Polygon(vertices=((3.0, 1.5), (4.0, 1.5), (4.0, 2.5), (3.0, 2.5)))
AHEAD = np.array([0.8, 0.0])


def task(mass, shape=SQUARE, others=(), **changes):
    fields = {"arena": (0, 0, 8, 4), "start": (1, 2, 0), "goal": (7, 2, 0), "horizon": 12.0, **changes}
    return Scenario(name="push", obstacles=(Obstacle(**{shape.kind: shape}, mass=mass), *others), **fields)


def centre(env, part=0):
    """The centre of a part of the obstacles, as the environment sees it."""
    return field_parts(env.unwrapped._simulator.fields[0])[part].vertices.mean(axis=0)


def pushed(scenario, steps=60, **settings):
    """An environment after the robot has driven ahead, into the obstacle."""
    env = NavigateEnv(scenario=scenario, terminate_on_collision=False, **settings)
    env.reset(seed=0)
    for _ in range(steps):
        _, _, _, _, info = env.step(AHEAD)
    assert info["collision"]
    return env


@pytest.mark.parametrize(
    "shape",
    [SQUARE, Circle(center=(3.5, 2.0), radius=0.5), Capsule(start=(3.5, 1.5), end=(3.5, 2.5), radius=0.3)],
    ids=lambda shape: shape.kind,
)
def test_a_robot_pushes_light_obstacles_farther_than_heavy_ones(shape):
    ways = [float(centre(pushed(task(mass, shape)))[0] - 3.5) for mass in (1.0, 10.0, 50.0, 200.0, None)]
    assert ways == sorted(ways, reverse=True)
    assert ways[0] > 2.0 and ways[-1] == 0.0
    env = pushed(task(1.0, shape))
    assert env.pose[0] < centre(env)[0] and abs(centre(env)[1] - 2.0) < 1e-3  # in front of the robot


def test_motors_are_too_weak_for_heavy_obstacles():
    light, heavy = (float(centre(pushed(task(mass), actuation="motor"))[0] - 3.5) for mass in (1.0, 50.0))
    assert light > 1.0 and heavy < 0.05


def test_an_obstacle_hit_off_its_centre_turns_and_stays_where_it_was_left():
    high = Polygon(vertices=((3.0, 1.7), (4.0, 1.7), (4.0, 2.7), (3.0, 2.7)))
    env = pushed(task(3.0, high), steps=45)
    places = [field_parts(env.unwrapped._simulator.fields[0])[0].vertices]
    edge = places[0][1] - places[0][0]
    assert np.hypot(*edge) == pytest.approx(1.0) and abs(edge[1]) > 0.05
    for _ in range(20):
        env.step(-AHEAD)
        places.append(field_parts(env.unwrapped._simulator.fields[0])[0].vertices)
    assert np.array_equal(places[-1], places[5])  # no contact any more


def test_a_pushed_obstacle_stops_at_walls_and_pushes_other_obstacles():
    env = pushed(task(1.0, arena=(0, 0, 5, 4), goal=(4.6, 3.5, 0)), steps=100)
    assert centre(env)[0] == pytest.approx(4.5, abs=0.01) and env.pose[0] == pytest.approx(3.75, abs=0.01)
    other = Obstacle(circle=Circle(center=(4.5, 2.0), radius=0.4), mass=1.0)
    env = pushed(task(1.0, others=(other,)))
    assert centre(env, part=0)[0] > 5.5  # the disc, which is the first part


def test_observations_and_frames_show_the_obstacle_where_it_is():
    scenario = task(1.0)
    env = pushed(scenario, render_mode="rgb_array")
    moved = env.render()
    simulator = env.unwrapped._simulator
    assert simulator.ranges(0)[0] == pytest.approx(centre(env)[0] - 0.5 - env.pose[0], abs=1e-3)
    env.reset(seed=0)
    assert np.array_equal(centre(env), (3.5, 2.0)) and env.scenario == scenario
    assert not np.array_equal(env.render(), moved)


def test_where_a_collision_ends_the_episode_the_mass_has_no_effect():
    rows = []
    for mass in (None, 1.0):
        env = NavigateEnv(scenario=task(mass))
        env.reset(seed=0)
        rows.append([])
        terminated = False
        while not terminated:
            observation, reward, terminated, _, _ = env.step(AHEAD)
            rows[-1].append((observation.tobytes(), reward))
    assert rows[0] == rows[1]


def test_an_episode_continues_after_pickling_and_is_that_of_the_vector_environment():
    scenario = task(2.0)
    env = pushed(scenario, steps=40)
    copy = pickle.loads(pickle.dumps(env))
    vector = NavigateVectorEnv(2, scenario=scenario, terminate_on_collision=False)
    vector.reset(seed=0)
    for _ in range(40):
        vector.step(np.array([AHEAD, 0 * AHEAD]))
    for _ in range(20):
        observation, reward, *_ = env.step(AHEAD)
        again, same, *_ = copy.step(AHEAD)
        both, rewards, *_ = vector.step(np.array([AHEAD, 0 * AHEAD]))
        assert observation.tobytes() == again.tobytes() == both[0].tobytes()
        assert reward == same == rewards[0]


def test_a_mass_is_stored_and_the_expert_drives_around(tmp_path):
    scenario = task(2.5)
    scenario.to_json(tmp_path / "push.json")
    assert '"mass": 2.5' in (tmp_path / "push.json").read_text()
    assert Scenario.from_json(tmp_path / "push.json") == scenario != task(None)
    assert find_optimum(scenario).cost == find_optimum(task(None)).cost


@pytest.mark.parametrize("mass", [0, -1.0, float("nan"), "heavy", True])
def test_an_invalid_mass_is_refused(mass):
    fields = task(None).to_dict()
    fields["obstacles"][0]["mass"] = mass
    with pytest.raises(ValueError, match=r"obstacles\[0\].mass: expected a (finite )?number"):
        Scenario.from_dict(fields)
