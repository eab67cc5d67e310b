"""Build the scenario banks that are included in leapnav, or compare them with a new build.

python scripts/build_banks.py            # builds missing banks; remove a bank to build it again
python scripts/build_banks.py --check    # builds all banks in a temporary directory and compares (`make test-all`)

The scenarios must be identical, and costs and paths must agree to the tolerances below: the last bits depend on the
processor, and some banks are older than changes of the search. Differences of the second-best costs are counted only,
because the search omits some of the expensive alternatives. Lower bounds, which `leapnav bank prove` adds, and shortest
paths are not compared.

python scripts/build_banks.py --shortest # adds shortest lengths and minimum times to the test banks (days)
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from leapnav.envs import Scenario, ScenarioBank
from leapnav.envs.scenarios.bank import collection_name
from leapnav.envs.scenarios.bank_writing import add_datasets
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS
from leapnav.experts import build_bank
from leapnav.experts.data.bank_shortest import find_shortest

BANKS = Path(__file__).resolve().parent.parent / "envs" / "scenarios" / "banks"
# Number of scenarios, and seed. Different seeds give independent scenarios, so no scenario is in both splits.
SPLITS = {"train": (400, 0), "test": (200, 1)}
# Families of the robots besides the unicycle, and number of scenarios of each split.
ROBOT_FAMILIES = {
    "car": ("clutter", "rooms"),
    "dynamic_unicycle": ("clutter", "rooms"),
    "differential_drive": ("clutter",),
    "dynamic_car": ("clutter",),
    "trailer": ("clutter",),
}
ROBOT_COUNT = 200
HARD_FAMILIES = "clutter", "polygons", "rooms", "slalom"  # test banks with hard obstacles
LARGE_FAMILIES, LARGE_COUNT = ("maze", "corridors"), 200  # fixed horizon only
COST_TOLERANCE = 1e-9  # relative
PATH_TOLERANCE = 1e-4  # of states, controls and costates, which are stored in single precision


def build(directory: Path, workers: int) -> None:
    for family in ALL_FAMILIES:
        for split, (count, seed) in SPLITS.items():
            build_bank(family, count, directory / f"{family}-{split}.bank", seed=seed, workers=workers)
            path = directory / f"{collection_name(family, horizon='free')}-{split}.bank"
            build_bank(family, count, path, horizon="free", seed=seed, workers=workers)
    for family in LARGE_FAMILIES:
        for split, (_, seed) in SPLITS.items():
            build_bank(family, LARGE_COUNT, directory / f"{family}-{split}.bank", seed=seed, workers=workers)
    for family in MOVING_LAYOUTS:  # fixed horizon only
        for split, (count, seed) in SPLITS.items():
            build_bank(family, count, directory / f"{family}-{split}.bank", seed=seed, workers=workers)
    count, seed = SPLITS["test"]
    for family in HARD_FAMILIES:
        path = directory / f"{collection_name(family, obstacles='hard')}-test.bank"
        build_bank(family, count, path, obstacles="hard", seed=seed, workers=workers)
    for robot, families in ROBOT_FAMILIES.items():
        for family in families:
            for split, (_, seed) in SPLITS.items():
                path = directory / f"{collection_name(family, robot)}-{split}.bank"
                build_bank(family, ROBOT_COUNT, path, robot=robot, seed=seed, workers=workers)


def add_shortest(directory: Path, workers: int) -> None:
    """Add the shortest lengths and minimum times to the test banks, once for each task."""
    for robot, families in ROBOT_FAMILIES.items():
        for family in families:
            path = directory / f"{collection_name(family, robot)}-test.bank"
            if np.isnan(ScenarioBank(path).shortest_times).any():
                find_shortest(path, workers=workers)
    for family in (*ALL_FAMILIES, *LARGE_FAMILIES):
        path = directory / f"{family}-test.bank"
        if np.isnan(ScenarioBank(path).shortest_times).any():
            find_shortest(path, workers=workers)
        bank = ScenarioBank(path)
        for name in (collection_name(family, horizon="free"), collection_name(family, obstacles="hard")):
            other = directory / f"{name}-test.bank"
            if other.exists() and [task(one) for one in ScenarioBank(other)] == [task(one) for one in bank]:
                values = {name: getattr(bank, name) for name in ("shortest_lengths", "shortest_times")}
                add_datasets(other, **values)


def task(scenario: Scenario) -> tuple[object, ...]:
    """Return what the shortest path depends on."""
    scale = scenario.cost.proximity_scale
    return scenario.arena, scenario.start, scenario.goal, scenario.obstacles, scenario.robot, scale


def check(workers: int) -> int:
    found: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        build(Path(scratch), workers)
        names = sorted(path.name for path in Path(scratch).iterdir())
        for name in names:
            found += compare(BANKS / name, Path(scratch) / name) if (BANKS / name).exists() else [f"{name}: missing"]
    print("\n".join(found) or f"{len(names)} banks agree")
    return 1 if found else 0


def compare(path: Path, built: Path) -> list[str]:
    """Return the differences between a bank and a new build of it."""
    ours, theirs = ScenarioBank(built), ScenarioBank(path)
    theirs.verify_checksums()
    if list(ours) != list(theirs) or ours.drawn != theirs.drawn or ours.rejected != theirs.rejected:
        return [f"{path.name}: other scenarios"]
    found = []
    deviation = float(np.abs(ours.costs / theirs.costs - 1).max())
    if deviation > COST_TOLERANCE:
        found.append(f"{path.name}: costs deviate by {deviation:.1e}")
    for index in range(len(ours)):
        for name in ("states", "controls", "costates"):
            one, other = getattr(ours.reference(index), name), getattr(theirs.reference(index), name)
            if one.shape != other.shape or np.abs(one - other).max() > PATH_TOLERANCE:
                found.append(f"{path.name}: scenario {index}: {name} deviate")
    second, stored = (np.where(np.isnan(bank.second_costs), np.inf, bank.second_costs) for bank in (ours, theirs))
    higher, lower = (second > (1 + COST_TOLERANCE) * stored).sum(), (second < (1 - COST_TOLERANCE) * stored).sum()
    print(
        f"{path.name}: costs deviate by {deviation:.1e}; second-best costs: {higher} higher, {lower} lower", flush=True
    )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="build in a temporary directory and compare")
    parser.add_argument("--shortest", action="store_true", help="add shortest lengths and minimum times")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="number of processes")
    arguments = parser.parse_args()
    if arguments.check:
        return check(arguments.workers)
    if arguments.shortest:
        add_shortest(BANKS, arguments.workers)
        return 0
    BANKS.mkdir(exist_ok=True)
    build(BANKS, arguments.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
