"""A robot of one's own: a unicycle that pulls a wagon, registered from outside the package."""

import math
from typing import ClassVar, Literal

from leapnav.envs.kernels import kernel
from leapnav.envs.robots import Dynamics, Symmetry, Unicycle, register
from leapnav.envs.robots.arcs import advance_arc
from leapnav.envs.robots.base import ADVANCE_SIGNATURE, POSE

STEPS = 8  # Runge-Kutta steps per control period of 0.05 s; the error of the heading of the wagon is below 1e-9 rad


@kernel(ADVANCE_SIGNATURE)
def advance(q, u, h, parameters, new):
    heading, wagon, speed, turn_rate = q[2], q[3], u[0] / parameters[0], u[1]
    step = h / STEPS
    for k in range(STEPS):
        here = heading + turn_rate * step * k
        k1 = speed * math.sin(here - wagon)
        k2 = speed * math.sin(here + turn_rate * step / 2 - wagon - k1 * step / 2)
        k3 = speed * math.sin(here + turn_rate * step / 2 - wagon - k2 * step / 2)
        k4 = speed * math.sin(here + turn_rate * step - wagon - k3 * step)
        wagon += step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    new[0], new[1], new[2] = advance_arc(q[0], q[1], heading, u[0] * h, turn_rate * h)
    new[3] = wagon


@register
class Wagon(Unicycle):
    """A unicycle that pulls a wagon: q = (x, y, theta, theta_1) with theta_1' = v sin(theta - theta_1) / length."""

    state_names: ClassVar = (*POSE, "wagon_heading")
    state_units: ClassVar = ("m", "m", "rad", "rad")
    goal_motion: ClassVar = (None,)  # the heading of the wagon is free at the goal
    heading_states: ClassVar = ("wagon_heading",)
    mirror: ClassVar = Symmetry(motion=(-1,), controls=((1, 0), (0, -1)))
    reversal: ClassVar = None  # the wagon is not at the other end of the robot
    advance: ClassVar = advance
    is_kinematic: ClassVar = False

    model: Literal["wagon"] = "wagon"
    length: float = 0.6  # m, from the robot to the axle of the wagon

    @classmethod
    def dynamics(cls) -> Dynamics:
        import sympy as sp

        x, y, theta, wagon, length = sp.symbols("x y theta theta_1 length")
        forwards = (sp.cos(theta), sp.sin(theta), 0, sp.sin(theta - wagon) / length)
        return Dynamics((x, y, theta, wagon), (0, 0, 0, 0), (forwards, (0, 0, 1, 0)), parameters=(length,))

    def parameters(self, cost) -> tuple[float, ...]:
        return (self.length,)


if __name__ == "__main__":
    import argparse

    from leapnav.envs import sample_scenario
    from leapnav.experts import find_optimum, plot_extremal

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", default="wagon.png", help="picture of the optimum")
    arguments = parser.parse_args()
    scenario = sample_scenario("clutter", 3, robot="wagon")
    optimum = find_optimum(scenario)
    print(f"{optimum.status.value}: J = {optimum.cost:.6f}")
    plot_extremal(optimum, arguments.plot, scenario)
    print(f"wrote {arguments.plot}")
