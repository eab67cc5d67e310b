"""Compare all methods on all families: clones, PPO and SAC from scratch and from a clone, and the included policies.

python scripts/compare_methods.py --runs DIR                      # skips finished runs in DIR, resumes the others
python scripts/compare_methods.py --only bc --families open       # trains only these
python scripts/compare_methods.py --table                         # trains nothing, prints the table of finished runs

Runs of less than ten minutes are repeated with five seeds. The clones of a family share their demonstrations, so their
variation is that of the fit. PPO starts from the first clone; SAC squashes its actions, so it fits a clone of its own.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import rollout
from leapnav.training import BCConfig, PPOConfig, SACConfig, train_bc, train_ppo, train_sac
from leapnav.training.scoring.comparison import compare_policies
from leapnav.training.scoring.policy_specs import load_policy_spec
from leapnav.training.scoring.reports import markdown_cells

METHODS = ("bc", "scratch", "warm", "sac", "sacwarm")
DEMONSTRATIONS = {"open": 2000, "clutter": 10_000, "polygons": 4000, "rooms": 4000, "slalom": 4000}
DEMONSTRATION_SEED = 60_000
STEPS = {"open": 1_000_000, "clutter": 5_000_000, "polygons": 2_000_000, "rooms": 2_000_000, "slalom": 2_000_000}
SAC_STEPS = {"sac": 100_000, "sacwarm": 20_000}
# Families on which a run of the method takes more than ten minutes.
SINGLE_SEED = {
    "bc": ("slalom",),
    "scratch": ("clutter", "polygons", "rooms", "slalom"),
    "warm": ("clutter", "polygons", "rooms", "slalom"),
    **dict.fromkeys(("sac", "sacwarm"), tuple(ALL_FAMILIES)),
}
OPEN = {"lidar_beams": 32, "hidden": (128, 128)}  # a smaller network suffices
N_EVALUATIONS = 8  # during a run of PPO or SAC
ROWS = {
    "bc": "clone of {demos:,}",
    "scratch": "PPO from scratch, {steps:.1f} M steps",
    "warm": "PPO from a clone",
    "sac": "SAC from scratch, {sac:,} steps",
    "sacwarm": "SAC from a clone, {sacwarm:,} steps",
}


def train(method: str, family: str, runs: Path, seeds: int, workers: int) -> None:
    """Run or resume a method on a family, with every seed."""
    demos = runs / family / "demonstrations"
    if method in ("bc", "warm", "sacwarm"):
        rollout(family, DEMONSTRATIONS[family], demos, seed=DEMONSTRATION_SEED, workers=workers)
    for seed in range(1 if family in SINGLE_SEED[method] else seeds):
        out = runs / family / f"{method}-{seed}"
        run = {"out": out, "seed": seed, "resume": (out / "config.json").exists(), **(OPEN if family == "open" else {})}
        if method == "bc":
            observation = "lidar" if family == "open" else "geodesic"
            train_bc(BCConfig.tuned(family, demos=(demos,), observation=observation, **run))
            continue
        if method in SAC_STEPS:
            steps = SAC_STEPS[method]
            start = (demos,) if method == "sacwarm" else ()
            run["evaluate_every"] = steps // N_EVALUATIONS
            train_sac(SACConfig.tuned(family, total_timesteps=steps, warm_start=start, **run))
            continue
        if method == "warm":
            run["warm_start"] = (runs / family / "bc-0", demos)
        if method == "scratch":
            run["total_timesteps"] = STEPS[family]
        config = PPOConfig.tuned(family, **run)
        train_ppo(replace(config, evaluate_every=config.total_timesteps // N_EVALUATIONS))


def is_finished(run: Path) -> bool:
    """Whether a run is finished; the directory of an unfinished one contains the policy of the latest evaluation."""
    evaluations = run / "evaluations.jsonl"
    return evaluations.exists() and json.loads(evaluations.read_text().splitlines()[-1])["final"]


def specs(family: str, runs: Path) -> list[str]:
    """Return the policies in the table of a family, as LABEL=DIRECTORY or NAME."""
    values = {"demos": DEMONSTRATIONS[family], "steps": STEPS[family] / 1e6, **SAC_STEPS}
    finished = [
        f"{ROWS[method].format(**values)}={run}"
        for method in METHODS
        for run in sorted((runs / family).glob(f"{method}-*"))
        if is_finished(run)
    ]
    return [*finished, f"DAgger (included)={family}", "go-to-goal"]


def main() -> None:
    """Train the methods and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/methods"))
    parser.add_argument("--families", nargs="+", default=ALL_FAMILIES, choices=ALL_FAMILIES)
    parser.add_argument("--only", nargs="+", default=METHODS, choices=METHODS, help="methods to train")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds of runs that take less than ten minutes")
    parser.add_argument("--table", action="store_true", help="print the table without training")
    parser.add_argument("--workers", type=int, default=1, help="number of processes that record demonstrations")
    arguments = parser.parse_args()
    if not arguments.table:
        for method in arguments.only:
            for family in arguments.families:
                train(method, family, arguments.runs, arguments.seeds, arguments.workers)
    print("| family | policy | runs | success (%) | collision (%) | SOC | median regret (%) |")
    print("|---|---|---|---|---|---|---|")
    for family in arguments.families:
        policies = [load_policy_spec(name) for name in specs(family, arguments.runs)]
        comparison = compare_policies(policies, [ScenarioBank.shipped(family, "test")])
        for row in comparison.scores():
            print(f"| {family} | {row.policy} | {row.runs} | {markdown_cells(row)} |", flush=True)


if __name__ == "__main__":
    main()
