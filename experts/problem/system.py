"""Control-affine systems, declared in SymPy, which is imported when the first one is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from leapnav.envs.robots import DifferentialDrive, DynamicUnicycle, RobotModel, Unicycle

if TYPE_CHECKING:
    import sympy as sp


@dataclass(frozen=True)
class ControlAffineSystem:
    """A control-affine system q' = a(q) + sum_j u_j b_j(q), declared with SymPy symbols.

    The extremal flow and its sensitivities are derived from the declaration, compiled at first use and cached on disk.
    Instances are immutable and hashable.

    Args:
        state: the n state symbols.
        drift: a(q), n expressions or numbers.
        fields: b_j(q), for each of the m controls a sequence of n expressions or numbers.
        angles: state symbols that are angles; their goal is met modulo 2 pi.
        position: the two state symbols that are the position in the plane, for systems that move among obstacles.
        parameters: symbols in `drift`, `fields` and the state cost whose values belong to the problem
            (`OptimalControlProblem.parameters`). A new value needs no compilation.
        labels: names of the n states and the m controls with their units, in Matplotlib's mathtext, for plots; by
            default the symbols of the states, and u_1, ..., u_m.
        heading: the state symbol that is the heading, for systems with a footprint.
        clock: the state symbol that is the time, for systems among moving obstacles; its drift is 1.

    Attributes:
        n: number of states.
        m: number of controls.

    Raises:
        ValueError: lengths disagree, or an expression has an unknown symbol or no finite value.

    Example:
        The Grushin plane:

        >>> x1, x2 = sympy.symbols("x1 x2")
        >>> grushin = ControlAffineSystem(state=(x1, x2), drift=(0, 0), fields=((1, 0), (0, x1)))

    """

    state: tuple[sp.Symbol, ...]
    drift: tuple[sp.Expr, ...]
    fields: tuple[tuple[sp.Expr, ...], ...]
    angles: tuple[sp.Symbol, ...] = field(default=())
    position: tuple[sp.Symbol, sp.Symbol] | None = None
    parameters: tuple[sp.Symbol, ...] = field(default=())
    labels: tuple[str, ...] = field(default=(), compare=False)
    heading: sp.Symbol | None = None
    clock: sp.Symbol | None = None

    def __init__(
        self,
        state: Sequence[sp.Symbol],
        drift: Sequence[Any],
        fields: Sequence[Sequence[Any]],
        angles: Sequence[sp.Symbol] = (),
        position: Sequence[sp.Symbol] | None = None,
        parameters: Sequence[sp.Symbol] = (),
        *,
        labels: Sequence[str] = (),
        heading: sp.Symbol | None = None,
        clock: sp.Symbol | None = None,
    ) -> None:
        import sympy as sp

        n = len(state)
        if n == 0 or len(set(state)) < n or not all(isinstance(s, sp.Symbol) for s in state):
            raise ValueError(f"state: expected distinct SymPy symbols, got {state!r}")
        if len(set(parameters)) < len(parameters) or not all(isinstance(s, sp.Symbol) for s in parameters):
            raise ValueError(f"parameters: expected distinct SymPy symbols, got {parameters!r}")
        if set(parameters) & set(state):
            raise ValueError(f"parameters: {sorted(map(str, set(parameters) & set(state)))[0]!r} is a state")
        if len(drift) != n:
            raise ValueError(f"drift: expected {n} expressions, one per state, got {len(drift)}")
        if len(fields) == 0:
            raise ValueError("fields: expected at least one control vector field, got none")
        for j, column in enumerate(fields):
            if len(column) != n:
                raise ValueError(f"fields[{j}]: expected {n} expressions, one per state, got {len(column)}")
        if labels and len(labels) != n + len(fields):
            raise ValueError(f"labels: expected {n + len(fields)}, one per state and control, got {len(labels)}")
        values = {
            "labels": tuple(labels),
            "state": tuple(state),
            "drift": tuple(as_expression("drift", e) for e in drift),
            "fields": tuple(tuple(as_expression(f"fields[{j}]", e) for e in c) for j, c in enumerate(fields)),
            "angles": tuple(angles),
            "position": None if position is None else tuple(position),
            "parameters": tuple(parameters),
            "heading": heading,
            "clock": clock,
        }
        for where, expressions in [
            ("drift", values["drift"]),
            *((f"fields[{j}]", c) for j, c in enumerate(values["fields"])),
        ]:
            unknown = set().union(*(e.free_symbols for e in expressions)) - {*state, *parameters}
            if unknown:
                raise ValueError(
                    f"{where}: unknown symbol {sorted(map(str, unknown))[0]!r}; the state is {tuple(state)}, "
                    f"the parameters are {tuple(parameters)}"
                )
        places = {"angles": values["angles"], "position": values["position"] or ()}
        single = {"heading": heading, "clock": clock}
        for where, chosen in (*places.items(), *((name, (s,) if s is not None else ()) for name, s in single.items())):
            if not set(chosen) <= set(state):
                raise ValueError(f"{where}: {chosen} is not among the state symbols {tuple(state)}")
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state)

    @property
    def m(self) -> int:
        """Number of controls."""
        return len(self.fields)


@cache
def time_weight_symbol() -> sp.Symbol:
    """Return the symbol of the cost per second; its name is not one that users choose."""
    import sympy as sp

    return sp.Symbol("_leapnav_time_weight", nonnegative=True)


@cache
def clock_symbol() -> sp.Symbol:
    """Return the symbol of the time as a state; a symbol "t" without the assumption is another one."""
    import sympy as sp

    return sp.Symbol("t", real=True)


@cache
def weighted_by_time(system: ControlAffineSystem, state_cost: sp.Expr) -> tuple[ControlAffineSystem, sp.Expr]:
    """Return a system and its state cost with the time weight as an additional parameter."""
    weight = time_weight_symbol()
    return replace(system, parameters=(*system.parameters, weight)), state_cost + weight


def as_expression(where: str, value: Any) -> sp.Expr:
    """Convert a value to a SymPy expression.

    Args:
        where: name of the argument, for the error message.
        value: an expression, a number or text.

    Raises:
        ValueError: the value is no expression, or it contains NaN or infinity.

    """
    import sympy as sp

    try:
        expression = sp.sympify(value)
    except (sp.SympifyError, TypeError, AttributeError, SyntaxError):
        expression = None
    if not isinstance(expression, sp.Expr) or expression.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise ValueError(f"{where}: expected an expression, got {value!r}")
    return expression


@cache
def system_of(model: type[RobotModel], timed: bool = False) -> ControlAffineSystem:
    """Return the system of a robot model; if it is timed, with the time as its last state, for moving obstacles."""
    dynamics = model.dynamics()
    x, y, heading = dynamics.state[:3]
    labels, n = list(dynamics.labels), len(dynamics.state)
    if timed and labels:
        labels.insert(n, "$t$ (s)")
    return ControlAffineSystem(
        state=(*dynamics.state, *((clock_symbol(),) if timed else ())),
        drift=(*dynamics.drift, *((1,) if timed else ())),
        fields=[(*column, *((0,) if timed else ())) for column in dynamics.fields],
        angles=(heading, *(dynamics.state[model.state_names.index(name)] for name in model.heading_states)),
        position=(x, y),
        parameters=dynamics.parameters,
        labels=labels,
        heading=heading,
        clock=clock_symbol() if timed else None,
    )


@cache
def state_cost_of(model: type[RobotModel]) -> sp.Expr:
    """Return the state cost of a robot model, without the proximity cost."""
    return as_expression("state_cost", model.dynamics().state_cost)


def switching_functions(
    model: type[RobotModel], states: np.ndarray, costates: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return the switching functions B(q)'lambda, the derivatives of lambda'q' with respect to the controls.

    Args:
        model: the robot's model.
        states (N, n): states.
        costates (N, n): costates.
        parameters (N, k): parameters of the dynamics.

    Returns:
        An array (N, m).

    """
    functions, count = _switching_functions(model), len(states)
    arguments = (*states.T, *costates.T, *parameters.reshape(count, -1).T)
    return np.stack([np.broadcast_to(function(*arguments), count) for function in functions], axis=1)


