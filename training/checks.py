"""Whether the settings of a run are possible: told before anything is made."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

from leapnav.envs.families import check_family
from leapnav.envs.settings import Settings
from leapnav.training.cloning import check_cloning
from leapnav.training.config import CloningConfig, DAggerConfig, PPOConfig, RunConfig, WarmStartConfig
from leapnav.training.dagger import check_dagger
from leapnav.training.warmstart import check_warm_start

# Settings of runs by what they may be.
COUNTS = (
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
POSITIVE = ("learning_rate", "reward_scale", "clip_range", "std", "control_period")
SHARES = ("jump_start", "jump_start_until", "divergence_until", "gamma", "gae_lambda")
NOT_NEGATIVE = ("divergence", "imitation", "learning_starts", "penalty", "last_std", "quiet")


def check_config(config: RunConfig) -> None:
    """Checks all settings of a run.

    Raises:
        ValueError: one is impossible; the message names it and its value.

    """
    check_family(config.family)
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"hidden: expected widths of at least 1, got {config.hidden!r}")
    if not 0 <= config.seed < 2**32:
        raise ValueError(f"seed: expected a number from 0 to 2^32 - 1, got {config.seed!r}")
    if not (config.lidar_beams > 0 and config.lidar_beams % 2 == 0):
        raise ValueError(f"lidar_beams: expected an even number from 2 on, got {config.lidar_beams!r}")
    Settings(**config.environment)
    if isinstance(config, PPOConfig) and config.last_std > 0 and config.ent_coef > 0:
        raise ValueError(f"ent_coef: with last_std the noise is not learned; expected 0, got {config.ent_coef!r}")
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            _check_part(field.name, value)
        else:
            _check(field.name, value)


def _check(name: str, value: Any) -> None:
    if name in COUNTS and value < 1:
        raise ValueError(f"{name}: expected at least 1, got {value!r}")
    if name in POSITIVE and not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: expected a positive number, got {value!r}")
    if name in SHARES and not 0 <= value <= 1:
        raise ValueError(f"{name}: expected a number in [0, 1], got {value!r}")
    if name in NOT_NEGATIVE and not (math.isfinite(value) and value >= 0):
        raise ValueError(f"{name}: expected a number >= 0, got {value!r}")
    if name in ("demonstrations", "critic_first") and not 0 <= value < 1:
        raise ValueError(f"{name}: expected a number in [0, 1), got {value!r}")
    if name == "ent_coef":
        number = str(value).removeprefix("auto").removeprefix("_") or "1"
        try:
            found = float(number)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and found >= 0):
            raise ValueError(f"{name}: expected a number >= 0, or auto or auto_NUMBER for SAC, got {value!r}")


def _check_part(name: str, part: Any) -> None:
    if getattr(part, "seed", 0) != 0:
        raise ValueError(f"{name}.seed: a run has one seed for all; set that, got {part.seed!r}")
    try:
        if isinstance(part, CloningConfig):
            check_cloning(part)
        elif isinstance(part, DAggerConfig):
            check_dagger(part)
        elif isinstance(part, WarmStartConfig):
            check_warm_start(part)
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from None
