"""Local optima close to obstacles: direct transcription on meshes that follow the path, with a barrier that steepens.

On a fixed mesh, a path touches obstacles where the intervals are longest, because the barrier acts at the nodes only.
The mesh is therefore computed again after each descent: the intervals are short where the clearance is small, and their
lengths change slowly along the path, so that a contact that moves does not leave the short ones. The descents begin
with a large weight of the barrier, far from the obstacles, and with the horizon of the guess.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from leapnav.envs.field.clearance import footprint_clearances, path_clearance
from leapnav.envs.field.layout import read_header
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.transcription.direct import MAX_VIOLATION, DirectPath, optimise

# The coarsest mesh: largest interval (horizons), largest motion of the outline in an interval relative to the
# clearance, and largest change of the length from an interval to the next. Each mesh halves the three.
LONGEST, RESOLUTION, GROWTH, MESHES = 1 / 150, 0.5, 0.1, 4
SMALLEST_CLEARANCE = 0.01  # proximity scales; the mesh does not resolve smaller clearances
# First weight of the barrier, in units of the mean running cost, the factor from one to the next, and the distance
# (proximity scales) below which the barrier is a quadratic polynomial while its weight is large.
FIRST_WEIGHT, WEIGHT_FACTOR, RELAXED_DISTANCE = 8.0, 0.35, 0.2
MAX_ITERATIONS, FIRST_ITERATIONS = 50, 200  # of a descent, and of the first one
# Horizon: smallest factor of a step, largest numbers of steps and of halvings of one, and relative tolerance, which is
# divided by 4 when the weight is that of the problem.
SMALLEST_FACTOR, MAX_STEPS, MAX_HALVINGS, TOLERANCE = 0.85, 20, 2, 0.02
FINER = 2  # meshes that are tried if the path crosses an obstacle between the nodes
MAX_INCREASE = 1.2  # factor of the cost in a descent; after a larger one, the path touches an obstacle
MAX_ROUNDS, MIN_DECREASE = 8, 1e-3  # of descents on a mesh, and relative decrease of the cost after which one follows
INTERVALS_PER_SEGMENT = 8  # of multiple shooting from a path
# Numbers of segments of the last attempts. In a door of 0.45 m, 8, 32 and 64 segments converge, but 16, 28, 57 and 114
# do not: with many nodes near an edge, the closest feature changes from one Newton step to the next.
FEW_SEGMENTS = 32, 8


def settle(problem: OptimalControlProblem, guess: DirectPath, energy: float) -> Iterator[DirectPath]:
    """Yield the local optimum near a path, on meshes that become finer.

    Args:
        problem: the problem with obstacles.
        guess: the path, free of contact; its dynamics may be violated a little, and its horizon may be another one.
        energy: mean running cost E of a path.

    Yields:
        Paths close to an extremal; none if a descent fails.

    """
    descent = _Descent(problem)
    path: DirectPath | None = replace(guess, cost=math.inf)  # its cost has another weight
    weight = FIRST_WEIGHT * energy
    while weight > problem.proximity_weight and path is not None:
        descent.problem = problem.with_barrier(weight)
        descent.relaxed_distance = RELAXED_DISTANCE if weight > energy else None  # a small barrier would be crossed
        path = descent.improved(path, 1.0, FIRST_ITERATIONS)
        path = None if path is None else descent.with_best_horizon(path, TOLERANCE)
        weight *= WEIGHT_FACTOR
    descent.problem, descent.relaxed_distance = problem, None
    for mesh in range(MESHES):
        descent.mesh = mesh
        for _ in range(MAX_ROUNDS):
            improved = None if path is None else descent.improved(path, 1.0)
            if path is None or improved is None:
                return
            cost, path = path.cost, descent.with_best_horizon(improved, TOLERANCE / 4)
            if path.cost > cost - MIN_DECREASE * abs(cost):
                break
        assert path is not None
        if problem.horizon is not None and not math.isclose(path.times[-1], problem.horizon):
            return  # the descents failed before the horizon was reached
        yield path


def settled_attempts(
    problem: OptimalControlProblem, guess: DirectPath, energy: float
) -> Iterator[tuple[int, DirectPath]]:
    """Yield numbers of segments of multiple shooting, each with a path of `settle` to apply it to."""
    path = None
    for path in settle(problem, guess, energy):
        yield len(path.controls) // INTERVALS_PER_SEGMENT, path
    if path is not None:
        yield from ((segments, path) for segments in FEW_SEGMENTS)


class _Descent:
    """Descents of a problem, each on a mesh for the path of the one before.

    Args:
        problem: the problem.

    Attributes:
        problem: the problem, with the present weight of the barrier.
        relaxed_distance: see `optimise`; None for the barrier itself.
        mesh: number of times that the coarsest mesh is halved.

    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        assert problem.field is not None
        self.problem, self.mesh = problem, 0
        self.relaxed_distance: float | None = RELAXED_DISTANCE
        self._field, self._outline = problem.field, problem.outline
        sizes = np.hypot(np.abs(self._outline[:, :2]).max(axis=1), self._outline[:, 2]) + self._outline[:, 3]
        self._reach = float(sizes.max())
        self._smallest = SMALLEST_CLEARANCE * float(read_header(self._field)["scale"])

    def improved(self, path: DirectPath, factor: float, iterations: int = MAX_ITERATIONS) -> DirectPath | None:
        """Return the optimum on a mesh for a path, with its times multiplied by a factor; None if the descent fails."""
        weight = None if self.relaxed_distance is None else self.problem.proximity_weight
        for mesh in range(self.mesh, self.mesh + FINER + 1):
            guess = path.resampled(self._nodes(path, mesh)).scaled(factor)
            found = optimise(self.problem, guess, iterations, weight, self.relaxed_distance)
            if not found.violation < MAX_VIOLATION or not found.cost < MAX_INCREASE * path.cost:
                return None
            if path_clearance(found.states, self._outline, self._field) > 0.0:
                return found
        return None

    def with_best_horizon(self, path: DirectPath, tolerance: float) -> DirectPath:
        """Return the optimum with the best horizon, or with that of the problem; that of the last descent if one fails.

        The derivative of the cost with respect to the horizon is zero there. It is found by regula falsi.
        """
        short = long = None  # horizons and derivatives on both sides
        for _ in range(MAX_STEPS):
            horizon, slope = float(path.times[-1]), path.slope(self.problem)
            if self.problem.horizon is not None:
                factor = min(max(self.problem.horizon / horizon, SMALLEST_FACTOR), 1.0 / SMALLEST_FACTOR)
            elif slope > 0:
                long = horizon, slope
                factor = max(SMALLEST_FACTOR, 1.0 - slope / path.cost)
            else:
                short = horizon, slope
                factor = min(1.0 / SMALLEST_FACTOR, 1.0 - slope / path.cost)
            if short is not None and long is not None:
                if long[0] - short[0] < tolerance * short[0]:  # also negative, after a descent to another optimum
                    break
                fraction = short[1] / (short[1] - long[1])
                factor = (short[0] + (long[0] - short[0]) * min(max(fraction, 0.2), 0.8)) / horizon
            if abs(factor - 1.0) < (tolerance / 2 if self.problem.horizon is None else 1e-12):
                break
            tried = (self.improved(path, factor**0.5**halving) for halving in range(MAX_HALVINGS + 1))
            following = next((found for found in tried if found is not None), None)
            if following is None:
                break
            path = following
        return path

    def _nodes(self, path: DirectPath, mesh: int) -> np.ndarray:
        """Return the times of the nodes of a mesh for a path."""
        times, states = path.times, path.states
        steps, fineness = np.diff(times), 0.5**mesh
        middles = 0.5 * (times[1:] + times[:-1])
        clearances = footprint_clearances(states, self._outline, self._field)
        clearances = np.minimum(np.minimum(clearances[1:], clearances[:-1]), self._between(states))
        motion = np.hypot(*np.diff(states[:, :2], axis=0).T) + self._reach * np.abs(np.diff(states[:, 2]))
        resolved = RESOLUTION * fineness * (np.maximum(clearances, 0.0) + self._smallest)
        longest = np.minimum(LONGEST * fineness * times[-1], steps * resolved / np.maximum(motion, 1e-12))
        growth = GROWTH * fineness * middles
        longest = growth + np.minimum.accumulate(longest - growth)
        longest = np.minimum.accumulate((longest + growth)[::-1])[::-1] - growth
        counts = np.append(0.0, np.cumsum(steps / longest))
        nodes = np.interp(np.linspace(0.0, counts[-1], math.ceil(counts[-1]) + 1), counts, times)
        nodes[0], nodes[-1] = times[0], times[-1]
        return nodes

    def _between(self, states: np.ndarray) -> np.ndarray:
        """Return the clearances (N,) in the middles between states."""
        return footprint_clearances(0.5 * (states[1:] + states[:-1]), self._outline, self._field)
