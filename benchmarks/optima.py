"""Scenario to certified optimum: `find_optimum` beside IPOPT from the same candidates, and how building banks scales.

Every scenario is new to both. IPOPT (CasADi, trapezoidal transcription, 60 intervals) is built once per scenario, which
is counted separately, and started from each of the lattice's candidates that find_optimum takes; its best path is good
to about a thousandth and not certified. Among hundreds of obstacles (those scenarios are drawn here) it gets the first
candidate only, and 400 intervals, or it would cut through what it passes.
"""

import argparse
import math
import statistics
import tempfile
import time
from itertools import islice
from pathlib import Path as FilePath

import numpy as np
from rich.console import Console
from rich.table import Table

from leapnav.envs import FAMILIES, Robot, Scenario, sample_scenario
from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Circle, Obstacle, Polygon
from leapnav.experts import OptimalControlProblem, Path, build_bank, find_optimum
from leapnav.experts.direct import discretise, optimise
from leapnav.experts.ipopt import Transcription
from leapnav.experts.lattice import Lattice

CANDIDATES, INTERVALS = 12, 60
SAME = 5e-3  # relative, of costs: IPOPT's discretisation
CROWDS = {"discs": 300, "polygons": 200}
COVERED, CROWD_INTERVALS = 0.12, 400


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


def crowd(kind: str, size: float, seed: int) -> Scenario:
    """300 discs or 200 polygons at random in a square arena of this size (m), from corner to corner."""
    rng = np.random.default_rng(seed)
    start, goal = ((x, x, float(rng.uniform(-math.pi, math.pi))) for x in (1.0, size - 1.0))
    mean = size * math.sqrt(COVERED / CROWDS[kind] / math.pi) * (1.0 if kind == "discs" else 1.25)
    obstacles: list[Obstacle] = []
    while len(obstacles) < CROWDS[kind]:
        centre, radius = rng.uniform(0.0, size, 2), float(mean * rng.uniform(0.5, 1.4))
        if min(math.dist(centre, start[:2]), math.dist(centre, goal[:2])) < radius + 0.5:
            continue
        if kind == "discs":
            obstacles.append(Obstacle(circle=Circle(center=tuple(centre.tolist()), radius=radius)))
            continue
        angles = np.zeros(2)
        while np.diff(angles, append=angles[0] + 2 * math.pi).max() > 2.6:  # neither flat nor beside its centre
            angles = np.sort(rng.uniform(0.0, 2 * math.pi, rng.integers(3, 7)))
        points = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        obstacles.append(Obstacle(polygon=Polygon(vertices=tuple(map(tuple, points.tolist())))))
    arena = (0.0, 0.0, size, size)
    return Scenario(
        arena=arena, start=start, goal=goal, horizon=size, obstacles=tuple(obstacles), robot=Robot(radius=0.2)
    )


def compare_crowds(count: int) -> None:
    table = Table(title=f"300 discs or 200 polygons, {count} scenarios of each size, median s, one process")
    table.add_column("obstacles")
    columns = "arena (m)", "find_optimum", "slowest", "certified", "local optima", "IPOPT, one path", "x", "building"
    for column in columns:
        table.add_column(column, justify="right")
    for kind in CROWDS:
        for size in (20.0, 30.0):
            ours, theirs, built, found = [], [], [], []
            for seed in range(count):
                scenario = crowd(kind, size, seed)
                start = time.perf_counter()
                optimum = find_optimum(scenario)
                ours.append(time.perf_counter() - start)
                found.append((1 + len(optimum.alternatives)) if optimum.success else 0)
                start = time.perf_counter()
                transcription = Transcription(scenario, CROWD_INTERVALS)
                built.append(time.perf_counter() - start)
                theirs.append(ipopt(scenario, transcription, 1)[1])
            middle, other = statistics.median(ours), statistics.median(theirs)
            table.add_row(
                f"{CROWDS[kind]} {kind}",
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


def ipopt(scenario, transcription: Transcription, candidates: int = CANDIDATES) -> tuple[float, float]:
    """Cost of the best collision-free path from all candidates, and the seconds that IPOPT took."""
    best, seconds = np.inf, 0.0
    whole = OptimalControlProblem.from_scenario(scenario)
    for candidate in islice(Lattice(scenario).candidates(), candidates):
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
    parser.add_argument("--crowds", type=int, default=2, help="scenarios of hundreds of obstacles, of each size")
    arguments = parser.parse_args()
    compare(arguments.count)
    compare_crowds(arguments.crowds)
    scaling(arguments.bank)


if __name__ == "__main__":
    main()
