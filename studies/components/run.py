"""How many actions a network has: clones with one action and with a mixture of four, with lidar alone, several runs.

python studies/components/run.py            # trains and scores all
python studies/components/run.py clutter-4  # only this row

`configurations/` contains the complete settings, in the format of `config.json` of a training run, and `results/` the
episodes on the test split. A finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny
budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path

from leapnav.envs import ScenarioBank

sys.path.append(str(Path(__file__).parents[1]))
from common import demonstrate, load, play, read_arguments, score_tables, train

HERE = Path(__file__).parent
DEMONSTRATIONS, DEMONSTRATION_SEED, SEEDS = 1000, 63_000, 5
ROWS = {f"{family}-{count}": f"`{family}` | {count}" for family in ("clutter", "rooms") for count in (1, 4)}
NAMES = tuple(ROWS)
TABLES = dict.fromkeys(("components", "components-runs"), "docs/training.md")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    return dict(zip(TABLES, score_tables(results, "family | actions", ROWS), strict=True))


def main() -> None:
    """Train and score clones with the named numbers of actions."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, runs = arguments.tiny, arguments.runs / "components"
    for name in arguments.names:
        family = name.rpartition("-")[0]
        count = 4 if tiny else DEMONSTRATIONS
        demos = demonstrate(family, count, runs / f"demonstrations-{family}", seed=DEMONSTRATION_SEED, tiny=tiny)
        settings = HERE / "configurations" / f"{name}.json"
        clones = [
            train(settings, runs / f"{name}-{seed}", tiny=tiny, seed=seed, demos=(demos,))
            for seed in range(2 if tiny else SEEDS)
        ]
        test = ScenarioBank.shipped(family, "test")
        play(map(load, clones), [test], arguments.results, name, count=2 if tiny else None, progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
