"""What the studies of learning share: the command line, the training of stored settings, and fresh scenarios."""

import argparse
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from stable_baselines3.common.policies import BasePolicy

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.bank import collection_name
from leapnav.experts import build_bank, rollout
from leapnav.training import (
    CloningConfig,
    DAggerConfig,
    Evaluation,
    WarmStartConfig,
    evaluate,
    load_policy,
    policy_environment,
    read_episodes,
    score,
    train_bc,
    train_dagger,
    train_ppo,
    train_sac,
    write_episodes,
)
from leapnav.training.config import read_config
from leapnav.training.scoring.reports import markdown_cells, markdown_run_cells

RUNS = Path("runs/studies")  # directory of the runs, the demonstrations and the fresh scenarios
FRESH_SEED = 784  # of the fresh scenarios
TRAIN: dict[str, Callable[..., Any]] = {"bc": train_bc, "dagger": train_dagger, "ppo": train_ppo, "sac": train_sac}
# Changes of the settings with a tiny budget, of those that have them.
TINY: dict[str, Any] = {
    "hidden": (16, 16),
    "n_envs": 2,
    "n_steps": 32,
    "batch_size": 32,
    "total_timesteps": 128,
    "scenarios": 4,
    "evaluation_scenarios": 2,
    "cloning": CloningConfig(epochs=1, batch_size=64),
    "dagger": DAggerConfig(rounds=1, max_episodes=4, max_failures=2, lead=0.5, epochs=1, last_epochs=1),
    "start": WarmStartConfig(critic_epochs=1, slopes=50),
}


