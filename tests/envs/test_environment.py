import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import best_known, drawn_scenario, scenario_fields
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import leapnav  # noqa: F401 (registers)
from leapnav.envs import NavigateEnv, Scenario, ScenarioError, sample_scenario
from leapnav.envs.field.clearance import clearance, clearances
from leapnav.envs.simulation.observations import GOAL_ENTRIES

ID = "leapnav/Navigate-v0"
EMPTY = {"start": [5.0, 5.0, 0.3], "goal": [6.0, 5.0, 0.0], "obstacles": []}


def scenario(**changes):
    return Scenario.from_dict(scenario_fields(**{**EMPTY, **changes}))


def play(env, actions, **reset):
    observation, info = env.reset(**reset)
    rows = [(observation, 0.0, False, info["cost"], tuple(info["pose"]))]
    for action in actions:
        observation, reward, terminated, _, info = env.step(action)
        rows.append((observation, reward, terminated, info["cost"], tuple(info["pose"])))
        if terminated:
            break
    return rows


def actions(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 2)).astype(np.float32)


@pytest.mark.parametrize(
    "arguments",
    [{"family": "clutter"}, {"family": "open"}, {"scenario": scenario()}, {"lidar_beams": 7}, {"horizon": "free"}],
)
def test_both_checkers_accept_the_environment_without_a_warning(arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ID, render_mode="rgb_array", **arguments).unwrapped)
        check_env_sb3(gym.make(ID, **arguments))


def test_the_same_seed_gives_the_same_episode_bit_for_bit():
    one, other = (play(gym.make(ID), actions(300), seed=7) for _ in range(2))
    assert len(one) == len(other)
    for (observation, *rest), (again, *rest_again) in zip(one, other, strict=True):
        assert observation.tobytes() == again.tobytes()
        assert rest == rest_again


def test_an_episode_does_not_depend_on_those_before_it():
    fresh, used = (gym.make(ID, terminate_on_collision=False) for _ in range(2))
    task = sample_scenario("clutter", 3)
    used.reset(seed=1)
    collided, done = False, False
    while not done:
        _, _, done, _, info = used.step(np.array([1.0, 0.1], np.float32))
        collided = info["collision"]
    assert collided  # the earlier episode has contacts
    for one, other in zip(
        play(fresh, actions(300), options={"scenario": task}),
        play(used, actions(300), options={"scenario": task}),
        strict=True,
    ):
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:] == other[1:]


def test_unseeded_resets_differ():
    env, other = gym.make(ID, split="fresh"), gym.make(ID, split="fresh")
    tasks = {drawn_scenario(env).start for _ in range(5)} | {drawn_scenario(other).start}
    assert len(tasks) == 6
    assert len({gym.make(ID).reset()[1]["index"] for _ in range(20)}) > 10


def test_the_global_generator_is_neither_read_nor_changed():
    np.random.seed(0)
    before = np.random.get_state()[1].copy()
    first = play(gym.make(ID), actions(20), seed=1)
    assert np.array_equal(before, np.random.get_state()[1])
    np.random.seed(99)
    assert first[-1][0].tobytes() == play(gym.make(ID), actions(20), seed=1)[-1][0].tobytes()


def test_a_pickled_environment_starts_the_same_episodes():
    env = NavigateEnv("clutter")
    env.reset(seed=3)
    copy = pickle.loads(pickle.dumps(env))
    for one, other in zip(play(env, actions(50)), play(copy, actions(50)), strict=True):
        assert one[0].tobytes() == other[0].tobytes()


def test_a_pickled_environment_goes_on_in_the_middle_of_an_episode():
    env = NavigateEnv(scenario=scenario())
    play(env, actions(10))
    copy = pickle.loads(pickle.dumps(env))
    for action in actions(50, seed=1):
        one, other = env.step(action), copy.step(action)
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:3] == other[1:3]


