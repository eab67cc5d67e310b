"""SAC in `clutter` with lidar alone, from scratch and from a warm start, in several runs.

python studies/sac/run.py                # trains and scores all
python studies/sac/run.py scratch start  # only these

`configurations/` contains the complete settings, in the format of `config.json` of a training run, of which `ROWS`
changes some, and `results/` the episodes on the test split. The demonstrations are those of the study of methods. A
finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny budget, to try the script; it
needs `--out`.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from leapnav.envs import ScenarioBank
from leapnav.training import WarmStartConfig

sys.path.append(str(Path(__file__).parents[1]))
from common import demonstrate, load, play, read_arguments, score_tables, train

HERE = Path(__file__).parent
FAMILY, SEEDS = "clutter", 3
DEMONSTRATIONS, DEMONSTRATION_SEED = 2000, 60_000  # of the study of methods
TABLES = dict.fromkeys(("sac", "sac-runs"), "docs/results.md")


class Row(NamedTuple):
    """A row of the tables.

    Attributes:
        label: its name.
        settings: name of the file of the settings.
        changes: changes of the settings.

    """

    label: str
    settings: str
    changes: dict[str, Any] = {}  # noqa: RUF012 (never changed)


ROWS = {
    "scratch": Row("from scratch", "scratch"),
    "start": Row(
        "actor cloned, before the training",
        "warm",
        {"total_timesteps": 16, "learning_starts": 16, "start": WarmStartConfig(critic=False)},
    ),
    "clone": Row("actor cloned, critic fitted", "warm", {"demonstrations": 0.0, "imitation": 0.0}),
    "imitation": Row("the same, half of each batch is demonstrations, imitation 50", "warm"),
}
NAMES = tuple(ROWS)


def train_row(name: str, seed: int, runs: Path, *, tiny: bool) -> Path:
    """Train a run of a row, and return its directory."""
    row, folder = ROWS[name], runs / "methods" / f"{FAMILY}-demonstrations"
    given = dict(row.changes)
    if row.settings == "warm":
        count = 4 if tiny else DEMONSTRATIONS
        given["warm_start"] = (demonstrate(FAMILY, count, folder, seed=DEMONSTRATION_SEED, tiny=tiny),)
    if tiny and "start" in given:
        given["start"] = replace(given["start"], critic_epochs=1, slopes=50)
    if tiny:
        given.pop("total_timesteps", None)
    settings = HERE / "configurations" / f"{row.settings}.json"
    return train(settings, runs / "sac" / f"{name}-{seed}", tiny=tiny, seed=seed, **given)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    labels = {name: row.label for name, row in ROWS.items()}
    return dict(zip(TABLES, score_tables(results, "SAC", labels), strict=True))


def main() -> None:
    """Train and score the named rows."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, test = arguments.tiny, ScenarioBank.shipped(FAMILY, "test")
    for name in arguments.names:
        runs = [train_row(name, seed, arguments.runs, tiny=tiny) for seed in range(2 if tiny else SEEDS)]
        play(map(load, runs), [test], arguments.results, name, count=2 if tiny else None, progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
