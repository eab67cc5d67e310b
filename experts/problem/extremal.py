"""Extremals, that is solutions of the minimum principle's boundary value problem, and their certificates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from leapnav.envs.utils.json_utils import encode, plain
from leapnav.envs.utils.validation import as_vector
from leapnav.experts.problem.problem import OptimalControlProblem


class Status(Enum):
    """The outcome of a solve. The value is a text that suggests what to try next."""

    SUCCESS = "certified: a local minimum, to the tolerance"
    NO_PATH = "no path from start to goal was found. Check that the passages between the obstacles are wide enough."
    HORIZON_TOO_SHORT = "the goal is out of reach within the horizon. Try a longer horizon or higher limits."
    ZERO_HORIZON = (
        "the start is the goal, so with a free horizon the optimum takes no time. Move the start or the goal."
    )
    STALLED = "Newton's method stopped making progress. Try another method, a better guess, or find_optimum."
    DIVERGED = "the extremal flow diverged from the guess. Try a guess closer to the solution, or another method."
    SINGULAR = "the solution is abnormal or not isolated, so nothing certifies it. Move the start or the goal slightly."
    MAX_ITERATIONS = "the iteration limit was reached. Try increasing max_iterations, or another method."
    NOT_CERTIFIED = "the solver converged but re-integration did not confirm it. Try a smaller tol."
    COLLISION = "the extremal passes through an obstacle. Try find_optimum, or another guess."
    BEYOND_LIMITS = "a state of the extremal is beyond its bounds. Try wider state_bounds, or another guess or horizon."
    CONJUGATE_POINT = "the extremal is no local minimum (conjugate point before the horizon). Try another guess."
    TIME_NOT_MINIMAL = "the extremal is no local minimum over the free horizon. Try a guess with another duration."
    SUBPROBLEM = "a Leapfrog sub-problem did not converge, so the sweeps stopped. Try more segments or polish=True."


class SolveError(RuntimeError):
    """Raised when a solve ends without success.

    The message is the status, with what to try next.

    Attributes:
        extremal: the failed result.
        name: name of the scenario, if there is one.

    """

    extremal: Extremal
    name: str

    def __init__(self, extremal: Extremal, name: str = "") -> None:
        super().__init__(f"{name}{': ' if name else ''}{extremal.status.name}: {extremal.status.value}")
        self.extremal, self.name = extremal, name

    def __reduce__(self) -> tuple[Any, ...]:
        return SolveError, (self.extremal, self.name)


@dataclass(frozen=True)
class Certificate:
    """Evidence that a path is a local minimum, from re-integration that is independent of the solver.

    Attributes:
        residual: largest violation of the boundary conditions, transversality conditions included, and with a free
            horizon also |H|, divided by the time weight if that is larger than 1.
        defect: largest difference between a node and the extremal flow from the node before it, integrated at 1e-12.
        hamiltonian_drift: largest minus smallest Hamiltonian. The Hamiltonian is constant along an extremal.
        conjugate_point: time (s) of a conjugate point before the horizon, at which dq(t)/dlambda(0) loses rank; with
            free final components, of a focal point. None if there is none: the extremal is a local minimum. NaN if the
            sensitivities diverge, so that this cannot be decided; such an extremal is not certified.
        clearance: smallest clearance (m) to an obstacle or a wall along the interpolated path; None without obstacles.
        time_curvature: with a free horizon, d2J/dT2 for extremals with the same ends, positive at a minimum over T;
            None with a fixed horizon.
        horizon_error: with a free horizon, |H| / (T d2J/dT2), the relative error of the horizon to first order; None
            with a fixed horizon.
        state_margin: smallest distance of a state from its bounds along the interpolated path, as a fraction of the
            width of the interval, or of the largest distance of start and goal from a single bound; None without them.
        controllability: smallest singular value of the change of the final state in an orthonormal basis of the changes
            of the final state and costate with the initial costate. It is 0 if a change of the costate leaves the final
            state as it is. If it is small, the larger of this value and that at half of the time: if both vanish, the
            extremal is abnormal (A. A. Agrachev, Y. L. Sachkov, Control Theory from the Geometric Viewpoint, 2004,
            ch. 12), and the test of conjugate points proves nothing. None with free final components or where controls
            are at their bounds.
        TOLERANCE: largest residual and defect of a certified extremal.
        MIN_CONTROLLABILITY: smallest controllability of a certified extremal.
        HORIZON_TOLERANCE: largest horizon error of a certified extremal; it is larger if the cost hardly depends on T.

    """

    residual: float
    defect: float
    hamiltonian_drift: float
    conjugate_point: float | None
    clearance: float | None
    time_curvature: float | None = None
    horizon_error: float | None = None
    state_margin: float | None = None
    controllability: float | None = None

    # Rounding errors leave about this much of a Newton solution at tolerance 1e-9 over a long horizon.
    TOLERANCE: ClassVar[float] = 1e-8
    HORIZON_TOLERANCE: ClassVar[float] = 1e-4
    # At most 1.3e-11 for the straight line of Martinet's problem, at least 0.06 in 100 other problems, and 6e-11 for a
    # unicycle that rotates by 0.001 rad only: over short horizons it decreases with the third power of the time.
    MIN_CONTROLLABILITY: ClassVar[float] = 3e-11

    def status(self) -> Status:
        """Return the status that the certificate proves."""
        if not (self.residual <= self.TOLERANCE and self.defect <= self.TOLERANCE):
            return Status.NOT_CERTIFIED
        if self.clearance is not None and not self.clearance > 0:
            return Status.COLLISION
        if self.state_margin is not None and not self.state_margin > 0:
            return Status.BEYOND_LIMITS
        if self.conjugate_point is not None:
            return Status.NOT_CERTIFIED if math.isnan(self.conjugate_point) else Status.CONJUGATE_POINT
        if self.controllability is not None and not self.controllability > self.MIN_CONTROLLABILITY:
            return Status.SINGULAR
        if self.time_curvature is None or self.horizon_error is None:
            return Status.SUCCESS
        if not self.time_curvature > 0:
            return Status.TIME_NOT_MINIMAL
        return Status.SUCCESS if self.horizon_error <= self.HORIZON_TOLERANCE else Status.NOT_CERTIFIED


@dataclass(frozen=True, eq=False)
class Iteration:
    """One iteration of a solver.

    Attributes:
        phase: "sweep" (Leapfrog), "reduce" (a Leapfrog sweep that removes nodes), "newton" or "collocation".
        segments: number of segments of the horizon.
        cost: J of the iterate.
        residual: largest violation of the boundary and continuity conditions. For a Leapfrog sweep only the states
            count, because the costates are discontinuous at the nodes until it converges.
        rejected: indices of the nodes whose move Leapfrog rejected.
        times: (segments + 1,), times (s) of the nodes of a Leapfrog sweep; None for other phases.
        nodes: (segments + 1, 2n), its nodes, connected by extremal arcs; None for other phases.

    """

    phase: str
    segments: int
    cost: float
    residual: float
    rejected: tuple[int, ...] = ()
    times: np.ndarray | None = None
    nodes: np.ndarray | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the iteration as a dictionary that JSON can represent, without the path."""
        return plain(
            {
                "phase": self.phase,
                "segments": self.segments,
                "cost": self.cost,
                "residual": self.residual,
                "rejected": len(self.rejected),
            }
        )