def test_commands_are_driven_as_exact_arcs():
    env = NavigateEnv(scenario=scenario())
    env.reset()
    x, y, heading = env.pose
    for action in actions(100) * (0.5, 1.0):
        _, _, terminated, _, _ = env.step(action)
        v, w, h = action[0] * 2.0, action[1] * 3.0, 0.05
        x += v / w * (math.sin(heading + w * h) - math.sin(heading))
        y -= v / w * (math.cos(heading + w * h) - math.cos(heading))
        heading += w * h
        assert not terminated
        assert env.pose == pytest.approx((x, y, heading), abs=1e-9)


def test_actions_are_clipped_on_both_sides():
    for sign in (-1.0, 1.0):
        one = play(NavigateEnv(scenario=scenario()), [np.array([sign, sign])])
        beyond = play(NavigateEnv(scenario=scenario()), [np.array([5 * sign, 7 * sign])])
        assert one[-1][1:] == beyond[-1][1:]


def test_the_return_is_minus_the_cost_minus_the_penalties():
    env = NavigateEnv(scenario=scenario(goal=[8.0, 8.0, 1.0], horizon=3.0), miss_penalty=11.0)
    rows = play(env, 0.2 * actions(100))
    assert rows[-1][2]
    assert sum(row[1] for row in rows) == pytest.approx(-rows[-1][3] - 11.0)
    assert env.time == 3.0


def test_the_running_cost_is_the_integral_along_the_path():
    # Past a disc at 0.1 m, so that the proximity cost matters.
    task = scenario(start=[2.8, 3.2, 1.57], obstacles=[{"circle": {"center": [4.0, 4.0], "radius": 0.85}}])
    coarse = play(NavigateEnv(scenario=task), [np.array([0.4, 0.0])] * 40)
    fine = play(NavigateEnv(scenario=task, control_period=0.001), [np.array([0.4, 0.0])] * 2000)
    effort = 0.5 * 0.8**2 * 2.0
    assert coarse[-1][3] - effort > 0.1
    assert coarse[-1][3] == pytest.approx(fine[-1][3], rel=1e-6)


@pytest.mark.parametrize("period", [0.2, 1.0])
def test_long_periods_are_charged_the_integral_too(period):
    post = {"circle": {"center": [5.0, 5.36], "radius": 0.1}}
    task = scenario(start=[3.0, 5.0, 0.0], goal=[7.0, 5.0, 0.0], obstacles=[post], horizon=2.0)
    coarse = play(NavigateEnv(scenario=task, control_period=period), [np.array([1.0, 0.0])] * 10)
    fine = play(NavigateEnv(scenario=task, control_period=0.01), [np.array([1.0, 0.0])] * 200)
    assert coarse[-1][3] == pytest.approx(fine[-1][3], rel=1e-4)


def test_a_reset_that_fails_changes_nothing():
    env, other = NavigateEnv(), NavigateEnv()
    for each in (env, other):
        each.reset(seed=3)
        each.step(np.array([0.5, 0.0]))
    with pytest.raises(IndexError):
        env.reset(seed=77, options={"index": 99999})
    assert env.pose == other.pose
    assert env.reset()[1]["index"] == other.reset()[1]["index"]


def test_the_last_period_ends_at_the_horizon():
    env = NavigateEnv(scenario=scenario(horizon=0.12))
    rows = play(env, [np.array([0.5, 0.0])] * 10)
    assert len(rows) == 1 + 3
    assert rows[-1][4][0] == pytest.approx(5.0 + 0.12 * 1.0 * math.cos(0.3))


@pytest.mark.parametrize(("offset", "success"), [(0.09, True), (0.11, False)])
def test_success_is_within_the_position_tolerance(offset, success):
    env = NavigateEnv(scenario=scenario(start=[5, 5, 0], goal=[6.0 + offset, 5, 0], horizon=1.0))
    env.reset()
    for _ in range(20):
        _, _reward, _, _, info = env.step(np.array([0.5, 0.0]))
    assert info["is_success"] is success
    assert info["reward_miss"] == (0.0 if success else -50.0)