def read_arguments(description: str, names: Sequence[str], folder: Path, **switches: str) -> argparse.Namespace:
    """Read the command line of a study.

    Args:
        description: docstring of the study.
        names: the parts that can be named.
        folder: directory of the study, with the results.
        switches: help of further switches.

    Returns:
        `names`, `runs`, `results`, `tiny` and the switches.

    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"parts ({', '.join(names)}); by default all")
    parser.add_argument("--runs", type=Path, help=f"directory of the runs; by default {RUNS}, with --tiny in --out")
    parser.add_argument("--out", type=Path, help="directory of the results; by default beside this file")
    parser.add_argument("--tiny", action="store_true", help="use a tiny budget, to try the script; needs --out")
    for name, text in switches.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in names]
    if unknown:
        parser.error(f"NAME: expected one of {', '.join(names)}, got {unknown[0]!r}")
    if arguments.tiny and arguments.out is None:
        parser.error("--tiny: needs --out, so that the results in the repository are kept")
    arguments.names = arguments.names or list(names)
    arguments.results = arguments.out or folder / "results"
    arguments.runs = arguments.runs or (arguments.out / "runs" if arguments.tiny else RUNS)
    arguments.results.mkdir(parents=True, exist_ok=True)
    return arguments


def workers() -> int:
    """Return the number of processes."""
    return os.cpu_count() or 1


def train(
    settings: Path, run: Path, *, tiny: bool, options: Mapping[str, Any] = MappingProxyType({}), **changes: Any
) -> Path:
    """Train with stored settings, or resume the run, and return its directory. A finished run is not repeated.

    Args:
        settings: file of the settings.
        run: directory of the run.
        tiny: whether to use a tiny budget.
        options: further arguments of the training function.
        changes: changes of the settings.

    """
    if not is_finished(run):
        algorithm, config = read_config(settings)
        names = {field.name for field in fields(config)}
        budget = {name: value for name, value in TINY.items() if name in names} if tiny else {}
        config = replace(config, **{**budget, **changes}, out=run, resume=(run / "config.json").exists())
        parallel = {"workers": workers()} if algorithm == "dagger" else {}
        TRAIN[algorithm](config, progress=not tiny, **parallel, **options)
    return run


def is_finished(run: Path) -> bool:
    """Return whether the final evaluation of a run exists."""
    evaluations = run / "evaluations.jsonl"
    lines = evaluations.read_text(encoding="utf-8").splitlines() if evaluations.exists() else []
    return bool(lines) and json.loads(lines[-1])["final"]


def demonstrate(family: str, count: int, folder: Path, *, seed: int, tiny: bool, horizon: str = "fixed") -> Path:
    """Record demonstrations of the expert, unless they are complete, and return their directory."""
    rollout(family, count, folder, horizon=horizon, seed=seed, workers=workers(), progress=not tiny)
    return folder


def fresh_bank(runs: Path, family: str, count: int, *, tiny: bool, **task: str) -> ScenarioBank:
    """Return the bank of fresh scenarios of a family, built at the first call.

    Args:
        runs: directory of the runs.
        family: the family.
        count: number of scenarios.
        tiny: whether to show no progress.
        task: robot, horizon and obstacles; by default those of `build_bank`.

    """
    path = runs / "fresh" / f"{collection_name(family, **task)}-{count}.bank"
    path.parent.mkdir(parents=True, exist_ok=True)
    return build_bank(family, count, path, **task, seed=FRESH_SEED, workers=workers(), progress=not tiny)


def load(run: Path) -> tuple[BasePolicy, dict[str, Any]]:
    """Return the policy of a run, or an included one, and the arguments of its environment."""
    return load_policy(run), policy_environment(run)


def play(
    policies: Iterable[tuple[BasePolicy, dict[str, Any]]],
    banks: Sequence[ScenarioBank],
    results: Path,
    name: str,
    **options: Any,
) -> None:
    """Evaluate policies, and write the episodes.

    Args:
        policies: policies of several runs, with the arguments of their environments.
        banks: the scenarios, of several families if there are several banks.
        results: directory of the results.
        name: name of the policies in the results, and of the file.
        options: further arguments of `evaluate`.

    """
    found = []
    for policy, environment in policies:
        arguments = {"environment": environment, "timed": False, "workers": workers(), **options}
        parts = [evaluate(policy, bank, **arguments).episodes for bank in banks]
        found.append(Evaluation(tuple(episode for part in parts for episode in part), float("nan")))
    write_episodes({name: found}, results / f"{name}.jsonl.gz")


def score_clones(
    arguments: argparse.Namespace, folder: Path, family: str, *, demonstrations: int, seed: int, runs: int
) -> None:
    """Train clones of the same demonstrations with each of the named settings, and score them on the test split.

    Args:
        arguments: the command line of the study.
        folder: directory of the study, with the settings.
        family: the family.
        demonstrations: number of demonstrations.
        seed: seed of their scenarios.
        runs: number of clones with the same settings.

    """
    tiny, trained, test = arguments.tiny, arguments.runs / folder.name, ScenarioBank.shipped(family, "test")
    count = 4 if tiny else demonstrations
    demos = demonstrate(family, count, trained / "demonstrations", seed=seed, tiny=tiny)
    for name in arguments.names:
        settings = folder / "configurations" / f"{name}.json"
        clones = [
            train(settings, trained / f"{name}-{number}", tiny=tiny, seed=number, demos=(demos,))
            for number in range(2 if tiny else runs)
        ]
        play(map(load, clones), [test], arguments.results, name, count=2 if tiny else None, progress=not tiny)


def score_tables(results: Path, heading: str, labels: Mapping[str, str]) -> tuple[str, str]:
    """Return two Markdown tables of scores: over the scenarios, and with the values of each of several runs.

    Args:
        results: directory of the results.
        heading: titles of the first columns, divided by " | ".
        labels: cells of the first columns by the names of the results; results that do not exist are omitted.

    """
    head = f"| {heading} | success (%) | collision (%) | SOC | regret, pose reached (%) |\n"
    head += "|---" * (head.count("|") - 1) + "|\n"
    over_scenarios, over_runs = head, head
    for name, label in labels.items():
        path = results / f"{name}.jsonl.gz"
        if path.exists():
            ((_, found),) = read_episodes(path).items()
            row = score(name, found)
            over_scenarios += f"| {label} | {markdown_cells(row)} |\n"
            if row.runs > 1:
                over_runs += f"| {label} | {markdown_run_cells(row)} |\n"
    return over_scenarios, over_runs
