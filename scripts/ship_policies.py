"""Train and score the policies that are included in leapnav.

python scripts/ship_policies.py                    # all policies, trained in runs/ship; skips finished runs
python scripts/ship_policies.py clutter car-clutter  # only these
"""

import argparse
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from leapnav.envs.scenarios.bank import collection_name
from leapnav.envs.scenarios.families import ALL, ALL_FAMILIES
from leapnav.training import DAggerRunConfig, evaluate, load_policy, policy_environment, save_policy, train_dagger
from leapnav.training.config import DAggerConfig, RobotName
from leapnav.training.policies.files import SHIPPED, read_description

ROBOTS = ("car", "dynamic_unicycle")
FREE = collection_name("clutter", horizon="free")
MOVING = "crossing", "crowd"
OPEN = {"observation": "lidar", "lidar_beams": 32, "hidden": (128, 128), "scenarios": 2000}
SETTINGS: dict[str, dict[str, Any]] = {
    "open": {**OPEN, "dagger": DAggerConfig(rounds=2)},
    "polygons": {"scenarios": 8000},
    "rooms": {"scenarios": 8000},
    "slalom": {"scenarios": 4000, "dagger": DAggerConfig(max_episodes=6000)},
    "crossing": {"scenarios": 5000},
    "crowd": {"scenarios": 5000, "dagger": DAggerConfig(rounds=6, max_failures=300)},
}
NAMES = (*ALL_FAMILIES, *MOVING, ALL, *(collection_name("clutter", robot) for robot in ROBOTS), FREE)


def ship(name: str, runs: Path) -> None:
    """Train the policy of a family, or resume its run; write the actor in half precision, and score it."""
    run = runs / name
    prefix, _, family = name.rpartition("-")
    robot = cast(RobotName, prefix if prefix in ROBOTS else "unicycle")
    settings: dict[str, Any] = {**SETTINGS.get(family, {}), "horizon": "free" if name == FREE else "fixed"}
    config = DAggerRunConfig.tuned(family, out=run, robot=robot, **settings)
    train_dagger(replace(config, resume=(run / "config.json").exists()), workers=os.cpu_count() or 1)
    shipped = SHIPPED / name
    shutil.rmtree(shipped, ignore_errors=True)
    training = read_description(run)["training"]
    save_policy(load_policy(run), shipped, policy_environment(run), training=training, half=True)
    policy = load_policy(shipped)
    for tested in ALL_FAMILIES if family == ALL else (family,):
        score = evaluate(policy, tested, environment=policy_environment(shipped))
        print(f"{name} on {tested}: success {score.success:.3f}, SOC {score.soc:.3f}, median regret {score.regret:.4f}")


def main() -> None:
    """Train the named policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"policies to train ({', '.join(NAMES)}); by default all"
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/ship"))
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in NAMES]
    if unknown:
        parser.error(f"NAME: expected one of {', '.join(NAMES)}, got {unknown[0]!r}")
    for name in arguments.names or NAMES:
        ship(name, arguments.runs)


if __name__ == "__main__":
    main()
