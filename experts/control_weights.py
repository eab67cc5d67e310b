"""Continuation to small control weights, the limit in which time or length is minimised.

The flow is sensitive where the controls switch, and more so the smaller their weights are. An extremal is followed by
Newton's method of multiple shooting. Where that stalls, the problem is transcribed again: in the time of the last
extremal, which is longer than necessary, direct transcription finds the local optimum with its costates.
"""

from __future__ import annotations

import math

import numpy as np

from leapnav.envs.field.clearance import path_clearance
from leapnav.experts.continuation import blend
from leapnav.experts.hard_limits import follow_limit, softened, without_barrier
from leapnav.experts.numerics.state_bounds import state_margin
from leapnav.experts.numerics.step_halving import step_halving
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solve import Method, solve
from leapnav.experts.transcription.direct import DirectPath, mean_running_cost, optimise

# Segments of multiple shooting after a transcription and, at least, of a continuation; intervals of a transcription per
# segment.
SEGMENTS, MIN_SEGMENTS, INTERVALS_PER_SEGMENT = 32, 8, 2
INTERVALS = INTERVALS_PER_SEGMENT * SEGMENTS
# Newton steps of an attempt; without the limit, a divergent one takes up to 6 s.
MAX_ITERATIONS = 20
SMALLEST_STEP = 1 / 64  # between two control weights
BARRIER_FACTOR = 0.25  # of the barrier weight from one transcription to the next
# Sum of the constraint violations of a transcription. With 1e-2, one problem of dynobench is solved only to a tolerance
# of 0.25 instead of 0.02: Newton's method also converges from some transcriptions that have not.
MAX_VIOLATION = 1.0


def is_free(problem: OptimalControlProblem, states: np.ndarray) -> bool:
    """Return whether a path (N, n) is within the limits of the states and not in contact with an obstacle."""
    if state_margin(problem.state_limits, states) <= 0:
        return False
    if problem.field is None or problem.system.position is None:
        return True
    if problem.outline[:, 4].any():  # the outline of a robot model, with joints
        return path_clearance(np.ascontiguousarray(states), problem.outline, problem.field) > 0
    at = [problem.system.state.index(symbol) for symbol in problem.system.position]
    heading = problem.system.heading
    headings = np.zeros(len(states)) if heading is None else states[:, problem.system.state.index(heading)]
    poses = np.column_stack([states[:, at], headings])
    return path_clearance(np.ascontiguousarray(poses), problem.outline, problem.field) > 0


def transcribed(problem: OptimalControlProblem, guess: DirectPath, segments: int = SEGMENTS) -> Extremal | None:
    """Return the extremal close to the local optimum of the discretised problem in the time of a guess.

    Args:
        problem: the problem, with a free horizon.
        guess: the path from which the descent starts; its intervals are those of the discretisation.
        segments: number of segments of multiple shooting.

    """
    energy = mean_running_cost(problem, Trajectory(guess.times, guess.states))
    fixed = softened(problem, energy).with_horizon(float(guess.times[-1]))
    path = optimise(fixed, guess)
    if not path.violation < MAX_VIOLATION:
        return None
    trajectory = Trajectory(path.times, path.states, path.costates)
    extremal = solve(problem, "multiple_shooting", trajectory, max_iterations=MAX_ITERATIONS, segments=segments)
    return extremal if extremal.success else None


def next_extremal(extremal: Extremal, problem: OptimalControlProblem) -> Extremal:
    """Solve a problem from the extremal of a similar one, and where Newton's method stalls, from a new transcription.

    The last resort are intermediate control weights and shorter segments.
    """
    segments = max(extremal.n_nodes - 1, MIN_SEGMENTS)
    found = solve(problem, "multiple_shooting", extremal, max_iterations=MAX_ITERATIONS, segments=segments)
    if found.success:
        return found
    # Longer segments than those of the last extremal are too sensitive.
    segments = max(SEGMENTS, segments)
    times = np.linspace(0.0, extremal.horizon, INTERVALS_PER_SEGMENT * segments + 1)
    states = extremal.evaluate(times)[0]
    controls = extremal.evaluate(0.5 * (times[1:] + times[:-1]))[1]
    guess = DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False)
    again = transcribed(problem, guess, segments)
    if again is not None:
        return again
    return continued(extremal, problem, "multiple_shooting") or found


def continued(extremal: Extremal, problem: OptimalControlProblem, method: Method) -> Extremal | None:
    """Solve a problem from the extremal of a similar one, by way of intermediate problems if necessary."""
    origin = extremal.problem

    def advance(fraction: float, guess: Extremal) -> Extremal | None:
        between = problem if fraction == 1.0 else blend(origin, problem, fraction)
        if method == "multiple_shooting":  # without more and more segments, which took 100 s where it fails
            segments = max(2 * SEGMENTS, guess.n_nodes - 1)
            found = solve(between, method, guess, max_iterations=MAX_ITERATIONS, segments=segments)
        else:
            found = solve(between, method, guess)
        return found if found.success else None

    return step_halving(advance, extremal, min_step=SMALLEST_STEP)


def limit_of(extremal: Extremal) -> Extremal:
    """Return the extremal close to the limit of hard limits; with the barrier that it has if that is not reached.

    Where Newton's method stalls on the way, the problem is transcribed again with a smaller barrier.
    """
    while True:
        limit = follow_limit(extremal)
        if limit.success or not extremal.problem.has_hard_limits:
            return limit if limit.success else without_barrier(extremal)
        problem = extremal.problem
        found = next_extremal(extremal, problem.with_barrier(BARRIER_FACTOR * problem.barrier_weight))
        if not found.success:
            return without_barrier(extremal)
        extremal = found
