"""Ablation of the warm start: short runs of PPO and SAC with different parts of it.

python scripts/ablate_warm_start.py --runs DIR          # skips finished runs in DIR, resumes the others

The clone is fitted to 2,000 demonstrations only, so that there is room for improvement. All runs of an algorithm have
the same number of steps. Runs from scratch use the settings tuned for that, the others those of a warm start, but with
a learning rate of PPO four times as high, so that the short runs have an effect.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from leapnav.experts import rollout
from leapnav.training import (
    BCConfig,
    PPOConfig,
    SACConfig,
    WarmStartConfig,
    train_bc,
    train_ppo,
    train_sac,
)

DEMONSTRATIONS, DEMONSTRATION_SEED = 2000, 50_000
PPO_STEPS, SAC_STEPS = 400_000, 20_000
CLONE_ONLY = WarmStartConfig(critic=False)


def variants(clone: Path, demos: Path) -> dict[str, PPOConfig | SACConfig]:
    """Return the configurations by their names in the table; their directories are set later."""
    intervals: dict[str, Any] = {"evaluate_every": PPO_STEPS // 8, "checkpoint_every": PPO_STEPS // 4}
    ppo = PPOConfig.tuned("clutter", warm=True, total_timesteps=PPO_STEPS, learning_rate=2e-4, **intervals)
    full = replace(ppo, warm_start=(clone, demos))
    scratch = PPOConfig.tuned("clutter", total_timesteps=PPO_STEPS, **intervals)
    intervals = {"evaluate_every": SAC_STEPS // 8, "checkpoint_every": SAC_STEPS // 4}
    sac = SACConfig.tuned(
        "clutter", warm=True, total_timesteps=SAC_STEPS, lidar_beams=32, warm_start=(demos,), **intervals
    )
    return {
        "PPO from scratch": scratch,
        "PPO from scratch, unshaped reward": replace(scratch, reward="cost"),
        "PPO from scratch, unshaped reward, critic": replace(
            scratch, reward="cost", warm_start=(demos,), start=WarmStartConfig(actor=False)
        ),
        "PPO: actor": replace(full, start=CLONE_ONLY, critic_first=0.0),
        "PPO: actor; critic trained first": replace(full, start=CLONE_ONLY),
        "PPO: actor, critic": replace(full, start=WarmStartConfig(gradient=False)),
        "PPO: actor, critic, gradient": full,
        "SAC from scratch": SACConfig.tuned("clutter", total_timesteps=SAC_STEPS, lidar_beams=32, **intervals),
        "SAC: actor": replace(sac, start=CLONE_ONLY, demonstrations=0.0, imitation=0.0),
        "SAC: actor, critic, gradient": replace(sac, demonstrations=0.0, imitation=0.0),
        "SAC: actor, critic, gradient; demonstrations": replace(sac, imitation=0.0),
        "SAC: actor, critic, gradient; demonstrations, imitation": sac,
    }


def summary(run: Path) -> str:
    """Return the cells of a run: initial, minimum and final success and SOC, final collisions and median regret."""
    lines = [json.loads(line)["clutter"] for line in (run / "evaluations.jsonl").read_text().splitlines()]
    first, last, worst = lines[0], lines[-1], min(lines, key=lambda line: line["soc"])
    pairs = [f"{100 * line['success']:.1f} / {line['soc']:.3f}" for line in (first, worst, last)]
    regret = "" if last["regret"] is None else f"{100 * last['regret']:.1f}"
    return " | ".join([*pairs, f"{100 * last['collision']:.1f}", regret])


def main() -> None:
    """Run the configurations that are not finished, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", default="", help="part of the names of the configurations to run")
    parser.add_argument("--workers", type=int, default=2, help="number of processes that record demonstrations")
    arguments = parser.parse_args()
    runs: Path = arguments.runs
    demos, clone = runs / "demonstrations", runs / "clone"
    rollout("clutter", DEMONSTRATIONS, demos, seed=DEMONSTRATION_SEED, workers=arguments.workers)
    settings: dict[str, Any] = {"observation": "lidar", "resume": (clone / "config.json").exists()}
    config = BCConfig.tuned("clutter", out=clone, demos=(demos,), **settings)
    train_bc(config)
    print("| run | initial success (%) / SOC | minimum | final | collision (%) | regret (%) |")
    print("|---|---|---|---|---|---|")
    for index, (name, variant) in enumerate(variants(clone, demos).items()):
        run = runs / f"{index:02d}"
        if arguments.only not in name:
            continue
        variant = replace(variant, out=run, evaluation_scenarios=200, resume=(run / "config.json").exists())
        if isinstance(variant, PPOConfig):
            train_ppo(variant)
        else:
            train_sac(variant)
        print(f"| {name} | {summary(run)} |", flush=True)


if __name__ == "__main__":
    main()
