"""The nodes (q, lambda) that a method starts from, on a path that meets both boundary conditions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from leapnav.experts.problem import OptimalControlProblem, Path

FEWEST_SEGMENTS, MOST_SEGMENTS = 8, 128  # by default


@dataclass(frozen=True)
class Settings:
    """What `solve` passes on to a method; see there."""

    tol: float = 1e-9
    max_iterations: int = 60
    segments: int | None = None
    polish: bool = True
    update: Literal["mean_time", "half_cost"] = "mean_time"
    order: Literal["sequential", "red_black"] = "sequential"


def start_nodes(
    problem: OptimalControlProblem, path: Path, segments: int | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Times (segments + 1,) and nodes (segments + 1, 2n) on a path, with both boundary conditions met exactly.

    `segments` is their number, for equal ones, or the times themselves.
    """
    times = np.linspace(0.0, problem.horizon, segments + 1) if isinstance(segments, int) else segments
    even = path.resample(times)
    costates = even.costates if even.costates is not None else problem.estimate_costates(even)
    arrays = problem.arrays
    nodes = np.concatenate([even.states, costates], axis=1)
    n = problem.system.n
    nodes[0, :n] = arrays.start
    nodes[-1, :n] = np.where(arrays.free, nodes[-1, :n], arrays.goal)
    return times, nodes


def default_segments(path: Path) -> int:
    """One segment per half second or per two points of a lattice path (0.4 to 0.7 m), whichever is more."""
    return int(np.clip(max(len(path.times) / 2, path.times[-1] / 0.5), FEWEST_SEGMENTS, MOST_SEGMENTS))
