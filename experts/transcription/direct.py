"""Direct transcription of a problem: local optima of a discretisation, in 0.2 to 2 ms each.

The controls are constant on each interval, the dynamics are integrated by the explicit midpoint rule, the state cost by
the trapezoidal rule. The discretised problem is solved by sequential quadratic programming. Each step is computed by
a Riccati recursion, linear in the number of intervals, with multipliers for the end conditions (A. E. Bryson and Y.-C.
Ho, Applied Optimal Control, 1975, section 5.3). The Hessian is exact, and shifted until the recursion shows that it is
positive definite, so that steps descend and leave saddle points. A step follows the dynamics, with the feedback of the
recursion, so that a path that satisfies them keeps to them (C. Mastalli et al., Crocoddyl: an efficient and versatile
framework for multi-contact optimal control, ICRA 2020); where that is rejected, the linear step is tried. The line
search uses the augmented Lagrangian, which
does not stall on curved constraints as a penalty function does (J. Nocedal and S. J. Wright, Numerical Optimization,
2nd ed., ch. 15, 17 and 18).

The result is not an extremal: the error of its cost is quadratic in the interval, about 1e-3 by default. It ranks paths
and identifies duplicates, and its multipliers are costates from which multiple shooting converges in three or four
Newton steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from leapnav.envs.field.packing import with_weight
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.numerics.time_scaling import time_factor
from leapnav.experts.problem.dynamics import controls_along
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.transcription.descent import CONVERGED, KNOWN, KnownPaths, descend
from leapnav.experts.transcription.discrete_problem import DiscreteProblem, Path
from leapnav.experts.transcription.riccati import recursion

INTERVALS_PER_STEP = 2.0  # intervals per step of a lattice path (0.2 to 0.45 m)
MIN_INTERVALS, MAX_INTERVALS = 32, 32_768
MAX_ITERATIONS = 40
# A path with n times as many intervals as this may take n times as many iterations, up to a limit.
INTERVALS_PER_LIMIT, MAX_LIMITS = 256, 16
HAMILTONIAN_POINTS = 9  # of a path, along which the Hamiltonian is almost constant
MIN_TIME_FACTOR = 0.8  # smallest factor by which a free horizon changes at once
# Distance (proximity scales) below which the relaxed barrier is a quadratic polynomial. With the proximity weight 0.1,
# 72 of 72 candidates among the walls of `slalom` led to an extremal, and 6 without relaxation; 1.0 gave the same.
RELAXED_DISTANCE = 0.5
MAX_VIOLATION = 1e-3  # sum of the constraint violations of a path that is feasible
NO_PATHS = KnownPaths(np.empty((0, 0, 3)), 0.0)
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
        known: whether it ended because the path is close to a known one.

    """

    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    cost: float
    violation: float
    converged: bool
    known: bool = False

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

    def resampled(self, times: np.ndarray) -> DirectPath:
        """Return the path at other times (M,), which begin and end as those of the path, as an initial guess."""
        states, costates = (interpolate(times, self.times, array) for array in (self.states, self.costates))
        index = np.searchsorted(self.times, 0.5 * (times[1:] + times[:-1])) - 1
        return DirectPath(times, states, self.controls[index], costates, self.cost, self.violation, False)

    def scaled(self, factor: float) -> DirectPath:
        """Return the path with all times multiplied by a factor, which keeps the cost of the path."""
        controls, costates = self.controls / factor, self.costates / factor
        return replace(self, times=factor * self.times, controls=controls, costates=costates)

    def nodes(self, problem: OptimalControlProblem, segments: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times (segments + 1,) and nodes (segments + 1, 2n) for multiple shooting, of points of the path."""
        at = np.rint(np.linspace(0, len(self.controls), segments + 1)).astype(int)
        nodes = np.concatenate([self.states[at], self.costates[at]], axis=1)
        n, arrays = problem.system.n, problem.arrays
        nodes[-1, :n] = np.where(arrays.free, nodes[-1, :n], arrays.goal)
        return self.times[at], nodes

    def time_factor(self, problem: OptimalControlProblem) -> float:
        """Return the factor of all times that reduces the cost, for a problem with a free horizon."""
        return time_factor(self.cost, self.slope(problem, HAMILTONIAN_POINTS), MIN_TIME_FACTOR)

    def slope(self, problem: OptimalControlProblem, points: int | None = None) -> float:
        """Return the derivative of the cost with respect to the logarithm of the horizon, of a local optimum.

        It is the integral of the Hamiltonian, over all nodes or a number of them.
        """
        at = np.unique(np.linspace(0, len(self.times) - 1, points or len(self.times)).astype(int))
        z = np.concatenate([self.states[at], self.costates[at]], axis=1)
        return float(np.trapezoid(hamiltonians(problem.arrays.flow, z), self.times[at]))


def generated_functions(problem: OptimalControlProblem) -> tuple[FunctionPointer, ...]:
    """Return the functions that are generated for a problem, compiled when they are first called."""
    flow, arrays = problem.arrays.flow, problem.arrays
    backward = recursion(problem.system.n, problem.system.m)
    return flow.function, flow.piece, arrays.control, *problem.compiled_dynamics, backward


def discretise(problem: OptimalControlProblem, path: Trajectory) -> DirectPath:
    """Return an initial guess from a path: equal intervals, controls that follow it best, and zero costates.

    Args:
        problem: the problem.
        path: states (N, n) at times (N,).

    """
    intervals = min(max(int(INTERVALS_PER_STEP * (len(path.times) - 1)), MIN_INTERVALS), MAX_INTERVALS)
    times = np.linspace(0.0, path.times[-1], intervals + 1)
    states = path.resample(times).states
    affine, m = problem.compiled_dynamics.affine, problem.system.m
    controls = controls_along(affine, problem.arrays.data, times, states, m)
    return DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False)


def mean_running_cost(problem: OptimalControlProblem, path: Trajectory) -> float:
    """Return the mean running cost (1/s) of the controls that follow a path best, without Phi."""
    direct = discretise(problem, path)
    effort = 0.5 * (direct.controls**2) @ np.array(problem.control_weight)
    return float(np.average(effort, weights=np.diff(direct.times))) + problem.time_weight


def optimise(
    problem: OptimalControlProblem,
    guess: DirectPath,
    max_iterations: int = MAX_ITERATIONS,
    relaxed_weight: float | None = None,
    relaxed_distance: float | None = None,
    known: KnownPaths | None = None,
) -> DirectPath:
    """Compute a local optimum of the discretised problem from a guess.

    Args:
        problem: the problem, with the windings of its goal angles chosen. The times are those of the guess.
        guess: initial guess; its states, controls and costates need not be consistent.
        max_iterations: number of iterations after which the result has not converged, for a path of up to
            2 INTERVALS_PER_LIMIT intervals.
        relaxed_weight: proximity weight, at least, with a relaxed barrier, from which a guess in collision moves out
            of the obstacles; None for the barrier of the problem.
        relaxed_distance: distance (proximity scales) below which the relaxed barrier is a quadratic polynomial; by
            default RELAXED_DISTANCE.
        known: known local optima; the iteration ends when the path is close to one of them.

    """
    max_iterations *= min(max(1, len(guess.controls) // INTERVALS_PER_LIMIT), MAX_LIMITS)
    arrays = problem.arrays
    scale = max(math.dist(problem.start[:2], arrays.goal[:2]) / 5.0, 0.1)
    tolerance = STEP_TOLERANCE * min(scale, 1.0)
    states, controls = guess.states.copy(), guess.controls.copy()
    states[0] = arrays.start
    field = arrays.field
    if relaxed_weight is not None and problem.field is not None:
        field = with_weight(field, max(relaxed_weight, problem.proximity_weight), relaxed_distance or RELAXED_DISTANCE)
    unit = problem.control_weight[0]  # the penalties of the descent are relative to it
    costates = guess.costates / unit
    dynamics = problem.compiled_dynamics
    task = DiscreteProblem(
        h=np.diff(guess.times),
        end=arrays.end,
        data=arrays.data,
        field=field,
        unit=1.0 / unit,
        step=dynamics.step,
        step_derivatives=dynamics.step_derivatives,
        state_cost=dynamics.state_cost,
    )
    backward = recursion(problem.system.n, problem.system.m)
    path = Path(states, controls, costates, np.zeros(controls.shape, dtype=np.int8))
    # Close to obstacles, a path that is consistent on other intervals may be in contact when it follows the dynamics.
    alternates = problem.field is not None
    code, cost, violation = descend(task, backward, path, tolerance, max_iterations, alternates, known or NO_PATHS)
    costates, cost = costates * unit, cost * unit
    return DirectPath(guess.times, states, controls, costates, cost, violation, code == CONVERGED, code == KNOWN)
