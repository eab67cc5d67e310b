"""From scenario to certified optimum: `find_optimum` compared with IPOPT, and the scaling of bank builds.

The scenarios are not in the banks. The IPOPT problem (CasADi, trapezoidal transcription, 60 intervals) is built once
per scenario, which is timed separately, and solved from each candidate of the lattice search that `find_optimum` uses.
Its best path is accurate to about 1e-3 and not certified. In scenes with hundreds of obstacles, which are sampled here,
IPOPT solves from the first candidate only, with 400 intervals; with fewer, paths cut through obstacles between nodes.
These take minutes and are compared with `--dense N` only.
"""

import argparse
import math
import statistics
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from leapnav.envs import Circle, Obstacle, Polygon, Scenario, Unicycle, sample_scenario
from leapnav.envs.field.clearance import clearances
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import OptimalControlProblem, Trajectory, build_bank, find_optimum
from leapnav.experts.ipopt import Transcription
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.transcription.direct import discretise, optimise

N_CANDIDATES, N_INTERVALS = 12, 60
COST_TOLERANCE = 5e-3  # relative; the discretisation error of IPOPT's cost
DENSE_OBSTACLES = {"discs": 300, "polygons": 200}
DENSE_COVERAGE, DENSE_INTERVALS = 0.12, 400  # coverage: fraction of the arena


def compare(count: int) -> None:
    table = Table(title=f"Scenario to optimum, {count} scenarios per family, median time (ms), one process")
    table.add_column("family")
    columns = "find_optimum", "95 %", "certified", "IPOPT", "ratio", "with build", "ratio", "same cost", "lower cost"
    for column in columns:
        table.add_column(column, justify="right")
    find_optimum(sample_scenario("clutter", 0))  # loads the kernels
    for family in ALL_FAMILIES:
        ours, theirs, built, costs, others = [], [], [], [], []
        for seed in range(700, 700 + count):
            scenario = sample_scenario(family, seed)
            start = time.perf_counter()
            optimum = find_optimum(scenario)
            ours.append(time.perf_counter() - start)
            costs.append(optimum.cost)
            start = time.perf_counter()
            transcription = Transcription(scenario, OptimalControlProblem.from_scenario(scenario), N_INTERVALS)
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
            str(int((np.abs(ratio - 1) <= COST_TOLERANCE).sum())),
            str(int((ratio < 1 - COST_TOLERANCE).sum())),
        )
    Console(width=150).print(table)


def dense_scenario(kind: str, size: float, seed: int) -> Scenario:
    """A random scenario with 300 discs or 200 polygons in a square arena of side `size` (m), from corner to corner."""
    rng = np.random.default_rng(seed)
    start, goal = ((x, x, float(rng.uniform(-math.pi, math.pi))) for x in (1.0, size - 1.0))
    mean_radius = (
        size * math.sqrt(DENSE_COVERAGE / DENSE_OBSTACLES[kind] / math.pi) * (1.0 if kind == "discs" else 1.25)
    )
    obstacles: list[Obstacle] = []
    while len(obstacles) < DENSE_OBSTACLES[kind]:
        centre, radius = rng.uniform(0.0, size, 2), float(mean_radius * rng.uniform(0.5, 1.4))
        if min(math.dist(centre, start[:2]), math.dist(centre, goal[:2])) < radius + 0.5:
            continue
        if kind == "discs":
            obstacles.append(Obstacle(circle=Circle(center=tuple(centre.tolist()), radius=radius)))
            continue
        angles = np.zeros(2)
        while np.diff(angles, append=angles[0] + 2 * math.pi).max() > 2.6:  # neither thin nor beside its centre
            angles = np.sort(rng.uniform(0.0, 2 * math.pi, rng.integers(3, 7)))
        points = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        obstacles.append(Obstacle(polygon=Polygon(vertices=tuple(map(tuple, points.tolist())))))
    arena = (0.0, 0.0, size, size)
    return Scenario(
        arena=arena, start=start, goal=goal, horizon=size, obstacles=tuple(obstacles), robot=Unicycle(radius=0.2)
    )


