"""How the times of a search and of a solve grow with the obstacles, the horizon and the number of segments.

Ratios are relative to the first row of each table. With `--figure`, they are plotted as well.
"""

import argparse
import gc
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from rich.console import Console
from rich.table import Table

from leapnav.envs import Scenario
from leapnav.experts import Extremal, OptimalControlProblem, Trajectory, find_optimum, solve
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice

matplotlib.use("svg")
import matplotlib.pyplot as plt

ROUNDS = 5  # of each measurement, whose median is printed
OBSTACLES, HORIZONS, SEGMENTS = (8, 16, 32, 64, 128, 256, 512), (10, 20, 40, 80), (16, 32, 64, 128, 256)
FIRST_DISCS = [(4.0, 4.5, 0.8), (6.0, 3.0, 0.5), (2.5, 6.0, 0.6), (7.0, 6.5, 0.5)]
NEAR, SMALL_RADIUS = (0.6, 2.5), 0.1  # m: distances of small discs from the path, and their radius
WIDTH_OF_NEAR = 16.0  # m, of the arena

Disc = tuple[float, float, float]


class Row(NamedTuple):
    """One measurement: the variable, median times (s) of a search and of a solve, and evaluations of the solve."""

    value: int
    search: float
    solve: float
    status: str
    evaluations: int


def make(size: float, start: tuple, goal: tuple, horizon: float, discs: list[Disc]) -> Scenario:
    obstacles = tuple({"circle": {"center": (x, y), "radius": r}} for x, y, r in discs)
    return Scenario(arena=(0.0, 0.0, size, size), start=start, goal=goal, horizon=horizon, obstacles=obstacles)


def distant_discs() -> list[Scenario]:
    """Four discs close to the path, the others more than 6 m away."""
    rng, discs = np.random.default_rng(0), list(FIRST_DISCS)
    while len(discs) < max(OBSTACLES):
        x, y = rng.uniform(1.0, 63.0, 2).tolist()
        if max(x, y) > 14.0:
            discs.append((x, y, 0.4))
    return [make(64.0, (1.0, 1.0, 0.0), (8.0, 8.0, 1.5), 12.0, discs[:count]) for count in OBSTACLES]


def near_discs() -> list[Scenario]:
    """All discs close to the path; the additional ones are small and at 0.6 to 2.5 m from it, which stays free."""
    discs = [*FIRST_DISCS, (9.0, 9.0, 0.5), (11.0, 7.0, 0.5), (8.0, 11.0, 0.5), (12.0, 12.0, 0.4)]
    size, ends = WIDTH_OF_NEAR, ((1.0, 1.0, 0.5), (14.5, 14.5, 0.8))
    optimum = find_optimum(make(size, *ends, 24.0, discs))
    path = optimum.interpolate(np.linspace(0.0, optimum.horizon, 400))[:, :2]
    rng = np.random.default_rng(0)
    while len(discs) < max(OBSTACLES):
        x, y = path[rng.integers(len(path))] + rng.normal(0.0, 1.2, 2)
        if NEAR[0] < np.hypot(*(path - (x, y)).T).min() < NEAR[1] and min(x, y) > 0.0 and max(x, y) < size:
            discs.append((float(x), float(y), SMALL_RADIUS))
    return [make(size, *ends, 24.0, discs[:count]) for count in OBSTACLES]


