"""The included policies: training, and scores in fresh scenarios of their families.

python studies/included_policies/run.py                   # scores all included policies
python studies/included_policies/run.py clutter crossing  # scores only these
python studies/included_policies/run.py clutter --train   # trains and includes them first; resumes unfinished runs

`configurations/` contains the complete settings of each policy, in the format of `config.json` of a training run, and
`results/` the episodes. The scenarios and their optima are built once in runs/studies/fresh. `--tiny` trains and scores
with a tiny budget, to try the script; it needs `--out`.
"""

import argparse
import json
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.bank import collection_name
from leapnav.envs.scenarios.families import families_of
from leapnav.experts import build_bank
from leapnav.training import (
    CloningConfig,
    DAggerConfig,
    DAggerRunConfig,
    Evaluation,
    evaluate,
    load_policy,
    policy_environment,
    read_episodes,
    save_policy,
    score,
    train_dagger,
    write_episodes,
)
from leapnav.training.config import read_config
from leapnav.training.policies.files import SHIPPED, read_description
from leapnav.training.scoring.reports import markdown_cells

HERE = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in (HERE / "configurations").glob("*.json")))
SCENARIOS, SEED = 4000, 784  # of each bank of fresh scenarios
TABLES = {"included-policies": "docs/results.md"}  # with the files that contain them


@dataclass(frozen=True)
class Budget:
    """How much is computed.

    Attributes:
        scenarios: number of fresh scenarios of each family.
        training: changes of the settings of the training.

    """

    scenarios: int
    training: dict[str, Any]


FULL = Budget(SCENARIOS, {})
TINY = Budget(
    4,
    {
        "hidden": (16, 16),
        "n_envs": 2,
        "scenarios": 4,
        "evaluation_scenarios": 2,
        "cloning": CloningConfig(epochs=1, batch_size=64),
        "dagger": DAggerConfig(rounds=1, max_episodes=4, max_failures=2, lead=0.5, epochs=1, last_epochs=1),
    },
)


def configuration(name: str) -> DAggerRunConfig:
    """Return the settings of a policy."""
    _, config = read_config(HERE / "configurations" / f"{name}.json")
    assert isinstance(config, DAggerRunConfig)
    return config


def train(name: str, runs: Path, included: Path, budget: Budget) -> None:
    """Train a policy, or resume its run, and write the actor in half precision into the directory of the policies."""
    run, shipped = runs / "included_policies" / name, included / name
    resume = (run / "config.json").exists()
    config = replace(configuration(name), **budget.training, out=run, resume=resume)
    train_dagger(config, workers=os.cpu_count() or 1, progress=budget is FULL)
    shutil.rmtree(shipped, ignore_errors=True)
    training = read_description(run)["training"]
    save_policy(load_policy(run), shipped, policy_environment(run), training=training, half=True)


def fresh_bank(family: str, config: DAggerRunConfig, runs: Path, count: int) -> ScenarioBank:
    """Return the bank of fresh scenarios of a family, built at the first call."""
    task = {"robot": config.robot, "horizon": config.horizon, "obstacles": config.obstacles}
    path = runs / "fresh" / f"{collection_name(family, *task.values())}-{count}.bank"
    path.parent.mkdir(parents=True, exist_ok=True)
    return build_bank(family, count, path, **task, seed=SEED, workers=os.cpu_count() or 1, progress=count == SCENARIOS)


def score_policy(name: str, included: Path, runs: Path, results: Path, budget: Budget) -> None:
    """Score a policy in fresh scenarios of its families, and write the episodes."""
    config, found = configuration(name), []
    policy, environment = load_policy(included / name), policy_environment(included / name)
    for family in families_of(config.family):
        bank = fresh_bank(family, config, runs, budget.scenarios)
        workers = os.cpu_count() or 1
        options = {"timed": False, "workers": workers, "progress": budget is FULL}
        found += evaluate(policy, bank, environment=environment, **options).episodes
    results.mkdir(parents=True, exist_ok=True)
    write_episodes({name: [Evaluation(tuple(found), float("nan"))]}, results / f"{name}.jsonl.gz")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    lines = [
        "| policy | scenarios | success (%) | collision (%) | SOC | regret, pose reached (%) | unknown |",
        "|---|---|---|---|---|---|---|",
    ]
    for path in sorted(results.glob("*.jsonl.gz"), key=lambda path: path.name.partition(".")[0]):
        for name, (evaluation,) in read_episodes(path).items():
            families = list(dict.fromkeys(episode.family for episode in evaluation))
            for family in families:
                episodes = tuple(episode for episode in evaluation if episode.family == family)
                row = score(name, replace(evaluation, episodes=episodes))
                label = f"`{name}`" if len(families) == 1 else f"`{name}` on {family}"
                lines.append(f"| {label} | {row.episodes:,} | {markdown_cells(row)} | {row.unknown} |")
    return {"included-policies": "\n".join(lines) + "\n"}


def main() -> None:
    """Train and score the named policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"policies ({', '.join(NAMES)}); by default all")
    parser.add_argument("--train", action="store_true", help="train the policies first, and include them")
    parser.add_argument("--runs", type=Path, default=Path("runs/studies"), help="directory of the runs and the banks")
    parser.add_argument("--out", type=Path, help="directory of the results; by default beside this file")
    parser.add_argument("--tiny", action="store_true", help="train and score with a tiny budget")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in NAMES]
    if unknown:
        parser.error(f"NAME: expected one of {', '.join(NAMES)}, got {unknown[0]!r}")
    if arguments.tiny and arguments.out is None:
        parser.error("--tiny: needs --out, so that the results in the repository are kept")
    budget, results = TINY if arguments.tiny else FULL, arguments.out or HERE / "results"
    included = results / "policies" if arguments.tiny and arguments.train else SHIPPED
    for name in arguments.names or NAMES:
        if arguments.train:
            train(name, arguments.runs, included, budget)
        score_policy(name, included, arguments.runs, results, budget)
    print(json.dumps({"results": str(results)}) if arguments.tiny else tables(results)["included-policies"])


if __name__ == "__main__":
    main()
