"""The barrier of hard limits in the expert's feedback: its weight for a reference, and its part of a cost."""

from __future__ import annotations

import itertools
import math

import numpy as np

from leapnav.experts.acting.tracking import follow_all
from leapnav.experts.hard_limits import GAUSS_NODES, GAUSS_WEIGHTS, SEARCH_WEIGHT, fitted_weight
from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.transcription.direct import mean_running_cost

# Panel (s) of the Gauss rule for the integral of the barrier. On 30 optima its error is at most 1 % of the integral,
# which is itself about 0.1 % of the cost.
PANEL = 0.1


def reference_problem(problem: OptimalControlProblem, path: Trajectory | Extremal) -> OptimalControlProblem:
    """Return a problem with the barrier weight of a reference; far from all limits, with that of a search.

    Args:
        problem: the problem, without a barrier weight.
        path: an extremal of the problem with a barrier, or a path.

    """
    if not problem.has_hard_limits:
        return problem
    if isinstance(path, Extremal):
        return problem.with_barrier(path.problem.barrier_weight)
    energy = mean_running_cost(problem, path)
    return problem.with_barrier(fitted_weight(problem, path, energy) or SEARCH_WEIGHT * energy)


def barrier_integral(problem: OptimalControlProblem, times: np.ndarray, nodes: np.ndarray) -> float:
    """Return the integral of the barrier along the extremal through nodes (K + 1, 2n) at times (K + 1,) (s)."""
    if not problem.has_hard_limits:
        return 0.0
    segments = [
        np.linspace(start, end, math.ceil((end - start) / PANEL - 1e-9), endpoint=False)
        for start, end in itertools.pairwise(times)
    ]
    ends = np.append(np.concatenate(segments), times[-1])
    half = 0.5 * np.diff(ends)[:, None]
    moments = ends[:-1, None] + half * (1.0 + GAUSS_NODES)
    states = follow_all(problem.arrays.flow, times, nodes, moments.ravel())
    return float((half * problem.barrier_cost(states).reshape(moments.shape) @ GAUSS_WEIGHTS).sum())
