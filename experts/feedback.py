"""The optimum from wherever the robot is: re-solved from the one before, or read off neighbouring-extremal gains."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario, ScenarioError
from leapnav.experts.extremal import CONVERGED
from leapnav.experts.integrator import CONTROL, FLOW, constant, matrix, propagate, vector
from leapnav.experts.multiple_shooting import flags, newton
from leapnav.experts.nodes import start_nodes
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.single_shooting import MARGIN

# Seconds between the nodes, at most: fewer are quicker, but past an obstacle the flow may be too sensitive for that.
SEGMENTS = (0.5, 0.25, 0.125)
TOLERANCE = 1e-6  # largest residual of the boundary and continuity conditions, for controls good to as much
SHORTEST_SEGMENT = 0.02  # s; a first segment that is shorter is joined to the next
ACCURACY = 1e-8  # of the flow between nodes
ITERATIONS = 8  # of Newton's method: what takes more is nearer to another solution
PAUSE = 0.5  # s after a search in vain before the next one
SMALLEST_STEP = 1 / 16  # of the way to a state that Newton's method does not reach at once
FAR = 0.05  # m or rad off the path from which on a re-solve is looked at closely
SAMPLING = 0.05  # s between the points at which a path's clearance is looked at
GAIN_STEP = 0.05  # s between the points of the gains
STIFFEST = 0.25  # s before the horizon from which the gains stay as they are: they grow without bound


class _Solution(NamedTuple):
    """Times (K + 1,) in the episode, nodes (K + 1, 6): states and costates, and the cost (K,) of each segment."""

    times: np.ndarray
    nodes: np.ndarray
    costs: np.ndarray


class Feedback:
    """The optimal control of one scenario from any state and time.

    What it stores is the optimum from the last state that it was asked about. The next one is mostly near, and one or
    two steps of Newton's method on states and costates at the remaining nodes lead there. Where they fail, it goes to
    the state in smaller steps, and where that fails or leads through an obstacle, it searches anew.

    Args:
        scenario: the task.
        path: its optimum, or one nearly so, with costates.
        quick: where a search is needed, let it not be thorough, see `find_optimum`.

    Attributes:
        searches: how often a new search was needed.

    Raises:
        ValueError: there is no optimum.

    """

    def __init__(self, scenario: Scenario, path: Path, *, quick: bool = False) -> None:
        self.scenario, self._quick = scenario, quick
        self.searches = 0
        self._patience = 0.0
        problem = OptimalControlProblem.from_scenario(scenario)
        if not self._take(problem, path, 0.0) and not self._search(np.array(scenario.start), 0.0):
            raise ValueError(f"scenario {scenario.name!r}: no optimum was found")

    def _take(self, problem: OptimalControlProblem, path: Path, since: float) -> bool:
        """Stores the solution near a path of the task from time `since` on; False if there is none."""
        problem = problem.with_winding_of(path.states)
        before, self._arrays = getattr(self, "_arrays", problem.arrays), problem.arrays
        for spacing in SEGMENTS:
            segments = max(1, math.ceil(problem.horizon / spacing - 1e-9))
            times, nodes = start_nodes(problem, path, segments)
            found, _, _ = self._newton(times + since, nodes, problem.arrays.start, since, TOLERANCE)
            if found is not None:
                self._stored = found
                return True
        self._arrays = before
        return False

    def update(self, state: np.ndarray, time: float) -> bool:
        """Re-solves from a state (3,) at a time, and stores the result.

        Args:
            state: x, y (m), heading (rad).
            time: s since the start of the episode.

        Returns:
            False if there is no solution: what is stored is then the one before.

        """
        found = self._resolve(np.array(state, dtype=float), time, TOLERANCE)
        if found is not None:
            self._stored = found
        return found is not None

    def value(self, state: np.ndarray, time: float, tol: float = 1e-9) -> tuple[float, np.ndarray]:
        """Cost-to-go and its gradient, the costate (3,), at a state and time; what is stored stays.

        Raises:
            ValueError: there is no solution from there.

        """
        stored = self._arrays, self._stored, self._patience
        try:
            found = self._resolve(np.array(state, dtype=float), time, tol)
        finally:
            self._arrays, self._stored, self._patience = stored
        if found is None:
            raise ValueError(f"state: no optimum was found from {list(map(float, state))} at {time:g} s")
        return float(found.costs.sum()), found.nodes[0, 3:].copy()

    @property
    def stored(self) -> tuple[float, np.ndarray]:
        """Cost-to-go and costate (3,) at the state and time of what is stored."""
        return float(self._stored.costs.sum()), self._stored.nodes[0, 3:].copy()

    @property
    def final_costate(self) -> np.ndarray:
        """The costate (3,) at the horizon."""
        return self._stored.nodes[-1, 3:].copy()

    def control(self, time: float) -> np.ndarray:
        """Speed (m/s) and turn rate (rad/s) at a time, along what is stored."""
        arrays, (times, nodes, _) = self._arrays, self._stored
        return _control_at(arrays.flow, arrays.control, times, nodes, time, arrays.data, arrays.field)

    def gains(self) -> Gains:
        """Neighbouring-extremal gains along what is stored."""
        arrays = self._arrays
        start, end = float(self._stored.times[0]), float(self._stored.times[-1])
        times = np.linspace(start, end, max(2, math.ceil((end - start) / GAIN_STEP - 1e-9) + 1))
        constants = arrays.data, arrays.field
        extremal = np.array([_follow(arrays.flow, *self._stored[:2], time, *constants) for time in times])
        n = 3
        transitions = np.empty((len(times) - 1, 2 * n, 2 * n))
        for k, transition in enumerate(transitions):
            transition[:] = np.eye(2 * n)
            duration = times[k + 1] - times[k]
            propagate(arrays.flow, extremal[k].copy(), transition, duration, *constants, ACCURACY, 0.0, False)
        slopes = np.zeros((len(times), n, n))
        free = arrays.free
        for k in range(len(times) - 2, -1, -1):
            A, B = transitions[k, :n, :n], transitions[k, :n, n:]
            C, D = transitions[k, n:, :n], transitions[k, n:, n:]
            if k == len(times) - 2:  # what the end conditions fix: the state, or where it is free the costate
                left, right = np.where(free[:, None], D, B), np.where(free[:, None], C, A)
                slopes[k] = -np.linalg.solve(left, right)
            else:
                slopes[k] = np.linalg.solve(D - slopes[k + 1] @ B, slopes[k + 1] @ A - C)
        last = max(0, int(np.searchsorted(times, end - STIFFEST, side="right")) - 1)
        slopes[last:] = slopes[last]
        return Gains(times, extremal, slopes, arrays.control, arrays.data)

    def _resolve(self, state: np.ndarray, time: float, tol: float) -> _Solution | None:
        """The solution from a state and time; None if there is none."""
        if self._stored.times[-1] - time <= 0.0:
            return None
        found, times, before = self._newton(*self._stored[:2], state, time, tol)
        far = np.abs(state - before[0, :3]).max() > FAR
        if found is None:
            found, far = self._walk(times, before, state, tol), True
        if found is not None and far and clearances(self._sample(found), self.scenario.field).min() <= 0.0:
            found = None
        if found is not None or not self._search(state, time):
            return found
        return self._stored if tol >= TOLERANCE else self._newton(*self._stored[:2], state, time, tol)[0]

    def _newton(
        self, times: np.ndarray, nodes: np.ndarray, state: np.ndarray, time: float, tol: float
    ) -> tuple[_Solution | None, np.ndarray, np.ndarray]:
        """The solution from a state at a time by Newton's method, None if it does not converge.

        It starts at those of the nodes that remain; their times and they themselves are returned too.
        """
        arrays = self._arrays
        constants = arrays.goal, arrays.free, arrays.data, arrays.field
        code, times, nodes, costs, before = _advance(arrays.flow, times, nodes, state, time, *constants, MARGIN * tol)
        return (_Solution(times, nodes, costs) if code == CONVERGED else None), times, before

    def _walk(self, times: np.ndarray, nodes: np.ndarray, state: np.ndarray, tol: float) -> _Solution | None:
        """The same by continuation in the state: the way there in steps that are halved where they fail."""
        start, found = nodes[0, :3], None
        reached, step = 0.0, 0.5
        while reached < 1.0:
            share = min(1.0, reached + step)
            following, _, _ = self._newton(times, nodes, start + share * (state - start), times[0], tol)
            if following is not None:
                found, nodes, reached, step = following, following.nodes, share, 2 * step
            else:
                step /= 2
                if step < SMALLEST_STEP:
                    return None
        return found

    def _sample(self, solution: _Solution) -> np.ndarray:
        """States (K, 3) along a solution, evenly spaced in time."""
        arrays, (times, nodes, _) = self._arrays, solution
        count = math.ceil((times[-1] - times[0]) / SAMPLING) + 1
        moments = np.linspace(times[0], times[-1], count)
        return _follow_all(arrays.flow, times, nodes, moments, arrays.data, arrays.field)

    def _task(self, state: np.ndarray, time: float) -> Scenario | None:
        """The rest of the episode from a state as a scenario, None in contact or without any time left."""
        update = {"start": tuple(state.tolist()), "horizon": float(self.scenario.horizon - time)}
        try:
            return self.scenario.model_copy(update=update)
        except ScenarioError:
            return None

    def _search(self, state: np.ndarray, time: float) -> bool:
        """Stores the best optimum from a state and time, by a new search; False if there is none."""
        if time < self._patience:
            return False
        self.searches += 1
        scenario = self._task(state, time)
        if scenario is None:
            return False
        optimum = find_optimum(scenario, thorough=not self._quick)
        path = Path(optimum.times, optimum.states, optimum.costates)
        if optimum.success and self._take(optimum.problem, path, time):
            return True
        self._patience = time + PAUSE
        return False


@njit(vector(FLOW, vector, matrix, float64, constant, constant), cache=True, error_model="numpy", nogil=True)
def _follow(flow, times, nodes, time, data, field):
    """(q, lambda) at a time: from the node before, by the flow."""
    k = min(max(np.searchsorted(times, time, side="right") - 1, 0), len(times) - 2)
    z = nodes[k].copy()
    duration = min(time, times[-1]) - times[k]
    if duration > 0.0:
        propagate(flow, z, np.empty((len(z), 0)), duration, data, field, ACCURACY, 0.0, False)
    return z


@njit(matrix(FLOW, vector, matrix, vector, constant, constant), cache=True, error_model="numpy", nogil=True)
def _follow_all(flow, times, nodes, moments, data, field):
    """The states (K, n) at times (K,)."""
    states = np.empty((len(moments), nodes.shape[1] // 2))
    for k in range(len(moments)):
        z = _follow(flow, times, nodes, moments[k], data, field)
        for i in range(states.shape[1]):
            states[k, i] = z[i]
    return states


@njit(vector(FLOW, CONTROL, vector, matrix, float64, constant, constant), cache=True, error_model="numpy", nogil=True)
def _control_at(flow, control, times, nodes, time, data, field):
    """The optimal control at a time."""
    u = np.empty(2)
    control(_follow(flow, times, nodes, time, data, field), data, u)
    return u


@njit(
    types.Tuple((int64, vector, matrix, vector, matrix))(
        FLOW, vector, matrix, vector, float64, vector, flags, constant, constant, float64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _advance(flow, times, nodes, state, time, goal, free, data, field, tolerance):
    """Newton's method from a state at a time, started at the nodes that remain.

    Returns (status, times, nodes, costs, the nodes before).
    """
    n = len(goal)
    k = min(max(np.searchsorted(times, time + 1e-9, side="right") - 1, 0), len(times) - 2)
    expected = _follow(flow, times, nodes, time, data, field) if time > times[k] else nodes[k].copy()
    kept = k + 1
    if times[kept] - time < SHORTEST_SEGMENT and kept < len(times) - 1:
        kept += 1
    count = 1 + len(times) - kept
    new_times, new_nodes = np.empty(count), np.empty((count, 2 * n))
    new_times[0], new_nodes[0] = time, expected
    new_times[1:], new_nodes[1:] = times[kept:], nodes[kept:]
    before = new_nodes.copy()
    new_nodes[0, :n] = state
    costs, log = np.empty(count - 1), np.empty((ITERATIONS + 1, 3))
    left, accuracy = new_times - time, 0.1 * tolerance
    code, _, _, _ = newton(
        flow, left, new_nodes, state, goal, free, data, field, tolerance, accuracy, ITERATIONS, True, costs, log
    )
    return code, new_times, new_nodes, costs, before


class Gains:
    """A feedback law linear in the costate: lambda = lambda*(t) + P(t) (q - q*(t)), then the minimising control.

    P is the derivative of the costate by the state along an extremal, by a backward sweep of the transition matrices
    (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, ch. 6). It grows without bound towards a fixed end, and
    is held where little time is left.

    Args:
        times (K,): s, evenly spaced.
        extremal (K, 6): states and costates.
        slopes (K, 3, 3): P.
        control, data: the control law and its constants, see `ProblemArrays`.

    """

    def __init__(self, times: np.ndarray, extremal: np.ndarray, slopes: np.ndarray, control: Any, data: Any) -> None:
        self.times, self.extremal, self.slopes = times, extremal, slopes
        self._control, self._data = control, data

    def control(self, state: np.ndarray, time: float, ahead: float = 0.0) -> np.ndarray:
        """Speed and turn rate for a state at a time, as they will be `ahead` seconds later."""
        k, share = self._place(time)
        z = (1 - share) * self.extremal[k] + share * self.extremal[k + 1]
        off = np.asarray(state, dtype=float) - z[:3]
        k, share = self._place(time + ahead)
        z = (1 - share) * self.extremal[k] + share * self.extremal[k + 1]
        slope = (1 - share) * self.slopes[k] + share * self.slopes[k + 1]
        z[:3] += off
        z[3:] += slope @ off
        control = np.empty(2)
        self._control(z, self._data, control)
        return control

    def _place(self, time: float) -> tuple[int, float]:
        step = self.times[1] - self.times[0]
        at = min(max((time - self.times[0]) / step, 0.0), len(self.times) - 1.0)
        k = min(int(at), len(self.times) - 2)
        return k, at - k
