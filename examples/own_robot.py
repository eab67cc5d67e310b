"""A robot of your own in ten lines of SymPy: a tractor with a trailer is parked 2 m to the side.

python examples/own_robot.py --plot trailer.png
"""

from pathlib import Path

import numpy as np
import sympy
import tyro

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, solve

LENGTH = 1.0  # m, of the trailer's bar


def main(plot: Path | None = None) -> None:
    """Parks the tractor and its trailer.

    Args:
        plot: write a picture of the solution.

    """
    x, y, heading, trailer = sympy.symbols("x y theta phi")
    tractor = ControlAffineSystem(
        state=(x, y, heading, trailer),
        drift=(0, 0, 0, 0),
        fields=((sympy.cos(heading), sympy.sin(heading), 0, sympy.sin(heading - trailer) / LENGTH), (0, 0, 1, 0)),
        angles=(heading, trailer),
    )
    # A jackknifed trailer is dear: the angle between the two should stay below a right angle.
    jackknife = 0.2 / (1.05 + sympy.cos(heading - trailer)) ** 2
    problem = OptimalControlProblem(
        tractor,
        start=(0, 0, 0, 0),
        goal=(0, -2, 0, 0),
        horizon=10,
        control_weight=(1, 0.5),
        state_cost=jackknife,
        control_bounds=((-1, 1), (-1.5, 1.5)),
    )
    extremal = solve(problem, raise_on_failure=True)
    angle = np.degrees(np.abs(extremal.states[:, 2] - extremal.states[:, 3]).max())
    print(f"{extremal.status.value}: J = {extremal.cost:.6f}; largest angle at the hitch {angle:.0f} degrees")
    if plot is not None:
        extremal.plot(plot)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
