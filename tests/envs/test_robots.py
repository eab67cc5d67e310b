"""Every general property of a robot, over all models: those of the package, and one that a user adds."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from helpers import info_of_plan
from scipy.integrate import solve_ivp
from wagon_robot import Wagon

import leapnav.envs
from leapnav.envs import (
    Car,
    DifferentialDrive,
    DynamicCar,
    DynamicUnicycle,
    NavigateEnv,
    NavigateVectorEnv,
    Scenario,
    ScenarioError,
    Trailer,
    Unicycle,
    UnicycleTrailer,
    sample_scenario,
)
from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots import register
from leapnav.envs.robots.base import MODELS
from leapnav.envs.scenarios.cost import Cost
from leapnav.experts import ExpertPolicy, OptimalControlProblem, find_optimum
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.problem.system import switching_functions, system_of

BUILT_IN = (Unicycle, DifferentialDrive, Car, DynamicCar, DynamicUnicycle, Trailer, UnicycleTrailer)
ROBOTS = {model.name(): model for model in (*BUILT_IN, Wagon)}
BOX = [{"offset": offset, "radius": 0.16} for offset in (-0.2, 0.0, 0.2)]
RECTANGLE = {"box": {"length": 0.7, "width": 0.32, "offset": 0.1}}
each_robot = pytest.mark.parametrize("name", ROBOTS)


def task(name, **changes):
    fields = {
        "arena": [0, 0, 8, 8],
        "robot": {"model": name},
        "start": [1.5, 2.0, 0.4],
        "goal": [6.0, 5.5, 1.2],
        "horizon": 8.0,
        "obstacles": [{"circle": {"center": [3.6, 3.9], "radius": 0.7}}],
    }
    return Scenario.from_dict({**fields, **changes})


def rates_of(scenario):
    """Return q'(q, u) of a scenario's robot, from its declaration in SymPy."""
    import sympy as sp

    dynamics = type(scenario.robot).dynamics()
    controls = sp.symbols(f"u:{len(dynamics.fields)}")
    rates = [
        a + sum(u * field[i] for u, field in zip(controls, dynamics.fields, strict=True))
        for i, a in enumerate(dynamics.drift)
    ]
    function = sp.lambdify([dynamics.state, controls, dynamics.parameters], rates, modules="math")
    parameters = scenario.robot.parameters(scenario.cost)
    return lambda q, u: np.array(function(q, u, parameters), dtype=float)


MODELS.pop("wagon", None)  # registered for the tests of this module only: other tests read the list of models


@pytest.fixture(scope="module", autouse=True)
def wagon():
    register(Wagon)
    yield
    del MODELS["wagon"]


@pytest.fixture(scope="module")
def optima():
    return {name: find_optimum(task(name)) for name in ROBOTS}


def test_every_model_of_the_package_is_tested():
    assert set(MODELS) == set(ROBOTS)


@each_robot
def test_the_simulated_motion_is_that_of_the_declared_dynamics(name):
    scenario, rng = task(name), np.random.default_rng(0)
    rates, limits = rates_of(scenario), scenario.robot.action_scale()[1]
    parameters = constant(scenario.robot.parameters(scenario.cost))
    for h in (0.05, 0.3) if name != "wagon" else (0.05,):
        for _ in range(5):
            q = rng.uniform(-1.5, 1.5, len(scenario.start_state))
            u = rng.uniform(-1.0, 1.0, len(limits)) * limits
            new = np.empty_like(q)
            ROBOTS[name].advance(q, u, h, parameters, new)
            found = solve_ivp(lambda _, y, u=u: rates(y, u), (0.0, h), q, rtol=1e-12, atol=1e-12, method="DOP853")
            assert new == pytest.approx(found.y[:, -1], abs=1e-9)


@each_robot
def test_an_optimum_is_certified_and_satisfies_the_minimum_principle_independently(name, optima):
    optimum, scenario = optima[name], task(name)
    assert optimum.success
    rates, limits = rates_of(scenario), scenario.robot.action_scale()[1]
    # SciPy's integrator with the controls of the optimum arrives at the goal, at the same cost and without contact.
    weights = np.array(scenario.robot.control_weight(scenario.cost))
    times = np.linspace(0.0, scenario.horizon, 4001)
    found = solve_ivp(
        lambda t, q: rates(q, optimum.evaluate(t)[1]),
        (0.0, scenario.horizon),
        scenario.start_state,
        rtol=1e-9,
        atol=1e-9,
        t_eval=times,
    )
    for value, goal in zip(found.y[:, -1], scenario.goal_state, strict=True):
        if goal is not None:
            assert math.remainder(value - goal, 2 * math.pi) == pytest.approx(0.0, abs=1e-5)
    states, controls, costates = optimum.evaluate(times)
    assert np.abs(found.y.T - states).max() < 1e-5
    assert (np.abs(controls) <= limits * (1 + 1e-9)).all()
    discs = [(states[:, :2], scenario.robot.radius)]
    if "hitch_angle" in scenario.robot.state_names:
        angle, (disc,) = states[:, 2] + states[:, -1], scenario.robot.trailer
        axle = states[:, :2] - scenario.robot.hitch_length * np.column_stack([np.cos(angle), np.sin(angle)])
        discs.append((axle, disc.radius))
    state_cost = ROBOTS[name].state_cost or (lambda q, parameters: 0.0)
    parameters = constant(scenario.robot.parameters(scenario.cost))
    running = np.array([state_cost(np.ascontiguousarray(q), parameters) for q in states])
    running += 0.5 * controls**2 @ weights
    for centres, radius in discs:
        distance = np.hypot(*(centres - (3.6, 3.9)).T) - 0.7
        gaps = np.column_stack([centres, 8.0 - centres, distance]) - radius
        assert gaps.min() > 0
        running += (1 / np.expm1(gaps / scenario.cost.proximity_scale)).sum(axis=1)
    assert np.trapezoid(running, times) == pytest.approx(optimum.cost, rel=1e-5)
    # Within the limits u = -p / r with the switching functions p, and at a limit p points outwards.
    columns = np.tile(parameters, (len(times), 1))
    p = switching_functions(type(scenario.robot), states, costates, columns)
    assert controls == pytest.approx(np.clip(-p / weights, -limits, limits), abs=1e-9)


@each_robot
def test_the_optimum_executed_in_the_environment_succeeds_at_its_cost(name, optima):
    scenario, env = task(name), NavigateEnv(scenario=task(name))
    env.reset()
    info = {}
    for action in plan_actions(optima[name], scenario, env.control_period):
        _, _, _, _, info = env.step(action)
    assert info["is_success"]
    assert info["cost"] == pytest.approx(optima[name].cost, rel=2e-3)


@each_robot
def test_cost_to_go_and_costate_agree(name):
    env = NavigateEnv(scenario=task(name))
    env.reset()
    expert = ExpertPolicy(env)
    n = len(env.state)
    rng = np.random.default_rng(1)
    state, time = env.state + 0.02 * rng.normal(size=n), 0.3
    costate, h = expert.costate(state, time), 1e-4
    tolerance = 1e-4 if env.scenario.robot.state_bounds() is None else 1e-3  # the value excludes the barrier
    for i in range(n):
        step = h * np.eye(n)[i]
        slope = (expert.value(state + step, time) - expert.value(state - step, time)) / (2 * h)
        assert slope == pytest.approx(costate[i], abs=tolerance * (1 + abs(costate[i])))


@each_robot
def test_the_expert_compensates_actuation_noise(name):
    env = NavigateEnv(scenario=task(name), disturbance={"actuation": 0.1})
    observation, _ = env.reset(seed=3)
    expert, info, terminated = ExpertPolicy(env), {}, False
    while not terminated:
        action, _ = expert.predict(observation)
        observation, _, terminated, _, info = env.step(action)
    assert info["is_success"]


@each_robot
def test_the_mirrored_scenario_has_the_same_cost(name, optima):
    obstacles = [{"circle": {"center": [3.6, 8 - 3.9], "radius": 0.7}}]
    mirrored = find_optimum(task(name, start=[1.5, 6.0, -0.4], goal=[6.0, 2.5, -1.2], obstacles=obstacles))
    assert mirrored.cost == pytest.approx(optima[name].cost, rel=1e-8)


@pytest.mark.parametrize("name", [name for name, model in ROBOTS.items() if model.reversal is not None])
def test_a_path_and_its_reversal_have_the_same_cost(name, optima):
    turned = find_optimum(task(name, start=[1.5, 2.0, 0.4 - math.pi], goal=[6.0, 5.5, 1.2 - math.pi]))
    assert turned.cost == pytest.approx(optima[name].cost, rel=1e-8)


@each_robot
def test_an_episode_of_the_vector_environment_is_that_of_a_single_one(name):
    rng = np.random.default_rng(2)
    envs = [NavigateEnv("rooms", split="fresh", robot=name) for _ in range(3)]
    venv = NavigateVectorEnv(3, "rooms", split="fresh", robot=name)
    observations, _ = venv.reset(seed=11)
    for i, env in enumerate(envs):
        assert (env.reset(seed=11 + i)[0] == observations[i]).all()
    for _ in range(30):
        actions = rng.uniform(-1.0, 1.0, venv.action_space.shape).astype(np.float32)
        observations, rewards, ended, _, _ = venv.step(actions)
        for i, env in enumerate(envs):
            observation, reward, terminated, _, _ = env.step(actions[i])
            assert (observation == observations[i]).all()
            assert (reward, terminated) == (rewards[i], ended[i])
            assert (env.state == venv.states[i]).all()
        if ended.any():
            break


@each_robot
def test_observation_and_action_spaces_fit_the_robot(name):
    env = NavigateEnv(scenario=task(name), observation="state", dict_observation=True)
    observation, _ = env.reset(seed=0)
    n, m = ROBOTS[name].sizes()
    assert env.action_space.shape == (m,)
    motion = env.observation_space["motion"].shape if n > 3 else (0,)
    assert motion == (n - 3,)
    assert ("motion" in observation) == (n > 3)
    if n > 3:
        action = np.full(m, 0.5, np.float32)
        observation, *_ = env.step(action)
        expected = env.state[3:].copy()
        if ROBOTS[name].heading_states:
            expected -= env.state[2]
        assert observation["motion"] == pytest.approx(expected, abs=1e-6)


def test_the_goal_of_a_further_heading_holds_modulo_2_pi():
    for turns, reached in ((0, True), (1, True), (0.25, False)):
        scenario = task("wagon", start=[2, 2, 0], goal=[2.05, 2, 0], goal_motion=[2 * math.pi * turns])
        env = NavigateEnv(scenario=scenario)
        env.reset(seed=0)
        assert env.at_goal is reached


@each_robot
def test_scenarios_survive_json(name):
    scenario = task(name, start_motion=[0.1] * (ROBOTS[name].sizes()[0] - 3) or None)
    again = Scenario.from_json(scenario.to_json())
    assert again == scenario
    for name in scenario.task._fields:
        assert getattr(again.task, name) == pytest.approx(getattr(scenario.task, name), nan_ok=True)


@pytest.mark.parametrize(("name", "width"), [("unicycle", 0.5), ("car", 0.52), ("dynamic_unicycle", 0.44)])
def test_a_box_of_three_discs(name, width):
    fields = {"model": name, "footprint": BOX}
    # The box fits lengthwise, but it cannot rotate in the passage.
    sides = (0, 4 - width / 2), (4 + width / 2, 8)
    walls = [{"polygon": {"vertices": [[3, low], [5, low], [5, high], [3, high]]}} for low, high in sides]
    scenario = task(name, robot=fields, start=[1.5, 4.0, 0.0], goal=[6.5, 4.0, 0.0], obstacles=walls)
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.doubts == ()
    times = np.linspace(0.0, scenario.horizon, 2001)
    states = optimum.evaluate(times)[0]
    inside = (states[:, 0] > 3.4) & (states[:, 0] < 4.6)
    for offset in (-0.2, 0.0, 0.2):
        y = states[:, 1] + offset * np.sin(states[:, 2])
        assert np.abs(y[inside] - 4.0).max() + 0.16 < width / 2
    assert optimum.certificate.clearance == pytest.approx(
        min(footprint_clearance(q, scenario.outline, scenario.field)[0] for q in states), abs=1e-3
    )
    info = info_of_plan(optimum, scenario)
    assert info["is_success"]
    assert info["cost"] == pytest.approx(optimum.cost, rel=5e-3)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("footprint", [None, BOX, RECTANGLE])
def test_a_collision_ends_where_the_outline_is_in_contact(name, footprint):
    robot = {"model": name} if footprint is None else {"model": name, "footprint": footprint}
    wall = [{"polygon": {"vertices": [[5, 0], [6, 0], [6, 8], [5, 8]]}}]
    scenario = task(name, robot=robot, start=[3.5, 4.0, 0.2], goal=[7.0, 4.0, 0.0], obstacles=wall)
    ahead = {"differential_drive": (1.0, 1.0)}.get(name, (1.0, 0.0))
    for terminate in (True, False):
        env = NavigateEnv(scenario=scenario, terminate_on_collision=terminate)
        env.reset()
        info = {"collision": False}
        for _ in range(60):
            _, _, terminated, _, info = env.step(np.array(ahead, dtype=np.float32))
            state = np.array([*env.pose, *info.get("motion", ())])
            clearance = footprint_clearance(state, scenario.outline, scenario.field)[0]
            assert clearance > -2e-3
            if info["collision"] and terminate:
                assert terminated
                assert clearance < 1e-4
                break
        assert info["collision"]


def test_the_wrong_robot_is_refused_by_name():
    env = NavigateEnv("clutter", split="fresh", robot="car")
    with pytest.raises(ValueError, match=r"this environment is for 'car', but scenario .* has the robot 'unicycle'"):
        env.reset(options={"scenario": sample_scenario("clutter", 5)})
    with pytest.raises(ValueError, match="robot: expected that of the scenario"):
        NavigateEnv(scenario=task("unicycle"), robot="car")
    with pytest.raises(ValueError, match=r"robot.model: expected one of .*'cars'; did you mean 'car'"):
        NavigateEnv(robot="cars")
    with pytest.raises(ValueError, match=r"robot.wheelbse: unknown field, got 0.5; did you mean 'wheelbase'"):
        NavigateEnv(robot={"model": "car", "wheelbse": 0.5})
    with pytest.raises(ValueError, match="actuation: 'motor' needs the robot 'unicycle', got 'car'"):
        NavigateEnv(robot="car", actuation="motor", split="fresh")
    with pytest.raises(ValueError, match="split: the robot 'unicycle_trailer' has included banks for no family"):
        NavigateEnv("clutter", split="test", robot="unicycle_trailer")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": {"model": "car", "max_steering": 2.0}}, "robot.max_steering: expected a number < 1.5708, got 2.0"),
        ({"robot": {"model": "car", "radius": 0.2, "footprint": BOX}}, "radius: cannot be combined with footprint"),
        ({"robot": {"model": "car", "footprint": []}}, "robot.footprint"),
        ({"robot": {"model": "car"}, "start_motion": [0.1, 0.2]}, r"start_motion: expected 1 \(steering\) numbers"),
        ({"start_motion": [0.1]}, "start_motion: expected 0 numbers for the robot 'unicycle'"),
        (
            {"robot": {"model": "car"}, "cost": {"turn_weight": 2.0}},
            "cost.turn_weight: not used by the robot 'car', got 2",
        ),
    ],
)
def test_errors_name_field_and_value(changes, message):
    with pytest.raises(ScenarioError, match=message):
        task("unicycle", **changes)


def test_a_bank_of_another_robot(tmp_path):
    from leapnav.experts import build_bank

    bank = build_bank("open", 3, tmp_path / "wagon.bank", robot="wagon", progress=False)
    assert bank.robot == Wagon()
    reference = bank.reference(0)
    assert reference.states.shape[1:] == (4,)
    env = NavigateEnv(bank=bank)
    expert, (observation, info) = ExpertPolicy(env), env.reset(seed=0)
    terminated = False
    while not terminated:
        action, _ = expert.predict(observation)
        observation, _, terminated, _, info = env.step(action)
    assert info["is_success"]
    assert info["cost"] == pytest.approx(float(bank.costs[env.index]), rel=1e-2)


def test_a_robot_of_one_s_own_is_demonstrated_and_cloned(tmp_path):
    from leapnav.experts import rollout
    from leapnav.experts.data.rollouts import check_dataset
    from leapnav.training import CloningConfig, Dataset, behaviour_clone, make_policy

    summary = rollout("open", 6, tmp_path / "data", robot="wagon", progress=False)
    assert summary.demonstrations == 6
    replay = check_dataset(tmp_path / "data", progress=False)
    assert max(replay.observation, replay.reward, replay.state) < 1e-9
    dataset = Dataset.of(tmp_path / "data")
    assert dataset.settings.robot == "wagon"
    env = NavigateEnv("open", split="fresh", robot="wagon")
    policy = make_policy(env.observation_space, env.action_space, 0, (32,))
    for loss in ("action", "hamiltonian"):
        losses = behaviour_clone(policy, dataset, CloningConfig(epochs=4, loss=loss), progress=False)
        assert losses[-1].training < losses[0].training


def test_a_name_is_registered_once():
    class Other(Unicycle):
        model: str = "car"

    with pytest.raises(ValueError, match=r"model: 'car' is the name of leapnav.envs.robots.car.Car"):
        register(Other)


def test_a_user_s_robot_is_unknown_until_its_file_is_imported():
    text = json.dumps(task("wagon").to_dict())
    code = "import sys; from leapnav.envs import Scenario; Scenario.from_json(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, text], capture_output=True, text=True, check=False)
    assert "robot.model: expected one of unicycle" in done.stderr.splitlines()[-1]


def test_the_metric_of_the_differential_drive_is_its_cost():
    """1/2 w (left^2 + right^2) is 1/2 (speed_weight v^2 + turn_weight omega^2) with the weights of the metric."""
    robot, cost = DifferentialDrive(track=0.7), Cost(speed_weight=1.6)
    left, right = 0.4, 1.1
    speed, turn_rate = (left + right) / 2, (right - left) / robot.track
    wheels = robot.control_weight(cost)
    weights = robot.metric(cost)
    assert wheels[0] * left**2 + wheels[1] * right**2 == pytest.approx(
        weights[0] * speed**2 + weights[1] * turn_rate**2
    )


def test_the_system_of_a_model_is_that_of_its_problem():
    for name, model in ROBOTS.items():
        problem = OptimalControlProblem.from_scenario(task(name))
        assert problem.system is system_of(model)
        assert len(problem.start) == len(model.state_names)
    assert leapnav.envs.RobotModel is not None
