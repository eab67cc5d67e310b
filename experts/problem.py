"""The optimal control problem that every method takes, and the path that a method starts from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import sympy as sp

from leapnav.envs.scenario import Scenario
from leapnav.experts.dynamics import sample_dynamics, smallest_costates
from leapnav.experts.system import CompiledFunction, ControlAffineSystem, as_expression, compile_flow, unicycle


@dataclass(frozen=True)
class Path:
    """A guess of the solution: times (N,) from 0 to the horizon, states (N, n), costates (N, n) or None."""

    times: np.ndarray
    states: np.ndarray
    costates: np.ndarray | None = None

    def resample(self, times: np.ndarray) -> Path:
        """The same path at other times, by linear interpolation."""
        columns = [self.states] if self.costates is None else [self.states, self.costates]
        values = [np.stack([np.interp(times, self.times, c) for c in array.T], axis=1) for array in columns]
        return Path(times, *values)


@dataclass(frozen=True, eq=False)
class OptimalControlProblem:
    """minimise the integral of 1/2 u'Ru + Phi(q) over [0, horizon], subject to the system and both boundary conditions.

    Args:
        system: the dynamics, n states and m controls.
        start: q(0), n numbers.
        goal: q(T), n numbers; None leaves a component free (its costate vanishes at T).
        horizon: T > 0.
        control_weight: the diagonal of R, m positive numbers.
        state_cost: Phi, a SymPy expression in the system's state symbols.
        control_bounds: m pairs (lowest, highest), or None for unbounded controls.
        field: a packed obstacle field (`Scenario.field`) whose proximity cost is added to Phi at the system's position.
        parameters: a number for each of the system's parameters, in its order.

    Raises:
        ValueError: a length or a value is impossible; the message names the argument and the value.

    """

    system: ControlAffineSystem
    start: Sequence[float]
    goal: Sequence[float | None]
    horizon: float
    control_weight: Sequence[float]
    state_cost: Any = 0
    control_bounds: Sequence[tuple[float, float]] | None = None
    field: np.ndarray | None = None
    parameters: Sequence[float] = ()

    def __post_init__(self) -> None:
        n, m = self.system.n, self.system.m
        for name, values, length in (
            ("start", self.start, n),
            ("goal", self.goal, n),
            ("control_weight", self.control_weight, m),
            ("parameters", self.parameters, len(self.system.parameters)),
        ):
            if len(values) != length:
                raise ValueError(f"{name}: expected {length} numbers, got {len(values)}: {values!r}")
            if not all((v is None and name == "goal") or _is_finite(v) for v in values):
                raise ValueError(f"{name}: expected finite numbers, got {values!r}")
        if not all(w > 0 for w in self.control_weight):
            raise ValueError(f"control_weight: expected positive numbers, got {self.control_weight!r}")
        if not (_is_finite(self.horizon) and self.horizon > 0):
            raise ValueError(f"horizon: expected a positive number, got {self.horizon!r}")
        if self.control_bounds is not None:
            if len(self.control_bounds) != m:
                raise ValueError(f"control_bounds: expected {m} pairs, got {len(self.control_bounds)}")
            for low, high in self.control_bounds:
                if not (_is_number(low) and _is_number(high) and low < high):
                    raise ValueError(f"control_bounds: expected lowest < highest, got ({low!r}, {high!r})")
        # SymPy's or NumPy's numbers are as good as Python's, but not to compiled functions.
        for name in ("start", "goal", "control_weight", "parameters"):
            values = tuple(None if v is None else float(v) for v in getattr(self, name))
            object.__setattr__(self, name, values)
        object.__setattr__(self, "horizon", float(self.horizon))
        if self.control_bounds is not None:
            bounds = tuple((float(low), float(high)) for low, high in self.control_bounds)
            object.__setattr__(self, "control_bounds", bounds)
        unknown = as_expression("state_cost", self.state_cost).free_symbols - {
            *self.system.state,
            *self.system.parameters,
        }
        if unknown:
            raise ValueError(
                f"state_cost: unknown symbol {sorted(map(str, unknown))[0]!r}; the state is {self.system.state}"
            )

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> OptimalControlProblem:
        """The problem of a scenario, with the robot's limits as control bounds."""
        robot, cost = scenario.robot, scenario.cost
        return cls(
            system=_UNICYCLE,
            start=scenario.start,
            goal=scenario.goal,
            horizon=scenario.horizon,
            control_weight=(cost.speed_weight, cost.turn_weight),
            control_bounds=((-robot.max_speed, robot.max_speed), (-robot.max_turn_rate, robot.max_turn_rate)),
            field=scenario.field,
        )

    def with_winding_of(self, states: np.ndarray) -> OptimalControlProblem:
        """The same problem with each goal angle moved by multiples of 2 pi to where the path `states` (N, n) ends."""
        goal = list(self.goal)
        for symbol in self.system.angles:
            i = self.system.state.index(symbol)
            value = goal[i]
            if value is not None:
                # The path ends on the goal modulo 2 pi only up to its own error.
                goal[i] = value + 2 * math.pi * round((float(states[-1, i]) - value) / (2 * math.pi))
        return replace(self, goal=tuple(goal))

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions belong to this process; the receiving one makes its own.
        return {name: value for name, value in self.__dict__.items() if name != "arrays"}

    @cached_property
    def arrays(self) -> ProblemArrays:
        """The problem as the arrays that the kernels take."""
        m = self.system.m
        flow, control = compile_flow(self.system, sp.sympify(self.state_cost), self.field is not None)
        bounds = np.array(
            self.control_bounds if self.control_bounds is not None else [(-np.inf, np.inf)] * m, dtype=float
        )
        return ProblemArrays(
            flow=flow,
            control=control,
            start=np.array(self.start, dtype=float),
            goal=np.array([0.0 if g is None else g for g in self.goal], dtype=float),
            free=np.array([g is None for g in self.goal]),
            data=_constant([*self.control_weight, *bounds[:, 0], *bounds[:, 1], *self.parameters]),
            field=_constant([]) if self.field is None else self.field,
        )

    def estimate_costates(self, path: Path) -> np.ndarray:
        """Costates (N, n) consistent with the minimum principle along a path without any.

        The control that follows the path in the least-squares sense gives the switching functions p = -R u, and of the
        costates with these the smallest is taken.
        """
        drift, fields = self.dynamics(path.states)
        costates = np.empty_like(drift)
        rates = np.gradient(path.states, path.times, axis=0)
        smallest_costates(drift, fields, rates, np.array(self.control_weight, dtype=float), costates)
        return costates

    def dynamics(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, n) and B (N, n, m) at states (N, n)."""
        arrays, n, m = self.arrays, self.system.n, self.system.m
        drift, fields = np.empty((len(states), n)), np.empty((len(states), n, m))
        sample_dynamics(
            arrays.flow, arrays.control, np.ascontiguousarray(states), arrays.data, arrays.field, drift, fields
        )
        return drift, fields

    def straight_line(self, points: int = 33) -> Path:
        """The straight line from start to goal; free components stay at their start."""
        start = np.array(self.start, dtype=float)
        goal = np.array([s if g is None else g for s, g in zip(self.start, self.goal, strict=True)], dtype=float)
        share = np.linspace(0.0, 1.0, points)[:, None]
        return Path(np.linspace(0.0, self.horizon, points), start + share * (goal - start))


@dataclass(frozen=True, eq=False)
class ProblemArrays:
    """What the kernels read: compiled functions, boundary values (n,), free flags (n,), weights and bounds, field."""

    flow: CompiledFunction
    control: CompiledFunction
    start: np.ndarray
    goal: np.ndarray
    free: np.ndarray
    data: np.ndarray
    field: np.ndarray


def _is_number(value: Any) -> bool:
    """Whether a value is a number, Python's, NumPy's or SymPy's, that a double can hold."""
    try:
        return not isinstance(value, str) and not math.isnan(float(value))
    except (TypeError, ValueError, OverflowError):
        return False


def _is_finite(value: Any) -> bool:
    return _is_number(value) and math.isfinite(float(value))


def _constant(values: Sequence[float] | list[float]) -> np.ndarray:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


_UNICYCLE = unicycle()


def as_problem(task: OptimalControlProblem | Scenario) -> OptimalControlProblem:
    """A scenario's problem, or the problem itself."""
    if isinstance(task, Scenario):
        return OptimalControlProblem.from_scenario(task)
    if isinstance(task, OptimalControlProblem):
        return task
    raise TypeError(f"expected a Scenario or an OptimalControlProblem, got {type(cast(object, task)).__name__}")
