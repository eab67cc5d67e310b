"""The planners among the baselines on the test banks of all families at rest, and the choice of their constants.

python studies/planners/run.py         # scores, into results/
python studies/planners/run.py --tune  # scores of other constants on the training banks, one at a time

`--tiny` plays with a tiny budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path
from typing import Any

from leapnav.envs import ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.training import (
    Evaluation,
    PlannerPolicy,
    PolicyFactory,
    evaluate,
    read_episodes,
    score,
    write_episodes,
)
from leapnav.training.policies.planners import PLANNERS
from leapnav.training.scoring.policy_specs import load_policy_spec
from leapnav.training.scoring.reports import markdown_cells

sys.path.append(str(Path(__file__).parents[1]))
from common import read_arguments, workers

HERE = Path(__file__).parent
TABLES = {"planners": "docs/training.md"}
POLICIES = ("go-to-goal", *PLANNERS)
TINY, TUNING = 2, 40  # scenarios of each bank with a tiny budget, and for each value of a constant
# Values of the constants that were compared; those in use are among them.
VALUES: dict[str, dict[str, tuple[Any, ...]]] = {
    "dwa": {
        "LOOKAHEAD": (0.4, 0.6, 1.0),
        "CLEARANCE_WEIGHT": (0.05, 0.1, 0.2),
        "HEADING_WEIGHT": (0.08, 0.15, 0.3),
        "TURNING_TIME": (2.0, 2.5, 3.0),
    },
    "mppi": {
        "STEPS": (15, 20, 30),
        "NOISE": ((0.15, 0.4), (0.25, 0.6), (0.4, 1.0)),
        "TEMPERATURE": (0.05, 0.1, 0.2),
        "NEAR": (0.5, 1.0, 2.0),
    },
    "lattice": {
        "GAINS": ((5.0, 20.0, 6.0), (8.0, 40.0, 10.0), (8.0, 80.0, 16.0), (8.0, 120.0, 20.0)),
        "TURNING_TIME": (0.5, 0.7, 1.0, 1.5),
    },
}


def play(policies: list[str], results: Path, count: int | None) -> None:
    """Score policies on the test banks, and write the episodes."""
    for name in policies:
        found = []
        for family in ALL_FAMILIES:
            bank, policy = ScenarioBank.shipped(family, "test"), load_policy_spec(name).policy
            options = {"count": count, "timed": False, "workers": workers(), "progress": count is None}
            found += evaluate(policy, bank, **options).episodes
        write_episodes({name: [Evaluation(tuple(found), float("nan"))]}, results / f"{name}.jsonl.gz")


def tune(count: int) -> None:
    """Print the scores with other values of each constant."""
    print("| planner | constant | value | " + " | ".join(ALL_FAMILIES) + " |")
    print("|---|---|---|" + "---|" * len(ALL_FAMILIES))
    for name, constants in VALUES.items():
        for constant, values in constants.items():
            used = getattr(PLANNERS[name], constant)
            for value in values:
                setattr(PLANNERS[name], constant, value)
                policy, cells = PolicyFactory(lambda env, name=name: PlannerPolicy(env, name)), []
                for family in ALL_FAMILIES:
                    bank = ScenarioBank.shipped(family, "train")
                    found = evaluate(policy, bank, count=count, timed=False, progress=False)
                    cells.append(f"{100 * found.success:.0f} % {found.soc:.3f}")
                mark = " (in use)" if value == used else ""
                print(f"| {name} | {constant} | {value}{mark} | {' | '.join(cells)} |", flush=True)
            setattr(PLANNERS[name], constant, used)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    lines = [
        "| family | baseline | success (%) | collision (%) | SOC | regret, pose reached (%) |",
        "|---|---|---|---|---|---|",
    ]
    found = {name: runs for path in results.glob("*.jsonl.gz") for name, runs in read_episodes(path).items()}
    for family in ALL_FAMILIES:
        for name in (name for name in POLICIES if name in found):
            episodes = tuple(episode for episode in found[name][0] if episode.family == family)
            row = score(name, Evaluation(episodes, float("nan")))
            lines.append(f"| {family} | `{name}` | {markdown_cells(row)} |")
    return {"planners": "\n".join(lines) + "\n"}


def main() -> None:
    """Score the planners, or compare their constants."""
    arguments = read_arguments(__doc__, POLICIES, HERE, tune="compare the constants on the training banks")
    if arguments.tune:
        tune(TINY if arguments.tiny else TUNING)
        return
    play(arguments.names, arguments.results, TINY if arguments.tiny else None)
    print(tables(arguments.results)["planners"])


if __name__ == "__main__":
    main()
