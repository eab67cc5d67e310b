"""Optimal feedback: re-solution of a scenario from any state, warm-started from the previous solution."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import as_vector
from leapnav.experts.acting.barrier import barrier_integral, reference_problem
from leapnav.experts.acting.gains import Gains
from leapnav.experts.acting.tracking import FLOW_ACCURACY, advance, control_at, follow, follow_all
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.shooting import hamiltonian
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.optimum import Effort, find_optimum
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import OptimalControlProblem, ProblemArrays, Trajectory
from leapnav.experts.solvers.newton import CONVERGED, MARGIN
from leapnav.experts.solvers.nodes import start_nodes
from leapnav.experts.spacetime.clock import started_at, with_clock

# Maximum time (s) between nodes, tried in this order. Fewer nodes are faster, but the flow close to an obstacle can be
# too sensitive for long segments, and so can that along a limit of the speed.
SEGMENT_DURATIONS = (0.5, 0.25, 0.125, 0.03)
TOLERANCE = 1e-6  # residual of the boundary and continuity conditions; the controls have a similar error
SEARCH_PAUSE = 0.5  # s after an unsuccessful search before the next one
MIN_STEP = 1 / 16  # smallest step of the continuation in the state, as a fraction of the distance
LARGE_DEVIATION = 0.05  # m or rad; after a larger deviation the clearance of the new path is checked
CLEARANCE_SAMPLING = 0.05  # s between the points of this check
MIN_FREE_TIME = 0.02  # s; with less time left until the goal, a free horizon is searched again
GAIN_SAMPLING = 0.05  # s between the points of the gains
GAIN_HOLD = 0.25  # s before the horizon from which the gains are constant, because they grow without bound


class _Solution(NamedTuple):
    """A solution from a state to the goal.

    Attributes:
        times: (K + 1,), in the episode (s).
        nodes: (K + 1, 2n), states and costates; among moving obstacles, the last state is the time in the episode.
        costs: (K,), of the segments.
        problem: the problem, whose goal has the winding of the solution.

    """

    times: np.ndarray
    nodes: np.ndarray
    costs: np.ndarray
    problem: OptimalControlProblem

    @property
    def arrays(self) -> ProblemArrays:
        """The problem in the form that the kernels take."""
        return self.problem.arrays

    @property
    def cost(self) -> float:
        """The cost-to-go, without the barrier of hard limits."""
        return float(self.costs.sum()) - barrier_integral(self.problem, self.times, self.nodes)


class Feedback:
    """Optimal control of one scenario from any state and time.

    The solution from the last state is stored. From the next state, which is usually close, one or two Newton steps on
    states and costates at the remaining nodes converge. If they fail, the state is approached in smaller steps; if this
    fails too, or leads through an obstacle, a new search is made.

    With hard obstacles, the solutions have the barrier of the last optimum that was given or found. The cost-to-go
    excludes it.

    Args:
        scenario: the scenario.
        path: its optimum, or an approximation of it with costates.
        effort: effort of the searches, see `find_optimum`.

    Attributes:
        searches: number of searches so far.

    Raises:
        ValueError: no optimum was found.

    """

    def __init__(self, scenario: Scenario, path: Trajectory | Extremal, *, effort: Effort = "medium") -> None:
        self.scenario = scenario
        self._effort: Effort = effort
        self.searches = 0
        self._next_search = 0.0  # s; earliest time of the next search
        self._n, self._m = scenario.robot.sizes()
        problem = OptimalControlProblem.from_scenario(scenario)
        self._timed = problem.clock >= 0
        path = path if isinstance(path, Extremal) else with_clock(problem, path)
        found = _solve_along(reference_problem(problem, path), path, 0.0)
        if found is None:
            self.searches += 1
            found = self._search(np.array(scenario.start_state), 0.0)
        if found is None:
            raise ValueError(f"scenario {scenario.name!r}: no optimum was found")
        self._stored = found

    def update(self, state: np.ndarray, time: float) -> bool:
        """Re-solve from a state at a time, and store the solution.

        Args:
            state: the robot's state, shape (n,).
            time: s since the start of the episode.

        Returns:
            Whether there is a solution; without one, the previous solution remains stored.

        """
        found, has_searched = self._resolve(as_vector("state", state, self._n), time, TOLERANCE)
        self.searches += has_searched
        if found is not None:
            self._stored = found
        elif has_searched:
            self._next_search = time + SEARCH_PAUSE
        return found is not None

    def value(self, state: np.ndarray, time: float, tol: float = 1e-9) -> tuple[float, np.ndarray]:
        """Return the cost-to-go and its gradient, the costate (n,).

        Nothing is changed, so that several threads may ask at once.

        Args:
            state: the robot's state, shape (n,).
            time: s since the start of the episode.
            tol: residual of the boundary and continuity conditions.

        Raises:
            ValueError: no solution was found.

        """
        found, _ = self._resolve(as_vector("state", state, self._n), time, tol)
        if found is None:
            raise ValueError(f"state: no optimum was found from {list(map(float, state))} at {time:g} s")
        return found.cost, self._costate(found.nodes[0])

    def with_time(self, state: np.ndarray, time: float) -> np.ndarray:
        """Return the state of the optimal control problem: among moving obstacles, the time (s) is its last entry."""
        return np.append(state, time) if self._timed else state

    @property
    def stored(self) -> tuple[float, np.ndarray]:
        """Cost-to-go and costate (n,) at the state and time of the stored solution."""
        return self._stored.cost, self._costate(self._stored.nodes[0])

    @property
    def final_costate(self) -> np.ndarray:
        """Costate (n,) at the horizon."""
        return self._costate(self._stored.nodes[-1])

    def control(self, time: float) -> np.ndarray:
        """Return the controls (m,) of the stored solution at a time.

        Raises:
            FloatingPointError: the solution diverges on the way to this time.

        """
        times, nodes, arrays = self._stored.times, self._stored.nodes, self._stored.arrays
        control = control_at(arrays.flow, arrays.control, times, nodes, time, self._m)
        if not np.isfinite(control).all():
            raise FloatingPointError(f"the stored solution diverges before {time:g} s")
        return control

    def gains(self) -> Gains:
        """Compute neighbouring-extremal gains along the stored solution.

        Raises:
            FloatingPointError: the sensitivities diverge along the solution.

        """
        stored_times, stored_nodes, arrays = self._stored.times, self._stored.nodes, self._stored.arrays
        start, end = float(stored_times[0]), float(stored_times[-1])
        times = np.linspace(start, end, max(2, math.ceil((end - start) / GAIN_SAMPLING - 1e-9) + 1))
        extremal = np.array([follow(arrays.flow, stored_times, stored_nodes, time) for time in times])
        n = stored_nodes.shape[1] // 2
        transitions = np.empty((len(times) - 1, 2 * n, 2 * n))
        for k, transition in enumerate(transitions):
            transition[:] = np.eye(2 * n)
            duration = times[k + 1] - times[k]
            z = extremal[k].copy()
            success, *_ = propagate(arrays.flow, z, transition, duration, FLOW_ACCURACY, 0.0, False)
            if not success:
                raise FloatingPointError(f"the sensitivities of the stored solution diverge after {times[k]:g} s")
        slopes, factors = np.zeros((len(times), n, n)), np.empty((len(times) - 1, n, n))
        free = arrays.free
        for k in range(len(times) - 2, -1, -1):
            A, B = transitions[k, :n, :n], transitions[k, :n, n:]
            C, D = transitions[k, n:, :n], transitions[k, n:, n:]
            if k == len(times) - 2:  # the final condition of each component: on the state, or on the costate if free
                factors[k], right = np.where(free[:, None], D, B), np.where(free[:, None], C, A)
                slopes[k] = -np.linalg.solve(factors[k], right)
            else:
                factors[k] = D - slopes[k + 1] @ B
                slopes[k] = np.linalg.solve(factors[k], slopes[k + 1] @ A - C)
        if self.scenario.horizon is None:
            rates = np.empty_like(extremal)
            for z, rate in zip(extremal, rates, strict=True):
                hamiltonian(arrays.flow, z, rate)
            _free_final_time(slopes, factors, rates, free)
        last = max(0, int(np.searchsorted(times, end - GAIN_HOLD, side="right")) - 1)
        slopes[last:] = slopes[last]
        return Gains(times, extremal, slopes, arrays.control, arrays.data, self._m)

    def _costate(self, node: np.ndarray) -> np.ndarray:
        """Return the costate (n,) of the robot's state at a node."""
        first = len(node) // 2
        return node[first : first + self._n].copy()

    def _resolve(self, robot_state: np.ndarray, time: float, tol: float) -> tuple[_Solution | None, bool]:
        """Return the solution from a state and time, None without one, and whether a search was made."""
        stored, state = self._stored, self.with_time(robot_state, time)
        left = stored.times[-1] - time
        if left <= 0.0 and self.scenario.horizon is not None:
            return None, False
        found, check_clearance = None, True
        if left > MIN_FREE_TIME or self.scenario.horizon is not None:  # otherwise the robot has missed the goal
            found, times, nodes = _solve_from(stored, state, time, tol)
            check_clearance = np.abs(state[:3] - nodes[0, :3]).max() > LARGE_DEVIATION
            if found is None:
                found, check_clearance = _approach(stored._replace(times=times, nodes=nodes), state, tol), True
        if found is not None and check_clearance and not self._clearance(found) > 0.0:  # NaN where it diverges
            found = None
        if found is not None or time < self._next_search:
            return found, False
        found = self._search(robot_state, time)
        if found is not None and tol < TOLERANCE:
            found = _solve_from(found, state, time, tol)[0]
        return found, True

    def _clearance(self, solution: _Solution) -> float:
        """Smallest clearance (m) of states of a solution that are evenly spaced in time."""
        times, nodes, arrays = solution.times, solution.nodes, solution.arrays
        count = math.ceil((times[-1] - times[0]) / CLEARANCE_SAMPLING) + 1
        moments = np.linspace(times[0], times[-1], count)
        states = follow_all(arrays.flow, times, nodes, moments)
        return float(footprint_clearances(states, self.scenario.outline, self.scenario.field).min())

    def _remaining_scenario(self, state: np.ndarray, time: float) -> Scenario | None:
        """The rest of the episode as a scenario, None in collision or without time left."""
        try:
            return self.scenario.from_state(state, time)
        except ScenarioError:
            return None

    def _search(self, state: np.ndarray, time: float) -> _Solution | None:
        """Search for the optimum from a state and time; None without one."""
        scenario = self._remaining_scenario(state, time)
        if scenario is None:
            return None
        optimum = find_optimum(scenario, self._effort)
        if not optimum.success:
            return None
        path = Trajectory(optimum.times, optimum.states, optimum.costates)
        return _solve_along(*started_at(optimum.problem, path, time, self.scenario.field), time)


