"""From an initial guess to a certified extremal: leapnav's methods, SciPy's solve_bvp and CasADi with IPOPT.

All start from the same lattice path of the same scenarios, alternating in one process. A solve of a peer counts as a
success if the solver reports one and the returned path is collision-free at dense points; a solve of leapnav only if it
is certified. "Equal accuracy" of solve_bvp is the tolerance at which its solutions pass leapnav's certificate. A second
part measures the time against the numbers of obstacles and segments and the horizon.
"""

import argparse
import gc
import math
import statistics
import time
from collections.abc import Callable

import numpy as np
from peers import Result, bvp, ipopt, line_guess, path_guess, transcription
from rich.console import Console
from rich.table import Table

from leapnav.envs import Scenario, sample_scenario
from leapnav.experts import OptimalControlProblem, Trajectory, find_optimum, solve
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice

Run = Callable[[Scenario, Trajectory], Result]
ROUNDS = 9  # repetitions of a scaling measurement; the median is printed


def leapnav_method(method: str) -> Run:
    def run(scenario: Scenario, path: Trajectory) -> Result:
        start = time.perf_counter()
        extremal = solve(scenario, method=method, guess=path)
        return Result(extremal.success, extremal.cost, time.perf_counter() - start)

    return run


def with_bvp(guess: Callable[..., tuple[np.ndarray, np.ndarray]], tol: float, zero: bool, compiled: bool) -> Run:
    def run(scenario: Scenario, path: Trajectory) -> Result:
        states, costates = guess(scenario, path)
        return bvp(scenario, states, 0.0 * costates if zero else costates, tol, compiled)

    return run


def peers() -> dict[str, Run]:
    line = lambda scenario, _: line_guess(scenario)  # noqa: E731
    return {
        "IPOPT, 50 intervals": lambda s, p: ipopt(s, p, 50),
        "IPOPT, 50 intervals, prebuilt": lambda s, p: ipopt(s, p, 50, prebuilt=True),
        "IPOPT, 200 intervals": lambda s, p: ipopt(s, p, 200),
        "IPOPT, 200 intervals, prebuilt": lambda s, p: ipopt(s, p, 200, prebuilt=True),
        "solve_bvp, straight line, zero costates": with_bvp(line, 1e-6, True, False),
        "solve_bvp, straight line, estimated costates": with_bvp(line, 1e-6, False, False),
        "solve_bvp, path, zero costates": with_bvp(path_guess, 1e-6, True, False),
        "solve_bvp, path, estimated costates": with_bvp(path_guess, 1e-6, False, False),
        "solve_bvp, path, estimated costates, equal accuracy": with_bvp(path_guess, 1e-8, False, False),
        "solve_bvp with leapnav's flow and Jacobian": with_bvp(path_guess, 1e-6, False, True),
        "solve_bvp with leapnav's flow and Jacobian, equal accuracy": with_bvp(path_guess, 1e-8, False, True),
    }


def compare(count: int) -> None:
    scenarios = [sample_scenario("clutter", seed=seed) for seed in range(500, 500 + count)]
    own = {name: leapnav_method(name) for name in ("multiple_shooting", "leapfrog", "collocation", "single_shooting")}
    methods = own | peers()
    paths = []
    for scenario in scenarios:
        candidate = next(CandidateSearch(Lattice(scenario)).candidates())
        paths.append(Trajectory(candidate.times, candidate.poses))
        for intervals in (50, 200):  # builds the prebuilt problems
            transcription(len(scenario.obstacles), intervals)
    for run in own.values():
        run(scenarios[0], paths[0])  # loads the kernels
    results: dict[str, list[Result]] = {name: [] for name in methods}
    for scenario, path in zip(scenarios, paths, strict=True):
        for name, run in methods.items():
            results[name].append(run(scenario, path))
    best = statistics.median(r.seconds for r in results["multiple_shooting"])
    leapfrog = statistics.median(r.seconds for r in results["leapfrog"])
    table = Table(title=f"Path to extremal, {count} clutter scenarios (seeds from 500)")
    table.add_column("method")
    columns = ("success", "certified", "median ms", "/ multiple shooting", "/ leapfrog", "median cost error")
    for column in columns:
        table.add_column(column, justify="right")
    for name, rows in results.items():
        middle = statistics.median(r.seconds for r in rows)
        # Only solutions in the local minimum of multiple shooting; for others the difference is not an error.
        pairs = zip(rows, results["multiple_shooting"], strict=True)
        errors = [abs(r.cost / e.cost - 1) for r, e in pairs if r.success and e.success]
        errors = [error for error in errors if error < 0.02]
        certified = sum(r.certified if name not in own else r.success for r in rows)
        table.add_row(
            name,
            f"{sum(r.success for r in rows)} of {count}",
            str(certified),
            f"{1e3 * middle:.1f}",
            f"{middle / best:.1f}",
            f"{middle / leapfrog:.1f}",
            f"{statistics.median(errors):.0e}" if errors else "-",
        )
    Console(width=150).print(table)
    searches, optima = [], []
    find_optimum(scenarios[0])
    for scenario in scenarios:
        searches.append(timed(lambda scenario=scenario: next(CandidateSearch(Lattice(scenario)).candidates())))
        optima.append(timed(lambda scenario=scenario: find_optimum(scenario)))
    print(f"lattice search, median               {1e3 * statistics.median(searches):8.1f} ms")
    print(f"find_optimum, in total, median       {1e3 * statistics.median(optima):8.1f} ms")


