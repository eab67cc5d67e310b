"""`leapnav train bc|dagger|ppo|sac`: training runs, whose settings are the options of the command."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from leapnav.training.config import ALGORITHMS, BCConfig, DAggerRunConfig, PPOConfig, RunConfig, SACConfig, read_config

if TYPE_CHECKING:
    from leapnav.training.scoring.results import Evaluation

OWN_PROFILES = ("lidar", "motor")  # observation and actuation that have their own profile
NOT_GIVEN = (Path("."),)


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy: behaviour cloning of the expert, DAgger, or PPO or SAC, from scratch or from a warm start.

    The defaults shown are tuned for a run from scratch, or from --warm-start; with --resume, they are those of the run.
    """

    config: RunConfig

    def run(self) -> int:
        """Train a policy and print its scores."""
        from leapnav.envs.scenarios.families import BANK_ENDING

        evaluations = self._train()
        for evaluation in evaluations:
            print(_describe(evaluation))
        if self.config.family.endswith(BANK_ENDING):
            print(f"{self.config.family}: scenarios of the training; those of another bank are a test")
        print(f"observed: {evaluations[0].settings.sensors}")
        print(f"wrote {self.config.out} (next: leapnav evaluate {self.config.out} expert --html report.html)")
        return 0

    @property
    def resumption(self) -> str:
        """What to do after an interruption."""
        algorithm = next(name for name, kind in ALGORITHMS.items() if isinstance(self.config, kind))
        return f"leapnav train {algorithm} --out {self.config.out} --resume continues from the last checkpoint"

    def _train(self) -> Sequence[Evaluation]:
        """Train, and return the final evaluation of each family."""
        from leapnav.training.runs import imitation, reinforcement

        config, workers = self.config, os.cpu_count() or 1
        if isinstance(config, BCConfig):
            return imitation.train_bc(config, workers=workers)
        if isinstance(config, DAggerRunConfig):
            return imitation.train_dagger(config, workers=workers)
        if isinstance(config, PPOConfig):
            return reinforcement.train_ppo(config)
        assert isinstance(config, SACConfig)
        return reinforcement.train_sac(config)


def _describe(evaluation: Evaluation) -> str:
    regret = "-" if math.isnan(evaluation.regret) else f"{100 * evaluation.regret:.2f} %"  # without any success
    return (
        f"{evaluation.episodes[0].family}: success {100 * evaluation.success:.1f} %, "
        f"collision {100 * evaluation.collision:.1f} %, SOC {evaluation.soc:.3f}, "
        f"median regret {regret}"
    )


def train_command(defaults: Mapping[str, RunConfig], *, needs_out: bool = True) -> type[TrainCommand]:
    """Return the class of the command with default configurations of the algorithms; `out` may have no default."""
    if needs_out:
        defaults = {name: replace(config, out=tyro.MISSING) for name, config in defaults.items()}
    choices = tuple(
        Annotated[kind, tyro.conf.subcommand(name, default=defaults[name])] for name, kind in ALGORITHMS.items()
    )
    union = Annotated[Union[choices], tyro.conf.arg(name="")]  # noqa: UP007 (the members are in a tuple)
    field = tyro.conf.OmitSubcommandPrefixes[union]
    command = make_dataclass("Train", [("config", field)], bases=(TrainCommand,), frozen=True)
    command.__doc__ = TrainCommand.__doc__
    return command


def default_configurations() -> dict[str, RunConfig]:
    """Return the default configurations, those of runs from scratch."""
    return {name: kind.tuned(RunConfig.family) for name, kind in ALGORITHMS.items()}


def probes() -> dict[str, RunConfig]:
    """Return default configurations with which a command line is parsed first, to find the settings that it contains.

    With these defaults, the observation is lidar, and the warm start not `NOT_GIVEN`, only if the command line says so.
    """
    found: dict[str, Any] = default_configurations()
    for name, config in found.items():
        warm_start = {"warm_start": NOT_GIVEN} if hasattr(config, "warm_start") else {}
        found[name] = replace(config, observation="geodesic", **warm_start)
    return found


def tuned_configurations(given: RunConfig) -> dict[str, RunConfig]:
    """Return the default configurations for a command line: those of the run to resume, or those of its profile.

    Args:
        given: the command line, parsed with `probes` as defaults.

    Raises:
        FileNotFoundError: there is no run to resume.
        ValueError: the family is unknown, the warm start is empty, or the configuration of the run to resume is
            damaged.

    """
    defaults = default_configurations()
    if given.resume and given.out != Path():  # otherwise `out` is missing
        algorithm, config = read_config(given.out)
        return {**defaults, algorithm: config}
    warm_start: tuple[Path, ...] = getattr(given, "warm_start", NOT_GIVEN)
    if not warm_start:
        raise ValueError("warm_start: expected demonstrations or a policy, got none")
    is_warm = warm_start != NOT_GIVEN
    start = [*(warm_start if is_warm else ()), *filter(None, [getattr(given, "policy", None)])]
    names = ("observation", "actuation")
    changes = {name: value for name in names if (value := getattr(given, name, None)) in OWN_PROFILES}
    algorithm = next(name for name, kind in ALGORITHMS.items() if isinstance(given, kind))
    return {**defaults, algorithm: type(given).tuned(given.family, warm=is_warm, start=start, **changes)}
