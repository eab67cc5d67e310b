"""Parts of a warm start: PPO and SAC in `clutter` with lidar alone, from scratch and from a clone, in several runs.

python studies/warm_start/run.py                     # trains and scores all
python studies/warm_start/run.py ppo-actor sac-clone # only these

`configurations/` contains the complete settings, in the format of `config.json` of a training run, of which `ROWS`
changes some, and `results/` the episodes on the test split. The clones from which PPO starts and the demonstrations are
those of the study of methods. A finished run is not repeated, an interrupted one resumes. `--tiny` trains with a tiny
budget, to try the script; it needs `--out`.
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
CLONE = HERE.parent / "methods/configurations/clutter-bc.json"
TABLES = dict.fromkeys(("warm-start", "warm-start-runs"), "docs/results.md")


class Row(NamedTuple):
    """A row of the tables.

    Attributes:
        label: its name.
        settings: name of the file of the settings; None for the clone itself.
        start: what the runs start from, of "clone" and "demonstrations".
        changes: changes of the settings.

    """

    label: str
    settings: str | None
    start: tuple[str, ...] = ()
    changes: dict[str, Any] = {}  # noqa: RUF012 (never changed)


NO_CRITIC = {"start": WarmStartConfig(critic=False)}
BOTH = ("clone", "demonstrations")
ROWS = {
    "clone": Row("clone, start of the runs of PPO", None),
    "ppo-scratch": Row("PPO from scratch", "ppo-scratch"),
    "ppo-critic": Row(
        "PPO from scratch, critic fitted to the cost-to-go and the costate",
        "ppo-scratch",
        ("demonstrations",),
        {"start": WarmStartConfig(actor=False)},
    ),
    "ppo-actor": Row("PPO, actor of the clone", "ppo", BOTH, {**NO_CRITIC, "critic_first": 0.0}),
    "ppo-actor-first": Row("PPO, actor of the clone; only the critic learns at first", "ppo", BOTH, NO_CRITIC),
    "ppo-value": Row(
        "PPO, actor of the clone, critic fitted to the cost-to-go",
        "ppo",
        BOTH,
        {"start": WarmStartConfig(gradient=False)},
    ),
    "ppo-costate": Row("PPO, actor of the clone, critic fitted to the cost-to-go and the costate", "ppo", BOTH),
    "sac-scratch": Row("SAC from scratch", "sac-scratch"),
    "sac-clone": Row(
        "SAC, actor cloned, critic fitted to the cost-to-go and the costate",
        "sac",
        ("demonstrations",),
        {"demonstrations": 0.0, "imitation": 0.0},
    ),
    "sac-imitation": Row("the same, half of each batch is demonstrations, imitation 50", "sac", ("demonstrations",)),
}
NAMES = tuple(ROWS)


def train_row(name: str, seed: int, runs: Path, *, tiny: bool) -> Path:
    """Train a run of a row, after that from which it starts, and return its directory."""
    row, methods, paths = ROWS[name], runs / "methods", {}
    if row.settings is None or row.start:
        count, folder = 4 if tiny else DEMONSTRATIONS, methods / f"{FAMILY}-demonstrations"
        demonstrations = demonstrate(FAMILY, count, folder, seed=DEMONSTRATION_SEED, tiny=tiny)
        paths["demonstrations"] = demonstrations
        if row.settings is None or "clone" in row.start:
            run = methods / f"{FAMILY}-bc-{seed}"
            paths["clone"] = train(CLONE, run, tiny=tiny, seed=seed, demos=(demonstrations,))
    if row.settings is None:
        return paths["clone"]
    given = {**row.changes, "warm_start": tuple(paths[one] for one in row.start)}
    if tiny and "start" in given:
        given["start"] = replace(given["start"], critic_epochs=1, slopes=50)
    settings = HERE / "configurations" / f"{row.settings}.json"
    return train(settings, runs / "warm_start" / f"{name}-{seed}", tiny=tiny, seed=seed, **given)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    labels = {name: row.label for name, row in ROWS.items()}
    return dict(zip(TABLES, score_tables(results, "start", labels), strict=True))


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
