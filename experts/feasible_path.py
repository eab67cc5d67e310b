"""Leapfrog's iterate: a path of arcs that is feasible, and the moves that keep it so, as compiled kernels.

Every arc is an extremal from its node to the next, found by simple shooting. See `leapfrog` for the method and its
sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.experts.extremal import CONVERGED, Iteration
from leapnav.experts.initial_path import local_minima
from leapnav.experts.integrator import FLOW, constant, matrix, propagate, vector
from leapnav.experts.multiple_shooting import flags
from leapnav.experts.problem import OptimalControlProblem
from leapnav.experts.single_shooting import shoot

SUBPROBLEM_ITERATIONS = 12
LONG_ACCURACY = 1e-13  # of the integrator, for arcs over which errors grow
EDGE = 0.05  # of a sub-problem's duration, within which its node stays
CLOSED = 5e-10  # larger jumps of the states between arcs call for a better integrator
LOOKED_AT = 1e-10  # accuracy of arcs that are drawn: errors grow along long ones, which still should look connected
STEERING_INTERVALS, STEERING_STARTS = 16, 6


@dataclass
class FeasiblePath:
    """Leapfrog's iterate: arcs from node to node, each an extremal of its own, and what they cost.

    Attributes:
        times (p + 1,), nodes (p + 1, 2n): changed in place.
        tolerance: largest end error of an arc.
        accuracy: of the integrator.
        half_cost: nodes move to half their sub-problem's cost, not to the mean time.
        thorough: connect nodes also where shooting alone does not, and measure the residual of every iterate.
        costs (p,): of the arcs; infinite where nothing connects two nodes.
        history: a row per sweep.

    """

    problem: OptimalControlProblem
    times: np.ndarray
    nodes: np.ndarray
    tolerance: float
    accuracy: float
    half_cost: bool = False
    thorough: bool = False
    costs: np.ndarray = field(init=False)
    history: list[Iteration] = field(default_factory=list)
    work: int = 0

    def __post_init__(self) -> None:
        self._connect()
        if self.thorough:
            self._mend()
        self._record("sweep", ())

    @property
    def feasible(self) -> bool:
        """Whether every two neighbouring nodes are connected."""
        return bool(np.isfinite(self.costs).all())

    def _connect(self) -> None:
        self.costs = np.empty(self.segments)
        arrays = self.problem.arrays
        _, work = connect(
            arrays.flow,
            self.times,
            self.nodes,
            arrays.goal,
            arrays.free,
            arrays.data,
            arrays.field,
            self.tolerance,
            self.accuracy,
            self.costs,
        )
        self.work += work

    def _mend(self) -> None:
        """Connects what shooting did not: over fewer nodes, which leaves more time, or by Gauss-Newton on controls."""
        while not self.feasible and self.segments > 1:
            k = int(np.flatnonzero(np.isinf(self.costs))[0])
            spans = [(a, b) for a, b in ((k, k + 2), (k - 1, k + 1), (k - 1, k + 2)) if a >= 0 and b <= self.segments]
            # Shooting over each span first: it takes a hundredth of the time.
            if not any(self._join(a, b, guess) for guess in (False, True) for a, b in [*spans, (k, k + 1)]):
                if not spans:
                    return
                self._replace(*spans[0], self.nodes[list(spans[0])], math.inf)

    def _join(self, a: int, b: int, guess: bool) -> bool:
        """Connects node a to node b by one arc and drops what lies between; False if that fails."""
        n = self.problem.system.n
        last = b == self.segments
        part = replace(
            self.problem,
            start=tuple(self.nodes[a, :n]),
            goal=self.problem.goal if last else tuple(self.nodes[b, :n]),
            horizon=float(self.times[b] - self.times[a]),
        )
        arrays = part.arrays
        minima = local_minima(part, STEERING_INTERVALS, STEERING_STARTS) if guess else [(0.0, None)]
        for _, path in sorted(minima, key=lambda entry: entry[0]):
            nodes, cost = self.nodes[[a, b]], np.empty(1)
            if path is not None and path.costates is not None:
                nodes[0, n:] = path.costates[0]
            failed, work = connect(
                arrays.flow,
                np.array([0.0, part.horizon]),
                nodes,
                arrays.goal,
                arrays.free,
                arrays.data,
                arrays.field,
                self.tolerance,
                self.accuracy,
                cost,
            )
            self.work += work
            if not failed:
                self._replace(a, b, nodes, cost[0])
                return True
        return False

    def _replace(self, a: int, b: int, nodes: np.ndarray, cost: float) -> None:
        """Puts one arc with these end nodes (2, 2n) in the place of those from node a to node b."""
        self.times = np.delete(self.times, np.s_[a + 1 : b])
        self.nodes = np.delete(self.nodes, np.s_[a + 1 : b], axis=0)
        self.costs = np.delete(self.costs, np.s_[a + 1 : b])
        self.nodes[a] = nodes[0]
        if a + 1 == self.segments:
            self.nodes[-1] = nodes[1]
        self.costs[a] = cost

    @property
    def segments(self) -> int:
        """How many arcs there are."""
        return len(self.times) - 1

    @property
    def cost(self) -> float:
        """J of the path."""
        return float(self.costs.sum())

    def sweep(self, red_black: bool = False) -> None:
        """Moves every inner node once: in order, or first the odd and then the even ones."""
        rejected = np.zeros(self.segments + 1, dtype=bool)
        for first, stride in ((1, 2), (2, 2)) if red_black else ((1, 1),):
            arrays = self.problem.arrays
            self.work += sweep(
                arrays.flow,
                self.times,
                self.nodes,
                arrays.goal,
                arrays.free,
                arrays.data,
                arrays.field,
                self.tolerance,
                self.accuracy,
                self.half_cost,
                self.costs,
                first,
                stride,
                rejected,
            )
        self._record("sweep", tuple(np.flatnonzero(rejected).tolist()))

    def reduce(self) -> int:
        """Removes what can be removed of every other node without raising the cost; returns how many."""
        keep, rejected = np.ones(self.segments + 1, dtype=bool), np.zeros(self.segments + 1, dtype=bool)
        arrays = self.problem.arrays
        self.work += merge(
            arrays.flow,
            self.times,
            self.nodes,
            arrays.goal,
            arrays.free,
            arrays.data,
            arrays.field,
            self.tolerance,
            self.accuracy,
            self.costs,
            keep,
            rejected,
        )
        self.times, self.nodes = self.times[keep].copy(), self.nodes[keep].copy()
        # A removed node's arc is part of the one before it.
        self.costs = self.costs[keep[:-1]].copy()
        self._record("reduce", tuple(np.flatnonzero(rejected).tolist()))
        return int((~keep).sum())

    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """States and costates of the nodes."""
        n = self.problem.system.n
        return self.nodes[:, :n], self.nodes[:, n:]

    def jumps(self) -> tuple[float, float]:
        """Largest jump at a node of the states (end conditions included) and of the costates.

        Without jumps of the costates the path is an extremal.
        """
        arrays = self.problem.arrays
        states, costates, work = measure(
            arrays.flow, self.times, self.nodes, arrays.goal, arrays.free, arrays.data, arrays.field, self.accuracy
        )
        self.work += work
        return states, costates

    def split(self) -> None:
        """Halves every arc, which changes neither path nor cost."""
        arrays, size = self.problem.arrays, self.nodes.shape[1]
        times, nodes = np.repeat(self.times, 2)[:-1], np.repeat(self.nodes, 2, axis=0)[:-1]
        times[1::2] = (self.times[1:] + self.times[:-1]) / 2
        costs = np.repeat(self.costs, 2)
        for k in range(self.segments):
            half = times[2 * k + 1] - times[2 * k]
            z, none = self.nodes[k].copy(), np.empty((size, 0))
            flow, data, field = arrays.flow, arrays.data, arrays.field
            cost, _, _, work = propagate(flow, z, none, half, data, field, self.accuracy, 0.0, False)
            nodes[2 * k + 1] = z
            costs[2 * k : 2 * k + 2] = cost, self.costs[k] - cost
            self.work += abs(work)
        self.times, self.nodes, self.costs = times, nodes, costs

    def _record(self, phase: str, rejected: tuple[int, ...]) -> None:
        residual = math.nan
        if self.thorough:
            residual = self.jumps()[0] if self.feasible else math.inf
            if CLOSED < residual < math.inf and self.accuracy > LONG_ACCURACY:
                # Errors grow along some arc by more than usual.
                self.accuracy = LONG_ACCURACY
                self._connect()
                residual = self.jumps()[0] if self.feasible else math.inf
        row = Iteration(phase, self.segments, self.cost, residual, rejected, self.times.copy(), self.nodes.copy())
        self.history.append(row)


@njit(
    types.Tuple((float64, float64, int64))(FLOW, vector, matrix, vector, flags, constant, constant, float64),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def measure(flow, times, Z, goal, free, data, field, accuracy):
    """Largest jumps of states and of costates from arc to arc, and the evaluations of the flow."""
    n = len(goal)
    p = len(times) - 1
    S = np.empty((2 * n, 0))
    states, costates, work = 0.0, 0.0, 0
    for k in range(p):
        z = Z[k].copy()
        _, _, _, evaluations = propagate(flow, z, S, times[k + 1] - times[k], data, field, accuracy, 0.0, False)
        work += abs(evaluations)
        for i in range(n):
            if k < p - 1:
                states = max(states, abs(z[i] - Z[k + 1, i]))
                costates = max(costates, abs(z[n + i] - Z[k + 1, n + i]))
            else:
                states = max(states, abs(z[n + i]) if free[i] else abs(z[i] - goal[i]))
    return states, costates, work


@njit(
    types.Tuple((int64, int64))(FLOW, vector, matrix, vector, flags, constant, constant, float64, float64, vector),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def connect(flow, times, Z, goal, free, data, field, tolerance, accuracy, costs):
    """Makes a path of nodes feasible: solves each segment on its own, from the costates guessed in Z.

    Where these lead nowhere, the costate at the end of the segment before is tried. `costs` (p,) becomes the cost of
    each segment, infinite where both failed. Returns (failed segments, evaluations of the flow).
    """
    n = len(goal)
    p = len(times) - 1
    fixed = np.zeros(n, dtype=np.bool_)
    end = Z[0].copy()
    log = np.empty((SUBPROBLEM_ITERATIONS + 1, 2))
    failed, work = 0, 0
    for k in range(p):
        costs[k] = np.inf
        before = end[n:].copy()
        for attempt in range(2):
            z = Z[k].copy()
            if attempt == 1:
                z[n:] = before
            # Only at the horizon may a component be free.
            status, _, _, cost, evaluations = shoot(
                flow,
                z,
                Z[k + 1, :n].copy(),
                end,
                free if k == p - 1 else fixed,
                times[k + 1] - times[k],
                data,
                field,
                tolerance,
                accuracy,
                SUBPROBLEM_ITERATIONS,
                log,
            )
            work += evaluations
            if status == CONVERGED:
                Z[k] = z
                costs[k] = cost
                if k == p - 1:
                    Z[p] = end
                break
        else:
            failed += 1
            end[:] = Z[k + 1]
    return failed, work


@njit(
    int64(
        FLOW, vector, matrix, vector, flags, constant, constant, float64, float64, boolean, vector, int64, int64, flags
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def sweep(flow, times, Z, goal, free, data, field, tolerance, accuracy, half_cost, costs, first, stride, rejected):
    """One sweep over the inner nodes first, first + stride, ... in place (stride 2: the red or black nodes).

    With `half_cost` a node moves to half the sub-problem's cost and its time changes, else it stays at the mean time of
    its neighbours. `rejected` (p + 1,) is set where a move was. Returns the evaluations of the flow.
    """
    n = len(goal)
    p = len(times) - 1
    fixed = np.zeros(n, dtype=np.bool_)
    S = np.empty((2 * n, 0))
    end = np.empty(2 * n)
    log = np.empty((SUBPROBLEM_ITERATIONS + 1, 2))
    work = 0
    for i in range(first, p, stride):
        duration = times[i + 1] - times[i - 1]
        before = costs[i - 1] + costs[i]
        slack = 10.0 * tolerance * (1.0 + abs(before))
        for attempt in range(2):
            z = Z[i - 1].copy()
            if attempt == 1:  # along an extremal costates change slowly
                z[n:] = Z[i, n:]
            status, _, _, cost, evaluations = shoot(
                flow,
                z,
                Z[i + 1, :n].copy(),
                end,
                free if i == p - 1 else fixed,
                duration,
                data,
                field,
                tolerance,
                accuracy,
                SUBPROBLEM_ITERATIONS,
                log,
            )
            work += evaluations
            if status == CONVERGED and (cost <= before + slack or before == np.inf):
                break
        else:
            rejected[i] = True
            continue
        middle = z.copy()
        elapsed, first_cost = 0.0, 0.0
        if half_cost and cost > 0.0:
            reached, elapsed, step, target = 0.0, 0.0, duration / 16.0, cost / 2.0
            part, taken = 0.0, 0.0
            here = middle.copy()
            while elapsed < duration:
                part, taken, following, evaluations = propagate(
                    flow, here, S, min(step, duration - elapsed), data, field, accuracy, step, True
                )
                work += abs(evaluations)
                if evaluations < 0 or reached + part > target:
                    break
                middle[:] = here
                reached += part
                elapsed += taken
                step = min(following, duration / 16.0)
            # Within the last step the cost grows almost linearly.
            rest = taken * (target - reached) / part if part > 0 else 0.0
            part, _, _, evaluations = propagate(flow, middle, S, rest, data, field, accuracy, 0.0, False)
            elapsed += rest
            first_cost = reached + part
        # Where the cost comes all at one end, or is not positive, half of it marks no point between the neighbours.
        if not EDGE * duration < elapsed < (1.0 - EDGE) * duration:
            middle[:] = z
            elapsed = duration / 2.0
            first_cost, _, _, evaluations = propagate(flow, middle, S, elapsed, data, field, accuracy, 0.0, False)
        work += abs(evaluations)
        Z[i - 1] = z
        Z[i] = middle
        if i == p - 1:
            Z[p] = end
        times[i] = times[i - 1] + elapsed
        costs[i - 1] = first_cost
        # What end errors of the arcs make uncertain is not booked as a rise.
        costs[i] = min(cost, before) - first_cost
    return work


@njit(
    int64(FLOW, vector, matrix, vector, flags, constant, constant, float64, float64, vector, flags, flags),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def merge(flow, times, Z, goal, free, data, field, tolerance, accuracy, costs, keep, rejected):
    """Takes out every other inner node whose sub-problem's extremal costs no more than the arcs on its two sides.

    `keep` (p + 1,) becomes False there, `costs` of the arc before it the cost of the one that replaces both. Returns
    the evaluations of the flow.
    """
    n = len(goal)
    p = len(times) - 1
    fixed = np.zeros(n, dtype=np.bool_)
    end = np.empty(2 * n)
    log = np.empty((4 * SUBPROBLEM_ITERATIONS + 1, 2))
    work = 0
    i = 1
    while i < p:
        z = Z[i - 1].copy()
        status, _, _, cost, evaluations = shoot(
            flow,
            z,
            Z[i + 1, :n].copy(),
            end,
            free if i == p - 1 else fixed,
            times[i + 1] - times[i - 1],
            data,
            field,
            tolerance,
            accuracy,
            4 * SUBPROBLEM_ITERATIONS,
            log,
        )
        work += evaluations
        before = costs[i - 1] + costs[i]
        if status == CONVERGED and cost <= before + 10.0 * tolerance * (1.0 + abs(before)):
            Z[i - 1] = z
            if i == p - 1:
                Z[p] = end
            # What end errors of the arcs make uncertain is not booked as a rise.
            costs[i - 1] = min(cost, before)
            keep[i] = False
            i += 2
        else:
            rejected[i] = True
            i += 1
    return work


def telling_sweeps(count: int, first: int, most: int) -> list[int]:
    """Which of so many sweeps to show: the first ones, which change most, and an even selection of the rest."""
    rest = np.linspace(first, count - 1, most - first).round().astype(int) if count > first else []
    return sorted({*range(min(first, count)), *map(int, rest)})


def dense_path(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, points: int
) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) and states (K, n) along a sweep's path, at least so many points.

    Args:
        problem: that was solved.
        times: (p + 1,), see `Iteration`.
        nodes: (p + 1, 2n).
        points: of the path, K or fewer.

    """
    arrays, n = problem.arrays, problem.system.n
    none = np.empty((2 * n, 0))
    steps = math.ceil(points / (len(times) - 1))
    dense = np.concatenate([np.linspace(a, b, steps + 1) for a, b in pairwise(times)])
    states = np.empty((len(dense), n))
    for k in range(len(times) - 1):
        z, at = nodes[k].copy(), k * (steps + 1)
        states[at] = z[:n]
        for j in range(at + 1, at + steps + 1):
            step = dense[j] - dense[j - 1]
            propagate(arrays.flow, z, none, step, arrays.data, arrays.field, LOOKED_AT, 0.0, False)
            states[j] = z[:n]
    return dense, states