def _solve_along(problem: OptimalControlProblem, path: Trajectory | Extremal, start_time: float) -> _Solution | None:
    """Return the solution close to a path of a problem that starts at `start_time` (s) in the episode."""
    if isinstance(path, Extremal):
        path = Trajectory(path.times, path.states, path.costates)
    problem = problem.with_winding_of(path.states)
    for duration in SEGMENT_DURATIONS:
        segments = max(1, math.ceil(problem.horizon_of(path) / duration - 1e-9))
        times, nodes = start_nodes(problem, path, segments)
        guess = _Solution(times + start_time, nodes, np.zeros(segments), problem)
        found, _, _ = _solve_from(guess, problem.arrays.start, start_time, TOLERANCE)
        if found is not None:
            return found
    return None


def _solve_from(
    guess: _Solution, state: np.ndarray, time: float, tol: float
) -> tuple[_Solution | None, np.ndarray, np.ndarray]:
    """Solve from a state at a time by Newton's method, with the remaining nodes of a solution as the initial guess.

    Returns the solution, None without convergence, and the times and values of the remaining nodes.
    """
    times, nodes, _, problem = guess
    flow, end = problem.arrays.flow, problem.arrays.end
    code, times, nodes, costs, remaining = advance(flow, times, nodes, state, time, end, MARGIN * tol)
    return (_Solution(times, nodes, costs, problem) if code == CONVERGED else None), times, remaining


