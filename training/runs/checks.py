"""Validation of a run's settings, before the run creates any file."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import check_family, families_of, is_built_in, task_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.validation import (
    check_choice,
    check_fraction,
    check_integer,
    check_not_negative,
    check_positive,
)
from leapnav.training.config import LevelsName, PPOConfig, RunConfig, SACConfig
from leapnav.training.fit_settings import CloningConfig, DAggerConfig, WarmStartConfig
from leapnav.training.learning.cloning import check_cloning
from leapnav.training.learning.dagger import check_dagger
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.warm_start import check_warm_start
from leapnav.training.policies.files import read_description
from leapnav.training.policies.zips import is_zip


def check_config(config: RunConfig) -> None:
    """Check all settings of a run.

    Raises:
        ValueError: a setting is invalid; the message contains its name and value.

    """
    check_family(config.family)
    task_of(config.family, config.robot)
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"hidden: expected widths of at least 1, got {config.hidden!r}")
    check_integer("seed", config.seed, 0, 2**32 - 1)
    beams = config.environment["lidar_beams"]
    if not (beams > 0 and (beams % 2 == 0 or config.lidar_fov < math.tau)):  # for the time reversal
        raise ValueError(f"lidar_beams: expected an even number >= 2, got {beams!r}")
    EnvironmentSettings(**config.environment)
    if isinstance(config, SACConfig) and config.algorithm == "tqc" and config.effort_weights is not None:
        raise ValueError(f"previous_action: expected False for algorithm='tqc', got {config.previous_action!r}")
    if isinstance(config, PPOConfig) and config.last_std > 0 and config.ent_coef > 0:
        raise ValueError(
            f"ent_coef: expected 0, because last_std > 0 fixes the noise and its entropy, got {config.ent_coef!r}"
        )
    if isinstance(config, PPOConfig):
        _check_levels(config)
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            _check_nested(field.name, value)
        elif field.name in _CHECKS and value is not None:  # None: determined by other settings
            _CHECKS[field.name](field.name, value)


def check_demonstrations(config: RunConfig, dataset: Dataset) -> None:
    """Check that demonstrations are for the robot and the horizon of a run.

    Raises:
        ValueError: they are not.

    """
    body, horizon, _ = task_of(config.family, config.robot, config.horizon, config.obstacles)
    # One scenario of each robot and kind of horizon; validating all takes long.
    scenarios = [Scenario.from_json(text) for text in {_kind(text): text for text in dataset.scenarios}.values()]
    for scenario in scenarios:
        check_robots("demos", body, scenario.robot)
        if scenario.horizon_kind != horizon:
            raise ValueError(f"demos: expected a {horizon} horizon, got a {scenario.horizon_kind} one")


def check_robots(name: str, expected: RobotModel, found: RobotModel) -> None:
    """Check that scenarios have the robot of a run.

    Raises:
        ValueError: they have another one; the message contains the first parameter that differs.

    """
    fields = expected.model_dump(mode="json")
    for field, value in found.model_dump(mode="json").items():
        if value != fields.get(field):
            raise ValueError(f"{name}: expected a robot with {field} {fields.get(field)!r}, got {value!r}")


def warn_of_family(name: str, path: Path, config: RunConfig) -> None:
    """Warn if the policy with which a run starts was trained in another family."""
    family = None if is_zip(path) else read_description(path)["training"].get("family")
    if family is not None and is_built_in(family) and family not in families_of(config.family):
        warnings.warn(f"{name}: {path} was trained in {family}; the run is in {config.family}", stacklevel=4)


def _kind(text: str) -> tuple[str, bool]:
    """Return the robot of a scenario in JSON, and whether its horizon is free, without a validation."""
    fields = json.loads(text)
    return str(fields.get("robot")), fields.get("horizon") is None


def _check_levels(config: PPOConfig) -> None:
    """Check that the choice of the levels is possible with the other settings."""
    check_choice("levels", config.levels, get_args(LevelsName))
    if config.levels == "fresh":
        if config.level_bank is not None:
            raise ValueError(f"level_bank: expected none with levels='fresh', got {str(config.level_bank)!r}")
        return
    included = ScenarioBank.shipped_families(**config.task, split="train")
    if config.level_bank is None and config.family not in included:
        raise ValueError(f"level_bank: expected a bank for levels={config.levels!r} of {config.family!r}, got none")


def _check_entropy_coefficient(name: str, value: Any) -> None:
    """Check a number, or for SAC "auto" or "auto_NUMBER"."""
    text = str(value).removeprefix("auto").removeprefix("_") or "1"
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"{name}: expected a number >= 0, or auto or auto_NUMBER for SAC, got {value!r}")


def _check_nested(name: str, config: Any) -> None:
    """Check a configuration that is a setting of the run."""
    if getattr(config, "seed", 0) != 0:
        raise ValueError(f"{name}.seed: expected 0, got {config.seed!r}; set the seed of the run instead")
    try:
        if isinstance(config, CloningConfig):
            check_cloning(config)
        elif isinstance(config, DAggerConfig):
            check_dagger(config)
        elif isinstance(config, WarmStartConfig):
            check_warm_start(config)
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from None


_COUNTS = (
    "components",
    "scenarios",
    "n_envs",
    "total_timesteps",
    "evaluate_every",
    "checkpoint_every",
    "evaluation_scenarios",
    "n_steps",
    "batch_size",
    "n_epochs",
    "gradient_steps",
    "buffer_size",
)
# The check of each setting, called with the setting's name and value.
_CHECKS: dict[str, Callable[[str, Any], object]] = {
    **dict.fromkeys(_COUNTS, partial(check_integer, minimum=1)),
    **dict.fromkeys(("learning_starts",), partial(check_integer, minimum=0)),
    **dict.fromkeys(("learning_rate", "reward_scale", "clip_range", "std", "control_period"), check_positive),
    **dict.fromkeys(("imitation", "penalty", "last_std", "quiet", "disturbance"), check_not_negative),
    **dict.fromkeys(("gamma", "gae_lambda"), check_fraction),
    **dict.fromkeys(("demonstrations", "critic_first"), partial(check_fraction, one=False)),
    "ent_coef": _check_entropy_coefficient,
}
