import pickle
import warnings
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.performance import benchmark_step, benchmark_vector_step
from gymnasium.vector import AutoresetMode
from helpers import scenario_fields

import leapnav  # noqa: F401 (registers)
from leapnav.envs import NavigateEnv, NavigateVectorEnv, Scenario, ScenarioBank
from leapnav.envs.field.clearance import clearance

ID, GOAL_ID = "leapnav/Navigate-v0", "leapnav/NavigateGoal-v0"
TIME_LIMITED = scenario_fields(horizon=None, time_limit=3.03, cost={"time_weight": 0.5})
SETTINGS = [
    {},
    {"family": "rooms", "observation": "state"},
    {"family": "polygons", "observation": "map", "split": "test"},
    {"family": "slalom", "reward": "shaped"},
    {"split": "fresh"},
    {"actuation": "motor"},
    {"actuation": "motor", "terminate_on_collision": False, "family": "rooms"},
    {"terminate_on_collision": False, "family": "polygons"},
    {"disturbance": {"actuation": 0.1, "slip": 0.1, "sensing": 0.02}},
    {"disturbance": 0.2, "actuation": "motor", "terminate_on_collision": False},
    {"dict_observation": True, "observation": "map"},
    {"scenario": scenario_fields(), "control_period": 0.11},
    {"horizon": "free", "reward": "shaped"},
    {"scenario": TIME_LIMITED, "terminate_on_collision": False, "actuation": "motor"},
]

ORANGE = 0xD9, 0x73, 0x0D  # of the optimum in a frame


def make(count, **arguments):
    return gym.make_vec(ID, num_envs=count, vectorization_mode="vector_entry_point", **arguments)


