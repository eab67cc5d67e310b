"""Direct transcription of a scenario's problem: local optima of a discretisation, in about 0.2 ms each.

The controls are constant on each interval and move the robot along exact circular arcs; the proximity cost is
integrated by the trapezoidal rule. The discretised problem is solved by sequential quadratic programming. Each step is
computed by a Riccati recursion, linear in the number of intervals, with multipliers for the end conditions (A. E.
Bryson and Y.-C. Ho, Applied Optimal Control, 1975, section 5.3). The Hessian is exact, and shifted until the recursion
shows that it is positive definite, so that steps descend and leave saddle points. The line search uses the augmented
Lagrangian, which does not stall on curved constraints as a penalty function does (J. Nocedal and S. J. Wright,
Numerical Optimization, 2nd ed., ch. 15, 17 and 18).

The result is not an extremal: the error of its cost is quadratic in the interval, about 1e-3 by default. It ranks paths
and identifies duplicates, and its multipliers are costates from which multiple shooting converges in three or four
Newton steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.descent import descend
from leapnav.experts.search.transcription import DiscreteProblem

INTERVALS_PER_STEP = 2.0  # intervals per step of a lattice path (0.2 to 0.45 m)
MIN_INTERVALS, MAX_INTERVALS = 32, 1024
MAX_ITERATIONS = 40
STEP_TOLERANCE = 1e-3  # m and rad, less on short paths; the iteration has converged when a full step is smaller


@dataclass(frozen=True)
class DirectPath:
    """A solution of the discretised problem.

    Attributes:
        times: (N + 1,), s.
        states: (N + 1, 3), x, y (m) and heading (rad).
        controls: (N, 2), speed (m/s) and turn rate (rad/s), constant on each interval.
        costates: (N + 1, 3).
        cost: J of the discretised problem.
        violation: sum of the constraint violations.
        converged: whether the iteration converged.

    """

    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    cost: float
    violation: float
    converged: bool

    def refined(self) -> DirectPath:
        """Return the path with every interval halved, as an initial guess of the finer discretisation."""
        times = np.interp(np.arange(2 * len(self.controls) + 1) / 2, np.arange(len(self.times)), self.times)
        states, costates = (
            np.stack([np.interp(times, self.times, column) for column in array.T], axis=1)
            for array in (self.states, self.costates)
        )
        controls = np.repeat(self.controls, 2, axis=0)
        return DirectPath(times, states, controls, costates, self.cost, self.violation, False)


def discretise(path: Trajectory) -> DirectPath:
    """Return an initial guess from a lattice path: equal intervals, controls that follow it, and zero costates."""
    intervals = int(np.clip(INTERVALS_PER_STEP * (len(path.times) - 1), MIN_INTERVALS, MAX_INTERVALS))
    times = np.linspace(0.0, path.times[-1], intervals + 1)
    states = path.resample(times).states
    step = np.diff(states, axis=0)
    heading = (states[1:, 2] + states[:-1, 2]) / 2
    controls = np.column_stack([step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading), step[:, 2]])
    controls /= np.diff(times)[:, None]
    return DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False)


def optimise(problem: OptimalControlProblem, guess: DirectPath) -> DirectPath:
    """Compute a local optimum of the discretised problem from a guess.

    Args:
        problem: the problem of a scenario, with the winding of the goal heading chosen.
        guess: initial guess; its states, controls and costates need not be consistent.

    """
    arrays = problem.arrays
    speed_weight = problem.control_weight[0]
    states, controls, costates = guess.states.copy(), guess.controls.copy(), guess.costates / speed_weight
    states[0] = arrays.start
    scale = max(math.dist(problem.start[:2], arrays.goal[:2]) / 5.0, 0.1)
    task = DiscreteProblem(
        h=np.diff(guess.times),
        end=arrays.end,
        turn_weight=problem.control_weight[1] / speed_weight,
        unit=1.0 / speed_weight,
        limits=arrays.data[4:6],
        field=arrays.field,
    )
    tolerance = STEP_TOLERANCE * min(scale, 1.0)
    converged, cost, violation = descend(task, states, controls, costates, tolerance, MAX_ITERATIONS)
    return DirectPath(guess.times, states, controls, costates * speed_weight, cost * speed_weight, violation, converged)
