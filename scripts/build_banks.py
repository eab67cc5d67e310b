"""Builds the banks that ship with leapnav, in envs/banks, or checks that they come out the same to the bit.

python scripts/build_banks.py            # builds those that are missing; remove a bank to build it anew
python scripts/build_banks.py --check    # builds all of them elsewhere and compares
"""

import argparse
import filecmp
import os
import sys
import tempfile
from pathlib import Path

from leapnav.envs import FAMILIES
from leapnav.experts import build_bank

BANKS = Path(__file__).resolve().parent.parent / "envs" / "banks"
# Number of scenarios and seed. Draws of different seeds are independent, so no test scenario is in a training bank.
SPLITS = {"train": (400, 0), "test": (200, 1)}


def build(folder: Path, workers: int) -> None:
    for family in FAMILIES:
        for split, (count, seed) in SPLITS.items():
            build_bank(family, count, folder / f"{family}-{split}.bank", seed=seed, workers=workers)


def check(workers: int) -> int:
    with tempfile.TemporaryDirectory() as scratch:
        build(Path(scratch), workers)
        names = sorted(path.name for path in Path(scratch).iterdir())
        _, different, missing = filecmp.cmpfiles(scratch, BANKS, names, shallow=False)
    for name in (*different, *missing):
        print(f"{name}: {'missing' if name in missing else 'different'}")
    print(f"{len(names) - len(different) - len(missing)} of {len(names)} banks are the same to the bit")
    return 1 if different or missing else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="build elsewhere and compare")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    arguments = parser.parse_args()
    if arguments.check:
        return check(arguments.workers)
    BANKS.mkdir(exist_ok=True)
    build(BANKS, arguments.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
