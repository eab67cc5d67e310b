"""Hard limits as the limit of a barrier: obstacles that cost nothing but must not be touched, and limits of states.

With hard limits, the running cost contains a barrier k b(d / scale) of the distance d from each limit, see
`leapnav.envs.field.barrier`. Its extremals approach those of the hard problem as the weight k decreases. An extremal
is followed to a weight at which the integral of the barrier is a given fraction of its cost: by Newton's method of
multiple shooting, from an extrapolation of the two preceding extremals. Close to a limit, d is proportional to sqrt(k),
so states and costates are extrapolated linearly in sqrt(k).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.multiple_shooting import confirm, polish
from leapnav.experts.solvers.nodes import SolverOptions

BARRIER_TOLERANCE = 1e-3  # largest integral of the barrier, as a fraction of the cost
# Factor of the weight of a step, and the factor above which a step is too small to continue. With 0.1, the extremals of
# `slalom` took 3.5 times as long, because most steps were repeated.
FACTOR, MAX_FACTOR = 0.3, 0.95
# Tolerance of the extremals on the way, which are not certified: with 1e-9 and certificates, the continuation took 1.6
# times as long.
TOLERANCE = 1e-3
# ... except after a step that failed: where corners pass corners, Newton's method needs accurate sensitivities.
FINE_TOLERANCE = 1e-6
# Steps of the integrator per segment: the segments are short where the barrier is steep. With 2 the continuation took
# 1.3 times as long; with 8 (16 from the first extremal) too, and one extremal of 100 stalled. If the last extremal
# stalls, 1 is tried.
STEPS_PER_SEGMENT, MIN_SEGMENTS = 4, 8
OPTIONS = SolverOptions(max_iterations=20)
# Smallest barrier weight of the first extremals, in units of the mean running cost E: of a search for several paths,
# and of a single path. With 0.1 E the extremals differ less from those of the limit, but direct transcription sometimes
# fails; with 2 E every method solves as many scenarios as with the proximity weight 1.
SEARCH_WEIGHT, SINGLE_WEIGHT = 0.2, 2.0
# Reduction of the cost, barrier included, on the way to the limit, as a multiple of the integral of the barrier: the
# expected one, since the cost without the barrier decreases about as much as the barrier, and the largest one.
EXPECTED_REDUCTION, LARGEST_REDUCTION = 2.0, 3.0
# Largest deviation from a constant Hamiltonian, relative to the variation of the barrier. In 240 references with hard
# obstacles it is 4e-5 in the median and at most 0.01, except in one of them, which is far from all obstacles.
MAX_FIT_ERROR = 0.1
MAX_FOLLOWED = 4  # local optima that are followed at most
GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)  # per step of the integrator


def softened(problem: OptimalControlProblem, energy: float, factor: float = SINGLE_WEIGHT) -> OptimalControlProblem:
    """Return a problem with the barrier weight of the first extremal, unless its proximity weight is larger.

    Args:
        problem: the problem; with a barrier weight it is returned as it is.
        energy: mean running cost E of a path.
        factor: barrier weight in units of E.

    """
    is_soft = problem.field is None or problem.proximity_weight >= factor * energy
    if problem.barrier_weight > 0.0 or (is_soft and not problem.has_hard_limits):
        return problem
    return problem.with_barrier(factor * energy)


def fitted_weight(problem: OptimalControlProblem, path: Trajectory, energy: float) -> float | None:
    """Return the barrier weight of a path with costates that is close to an extremal of a barrier problem.

    The Hamiltonian of the barrier problem is constant, so that without the barrier it is linear in the barrier, with
    the weight as the negative slope. In single precision the weight has four correct digits.

    Args:
        problem: the problem without a barrier weight.
        path: the path.
        energy: mean running cost E of the path.

    Returns:
        The weight; None if the path is not close to such an extremal, or too far from the limits.

    """
    if path.costates is None:
        return None
    states = np.asarray(path.states, dtype=float)
    barriers = problem.with_barrier(1.0).barrier_cost(states)
    values = hamiltonians(problem.arrays.flow, np.concatenate([states, path.costates], axis=1))
    barriers, values = barriers - barriers.mean(), values - values.mean()
    spread = float(barriers @ barriers)
    if spread == 0.0:
        return None
    weight = -float(barriers @ values) / spread
    error = float(np.linalg.norm(values + weight * barriers))
    is_close = error <= MAX_FIT_ERROR * weight * math.sqrt(spread)
    return weight if is_close and 0.0 < weight <= SINGLE_WEIGHT * energy else None


def barrier_integrals(extremal: Extremal) -> np.ndarray:
    """Return the integral of the barrier over each step (N - 1,) of an extremal."""
    step = np.diff(extremal.times)
    times = extremal.times[:-1, None] + step[:, None] * (0.5 + 0.5 * GAUSS_NODES)
    states = np.ascontiguousarray(extremal.interpolate(times.ravel())[:, : extremal.problem.system.n])
    return 0.5 * step * (extremal.problem.barrier_cost(states).reshape(times.shape) @ GAUSS_WEIGHTS)


def without_barrier(extremal: Extremal) -> Extremal:
    """Return an extremal whose costs exclude the barrier, with `Extremal.barrier`."""
    if len(extremal.times) == 0 or extremal.problem.barrier_weight == 0.0:
        return extremal
    integrals = barrier_integrals(extremal)
    accumulated, terms = extremal.accumulated.copy(), extremal.terms.copy()
    accumulated[1:] -= np.cumsum(integrals)
    terms[:, 0, -1] -= integrals  # the linear terms of the interpolant
    integral = float(integrals.sum())
    cost = extremal.cost - integral
    barrier = integral / abs(cost) if cost != 0.0 else math.inf
    return replace(extremal, cost=cost, accumulated=accumulated, terms=terms, barrier=barrier)


def expected_limit(extremal: Extremal) -> float:
    """Return the cost that is expected in the limit for an extremal whose cost excludes the barrier."""
    return extremal.cost - (EXPECTED_REDUCTION - 1.0) * extremal.barrier * abs(extremal.cost)


def follow_limit(extremal: Extremal, weight: float = 0.0, tolerance: float = BARRIER_TOLERANCE) -> Extremal:
    """Follow an extremal of a barrier to its limit.

    Args:
        extremal: the extremal of a problem with a barrier weight.
        weight: proximity weight of the obstacles, at which the continuation ends if there are no hard limits.
        tolerance: with hard limits, largest integral of the barrier as a fraction of the cost, at which it ends.

    Returns:
        The extremal, whose cost excludes the barrier. Its status is STALLED if the limit was not reached.

    """
    return _Continuation(extremal, weight, tolerance).run()


def follow_best(
    extremals: Sequence[Extremal], weight: float, tolerance: float = BARRIER_TOLERANCE, alternatives: bool = True
) -> list[Extremal]:
    """Follow the best local optima to the limit, in the order of the cost in the limit that is expected.

    Args:
        extremals: certified extremals, at least one.
        weight, tolerance: see `follow_limit`.
        alternatives: whether to follow others that cannot be the best.

    Returns:
        The results in order of cost.

    """
    if extremals[0].problem.barrier_weight == 0.0:
        return sorted(extremals, key=lambda extremal: extremal.cost)
    pending = sorted((_Continuation(extremal, weight, tolerance) for extremal in extremals), key=lambda c: c.expected)
    found: list[Extremal] = []
    for continuation in pending[:MAX_FOLLOWED]:
        best = min((one.cost for one in found if one.success), default=math.inf)
        if continuation.lowest < best or (alternatives and len(found) < 2):
            found.append(continuation.run(math.inf if alternatives else best))
    return sorted(found, key=lambda extremal: (not extremal.success, extremal.cost))


def _weight(problem: OptimalControlProblem) -> float:
    """Return the weight of the barrier; without a barrier, the proximity weight."""
    return problem.barrier_weight or problem.proximity_weight


class _Continuation:
    """The continuation of one extremal, see `follow_limit`."""

    def __init__(self, extremal: Extremal, weight: float, tolerance: float) -> None:
        self._weight, self._tolerance = 0.0 if extremal.problem.has_hard_limits else weight, tolerance
        self._first = extremal
        self._before: Extremal | None = None
        self._set(extremal)

    def _set(self, extremal: Extremal) -> None:
        self._extremal, self._limit = extremal, without_barrier(extremal)

    @property
    def expected(self) -> float:
        """The cost that is expected in the limit."""
        return expected_limit(self._limit)

    @property
    def lowest(self) -> float:
        """An estimate of the lowest cost that is possible in the limit."""
        return self._limit.cost - (LARGEST_REDUCTION - 1.0) * self._limit.barrier * abs(self._limit.cost)

    @property
    def _is_reached(self) -> bool:
        problem = self._extremal.problem
        return self._limit.barrier <= self._tolerance if problem.has_hard_limits else problem.barrier_weight == 0.0

    def run(self, max_cost: float = math.inf) -> Extremal:
        """Follow the extremal until its limit, or until it costs more than `max_cost`."""
        while self._approach(max_cost):
            if self._extremal.success:
                return self._limit
            certified = self._certified()
            if certified is None:
                break
            self._set(certified)  # its barrier may be slightly above the tolerance again
        return replace(self._limit, status=Status.STALLED)

    def _approach(self, max_cost: float) -> bool:
        """Decrease the weight until the limit is reached or costs more than `max_cost`; False if a step fails."""
        factor = FACTOR
        while not self._is_reached and self.lowest < max_cost:
            tolerance = TOLERANCE if factor == FACTOR else FINE_TOLERANCE
            found = self._step(max(factor * _weight(self._extremal.problem), self._weight), tolerance)
            if found is not None:
                self._before = self._extremal
                self._set(found)
                factor = max(FACTOR, factor**1.5)
            else:
                factor = math.sqrt(factor)
                if factor > MAX_FACTOR:
                    return False
        return True

    def _certified(self) -> Extremal | None:
        """Return the last extremal with a certificate; None if Newton's method does not converge.

        Its history begins with that of the first extremal.
        """
        problem, first = self._extremal.problem, self._first
        for steps in (STEPS_PER_SEGMENT, 1):
            times, nodes = self._nodes(steps)
            status, history, evaluations = polish(problem, times, nodes, OPTIONS.tol, OPTIONS.max_iterations)
            history, evaluations = (*first.history, *history), first.n_evaluations + evaluations
            found = confirm(problem, times, nodes, status, history, evaluations, OPTIONS)
            if found.success:
                return found
        return None

    def _step(self, weight: float, tolerance: float) -> Extremal | None:
        """Return the extremal at another weight, not certified; None if Newton's method does not converge."""
        problem = self._extremal.problem.with_barrier(weight if weight > self._weight else 0.0)
        for times, nodes in self._guesses(weight):
            status, _, _ = polish(problem, times, nodes, tolerance, OPTIONS.max_iterations)
            if status is Status.SUCCESS:
                found = certify(problem, times, nodes, Status.MAX_ITERATIONS)
                if found.status is Status.MAX_ITERATIONS and len(found.times):
                    return found
        return None

    def _nodes(self, steps_per_segment: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times and nodes of the last extremal."""
        extremal = self._extremal
        steps = len(extremal.times) - 1
        segments = max(round(steps / steps_per_segment), MIN_SEGMENTS)
        at = np.unique(np.rint(np.linspace(0, steps, segments + 1)).astype(int))
        return extremal.times[at], np.concatenate([extremal.states[at], extremal.costates[at]], axis=1)

    def _guesses(self, weight: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return times and nodes of initial guesses: extrapolated, and those of the last extremal."""
        extremal, before, n = self._extremal, self._before, self._extremal.problem.system.n
        times, nodes = self._nodes(STEPS_PER_SEGMENT)
        guesses = [(times.copy(), nodes.copy())]
        if before is not None:
            last, first = (math.sqrt(_weight(one.problem)) for one in (extremal, before))
            scale = (math.sqrt(weight) - last) / (last - first)
            extrapolated = nodes + scale * (nodes - before.interpolate(times * (before.horizon / extremal.horizon)))
            extrapolated[[0, -1], :n] = nodes[[0, -1], :n]
            guesses.insert(0, (times.copy(), extrapolated))
        return guesses
