"""A hard scenario and its alternatives: which ways lead to the goal, what each costs, and why the best is the best.

python examples/alternatives.py --plot ways.png
"""

from pathlib import Path

import tyro

from leapnav.envs import Scenario
from leapnav.experts import find_optimum
from leapnav.experts.plotting import plot_solution

# A gate that is hardly wider than the robot, a way round it, and a goal to be reached backwards.
SCENARIO = Scenario.from_dict(
    {
        "name": "the gate",
        "arena": [0, 0, 10, 8],
        "start": [1, 4, 0],
        "goal": [8.5, 4, 3.141592653589793],
        "horizon": 14,
        "obstacles": [
            {"polygon": {"vertices": [[4.6, 0.9], [5.0, 0.9], [5.0, 3.66], [4.6, 3.66]]}},
            {"polygon": {"vertices": [[4.6, 4.34], [5.0, 4.34], [5.0, 6.6], [4.6, 6.6]]}},
            {"circle": {"center": [6.8, 4.3], "radius": 0.45}},
            {"circle": {"center": [2.8, 5.6], "radius": 0.5}},
        ],
    }
)


def main(plot: Path | None = None) -> None:
    """Finds all the ways.

    Args:
        plot: write a picture of them.

    """
    optimum = find_optimum(SCENARIO)
    print(f"{SCENARIO.name}: {optimum.status.value}")
    for extremal in (optimum, *optimum.alternatives):
        sides = "".join(side[0].upper() for side in extremal.path_class)  # where each obstacle lies, Left or Right
        driving = ", ".join(extremal.driving_modes)
        assert extremal.certificate is not None
        print(f"J = {extremal.cost:8.4f}  clearance {extremal.certificate.clearance:.3f} m  {sides}  {driving}")
    for doubt in optimum.doubts:
        print(f"cheaper, but no solution: J = {doubt.cost:.4f}: {doubt.status.value}")
    if plot is not None:
        plot_solution(SCENARIO, optimum, plot)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
