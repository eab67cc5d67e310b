"""`leapnav train bc|dagger|ppo|sac`: training runs, whose settings are the options of the command."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from leapnav.durations import announce, of_training
from leapnav.training.config import ALGORITHMS, BCConfig, DAggerRunConfig, PPOConfig, RunConfig, SACConfig, read_config

if TYPE_CHECKING:
    from leapnav.training.scoring.results import Evaluation

HELP = """Train a policy: behaviour cloning of the expert, DAgger, or PPO or SAC, from scratch or from a warm start. The
defaults shown are those tuned for --family (and for --warm-start); with --resume, those of the run."""


@dataclass(frozen=True)
class TrainCommand:
    """Base class of the command; `train_command` adds the type of the configuration."""

    config: RunConfig

    def run(self) -> int:
        """Train a policy and print its scores."""
        config, workers = self.config, os.cpu_count() or 1
        if not config.resume:
            announce(of_training(config, workers), "this run")
        for evaluation in self._train():
            print(_describe(evaluation))
        print(f"wrote {config.out} (next: leapnav evaluate {config.out} expert; leapnav report {config.out})")
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
    return (
        f"{evaluation.episodes[0].family}: success {100 * evaluation.success:.1f} %, "
        f"collision {100 * evaluation.collision:.1f} %, SOC {evaluation.soc:.3f}, "
        f"median regret {100 * evaluation.regret:.2f} %"
    )


def train_command(arguments: Sequence[str]) -> type[TrainCommand]:
    """Return the class of the command for a command line.

    Its defaults depend on the family, the horizon, the warm start and the run to resume in the arguments, so these are
    read before the command line is parsed.

    Args:
        arguments: the words after `leapnav`.

    Raises:
        FileNotFoundError: there is no run to resume.
        ValueError: the family is unknown, the warm start has no value, or the configuration of the run to resume is
            damaged.

    """
    arguments = [word.replace("_", "-") if word.startswith("--") and "=" not in word else word for word in arguments]
    is_train = arguments[:1] == ["train"]  # other commands have options of the same names
    family = (_option(arguments, "--family") if is_train else None) or RunConfig.family
    out = _option(arguments, "--out")
    if is_train and "--warm-start" in arguments:
        following = arguments[arguments.index("--warm-start") + 1 :][:1]
        if not following or following[0].startswith("--"):
            raise ValueError("warm_start: expected demonstrations or a policy, got none")
    warm = any(word.partition("=")[0] == "--warm-start" for word in arguments)
    start = (
        [Path(word) for name in ("--warm-start", "--policy") for word in _values(arguments, name)] if is_train else []
    )
    given = {name: _option(arguments, f"--{name}") for name in ("horizon", "observation")} if is_train else {}
    changes = {name: value for name, value in given.items() if value in ("free", "lidar")}  # those with other defaults
    defaults: dict[str, Any] = {
        name: replace(kind.tuned(family, warm=warm, start=start, **changes), out=tyro.MISSING)
        for name, kind in ALGORITHMS.items()
    }
    if is_train and "--resume" in arguments and out is not None:
        algorithm, config = read_config(Path(out))
        if algorithm in defaults:
            defaults[algorithm] = replace(config, out=tyro.MISSING)
    choices = tuple(
        Annotated[kind, tyro.conf.subcommand(name, default=defaults[name])] for name, kind in ALGORITHMS.items()
    )
    union = Annotated[Union[choices], tyro.conf.arg(name="")]  # noqa: UP007 (the members are in a tuple)
    field = tyro.conf.OmitSubcommandPrefixes[union]
    command = make_dataclass("Train", [("config", field)], bases=(TrainCommand,), frozen=True)
    command.__doc__ = HELP
    return command


def _values(arguments: Sequence[str], name: str) -> list[str]:
    """The values of an option, up to the next option."""
    if name not in arguments:
        return [word.removeprefix(f"{name}=") for word in arguments if word.startswith(f"{name}=")]
    following = arguments[arguments.index(name) + 1 :]
    return list(takewhile(lambda word: not word.startswith("--"), following))


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of an option, written as `--name value` or `--name=value`."""
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if word == name:
            return following
        if word.startswith(f"{name}="):
            return word.removeprefix(f"{name}=")
    return None
