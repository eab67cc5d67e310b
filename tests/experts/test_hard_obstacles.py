"""Scenarios with the proximity weight 0: obstacles that cost nothing and must not be touched."""

import json

import gymnasium as gym
import numpy as np
import pytest
from helpers import ROBOTS, drawn_scenario

from leapnav.cli import main
from leapnav.envs import NavigateEnv, Scenario, ScenarioBank, ScenarioError, sample_scenario
from leapnav.envs.scenarios.bank import BankError, collection_name
from leapnav.envs.scenarios.bank_writing import BankEntry, write_bank
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.experts import ExpertPolicy, build_bank, build_bank_of, find_optimum, minimum_time, solve
from leapnav.experts.acting.barrier import barrier_integral, reference_problem
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.data.datasets import dataset_id
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.experts.data.rollouts import check_dataset, rollout
from leapnav.experts.hard_limits import barrier_integrals
from leapnav.experts.optimum import find_reached_optimum
from leapnav.experts.plotting.extremals import plot_extremal
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.play.solving import PlaySolver
from leapnav.training import Dataset, evaluate
from leapnav.training.config import DAggerRunConfig, PPOConfig
from leapnav.training.runs.imitation import make_env
from leapnav.training.runs.reinforcement import make_training_env

ID = "leapnav/Navigate-v0"
FAMILIES = ("clutter", "polygons", "rooms", "slalom")  # with included test banks


def stored_path(bank, index):
    reference = bank.reference(index)
    return Trajectory(reference.times, reference.states.astype(float), reference.costates.astype(float))


def drive(env, expert, **options):
    """Play an episode; return the infos of its steps."""
    observation, _ = env.reset(seed=0, options=options)
    infos, done = [], False
    while not done:
        observation, reward, terminated, truncated, info = env.step(expert.predict(observation)[0])
        assert np.isfinite(reward)
        infos.append(info)
        done = terminated or truncated
    return infos


@pytest.mark.parametrize("horizon", ["fixed", "free"])
def test_random_scenarios_differ_in_the_proximity_weight_only(horizon):
    for robot in ROBOTS:
        soft, hard = (sample_scenario("rooms", 7, robot, horizon, kind) for kind in ("cost", "hard"))
        assert (soft.cost.obstacles, hard.cost.obstacles) == ("cost", "hard")
        assert hard == soft.model_copy(update={"cost": soft.cost.model_copy(update={"proximity_weight": 0.0})})


def test_invalid_arguments_are_named():
    for function in (
        lambda: sample_scenario("clutter", 1, obstacles="soft"),
        lambda: NavigateEnv(obstacles="soft"),
        lambda: ScenarioBank.shipped("clutter", "test", obstacles="soft"),
        lambda: build_bank("clutter", 1, "no.bank", obstacles="soft"),
        lambda: rollout("clutter", 1, "no", obstacles="soft"),
    ):
        with pytest.raises(ValueError, match="obstacles: expected one of cost, hard, got 'soft'"):
            function()
    hard, bank = sample_scenario("clutter", 1, obstacles="hard"), ScenarioBank.shipped("clutter", "test")
    with pytest.raises(ValueError, match="obstacles: expected that of the scenario, 'hard', got 'cost'"):
        NavigateEnv(scenario=hard, obstacles="cost")
    with pytest.raises(ValueError, match="obstacles: expected that of the bank, 'cost', got 'hard'"):
        NavigateVectorEnv(2, bank=bank, obstacles="hard")
    with pytest.raises(
        ValueError, match="'unicycle' with hard obstacles has included banks for no family, got 'train'"
    ):
        NavigateEnv("clutter", split="train", obstacles="hard")


def test_environments_have_hard_obstacles():
    bank = ScenarioBank.shipped("rooms", "test", obstacles="hard")
    env = gym.make(ID, family="rooms", split="test", obstacles="hard")
    _, info = env.reset(seed=1)
    assert env.unwrapped.bank is bank and env.unwrapped.scenario.cost.proximity_weight == 0
    assert info["reference_cost"] == bank.costs[info["index"]]
    fresh = gym.make(ID, obstacles="hard")  # there is no training bank
    assert fresh.unwrapped.bank is None
    assert drawn_scenario(fresh, seed=1).cost.obstacles == "hard"
    again = gym.make(fresh.unwrapped.spec)
    assert drawn_scenario(again, seed=1).cost.obstacles == "hard"
    many = gym.make_vec(ID, num_envs=2, obstacles="hard", vectorization_mode="vector_entry_point")
    many.reset(seed=1)
    assert {scenario.cost.obstacles for scenario in many.scenarios} == {"hard"}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("observation", ["lidar", "geodesic"])
