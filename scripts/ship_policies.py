"""Trains the policies that ship with leapnav, in training/pretrained, and scores them.

python scripts/ship_policies.py                    # all of them, in runs/ship; what is finished there is not done again
python scripts/ship_policies.py clutter all        # some
"""

import argparse
import os
import shutil
from dataclasses import replace
from pathlib import Path

from leapnav.envs.families import ALL, FAMILIES
from leapnav.training import DAggerRunConfig, evaluate, load_policy, policy_environment, save_policy, train_dagger
from leapnav.training.policies import read_description

PRETRAINED = Path(__file__).resolve().parent.parent / "training" / "pretrained"
NAMES = (*FAMILIES, ALL)


def ship(name: str, runs: Path) -> None:
    """Trains a family's policy, or goes on with it, and writes its actor in half precision."""
    run = runs / name
    config = replace(DAggerRunConfig.tuned(name), out=run)
    train_dagger(replace(config, resume=(run / "config.json").exists()), workers=os.cpu_count() or 1)
    folder = PRETRAINED / name
    shutil.rmtree(folder, ignore_errors=True)
    training = read_description(run)["training"]
    save_policy(load_policy(run), folder, policy_environment(run), training=training, half=True)
    policy = load_policy(folder)
    for family in FAMILIES if name == ALL else (name,):
        found = evaluate(policy, family, environment=policy_environment(folder))
        print(f"{name} on {family}: success {found.success:.3f}, SOC {found.soc:.3f}, median regret {found.regret:.4f}")


def main() -> None:
    """Ships what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(NAMES)}")
    parser.add_argument("--runs", type=Path, default=Path("runs/ship"))
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in NAMES]
    if unknown:
        parser.error(f"expected some of {', '.join(NAMES)}, got {unknown[0]!r}")
    for name in arguments.names or NAMES:
        ship(name, arguments.runs)


if __name__ == "__main__":
    main()
