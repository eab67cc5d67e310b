"""The four methods on one scenario, from the same initial guess: cost, residual, iterations and time of each.

python examples/compare_methods.py --family polygons --index 3 --plot leapfrog.png
"""

from pathlib import Path
from time import perf_counter
from typing import get_args

import tyro
from rich.console import Console
from rich.table import Table

from leapnav.envs import ScenarioBank
from leapnav.experts import find_optimum, plot_extremal, solve
from leapnav.experts.solve import Method


def main(family: str = "clutter", index: int = 0, plot: Path | None = None) -> None:
    """Solve a scenario of the test bank by every method.

    Args:
        family: Family of the scenario: open, clutter, polygons, rooms or slalom.
        index: Index of the scenario in the bank.
        plot: Picture of Leapfrog's sweeps (.png, .pdf or .svg), without the final Newton steps.

    """
    scenario = ScenarioBank.shipped(family, "test")[index]
    table = Table(title=scenario.name)
    for column in ("method", "status", "J", "residual", "iterations", "ms"):
        table.add_column(column, no_wrap=True)
    for method in get_args(Method):
        solve(scenario, method=method)  # loads or compiles the kernels, so that the next solve is timed without that
        start = perf_counter()
        extremal = solve(scenario, method=method)
        milliseconds = 1000 * (perf_counter() - start)
        residual = "-" if extremal.certificate is None else f"{extremal.certificate.residual:.0e}"
        iterations = str(len(extremal.history))
        table.add_row(
            method, extremal.status.name, f"{extremal.cost:.10g}", residual, iterations, f"{milliseconds:.1f}"
        )
    Console().print(table)
    print(f"optimum of the global search: J = {find_optimum(scenario).cost:.9f}")
    if plot is not None:
        plot_extremal(solve(scenario, method="leapfrog", polish=False), plot)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