@pytest.mark.parametrize(
    ("heading", "success"), [(0.09, True), (0.11, False), (2 * math.pi - 0.05, True), (None, True)]
)
def test_success_is_within_the_heading_tolerance_modulo_a_turn(heading, success):
    env = NavigateEnv(scenario=scenario(start=[5, 5, 0], goal=[6.0, 5, heading], horizon=1.0))
    env.reset()
    for _ in range(20):
        *_, info = env.step(np.array([0.5, 0.0]))
    assert info["is_success"] is success


def test_a_collision_ends_the_episode_and_is_penalised():
    wall = {"polygon": {"vertices": [[6, 4], [6.05, 4], [6.05, 6], [6, 6]]}}
    task = scenario(start=[5, 5, 0], goal=[8, 5, 0], obstacles=[wall])
    env = NavigateEnv(scenario=task)
    rows = play(env, [np.array([1.0, 0.0])] * 100)
    assert rows[-1][2]
    assert rows[-1][1] < -99  # collision and miss
    assert rows[-1][4][0] == pytest.approx(5.75, abs=0.1)


def test_a_robot_that_continues_after_a_contact_does_not_pass_through():
    wall = {"polygon": {"vertices": [[6, 4], [6.05, 4], [6.05, 6], [6, 6]]}}
    task = scenario(start=[5, 5, 0], goal=[8, 5, 0], obstacles=[wall], horizon=10.0)
    env = NavigateEnv(scenario=task, terminate_on_collision=False)
    env.reset()
    total, terminated = 0.0, False
    while not terminated:
        _, _, terminated, _, info = env.step(np.array([1.0, 0.0]))
        total += info["reward_collision"]
        assert clearance(*env.pose[:2], task.field)[0] > -0.06
    assert total == -50.0  # once
    assert info["collision"]
    assert not info["is_success"]


@pytest.mark.parametrize(("gap", "period"), [(0.001, 0.05), (0.003, 0.2), (0.005, 0.5)])
def test_an_arc_close_to_a_disc_is_not_a_collision(gap, period):
    # A circle of 1 m at 2 m/s; the chord of a period deviates from the arc by more than the clearance.
    disc = {"circle": {"center": [5.0, 5.0], "radius": 1.0 - 0.25 - gap}}
    task = scenario(start=[6.0, 5.0, math.pi / 2], goal=[2.0, 2.0, 0.0], obstacles=[disc], horizon=3.0)
    env = NavigateEnv(scenario=task, control_period=period)
    env.reset()
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step(np.array([1.0, 2.0 / 3.0]))
        assert info["clearance"] == pytest.approx(gap, abs=1e-3)
    assert not info["collision"]
    angle = 2.0 * 3.0  # driven: 6 m at 1 m
    assert env.pose[:2] == pytest.approx((5 + math.cos(angle), 5 + math.sin(angle)), abs=1e-6)


def test_lidar_ranges_agree_with_dense_sampling_of_the_beams():
    for task, _ in best_known()[::4]:
        x, y, heading = task.start
        # The robot's radius is taken off in `clearances`, not in a ray.
        ranges = NavigateEnv(scenario=task).reset()[0][GOAL_ENTRIES:]
        steps = np.arange(0, 10, 2e-3)
        for k in range(0, 32, 3):
            angle = heading + 2 * math.pi * k / 32
            ray = np.stack([x + steps * math.cos(angle), y + steps * math.sin(angle)], axis=1)
            free = clearances(ray, task.field) + task.robot.radius > 0
            walked = steps[np.argmin(free)] if not free.all() else 10.0
            assert ranges[k] == pytest.approx(walked, abs=3e-3)


