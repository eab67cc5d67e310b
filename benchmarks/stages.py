"""Where `find_optimum` spends its time: the stages of the search, for each family and each robot.

    python benchmarks/stages.py [--count N]

The stages are timed by wrapping their functions, which takes less than 1 % of the time. The rest is Python between
kernels. The columns with effort="medium", on the same scenarios in the same run, show the search for the best path
only, and that its cost is the same.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

from rich.console import Console
from rich.table import Table

from leapnav.envs import Scenario, sample_scenario
from leapnav.envs.scenarios.families import FAMILIES
from leapnav.experts import find_optimum
from leapnav.experts import optimum as search
from leapnav.experts.search import local_optima

STAGES = {
    "lattice": ((search, "Lattice"), (search, "CandidateSearch"), (search, "plane_lattice"), (search, "PlaneSearch")),
    "transcription": ((local_optima, "optimise"),),
    "Newton": ((local_optima, "polish_in_stages"),),
    "certificate": ((local_optima, "confirm"),),
}
ROBOTS = ("differential_drive", "car", "dynamic_unicycle")
COST_TOLERANCE = 1e-8  # relative; at vertices of polygons, costs are accurate to about 1e-9


def timed(function: Callable[..., Any], seconds: dict[str, float], stage: str) -> Callable[..., Any]:
    def wrapped(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            seconds[stage] += time.perf_counter() - start

    return wrapped


def measure(scenarios: list[Scenario]) -> tuple[dict[str, float], list[float], list[float]]:
    """Return the mean time (ms) of each stage, and the times (ms) of the search and of that for the best path only."""
    seconds = dict.fromkeys(STAGES, 0.0)
    whole, best = [], []
    find_optimum(scenarios[0])  # loads the kernels
    for scenario in scenarios:
        start = time.perf_counter()
        alone = find_optimum(scenario, "medium")
        best.append(1e3 * (time.perf_counter() - start))
        with ExitStack() as stack:
            for stage, functions in STAGES.items():
                for module, name in functions:
                    stack.enter_context(mock.patch.object(module, name, timed(getattr(module, name), seconds, stage)))
            start = time.perf_counter()
            optimum = find_optimum(scenario)
            whole.append(1e3 * (time.perf_counter() - start))
        if alone.cost > optimum.cost * (1 + COST_TOLERANCE):
            raise SystemExit(f"{scenario.name}: {alone.cost} without alternatives, {optimum.cost} with them")
    return {stage: 1e3 * seconds[stage] / len(scenarios) for stage in STAGES}, whole, best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=15, help="scenarios per row")
    count = parser.parse_args().count
    table = Table(title=f"Stages of find_optimum, {count} scenarios per row, one process (ms)")
    for column in ("family", "robot", *STAGES, "rest", "mean", "median", "effort=medium", "ratio"):
        table.add_column(column, justify="left" if column in ("family", "robot") else "right")
    rows = [(family, "unicycle") for family in FAMILIES] + [("clutter", robot) for robot in ROBOTS]
    for family, robot in rows:
        stages, whole, best = measure([sample_scenario(family, 800 + seed, robot) for seed in range(count)])
        mean, middle = statistics.mean(whole), statistics.median(best)
        times = (*stages.values(), mean - sum(stages.values()), mean, statistics.median(whole), middle)
        table.add_row(family, robot, *(f"{value:.1f}" for value in times), f"{middle / statistics.median(whole):.2f}")
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
