"""A custom robot in ten lines of SymPy: a tractor with a trailer is parked 2 m to the side.

python examples/own_robot.py --plot trailer.png
"""

from pathlib import Path

import numpy as np
import sympy
import tyro

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, plot_extremal, solve

BAR_LENGTH = 1.0  # m, from the tractor to the trailer's axle


def main(plot: Path | None = None) -> None:
    """Park the tractor and its trailer.

    Args:
        plot: Picture of the solution (.png, .pdf or .svg).

    """
    x, y, heading, trailer = sympy.symbols("x y theta phi")
    tractor = ControlAffineSystem(
        state=(x, y, heading, trailer),
        drift=(0, 0, 0, 0),
        fields=((sympy.cos(heading), sympy.sin(heading), 0, sympy.sin(heading - trailer) / BAR_LENGTH), (0, 0, 1, 0)),
        angles=(heading, trailer),
    )
    # The cost of a large angle between tractor and trailer keeps the trailer from jackknifing.
    jackknife_cost = 0.2 / (1.05 + sympy.cos(heading - trailer)) ** 2
    problem = OptimalControlProblem(
        tractor,
        start=(0, 0, 0, 0),
        goal=(0, -2, 0, 0),
        horizon=10,
        control_weight=(1, 0.5),
        state_cost=jackknife_cost,
        control_bounds=((-1, 1), (-1.5, 1.5)),
    )
    extremal = solve(problem, raise_on_failure=True)
    angle = np.degrees(np.abs(extremal.states[:, 2] - extremal.states[:, 3]).max())
    print(f"{extremal.status.value}: J = {extremal.cost:.6f}; maximum angle at the hitch: {angle:.0f} degrees")
    if plot is not None:
        plot_extremal(extremal, plot)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
