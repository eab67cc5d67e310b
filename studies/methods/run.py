"""Methods on the same families with the same sensor, lidar alone: clones, DAgger and PPO, in several runs each.

python studies/methods/run.py                      # trains and scores all methods
python studies/methods/run.py open-bc clutter-ppo  # only these, and the clones from which they start

`configurations/` contains the complete settings of each method on each family, in the format of `config.json` of a
training run, and `results/` the episodes on the test split. A finished run is not repeated, an interrupted one resumes.
The clones of a family share their demonstrations, and DAgger and PPO start from the clone of the same seed. `--tiny`
trains with a tiny budget, to try the script; it needs `--out`.
"""

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from leapnav.envs import ScenarioBank
from leapnav.experts import rollout
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
    write_episodes,
)
from leapnav.training.config import read_config
from leapnav.training.scoring.reports import markdown_cells, markdown_run_cells

HERE = Path(__file__).parent
TABLES = {"methods": "docs/results.md", "methods-runs": "docs/results.md"}
ROWS = {
    "bc": "clone",
    "dagger": "DAgger from the clone",
    "ppo": "PPO from scratch",
    "ppo-clone": "PPO from the clone",
}
FAMILIES = ("open", "clutter")
NAMES = tuple(f"{family}-{method}" for family in FAMILIES for method in ROWS)
DEMONSTRATIONS, DEMONSTRATION_SEED = 2000, 60_000


@dataclass(frozen=True)
class Budget:
    """How much is computed.

    Attributes:
        seeds: number of runs of each method.
        demonstrations: number of demonstrated scenarios of each family.
        scenarios: number of scenarios of the test split; None: all.
        changes: changes of the settings, of those that have them.

    """

    seeds: int
    demonstrations: int
    scenarios: int | None
    changes: dict[str, Any]


FULL = Budget(3, DEMONSTRATIONS, None, {})
TINY = Budget(
    2,
    4,
    2,
    {
        "hidden": (16, 16),
        "n_envs": 2,
        "n_steps": 32,
        "batch_size": 32,
        "total_timesteps": 128,
        "evaluation_scenarios": 2,
        "cloning": CloningConfig(epochs=1, batch_size=64),
        "dagger": DAggerConfig(rounds=1, max_episodes=4, max_failures=2, lead=0.5, epochs=1, last_epochs=1),
        "start": WarmStartConfig(critic_epochs=1, slopes=50),
    },
)
TRAIN: dict[str, Callable[..., Any]] = {"bc": train_bc, "dagger": train_dagger, "ppo": train_ppo}


def train(name: str, seed: int, runs: Path, budget: Budget) -> Path:
    """Train a method, or resume its run, and return the directory of the run."""
    family, _, method = name.partition("-")
    run, demonstrations = runs / f"{name}-{seed}", runs / f"{family}-demonstrations"
    if _is_finished(run):
        return run
    given: dict[str, Any] = {}
    if method != "ppo":
        options = {"workers": os.cpu_count() or 1, "progress": budget is FULL}
        rollout(family, budget.demonstrations, demonstrations, seed=DEMONSTRATION_SEED, **options)
    if method in ("dagger", "ppo-clone"):
        clone = train(f"{family}-bc", seed, runs, budget)
        given = {"policy": clone, "demos": (demonstrations,)}
        if method == "ppo-clone":
            given = {"warm_start": (clone, demonstrations)}
    elif method == "bc":
        given = {"demos": (demonstrations,)}
    algorithm, config = read_config(HERE / "configurations" / f"{name}.json")
    names = {field.name for field in fields(config)}
    given |= {setting: value for setting, value in budget.changes.items() if setting in names}
    config = replace(config, **given, out=run, seed=seed, resume=(run / "config.json").exists())
    TRAIN[algorithm](config, progress=budget is FULL)
    return run


def _is_finished(run: Path) -> bool:
    evaluations = run / "evaluations.jsonl"
    return evaluations.exists() and json.loads(evaluations.read_text(encoding="utf-8").splitlines()[-1])["final"]


def score_method(name: str, runs: Path, results: Path, budget: Budget) -> None:
    """Train and score all runs of a method, and write their episodes."""
    bank, found = ScenarioBank.shipped(name.partition("-")[0], "test"), list[Evaluation]()
    for seed in range(budget.seeds):
        run = train(name, seed, runs, budget)
        options = {"count": budget.scenarios, "timed": False, "workers": os.cpu_count() or 1}
        environment = policy_environment(run)
        found.append(evaluate(load_policy(run), bank, environment=environment, progress=budget is FULL, **options))
    results.mkdir(parents=True, exist_ok=True)
    write_episodes({name: found}, results / f"{name}.jsonl.gz")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    columns = "| success (%) | collision (%) | SOC | regret, pose reached (%) |\n|---|---|---|---|---|---|---|\n"
    rows = {"methods": "| family | method | runs " + columns, "methods-runs": "| family | method | runs " + columns}
    for name in NAMES:
        path = results / f"{name}.jsonl.gz"
        if path.exists():
            family, _, method = name.partition("-")
            ((_, found),) = read_episodes(path).items()
            row = score(name, found)
            start = f"| {family} | {ROWS[method]} | {row.runs} | "
            rows["methods"] += f"{start}{markdown_cells(row)} |\n"
            rows["methods-runs"] += f"{start}{markdown_run_cells(row)} |\n"
    return rows


def main() -> None:
    """Train and score the named methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"methods ({', '.join(NAMES)}); by default all")
    parser.add_argument("--runs", type=Path, default=Path("runs/studies/methods"), help="directory of the runs")
    parser.add_argument("--out", type=Path, help="directory of the results; by default beside this file")
    parser.add_argument("--tiny", action="store_true", help="train and score with a tiny budget")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in NAMES]
    if unknown:
        parser.error(f"NAME: expected one of {', '.join(NAMES)}, got {unknown[0]!r}")
    if arguments.tiny and arguments.out is None:
        parser.error("--tiny: needs --out, so that the results in the repository are kept")
    budget, results = TINY if arguments.tiny else FULL, arguments.out or HERE / "results"
    for name in arguments.names or NAMES:
        score_method(name, arguments.runs, results, budget)
    print("\n".join(tables(results).values()))


if __name__ == "__main__":
    main()
