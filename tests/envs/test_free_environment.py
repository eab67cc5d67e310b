"""Environments, banks, expert, demonstrations and training with a free horizon."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from helpers import QUICK, SMALL, fresh, scenario_fields

from leapnav.cli import main
from leapnav.envs import NavigateEnv, NavigateGoalEnv, Scenario, ScenarioBank, ScenarioError, sample_scenario
from leapnav.envs.episodes import act_with, play_episode
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.envs.simulation.observations import FREE_GOAL_ENTRIES, GOAL_ENTRIES, observation_entries, parts_of
from leapnav.experts import ExpertPolicy, build_bank, find_optimum, find_reached_optimum
from leapnav.experts.data.datasets import dataset_id
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.experts.data.rollouts import check_dataset, rollout
from leapnav.training import Dataset, evaluate, load_policy, make_vec_env, save_policy
from leapnav.training.config import DAggerRunConfig, PPOConfig, SACConfig
from leapnav.training.effort import effort_weights
from leapnav.training.fit_settings import CloningConfig, DAggerConfig
from leapnav.training.learning.cloning import behaviour_clone
from leapnav.training.policies.baselines import GoToGoal
from leapnav.training.policies.navigation_policy import add_momentum
from leapnav.training.policies.symmetries import mirror, time_reversal
from leapnav.training.runs.imitation import train_dagger
from leapnav.training.runs.reinforcement import train_ppo, train_sac

ID, GOAL_ID = "leapnav/Navigate-v0", "leapnav/NavigateGoal-v0"
STAY, AHEAD = np.zeros(2, np.float32), np.array([0.5, 0.0], np.float32)


def straight(**changes):
    """Return a scenario whose goal is 2 m ahead."""
    fields = scenario_fields(start=[1, 5, 0], goal=[3, 5, 0], horizon=None, obstacles=[])
    fields["cost"] = {**fields["cost"], "proximity_weight": 0.0, "time_weight": 0.5}
    return Scenario.from_dict({**fields, **changes})


def play(env, action, **options):
    _, _, steps = play_episode(env, lambda *_: action, options=options or None)
    return list(steps)


def test_an_episode_terminates_at_the_goal_and_its_return_is_the_cost():
    env = NavigateEnv(scenario=straight(goal=[3.02, 5, 0]))
    steps = play(env, AHEAD)  # 1 m/s, the optimal speed for the time weight 0.5
    assert len(steps) == 39  # the first position within 0.1 m of the goal is 1.95 m ahead
    assert [step.done for step in steps] == [False] * 38 + [True]
    last = steps[-1]
    assert last.terminated and not last.truncated and last.info["is_success"]
    assert last.info["cost"] == pytest.approx(1.95)  # (0.5 + 1/2 v^2) T
    assert sum(step.reward for step in steps) == pytest.approx(-last.info["cost"])
    assert last.info["reward_time"] == pytest.approx(-0.5 * 0.05)
    optimum = find_reached_optimum(env.scenario, env.state, last.info["cost"])
    assert optimum.cost == pytest.approx(last.info["cost"])
    with pytest.raises(gym.error.ResetNeeded):  # after the end
        env.step(AHEAD)


def test_an_episode_is_truncated_at_the_time_limit_without_a_penalty():
    env = NavigateEnv(scenario=straight(time_limit=1.0))
    steps = play(env, STAY)
    assert len(steps) == 20
    assert [step.truncated for step in steps] == [False] * 19 + [True]
    assert not any(step.terminated for step in steps) and not steps[-1].info["is_success"]
    assert sum(step.reward for step in steps) == pytest.approx(-0.5)
    assert straight().episode_limit == pytest.approx(3 * 20 / 1.0)  # half the perimeter at 1 m/s


def test_a_collision_terminates_an_episode_with_both_penalties():
    wall = [{"circle": {"center": [2.0, 5.0], "radius": 0.3}}]
    steps = play(NavigateEnv(scenario=straight(obstacles=wall)), AHEAD)
    assert steps[-1].terminated and not steps[-1].truncated
    assert steps[-1].info["reward_collision"] == steps[-1].info["reward_miss"] == -50.0
    behind = straight(obstacles=wall, time_limit=2.0)
    steps = play(NavigateEnv(scenario=behind, terminate_on_collision=False), AHEAD)
    assert steps[-1].truncated and steps[-1].info["collision"]


def test_a_goal_that_is_reached_after_a_collision_ends_the_episode_without_success():
    wall = [{"polygon": {"vertices": [[1.5, 5.3], [2.5, 5.24], [2.5, 5.6], [1.5, 5.6]]}}]  # the robot slides past it
    env = NavigateEnv(scenario=straight(obstacles=wall, goal=[3, 4.95, None]), terminate_on_collision=False)
    steps = play(env, AHEAD)
    assert steps[-1].terminated and steps[-1].info["collision"] and not steps[-1].info["is_success"]
    assert steps[-1].info["reward_miss"] == 0.0


def test_the_observation_has_no_time_left():
    env = NavigateEnv(scenario=straight())
    first, _ = env.reset()
    later = env.step(STAY)[0]
    assert (first == later).all()
    assert first[:FREE_GOAL_ENTRIES] == pytest.approx([2, 0, 1, 0])
    assert len(first) == FREE_GOAL_ENTRIES + 32 and parts_of(env.observation_space)["goal"] == slice(
        0, FREE_GOAL_ENTRIES
    )
    assert parts_of(NavigateEnv(split="fresh").observation_space)["goal"] == slice(0, GOAL_ENTRIES)
    names = [entry.name for entry in observation_entries(env.settings)]
    assert names[:5] == [
        "goal.ahead",
        "goal.left",
        "goal.cos_heading_error",
        "goal.sin_heading_error",
        "lidar[0], 0 deg counter-clockwise from ahead",
    ]


def test_the_shaped_reward_telescopes():
    task = sample_scenario("clutter", 31_000, horizon="free")
    shaped, plain = (NavigateEnv(scenario=task, reward=reward, discount=1.0) for reward in ("shaped", "cost"))
    totals = []
    for env in (plain, shaped):
        _, _, steps = play_episode(env, act_with(ExpertPolicy(env)))
        totals.append(sum(step.reward for step in steps))
    length, turn = np.hypot(*np.subtract(task.goal[:2], task.start[:2])), task.goal[2] - task.start[2]
    potential = -math.sqrt(2 * 0.5 * (length**2 + 0.5 * math.remainder(turn, 2 * math.pi) ** 2))
    assert totals[1] - totals[0] == pytest.approx(-potential, rel=1e-6)  # 0 after the end, minus the one at the start
    assert potential == pytest.approx(totals[0], rel=0.35)  # an estimate of the return


def test_environments_take_the_horizon_of_the_scenario_or_of_the_bank():
    free, bank = straight(), ScenarioBank.shipped("open", "test", horizon="free")
    assert NavigateEnv(scenario=free).settings.horizon == NavigateEnv(bank=bank).settings.horizon == "free"
    assert NavigateEnv("open", split="test", horizon="free").bank is bank
    with pytest.raises(ValueError, match="horizon: expected that of the scenario, 'free', got 'fixed'"):
        NavigateEnv(scenario=free, horizon="fixed")
    with pytest.raises(ValueError, match="horizon: expected that of the bank, 'free', got 'fixed'"):
        gym.make_vec(ID, num_envs=2, bank=bank, horizon="fixed", vectorization_mode="vector_entry_point")
    with pytest.raises(ValueError, match="make the environment with horizon='free'"):
        NavigateEnv(split="fresh").reset(options={"scenario": free})
    with pytest.raises(ValueError, match="horizon: expected one of fixed, free, got 'open'"):
        NavigateEnv(horizon="open")
    with pytest.raises(
        ValueError, match=r"split: the robot 'car' with a free horizon has included banks for no family"
    ):
        NavigateEnv(robot="car", horizon="free", split="test")
    with pytest.raises(ScenarioError, match="time_limit: expected None, since the horizon is fixed, got 5"):
        straight(horizon=3.0, time_limit=5.0)


def test_fresh_scenarios_have_the_same_layout_with_both_kinds_of_horizon():
    for robot in ("unicycle", "car"):
        fixed, free = (sample_scenario("rooms", 17, robot, horizon) for horizon in ("fixed", "free"))
        assert free.horizon is None and free.cost.time_weight == 0.5
        assert (free.obstacles, free.start, free.goal) == (fixed.obstacles, fixed.start, fixed.goal)
        duration = find_optimum(free).horizon
        assert 2 * duration < free.time_limit < 4 * duration


@pytest.mark.parametrize("family", ALL_FAMILIES)
def test_included_banks_hold_certified_optima(family):
    for split, count in (("train", 400), ("test", 200)):
        bank = ScenarioBank.shipped(family, split, horizon="free")
        assert len(bank) == count and bank.horizon == "free"
        limits = [scenario.time_limit for scenario in bank]
        assert np.allclose(limits, 3 * bank.horizons, atol=0.051)
        assert all(scenario.cost.time_weight == 0.5 for scenario in bank)
    index = 11
    optimum, reference = find_optimum(bank[index]), bank.reference(index)
    assert reference.cost == pytest.approx(optimum.cost, rel=1e-6)
    assert reference.times[-1] == bank.horizons[index] == pytest.approx(optimum.horizon, rel=1e-6)
    # E = c: on an optimum without proximity cost, half of J is time.
    assert reference.cost >= 2 * 0.5 * reference.times[-1] * (1 - 1e-6)


def test_a_bank_is_built_and_read(tmp_path):
    bank = build_bank("open", 3, tmp_path / "free.bank", robot="car", horizon="free", progress=False)
    assert bank.horizon == "free" and bank[0].name.startswith("car-free-open-0-")
    assert bank.robot.model == "car"
    with pytest.raises(ValueError, match="with horizon 'free' instead of 'fixed'"):
        build_bank("open", 3, tmp_path / "free.bank", robot="car", progress=False)


@pytest.mark.parametrize("feedback", ["resolve", "gains", "none"])
def test_the_expert_drives_at_the_optimal_cost(feedback):
    env = NavigateEnv("clutter", split="test", horizon="free")
    for index in range(4):
        _, info, steps = play_episode(env, act_with(ExpertPolicy(env, feedback=feedback)), options={"index": index})
        last = list(steps)[-1].info
        assert last["is_success"] and last["cost"] <= info["reference_cost"]
        optimum = find_reached_optimum(env.scenario, env.state, last["cost"])
        assert last["cost"] == pytest.approx(optimum.cost, rel=1e-3)


@pytest.mark.parametrize(
    ("robot", "feedback"),
    [
        ("unicycle", "resolve"),
        ("unicycle", "gains"),
        ("differential_drive", "resolve"),
        ("car", "resolve"),
        ("dynamic_unicycle", "resolve"),
    ],
)
def test_the_expert_corrects_disturbances(robot, feedback):
    env = NavigateEnv("open", split="fresh", horizon="free", robot=robot, disturbance={"actuation": 0.1, "slip": 0.1})
    for seed in range(4):
        _, _, steps = play_episode(env, act_with(ExpertPolicy(env, feedback=feedback)), seed=seed)
        assert list(steps)[-1].info["is_success"]


def test_the_value_does_not_depend_on_the_time():
    env = NavigateEnv("clutter", split="test", horizon="free")
    env.reset(options={"index": 3})
    expert = ExpertPolicy(env)
    start = expert.value()
    assert start == pytest.approx(env.bank.costs[3], rel=1e-6)
    assert expert.value(env.state, 1.0) == pytest.approx(start, rel=1e-6)
    # lambda is the gradient of J*, and H = 0: along the optimum, J* decreases by the running cost.
    state, costate, offset = env.state, expert.costate(), 1e-4 * np.array([1.0, -1.0, 2.0])
    difference = expert.value(state + offset) - expert.value(state - offset)
    assert difference / 2 == pytest.approx(costate @ offset, rel=1e-4)


def test_demonstrations_are_written_checked_and_learned_from(tmp_path):
    assert main(f"rollout --out {tmp_path} --family open --horizon free --count 6 --recoveries 1".split()) == 0
    assert (tmp_path / dataset_id("open", horizon="free")).is_dir()
    assert main(f"dataset check {tmp_path}".split()) == 0
    demonstrations = load_demonstrations(tmp_path)
    for demonstration in demonstrations:
        cost = demonstration.running_cost.sum()
        assert demonstration.rewards.sum() == pytest.approx(-cost)
        # The episode ends within the tolerances, where the optimum has a cost-to-go.
        assert cost + demonstration.cost_to_go[-1] == pytest.approx(demonstration.reference_cost, rel=2e-2)
    dataset = Dataset.of(tmp_path)
    assert dataset.settings.horizon == "free"
    ends = np.append(dataset.episodes[1:] != dataset.episodes[:-1], True)
    assert dataset.time_left[~ends].min() > 0 and dataset.time_left[ends].max() < 0.2
    many = dataset.observed(NavigateEnv(split="fresh", horizon="free", lidar_beams=8).settings)
    assert many.observations.shape[1] == FREE_GOAL_ENTRIES + 8


def test_disturbed_demonstrations_show_how_to_recover(tmp_path):
    rollout("open", 4, tmp_path, horizon="free", noise=0.2, progress=False)
    replay = check_dataset(tmp_path, progress=False)
    assert replay.episodes == 4 and max(replay.observation, replay.reward, replay.state) < 1e-6
    for demonstration in load_demonstrations(tmp_path):
        assert np.isfinite(demonstration.cost_to_go).all() and demonstration.cost_to_go[-1] < 0.2


def test_symmetries_of_observations_are_those_of_scenarios():
    env = NavigateEnv(split="fresh", horizon="free")
    task = sample_scenario("clutter", 5, horizon="free")
    first = th.as_tensor(env.reset(options={"scenario": task})[0])[None]
    fields = task.to_dict()
    flip = lambda point: [point[0], 10 - point[1], *[-angle for angle in point[2:]]]  # noqa: E731
    for obstacle in fields["obstacles"]:
        obstacle["circle"]["center"] = flip(obstacle["circle"]["center"])
    fields |= {"start": flip(fields["start"]), "goal": flip(fields["goal"])}
    mirrored = env.reset(options={"scenario": Scenario.from_dict(fields)})[0]
    action = th.tensor([[0.3, 0.2]])
    free = env.unwrapped.settings
    observation, turned = mirror(free)(first, action)
    assert observation[0].numpy() == pytest.approx(mirrored, abs=1e-4)
    assert turned[0].tolist() == pytest.approx([0.3, -0.2])
    observation, _ = time_reversal(free)(first, action)
    (x, y, heading), (goal_x, goal_y, goal_heading) = task.start, task.goal
    backwards = task.model_copy(
        update={"start": (x, y, heading + math.pi), "goal": (goal_x, goal_y, goal_heading + math.pi)}
    )
    assert observation[0].numpy() == pytest.approx(env.reset(options={"scenario": backwards})[0], abs=1e-4)


def test_a_truncated_episode_is_marked_for_the_bootstrap():
    venv = make_vec_env(n_envs=2, scenario=straight(time_limit=0.1))
    venv.reset()
    for _ in range(2):
        _, _, dones, infos = venv.step(np.zeros((2, 2), np.float32))
    assert dones.all() and all(info["TimeLimit.truncated"] and "terminal_observation" in info for info in infos)


def test_a_policy_is_cloned_saved_and_evaluated(tmp_path):
    rollout("open", 8, tmp_path / "demos", horizon="free", progress=False)
    env = NavigateEnv("open", split="fresh", horizon="free")
    policy = fresh(env)
    thorough = CloningConfig(epochs=20, batch_size=64)
    losses = behaviour_clone(policy, Dataset.of(tmp_path / "demos"), thorough, progress=False)
    assert losses[-1].training < losses[0].training
    save_policy(policy, tmp_path / "policy", {"horizon": "free"})
    loaded = load_policy(tmp_path / "policy", env)
    evaluation = evaluate(loaded, "open", count=5, environment={"horizon": "free"}, timed=False, progress=False)
    assert len(evaluation.episodes) == 5
    with pytest.raises(ValueError, match=r"horizon='free' \(here 'fixed'\)"):
        load_policy(tmp_path / "policy", NavigateEnv("open", split="fresh"))
    command = f"evaluate {tmp_path / 'policy'} expert go-to-goal --family open --count 3 --json {tmp_path / 'out.json'}"
    assert main(command.split()) == 0


def test_the_expert_and_the_controller_are_evaluated():
    options = {"environment": {"horizon": "free"}, "timed": False, "progress": False}
    expert = evaluate(ExpertPolicy, "rooms", count=5, **options)
    assert expert.success == 1.0 and expert.soc == 1.0 and abs(expert.reached_regret) < 1e-3
    controller = evaluate(GoToGoal, "open", count=40, **options)
    assert controller.success > 0.5 and 0.0 < controller.regret < 1.0


@pytest.mark.parametrize(
    ("kind", "train"), [(PPOConfig, train_ppo), pytest.param(SACConfig, train_sac, marks=pytest.mark.slow)]
)
def test_reinforcement_learning_runs(kind, train, tmp_path):
    changes = {"hidden": SMALL, "lidar_beams": 8, "evaluation_scenarios": 2, "total_timesteps": 512, "n_envs": 4}
    if kind is SACConfig:
        changes |= {"learning_starts": 50, "buffer_size": 1000, "batch_size": 32}
    config = kind.tuned("open", horizon="free", out=tmp_path / "run", **changes)
    assert 0.99 < config.discount < 1.0
    (evaluation,) = train(config, progress=False)
    assert len(evaluation.episodes) == 5


def test_dagger_and_a_warm_start_run(tmp_path):
    common = {"family": "open", "horizon": "free", "hidden": SMALL, "lidar_beams": 8, "evaluation_scenarios": 2}
    dagger = DAggerConfig(rounds=1, max_failures=5, max_episodes=20, lead=1.0, last_epochs=1)
    run = DAggerRunConfig(out=tmp_path / "dagger", scenarios=8, n_envs=8, cloning=QUICK, dagger=dagger, **common)
    (evaluation,) = train_dagger(run, progress=False)
    assert len(evaluation.episodes) == 5
    demos = tmp_path / "dagger" / "demonstrations"
    changes = {"warm_start": (demos, tmp_path / "dagger"), "total_timesteps": 512, "n_envs": 4}
    del common["family"]
    config = PPOConfig.tuned("open", out=tmp_path / "ppo", **common, **changes)
    (evaluation,) = train_ppo(config, progress=False)
    assert len(evaluation.episodes) == 5


def test_a_goal_conditioned_environment_ends_at_the_goal():
    env = gym.make(GOAL_ID, scenario=straight(), reward="cost")
    observation, _ = env.reset()
    assert observation["observation"].shape == (32,)
    total, done = 0.0, False
    while not done:
        observation, reward, terminated, truncated, info = env.step(AHEAD)
        total, done = total + reward, terminated or truncated
    assert terminated and total == pytest.approx(-info["cost"])
    with pytest.raises(ValueError, match="a goal-conditioned environment needs 'lidar' or 'map', got 'state'"):
        NavigateGoalEnv(scenario=straight(), observation="state")


def test_a_picture_shows_the_time():
    env = NavigateEnv(scenario=straight(), render_mode="rgb_array")
    env.reset()
    frame = env.render()
    for _ in range(20):
        env.step(STAY)
    assert frame.shape == env.render().shape and (frame != env.render()).any()


def test_commands_take_the_horizon(tmp_path, capsys):
    bank = tmp_path / "free.bank"
    assert main(f"bank build --out {bank} --family open --horizon free --count 2".split()) == 0
    assert main(f"bank show {bank} --plot {tmp_path / 'bank.png'}".split()) == 0
    assert main(f"evaluate expert go-to-goal --bank {bank}".split()) == 0
    assert main(["evaluate", "expert", "--family", "open", "--horizon", "free", "--count", "2"]) == 0
    assert "expert" in capsys.readouterr().out
    assert main(["evaluate", "open", "--horizon", "free", "--count", "1"]) == 2
    assert "horizon: expected that of the policies, 'fixed', got 'free'" in capsys.readouterr().err


def test_old_banks_and_policies_are_fixed():
    assert ScenarioBank.shipped("open", "test").horizon == "fixed"
    assert Scenario.from_dict(scenario_fields()).horizon_kind == "fixed"
    policy = load_policy("open", NavigateEnv("open", split="fresh"))
    assert parts_of(policy.observation_space)["goal"] == slice(0, GOAL_ENTRIES)


def test_momentum_leaves_decided_actions_unchanged():
    scenario = straight(time_limit=5.0)
    weights = effort_weights(scenario)
    assert weights == pytest.approx((1.0 * 2.0**2, 0.5 * 3.0**2))  # r u_max^2 / (2 c), with c = 0.5
    for optimum in (find_optimum(sample_scenario("rooms", seed, horizon="free")) for seed in (31_000, 31_001)):
        actions = optimum.controls / np.array([2.0, 3.0])
        assert (actions**2 @ weights).min() >= 1 - 1e-6  # H = 0: the effort of an optimum is at least c
    weights = th.tensor(weights)
    decided, previous = th.tensor([[0.6, 0.0], [-0.2, 0.5]]), th.tensor([[-1.0, 1.0], [1.0, -1.0]])
    assert th.equal(add_momentum(decided, previous, weights), decided)
    undecided = add_momentum(th.tensor([[0.01, 0.0], [-0.01, 0.0], [0.0, 0.0]]), th.tensor([[0.5, 0.0]]), weights)
    assert (undecided[:, 0] > 0.49).all()  # in the direction of the last action, with the least effort of an optimum
    alone = add_momentum(th.tensor([[0.01, -0.02]]), th.zeros(1, 2), weights)
    assert (weights * alone.square()).sum() == pytest.approx(1.0) and alone[0, 1] == pytest.approx(-2 * alone[0, 0])


def test_only_robots_without_drift_have_momentum():
    for robot in ("unicycle", "differential_drive", "car"):
        assert effort_weights(sample_scenario("open", 3, robot, "free")) is not None
        assert effort_weights(sample_scenario("open", 3, robot)) is None
    assert effort_weights(sample_scenario("open", 3, "dynamic_unicycle", "free")) is None
