"""Families of users: registered functions, and functions in modules."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers import SMALL, drawn_scenario

from leapnav.cli import main
from leapnav.envs import Circle, NavigateEnv, Obstacle, Scenario, ScenarioBank, ScenarioLayout, register_family
from leapnav.envs.scenarios.families import sample_scenario
from leapnav.experts import build_bank, load_demonstrations, rollout
from leapnav.training import PPOConfig, evaluate, train_ppo

MODULE = """
from leapnav.envs import Circle, Obstacle, ScenarioLayout

def pillar(rng):
    where = tuple(rng.uniform(2.5, 3.5, 2).round(3).tolist())
    return ScenarioLayout([Obstacle(circle=Circle(center=where, radius=0.4))], arena=(0.0, 0.0, 6.0, 6.0))

answer = 42
"""


@pytest.fixture
def pillar():
    def sample(rng):
        where = tuple(rng.uniform(2.5, 3.5, 2).round(3).tolist())
        return ScenarioLayout([Obstacle(circle=Circle(center=where, radius=0.4))], arena=(0.0, 0.0, 6.0, 6.0))

    register_family("pillar", sample)
    return sample


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The name of a family in a module."""
    (tmp_path / "warehouse.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    yield "warehouse:pillar"
    sys.modules.pop("warehouse", None)


def test_a_registered_family_is_sampled_like_a_built_in_one(pillar):
    scenario = sample_scenario("pillar", 3)
    assert scenario == sample_scenario("pillar", 3) != sample_scenario("pillar", 4)
    assert scenario.name == "pillar-3" and scenario.arena == (0.0, 0.0, 6.0, 6.0)
    assert np.hypot(*np.subtract(scenario.start[:2], scenario.goal[:2])) >= 2.4  # 0.4 times the side
    for pose in (scenario.start, scenario.goal):
        assert min(pose[:2]) >= 0.5 and max(pose[:2]) <= 5.5
    free = sample_scenario("pillar", 3, horizon="free")
    assert free.start == scenario.start and free.horizon is None and free.time_limit > scenario.horizon


def test_the_horizon_grows_with_the_arena():
    register_family("hall", lambda rng: ScenarioLayout([], arena=(0.0, 0.0, 100.0, 100.0)))
    horizons = [sample_scenario("hall", seed).horizon for seed in range(10)]
    assert 50.0 < max(horizons) <= 400.0


def test_environments_play_it(pillar, module):
    for name in ("pillar", module):
        env = NavigateEnv(name)
        scenario = drawn_scenario(env, seed=0)
        assert len(scenario.obstacles) == 1 and env.family == name
        venv = gym.make_vec("leapnav/Navigate-v0", 3, "vector_entry_point", family=name)
        venv.reset(seed=0)
        assert venv.unwrapped.scenarios[0].obstacles == scenario.obstacles
        for _ in range(3):
            venv.step(np.zeros((3, 2)))


def test_a_family_may_return_whole_scenarios():
    def sample(rng):
        x = float(rng.uniform(4.0, 5.0))
        return Scenario(name="x", arena=(0, 0, 8, 4), start=(1, 2, 0), goal=(x, 2, 0), horizon=6.0)

    register_family("lane", sample)
    scenario = sample_scenario("lane", 7)
    assert scenario.name == "lane-7" and scenario.horizon == 6.0 and 4.0 <= scenario.goal[0] <= 5.0
    with pytest.raises(ValueError, match="robot: expected that of the scenarios of 'lane'"):
        sample_scenario("lane", 7, robot="car")
    with pytest.raises(ValueError, match="horizon: expected that of the scenarios of 'lane', 'fixed', got 'free'"):
        sample_scenario("lane", 7, horizon="free")


def test_the_scenarios_of_a_family_may_have_robots_with_different_parameters(tmp_path):
    def sample(rng):
        robot = {"model": "differential_drive", "radius": round(float(rng.uniform(0.2, 0.3)), 3)}
        return Scenario(name="x", arena=(0, 0, 8, 4), start=(1, 2, 0), goal=(5, 2, 0), horizon=6.0, robot=robot)

    register_family("sizes", sample)
    env, radii = gym.make("leapnav/Navigate-v0", family="sizes"), set()  # the model is that of the scenarios
    for seed in range(3):
        env.reset(seed=seed)
        radii.add(env.unwrapped.scenario.robot.radius)
    assert len(radii) == 3 and env.unwrapped.settings.robot == "differential_drive"
    bank = build_bank("sizes", 3, tmp_path / "sizes.bank", progress=False)
    assert len({scenario.robot.radius for scenario in bank}) == 3
    assert rollout("sizes", 2, tmp_path / "demos", robot="differential_drive", progress=False).demonstrations == 2
    with pytest.raises(ValueError, match="robot: expected that of the scenarios of 'sizes'"):
        sample_scenario("sizes", 7, robot={"model": "differential_drive", "radius": 0.25})


def test_banks_and_demonstrations_are_the_same_with_any_number_of_processes(pillar, tmp_path):
    """The function is local, so that other processes cannot import it."""
    banks = [build_bank("pillar", 4, tmp_path / f"{n}.bank", seed=5, workers=n, progress=False) for n in (1, 2)]
    assert banks[0].path.read_bytes() == banks[1].path.read_bytes()
    assert banks[0].family == "pillar" and banks[0][0].name == "pillar-5-0"
    assert rollout("pillar", 3, tmp_path / "demos", workers=2, progress=False).demonstrations == 3
    assert load_demonstrations(tmp_path / "demos")[0].scenario.arena == (0.0, 0.0, 6.0, 6.0)


@pytest.mark.usefixtures("coarse_decisions")
def test_a_run_trains_and_is_evaluated(module, tmp_path):
    config = PPOConfig(
        out=tmp_path / "run",
        family=module,
        hidden=SMALL,
        lidar_beams=8,
        n_envs=4,
        n_steps=32,
        total_timesteps=256,
        evaluation_scenarios=3,
    )
    (evaluation,) = train_ppo(config, progress=False)
    bank = ScenarioBank(tmp_path / "run" / "test.bank")
    assert len(evaluation) == len(bank) == 5 and bank.family == module
    assert len(evaluate(lambda observation: np.zeros(2), bank, count=2, progress=False)) == 2
    command = ["evaluate", str(tmp_path / "run"), "--count", "2", "--html", str(tmp_path / "report.html")]
    assert main(command) == 0
    assert module in (tmp_path / "report.html").read_text()


def test_the_command_line_finds_modules_in_the_current_directory(module, tmp_path):
    out, script = tmp_path / "own.bank", Path(sys.executable).with_name("leapnav")
    command = ["bank", "build", "--family", module, "--count", "3", "--out", str(out)]
    words = [str(script), *command, "--workers", "1"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ScenarioBank(out)[0].name == "warehouse_pillar-0-0"


def test_modules_are_searched_in_the_current_directory_only_for_a_family_of_a_module(tmp_path, monkeypatch, capsys):
    (tmp_path / "depot.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    known = [folder for folder in sys.path if folder not in ("", str(tmp_path))]
    monkeypatch.setattr(sys, "path", known.copy())
    assert main(["completion", "bash"]) == 0 and main(["bank", "show", "missing.bank"]) == 2
    assert main(["evaluate", "go-to-goal", "--family", "nowhere:pillar"]) == 2
    assert "cannot import the module 'nowhere'" in capsys.readouterr().err
    assert sys.path == known
    assert main(["evaluate", "go-to-goal", "--family", "depot:pillar"]) == 2
    assert "build a bank of another family" in capsys.readouterr().err
    assert sys.path == [*known, str(tmp_path)]
    sys.modules.pop("depot")


def test_without_a_bank_the_command_says_how_to_make_one(module, capsys):
    assert main(["evaluate", "go-to-goal", "--family", module]) == 2
    message = "got 'warehouse:pillar'; build a bank of another family with leapnav bank build, and pass it as bank"
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere:pillar", "family: 'nowhere:pillar': cannot import the module 'nowhere'"),
        ("warehouse:shelf", "family: the module 'warehouse' has no function 'shelf'"),
        ("warehouse:answer", "family: 'warehouse:answer' is not a function, but a int"),
    ],
)
def test_a_function_that_does_not_exist_is_named(module, name, message):
    with pytest.raises(ValueError, match=message):
        sample_scenario(name, 0)


def test_bad_registrations_are_named(pillar, monkeypatch):
    monkeypatch.setattr("leapnav.envs.scenarios.families.MAX_DRAWS", 100)
    register_family("pillar", pillar)  # the same function again
    for name, sample, message in (
        ("rooms", pillar, "name: 'rooms' is a built-in family"),
        ("my-rooms", pillar, "name: expected letters, digits and underscores, got 'my-rooms'"),
        ("pillar", sample_scenario, "name: 'pillar' is the name of .*test_own_families"),
    ):
        with pytest.raises(ValueError, match=message):
            register_family(name, sample)
    with pytest.raises(TypeError, match="sample: expected a function of a random generator, got int"):
        register_family("number", 3)
    register_family("number", lambda rng: 3)
    with pytest.raises(TypeError, match="family: 'number': expected a ScenarioLayout or a Scenario, got int"):
        sample_scenario("number", 0)
    wall = [Obstacle(circle=Circle(center=(3.0, 1.5 * k), radius=0.9)) for k in range(5)]
    sides = {"start": (0.5, 0.5, 1.5, 5.5), "goal": (4.5, 0.5, 5.5, 5.5)}
    register_family("wall", lambda rng: ScenarioLayout(wall, arena=(0.0, 0.0, 6.0, 6.0), **sides))
    with pytest.raises(ValueError, match="family: 'wall': no layout connects start and goal in 100 draws"):
        sample_scenario("wall", 0)
    with pytest.raises(ValueError, match="split: the family 'pillar' has 'fresh' scenarios only, got 'test'"):
        NavigateEnv("pillar", split="test")
