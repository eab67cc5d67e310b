"""All methods on all families: clones of several seeds, PPO and SAC from scratch and from a clone, what ships.

python scripts/compare_methods.py --runs DIR                      # what is finished there is not done again
python scripts/compare_methods.py --only bc --families open       # some
python scripts/compare_methods.py --table                         # nothing is trained: the table of what is there

What takes less than ten minutes is run with five seeds; clones share their demonstrations, so that their spread is the
fit's. PPO from a clone starts with the first one; SAC, which squashes its actions, makes its own.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from leapnav.envs import FAMILIES, ScenarioBank
from leapnav.experts.rollouts import rollout
from leapnav.training import BCConfig, PPOConfig, SACConfig, train_bc, train_ppo, train_sac
from leapnav.training.contest import contest
from leapnav.training.entrants import load_entrant
from leapnav.training.reports import COLUMNS, cell

SHOWN = ("success", "collision", "soc", "regret")
METHODS = ("bc", "scratch", "warm", "sac", "sacwarm")
DEMONSTRATIONS = {"open": 2000, "clutter": 10_000, "polygons": 4000, "rooms": 4000, "slalom": 4000}
DEMONSTRATION_SEED = 60_000
STEPS = {"open": 1_000_000, "clutter": 5_000_000, "polygons": 2_000_000, "rooms": 2_000_000, "slalom": 2_000_000}
SAC_STEPS = {"sac": 100_000, "sacwarm": 20_000}
ONE_SEED = {
    "bc": ("slalom",),
    "scratch": ("clutter", "polygons", "rooms", "slalom"),
    "warm": ("clutter", "polygons", "rooms", "slalom"),
    **dict.fromkeys(("sac", "sacwarm"), tuple(FAMILIES)),
}
EVALUATIONS = 8  # on the way of a run of PPO or SAC
ROWS = {
    "bc": "clone of {demos:,}",
    "scratch": "PPO from scratch, {steps:.1f} M steps",
    "warm": "PPO from a clone",
    "sac": "SAC from scratch, {sac:,} steps",
    "sacwarm": "SAC from a clone, {sacwarm:,} steps",
}


def train(method: str, family: str, runs: Path, seeds: int, workers: int) -> None:
    """The runs of a method on a family that are not finished."""
    demos = runs / family / "demonstrations"
    if method in ("bc", "warm", "sacwarm"):
        rollout(family, DEMONSTRATIONS[family], demos, seed=DEMONSTRATION_SEED, workers=workers)
    for seed in range(1 if family in ONE_SEED[method] else seeds):
        out = runs / family / f"{method}-{seed}"
        run = {"out": out, "seed": seed, "resume": (out / "config.json").exists()}
        if method == "bc":
            train_bc(BCConfig.tuned(family, demos=(demos,), **run))
            continue
        if method in SAC_STEPS:
            steps = SAC_STEPS[method]
            start = (demos,) if method == "sacwarm" else ()
            every = steps // EVALUATIONS
            train_sac(SACConfig.tuned(family, total_timesteps=steps, warm_start=start, evaluate_every=every, **run))
            continue
        if method == "warm":
            run["warm_start"] = (runs / family / "bc-0", demos)
        if method == "scratch":
            run["total_timesteps"] = STEPS[family]
        config = PPOConfig.tuned(family, **run)
        train_ppo(replace(config, evaluate_every=config.total_timesteps // EVALUATIONS))


def is_finished(run: Path) -> bool:
    """Whether a run came to its end: during it, its folder holds the policy of the last evaluation."""
    evaluations = run / "evaluations.jsonl"
    return evaluations.exists() and json.loads(evaluations.read_text().splitlines()[-1])["final"]


def entrants(family: str, runs: Path) -> list[str]:
    """What the table of a family compares, each with its row's name."""
    values = {"demos": DEMONSTRATIONS[family], "steps": STEPS[family] / 1e6, **SAC_STEPS}
    found = [
        f"{ROWS[method].format(**values)}={folder}"
        for method in METHODS
        for folder in sorted((runs / family).glob(f"{method}-*"))
        if is_finished(folder)
    ]
    return [*found, f"DAgger (ships)={family}", "go-to-goal"]


def main() -> None:
    """Trains what is asked for and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/methods"))
    parser.add_argument("--families", nargs="+", default=FAMILIES, choices=FAMILIES)
    parser.add_argument("--only", nargs="+", default=METHODS, choices=METHODS, help="train these methods")
    parser.add_argument("--seeds", type=int, default=5, help="of what takes less than ten minutes")
    parser.add_argument("--table", action="store_true", help="train nothing")
    parser.add_argument("--workers", type=int, default=1, help="processes that make demonstrations")
    arguments = parser.parse_args()
    if not arguments.table:
        for method in arguments.only:
            for family in arguments.families:
                train(method, family, arguments.runs, arguments.seeds, arguments.workers)
    print("| family | policy | runs | success (%) | collision (%) | SOC | median regret (%) |")
    print("|---|---|---|---|---|---|---|")
    for family in arguments.families:
        names = [load_entrant(name) for name in entrants(family, arguments.runs)]
        found = contest(names, [ScenarioBank.shipped(family, "test")])
        for row in found.scores():
            cells = [cell(getattr(row, name), *form).replace("\n", " ") for _, name, *form in COLUMNS if name in SHOWN]
            print(f"| {family} | {row.policy} | {row.runs} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