@cache
def _switching_functions(model: type[RobotModel]) -> list[Callable[..., np.ndarray]]:
    """Return the switching functions of (q, lambda, parameters)."""
    import sympy as sp

    dynamics = model.dynamics()
    costate = sp.symbols(f"costate:{len(dynamics.state)}")
    arguments = (*dynamics.state, *costate, *dynamics.parameters)
    products = [sum(sp.sympify(b) * p for b, p in zip(field, costate, strict=True)) for field in dynamics.fields]
    return [sp.lambdify(arguments, product, modules="numpy") for product in products]


def unicycle() -> ControlAffineSystem:
    """Return the unicycle: q = (x, y, theta), u = (v, omega) in m/s and rad/s."""
    return system_of(Unicycle)


def differential_drive() -> ControlAffineSystem:
    """Return the differential drive: q = (x, y, theta), u = (left, right), the wheel speeds in m/s.

    Its parameter `track` is the distance (m) between the wheels.
    """
    return system_of(DifferentialDrive)


def unicycle_with_inertia() -> ControlAffineSystem:
    """Return the unicycle with inertia: q = (x, y, theta, v, omega), u = (dv/dt, domega/dt) in m/s^2 and rad/s^2."""
    system = system_of(DynamicUnicycle)
    return ControlAffineSystem(
        state=system.state,
        drift=system.drift,
        fields=system.fields,
        angles=system.angles,
        position=system.position,
        labels=system.labels,
        heading=system.heading,
    )
