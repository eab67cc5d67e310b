"""Options of the solvers, and their initial nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from leapnav.experts.problem.extremal import Extremal
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory

MIN_SEGMENTS, MAX_SEGMENTS = 8, 128  # by default
POINTS_PER_SEGMENT = 8  # at which an extremal is sampled if it is the initial guess


@dataclass(frozen=True)
class SolverOptions:
    """Options of a solver.

    Attributes:
        tol: largest residual of the boundary and continuity conditions.
        max_iterations: largest number of Newton steps.
        segments: number of shooting segments; None chooses it from the guess.
        mesh: times (segments + 1,) of the nodes, from 0 to the horizon (s); None for equal segments.
        subdivide: whether multiple shooting may divide segments.
        polish: whether Leapfrog and collocation end with multiple-shooting Newton steps.
        update: where Leapfrog moves a node on the extremal of its sub-problem, at the mean time or at half the cost.
        order: order of the nodes in a Leapfrog sweep; "red_black" moves the odd nodes before the others.

    """

    tol: float = 1e-9
    max_iterations: int = 60
    segments: int | None = None
    mesh: np.ndarray | None = None
    subdivide: bool = True
    polish: bool = True
    update: Literal["mean_time", "half_cost"] = "mean_time"
    order: Literal["sequential", "red_black"] = "sequential"


def start_nodes(
    problem: OptimalControlProblem, path: Trajectory, segments: int | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial nodes on a path, with both boundary conditions met exactly.

    Args:
        problem: the problem.
        path: the path; its costates are estimated if it has none. Its duration is the guess of a free horizon.
        segments: number of segments of equal duration, or the times (segments + 1,) of the nodes.

    Returns:
        Times (segments + 1,) and nodes (segments + 1, 2n).

    Raises:
        ValueError: the path has another number of states.

    """
    times = np.linspace(0.0, problem.horizon_of(path), segments + 1) if isinstance(segments, int) else segments
    resampled = path.resample(times)
    if resampled.states.shape[1] != problem.system.n:
        raise ValueError(f"states: expected {problem.system.n} columns, got {resampled.states.shape[1]}")
    costates = resampled.costates if resampled.costates is not None else problem.estimate_costates(resampled)
    arrays = problem.arrays
    nodes = np.concatenate([resampled.states, costates], axis=1)
    n = problem.system.n
    nodes[0, :n] = arrays.start
    nodes[-1, :n] = np.where(arrays.free, nodes[-1, :n], arrays.goal)
    return times, nodes


def _spread(times: np.ndarray, count: int) -> np.ndarray:
    """Return times between which there are equal numbers of the given ones."""
    return np.interp(np.linspace(0.0, len(times) - 1.0, count), np.arange(len(times)), times)


def first_mesh(path: Trajectory, options: SolverOptions) -> int | np.ndarray:
    """Return the times of the first nodes, or the number of segments of equal duration."""
    return options.segments or default_segments(path) if options.mesh is None else options.mesh.copy()


def default_segments(path: Trajectory) -> int:
    """Return the larger of one segment per 0.5 s and one per two points of a lattice path (0.4 to 0.7 m)."""
    return int(np.clip(max(len(path.times) / 2, path.times[-1] / 0.5), MIN_SEGMENTS, MAX_SEGMENTS))


def path_of(
    problem: OptimalControlProblem, extremal: Extremal, options: SolverOptions
) -> tuple[Trajectory, SolverOptions]:
    """Return an extremal as the initial path of a problem, and options with nodes on it, as many as it has.

    Between two nodes there are equal numbers of steps of the integrator.

    Raises:
        ValueError: the extremal has no path, or another number of states.

    """
    if len(extremal.times) == 0:
        raise ValueError(f"guess: the extremal has no path: {extremal.status.value}")
    n, expected = extremal.states.shape[1], problem.system.n
    if n != expected:
        raise ValueError(f"guess: the extremal has {n} states, the problem {expected}")
    segments = options.segments or (extremal.n_nodes - 1 if extremal.n_nodes > 2 else MIN_SEGMENTS)
    times = _spread(extremal.times, POINTS_PER_SEGMENT * segments + 1)
    values = extremal.interpolate(times)
    # If the horizons differ, time is scaled.
    duration = float(extremal.times[-1]) if problem.horizon is None else problem.horizon
    times *= duration / float(extremal.times[-1])
    times[-1] = duration  # exactly
    mesh = times[::POINTS_PER_SEGMENT].copy()
    return Trajectory(times, values[:, :n], values[:, n:]), replace(options, mesh=mesh)