def scaling() -> None:
    """Time against obstacles, horizon and segments. Ratios are relative to the first row of each table."""
    close = [(4.0, 4.5, 0.8), (6.0, 3.0, 0.5), (2.5, 6.0, 0.6), (7.0, 6.5, 0.5)]
    rng = np.random.default_rng(0)
    distant: list[tuple[float, float, float]] = []
    while len(distant) < 512:
        x, y = rng.uniform(1.0, 63.0, 2)
        if max(x, y) > 14.0:
            distant.append((x, y, 0.4))
    start, goal = (1.0, 1.0, 0.0), (8.0, 8.0, 1.5)
    rows = []
    path = None
    for count in (8, 16, 32, 64, 128, 256, 512):
        scenario = make(64.0, start, goal, 12.0, (close + distant)[:count])
        if path is None:
            path = lattice_path(scenario)
        rows.append((count, scenario, path, None))
    report("obstacles, four of them close to the path", rows)

    rows = []
    for horizon in (10, 20, 40, 80):
        # Driven at 0.7 m/s along the diagonal, with a constant number of discs per metre.
        size = 0.7 * horizon / math.sqrt(2) + 2.0
        discs = []
        for k in range(1, horizon // 4):
            middle = 1.0 + 4 * k * (size - 2.0) / horizon
            discs.append((middle + 0.3, middle - 0.3 * (-1) ** k, 0.4))
        scenario = make(size, (1.0, 1.0, 0.8), (size - 1.0, size - 1.0, 0.8), float(horizon), discs)
        rows.append((horizon, scenario, lattice_path(scenario), None))
    report("horizon (s), with a constant number of obstacles per second", rows)

    # From a converged solution, so that the number of iterations does not depend on the segments.
    extremal = solve(scenario, method="multiple_shooting", guess=rows[-1][2])
    rows = [(segments, scenario, extremal, segments) for segments in (16, 32, 64, 128, 256)]
    report("segments, in the last of these scenarios", rows)


def make(size: float, start: tuple, goal: tuple, horizon: float, discs: list) -> Scenario:
    obstacles = tuple({"circle": {"center": (x, y), "radius": r}} for x, y, r in discs)
    return Scenario(arena=(0.0, 0.0, size, size), start=start, goal=goal, horizon=horizon, obstacles=obstacles)


def lattice_path(scenario: Scenario) -> Trajectory:
    candidate = next(CandidateSearch(Lattice(scenario)).candidates())
    return Trajectory(candidate.times, candidate.poses)


def report(variable: str, rows: list) -> None:
    table = Table(title=f"Multiple shooting: time against {variable}")
    for column in (variable.split(",")[0], "status", "median ms", "ratio", "flow evaluations"):
        table.add_column(column, justify="right")
    first = None
    for value, scenario, guess, segments in rows:
        problem = OptimalControlProblem.from_scenario(scenario)
        kwargs = {"method": "multiple_shooting", "guess": guess, "segments": segments}
        extremal = solve(problem, **kwargs)
        gc.collect()
        middle = statistics.median(timed(lambda p=problem, k=kwargs: solve(p, **k)) for _ in range(ROUNDS))
        first = first or middle
        row = (
            str(value),
            extremal.status.name,
            f"{1e3 * middle:.2f}",
            f"{middle / first:.2f}",
            str(extremal.n_evaluations),
        )
        table.add_row(*row)
    Console(width=150).print(table)


def timed(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="number of clutter scenarios")
    compare(parser.parse_args().count)
    scaling()


if __name__ == "__main__":
    main()
