"""Success of a clone against the number of demonstrations: `clutter` with lidar alone, in several runs.

python studies/demonstrations/run.py           # trains and scores all
python studies/demonstrations/run.py 100 1000  # only clones of so many demonstrations

`configurations/clutter.json` contains the complete settings, in the format of `config.json` of a training run, and
`results/` the episodes in fresh scenarios. Larger sets of demonstrations contain the smaller ones. The runs share them.
A finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny budget, to try the script; it
needs `--out`.
"""

import sys
from itertools import pairwise
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
from common import demonstrate, fresh_bank, load, play, read_arguments, score_tables, train

HERE = Path(__file__).parent
FAMILY, COUNTS, SCENARIOS = "clutter", (100, 300, 1000, 3000, 10_000, 30_000), 1000
SEEDS, DEMONSTRATION_SEED, SEED_DISTANCE = 3, 61_000, 100_000  # distance: of the seeds of two directories
NAMES = tuple(map(str, COUNTS))
TABLES = {"demonstrations": "docs/results.md", "demonstrations-runs": "docs/results.md"}


def demonstrations(count: int, runs: Path, *, tiny: bool) -> tuple[Path, ...]:
    """Record demonstrations, in one directory for each of the smaller numbers, and return the directories."""
    folders = []
    for number, (before, following) in enumerate(pairwise((0, *COUNTS))):
        if following <= count:
            size, folder = 4 if tiny else following - before, runs / f"demonstrations-{following}"
            folders.append(
                demonstrate(FAMILY, size, folder, seed=DEMONSTRATION_SEED + number * SEED_DISTANCE, tiny=tiny)
            )
    return tuple(folders)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    labels = {name: f"{int(name):,}" for name in NAMES}
    return dict(zip(TABLES, score_tables(results, "demonstrations", labels), strict=True))


def main() -> None:
    """Train and score clones of the given numbers of demonstrations."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, runs = arguments.tiny, arguments.runs / "demonstrations"
    bank = fresh_bank(arguments.runs, FAMILY, 2 if tiny else SCENARIOS, tiny=tiny)
    for name in arguments.names:
        demos = demonstrations(int(name), runs, tiny=tiny)
        clones = [
            train(HERE / "configurations/clutter.json", runs / f"{name}-{seed}", tiny=tiny, seed=seed, demos=demos)
            for seed in range(2 if tiny else SEEDS)
        ]
        play(map(load, clones), [bank], arguments.results, name, progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