def compare_dense(count: int) -> None:
    table = Table(title=f"300 discs or 200 polygons, {count} scenarios per arena size, median time (s), one process")
    table.add_column("obstacles")
    columns = "arena (m)", "find_optimum", "maximum", "certified", "local optima", "IPOPT, one path", "ratio", "build"
    for column in columns:
        table.add_column(column, justify="right")
    for kind in DENSE_OBSTACLES:
        for size in (20.0, 30.0):
            ours, theirs, built, found = [], [], [], []
            for seed in range(count):
                scenario = dense_scenario(kind, size, seed)
                start = time.perf_counter()
                optimum = find_optimum(scenario)
                ours.append(time.perf_counter() - start)
                found.append((1 + len(optimum.alternatives)) if optimum.success else 0)
                start = time.perf_counter()
                transcription = Transcription(scenario, OptimalControlProblem.from_scenario(scenario), DENSE_INTERVALS)
                built.append(time.perf_counter() - start)
                theirs.append(ipopt(scenario, transcription, 1)[1])
            middle, other = statistics.median(ours), statistics.median(theirs)
            table.add_row(
                f"{DENSE_OBSTACLES[kind]} {kind}",
                f"{size:.0f}",
                f"{middle:.2f}",
                f"{max(ours):.2f}",
                f"{sum(map(bool, found))} of {count}",
                f"{np.mean(found):.1f}",
                f"{other:.1f}",
                f"{other / middle:.1f}",
                f"{statistics.median(built):.0f}",
            )
    Console(width=150).print(table)


def ipopt(scenario, transcription: Transcription, candidates: int = N_CANDIDATES) -> tuple[float, float]:
    """Cost of the best collision-free path from all candidates, and the time of IPOPT (s)."""
    best, seconds = np.inf, 0.0
    unwound = OptimalControlProblem.from_scenario(scenario)
    for candidate in islice(CandidateSearch(Lattice(scenario)).candidates(), candidates):
        path = Trajectory(candidate.times, candidate.poses)
        problem = unwound.with_winding_of(path.states)
        start = time.perf_counter()
        solution = transcription.solve(problem, path)
        seconds += time.perf_counter() - start
        if solution is not None and clearances(np.ascontiguousarray(solution.states), scenario.field).min() > 0:
            # The cost of the nearest path of the direct transcription has a smaller error than the trapezoidal rule.
            best = min(best, optimise(problem, discretise(problem, solution)).cost)
    return best, seconds


def scaling(count: int) -> None:
    seconds = {}
    with tempfile.TemporaryDirectory() as scratch:
        for workers in (1, 2):
            # A small bank first, so that the start of the processes is not timed.
            build_bank("rooms", 2 * workers, Path(scratch) / f"start{workers}.bank", workers=workers, progress=False)
            start = time.perf_counter()
            build_bank("rooms", count, Path(scratch) / f"{workers}.bank", workers=workers, progress=False)
            seconds[workers] = time.perf_counter() - start
        is_identical = len({(Path(scratch) / f"{workers}.bank").read_bytes() for workers in (1, 2)}) == 1
    rates = {workers: count / elapsed for workers, elapsed in seconds.items()}
    print(
        f"bank of {count} rooms: {rates[1]:.1f} scenarios/s with one process, {rates[2]:.1f} with two, "
        f"ratio {rates[2] / rates[1]:.2f}; files {'identical' if is_identical else 'NOT IDENTICAL'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=5, help="number of scenarios per family")
    parser.add_argument("--bank", type=int, default=100, help="number of scenarios of the bank")
    parser.add_argument(
        "--dense", type=int, default=0, help="number of scenarios with hundreds of obstacles, per kind and arena size"
    )
    arguments = parser.parse_args()
    compare(arguments.count)
    if arguments.dense > 0:
        compare_dense(arguments.dense)
    scaling(arguments.bank)


if __name__ == "__main__":
    main()
