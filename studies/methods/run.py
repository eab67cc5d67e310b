"""Methods on the same families with the same sensor, lidar alone: clones, DAgger and PPO, in several runs each.

python studies/methods/run.py                      # trains and scores all methods
python studies/methods/run.py open-bc clutter-ppo  # only these, and the clones from which they start

`configurations/` contains the complete settings of each method on each family, in the format of `config.json` of a
training run, and `results/` the episodes on the test split. A finished run is not repeated, an interrupted one resumes.
The clones of a family share their demonstrations, and DAgger and PPO start from the clone of the same seed. `--tiny`
trains with a tiny budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path
from typing import Any

from leapnav.envs import ScenarioBank

sys.path.append(str(Path(__file__).parents[1]))
from common import demonstrate, load, play, read_arguments, score_tables, train

HERE = Path(__file__).parent
TABLES = {"methods": "docs/results.md", "methods-runs": "docs/results.md"}
ROWS = {
    "bc": "clone",
    "dagger": "DAgger from the clone",
    "ppo": "PPO from scratch",
    "ppo-clone": "PPO from the clone",
}
TASKS = {"open": ("open", "fixed"), "clutter": ("clutter", "fixed"), "free-clutter": ("clutter", "free")}
PARTS = {f"{task}-{method}": (task, method) for task in TASKS for method in ROWS}
NAMES = tuple(PARTS)
SEEDS, DEMONSTRATIONS, DEMONSTRATION_SEED = 3, 2000, 60_000


def train_method(name: str, seed: int, runs: Path, *, tiny: bool) -> Path:
    """Train a method, or resume its run, and return the directory of the run."""
    task, method = PARTS[name]
    family, horizon = TASKS[task]
    given: dict[str, Any] = {}
    if method != "ppo":
        count, folder = 4 if tiny else DEMONSTRATIONS, runs / f"{task}-demonstrations"
        demonstrations = demonstrate(family, count, folder, seed=DEMONSTRATION_SEED, tiny=tiny, horizon=horizon)
        if method == "bc":
            given = {"demos": (demonstrations,)}
        else:
            clone = train_method(f"{task}-bc", seed, runs, tiny=tiny)
            given = {"policy": clone, "demos": (demonstrations,)}
            if method == "ppo-clone":
                given = {"warm_start": (clone, demonstrations)}
    return train(HERE / "configurations" / f"{name}.json", runs / f"{name}-{seed}", tiny=tiny, seed=seed, **given)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    titles = {
        task: family if horizon == "fixed" else f"{family}, free horizon" for task, (family, horizon) in TASKS.items()
    }
    labels = {name: f"{titles[task]} | {ROWS[method]}" for name, (task, method) in PARTS.items()}
    return dict(zip(TABLES, score_tables(results, "family | method", labels), strict=True))


def main() -> None:
    """Train and score the named methods."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, seeds = arguments.tiny, range(2 if arguments.tiny else SEEDS)
    for name in arguments.names:
        runs = [train_method(name, seed, arguments.runs / "methods", tiny=tiny) for seed in seeds]
        family, horizon = TASKS[PARTS[name][0]]
        bank = ScenarioBank.shipped(family, "test", horizon=horizon)
        play(map(load, runs), [bank], arguments.results, name, count=2 if tiny else None, progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