@dataclass(frozen=True, eq=False, repr=False)
class Extremal:
    """An extremal of an optimal control problem: the result of `solve` and `find_optimum`.

    The arrays hold the solution at the N steps of the integrator that certified it; `evaluate` interpolates between
    them. They are empty if the solve failed without a path.

    Attributes:
        problem: the problem that was solved.
        status: outcome of the solve; its value suggests what to try next.
        cost: J of the path, certified or not; infinite without a path.
        times: (N,), s.
        states: (N, n).
        controls: (N, m).
        costates: (N, n).
        accumulated: (N,), cost from time 0 to each time.
        hamiltonian: (N,), constant along an extremal.
        terms: (N - 1, 7, 2n + 1), coefficients of the integrator's interpolant of (state, costate, cost).
        history: iterations of the solver.
        certificate: evidence from re-integration; None without a path.
        n_nodes: number of nodes of the solver.
        n_evaluations: number of evaluations of the extremal flow by the solver.
        barrier: integral of the barrier that approximates hard limits, as a fraction of |`cost`|, which excludes it; 0
            without hard limits. The cost of the optimum with the hard limits is lower by about this fraction.

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
    n_nodes: int = 0
    n_evaluations: int = 0
    barrier: float = 0.0

    def __repr__(self) -> str:
        return f"Extremal({self.status.name}, cost={self.cost:.9g}, {len(self.times)} points, {self.certificate})"

    @property
    def horizon(self) -> float:
        """The horizon (s): that of the problem, or the optimal one if it is free; NaN without a path."""
        if self.problem.horizon is not None:
            return self.problem.horizon
        return float(self.times[-1]) if len(self.times) else math.nan

    @property
    def success(self) -> bool:
        """Whether the certificate proves a local minimum, collision-free if there are obstacles."""
        return self.status is Status.SUCCESS

    def evaluate(self, t: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return states, controls and costates at given times.

        States and costates come from the integrator's interpolant of order 7, and the controls follow from the minimum
        principle.

        Args:
            t: time (s), scalar or (K,); clipped to [0, horizon].

        Returns:
            (states, controls, costates), of shapes (n,), (m,), (n,) for a scalar, or (K, n), (K, m), (K, n).

        Raises:
            ValueError: there is no path, because the solve failed.

        """
        values = self.interpolate(as_vector("t", np.atleast_1d(t)))
        n = self.problem.system.n
        arrays = self.problem.arrays
        controls = np.empty((len(values), self.problem.system.m))
        for row, value in zip(controls, values, strict=True):
            arrays.control(value, arrays.data, row)
        result = values[:, :n], controls, values[:, n:]
        return result if np.ndim(t) else (result[0][0], result[1][0], result[2][0])

    def interpolate(self, times: np.ndarray) -> np.ndarray:
        """Return states and costates (K, 2n) at times (K,).

        Raises:
            ValueError: there is no path, because the solve failed, or a time is not a finite number.

        """
        if len(self.times) == 0:
            raise ValueError(f"there is no path: {self.status.value}")
        times = as_vector("times", times)
        return np.ascontiguousarray(self._interpolate(times)[:, :-1])

    def _interpolate(self, times: np.ndarray) -> np.ndarray:
        """Return states, costates and accumulated cost (K, 2n + 1) at times (K,)."""
        times = np.clip(times, 0.0, self.horizon)
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        s = ((times - self.times[k]) / (self.times[k + 1] - self.times[k]))[:, None]
        value = np.zeros((len(times), self.terms.shape[2]))
        for j in range(self.terms.shape[1] - 1, -1, -1):
            value = (value + self.terms[k, j]) * (s if j % 2 == 0 else 1.0 - s)
        return value + np.concatenate([self.states, self.costates, self.accumulated[:, None]], axis=1)[k]

    def cost_to_go(self, t: Any) -> Any:
        """Return the cost from time t (s), scalar or (K,), to the horizon.

        Raises:
            ValueError: there is no path, because the solve failed.

        """
        if len(self.times) == 0:
            raise ValueError(f"there is no path: {self.status.value}")
        values = self.cost - self._interpolate(as_vector("t", np.atleast_1d(t)))[:, -1]
        return values if np.ndim(t) else float(values[0])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary that JSON can represent, as `leapnav solve --json` writes it.

        Numbers that are not finite become None.
        """
        return plain(
            {
                "status": self.status.name,
                "advice": self.status.value,
                "success": self.success,
                "cost": self.cost,
                "barrier": self.barrier,
                "horizon": self.horizon,
                "certificate": self.certificate,
                "times": self.times.tolist(),
                "states": self.states.tolist(),
                "controls": self.controls.tolist(),
                "costates": self.costates.tolist(),
                "history": [row.to_dict() for row in self.history],
            }
        )

    def to_json(self) -> str:
        """Return `to_dict` as JSON text."""
        return encode(self.to_dict())