def test_the_environment_charges_no_proximity_cost_even_in_contact(robot, observation):
    scenario = sample_scenario("clutter", 3, robot, obstacles="hard")
    env = NavigateEnv(scenario=scenario, observation=observation, terminate_on_collision=False)
    seen, _ = env.reset(seed=0)
    contact = False
    action = np.array([1.0, 1.0 if robot == "differential_drive" else 0.0], np.float32)  # straight ahead
    for _ in range(300):
        seen, reward, terminated, _, info = env.step(action)
        contact = contact or info["collision"]
        assert info["reward_proximity"] == 0.0
        assert np.isfinite(seen).all() and np.isfinite(reward)
        assert reward == pytest.approx(sum(value for name, value in info.items() if name.startswith("reward_")))
        if terminated:
            break
    assert contact


@pytest.mark.parametrize("family", FAMILIES)
def test_included_banks_have_collision_free_optima(family):
    bank = ScenarioBank.shipped(family, "test", obstacles="hard")
    assert len(bank) == 200 and bank.obstacles == "hard" and bank[0].name.startswith(f"hard-{family}-1-")
    assert family in ScenarioBank.shipped_families(obstacles="hard")
    assert bank.certificates[:, 3].min() > 0
    soft = ScenarioBank.shipped(family, "test")
    known = dict(zip(soft.draws.tolist(), soft.costs.tolist(), strict=True))
    both = [(cost, known[draw]) for draw, cost in zip(bank.draws.tolist(), bank.costs, strict=True) if draw in known]
    assert len(both) > 150 and all(hard < soft for hard, soft in both)  # less to pay for
    for index in range(0, 200, 40):
        guess = stored_path(bank, index)
        problem = reference_problem(OptimalControlProblem.from_scenario(bank[index]), guess)
        found = solve(bank[index], "multiple_shooting", guess=guess)
        assert found.success and found.cost == pytest.approx(bank.costs[index], rel=1e-6)
        assert found.problem.barrier_weight == pytest.approx(problem.barrier_weight, rel=1e-9)
        assert 0 < found.barrier <= 1e-3


def test_the_barrier_weight_of_a_stored_path_is_found():
    for robot in ("unicycle", "car", "dynamic_unicycle"):
        scenario = sample_scenario("clutter", 1, robot, obstacles="hard")
        optimum = find_optimum(scenario, "medium")
        states, _, costates = optimum.evaluate(times := np.linspace(0.0, optimum.horizon, 120))
        stored = Trajectory(times, states.astype("f4").astype(float), costates.astype("f4").astype(float))
        problem = OptimalControlProblem.from_scenario(scenario)
        assert reference_problem(problem, stored).barrier_weight == pytest.approx(
            optimum.problem.barrier_weight, rel=1e-3
        )
        assert reference_problem(problem, optimum).barrier_weight == optimum.problem.barrier_weight
        nodes = np.concatenate([optimum.states, optimum.costates], axis=1)[::8].copy()
        integral = barrier_integral(optimum.problem, optimum.times[::8].copy(), nodes)
        part = barrier_integrals(optimum)[: (len(nodes) - 1) * 8].sum()
        assert integral == pytest.approx(part, rel=1e-2)


def test_the_history_begins_with_the_method_that_found_the_first_extremal():
    found = solve(sample_scenario("clutter", 0, obstacles="hard"), method="leapfrog", polish=False)
    assert found.success
    assert found.history[0].phase == "sweep" and found.history[-1].phase == "newton"


