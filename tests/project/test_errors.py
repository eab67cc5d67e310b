"""Error messages of invalid input, from tables of an input and, below it, its message. No file is written.

`data/errors_on_the_command_line.txt` contains arguments of `leapnav`; `data/errors_in_python.txt` contains expressions,
whose names are the public ones and those of the fixture `names`. `data/plausible_mistakes.txt` and `USAGE` contain 40
mistakes of new users, of both kinds. A message that states what is expected must name the field and the value of the
table; its other words may differ.
"""

import json
import math
import re
import shutil
from dataclasses import replace

import gymnasium as gym
import h5py
import numpy as np
import pytest
import sympy as sp
from helpers import DATA, SMALL, scenario_fields
from stable_baselines3 import PPO, SAC

import leapnav.envs
import leapnav.experts
import leapnav.training
from leapnav.cli import main
from leapnav.envs import NavigateEnv, NavigateVectorEnv, Scenario, ScenarioBank
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts import (
    ControlAffineSystem,
    ExpertPolicy,
    OptimalControlProblem,
    find_optimum,
    rollout,
    solve,
    unicycle,
)
from leapnav.training import Dataset, evaluate, make_policy, make_vec_env

BANK = ScenarioBank.shipped("open", "test")
FILES = {
    "good.json": scenario_fields(),
    "empty.json": "",
    "list.json": [1],
    "text.json": "{name: 1}",
    "horizon.json": scenario_fields(horizon=-1),
    "nan.json": scenario_fields(horizon=float("nan")),
    "unknown.json": scenario_fields(speed=3),
    "inside.json": scenario_fields(goal=[4, 4.5, 0]),
    "wall.json": scenario_fields(start=[0.1, 5, 0]),
    "star.json": scenario_fields(obstacles=[{"polygon": {"vertices": [[0, 0], [1, 1], [1, 0], [0, 1]]}}]),
    "two.json": scenario_fields(obstacles=[{"polygon": {"vertices": [[3, 3], [4, 3]]}}]),
    "both.json": scenario_fields(obstacles=[{}]),
    "arena.json": scenario_fields(arena=[5, 0, 0, 5]),
    "twice.json": '{"name": "a", "name": "b"}',
    "missing.json": {"name": "m"},
    "radius.json": scenario_fields(robot={"radius": "big"}),
    "model.json": scenario_fields(robot={"model": "tank"}),
    "text.bank": "no bank",
    "good.map": "type octile\nheight 2\nwidth 3\nmap\n...\n.@.\n",
    "head.map": "height 2\n",
    "size.map": "type octile\nheight two\nwidth 3\nmap\n...\n...\n",
    "short.map": "type octile\nheight 2\nwidth 3\nmap\n...\n",
    "cell.map": "type octile\nheight 1\nwidth 3\nmap\n.x.\n",
    "utf8.map": "type octile\nheight 1\nwidth 3\nmap\n.é.\n",
    "data/x": "",
    "degrees.json": scenario_fields(goal=[8, 8, 90]),
    "typo.json": {**scenario_fields(horizon=-1, obstacels=[]), "cost": {"speed_wieght": 1.0}},
    "text.zip": "no model",
}


def parts_of(message):
    """Return the field that a message names and the value that it states, but not the words between; else all words."""
    field, expected, rest = message.partition(": expected ")
    return (field, rest.rpartition(", got ")[2]) if expected and ", got " in rest else (message, None)


