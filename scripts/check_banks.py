"""Build every included bank again, and compare it with the file (`make test-all`).

    python scripts/check_banks.py [FAMILY-SPLIT ...]

The scenarios must be identical. Costs agree to the tolerances below: the banks of "clutter" were built when the lattice
took the distance to a circle without the smoothing of the proximity cost, so that its paths, from which Newton's method
starts, differ in the last digits; and the last bits depend on the processor.
"""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.bank import BANK_DIRECTORY
from leapnav.experts import build_bank

TOLERANCES = {"costs": 1e-11, "second_costs": 1e-9}  # relative
PATH_TOLERANCE = 1e-4  # of states, controls and costates, which are stored in single precision


def compare(path: Path, folder: str) -> list[str]:
    """Return the differences between a bank and a new build of it."""
    shipped = ScenarioBank(path)
    out = Path(folder) / path.name
    bank = build_bank(shipped.family, len(shipped), out, seed=shipped.seed, workers=os.cpu_count() or 1, progress=False)
    found = []
    if list(bank) != list(shipped) or bank.drawn != shipped.drawn or bank.rejected != shipped.rejected:
        return [f"{path.name}: other scenarios"]
    for name, tolerance in TOLERANCES.items():
        ours, theirs = getattr(bank, name), getattr(shipped, name)
        deviation = float(np.nanmax(np.abs(ours / theirs - 1)))
        if (np.isnan(ours) != np.isnan(theirs)).any() or deviation > tolerance:
            found.append(f"{path.name}: {name} deviate by {deviation:.1e}")
        print(f"{path.name}: largest relative deviation of {name}: {deviation:.1e}")
    for index in range(len(bank)):
        ours, theirs = bank.reference(index), shipped.reference(index)
        for name in ("states", "controls", "costates"):
            deviation = float(np.abs(getattr(ours, name) - getattr(theirs, name)).max())
            if deviation > PATH_TOLERANCE:
                found.append(f"{path.name}: scenario {index}: {name} deviate by {deviation:.1e}")
    print(f"{path.name}: bitwise identical: {out.read_bytes() == path.read_bytes()}", flush=True)
    return found


def main() -> int:
    names = sys.argv[1:] or sorted(path.stem for path in BANK_DIRECTORY.glob("*.bank"))
    with tempfile.TemporaryDirectory() as folder:
        found = [line for name in names for line in compare(BANK_DIRECTORY / f"{name}.bank", folder)]
    print("\n".join(found) or f"{len(names)} banks agree")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
