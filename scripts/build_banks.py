"""Build the scenario banks that are included in leapnav, or check that a new build has bitwise identical contents.

python scripts/build_banks.py            # builds missing banks; remove a bank to build it again
python scripts/build_banks.py --check    # builds all banks in a temporary directory and compares

Lower bounds, which `leapnav bank prove` adds, are not compared.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import h5py

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.bank import LOWER_BOUNDS, collection_name
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import build_bank

BANKS = Path(__file__).resolve().parent.parent / "envs" / "scenarios" / "banks"
# Number of scenarios, and seed. Different seeds give independent scenarios, so no scenario is in both splits.
SPLITS = {"train": (400, 0), "test": (200, 1)}
# Robots besides the unicycle: models, families, and number of scenarios of each split.
ROBOTS, ROBOT_FAMILIES, ROBOT_COUNT = ("car", "dynamic_unicycle"), ("clutter", "rooms"), 200
LARGE_FAMILIES, LARGE_COUNT = ("maze", "corridors"), 200  # fixed horizon only


def build(directory: Path, workers: int) -> None:
    for family in ALL_FAMILIES:
        for split, (count, seed) in SPLITS.items():
            build_bank(family, count, directory / f"{family}-{split}.bank", seed=seed, workers=workers)
            path = directory / f"{collection_name(family, horizon='free')}-{split}.bank"
            build_bank(family, count, path, horizon="free", seed=seed, workers=workers)
    for family in LARGE_FAMILIES:
        for split, (_, seed) in SPLITS.items():
            build_bank(family, LARGE_COUNT, directory / f"{family}-{split}.bank", seed=seed, workers=workers)
    for robot in ROBOTS:
        for family in ROBOT_FAMILIES:
            for split, (_, seed) in SPLITS.items():
                path = directory / f"{collection_name(family, robot)}-{split}.bank"
                build_bank(family, ROBOT_COUNT, path, robot=robot, seed=seed, workers=workers)


def check(workers: int) -> int:
    with tempfile.TemporaryDirectory() as scratch:
        build(Path(scratch), workers)
        names = sorted(path.name for path in Path(scratch).iterdir())
        missing = [name for name in names if not (BANKS / name).exists()]
        different = [
            name for name in names if name not in missing and digests(BANKS / name) != digests(Path(scratch) / name)
        ]
    for name in (*different, *missing):
        print(f"{name}: {'missing' if name in missing else 'different'}")
    print(f"{len(names) - len(different) - len(missing)} of {len(names)} banks have bitwise identical contents")
    return 1 if different or missing else 0


def digests(path: Path) -> dict[str, str]:
    """Return the checksums of the attributes and of all datasets except the lower bounds, after verifying them."""
    ScenarioBank(path).verify_checksums()
    with h5py.File(path) as file:
        found: dict[str, str] = json.loads(str(file.attrs["checksums"]))
    return {name: digest for name, digest in found.items() if name != LOWER_BOUNDS}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="build in a temporary directory and compare")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="number of processes")
    arguments = parser.parse_args()
    if arguments.check:
        return check(arguments.workers)
    BANKS.mkdir(exist_ok=True)
    build(BANKS, arguments.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
