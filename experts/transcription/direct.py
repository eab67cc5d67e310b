"""Direct transcription of a scenario's problem: local optima of a discretisation, in 0.2 to 2 ms each.

The controls are constant on each interval, and the state cost is integrated by the trapezoidal rule. The unicycle moves
along exact circular arcs (`arcs`), other robots by steps of the midpoint rule (`midpoint`). The discretised problem is
solved by sequential quadratic programming. Each step is computed by a Riccati recursion, linear in the number of
intervals, with multipliers for the end conditions (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, section
5.3). The Hessian is exact, and shifted until the recursion shows that it is positive definite, so that steps descend
and leave saddle points. The line search uses the augmented Lagrangian, which does not stall on curved constraints as a
penalty function does (J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., ch. 15, 17 and 18).

The result is not an extremal: the error of its cost is quadratic in the interval, about 1e-3 by default. It ranks paths
and identifies duplicates, and its multipliers are costates from which multiple shooting converges in three or four
Newton steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from leapnav.envs.shapes.field import with_weight
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.numerics.time_scaling import time_factor
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.problem.system import differential_drive, unicycle
from leapnav.experts.transcription import arcs, arcs_descent, descent, midpoint

INTERVALS_PER_STEP = 2.0  # intervals per step of a lattice path (0.2 to 0.45 m)
MIN_INTERVALS, MAX_INTERVALS = 32, 32_768
MAX_ITERATIONS = 40
# A path with n times as many intervals as this may take n times as many iterations, up to a limit.
INTERVALS_PER_LIMIT, MAX_LIMITS = 256, 16
MIN_GRAM = 1e-9  # keeps B'B regular where the fields are linearly dependent
HAMILTONIAN_POINTS = 9  # of a path, along which the Hamiltonian is almost constant
MIN_TIME_FACTOR = 0.8  # smallest factor by which a free horizon changes at once
# Distance (proximity scales) below which the relaxed barrier is a quadratic polynomial. With the proximity weight 0.1,
# 72 of 72 candidates among the walls of `slalom` led to an extremal, and 6 without relaxation; 1.0 gave the same.
RELAXED_DISTANCE = 0.5
STEP_TOLERANCE = 1e-3  # m and rad, less on short paths; the iteration has converged when a full step is smaller


@dataclass(frozen=True)
class DirectPath:
    """A solution of the discretised problem.

    Attributes:
        times: (N + 1,), s.
        states: (N + 1, n), x, y (m), heading (rad) and further states.
        controls: (N, m), constant on each interval.
        costates: (N + 1, n).
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

    def refined(self, pieces: np.ndarray | int = 2) -> DirectPath:
        """Return the path with intervals divided, as an initial guess of the finer discretisation.

        Args:
            pieces: number of parts of each interval, (N,) or the same for all.

        """
        pieces = np.broadcast_to(pieces, len(self.controls))
        index = np.repeat(np.arange(len(pieces)), pieces)
        first = np.cumsum(pieces) - pieces
        fractions = (np.arange(len(index)) - first[index]) / pieces[index]
        times = np.append(self.times[index] + fractions * np.diff(self.times)[index], self.times[-1])
        states, costates = (interpolate(times, self.times, array) for array in (self.states, self.costates))
        return DirectPath(times, states, self.controls[index], costates, self.cost, self.violation, False)

    def scaled(self, factor: float) -> DirectPath:
        """Return the path with all times multiplied by a factor, which keeps the cost of the path."""
        controls, costates = self.controls / factor, self.costates / factor
        return replace(self, times=factor * self.times, controls=controls, costates=costates)

    def time_factor(self, problem: OptimalControlProblem) -> float:
        """Return the factor of all times that reduces the cost, for a problem with a free horizon."""
        at = np.unique(np.linspace(0, len(self.times) - 1, HAMILTONIAN_POINTS).astype(int))
        z = np.concatenate([self.states[at], self.costates[at]], axis=1)
        values = hamiltonians(problem.arrays.flow, z)
        return time_factor(self.cost, float(np.trapezoid(values, self.times[at])), MIN_TIME_FACTOR)


def discretise(problem: OptimalControlProblem, path: Trajectory) -> DirectPath:
    """Return an initial guess from a path: equal intervals, controls that follow it best, and zero costates.

    Args:
        problem: the problem.
        path: states (N, n) at times (N,).

    """
    intervals = min(max(int(INTERVALS_PER_STEP * (len(path.times) - 1)), MIN_INTERVALS), MAX_INTERVALS)
    times = np.linspace(0.0, path.times[-1], intervals + 1)
    states = path.resample(times).states
    return DirectPath(
        times, states, _controls(problem, times, states), np.zeros_like(states), math.inf, math.inf, False
    )