def test_banks_are_built_and_checked(tmp_path):
    path = tmp_path / "hard.bank"
    assert (
        main(f"bank build --out {path} --family clutter --obstacles hard --count 2 --seed 5 --workers 1".split()) == 0
    )
    bank = ScenarioBank(path)
    assert bank.obstacles == "hard" and bank[0].name.startswith("hard-clutter-5-")
    assert len(build_bank("clutter", 2, path, obstacles="hard", seed=5, progress=False)) == 2
    with pytest.raises(BankError, match="with obstacles 'hard' instead of 'cost'"):
        build_bank("clutter", 2, path, seed=5, progress=False)
    assert collection_name("clutter", "car", "free", "hard") == "car-free-hard-clutter"
    reference = bank.reference(0)
    arrays = reference.states, reference.controls, reference.costates
    soft = sample_scenario("clutter", 6)
    entries = [
        BankEntry(one.to_json(), 0, reference.cost, None, reference.certificate, *arrays) for one in (bank[0], soft)
    ]
    rest = {"family": "clutter", "seed": 5, "drawn": 2, "rejected": {}, "software": "0"}
    with pytest.raises(ValueError, match="expected one kind of obstacles for all scenarios, got cost, hard"):
        write_bank(tmp_path / "mixed.bank", entries, **rest)
    with pytest.raises(ScenarioError, match="obstacles: expected that of"):
        build_bank_of([bank[0], soft], tmp_path / "mixed.bank")
    for factor in (0.9, 1.1):
        entry = BankEntry(bank[0].to_json(), 0, factor * reference.cost, None, reference.certificate, *arrays)
        write_bank(tmp_path / "wrong.bank", [entry], **{**rest, "drawn": 1})
        with pytest.raises(BankError, match="costs: expected"):
            ScenarioBank(tmp_path / "wrong.bank").reference(0)


@pytest.mark.parametrize("horizon", ["fixed", "free"])
@pytest.mark.parametrize(
    ("family", "robot"),
    [
        ("clutter", "unicycle"),
        ("rooms", "dynamic_unicycle"),
        *(
            pytest.param(*task, marks=pytest.mark.slow)
            for task in [("clutter", "car"), ("clutter", "dynamic_unicycle"), ("rooms", "unicycle"), ("rooms", "car")]
        ),
    ],
)
def test_the_expert_reaches_the_goal_from_perturbed_starts(family, robot, horizon):
    scenario = sample_scenario(family, 6001, robot, horizon, "hard")
    optimum = find_optimum(scenario, "medium")
    path = Trajectory(optimum.times, optimum.states, optimum.costates)
    start = np.array(scenario.start_state)
    for sign in (0.0, 1.0, -1.0):
        offset = sign * np.resize([0.08, -0.05, 0.1], len(start))
        moved = scenario.from_state(start + offset, 0.0)
        env = NavigateEnv(scenario=moved)
        last = drive(env, ExpertPolicy(env, references={moved: path}))[-1]
        assert last["is_success"] and not last["collision"]
        if sign == 0.0 and horizon == "fixed":
            assert last["cost"] == pytest.approx(optimum.cost, rel=2e-3)


def test_values_exclude_the_barrier():
    bank = ScenarioBank.shipped("clutter", "test", obstacles="hard")
    env = NavigateEnv(bank=bank)
    expert = ExpertPolicy(env)
    for index in range(3):
        observation, _ = env.reset(options={"index": index})
        assert expert.value() == pytest.approx(bank.costs[index], rel=1e-5)
        expert.predict(observation)
        costs, costates = expert.labels()
        assert costs[0] == pytest.approx(bank.costs[index], rel=1e-5)
        assert costates[0] == pytest.approx(bank.reference(index).costates[0], abs=1e-3)
        last = drive(env, expert, index=index)[-1]
        assert last["is_success"]
        reached = find_reached_optimum(bank[index], env.state, last["cost"], stored_path(bank, index))
        assert reached.success and 1 <= last["cost"] / reached.cost < 1.001


def test_gains_of_the_barrier_problem_are_finite():
    scenario = sample_scenario("clutter", 1, obstacles="hard")
    feedback = Feedback(scenario, find_optimum(scenario, "medium"))
    gains = feedback.gains()
    assert np.isfinite(gains.slopes).all() and np.isfinite(gains.control(np.array(scenario.start), 0.0)).all()


