"""Every script of a study, with a tiny budget."""

import importlib.util
import sys
from dataclasses import fields, replace
from functools import partial

import pytest
from helpers import ROOT

from leapnav.training import CloningConfig, DAggerConfig, WarmStartConfig
from leapnav.training.config import RunConfig
from leapnav.training.runs import run
from leapnav.training.scoring import comparison

SMALL = {
    "n_envs": 2,
    "n_steps": 32,
    "batch_size": 32,
    "total_timesteps": 128,
    "learning_starts": 8,
    "gradient_steps": 1,
    "scenarios": 4,
    "evaluation_scenarios": 2,
    "cloning": CloningConfig(epochs=1, batch_size=64),
    "dagger": DAggerConfig(rounds=1, max_episodes=4, max_failures=2, lead=0.5, epochs=1, last_epochs=1),
    "start": WarmStartConfig(critic_epochs=1, slopes=50),
}


@pytest.fixture
def script(monkeypatch, tmp_path):
    """A function that runs a script with arguments and with other values of its constants."""
    tuned = RunConfig.tuned.__func__

    def small(cls, *arguments, **settings):
        config = tuned(cls, *arguments, **settings)
        names = {field.name for field in fields(config)}
        return replace(config, **{name: value for name, value in SMALL.items() if name in names})

    monkeypatch.setattr(RunConfig, "tuned", classmethod(small))
    for module in (run, comparison):
        evaluate = partial(limited, module.evaluate)
        monkeypatch.setattr(module, "evaluate", evaluate)
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    monkeypatch.chdir(tmp_path)

    def start(name, *words, **constants):
        specification = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
        module = importlib.util.module_from_spec(specification)
        monkeypatch.setitem(sys.modules, name, module)  # for the processes that receive its functions
        specification.loader.exec_module(module)
        for constant, value in constants.items():
            assert hasattr(module, constant)
            monkeypatch.setattr(module, constant, value)
        if hasattr(module, "evaluate"):
            monkeypatch.setattr(module, "evaluate", partial(limited, module.evaluate))
        monkeypatch.setattr(sys, "argv", [name, *words])
        module.main()

    return start


def limited(evaluate, *arguments, count=None, **options):
    """Evaluate a policy on two scenarios."""
    return evaluate(*arguments, count=2, **{**options, "timed": False, "progress": False})


def rows(printed):
    """The rows of tables in a printed text."""
    return [line for line in printed.splitlines() if line.startswith("| ") and not line.startswith("|--")]


@pytest.mark.slow
def test_the_ablation_of_the_warm_start(script, capsys):
    script("ablate_warm_start", "--only", "gradient", "--workers", "1", DEMONSTRATIONS=4, PPO_STEPS=200, SAC_STEPS=200)
    assert [row.split("|")[1].strip()[:4] for row in rows(capsys.readouterr().out)[1:]] == ["PPO:", *["SAC:"] * 3]


def test_the_study_of_curricula(script, capsys, tmp_path):
    words = "--only", "uniform", "exact_regret", "--seeds", "0", "--figure", str(tmp_path / "curricula.svg")
    script("curriculum_study", *words, FAMILY="open", N_LEVELS=10, N_ROBOTS=10, STEPS=128)
    assert rows(capsys.readouterr().out)
    assert (tmp_path / "curricula.svg").stat().st_size > 1000


def test_the_study_of_the_imitation_gap(script, capsys):
    script("imitation_gap", "--workers", "1", FAMILY="open", DEMONSTRATIONS=4, SCENARIOS=2, MAX_EPOCHS=1)
    assert [row.split("|")[1].strip() for row in rows(capsys.readouterr().out)] == [
        "lidar",
        "mixture",
        "map",
        "geodesic",
    ]


def test_the_study_of_reinforcement(script, capsys):
    words = "--only", "grazes", "--seeds", "0", "--workers", "1"
    script("reinforcement_study", *words, SCENARIOS=2, N_DRIVEN=16, N_ROBOTS=16)
    assert capsys.readouterr().out.count("  gain ") == 1
