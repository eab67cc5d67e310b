"""An extremal: a solution of the minimum principle's boundary value problem, with the certificate that it is one."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from leapnav.experts.problem import OptimalControlProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Status(Enum):
    """How a solve ended. The value is advice."""

    SUCCESS = "certified: a local minimum, to the tolerance"
    NO_PATH = "no path from start to goal was found. Check that the gaps between the obstacles let the robot through."
    HORIZON_TOO_SHORT = "the robot cannot get there in time at its limits. Try a longer horizon or higher limits."
    STALLED = "Newton's method made no more progress. Try method='leapfrog', a better guess, or find_optimum."
    DIVERGED = "the extremal flow diverged from the guess. Try a guess nearer to the solution or method='leapfrog'."
    SINGULAR = "the Newton matrix is singular: the solution is not isolated. Move the start or the goal a little."
    MAX_ITERATIONS = "the iteration limit was reached. Try increasing max_iterations, or method='leapfrog'."
    NOT_CERTIFIED = "the solver converged but re-integration did not confirm it. Try a smaller tol."
    COLLISION = "the extremal passes through an obstacle. Try find_optimum, or another guess."
    CONJUGATE_POINT = "the extremal is no local minimum (conjugate point before the horizon). Try another guess."
    SUBPROBLEM = "a Leapfrog sub-problem did not converge, so the sweeps stand still. Try more segments or polish=True."


# What the compiled Newton kernels return.
CONVERGED, STALLED, DIVERGED, SINGULAR, MAX_ITERATIONS = 0, 1, 2, 3, 4
KERNEL_STATUS = {
    CONVERGED: Status.SUCCESS,
    STALLED: Status.STALLED,
    DIVERGED: Status.DIVERGED,
    SINGULAR: Status.SINGULAR,
    MAX_ITERATIONS: Status.MAX_ITERATIONS,
}


class SolveError(RuntimeError):
    """A solve without success. The message says what to try next; `extremal` is the failed result."""

    def __init__(self, extremal: Extremal, name: str = "") -> None:
        super().__init__(f"{name}{': ' if name else ''}{extremal.status.name}: {extremal.status.value}")
        self.extremal, self.name = extremal, name

    def __reduce__(self) -> tuple[Any, ...]:
        return SolveError, (self.extremal, self.name)


@dataclass(frozen=True)
class Certificate:
    """What re-integration of the extremal says, whatever the solver said.

    Attributes:
        residual: largest violation of the boundary conditions, transversality included.
        defect: largest gap between a node and the flow from the node before, re-integrated at tight tolerance.
        hamiltonian_drift: largest minus smallest H along the extremal (H is constant on an extremal).
        conjugate_point: a time (s) before the horizon at which dq(t)/dlambda(0) loses rank, or, where final components
            are free, at which the extremals that meet the end conditions focus; None: a local minimum.
        clearance: smallest distance (m) to an obstacle or wall on the dense path; None without obstacles.

    """

    residual: float
    defect: float
    hamiltonian_drift: float
    conjugate_point: float | None
    clearance: float | None

    # What double precision leaves of a Newton solution at tolerance 1e-9 over long horizons.
    TOLERANCE: ClassVar[float] = 1e-8

    def status(self) -> Status:
        """What the certificate proves."""
        if not (self.residual <= self.TOLERANCE and self.defect <= self.TOLERANCE):
            return Status.NOT_CERTIFIED
        if self.clearance is not None and not self.clearance > 0:
            return Status.COLLISION
        return Status.SUCCESS if self.conjugate_point is None else Status.CONJUGATE_POINT


@dataclass(frozen=True, eq=False)
class Iteration:
    """One row of a solver's history.

    Attributes:
        phase: "sweep" (Leapfrog), "reduce" (a Leapfrog sweep that removes nodes), "newton" or "collocation".
        segments: into how many pieces the horizon is divided.
        cost: J of the iterate.
        residual: largest violation of the boundary and continuity conditions; for a sweep, of its path's states alone
            (the costates may jump at the nodes until the end).
        rejected: Leapfrog's rejected moves, the numbers of their nodes.
        times, nodes: a sweep's feasible path, (segments + 1,) and (segments + 1, 2n): extremal arcs from node to node.

    """

    phase: str
    segments: int
    cost: float
    residual: float
    rejected: tuple[int, ...] = ()
    times: np.ndarray | None = None
    nodes: np.ndarray | None = None

    def to_dict(self) -> dict[str, Any]:
        """The row as plain numbers, without the path."""
        return {
            "phase": self.phase,
            "segments": self.segments,
            "cost": _number(self.cost),
            "residual": _number(self.residual),
            "rejected": len(self.rejected),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Extremal:
    """The result of `solve` and `find_optimum`.

    Attributes:
        status: how the solve ended; its text is advice.
        cost: J (the value of the returned path, even if it is not certified).
        times (N,), states (N, n), controls (N, m), costates (N, n): the solution at the integrator's own steps (s).
        accumulated (N,): cost from time 0.
        hamiltonian (N,): H, constant along an extremal.
        terms (N - 1, 7, 2n + 1): coefficients of the integrator's interpolant of (q, lambda, cost).
        history: one row per iteration.
        certificate: see `Certificate`; None if the solver returned no path.
        nodes: how many nodes the solver used.
        work: evaluations of the extremal flow by the solver.

    """

    problem: OptimalControlProblem
    status: Status
    cost: float
    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    accumulated: np.ndarray
    hamiltonian: np.ndarray
    terms: np.ndarray
    history: tuple[Iteration, ...] = ()
    certificate: Certificate | None = None
    nodes: int = 0
    work: int = 0

    def __repr__(self) -> str:
        return f"Extremal({self.status.name}, cost={self.cost:.9g}, {len(self.times)} points, {self.certificate})"

    @property
    def success(self) -> bool:
        """True if the certificate proves a (collision-free) local minimum."""
        return self.status is Status.SUCCESS

    def evaluate(self, t: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(states, controls, costates) at times t, scalar or (K,); results have shape (n,), (m,), (n,) or (K, ...).

        The integrator's own interpolant of order 7 for (q, lambda), controls from the minimum principle; times outside
        [0, horizon] are held at the ends.
        """
        values = self.interpolate(np.atleast_1d(np.asarray(t, dtype=float)))
        n = self.problem.system.n
        arrays = self.problem.arrays
        controls = np.empty((len(values), self.problem.system.m))
        for row, value in zip(controls, values, strict=True):
            arrays.control(value, arrays.data, row)
        result = values[:, :n], controls, values[:, n:]
        return result if np.ndim(t) else (result[0][0], result[1][0], result[2][0])

    def interpolate(self, times: np.ndarray) -> np.ndarray:
        """(q, lambda) at times (K,), shape (K, 2n).

        Raises:
            ValueError: a failed solve has no path.

        """
        if len(self.times) == 0:
            raise ValueError(f"there is no path: {self.status.value}")
        return np.ascontiguousarray(self._interpolate(times)[:, :-1])

    def _interpolate(self, times: np.ndarray) -> np.ndarray:
        """(q, lambda, cost so far) at times (K,), shape (K, 2n + 1)."""
        times = np.clip(times, 0.0, self.problem.horizon)
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        s = ((times - self.times[k]) / (self.times[k + 1] - self.times[k]))[:, None]
        value = np.zeros((len(times), self.terms.shape[2]))
        for j in range(self.terms.shape[1] - 1, -1, -1):
            value = (value + self.terms[k, j]) * (s if j % 2 == 0 else 1.0 - s)
        return value + np.concatenate([self.states, self.costates, self.accumulated[:, None]], axis=1)[k]

    def cost_to_go(self, t: Any) -> Any:
        """Cost from time t to the horizon, scalar or (K,).

        Raises:
            ValueError: a failed solve has no path.

        """
        if len(self.times) == 0:
            raise ValueError(f"there is no path: {self.status.value}")
        values = self.cost - self._interpolate(np.atleast_1d(np.asarray(t, dtype=float)))[:, -1]
        return values if np.ndim(t) else float(values[0])

    def plot(self, path: str | os.PathLike[str] | None = None, title: str | None = None) -> Figure:
        """States, controls, costates and Hamiltonian over time, the path in the plane, and Leapfrog's sweeps.

        See `leapnav.experts.plotting.plot_extremal`, which also draws a scenario.

        Args:
            path: where to write the picture; None writes none.
            title: None: cost and status.

        Raises:
            ValueError: a failed solve has no path, or the file's ending is no picture format.

        """
        # Whoever only solves need not load Matplotlib.
        from leapnav.experts.plotting import plot_extremal

        return plot_extremal(cast(Any, self), path, title=title)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, lists and numbers, as `leapnav solve --json` writes it."""
        return {
            "status": self.status.name,
            "advice": self.status.value,
            "success": self.success,
            "cost": _number(self.cost),
            "certificate": None if self.certificate is None else asdict(self.certificate),
            "times": self.times.tolist(),
            "states": self.states.tolist(),
            "controls": self.controls.tolist(),
            "costates": self.costates.tolist(),
            "history": [row.to_dict() for row in self.history],
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), allow_nan=False)


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity."""
    return float(value) if np.isfinite(value) else None
