"""What each part of a warm start brings: short runs of PPO and SAC that lack one, or have one more, side by side.

python scripts/ablate_warm_start.py --runs DIR          # what is finished there is not done again

A small clone (of 2,000 demonstrations) leaves something to learn. All runs of an algorithm take equally many steps.
Those from scratch have the settings tuned for that, the others those of a warm start, but for PPO's learning rate: four
times as high, so that so few steps change something.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from leapnav.experts.rollouts import rollout
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
    """The runs, by what is printed of them; their folders are set later."""
    every: dict[str, Any] = {"evaluate_every": PPO_STEPS // 8, "checkpoint_every": PPO_STEPS // 4}
    ppo = PPOConfig.tuned("clutter", warm=True, total_timesteps=PPO_STEPS, learning_rate=2e-4, **every)
    both = {"warm_start": (clone, demos)}
    full = replace(ppo, **both)
    scratch = PPOConfig.tuned("clutter", total_timesteps=PPO_STEPS, **every)
    every = {"evaluate_every": SAC_STEPS // 8, "checkpoint_every": SAC_STEPS // 4}
    sac = SACConfig.tuned("clutter", warm=True, total_timesteps=SAC_STEPS, lidar_beams=32, warm_start=(demos,), **every)
    return {
        "PPO from scratch": scratch,
        "PPO from scratch, reward not shaped": replace(scratch, reward="cost"),
        "PPO: the same, critic": replace(
            scratch, reward="cost", warm_start=(demos,), start=WarmStartConfig(actor=False)
        ),
        "PPO: actor": replace(full, start=CLONE_ONLY, critic_first=0.0),
        "PPO: actor, critic alone first": replace(full, start=CLONE_ONLY),
        "PPO: actor, critic": replace(full, start=WarmStartConfig(gradient=False)),
        "PPO: actor, critic, gradient": full,
        "PPO: all three, divergence 0.1": replace(full, divergence=0.1),
        "PPO: all three, jump-start 0.8": replace(full, jump_start=0.8),
        "SAC from scratch": SACConfig.tuned("clutter", total_timesteps=SAC_STEPS, lidar_beams=32, **every),
        "SAC: actor": replace(sac, start=CLONE_ONLY, demonstrations=0.0, imitation=0.0),
        "SAC: actor, critic, gradient": replace(sac, demonstrations=0.0, imitation=0.0),
        "SAC: all three, demonstrations": replace(sac, imitation=0.0),
        "SAC: all three, demonstrations, imitation": sac,
    }


def summary(folder: Path) -> str:
    """Cells of a run's row: success and SOC at first, at worst and at the end, and the median regret then."""
    lines = [json.loads(line)["clutter"] for line in (folder / "evaluations.jsonl").read_text().splitlines()]
    first, last, worst = lines[0], lines[-1], min(lines, key=lambda line: line["soc"])
    pairs = [f"{100 * line['success']:.1f} / {line['soc']:.3f}" for line in (first, worst, last)]
    regret = "" if last["regret"] is None else f"{100 * last['regret']:.1f}"
    return " | ".join([*pairs, f"{100 * last['collision']:.1f}", regret])


def main() -> None:
    """Runs what is not finished, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", default="", help="variants whose name has this")
    parser.add_argument("--workers", type=int, default=2, help="processes that make the demonstrations")
    arguments = parser.parse_args()
    runs: Path = arguments.runs
    demos, clone = runs / "demonstrations", runs / "clone"
    rollout("clutter", DEMONSTRATIONS, demos, seed=DEMONSTRATION_SEED, workers=arguments.workers)
    config = BCConfig.tuned("clutter", out=clone, demos=(demos,), resume=(clone / "config.json").exists())
    train_bc(config)
    print("| run | success (%) / SOC at first | at worst | at the end | collision (%) | regret (%) |")
    print("|---|---|---|---|---|---|")
    for number, (name, variant) in enumerate(variants(clone, demos).items()):
        folder = runs / f"{number:02d}"
        if arguments.only not in name:
            continue
        variant = replace(variant, out=folder, evaluation_scenarios=200, resume=(folder / "config.json").exists())
        if isinstance(variant, PPOConfig):
            train_ppo(variant)
        else:
            train_sac(variant)
        print(f"| {name} | {summary(folder)} |", flush=True)


if __name__ == "__main__":
    main()