def rows(name):
    """Pairs of an input and its message."""
    lines = (DATA / name).read_text().splitlines()
    return [pytest.param(text, message.strip(), id=text) for text, message in zip(lines[::2], lines[1::2], strict=True)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A directory with valid and invalid files; no test may add or remove any."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "data").mkdir()
    for name, content in FILES.items():
        text = content if isinstance(content, str) else json.dumps(content)
        (tmp_path / name).write_text(text, encoding="utf-8")
    with h5py.File(tmp_path / "hdf5.bank", "w") as file:
        file["x"] = 1
    for name in ("newer.bank", "cut.bank"):
        shutil.copy(BANK.path, tmp_path / name)
    with h5py.File(tmp_path / "newer.bank", "a") as file:
        file.attrs["version"] = 99
    with h5py.File(tmp_path / "cut.bank", "a") as file:
        del file["costs"]
    before = sorted(tmp_path.rglob("*"))
    yield tmp_path
    assert sorted(tmp_path.rglob("*")) == before


MISTAKES = rows("plausible_mistakes.txt")
COMMANDS = [row for row in MISTAKES if row.id.startswith("leapnav ")]
EXPRESSIONS = [row for row in MISTAKES if row not in COMMANDS]


USAGE = {  # errors in the words themselves, and what the message of tyro contains
    "evalute expert": ["evalute", "evaluate"],
    "evaluate expert --famly open": ["--famly", "Perhaps you meant", "--family"],
    "evaluate expert --count ten": ["--count", "'ten'"],
    "evaluate expert --split exam": ["'exam'", "--split", "'test', 'train'"],
    "train bcc --out run": ["bcc", "bc, dagger, ppo, sac"],
    "train bc": ["--out", "Run directory"],
    "train bc --resume": ["--out", "Run directory"],
    "train bc --cloning.epoch 3 --out run": ["--cloning.epoch,", "Perhaps you meant", "--cloning.epochs"],
    "solve": ["PATH", "Scenario file (JSON)"],
    "solve good.json --method newton": ["'newton'", "--method", "'multiple_shooting'"],
    "bank bild --out x.bank": ["bild", "build, show, verify, card, prove"],
    "export clutter": ["--onnx", "Output file (.onnx)"],
}


@pytest.mark.parametrize("words", USAGE)
def test_usage_errors_name_the_word(words, folder, capsys):
    with pytest.raises(SystemExit) as end:
        main(words.split())
    printed = capsys.readouterr()
    text = " ".join(re.sub(r"[╭╮╰╯│─]", " ", printed.err).split())
    assert end.value.code == 2 and printed.out == ""
    for word in USAGE[words]:
        assert word in text


def test_there_are_forty_plausible_mistakes():
    assert len(MISTAKES) + len(USAGE) >= 40 and len(COMMANDS) + len(USAGE) >= 20 and len(EXPRESSIONS) >= 12


@pytest.mark.parametrize(("words", "line"), rows("errors_on_the_command_line.txt") + COMMANDS)
def test_the_line_that_is_printed(words, line, folder, capsys):
    assert main(words.removeprefix("leapnav ").split()) == 2
    lines = [text for text in capsys.readouterr().err.splitlines() if not text.startswith("leapnav: compiling")]
    assert len(lines) == 1
    assert parts_of(lines[0].removeprefix("leapnav: ")) == parts_of(line.replace("{folder}", str(folder)))


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """The names in the expressions."""
    public = {
        name: getattr(package, name)
        for package in (leapnav.envs, leapnav.experts, leapnav.training)
        for name in package.__all__
    }
    deep: list = []
    for _ in range(2000):
        deep = [deep]
    env, vector = NavigateEnv("open", split="test"), NavigateVectorEnv(2, "open", split="test")
    env.reset(seed=0)
    vector.reset(seed=0)
    x, y, z = sp.symbols("x y z")
    problem = OptimalControlProblem(unicycle(), (0, 0, 0), (1, 0.5, 1), 1.0, (1, 1))
    enclosed = Scenario.from_dict(
        scenario_fields(obstacles=[{"polygon": {"vertices": [[4, 0], [5, 0], [5, 10], [4, 10]]}}])
    )
    shut = NavigateEnv(scenario=enclosed)
    shut.reset()
    demonstrations = tmp_path_factory.mktemp("demonstrations") / "open"
    rollout("open", 2, demonstrations, progress=False)
    data = Dataset.of(demonstrations)
    robots = make_vec_env(n_envs=2, seed=0, family="open", split="fresh")
    return {
        **public,
        "EnvironmentSettings": EnvironmentSettings,
        "replace": replace,
        "rollout": rollout,
        "nan": math.nan,
        "FIELDS": Scenario.from_dict(scenario_fields()).model_dump(),
        "DEEP": deep,
        "BANK": BANK,
        "ENV": env,
        "VECTOR": vector,
        "POSE": np.zeros((3, 4)),
        "X": x,
        "Y": y,
        "Z": z,
        "UNICYCLE": unicycle(),
        "PROBLEM": problem,
        "BOUNDED": replace(problem, control_bounds=((-9, 9), (-9, 9))),
        "FREE": replace(problem, goal=(1, 0.5, None)),
        "OTHER_SYSTEM": OptimalControlProblem(ControlAffineSystem([x], [0], [[1]]), (0,), (1,), 1.0, (1,)),
        "EXTREMAL": solve(problem),
        "PATHLESS": find_optimum(enclosed),
        "SHUT_ENV": shut,
        "CARTPOLE": gym.make("CartPole-v1"),
        "POLICY": make_policy(env.observation_space, env.action_space, hidden=SMALL),
        "PPO_MODEL": PPO("MlpPolicy", robots, device="cpu"),
        "SAC_MODEL": SAC("MlpPolicy", robots, buffer_size=1, device="cpu"),
        "DATA": data,
        "OTHER_DATA": data.observed(replace(data.settings, lidar_beams=8)),
        "PLAIN_DATA": replace(data, costates=math.nan * data.costates, returns=math.nan * data.returns),
        "VENV": robots,
        "EXPERT": ExpertPolicy(robots),
        "EXPERT_ONE": ExpertPolicy(env),
        "FEW_EPISODES": evaluate(ExpertPolicy, BANK, count=1, progress=False),
        "MORE_EPISODES": evaluate(ExpertPolicy, BANK, count=2, progress=False),
    }


@pytest.mark.parametrize(("expression", "line"), rows("errors_in_python.txt") + EXPRESSIONS)
def test_the_exception_that_is_raised(expression, line, folder, names):
    with pytest.raises(Exception) as raised:  # noqa: PT011 (type and message are checked below)
        eval(expression, dict(names))
    kind, _, message = line.replace("{folder}", str(folder)).partition(": ")
    assert raised.type.__name__ == kind
    assert parts_of(str(raised.value)) == parts_of(message)
