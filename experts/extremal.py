"""An extremal: a solution of the minimum principle's boundary value problem, with the certificate that it is one."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from leapnav.experts.problem import OptimalControlProblem


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


@dataclass(frozen=True)
class Iteration:
    """One row of a solver's history. `phase` is "sweep" or "newton"; residual is NaN where it is not computed."""

    phase: str
    segments: int
    cost: float
    residual: float
    rejected: int


@dataclass(frozen=True, eq=False, repr=False)
class Extremal:
    """The result of `solve` and `find_optimum`.

    Attributes:
        status: how the solve ended; its text is advice.
        cost: J (the value of the returned path, even if it is not certified).
        times (N,), states (N, n), controls (N, m), costates (N, n): the solution at the integrator's own steps (s).
        accumulated (N,): cost from time 0.
        rates (N, 2n), curvatures (N, 2n): first and second time derivatives of (q, lambda), for dense evaluation.
        history: one row per iteration (simple shooting: its last).
        certificate: see `Certificate`; None if the solver returned no path.
        nodes: how many nodes the solver used.
        work: integration steps taken by the solver.

    """

    problem: OptimalControlProblem
    status: Status
    cost: float
    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    accumulated: np.ndarray
    rates: np.ndarray
    curvatures: np.ndarray
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

        Quintic Hermite interpolation of (q, lambda) between the integrator's steps, controls from the minimum
        principle; times outside [0, horizon] are held at the ends.
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
        times = np.clip(times, 0.0, self.problem.horizon)
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        h = (self.times[k + 1] - self.times[k])[:, None]
        s = (times - self.times[k])[:, None] / h
        z = np.concatenate([self.states, self.costates], axis=1)
        return _quintic(
            s, h, z[k], self.rates[k], self.curvatures[k], z[k + 1], self.rates[k + 1], self.curvatures[k + 1]
        )

    def cost_to_go(self, t: Any) -> Any:
        """Cost from time t to the horizon, scalar or (K,).

        Raises:
            ValueError: a failed solve has no path.

        """
        if len(self.times) == 0:
            raise ValueError(f"there is no path: {self.status.value}")
        return self.cost - np.interp(t, self.times, self.accumulated)

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
            "history": [
                {**asdict(row), "residual": _number(row.residual), "cost": _number(row.cost)} for row in self.history
            ],
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), allow_nan=False)


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity."""
    return float(value) if np.isfinite(value) else None


def _quintic(s: Any, h: Any, z0: Any, d0: Any, c0: Any, z1: Any, d1: Any, c1: Any) -> np.ndarray:
    """Quintic Hermite polynomial through value, slope and curvature at both ends; s in [0, 1]."""
    gap = z1 - z0
    a, b, c = gap - h * d0 - h * h * c0 / 2, h * (d1 - d0) - h * h * c0, h * h * (c1 - c0)
    cubic, quartic, quintic = 10 * a - 4 * b + c / 2, -15 * a + 7 * b - c, 6 * a - 3 * b + c / 2
    return z0 + s * (h * d0 + s * (h * h * c0 / 2 + s * (cubic + s * (quartic + s * quintic))))