def _approach(guess: _Solution, state: np.ndarray, tol: float) -> _Solution | None:
    """Solve by continuation in the state, with steps that are halved when they fail."""
    times, start = guess.times, guess.nodes[0, : len(state)]

    def advance_to(fraction: float, previous: _Solution) -> _Solution | None:
        target = start + fraction * (state - start)
        return _solve_from(previous, target, times[0], tol)[0]

    return step_halving(advance_to, guess, first_step=0.5, min_step=MIN_STEP)


def _free_final_time(slopes: np.ndarray, factors: np.ndarray, rates: np.ndarray, free: np.ndarray) -> None:
    """Change slopes (K, n, n) of the costate for a fixed final time to those for a free one, in place.

    A deviation then changes the final time, so that the Hamiltonian remains 0.

    Args:
        slopes: derivatives of the costate with respect to the state.
        factors (K - 1, n, n): matrices of the linear systems of the backward sweep.
        rates (K, 2n): q' and lambda' along the extremal.
        free (n,): which final states are free, bool.

    """
    n = len(free)
    shift = -np.where(free, rates[-1, n:], rates[-1, :n])  # of the final conditions by the final time; then d lambda/dT
    for k in range(len(factors) - 1, -1, -1):
        shift = np.linalg.solve(factors[k], shift)
        along = slopes[k].T @ rates[k, :n] - rates[k, n:]
        slopes[k] -= np.outer(shift, along) / (rates[k, :n] @ shift)