def same(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    return np.asarray(one).tobytes() == np.asarray(other).tobytes()


def row(observation, i):
    if isinstance(observation, dict):
        return {name: value[i] for name, value in observation.items()}
    return observation[i]


def bold_actions(count, robots, seed=0):
    """Actions that change slowly, so that robots get somewhere and run into things."""
    rng = np.random.default_rng(seed)
    steps = 0.3 * rng.normal(size=(count, robots, 2))
    return np.clip(np.cumsum(steps, axis=0), -1, 1).astype(np.float32)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_single_and_vector_play_the_same_episodes_bit_for_bit(settings):
    robots, steps = 5, 260
    venv = make(robots, **settings)
    envs = [gym.make(ID, **settings) for _ in range(robots)]
    observation, infos = venv.reset(seed=11)
    starts = [env.reset(seed=11 + i) for i, env in enumerate(envs)]
    for i, (start, info) in enumerate(starts):
        assert same(row(observation, i), start)
        assert infos["cost"][i] == info["cost"]
    ended = np.zeros(robots, dtype=bool)
    episodes = 0
    for actions in bold_actions(steps, robots):
        observation, rewards, terminated, truncated, infos = venv.step(actions)
        assert settings.get("scenario") is TIME_LIMITED or not truncated.any()
        for i, env in enumerate(envs):
            if ended[i]:
                (alone, info), reward, end, cut = env.reset(), 0.0, False, False
                episodes += 1
            else:
                alone, reward, end, cut, info = env.step(actions[i])
            assert same(row(observation, i), alone)
            assert rewards[i] == reward
            assert (terminated[i], truncated[i]) == (end, cut)
            for name, value in info.items():
                assert np.array_equal(infos[name][i], value)
        ended = terminated | truncated
    assert episodes > 1


def test_episodes_are_the_same_in_subprocesses():
    arguments = {"family": "rooms", "disturbance": 0.1}
    ours = make(2, **arguments)
    others = gym.make_vec(ID, num_envs=2, vectorization_mode="async", **arguments)
    try:
        assert same(ours.reset(seed=5)[0], others.reset(seed=5)[0])
        for actions in bold_actions(150, 2, seed=1):
            one, other = ours.step(actions), others.step(actions)
            for k in range(4):
                assert same(one[k], other[k])
    finally:
        others.close()


def test_a_robot_s_episodes_do_not_depend_on_the_other_robots():
    arguments = {"family": "clutter", "terminate_on_collision": False, "actuation": "motor", "disturbance": 0.1}
    few, many = make(2, **arguments), make(7, **arguments)
    few.reset(seed=[4, 9])
    many.reset(seed=[100, 4, 101, 102, 103, 9, 104])
    rng = np.random.default_rng(0)
    for actions in bold_actions(500, 2, seed=2):
        crowd = rng.uniform(-1, 1, (7, 2)).astype(np.float32)
        crowd[[1, 5]] = actions
        one, other = few.step(actions), many.step(crowd)
        for k in range(3):
            assert same(one[k], other[k][[1, 5]])


def test_an_arena_s_history_does_not_leak_into_its_next_episode():
    arguments = {"family": "rooms", "terminate_on_collision": False, "actuation": "motor", "disturbance": 0.1}
    used, fresh = make(3, **arguments), make(3, **arguments)
    used.reset(seed=1)
    for actions in bold_actions(300, 3, seed=3):
        used.step(actions)
    assert same(used.reset(seed=8)[0], fresh.reset(seed=8)[0])
    for actions in bold_actions(300, 3, seed=4):
        for one, other in zip(used.step(actions)[:3], fresh.step(actions)[:3], strict=True):
            assert same(one, other)


def test_robots_with_the_same_scenario_share_its_field():
    env = make(5, family="clutter")
    env.reset(seed=1, options={"index": [3, 4, 3, 3, 4]})
    for copy in (env, pickle.loads(pickle.dumps(env)), deepcopy(env)):
        fields = copy.unwrapped._simulator.fields
        assert fields[0] is fields[2] is fields[3]
        assert fields[1] is fields[4] is not fields[0]
        assert (fields[1] == env.unwrapped.bank[4].field).all()
        assert len(set(fields.places[:, 0].tolist())) == 2


def test_copies_from_read_only_buffers_have_arrays_of_their_own():
    env = NavigateVectorEnv(2, "open", split="test", lidar_beams=8, history=(0.4,))
    env.reset(seed=0)
    buffers = []
    pickled = pickle.dumps(env, protocol=5, buffer_callback=buffers.append)
    assert buffers
    shared = [bytes(buffer) for buffer in buffers]  # as other processes may receive them
    before = [hash(one) for one in shared]
    first, second = (pickle.loads(pickled, buffers=shared) for _ in range(2))
    start = second.states.copy()
    found = [env_.step(np.ones((2, 2), np.float32))[0] for env_ in (env, first)]
    assert np.array_equal(*found)
    assert np.array_equal(second.states, start) and [hash(bytes(bytearray(one))) for one in shared] == before


def test_an_episode_whose_state_is_not_finite_ends_after_its_steps():
    env = NavigateEnv("clutter", split="test", terminate_on_collision=False)
    env.reset(seed=0)
    env._simulator.states[0, 0] = np.nan
    for _ in range(1000):
        *_, terminated, truncated, info = env.step(np.ones(2, np.float32))
        if terminated or truncated:
            break
    assert terminated and not info["is_success"]


@pytest.mark.parametrize("actuation", ["velocity", "motor"])
@pytest.mark.parametrize("period", [0.05, 0.5])
def test_a_pickled_environment_goes_on_in_the_middle_of_its_episodes(actuation, period):
    env = make(
        6,
        family="rooms",
        terminate_on_collision=False,
        disturbance=0.1,
        actuation=actuation,
        control_period=period,
    )
    env.reset(seed=1)
    in_contact = 0
    for actions in bold_actions(50, 6):
        copy = pickle.loads(pickle.dumps(env))  # often with robots in contact
        before, after = env.step(actions), copy.step(actions)
        in_contact += (before[4]["clearance"] <= 0).sum()
        for k in range(4):
            assert same(before[k], after[k])
    assert in_contact > 8


def test_in_same_step_mode_the_last_observation_is_in_the_infos():
    arguments = {"family": "clutter", "dict_observation": True}
    later, now = make(6, **arguments), make(6, autoreset_mode="SameStep", **arguments)
    assert now.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    later.reset(seed=2)
    now.reset(seed=2)
    seen = 0
    for actions in bold_actions(80, 6):
        observation, rewards, terminated, _, infos = later.step(actions)
        following, rewards_now, terminated_now, _, infos_now = now.step(actions)
        assert same(rewards, rewards_now)
        assert same(terminated, terminated_now)
        if terminated.any():
            seen += 1
            assert same(infos_now["_final_obs"], terminated)
            for i in np.flatnonzero(terminated):
                assert same(infos_now["final_obs"][i], row(observation, i))
                assert infos_now["final_info"]["cost"][i] == infos["cost"][i]
                assert infos_now["time"][i] == 0.0
            later_start, *_ = later.step(actions)  # resets those that ended; the others are ahead from here on
            for i in np.flatnonzero(terminated):
                assert same(row(later_start, i), row(following, i))
            break
    assert seen


def test_without_autoreset_only_the_masked_robots_start():
    env = make(3, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    terminated = np.zeros(3, dtype=bool)
    while not terminated.any():
        observation, _, terminated, _, _ = env.step(np.tile(np.array([1.0, 0.05], np.float32), (3, 1)))
    with pytest.raises(gym.error.ResetNeeded, match=f"robot {np.argmax(terminated)}"):
        env.step(np.zeros((3, 2), np.float32))
    again, infos = env.reset(options={"reset_mask": terminated})
    assert same(infos["_cost"], terminated)
    for i in range(3):
        assert same(again[i], observation[i]) != terminated[i]
    env.step(np.zeros((3, 2), np.float32))


def test_options_choose_scenarios_for_all_or_each():
    bank = ScenarioBank.shipped("rooms", "test")
    env = make(3, bank=bank)
    assert env.reset(options={"index": 7})[1]["index"].tolist() == [7, 7, 7]
    _, infos = env.reset(options={"index": [5, 0, -1]})
    assert infos["index"].tolist() == [5, 0, 199]
    assert infos["reference_cost"].tolist() == bank.costs[[5, 0, 199]].tolist()
    assert env.scenarios == (bank[5], bank[0], bank[-1])
    other = Scenario.from_dict(scenario_fields())
    _, infos = env.reset(options={"scenario": [other, bank[3], other.to_json()]})
    assert env.scenarios == (other, bank[3], other)
    assert infos["index"].tolist() == [-1, -1, -1] and np.isnan(infos["reference_cost"]).all()


def test_the_rate_is_what_gymnasium_s_benchmarks_can_measure():
    assert benchmark_step(gym.make(ID), target_duration=0.05, seed=0) > 0
    assert benchmark_vector_step(make(8), target_duration=0.05, seed=0) > 0


def test_gymnasium_s_vector_wrappers_accept_the_environment(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.wrappers.vector.RecordEpisodeStatistics(make(4, family="open"))
        env.reset(seed=0)
        lengths = []
        for actions in bold_actions(200, 4):
            *_, infos = env.step(actions)
            if "episode" in infos:
                lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert lengths


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make(2, family="moon"), "family: expected one of .*'moon'"),
        (lambda: NavigateVectorEnv(0), "num_envs: expected an integer >= 1, got 0"),
        (lambda: make(2, autoreset_mode="later"), "autoreset_mode: expected one of .*'later'"),
        (lambda: make(2, render_mode="human"), "render_mode: expected None or one of rgb_array, got 'human'"),
        (lambda: make(2, lidar_beams=-3), "lidar_beams: .*-3"),
        (lambda: make(2).reset(seed=1.5), "seed: expected an integer or a list of them, got 1.5"),
        (lambda: make(2).reset(seed=[1, 2.7]), "seed: expected an integer >= 0, got 2.7"),
        (lambda: make(2).reset(seed=[1, 2, 3]), "seed: expected one for each of 2 robots, got 3"),
        (lambda: make(2).reset(options={"index": [1, 2, 3]}), "index: expected one for each of 2 robots, got 3"),
        (lambda: make(2).reset(options={"mask": 1}), "options: .*'mask'"),
        (lambda: make(2).reset(options={"reset_mask": np.zeros(2, bool)}), "reset_mask: expected bool"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_an_unknown_argument_is_named():
    with pytest.raises(TypeError, match="NavigateVectorEnv: got an unexpected keyword argument 'lidar'"):
        make(2, lidar=3)


def test_a_reset_that_fails_changes_nothing():
    env, other = make(2), make(2)
    for each in (env, other):
        each.reset(seed=3)
        each.step(np.full((2, 2), 0.5, np.float32))
    with pytest.raises(IndexError, match=r"clutter-train\.bank has 400 scenarios, got 400"):
        env.reset(seed=77, options={"index": [0, 400]})
    assert env.times.tolist() == [0.05, 0.05]
    assert env.np_random_seed == (3, 4)
    assert same(env.reset()[0], other.reset()[0])


def test_films_run_in_real_time():
    assert make(1, control_period=0.2).metadata["render_fps"] == 5
    assert NavigateEnv(control_period=0.2).metadata["render_fps"] == 5


def test_a_missing_bank_is_named():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.bank"):
        make(2, bank="nowhere.bank")


def test_faulty_actions_are_refused_and_change_nothing():
    env = make(3)
    env.reset(seed=0)
    bad = np.zeros((3, 2), np.float32)
    bad[1, 1] = np.nan
    with pytest.raises(ValueError, match=r"action: expected two finite numbers, got \[0.0, nan\] for robot 1"):
        env.step(bad)
    with pytest.raises(ValueError, match=r"action: expected finite numbers of shape \(3, 2\), got shape \(2, 2\)"):
        env.step(np.zeros((2, 2), np.float32))
    assert env.times.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(gym.error.ResetNeeded):
        make(2).step(np.zeros((2, 2), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        make(2).reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize("period", [0.05, 0.4])
@pytest.mark.parametrize("actuation", ["velocity", "motor"])
def test_robots_that_continue_after_a_contact_stay_out_of_obstacles(actuation, period):
    for family in ("polygons", "rooms"):
        env = make(12, family=family, actuation=actuation, terminate_on_collision=False, control_period=period)
        env.reset(seed=3)
        deepest, touched = 0.0, 0
        for actions in bold_actions(120 if period < 0.1 else 40, 12, seed=5):
            _, _, _, _, infos = env.step(actions)
            touched += infos["collision"].sum()
            for pose, task in zip(infos["pose"], env.scenarios, strict=True):
                deepest = min(deepest, clearance(pose[0], pose[1], task.field)[0])
        assert touched > 0
        assert deepest > -1e-3


@pytest.mark.parametrize(("radius", "wall", "speed"), [(0.002, 0.001, 2.0), (0.05, 0.02, 40.0), (0.25, 0.1, 150.0)])
@pytest.mark.parametrize("actuation", ["velocity", "motor"])
def test_no_robot_gets_through_a_wall(radius, wall, speed, actuation):
    corners = [[6.0, 0.0], [6.0 + wall, 0.0], [6.0 + wall, 10.0], [6.0, 10.0]]
    task = scenario_fields(
        start=[5.0, 5.0, 0.3],
        goal=[2.0, 2.0, 0.0],
        horizon=4.0,
        obstacles=[{"polygon": {"vertices": corners}}],
        robot={"model": "unicycle", "radius": radius, "max_speed": speed, "max_turn_rate": 3.0},
    )
    env = NavigateEnv(scenario=task, actuation=actuation, terminate_on_collision=False, motor={"wheel_force": 1e4})
    env.reset()
    touched = False
    for k in range(80):
        *_, info = env.step(np.array([1.0, 0.4 * np.sin(k)], np.float32))
        touched = touched or info["collision"]
        assert 0.0 < env.pose[0] < 6.0
    assert touched


def test_in_contact_the_motion_is_charged_not_the_command():
    corners = [[6.0, 0.0], [6.1, 0.0], [6.1, 10.0], [6.0, 10.0]]
    task = scenario_fields(
        start=[5.5, 5.0, 0.0], goal=[2.0, 2.0, 0.0], horizon=4.0, obstacles=[{"polygon": {"vertices": corners}}]
    )
    for actuation in ("velocity", "motor"):
        env = NavigateEnv(scenario=task, actuation=actuation, terminate_on_collision=False)
        env.reset()
        for k in range(40):
            *_, info = env.step(np.array([1.0, 0.0], np.float32))
            if k >= 20:  # it stands before the wall
                assert info["reward_effort"] == pytest.approx(0.0, abs=1e-3)  # commanded: -0.1


def test_gymnasium_s_recorders_film_single_and_vector(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        options = {"step_trigger": lambda step: step == 0, "video_length": 5, "disable_logger": True}
        env = gym.wrappers.RecordVideo(gym.make(ID, render_mode="rgb_array"), str(tmp_path / "one"), **options)
        venv = gym.wrappers.vector.RecordVideo(make(3, render_mode="rgb_array"), str(tmp_path / "many"), **options)
        for recorded in (env, venv):
            recorded.reset(seed=0)
            for _ in range(8):
                recorded.step(recorded.action_space.sample())
            recorded.close()
    assert len(list(tmp_path.glob("one/*.mp4"))) == len(list(tmp_path.glob("many/*.mp4"))) == 1


def test_frames_are_of_each_robot():
    env = make(2, render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    env.step(np.ones((2, 2), np.float32))
    frames = env.render()
    alone = NavigateEnv(render_mode="rgb_array")
    alone.reset(seed=1)
    alone.step(np.ones(2, np.float32))
    assert np.array_equal(frames[1], alone.render())
    assert not np.array_equal(frames[0], frames[1])


def test_frames_contain_the_optimum_only_on_request():
    for kind in (make, lambda count, **arguments: NavigateEnv(**arguments)):
        shown = []
        for wish in (True, False):
            env = kind(1, render_mode="rgb_array", show_optimum=wish)
            env.reset(seed=0)
            orange = np.abs(np.squeeze(env.render()).astype(int) - ORANGE).sum(axis=2) < 20
            shown.append(int(orange.sum()))
        assert shown[0] > 100 and shown[1] == 0
