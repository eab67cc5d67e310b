"""Lower bounds of the optimal cost: gaps and times of proofs and checks, compared with the second opinion.

    python benchmarks/lower_bounds.py [--count N] [--gap G] [--time-limit S] [--worlds N]

The second opinion searches with 100 times the effort of `find_optimum` and proves nothing; the ratio is the time of the
proof divided by its time, for the same scenario in the same run. Worlds are corridors with 250 discs of 0.075 m, as in
the BARN challenge. One process, one thread.
"""

import argparse
import math
import resource
import time
from collections.abc import Iterator
from itertools import count as integers
from itertools import islice

import numpy as np
from rich.console import Console
from rich.table import Table
from tqdm.auto import tqdm

from leapnav.envs import Scenario, ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import Optimum, check_proof, find_optimum, lower_bound
from leapnav.experts.second_opinion import second_opinion

WIDTH, LENGTH, CELL = 4.5, 9.0, 0.15  # of a world (m): grid cells are free or contain a disc
DISCS, MARGIN = 250, 1.5  # number of discs, and length of the free parts before and after them (m)


def world(seed: int) -> Scenario:
    """Return a corridor with discs in random clusters between start and goal; there may be no path."""
    rng = np.random.default_rng(seed)
    lines, columns = round((LENGTH - 2 * MARGIN) / CELL), round(WIDTH / CELL)
    # A smoothed random field: its largest values are the discs, in clusters of a few cells.
    noise = np.fft.rfft2(rng.normal(size=(lines, columns)))
    waves = np.hypot(np.fft.fftfreq(lines)[:, None], np.fft.rfftfreq(columns)[None, :])
    smooth = np.fft.irfft2(noise * np.exp(-((waves / 0.15) ** 2)), s=(lines, columns))
    chosen = np.argsort(smooth, axis=None)[-DISCS:]
    line, column = np.unravel_index(chosen, smooth.shape)
    discs = np.column_stack([(column + 0.5) * CELL, MARGIN + (line + 0.5) * CELL, np.full(DISCS, CELL / 2)])
    ends = (WIDTH / 2, MARGIN / 2, math.pi / 2), (WIDTH / 2, LENGTH - MARGIN / 2, math.pi / 2)
    return Scenario.from_discs(
        discs,
        start=ends[0],
        goal=ends[1],
        horizon=None,
        arena=(0.0, 0.0, WIDTH, LENGTH),
        cost={"time_weight": 0.5},
        robot={"radius": 0.2},
        name=f"world {seed}",
    )


def bank_cases(family: str, count: int) -> list[tuple[Scenario, Optimum]]:
    """Return scenarios of a test bank, evenly spaced, with their optima."""
    bank = ScenarioBank.shipped(family, "test")
    indices = np.linspace(0, len(bank) - 1, count).astype(int).tolist()
    return [(bank[i], find_optimum(bank[i])) for i in indices]


def world_cases() -> Iterator[tuple[Scenario, Optimum]]:
    """Generate worlds through which there is a path, with their optima."""
    for seed in integers():
        scenario = world(seed)
        optimum = find_optimum(scenario)
        if optimum.success:
            yield scenario, optimum


def measure(name: str, cases: list[tuple[Scenario, Optimum]], gap: float, time_limit: float) -> list[str]:
    """Return the row of the table for some scenarios."""
    gaps, times, checks, ratios = [], [], [], []
    for scenario, optimum in tqdm(cases, desc=name, leave=False):
        bound = lower_bound(scenario, optimum, gap, time_limit, threads=1)
        start = time.perf_counter()
        check_proof(bound.proof)
        middle = time.perf_counter()
        second_opinion(scenario)
        end = time.perf_counter()
        gaps.append(100 * bound.gap)
        times.append(bound.seconds)
        checks.append((middle - start) / bound.seconds)
        ratios.append(bound.seconds / (end - middle))
    proved = sum(value <= 100 * gap * (1 + 1e-6) for value in gaps)
    cells = [f"{np.median(values):.3g}, {np.percentile(values, 90):.3g}" for values in (gaps, times, checks, ratios)]
    return [name, f"{proved} of {len(cases)}", *cells]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1, help="scenarios of each test bank")
    parser.add_argument("--worlds", type=int, default=0, help="worlds with 250 discs")
    parser.add_argument("--gap", type=float, default=0.05, help="gap to prove; for the worlds twice as large")
    parser.add_argument("--time-limit", type=float, default=20.0, help="seconds; for the worlds twice as long")
    arguments = parser.parse_args()
    table = Table(title=f"gap {100 * arguments.gap:g} % in {arguments.time_limit:g} s: median, 90th percentile")
    for column in ("scenarios", "proved", "gap (%)", "proof (s)", "check / proof", "proof / second opinion"):
        table.add_column(column, justify="left" if column == "scenarios" else "right")
    for family in ALL_FAMILIES:
        cases = bank_cases(family, arguments.count)
        table.add_row(*measure(family, cases, arguments.gap, arguments.time_limit))
    if arguments.worlds > 0:
        worlds = list(islice(world_cases(), arguments.worlds))
        table.add_row(*measure("250 discs", worlds, 2 * arguments.gap, 2 * arguments.time_limit))
    console = Console()
    console.print(table)
    console.print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
