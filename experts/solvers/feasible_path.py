"""The iterate of the Leapfrog method: a feasible path of arcs, and the operations that keep it feasible.

Each arc is an extremal from one node to the next, found by single shooting. See `leapnav.experts.solvers.leapfrog` for
the method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from leapnav.experts.numerics.flow import NewtonOptions
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.numerics.time_scaling import time_factor
from leapnav.experts.problem.extremal import Iteration
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.solvers.initial_paths import local_minima
from leapnav.experts.solvers.sweeps import ArcPath, connect, measure_defects, merge, sweep

MAX_ITERATIONS = 12  # Newton steps per sub-problem
LONG_ARC_ACCURACY = 1e-13  # tolerance of the integrator for long arcs, along which errors grow
MAX_STATE_DEFECT = 5e-10  # a larger defect of the states requires a more accurate integrator
# Tolerance of the integrator for paths that are displayed: errors grow along long arcs, but these must look connected.
DISPLAY_ACCURACY = 1e-10
# Intervals and initial controls of the search for an arc that shooting does not find.
STEERING_INTERVALS, STEERING_STARTS = 16, 6
# Smallest factor of a free horizon per sweep, largest number of halved steps, and relative rounding error of the cost.
MIN_FACTOR, MAX_HALVINGS, COST_ROUNDING = 0.5, 4, 1e-13


@dataclass
class FeasiblePath:
    """A path of p arcs, each an extremal from one node to the next.

    Attributes:
        problem: the problem.
        times: (p + 1,), of the nodes (s); changed in place.
        nodes: (p + 1, 2n), states and costates; changed in place.
        tolerance: largest end error of an arc.
        accuracy: tolerance of the integrator.
        half_cost: whether nodes move to half of their sub-problem's cost instead of to the mean time.
        costs: (p,), of the arcs; infinite if two nodes are not connected.
        history: one iteration per sweep.
        evaluations: number of evaluations of the flow.

    """

    problem: OptimalControlProblem
    times: np.ndarray
    nodes: np.ndarray
    tolerance: float
    accuracy: float
    half_cost: bool = False
    costs: np.ndarray = field(init=False)
    history: list[Iteration] = field(default_factory=list)
    evaluations: int = 0

    def __post_init__(self) -> None:
        self._connect()
        self._connect_remaining()
        self._record("sweep", ())

    @property
    def feasible(self) -> bool:
        """Whether all pairs of neighbouring nodes are connected."""
        return bool(np.isfinite(self.costs).all())

    def _connect(self) -> None:
        """Solve for each arc separately."""
        self.costs = np.empty(self.segments)
        arrays = self.problem.arrays
        _, evaluations = connect(arrays.flow, self._arcs, arrays.end, self._newton(MAX_ITERATIONS))
        self.evaluations += evaluations

    @property
    def _arcs(self) -> ArcPath:
        """The path in the form that the kernels take."""
        return ArcPath(self.times, self.nodes, self.costs)

    def _newton(self, iterations: int) -> NewtonOptions:
        # Sweeps compare costs, which with adaptive accuracy are not those of the last iterate: without polishing, 2 of
        # 16 scenarios would be solved instead of all.
        return NewtonOptions(self.tolerance, self.accuracy, iterations, adaptive=False)

    def _connect_remaining(self) -> None:
        """Connect the nodes that shooting did not connect.

        Tries longer arcs without some of the nodes first, and then a search for local minima on piecewise constant
        controls.
        """
        while not self.feasible and self.segments > 1:
            k = int(np.flatnonzero(np.isinf(self.costs))[0])
            spans = [(a, b) for a, b in ((k, k + 2), (k - 1, k + 1), (k - 1, k + 2)) if a >= 0 and b <= self.segments]
            # Shooting over each span is tried first, because it takes 1/100 of the time of the search.
            if not any(self._join(a, b, search) for search in (False, True) for a, b in [*spans, (k, k + 1)]):
                if not spans:
                    return
                self._replace(*spans[0], self.nodes[list(spans[0])], math.inf)

    def _join(self, a: int, b: int, search: bool) -> bool:
        """Connect node a to node b by one arc and remove the nodes between them; return False if that fails.

        With `search` the initial costates come from local minima on piecewise constant controls.
        """
        n = self.problem.system.n
        last = b == self.segments
        duration = float(self.times[b] - self.times[a])
        goal = self.problem.goal if last else tuple(self.nodes[b, :n].tolist())
        part = self.problem.between(tuple(self.nodes[a, :n].tolist()), goal, duration)
        arrays = part.arrays
        minima = local_minima(part, STEERING_INTERVALS, STEERING_STARTS) if search else [(0.0, None)]
        for _, path in sorted(minima, key=lambda entry: entry[0]):
            nodes, cost = self.nodes[[a, b]], np.empty(1)
            if path is not None and path.costates is not None:
                nodes[0, n:] = path.costates[0]
            arcs = ArcPath(np.array([0.0, duration]), nodes, cost)
            failed, evaluations = connect(arrays.flow, arcs, arrays.end, self._newton(MAX_ITERATIONS))
            self.evaluations += evaluations
            if not failed:
                self._replace(a, b, nodes, cost[0])
                return True
        return False

    def _replace(self, a: int, b: int, nodes: np.ndarray, cost: float) -> None:
        """Replace the arcs from node a to node b by one arc with these end nodes (2, 2n)."""
        self.times = np.delete(self.times, np.s_[a + 1 : b])
        self.nodes = np.delete(self.nodes, np.s_[a + 1 : b], axis=0)
        self.costs = np.delete(self.costs, np.s_[a + 1 : b])
        self.nodes[a] = nodes[0]
        if a + 1 == self.segments:
            self.nodes[-1] = nodes[1]
        self.costs[a] = cost

    @property
    def segments(self) -> int:
        """Number of arcs."""
        return len(self.times) - 1

    @property
    def cost(self) -> float:
        """J of the path; infinite if it is not feasible."""
        return float(self.costs.sum())

    def sweep(self, red_black: bool = False) -> None:
        """Move every inner node once: in order, or with `red_black` first the odd and then the even nodes.

        With a free horizon, all times are scaled afterwards.
        """
        rejected = np.zeros(self.segments + 1, dtype=bool)
        arrays, newton = self.problem.arrays, self._newton(MAX_ITERATIONS)
        for first, stride in ((1, 2), (2, 2)) if red_black else ((1, 1),):
            self.evaluations += sweep(
                arrays.flow, self._arcs, arrays.end, newton, self.half_cost, first, stride, rejected
            )
        if self.problem.horizon is None:
            self.rescale()
        self._record("sweep", tuple(np.flatnonzero(rejected).tolist()))

    def rescale(self) -> None:
        """Scale all times where that reduces the cost; the nodes keep their states.

        The derivative of the cost by the factor s of the times is the sum of the Hamiltonians of the arcs times their
        durations. The step is exact for systems without drift, whose cost is E / s + P s.
        """
        values = hamiltonians(self.problem.arrays.flow, self.nodes[:-1])
        slope, before = float(values @ np.diff(self.times)), self.cost
        self.evaluations += len(values)
        factor = time_factor(before, slope, MIN_FACTOR)
        times, nodes, costs = self.times, self.nodes, self.costs
        for _ in range(MAX_HALVINGS):
            self.times, self.nodes = factor * times, nodes.copy()
            self.nodes[:, self.problem.system.n :] /= factor  # exact without drift and state cost
            self._connect()
            if self.cost <= before + COST_ROUNDING * (1.0 + abs(before)):
                return
            factor = 1.0 + 0.5 * (factor - 1.0)
        self.times, self.nodes, self.costs = times, nodes, costs

    def reduce(self) -> int:
        """Remove at most every other node where that does not raise the cost; return the number of removed nodes."""
        keep, rejected = np.ones(self.segments + 1, dtype=bool), np.zeros(self.segments + 1, dtype=bool)
        arrays, newton = self.problem.arrays, self._newton(4 * MAX_ITERATIONS)
        self.evaluations += merge(arrays.flow, self._arcs, arrays.end, newton, keep, rejected)
        self.times, self.nodes = self.times[keep].copy(), self.nodes[keep].copy()
        # The arc of a removed node has become part of the arc before it.
        self.costs = self.costs[keep[:-1]].copy()
        self._record("reduce", tuple(np.flatnonzero(rejected).tolist()))
        return int((~keep).sum())

    @property
    def states(self) -> np.ndarray:
        """States of the nodes, (p + 1, n)."""
        return self.nodes[:, : self.problem.system.n]

    @property
    def costates(self) -> np.ndarray:
        """Costates of the nodes, (p + 1, n)."""
        return self.nodes[:, self.problem.system.n :]

    def defects(self) -> tuple[float, float]:
        """Return the largest defect at a node of the states (end conditions included) and of the costates.

        A path without defects of the costates is an extremal.
        """
        arrays = self.problem.arrays
        states, costates, evaluations = measure_defects(arrays.flow, self._arcs, arrays.end, self.accuracy)
        self.evaluations += evaluations
        return states, costates

    def split(self) -> bool:
        """Divide every arc in two, which changes neither the path nor its cost; False if an arc diverges."""
        arrays, size = self.problem.arrays, self.nodes.shape[1]
        times, nodes = np.repeat(self.times, 2)[:-1], np.repeat(self.nodes, 2, axis=0)[:-1]
        times[1::2] = (self.times[1:] + self.times[:-1]) / 2
        costs = np.repeat(self.costs, 2)
        for k in range(self.segments):
            half = times[2 * k + 1] - times[2 * k]
            z, none = self.nodes[k].copy(), np.empty((size, 0))
            success, cost, _, _, evaluations = propagate(arrays.flow, z, none, half, self.accuracy, 0.0, False)
            self.evaluations += evaluations
            if not success:
                return False
            nodes[2 * k + 1] = z
            costs[2 * k : 2 * k + 2] = cost, self.costs[k] - cost
        self.times, self.nodes, self.costs = times, nodes, costs
        return True

    def _record(self, phase: str, rejected: tuple[int, ...]) -> None:
        """Append an iteration to the history; increase the accuracy of the integrator if the defects require it."""
        residual = self._residual()
        if MAX_STATE_DEFECT < residual < math.inf and self.accuracy > LONG_ARC_ACCURACY:
            self.accuracy = LONG_ARC_ACCURACY
            self._connect()
            residual = self._residual()
        row = Iteration(phase, self.segments, self.cost, residual, rejected, self.times.copy(), self.nodes.copy())
        self.history.append(row)

    def _residual(self) -> float:
        return self.defects()[0] if self.feasible else math.inf


def select_sweeps(n_sweeps: int, n_first: int, max_selected: int) -> list[int]:
    """Select indices of sweeps to display: the first ones, which change most, and others evenly spaced."""
    rest = np.linspace(n_first, n_sweeps - 1, max_selected - n_first).round().astype(int) if n_sweeps > n_first else []
    return sorted({*range(min(n_first, n_sweeps)), *map(int, rest)})


def dense_path(
    problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray, points: int
) -> tuple[np.ndarray, np.ndarray]:
    """Compute points along the path of a sweep.

    Args:
        problem: the problem that was solved.
        times: (p + 1,), times of the nodes, see `Iteration`.
        nodes: (p + 1, 2n).
        points: smallest number of points.

    Returns:
        Times (K,) and states (K, n), K >= points. States are NaN from where the flow diverges to the next node, which
        leaves a gap in a plot.

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
            success, *_ = propagate(arrays.flow, z, none, step, DISPLAY_ACCURACY, 0.0, False)
            if not success:
                states[j : at + steps + 1] = np.nan
                break
            states[j] = z[:n]
    return dense, states