def long_paths() -> list[Scenario]:
    """Driven at 0.7 m/s along the diagonal, with a constant number of discs per metre."""
    scenarios = []
    for horizon in HORIZONS:
        size = 0.7 * horizon / math.sqrt(2) + 2.0
        discs = []
        for k in range(1, horizon // 4):
            middle = 1.0 + 4 * k * (size - 2.0) / horizon
            discs.append((middle + 0.3, middle - 0.3 * (-1) ** k, 0.4))
        scenarios.append(make(size, (1.0, 1.0, 0.8), (size - 1.0, size - 1.0, 0.8), float(horizon), discs))
    return scenarios


def measure(value: int, scenario: Scenario, guess: Trajectory | Extremal, segments: int | None = None) -> Row:
    problem = OptimalControlProblem.from_scenario(scenario)

    def solved() -> Extremal:
        return solve(problem, method="multiple_shooting", guess=guess, segments=segments)

    extremal = solved()
    searched = statistics.median(timed(lambda: find_optimum(scenario)) for _ in range(ROUNDS)) if not segments else 0.0
    seconds = statistics.median(timed(solved) for _ in range(ROUNDS))
    return Row(value, searched, seconds, extremal.status.name, extremal.n_evaluations)


def timed(run: Callable[[], object]) -> float:
    gc.collect()
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def report(variable: str, rows: list[Row]) -> None:
    table = Table(title=f"Time against {variable}")
    columns = ("find_optimum (ms)", "ratio", "multiple shooting (ms)", "ratio", "status", "flow evaluations")
    for column in (variable.split(",")[0], *columns):
        table.add_column(column, justify="right")
    for row in rows:
        searched = (f"{1e3 * row.search:.0f}", f"{row.search / rows[0].search:.2f}") if row.search else ("-", "-")
        solved = f"{1e3 * row.solve:.2f}", f"{row.solve / rows[0].solve:.2f}"
        table.add_row(str(row.value), *searched, *solved, row.status, str(row.evaluations))
    Console(width=150).print(table)


def lattice_path(scenario: Scenario) -> Trajectory:
    candidate = next(CandidateSearch(Lattice(scenario)).candidates())
    return Trajectory(candidate.times, candidate.poses)


def plot(near: list[Row], distant: list[Row], long: list[Row], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained")
    for rows, label in ((near, "all near the path"), (distant, "four near the path")):
        values = [row.value for row in rows]
        left.loglog(values, [row.search / rows[0].search for row in rows], "o-", label=f"find_optimum, {label}")
        left.loglog(values, [row.solve / rows[0].solve for row in rows], "s:", label=f"multiple shooting, {label}")
    horizons = [row.value for row in long]
    right.loglog(horizons, [row.search / long[0].search for row in long], "o-", label="find_optimum")
    right.loglog(horizons, [row.solve / long[0].solve for row in long], "s:", label="multiple shooting")
    right.loglog(horizons, [value / horizons[0] for value in horizons], "--", color="gray", label="linear")
    for axes, variable, values in ((left, "obstacles", [r.value for r in near]), (right, "horizon (s)", horizons)):
        axes.set_xlabel(variable)
        axes.set_xticks(values, [str(value) for value in values], minor=False)
        axes.minorticks_off()
        axes.set_yticks([1, 2, 4, 8], ["1", "2", "4", "8"])
        axes.legend(fontsize=7)
        axes.grid(alpha=0.3)
    left.set_ylabel("time / time of the first")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path, help="picture of the ratios (.svg)")
    figure = parser.parse_args().figure
    # The guess of a solve is the first path of the lattice, so that it starts as a search does.
    near, distant, long = (
        [measure(value, scenario, lattice_path(scenario)) for value, scenario in zip(values, scenarios, strict=True)]
        for values, scenarios in ((OBSTACLES, near_discs()), (OBSTACLES, distant_discs()), (HORIZONS, long_paths()))
    )
    report("obstacles, all of them close to the path", near)
    report("obstacles, four of them close to the path", distant)
    report("horizon (s), with a constant number of obstacles per second", long)
    # From a converged solution, so that the number of iterations does not depend on the segments.
    scenario = long_paths()[-1]
    extremal = solve(scenario, method="multiple_shooting", guess=lattice_path(scenario))
    report("segments, in the last of these scenarios", [measure(n, scenario, extremal, n) for n in SEGMENTS])
    if figure is not None:
        plot(near, distant, long, figure)


if __name__ == "__main__":
    main()
