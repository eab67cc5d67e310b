"""The included policies in other families than that of their training: each policy on the test splits of all families.

python studies/transfer/run.py                # scores all policies
python studies/transfer/run.py clutter-lidar  # only this one

`results/` contains the episodes. `--tiny` plays with a tiny budget, to try the script; it needs `--out`.
"""

import sys
from dataclasses import replace
from pathlib import Path

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.training import Score, read_episodes, score
from leapnav.training.scoring.reports import cell

sys.path.append(str(Path(__file__).parents[1]))
from common import load, play, read_arguments

HERE = Path(__file__).parent
# The policies of each table: those that know the map, and those with lidar alone.
POLICIES = {
    "transfer-map": ("clutter", "polygons", "rooms", "slalom", "all"),
    "transfer-lidar": ("open", "clutter-lidar", "polygons-lidar", "rooms-lidar", "slalom-lidar"),
}
NAMES = tuple(name for names in POLICIES.values() for name in names)
TABLES = dict.fromkeys(POLICIES, "docs/results.md")


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    head = f"| policy | {' | '.join(ALL_FAMILIES)} |\n|---{'|---' * len(ALL_FAMILIES)}|\n"
    texts = dict.fromkeys(POLICIES, head)
    for table, names in POLICIES.items():
        for name in names:
            path = results / f"{name}.jsonl.gz"
            if path.exists():
                ((_, (found,)),) = read_episodes(path).items()
                rows = []
                for family in ALL_FAMILIES:
                    episodes = tuple(episode for episode in found if episode.family == family)
                    rows.append(score(name, replace(found, episodes=episodes)))
                texts[table] += f"| `{name}` | {' | '.join(map(_cell, rows))} |\n"
    return texts


def _cell(row: Score) -> str:
    return f"{cell(row.success, 100, 1, 1)}, {row.soc.value:.3f}".replace("\n", " ")


def main() -> None:
    """Score the named policies."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    banks = [ScenarioBank.shipped(family, "test") for family in ALL_FAMILIES]
    count = 2 if arguments.tiny else None
    for name in arguments.names:
        play([load(Path(name))], banks, arguments.results, name, count=count, progress=not arguments.tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
