"""Optimal control problems and initial guesses of their solution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from leapnav.envs.field.layout import read_header
from leapnav.envs.field.packing import check_field, with_weight
from leapnav.envs.field.proximity import footprint_proximities
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots.footprints import Box, Disc, outline_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import as_matrix, as_vector
from leapnav.experts.numerics.flow import EndCondition, ExtremalFlow
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.numerics.state_bounds import StateLimit, check_state_bounds, limit_costs, move_inside, state_limits
from leapnav.experts.problem.dynamics import least_norm_costates, least_squares_controls, sample_dynamics
from leapnav.experts.problem.system import (
    ControlAffineSystem,
    as_expression,
    state_cost_of,
    system_of,
    weighted_by_time,
)

if TYPE_CHECKING:
    import sympy as sp

    from leapnav.experts.problem.generated_dynamics import CompiledDynamics
    from leapnav.experts.problem.generated_flow import Obstacles


@dataclass(frozen=True)
class Trajectory:
    """A path in time, used as an initial guess of a solution.

    The states need not satisfy the dynamics.

    Attributes:
        times: (N,), increasing, from 0 to the horizon (s).
        states: (N, n).
        costates: (N, n); None lets the solver estimate them from the motion.

    """

    times: np.ndarray
    states: np.ndarray
    costates: np.ndarray | None = None

    def resample(self, times: np.ndarray) -> Trajectory:
        """Return the path at other times (K,), by linear interpolation."""
        own = as_vector("times", self.times, finite=False)
        at = as_vector("times", times, finite=False)
        states = as_matrix("states", self.states, len(own), finite=False)
        if len(own) == 0:
            raise ValueError("times: expected at least one, got none")
        if self.costates is None:
            return Trajectory(at, interpolate(at, own, states))
        costates = as_matrix("costates", self.costates, *states.shape, finite=False)
        return Trajectory(at, interpolate(at, own, states), interpolate(at, own, costates))


@dataclass(frozen=True, eq=False)
class OptimalControlProblem:
    """An optimal control problem with a fixed or a free horizon, for a control-affine system.

    Minimise the integral of c + 1/2 u'Ru + Phi(q) over [0, T], subject to q' = a(q) + sum_j u_j b_j(q), q(0) = start
    and q(T) = goal. If the horizon is free, J is minimised over T > 0 too, and the Hamiltonian of an extremal is 0.

    Args:
        system: the dynamics, with n states and m controls.
        start: q(0), n numbers.
        goal: q(T), n numbers or None. None leaves a component free; its costate vanishes at T.
        horizon: T > 0 (s); None if it is free.
        control_weight: diagonal of R, m positive numbers.
        state_cost: Phi, a SymPy expression in the system's state and parameters.
        control_bounds: m pairs (minimum, maximum); None for unbounded controls.
        field: packed obstacle field (`Scenario.field`) whose proximity cost is added to Phi at the system's position.
        parameters: values of the system's parameters, in the order of their declaration.
        footprint: outline of the robot, `leapnav.envs.Disc`s along its heading, a `Box`, or the array of
            `RobotModel.outline`; None for one disc with the radius of the field.
        time_weight: c >= 0, cost per second.
        barrier_weight: weight of the barrier that approximates hard limits: if the proximity weight of the field is
            smaller, this is used instead. `solve` and `find_optimum` reduce it, see `leapnav.experts.hard_limits`.
        state_bounds: for each state None or a pair (lowest, highest), of which one may be infinite. Start and goal are
            inside. They are hard limits, approximated by the barrier (A. E. Bryson, W. F. Denham, S. E. Dreyfus,
            Optimal programming problems with inequality constraints I, AIAA Journal 1, 1963, treat them exactly). The
            goal of an angle with bounds is not met modulo 2 pi, but as it is.

    Raises:
        ValueError: an argument has a wrong length or an invalid value, or the horizon is free and there is neither a
            time weight nor a state cost nor an obstacle field.

    """

    system: ControlAffineSystem
    start: Sequence[float]
    goal: Sequence[float | None]
    horizon: float | None
    control_weight: Sequence[float]
    state_cost: Any = 0
    control_bounds: Sequence[tuple[float, float]] | None = None
    field: np.ndarray | None = None
    parameters: Sequence[float] = ()
    footprint: Sequence[Disc] | Box | np.ndarray | None = None
    time_weight: float = 0.0
    barrier_weight: float = 0.0
    state_bounds: Sequence[tuple[float, float] | None] | None = None

    def __post_init__(self) -> None:
        n, m = self.system.n, self.system.m
        for name, values, length in (
            ("start", self.start, n),
            ("goal", self.goal, n),
            ("control_weight", self.control_weight, m),
            ("parameters", self.parameters, len(self.system.parameters)),
        ):
            if not isinstance(values, (Sequence, np.ndarray)) or isinstance(values, str):
                raise ValueError(f"{name}: expected a sequence of {length} numbers, got {values!r}")
            if len(values) != length:
                raise ValueError(f"{name}: expected {length} numbers, got {len(values)}: {values!r}")
            if not all((v is None and name == "goal") or _is_finite(v) for v in values):
                raise ValueError(f"{name}: expected finite numbers, got {values!r}")
        if not all(w > 0 for w in self.control_weight):
            raise ValueError(f"control_weight: expected positive numbers, got {self.control_weight!r}")
        if self.horizon is not None and not (_is_finite(self.horizon) and self.horizon > 0):
            raise ValueError(f"horizon: expected a positive number, or None for a free horizon, got {self.horizon!r}")
        if not (_is_finite(self.time_weight) and self.time_weight >= 0):
            raise ValueError(f"time_weight: expected a number of at least 0, got {self.time_weight!r}")
        if not (_is_finite(self.barrier_weight) and self.barrier_weight >= 0):
            raise ValueError(f"barrier_weight: expected a number of at least 0, got {self.barrier_weight!r}")
        if self.control_bounds is not None:
            if len(self.control_bounds) != m:
                raise ValueError(f"control_bounds: expected {m} pairs, got {len(self.control_bounds)}")
            for low, high in self.control_bounds:
                if not (_is_number(low) and _is_number(high) and low < high):
                    raise ValueError(f"control_bounds: expected lowest < highest, got ({low!r}, {high!r})")
        # SymPy and NumPy numbers are accepted, but compiled functions need Python floats.
        for name in ("start", "goal", "control_weight", "parameters"):
            values = tuple(None if v is None else float(v) for v in getattr(self, name))
            object.__setattr__(self, name, values)
        object.__setattr__(self, "horizon", None if self.horizon is None else float(self.horizon))
        object.__setattr__(self, "time_weight", float(self.time_weight))
        object.__setattr__(self, "barrier_weight", float(self.barrier_weight))
        if self.control_bounds is not None:
            bounds = tuple((float(low), float(high)) for low, high in self.control_bounds)
            object.__setattr__(self, "control_bounds", bounds)
        if self.state_bounds is not None:
            object.__setattr__(self, "state_bounds", check_state_bounds(self.state_bounds, self.start, self.goal))
        if self.field is not None:
            object.__setattr__(self, "field", check_field(self.field))
        self._check_footprint()
        state_cost = as_expression("state_cost", self.state_cost)
        if self.horizon is None and self.time_weight == 0 and state_cost == 0 and self.field is None:
            raise ValueError(
                "time_weight: expected a positive number, since the horizon is free and there is no state cost, got 0"
            )
        unknown = state_cost.free_symbols - {*self.system.state, *self.system.parameters}
        if unknown:
            raise ValueError(
                f"state_cost: unknown symbol {sorted(map(str, unknown))[0]!r}; the state is {self.system.state}"
            )

    def _check_footprint(self) -> None:
        discs: Any = self.footprint
        if discs is None or isinstance(discs, Box) or (isinstance(discs, np.ndarray) and discs.shape[1:] == (5,)):
            return
        if not isinstance(discs, (tuple, list)) or not discs or not all(isinstance(disc, Disc) for disc in discs):
            raise ValueError(f"footprint: expected discs or a box (Disc, Box), got {self.footprint!r}")

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> OptimalControlProblem:
        """Return the problem of a scenario, whose last state is the time t if obstacles move, with lambda_t(T) = 0."""
        robot, cost, timed, bounds = scenario.robot, scenario.cost, scenario.moves, scenario.robot.state_bounds()
        return cls(
            system=system_of(type(robot), True) if timed else system_of(type(robot)),
            start=(*move_inside(bounds, scenario.start_state), *((0.0,) if timed else ())),
            goal=(*move_inside(bounds, scenario.goal_state), *((None,) if timed else ())),
            horizon=scenario.horizon,
            control_weight=robot.control_weight(cost),
            state_cost=state_cost_of(type(robot)),
            control_bounds=[(low, high) for low, high in robot.control_bounds().tolist()],
            field=scenario.field,
            parameters=robot.parameters(cost),
            footprint=scenario.outline if scenario.outline[:, 4].any() else robot.footprint,
            time_weight=cost.time_weight,
            state_bounds=(*bounds, None) if timed and bounds is not None else bounds,
        )

    def with_winding_of(self, states: np.ndarray) -> OptimalControlProblem:
        """Return the problem with each goal angle shifted by a multiple of 2 pi to where the path (N, n) ends."""
        goal = self.wound_goal(states)
        return self if goal == self.goal else replace(self, goal=goal)

    def wound_goal(self, states: np.ndarray) -> tuple[float | None, ...]:
        """Return the goal of `with_winding_of`."""
        goal, n = list(self.goal), self.system.n
        if np.ndim(states) != 2 or len(states) == 0:
            raise ValueError(f"states: expected the shape (any, {n}), got {np.shape(states)}")
        last = as_vector("states", states[-1], n)
        for i in self.winding_states:
            value = goal[i]
            if value is not None:
                # Rounded, because the path need not end exactly at the goal.
                goal[i] = value + 2 * math.pi * round((float(last[i]) - value) / (2 * math.pi))
        return tuple(goal)

    @cached_property
    def winding_states(self) -> tuple[int, ...]:
        """Indices of the angles, whose goal is met modulo 2 pi, without those with state bounds."""
        at = [self.system.state.index(symbol) for symbol in self.system.angles]
        return tuple(i for i in at if self.state_bounds is None or self.state_bounds[i] is None)

    @property
    def clock(self) -> int:
        """Index of the time in the state; -1 if it is no state."""
        return -1 if self.system.clock is None else self.system.state.index(self.system.clock)

    @property
    def starts_at_goal(self) -> bool:
        """Whether the start is the goal, up to multiples of 2 pi of the angles."""
        goal = self.wound_goal(np.array([self.start], dtype=float))
        return all(g is None or math.isclose(s, g, abs_tol=1e-12) for s, g in zip(self.start, goal, strict=True))

    def with_horizon(self, horizon: float) -> OptimalControlProblem:
        """Return the problem with a fixed horizon (s)."""
        return replace(self, horizon=horizon)

    def between(self, start: tuple[float, ...], goal: Sequence[float | None], horizon: float) -> OptimalControlProblem:
        """Return the problem for a part of a path, whose ends need not satisfy the state bounds, in a time (s)."""
        part = copy(self)
        # The ends are not checked, and the barrier has the same scales.
        part.__dict__.update(start=start, goal=goal, horizon=horizon, state_limits=self.state_limits)
        return part

    def with_barrier(self, weight: float) -> OptimalControlProblem:
        """Return the problem with another barrier weight."""
        return self if weight == self.barrier_weight else replace(self, barrier_weight=weight)

    @cached_property
    def proximity_weight(self) -> float:
        """The weight of the proximity cost that the solvers use; 0 without obstacles."""
        return 0.0 if self.field is None else max(float(read_header(self.field)["weight"]), self.barrier_weight)

    @property
    def has_hard_limits(self) -> bool:
        """Whether the cost of an optimum excludes the barrier: state bounds, or obstacles with proximity weight 0."""
        return bool(self.state_limits) or (self.field is not None and read_header(self.field)["weight"] == 0.0)

    @cached_property
    def state_limits(self) -> tuple[StateLimit, ...]:
        """The finite limits of the states."""
        return () if self.state_bounds is None else state_limits(self.state_bounds, self.start, self.goal)

    def barrier_cost(self, states: np.ndarray) -> np.ndarray:
        """Return the running cost (K,) of the barrier at states (K, n): what `barrier_weight` adds to the running cost.

        With a proximity weight below the barrier weight, it is the difference of the two proximity costs.
        """
        states = as_matrix("states", states, None, self.system.n)
        cost = np.zeros(len(states))
        for state, bound, slope in self.state_limits:
            cost += limit_costs(states[:, state].copy(), constant([bound, slope, self.barrier_weight]))
        if self.field is None or self.proximity_weight == 0.0:
            return cost
        added = 1.0 - float(read_header(self.field)["weight"]) / self.proximity_weight
        return cost + added * footprint_proximities(states, self.outline, self.arrays.field)

    @property
    def fixed_horizon(self) -> float:
        """The horizon (s).

        Raises:
            ValueError: it is free.

        """
        if self.horizon is None:
            raise ValueError("horizon: expected a fixed one, got None")
        return self.horizon

    def horizon_of(self, path: Trajectory) -> float:
        """Return the horizon (s), or the duration of a path if the horizon is free."""
        return float(path.times[-1]) if self.horizon is None else self.horizon

    @property
    def _compiled(self) -> tuple[ControlAffineSystem, sp.Expr]:
        """System and state cost in the form that is compiled; the time weight is one of its parameters."""
        state_cost = as_expression("state_cost", self.state_cost)
        return weighted_by_time(self.system, state_cost)

    @property
    def _obstacles(self) -> Obstacles:
        if self.field is None:
            return None
        return () if self.footprint is None else tuple(sorted({int(joint) for joint in self.outline[:, 4]}))

    @cached_property
    def outline(self) -> np.ndarray:
        """The robot's outline (K, 5), see `leapnav.envs.robots.footprints.outline_of`; (0, 5) without obstacles."""
        if self.field is None:
            return outline_of(()).reshape(-1, 5)
        discs = (Disc(radius=float(read_header(self.field)["radius"])),) if self.footprint is None else self.footprint
        return discs if isinstance(discs, np.ndarray) else outline_of(discs)

    @cached_property
    def compiled_dynamics(self) -> CompiledDynamics:
        """The compiled dynamics with controls as arguments, for direct transcription."""
        from leapnav.experts.problem.generated_dynamics import compile_dynamics

        return compile_dynamics(*self._compiled, self._obstacles, tuple(limit.state for limit in self.state_limits))

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions cannot be pickled; the receiving process creates its own.
        return {name: value for name, value in self.__dict__.items() if name not in ("arrays", "compiled_dynamics")}

    @cached_property
    def arrays(self) -> ProblemArrays:
        """The problem in the form that the kernels take."""
        from leapnav.experts.problem.generated_flow import compile_flow

        m, limits = self.system.m, self.state_limits
        flow, piece, control = compile_flow(*self._compiled, self._obstacles, tuple(limit.state for limit in limits))
        bounds = np.array(
            self.control_bounds if self.control_bounds is not None else [(-np.inf, np.inf)] * m, dtype=float
        )
        goal = np.array([0.0 if g is None else g for g in self.goal], dtype=float)
        outline = self.outline.ravel().tolist() if self._obstacles else ()
        parameters = *self.parameters, self.time_weight
        barriers = [number for limit in limits for number in (limit.bound, limit.slope, self.barrier_weight)]
        data = constant([*self.control_weight, *bounds[:, 0], *bounds[:, 1], *parameters, *barriers, *outline])
        field = constant([]) if self.field is None else with_weight(self.field, self.proximity_weight)
        return ProblemArrays(
            flow=ExtremalFlow(flow, piece, data, field),
            control=control,
            start=np.array(self.start, dtype=float),
            end=EndCondition(goal, np.array([g is None for g in self.goal]), self.horizon is None),
        )

    def estimate_costates(self, path: Trajectory) -> np.ndarray:
        """Return the costates (N, n) of least norm whose controls of the minimum principle follow a path."""
        times = as_vector("times", path.times)
        states = as_matrix("states", path.states, len(times), self.system.n)
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise ValueError(f"times: expected at least two increasing numbers, got {times}")
        drift, fields = self.dynamics(states)
        controls = least_squares_controls(fields, np.gradient(states, times, axis=0) - drift)
        return least_norm_costates(fields, -np.array(self.control_weight) * controls)

    def follow(self, states: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the controls (N, m) with which states (N, n) have given rates (N, n), in the least-squares sense."""
        drift, fields = self.dynamics(states)
        return least_squares_controls(fields, rates - drift)

    def dynamics(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the drift a(q) (N, n) and the control vector fields B(q) (N, n, m) at states (N, n)."""
        n, m = self.system.n, self.system.m
        states = as_matrix("states", states, None, n)
        drift, fields = np.empty((len(states), n)), np.empty((len(states), n, m))
        sample_dynamics(self.compiled_dynamics.affine, self.arrays.data, states, drift, fields)
        return drift, fields

    def straight_line(self, points: int = 33) -> Trajectory:
        """Return the straight line from start to goal; free components keep their initial value.

        If the horizon is free, it takes 1 s.
        """
        start = np.array(self.start, dtype=float)
        goal = np.array([s if g is None else g for s, g in zip(self.start, self.goal, strict=True)], dtype=float)
        fraction = np.linspace(0.0, 1.0, points)[:, None]
        return Trajectory(np.linspace(0.0, self.horizon or 1.0, points), start + fraction * (goal - start))


@dataclass(frozen=True, eq=False)
class ProblemArrays:
    """An optimal control problem in the form that the kernels take.

    Attributes:
        flow: compiled extremal flow with its constants.
        control: compiled control law, see `CONTROL_SIGNATURE`.
        start: (n,), q(0).
        end: conditions at the horizon.

    """

    flow: ExtremalFlow
    control: FunctionPointer
    start: np.ndarray
    end: EndCondition

    @property
    def goal(self) -> np.ndarray:
        """q(T), (n,); 0 where a component is free."""
        return self.end.goal

    @property
    def free(self) -> np.ndarray:
        """Which components of q(T) are free, (n,), bool."""
        return self.end.free

    @property
    def data(self) -> np.ndarray:
        """Control weights (m,), control bounds (2m,), parameters, limits of states, and the outline."""
        return self.flow.data

    @property
    def field(self) -> np.ndarray:
        """The packed obstacle field, or an empty array."""
        return self.flow.field

    def rates(self, z: np.ndarray) -> np.ndarray:
        """Return the derivative (2n,) of z = (q, lambda) along the extremal flow."""
        none, dz = np.empty((len(z), 0)), np.empty(len(z))
        self.flow.function(z, self.data, self.field, none, dz, none)
        return dz


def _is_number(value: Any) -> bool:
    """Return whether a value is a real number of Python, NumPy or SymPy that a double can represent."""
    try:
        return not isinstance(value, str) and not math.isnan(float(value))
    except (TypeError, ValueError, OverflowError):
        return False


def _is_finite(value: Any) -> bool:
    return _is_number(value) and math.isfinite(float(value))


def as_problem(problem: OptimalControlProblem | Scenario) -> OptimalControlProblem:
    """Return the problem of a scenario, or the problem itself."""
    if isinstance(problem, Scenario):
        return OptimalControlProblem.from_scenario(problem)
    if isinstance(problem, OptimalControlProblem):
        return problem
    raise TypeError(f"expected a Scenario or an OptimalControlProblem, got {type(cast(object, problem)).__name__}")
