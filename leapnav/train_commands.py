"""`leapnav train bc|dagger|ppo|sac`: a run's settings are the options."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from leapnav.training.config import ALGORITHMS, BCConfig, DAggerRunConfig, PPOConfig, RunConfig, SACConfig, read_config

if TYPE_CHECKING:
    from leapnav.training.evaluation import Evaluation

DOCUMENTATION = """Train a policy: clone the expert, aggregate a dataset, or learn by PPO or SAC from scratch or from
the optimum. The defaults shown are those tuned for --family (and for --warm-start); with --resume, the run's own."""


@dataclass(frozen=True)
class TrainCommand:
    """What `train_command` makes a type of."""

    config: RunConfig

    def run(self) -> int:
        """Trains, and says how good the policy is."""
        config = self.config
        for evaluation in self._train():
            print(_describe(evaluation))
        print(f"wrote {config.out} (leapnav evaluate {config.out} expert; leapnav report {config.out})")
        return 0

    def _train(self) -> Sequence[Evaluation]:
        """The last evaluation, of each family."""
        from leapnav.training import imitation, reinforcement

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
    """The command as a type whose defaults depend on the family, the warm start and the run that the words ask for.

    Raises:
        ValueError: there is no such family, nothing to start from, or the run to resume has a damaged configuration.

    """
    arguments = [word.replace("_", "-") if word.startswith("--") and "=" not in word else word for word in arguments]
    meant = arguments[:1] == ["train"]  # the other commands have families and folders of their own
    family = (_option(arguments, "--family") if meant else None) or RunConfig.family
    out = _option(arguments, "--out")
    if meant and "--warm-start" in arguments:
        following = arguments[arguments.index("--warm-start") + 1 :][:1]
        if not following or following[0].startswith("--"):
            raise ValueError("warm_start: expected demonstrations or a policy, got none")
    warm = any(word.partition("=")[0] == "--warm-start" for word in arguments)
    defaults: dict[str, Any] = {
        name: replace(kind.tuned(family, warm=warm), out=tyro.MISSING) for name, kind in ALGORITHMS.items()
    }
    if meant and "--resume" in arguments and out is not None:
        algorithm, config = read_config(Path(out))
        if algorithm in defaults:
            defaults[algorithm] = replace(config, out=tyro.MISSING)
    choices = tuple(
        Annotated[kind, tyro.conf.subcommand(name, default=defaults[name])] for name, kind in ALGORITHMS.items()
    )
    union = Annotated[Union[choices], tyro.conf.arg(name="")]  # noqa: UP007 (of a tuple)
    field = tyro.conf.OmitSubcommandPrefixes[union]
    command = make_dataclass("Train", [("config", field)], bases=(TrainCommand,), frozen=True)
    command.__doc__ = DOCUMENTATION
    return command


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of an option, however it is written."""
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if word == name:
            return following
        if word.startswith(f"{name}="):
            return word.removeprefix(f"{name}=")
    return None