@pytest.mark.parametrize(("horizon", "robot"), [("fixed", "car"), ("free", "unicycle")])
def test_demonstrations_succeed_and_are_replayed(tmp_path, horizon, robot, monkeypatch):
    monkeypatch.setattr("leapnav.experts.data.rollouts.SHARD_SIZE", 1)
    arguments = {"horizon": horizon, "obstacles": "hard", "robot": robot}
    summary = rollout("clutter", 2, tmp_path, **arguments, recoveries=1, progress=False)
    assert summary.failed_replays == 0 and summary.demonstrations > 2
    assert (tmp_path / dataset_id("clutter", **arguments)).is_dir()
    replay = check_dataset(tmp_path, progress=False)
    assert max(replay.observation, replay.reward, replay.state) < 1e-6
    for demonstration in load_demonstrations(tmp_path):
        assert demonstration.is_success and demonstration.scenario.cost.obstacles == "hard"
        spent = demonstration.running_cost.sum() + demonstration.cost_to_go[-1]
        assert spent == pytest.approx(demonstration.reference_cost, rel=5e-3)
    dataset = Dataset.of(tmp_path)
    assert np.isfinite(dataset.returns).mean() > 0.95


def test_policies_are_evaluated_and_trained_with_hard_obstacles(tmp_path):
    scores = evaluate(ExpertPolicy, "clutter", count=4, environment={"obstacles": "hard"}, timed=False, progress=False)
    assert scores.success == 1.0 and scores.soc > 0.999
    assert main(f"evaluate go-to-goal --obstacles hard --count 2 --json {tmp_path / 'scores.json'}".split()) == 0
    assert json.loads((tmp_path / "scores.json").read_text())
    env = make_training_env(PPOConfig(out=tmp_path, obstacles="hard", n_envs=2))
    env.reset()
    assert {scenario.cost.obstacles for scenario in env.unwrapped.venv.scenarios} == {"hard"}
    own = make_env(DAggerRunConfig(out=tmp_path, obstacles="hard"))
    assert drawn_scenario(own, seed=0).cost.obstacles == "hard"


def test_solutions_state_the_remaining_barrier(tmp_path, capsys):
    scenario = sample_scenario("clutter", 1, obstacles="hard")
    scenario.to_json(tmp_path / "hard.json")
    files = f"--json {tmp_path / 'out.json'} --plot {tmp_path / 'out.png'}"
    assert main(f"solve {tmp_path / 'hard.json'} {files}".split()) == 0
    content = json.loads((tmp_path / "out.json").read_text())
    assert 0 < content["barrier"] <= 1e-3 and (tmp_path / "out.png").stat().st_size > 0
    assert f"barrier            {100 * content['barrier']:.3f} % of the cost" in capsys.readouterr().out
    solver = PlaySolver(["expert"])
    found = solver.search(scenario)
    assert found["path"]["barrier"] == pytest.approx(content["barrier"])
    fields = scenario.to_dict()
    fields["goal"][0] += 0.02
    followed = solver.follow(Scenario.from_dict(fields), found["id"])
    assert followed["success"] and not followed["searched"] and followed["path"]["barrier"] <= 1e-3
    assert solver.drive(scenario, "expert")["success"]
    soft = find_optimum(sample_scenario("clutter", 1), "medium")
    assert soft.to_dict()["barrier"] == 0.0 and plot_extremal(soft) is not None


def test_the_minimum_time_with_hard_obstacles_is_shorter():
    soft, hard = (sample_scenario("rooms", 2, "car", obstacles=kind) for kind in ("cost", "hard"))
    free = minimum_time(hard, 0.1)
    assert free.horizon < minimum_time(soft, 0.1).horizon
    assert free.extremal.certificate.clearance > 0 and free.extremal.barrier < 5e-3


@pytest.mark.parametrize("effort", ["medium", "high"])
def test_a_cheaper_extremal_whose_continuation_stalled_is_searched_again(effort):
    """The continuation of the optimum stalls at the first barrier weight; the next extremal costs 45 % more."""
    scenario = sample_scenario("clutter", np.random.default_rng([784, 3408]), obstacles="hard")
    found = find_optimum(scenario, effort)
    assert found.success and found.cost < 2.22 and not found.doubts
    assert all(one.success and one.cost > found.cost for one in found.alternatives)
