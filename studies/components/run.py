"""How many actions a network has: clones in `clutter` with one action and with a mixture of four, several runs.

python studies/components/run.py        # trains and scores all
python studies/components/run.py four   # only this row

`configurations/` contains the complete settings, in the format of `config.json` of a training run, and `results/` the
episodes on the test split. A finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny
budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
from common import read_arguments, score_clones, score_tables

HERE = Path(__file__).parent
FAMILY, DEMONSTRATIONS, DEMONSTRATION_SEED, SEEDS = "clutter", 1000, 63_000, 5
ROWS = {"one": "1", "four": "4"}
NAMES = tuple(ROWS)
TABLES = dict.fromkeys(("components", "components-runs"), "docs/training.md")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    return dict(zip(TABLES, score_tables(results, "actions", ROWS), strict=True))


def main() -> None:
    """Train and score clones with the named numbers of actions."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    demonstrations = {"demonstrations": DEMONSTRATIONS, "seed": DEMONSTRATION_SEED}
    score_clones(arguments, HERE, FAMILY, **demonstrations, runs=SEEDS)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
