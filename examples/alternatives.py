"""The local optima of a difficult scenario: path class, driving modes, cost and clearance of each.

python examples/alternatives.py --plot optima.png
"""

from pathlib import Path

import tyro

from leapnav.envs import Scenario
from leapnav.experts import find_optimum, plot_extremal

# The direct path leads through a passage that is hardly wider than the robot; the goal must be reached backwards.
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
    """Find the optimum and its alternatives.

    Args:
        plot: Picture of the local optima (.png, .pdf or .svg).

    """
    optimum = find_optimum(SCENARIO)
    print(f"{SCENARIO.name}: {optimum.status.value}")
    for extremal in (optimum, *optimum.alternatives):
        sides = "".join(side[0].upper() for side in extremal.path_class)  # Left or Right of the path, by obstacle
        driving = ", ".join(extremal.driving_modes)
        assert extremal.certificate is not None
        print(f"J = {extremal.cost:8.4f}  clearance {extremal.certificate.clearance:.3f} m  {sides}  {driving}")
    for doubt in optimum.doubts:
        print(f"lower cost, but not certified: J = {doubt.cost:.4f}: {doubt.status.value}")
    if plot is not None:
        plot_extremal(optimum, plot, SCENARIO)
        print(f"wrote {plot}")


if __name__ == "__main__":
    tyro.cli(main)
