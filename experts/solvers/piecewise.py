"""Paths of few pieces of constant controls to the goal, by optimisation of the durations of the pieces.

Where time is minimised, most controls are at a bound or zero, so that a path of few pieces is close to the optimum, or
the optimum itself. Random sequences of such controls are corrected by Gauss-Newton steps for the durations of their
pieces until they end at the goal, and then shortened within these sequences (C. Y. Kaya and J. L. Noakes,
"Computational method for time-optimal switching control", J. Optimization Theory and Applications 117, 2003). Unlike a
local optimum on a fixed horizon, a sequence needs no estimate of the time, and is met in any number of turns.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import CONSTANT, FLAGS, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.experts.numerics.flow import STEP_FUNCTION
from leapnav.experts.numerics.linear import eliminate, substitute
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.transcription.direct import DirectPath
from leapnav.experts.transcription.discrete_problem import roll_out

PIECES = 5  # as many as an optimal path of Reeds and Shepp's car
# Random sequences per scale of the time; then rounds of variations of the best sequences, variations per round, and
# sequences that are varied. In 160 tasks with known minimum times, these take 0.15 s per task, and the best times of 4
# tasks are more than 0.1 % too long, before the continuation. With 200 sequences and 3 rounds of 80 variations, it is 8
# of them after 0.29 s; with 60 sequences and 6 rounds of 40, 6 after 0.09 s.
WORDS, GENERATIONS, VARIATIONS, PARENTS = 100, 4, 60, 8
INSERTED = 0.1  # mean duration of the piece that a variation inserts, relative to the total time
# Scales of the time (s), powers of two, of which the smallest ones are skipped while the goal is out of reach; and the
# number of scales after the first with a path.
MIN_SCALE, MAX_SCALE, MORE_SCALES = -20, 24, 1
OUT_OF_REACH = 5.0  # distance of the goal in standard deviations of the ends of random sequences
SUBSTEPS = 16  # of the midpoint rule per piece
MAX_STEPS, MAX_HALVINGS = 60, 6  # Gauss-Newton steps, and halvings of each
# First steps, and the residual and the time relative to the best one above which the sequence is then given up.
FIRST_STEPS, MAX_FIRST_RESIDUAL, MAX_FIRST_TIME = 8, 0.1, 1.5
# Residual relative to the scales of the states at which a path ends at the goal, and the decrease of the total time,
# relative to it, at which its durations are optimal.
MAX_RESIDUAL, MIN_DECREASE = 1e-4, 1e-5
INCREMENT = 1e-6  # of a duration, relative to the total time, for derivatives
PENALTY = 10.0  # of the residual, relative to the total time
# Reduction of the total time per step that is tried, relative to the mean duration of a piece: first, smallest and
# largest.
FIRST_REDUCTION, MIN_REDUCTION, MAX_REDUCTION = 0.1, 1e-4, 0.4
MAX_PATHS = 8
SAME_TIME = 1e-3  # relative; paths whose times agree to this are one, or mirror images


class PiecewisePath(NamedTuple):
    """A path of pieces of constant controls that ends at the goal.

    Attributes:
        durations (K,): durations of the pieces (s).
        controls (K, m): their controls.
        problem: the problem with the winding of the path.

    """

    durations: np.ndarray
    controls: np.ndarray
    problem: OptimalControlProblem

    @property
    def time(self) -> float:
        """Total time (s)."""
        return float(self.durations.sum())

    def path(self, intervals: int, lengthening: float = 1.0) -> DirectPath:
        """Return the path on equal intervals, slower by a factor, without costates."""
        times = np.linspace(0.0, lengthening * self.time, intervals + 1)
        ends = np.cumsum(lengthening * self.durations)
        middles = 0.5 * (times[1:] + times[:-1])
        controls = self.controls[np.searchsorted(ends, middles).clip(0, len(ends) - 1)]
        states = np.empty((intervals + 1, self.problem.system.n))
        states[0] = self.problem.start
        step, data = self.problem.compiled_dynamics.step, self.problem.arrays.data
        roll_out(step, data, times / lengthening, controls, states)
        return DirectPath(times, states, controls, np.zeros_like(states), math.inf, math.inf, False)


class Task(NamedTuple):
    """What a path has to achieve.

    Attributes:
        step: step of the dynamics, see `leapnav.experts.numerics.flow`.
        data: constants of the dynamics.
        start, goal (n,): first and last state.
        free (n,): which components of the last state are free.
        winds (n,): which of them are met modulo 2 pi.
        scales (n,): units of the deviations from the goal.

    """

    step: FunctionPointer
    data: np.ndarray
    start: np.ndarray
    goal: np.ndarray
    free: np.ndarray
    winds: np.ndarray
    scales: np.ndarray


TASK = record_type(
    Task, step=STEP_FUNCTION, data=CONSTANT, start=VECTOR, goal=VECTOR, free=FLAGS, winds=FLAGS, scales=VECTOR
)


@kernel(boolean(TASK, MATRIX, VECTOR, VECTOR))
def end_of_pieces(task, controls, durations, end):
    """Fill the state (n,) at the end of the pieces; return whether it is finite."""
    before = task.start.copy()
    for k in range(len(durations)):
        if durations[k] == 0.0:
            continue
        for _ in range(SUBSTEPS):
            task.step(before, controls[k], durations[k] / SUBSTEPS, task.data, end)
            before[:] = end
    end[:] = before
    return bool(np.abs(before).max() < np.inf)


@kernel(float64(TASK, VECTOR, VECTOR))
def _residual(task, end, residual):
    """Fill the deviation from the goal relative to the scales; return its norm."""
    norm = 0.0
    for i in range(len(end)):
        deviation = 0.0 if task.free[i] else end[i] - task.goal[i]
        if task.winds[i]:
            deviation -= 2.0 * math.pi * np.rint(deviation / (2.0 * math.pi))
        residual[i] = deviation / task.scales[i]
        norm += residual[i] ** 2
    return math.sqrt(norm)


@kernel(NOTHING(TASK, MATRIX, VECTOR, VECTOR, MATRIX))
def _fill_jacobian(task, controls, durations, end, jacobian):
    """Fill the derivatives (n, K) of the residual by the durations, by finite differences."""
    moved = np.empty(len(end))
    increment = INCREMENT * durations.sum()
    for k in range(len(durations)):
        durations[k] += increment
        end_of_pieces(task, controls, durations, moved)
        durations[k] -= increment
        for i in range(len(end)):
            jacobian[i, k] = 0.0 if task.free[i] else (moved[i] - end[i]) / (increment * task.scales[i])


@kernel(NOTHING(MATRIX, VECTOR, VECTOR, float64, VECTOR))
def _correction(jacobian, residual, durations, shortening, change):
    """Fill the change of the durations that reduces the residual by least squares, and otherwise the total time.

    Durations stay at zero if they would become negative.
    """
    n, count = jacobian.shape
    active = np.ones(count)
    for _ in range(count):
        normal = np.zeros((n, n + 1))
        first, second = np.empty(n), np.empty(n)
        for right in range(2):
            for i in range(n):
                for j in range(n):
                    normal[i, j] = 1e-9 if i == j else 0.0
                    for k in range(count):
                        normal[i, j] += active[k] * jacobian[i, k] * jacobian[j, k]
                normal[i, n] = residual[i]
                if right == 1:
                    normal[i, n] = 0.0
                    for k in range(count):
                        normal[i, n] += active[k] * jacobian[i, k]
            if eliminate(normal, True, 1e-30) == 0.0:
                change[:] = 0.0
                return
            substitute(normal, first if right == 0 else second)
        changed = False
        for k in range(count):
            change[k] = -shortening
            for i in range(n):
                change[k] -= jacobian[i, k] * (first[i] - shortening * second[i])
            change[k] *= active[k]
            if durations[k] == 0.0 and change[k] < 0.0:
                active[k], change[k], changed = 0.0, 0.0, True
        if not changed:
            return


@kernel(tuple_of(float64, float64)(TASK, MATRIX, VECTOR, float64))
def shorten(task, controls, durations, limit):
    """Change the durations of the pieces in place, so that they end at the goal after a short time.

    Gives up after the first steps if the time is above `limit`. Returns the residual and the total time.
    """
    n, count = len(task.start), len(durations)
    end, moved, residual, changed = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    jacobian, change, trial = np.empty((n, count)), np.empty(count), np.empty(count)
    if not end_of_pieces(task, controls, durations, end):
        return np.inf, np.inf
    norm = _residual(task, end, residual)
    unit = durations.sum()
    factor = FIRST_REDUCTION
    for iteration in range(MAX_STEPS):
        total = durations.sum()
        _fill_jacobian(task, controls, durations, end, jacobian)
        _correction(jacobian, residual, durations, factor * total / count, change)
        largest = np.abs(change).max()
        damping = min(1.0, 0.5 * total / largest) if largest > 0.0 else 1.0
        better, trial_norm = False, np.inf
        for _ in range(MAX_HALVINGS):
            for k in range(count):
                trial[k] = max(durations[k] + damping * change[k], 0.0)
            if end_of_pieces(task, controls, trial, moved):
                trial_norm = _residual(task, moved, changed)
                better = PENALTY * trial_norm + trial.sum() / unit < PENALTY * norm + total / unit
                if better:
                    break
            damping *= 0.5
        if not better:
            factor *= 0.25
            if factor < MIN_REDUCTION:
                break
            continue
        decrease = total - trial.sum()
        durations[:] = trial
        end[:] = moved
        residual[:] = changed
        norm = trial_norm
        if damping == 1.0:
            factor = min(2.0 * factor, MAX_REDUCTION)
        if norm < 0.1 * MAX_RESIDUAL and abs(decrease) < MIN_DECREASE * total:
            break
        if iteration == FIRST_STEPS and (norm > MAX_FIRST_RESIDUAL or durations.sum() > limit):
            break
    return norm, durations.sum()


def piecewise_paths(problem: OptimalControlProblem, seed: int = 0) -> list[PiecewisePath]:
    """Return distinct paths of few pieces with each control at a bound or zero, in order of their times.

    Args:
        problem: a problem with finite control bounds. Its obstacles and limits of states are ignored.
        seed: random seed.

    """
    search = _Search(problem, np.random.default_rng(seed))
    more = MORE_SCALES
    for exponent in range(MIN_SCALE, MAX_SCALE):
        search.sample(2.0**exponent)
        if search.found:
            more -= 1
            if more < 0:
                break
    for _ in range(GENERATIONS):
        search.vary()
    return search.best(MAX_PATHS)


class _Search:
    """The search for sequences of pieces."""

    def __init__(self, problem: OptimalControlProblem, rng: np.random.Generator) -> None:
        self.problem, self.rng = problem, rng
        self.found: list[tuple[float, np.ndarray, np.ndarray]] = []  # time, durations, controls
        assert problem.control_bounds is not None
        values = [sorted({low, min(max(0.0, low), high), high}) for low, high in problem.control_bounds]
        levels = itertools.product(*values)
        is_driftless = all(rate == 0 for rate in problem.system.drift)
        self._levels = np.array([level for level in levels if any(level) or not is_driftless])
        n, arrays = problem.system.n, problem.arrays
        winds = np.zeros(n, dtype=bool)
        winds[list(problem.winding_states)] = True
        ends = arrays.start, arrays.goal, arrays.free
        self._task = Task(problem.compiled_dynamics.step, arrays.data, *ends, winds, np.ones(n))

    def sample(self, scale: float) -> None:
        """Add random sequences whose total time is about `scale` (s), unless the goal is out of reach."""
        durations = self.rng.exponential(scale / PIECES, size=(WORDS, PIECES))
        words = self.rng.integers(0, len(self._levels), size=(WORDS, PIECES))
        task = self._task
        ends = np.empty((WORDS, len(task.start)))
        finite = [end_of_pieces(task, self._levels[w], d, e) for w, d, e in zip(words, durations, ends, strict=True)]
        if not any(finite):
            return
        distances = np.where(task.free, 0.0, task.goal - task.start)
        distances[task.winds] -= 2 * math.pi * np.rint(distances[task.winds] / (2 * math.pi))
        reach = ends[finite].std(axis=0)
        if not self.found and (np.abs(distances) > OUT_OF_REACH * reach + 1e-12).any():
            return
        self._task = task._replace(scales=np.maximum(np.abs(distances), reach) + 1e-12)
        for word, d in zip(words, durations, strict=True):
            self._add(self._levels[word], d)

    def vary(self) -> None:
        """Add variations of the best sequences, with another piece inserted at a random place."""
        parents = self.best(PARENTS)
        for _ in range(VARIATIONS if parents else 0):
            parent = parents[self.rng.integers(len(parents))]
            durations, controls = parent.durations.copy(), parent.controls.copy()
            shortest = int(durations.argmin())
            durations, controls = np.delete(durations, shortest), np.delete(controls, shortest, axis=0)
            at = int(self.rng.integers(PIECES))
            level = self._levels[self.rng.integers(len(self._levels))]
            durations = np.insert(durations, at, self.rng.exponential(INSERTED * parent.time))
            self._add(np.insert(controls, at, level, axis=0), durations)

    def _add(self, controls: np.ndarray, durations: np.ndarray) -> None:
        """Add the path of a sequence, if it ends at the goal."""
        limit = MAX_FIRST_TIME * min((found[0] for found in self.found), default=math.inf)
        residual, time = shorten(self._task, controls, durations, limit)
        if residual < MAX_RESIDUAL and time > 0.0:
            self.found.append((time, durations, controls))

    def best(self, count: int) -> list[PiecewisePath]:
        """Return the best distinct paths in order of their times, those of different times."""
        chosen: list[PiecewisePath] = []
        for time, durations, controls in sorted(self.found, key=lambda entry: entry[0]):
            if not chosen or time > chosen[-1].time * (1.0 + SAME_TIME):
                chosen.append(PiecewisePath(durations, controls, self.problem))
                if len(chosen) == count:
                    break
        return chosen