@pytest.mark.parametrize("family", ["clutter", "polygons", "corridors"])
def test_a_beam_does_not_depend_on_the_number_of_others(family):
    """Obstacles are tested only against the beams that may meet them."""
    for seed in range(8):
        task = sample_scenario(family, seed)
        everywhere = NavigateEnv(scenario=task, lidar_beams=360).reset()[0][GOAL_ENTRIES:]
        for count in (1, 2, 3, 4, 5, 8, 40):
            ranges = NavigateEnv(scenario=task, lidar_beams=count).reset()[0][GOAL_ENTRIES:]
            assert ranges == pytest.approx(everywhere[:: 360 // count], abs=1e-6)


@pytest.mark.parametrize("family", ["clutter", "polygons", "crossing"])
def test_a_smaller_field_of_view_has_the_beams_of_the_full_circle(family):
    """The ranges, the detours and the velocities of obstacles, from the right end to the left end."""
    for seed in range(6):
        task = sample_scenario(family, seed)
        given = {"scenario": task, "observation": "geodesic", "dict_observation": True}
        everywhere = NavigateEnv(lidar_beams=360, **given).reset()[0]
        for degrees, count in ((180, 5), (270, 271), (90, 2), (359, 360), (60, 1)):
            env = NavigateEnv(lidar_beams=count, lidar_fov=math.radians(degrees), **given)
            found = env.reset()[0]
            angles = np.linspace(-degrees / 2, degrees / 2, count) if count > 1 else np.zeros(1)
            assert env.settings.beam_angles == pytest.approx(np.radians(angles))
            if (angles % 1).any():  # between two of the 360 beams
                continue
            indices = angles.astype(int) % 360
            assert found["lidar"] == pytest.approx(everywhere["lidar"][indices], abs=1e-6)
            assert found["detours"] == pytest.approx(everywhere["detours"][indices], abs=1e-5)
            if family == "crossing":
                pairs = everywhere["velocities"].reshape(2, 360)[:, indices].ravel()
                assert found["velocities"] == pytest.approx(pairs, abs=1e-6)
    with pytest.raises(ValueError, match=r"lidar_fov: expected an angle in \[0.001, 2 pi\] rad, got 270.0"):
        NavigateEnv(lidar_fov=270)
    assert NavigateEnv(lidar_fov=np.float32(2 * np.pi)).settings == NavigateEnv().settings


@pytest.mark.parametrize("heading", [0.0, -0.0, math.pi / 2, math.pi, -math.pi / 2, 1e-12])
def test_beams_along_the_axes_see_what_is_there(heading):
    disc = {"circle": {"center": [4.0, 1.0], "radius": 0.8}}
    task = scenario(start=[1.0, 1.0, heading], goal=[8.0, 8.0, 0.0], obstacles=[disc])
    ranges = NavigateEnv(scenario=task, lidar_beams=4).reset()[0][GOAL_ENTRIES:]
    east_first = np.roll(ranges, round(heading / (math.pi / 2)))
    assert east_first == pytest.approx([2.2, 9.0, 1.0, 1.0], abs=1e-5)


def test_the_observation_agrees_with_the_docstring():
    task = scenario(start=[2.0, 3.0, math.pi / 2], goal=[1.0, 6.0, math.pi], horizon=4.0)
    observation, _ = NavigateEnv(scenario=task).reset()
    assert observation[:GOAL_ENTRIES] == pytest.approx(
        [3.0, 1.0, 0.0, 1.0, 4.0, 0.75, 0.25, math.sqrt(10) / 4, math.pi / 8], abs=1e-6
    )
    ahead, left, behind, right = observation[GOAL_ENTRIES::8]
    assert (ahead, left, behind, right) == pytest.approx((7.0, 2.0, 3.0, 8.0), abs=1e-5)


def test_a_free_goal_heading_shows_as_zeros():
    observation, _ = NavigateEnv(scenario=scenario(goal=[8.0, 8.0, None])).reset()
    assert observation[2] == observation[3] == observation[8] == 0.0


def test_observations_stay_in_their_space():
    env = NavigateEnv("clutter", terminate_on_collision=False)
    for seed in range(3):
        for row in play(env, actions(400, seed), seed=seed):
            assert env.observation_space.contains(row[0])


def test_the_scenario_option_takes_every_form_and_is_reported():
    task = scenario()
    env = gym.make(ID)
    for form in (task, task.to_dict(), task.to_json()):
        assert drawn_scenario(env, options={"scenario": form}) == task


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gym.make(ID, family="moon"), "family: expected one of .*'moon'"),
        (lambda: gym.make(ID, control_period=0.0), "control_period: .*0.0"),
        (lambda: gym.make(ID, miss_penalty=-1), "miss_penalty: .*-1"),
        (lambda: gym.make(ID, lidar_beams=-1), "lidar_beams: .*-1"),
        (lambda: gym.make(ID, lidar_beams=32.7), "lidar_beams: .*32.7"),
        (lambda: gym.make(ID, control_period=5e-324), "control_period: expected at least"),
        (lambda: gym.make(ID, scenario=scenario_fields(horizon=-1)), "horizon"),
        (lambda: gym.make(ID).reset(options={"seed": 1}), "options: .*'seed'"),
        (lambda: gym.make(ID).reset(options={"scenario": 3}), "scenario: expected .* int"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_bad_scenario_is_a_scenario_error():
    with pytest.raises(ScenarioError):
        gym.make(ID).reset(options={"scenario": scenario_fields(start=[4.0, 4.5, 0.0])})


def test_an_action_that_is_not_finite_is_refused_and_changes_nothing():
    env = NavigateEnv(scenario=scenario())
    env.reset()
    with pytest.raises(ValueError, match="action: expected two finite numbers"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="action: expected two finite numbers"):
        env.step(np.array([0.5]))
    assert env.time == 0.0
    assert env.pose == (5.0, 5.0, 0.3)


@pytest.mark.parametrize("action", [["0.5", "1"], [True, False], np.array([1j, 0]), None, [[1], [2, 3]], "ab"])
def test_an_action_that_is_no_two_numbers_is_refused(action):
    env = NavigateEnv(scenario=scenario())
    env.reset()
    with pytest.raises(ValueError, match="action: expected two finite numbers, got"):
        env.step(action)


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        NavigateEnv().step(np.zeros(2))


def test_frames_show_the_robot_where_it_is():
    env = gym.make(
        ID, scenario=scenario(start=[5.0, 5.0, 0.0], goal=[9.0, 9.0, 0.0], obstacles=[]), render_mode="rgb_array"
    )
    env.reset()
    frame = env.render()
    assert frame.shape == (640, 600, 3)
    assert frame.dtype == np.uint8
    robot = np.abs(frame.astype(int) - (38, 98, 171)).sum(axis=2) < 20
    rows, columns = np.nonzero(robot)
    assert (rows.mean(), columns.mean()) == pytest.approx((300, 300), abs=3)
    for _ in range(20):
        env.step(np.array([0.5, 0.0], np.float32))
    assert np.nonzero(np.abs(env.render().astype(int) - (38, 98, 171)).sum(axis=2) < 20)[1].mean() > columns.mean() + 10


def test_a_person_can_drive_by_keys(monkeypatch):
    """Gymnasium's play loop finds the keys in the environment, also inside wrappers."""
    import pygame
    from gymnasium.utils.play import play

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("leapnav/Navigate-v0", family="open", render_mode="rgb_array")
    keys = env.unwrapped.get_keys_to_action()
    assert keys[""].tolist() == [0.0, 0.0]
    assert keys[("w",)].tolist() == [0.5, 0.0] and keys[("s", "d")].tolist() == [-0.5, -0.5]
    assert keys[(pygame.K_UP, pygame.K_LEFT)].tolist() == [0.5, 0.5]
    taken, steps = [], 6

    def after_step(before, after, action, reward, terminated, truncated, info):
        taken.append((np.asarray(action).tolist(), info["pose"]))
        key = [pygame.event.Event(pygame.KEYDOWN, key=ord("w")), pygame.event.Event(pygame.KEYDOWN, key=ord("a"))]
        pygame.event.post(key[len(taken) - 1] if len(taken) <= 2 else pygame.event.Event(pygame.USEREVENT))
        if len(taken) == steps:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    play(env, callback=after_step, fps=1000, seed=0)
    assert [action for action, _ in taken[:3]] == [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]]
    assert math.dist(taken[-1][1][:2], taken[0][1][:2]) > 0.1
