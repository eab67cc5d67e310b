"""Training runs with level samplers, callbacks and wrappers."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.unwrapping import unwrap
from leapnav.training.config import LevelsName, PPOConfig
from leapnav.training.environments.level_samplers import SCORES, UniformSampler
from leapnav.training.runs.reinforcement import make_training_env, train_ppo
from leapnav.training.scoring.comparison import _trains_on


def ppo(out, **changes):
    network = {"hidden": (16, 16), "lidar_beams": 16}
    settings = {"n_envs": 4, "n_steps": 64, "batch_size": 64, "n_epochs": 2, "total_timesteps": 1536, "seed": 3}
    intervals = {"evaluate_every": 512, "checkpoint_every": 512, "evaluation_scenarios": 4}
    return PPOConfig(out=out, **{"family": "open", **network, **settings, **intervals, **changes})


class LevelsOfEpisodes(BaseCallback):
    """Collects the levels that are played."""

    def _on_training_start(self):
        self.indices, self.sampler = set(), unwrap(self.training_env)[0].sampler

    def _on_step(self):
        self.indices |= set(unwrap(self.training_env)[0].indices)
        return True


def test_a_run_learns_from_the_levels_that_a_sampler_chooses(tmp_path):
    levels, names = LevelsOfEpisodes(), get_args(LevelsName)
    assert names == ("fresh", "uniform", *SCORES)
    train_ppo(ppo(tmp_path / "run", levels="positive_value_loss"), callback=levels, progress=False)
    bank = ScenarioBank.shipped("open", "train")
    assert levels.sampler.score == "positive_value_loss" and len(levels.sampler.scores) == len(bank)
    assert (~np.isnan(levels.sampler.scores)).sum() >= 4 and levels.indices <= set(range(len(bank)))
    robots = unwrap(make_training_env(ppo(tmp_path, levels="uniform", level_bank=bank.path)))[0]
    assert robots.bank.path == bank.path and type(robots.sampler) is UniformSampler


class CountingSteps(VecEnvWrapper):
    """Counts the steps of the robots."""

    steps = 0

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        self.steps += self.num_envs
        return self.venv.step_wait()


def test_a_wrapper_of_the_training_environment_is_part_of_the_run(tmp_path):
    made = []

    def wrapper(venv):
        made.append(CountingSteps(venv))
        return made[-1]

    config = ppo(tmp_path / "run")
    train_ppo(config, wrapper=wrapper, progress=False)
    assert [counter.steps for counter in made] == [config.total_timesteps]
    with pytest.raises(TypeError, match="wrapper: expected a function that returns a VecEnv, got NoneType"):
        train_ppo(ppo(tmp_path / "other"), wrapper=lambda venv: None, progress=False)
    assert not (tmp_path / "other").exists()


def test_a_bank_of_levels_has_the_robot_and_the_horizon_of_the_run(tmp_path):
    for arguments, message in (
        ({"horizon": "free"}, "level_bank: horizon: expected 'fixed', got 'free'"),
        ({"family": "clutter", "robot": "car"}, "level_bank: expected a robot with model 'unicycle', got 'car'"),
    ):
        bank = ScenarioBank.shipped(**{"family": "open", "split": "train", **arguments})
        with pytest.raises(ValueError, match=message):
            train_ppo(ppo(tmp_path / "run", levels="uniform", level_bank=bank.path), progress=False)
    assert not (tmp_path / "run").exists()


def test_banks_that_were_used_for_training_are_named(tmp_path):
    train, test = (ScenarioBank.shipped("open", split) for split in ("train", "test"))
    levels = PPOConfig(out=tmp_path, family="open", levels="uniform")
    assert _trains_on(levels, train) and not _trains_on(levels, test)
    assert not _trains_on(PPOConfig(out=tmp_path, family="open"), train)
    assert _trains_on(replace(levels, level_bank=test.path), test)
