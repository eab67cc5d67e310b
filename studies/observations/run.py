"""What a clone can observe: the same demonstrations of `rooms` with lidar, with memory and with the map, several runs.

python studies/observations/run.py           # trains and scores all
python studies/observations/run.py geodesic  # only this observation

`configurations/` contains the complete settings, in the format of `config.json` of a training run, and `results/` the
episodes on the test split. A finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny
budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
from common import read_arguments, score_clones, score_tables

HERE = Path(__file__).parent
FAMILY, DEMONSTRATIONS, DEMONSTRATION_SEED, SEEDS = "rooms", 1500, 62_000, 3
ROWS = {
    "lidar": "lidar",
    "memory": "lidar, also 0.4, 1.2 and 2.8 s before",
    "geodesic": "lidar and detours",
}
NAMES = tuple(ROWS)
TABLES = dict.fromkeys(("observations", "observations-runs"), "docs/training.md")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    return dict(zip(TABLES, score_tables(results, "observation", ROWS), strict=True))


def main() -> None:
    """Train and score clones with the named observations."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    demonstrations = {"demonstrations": DEMONSTRATIONS, "seed": DEMONSTRATION_SEED}
    score_clones(arguments, HERE, FAMILY, **demonstrations, runs=SEEDS)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
