"""The four methods on one scenario, from the same path: what each finds, how fast, and Leapfrog's way there.

python examples/compare_methods.py --family polygons --index 3 --plot leapfrog.png
"""

from pathlib import Path
from time import perf_counter
from typing import get_args

import tyro
from rich.console import Console
from rich.table import Table

from leapnav.envs import ScenarioBank
from leapnav.experts import find_optimum, solve
from leapnav.experts.methods import Method


def main(family: str = "clutter", index: int = 0, plot: Path | None = None) -> None:
    """Solves a scenario of the test bank with every method.

    Args:
        family: open, clutter, polygons, rooms or slalom.
        index: of the scenario.
        plot: write a picture of Leapfrog's sweeps, without Newton's method to end them.

    """
    scenario = ScenarioBank.shipped(family, "test")[index]
    table = Table(title=scenario.name)
    for column in ("method", "status", "J", "residual", "iterations", "ms"):
        table.add_column(column, no_wrap=True)
    for method in get_args(Method):
        solve(scenario, method=method)  # what is compiled now need not be timed
        start = perf_counter()
        extremal = solve(scenario, method=method)
        milliseconds = 1000 * (perf_counter() - start)
        residual = "-" if extremal.certificate is None else f"{extremal.certificate.residual:.0e}"
        iterations = str(len(extremal.history))
        table.add_row(method, extremal.status.name, f"{extremal.cost:.9f}", residual, iterations, f"{milliseconds:.1f}")
    Console().print(table)
    print(f"the best of all paths: J = {find_optimum(scenario).cost:.9f}")
    if plot is not None:
        solve(scenario, method="leapfrog", polish=False).plot(plot)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
