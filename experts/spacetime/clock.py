"""Paths of robots as paths of problems whose last state is the time, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from leapnav.envs.utils.validation import as_matrix, as_vector
from leapnav.experts.numerics.shooting import hamiltonians
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory


def with_clock(problem: OptimalControlProblem, path: Trajectory) -> Trajectory:
    """Return a path of the robot as a path of a problem.

    If the time is the last state of the problem, it is added with its costate: since H + lambda_t is constant and
    lambda_t(T) = 0, that is lambda_t(t) = H(T) - H(t).

    Args:
        problem: the problem.
        path: the path, with states (K, n) of the problem, or without the time; it is returned unchanged if it has the
            time, or if the problem has none.

    """
    n = problem.system.n
    if problem.clock < 0 or np.ndim(path.states) != 2 or path.states.shape[1] != n - 1:
        return path
    times = as_vector("times", path.times)
    states = np.column_stack([as_matrix("states", path.states, len(times), n - 1), problem.start[-1] + times])
    if path.costates is None:
        return Trajectory(times, states)
    costates = np.column_stack([as_matrix("costates", path.costates, len(times), n - 1), np.zeros(len(times))])
    values = hamiltonians(problem.arrays.flow, np.concatenate([states, costates], axis=1))
    costates[:, -1] = values[-1] - values
    return Trajectory(times, states, costates)


def started_at(
    problem: OptimalControlProblem, path: Trajectory, time: float, field: np.ndarray | None
) -> tuple[OptimalControlProblem, Trajectory]:
    """Return a problem and a path of the rest of an episode with the time and the field of the whole episode.

    Args:
        problem: the problem of `Scenario.from_state`, whose time begins at 0.
        path: a path of the problem.
        time: s since the start of the episode.
        field: the packed field of the episode.

    """
    if problem.clock < 0:
        return problem, path
    states = path.states.copy()
    states[:, -1] += time
    whole = replace(problem, start=(*problem.start[:-1], problem.start[-1] + time), field=field)
    return whole, Trajectory(path.times, states, path.costates)
