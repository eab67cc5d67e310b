"""Offline reinforcement learning in `open` with lidar alone: BC, TD3+BC and IQL of d3rlpy on three datasets.

pip install --no-deps -r examples/requirements.txt
python studies/offline/run.py                        # records the datasets, trains and scores all
python studies/offline/run.py expert-bc mixed-iql    # only these

The datasets are episodes of the expert, of the planner `dwa`, and of random actions, `dwa` and the expert in turn. The
settings of the algorithms are those of `examples/offline_rl.py`; `results/` contains the episodes on the test split.
`--tiny` trains with a tiny budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path
from typing import Any

from leapnav.envs import ScenarioBank
from leapnav.training import record

sys.path.append(str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).parents[2] / "examples"))
from common import play, read_arguments, score_tables

HERE = Path(__file__).parent
FAMILY, SEEDS, STEPS = "open", 3, 10_000
EPISODES, SEED, NOISE = 500, 70_000, 0.1  # of each dataset
DATA = {"expert": ("expert",), "mixed": ("random", "dwa", "expert"), "dwa": ("dwa",)}
ALGORITHMS = {"bc": "BC", "td3+bc": "TD3+BC", "iql": "IQL"}
NAMES = tuple(f"{data}-{algorithm}" for data in DATA for algorithm in ALGORITHMS)
TABLES = dict.fromkeys(("offline", "offline-runs"), "docs/results.md")


def recorded(data: str, runs: Path, *, tiny: bool) -> Path:
    """Record a dataset, unless it exists, and return its directory."""
    folder = runs / "offline" / data
    if not folder.exists():
        count = 6 if tiny else EPISODES
        record(DATA[data], FAMILY, count, folder, name=data, seed=SEED, noise=NOISE, progress=not tiny)
    return folder


def learn(data: Path, algorithm: str, seed: int, *, tiny: bool) -> Any:
    """Train an algorithm on a dataset, and return its policy."""
    import d3rlpy
    from offline_rl import OfflinePolicy, fit, load

    d3rlpy.seed(seed)
    return OfflinePolicy(fit(load(data)[0], algorithm, 20 if tiny else STEPS))


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    parts = {name: name.partition("-") for name in NAMES}
    labels = {
        name: f"{', '.join(DATA[data])} | {ALGORITHMS[algorithm]}" for name, (data, _, algorithm) in parts.items()
    }
    return dict(zip(TABLES, score_tables(results, "episodes of | algorithm", labels), strict=True))


def main() -> None:
    """Train and score the named rows."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, test = arguments.tiny, ScenarioBank.shipped(FAMILY, "test")
    for name in arguments.names:
        data, _, algorithm = name.partition("-")
        folder = recorded(data, arguments.runs, tiny=tiny)
        policies = [(learn(folder, algorithm, seed, tiny=tiny), {}) for seed in range(2 if tiny else SEEDS)]
        count = 2 if tiny else None
        play(policies, [test], arguments.results, name, count=count, workers=1, progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