def _controls(problem: OptimalControlProblem, times: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the controls (N, m) that follow the states (N + 1, n) best."""
    step, interval = states[1:] - states[:-1], (times[1:] - times[:-1])[:, None]
    if problem.system in (unicycle(), differential_drive()):
        heading, controls = (states[1:, 2] + states[:-1, 2]) / 2, np.empty((len(step), 2))
        controls[:, 0] = step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)
        controls[:, 1] = step[:, 2]
        controls /= interval
        return controls if problem.system == unicycle() else controls @ _wheels(problem).T
    return follow_controls(problem, (states[1:] + states[:-1]) / 2, step / interval)


def follow_controls(problem: OptimalControlProblem, states: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the controls (N, m) with which states (N, n) have given rates (N, n), in the least-squares sense."""
    drift, fields = problem.dynamics(states)
    gram = np.einsum("kij,kil->kjl", fields, fields) + MIN_GRAM * np.eye(fields.shape[2])
    return np.linalg.solve(gram, np.einsum("kij,ki->kj", fields, rates - drift)[:, :, None])[:, :, 0]


def mean_running_cost(problem: OptimalControlProblem, path: Trajectory) -> float:
    """Return the mean running cost (1/s) of the controls that follow a path best, without Phi."""
    direct = discretise(problem, path)
    effort = 0.5 * (direct.controls**2) @ np.array(problem.control_weight)
    return float(np.average(effort, weights=np.diff(direct.times))) + problem.time_weight


def optimise(
    problem: OptimalControlProblem,
    guess: DirectPath,
    max_iterations: int = MAX_ITERATIONS,
    cost_scale: float | None = None,
    relaxed_weight: float | None = None,
) -> DirectPath:
    """Compute a local optimum of the discretised problem from a guess.

    Args:
        problem: the problem of a scenario, with the winding of the goal heading chosen.
        guess: initial guess; its states, controls and costates need not be consistent.
        max_iterations: number of iterations after which the result has not converged, for a path of up to
            2 INTERVALS_PER_LIMIT intervals.
        cost_scale: weight of the squared speed, to which the penalty of the general transcription is relative; None for
            the weight of the first control. It changes the iterates, not the optimum, and has no effect on arcs.
        relaxed_weight: proximity weight, at least, with a relaxed barrier, from which a guess in collision moves out
            of the obstacles; None for the barrier of the problem.

    """
    max_iterations *= min(max(1, len(guess.controls) // INTERVALS_PER_LIMIT), MAX_LIMITS)
    arrays = problem.arrays
    scale = max(math.dist(problem.start[:2], arrays.goal[:2]) / 5.0, 0.1)
    tolerance = STEP_TOLERANCE * min(scale, 1.0)
    states, controls = guess.states.copy(), guess.controls.copy()
    states[0] = arrays.start
    field = arrays.field
    if relaxed_weight is not None and problem.field is not None:
        field = with_weight(field, max(relaxed_weight, problem.proximity_weight), RELAXED_DISTANCE)
    h = np.diff(guess.times)
    on_arcs = _on_arcs(problem)
    # The unit of the costs; the kernels of arcs assume that the weight of the squared speed is 1.
    unit = (cost_scale or problem.control_weight[0]) if on_arcs is None else on_arcs[0]
    costates = guess.costates / unit
    converged, cost, violation, within_limits = False, math.inf, math.inf, True
    if on_arcs is not None:
        _, turn_weight, limits, wheels = on_arcs
        motion = controls if wheels is None else np.ascontiguousarray(np.linalg.solve(wheels, controls.T).T)
        task = arcs.DiscreteProblem(h, arrays.end, turn_weight, 1.0 / unit, limits, field)
        converged, cost, violation = arcs_descent.descend(task, states, motion, costates, tolerance, max_iterations)
        cost += problem.time_weight * guess.times[-1] / unit
        controls = motion if wheels is None else motion @ wheels.T
        within_limits = wheels is None or bool((np.abs(controls) <= arrays.data[4:6] + 1e-9).all())
    if on_arcs is None or not within_limits:
        general = midpoint.DiscreteProblem(h, arrays.end, arrays.data, field, 1.0 / unit, *problem.compiled_dynamics)
        converged, cost, violation = descent.descend(general, states, controls, costates, tolerance, max_iterations)
    costates, cost = costates * unit, cost * unit
    return DirectPath(guess.times, states, controls, costates, cost, violation, converged)


def _on_arcs(problem: OptimalControlProblem) -> tuple[float, float, np.ndarray, np.ndarray | None] | None:
    """Return how a problem is that of a unicycle, whose limits may be wider; None if it is not.

    Returns:
        The speed weight, the turn weight divided by the speed weight, the limits (2,) of speed (m/s) and turn rate
        (rad/s), and the matrix (2, 2) that maps speed and turn rate to wheel speeds, None if the controls are speed and
        turn rate.

    """
    if problem.footprint is not None or problem.state_limits:
        return None
    limits = problem.arrays.data[4:6]
    first, second = problem.control_weight[:2]
    if problem.system == unicycle():
        return first, second / first, limits, None
    if problem.system == differential_drive() and first == second:
        track = problem.parameters[0]
        # The sum of the squared wheel speeds is 2 v^2 + track^2 omega^2 / 2.
        return 2 * first, track**2 / 4, np.array([limits.max(), 2 * limits.max() / track]), _wheels(problem)
    return None


def _wheels(problem: OptimalControlProblem) -> np.ndarray:
    """Return the matrix (2, 2) that maps speed and turn rate of a differential drive to wheel speeds."""
    track = problem.parameters[0]
    return np.array([[1.0, -track / 2], [1.0, track / 2]])
