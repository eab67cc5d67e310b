"""Scenario to certified optimum: `find_optimum` beside IPOPT from the same candidates, and how building banks scales.

Every scenario is new to both. IPOPT (CasADi, trapezoidal transcription, 60 intervals) is built once per scenario, which
is counted separately, and started from each of the lattice's candidates that find_optimum takes; its best path is good
to about a thousandth and not certified.
"""

import argparse
import statistics
import tempfile
import time
from itertools import islice
from pathlib import Path as FilePath

import numpy as np
from rich.console import Console
from rich.table import Table

from leapnav.envs import FAMILIES, sample_scenario
from leapnav.envs.obstacles import clearances
from leapnav.experts import OptimalControlProblem, Path, build_bank, find_optimum
from leapnav.experts.direct import discretise, optimise
from leapnav.experts.ipopt import Transcription
from leapnav.experts.lattice import Lattice

CANDIDATES, INTERVALS = 12, 60
SAME = 5e-3  # relative, of costs: IPOPT's discretisation


def compare(count: int) -> None:
    table = Table(title=f"Scenario to optimum, {count} of each family, median ms, one process")
    table.add_column("family")
    for column in ("find_optimum", "95 %", "certified", "IPOPT", "x", "with building", "x", "same optimum", "cheaper"):
        table.add_column(column, justify="right")
    find_optimum(sample_scenario("clutter", 0))  # loads the compiled code
    for family in FAMILIES:
        ours, theirs, built, costs, others = [], [], [], [], []
        for seed in range(700, 700 + count):
            scenario = sample_scenario(family, seed)
            start = time.perf_counter()
            optimum = find_optimum(scenario)
            ours.append(time.perf_counter() - start)
            costs.append(optimum.cost)
            start = time.perf_counter()
            transcription = Transcription(scenario, INTERVALS)
            building = time.perf_counter() - start
            cost, seconds = ipopt(scenario, transcription)
            theirs.append(seconds)
            built.append(seconds + building)
            others.append(cost)
        ratio = np.array(others) / np.array(costs)
        middle = statistics.median(ours)
        table.add_row(
            family,
            f"{1e3 * middle:.1f}",
            f"{1e3 * np.percentile(ours, 95):.1f}",
            f"{np.isfinite(costs).sum()} of {count}",
            f"{1e3 * statistics.median(theirs):.0f}",
            f"{statistics.median(theirs) / middle:.0f}",
            f"{1e3 * statistics.median(built):.0f}",
            f"{statistics.median(built) / middle:.0f}",
            str(int((np.abs(ratio - 1) <= SAME).sum())),
            str(int((ratio < 1 - SAME).sum())),
        )
    Console(width=150).print(table)


def ipopt(scenario, transcription: Transcription) -> tuple[float, float]:
    """Cost of the best collision-free path from all candidates, and the seconds that IPOPT took."""
    best, seconds = np.inf, 0.0
    whole = OptimalControlProblem.from_scenario(scenario)
    for candidate in islice(Lattice(scenario).candidates(), CANDIDATES):
        path = Path(candidate.times, candidate.poses)
        problem = whole.with_winding_of(path.states)
        start = time.perf_counter()
        solution = transcription.solve(problem, path)
        seconds += time.perf_counter() - start
        if solution is not None and clearances(np.ascontiguousarray(solution.states), scenario.field).min() > 0:
            # Its cost as the direct path's next to it: the trapezoidal rule's own would be off by more.
            best = min(best, optimise(problem, discretise(solution)).cost)
    return best, seconds


def scaling(count: int) -> None:
    seconds = {}
    with tempfile.TemporaryDirectory() as scratch:
        for workers in (1, 2):
            # So that both measure the work, not the start of the processes.
            build_bank(
                "rooms", 2 * workers, FilePath(scratch) / f"start{workers}.bank", workers=workers, progress=False
            )
            start = time.perf_counter()
            build_bank("rooms", count, FilePath(scratch) / f"{workers}.bank", workers=workers, progress=False)
            seconds[workers] = time.perf_counter() - start
        same = len({(FilePath(scratch) / f"{workers}.bank").read_bytes() for workers in (1, 2)}) == 1
    rates = {workers: count / elapsed for workers, elapsed in seconds.items()}
    print(
        f"bank of {count} rooms: {rates[1]:.1f} scenarios/s with one process, {rates[2]:.1f} with two, "
        f"{rates[2] / rates[1]:.2f} times; {'the same' if same else 'NOT THE SAME'} file"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="scenarios of each family")
    parser.add_argument("--bank", type=int, default=500, help="scenarios of the bank")
    arguments = parser.parse_args()
    compare(arguments.count)
    scaling(arguments.bank)


if __name__ == "__main__":
    main()
