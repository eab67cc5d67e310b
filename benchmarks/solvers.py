"""From an initial guess to a certified extremal: leapnav's methods, SciPy's solve_bvp, CasADi with IPOPT and fatrop.

All start from the same lattice path of the same scenarios, alternating in one process. A solve of a peer counts as a
success if the solver reports one and the returned path is collision-free at dense points; a solve of leapnav only if it
is certified. "Equal accuracy" of solve_bvp is the tolerance at which its solutions pass leapnav's certificate.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from peers import Result, bvp, fatrop, ipopt, line_guess, path_guess, staged_transcription, transcription
from rich.console import Console
from rich.table import Table

from leapnav.envs import Scenario, sample_scenario
from leapnav.experts import Trajectory, find_optimum, solve
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.solve import Method

Run = Callable[[Scenario, Trajectory], Result]


def leapnav_method(method: Method) -> Run:
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
        "fatrop, 50 intervals, prebuilt": lambda s, p: fatrop(s, p, 50),
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
    names: tuple[Method, ...] = "multiple_shooting", "leapfrog", "collocation", "single_shooting"
    own = {name: leapnav_method(name) for name in names}
    methods = own | peers()
    paths = []
    for scenario in scenarios:
        candidate = next(CandidateSearch(Lattice(scenario)).candidates())
        paths.append(Trajectory(candidate.times, candidate.poses))
        for intervals in (50, 200):  # builds the prebuilt problems
            transcription(len(scenario.obstacles), intervals)
        staged_transcription(len(scenario.obstacles), 50)
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


def timed(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="number of clutter scenarios")
    compare(parser.parse_args().count)


if __name__ == "__main__":
    main()
