"""Code generation of the extremal flow: derived in SymPy, written as a Python module, compiled by Numba.

For q' = a(q) + sum_j b_j(q) u_j and running cost 1/2 u'Ru + Phi(q), the reduced Hamiltonian of the minimum principle is
H*(q, lam) = a'lam + Phi - sum_j h_j(b_j'lam). Its gradient is the extremal flow z' = J grad H* with z = (q, lam), and
its Hessian gives the sensitivity (variational) equations S' = J hess H* S. Both are derived once per system, written as
a Python module with common subexpressions removed, and compiled into the user's cache directory.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement, product
from typing import Any, NamedTuple

import sympy as sp

from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.utils.caching import computed_once
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, FLOW_FUNCTION, PIECE_FUNCTION
from leapnav.experts.numerics.state_bounds import ENTRIES
from leapnav.experts.problem.code_generation import Assignments, load, unpack
from leapnav.experts.problem.system import ControlAffineSystem

# What obstacles contribute: None for nothing, () for the proximity cost of one disc at the position with the radius of
# the field, or the distinct joints of the outline of a footprint, see `leapnav.envs.field.rectangle`.
Obstacles = tuple[int, ...] | None


@computed_once(maxsize=64)
def compile_flow(
    system: ControlAffineSystem, state_cost: sp.Expr, obstacles: Obstacles, limited: tuple[int, ...] = ()
) -> tuple[FunctionPointer, FunctionPointer, FunctionPointer]:
    """Compile the extremal flow and the control law of a system.

    Args:
        system: the system.
        state_cost: SymPy expression in the state and the parameters.
        obstacles: see `Obstacles`.
        limited: for each limit of a state the index of the state.

    Returns:
        `flow(z, data, field, S, dz, dS) -> running cost`, `piece(z, data, field)` and `control(z, data, u)`, see
        `leapnav.experts.numerics.flow`.

    Raises:
        ValueError: there are obstacles, and the system has no position, or no heading for a footprint.

    """
    check_obstacles(system, obstacles)
    declaration = declare(system, state_cost, obstacles, limited)
    module = load("flow", __file__, declaration, lambda: _generate(system, state_cost, obstacles, limited))
    return (
        FunctionPointer(module.flow, FLOW_FUNCTION),
        FunctionPointer(module.piece, PIECE_FUNCTION),
        FunctionPointer(module.control, CONTROL_FUNCTION),
    )


def declare(system: ControlAffineSystem, state_cost: sp.Expr, obstacles: Obstacles, limited: tuple[int, ...]) -> str:
    """Return a text that identifies a system with its cost."""
    places = system.position, system.heading, system.clock, obstacles, limited
    return sp.srepr((system.state, system.parameters, system.drift, system.fields, state_cost, str(places)))


def check_obstacles(system: ControlAffineSystem, obstacles: Obstacles) -> None:
    """Raise ValueError unless a system has the symbols that obstacles need."""
    if obstacles is not None and system.position is None:
        raise ValueError("position: expected two state symbols for a problem with obstacles, got None")
    if obstacles and system.heading is None:
        raise ValueError("heading: expected a state symbol for a problem with a footprint, got None")


def _generate(system: ControlAffineSystem, state_cost: sp.Expr, obstacles: Obstacles, limited: tuple[int, ...]) -> str:
    """Return the source of the generated module."""
    n, m = system.n, system.m
    # The user's symbols are renamed, because their names need not be valid or distinct identifiers.
    q = sp.symbols(f"q:{n}", real=True)
    lam = sp.symbols(f"lam:{n}", real=True)
    u = sp.symbols(f"u:{m}", real=True)
    slope = sp.symbols(f"slope:{m}", real=True)  # h_j'': 1 / r_j within the control bounds, 0 at them
    z = (*q, *lam)
    parameters = sp.symbols(f"parameter:{len(system.parameters)}", real=True) if system.parameters else ()
    rename = dict(zip((*system.state, *system.parameters), (*q, *parameters), strict=True))
    drift = sum((sp.sympify(a).xreplace(rename) * p for a, p in zip(system.drift, lam, strict=True)), sp.Integer(0))
    switching = [
        sum((sp.sympify(b).xreplace(rename) * p for b, p in zip(column, lam, strict=True)), sp.Integer(0))
        for column in system.fields
    ]
    cost = sp.sympify(state_cost).xreplace(rename)

    value, gradient, hessian = cost, [sp.diff(drift + cost, s) for s in z], {}
    for j in range(m):
        gradient = [g + u[j] * sp.diff(switching[j], s) for g, s in zip(gradient, z, strict=True)]
    for a in range(2 * n):
        for b in range(a, 2 * n):
            entry = sp.diff(drift + cost, z[a], z[b])
            for j in range(m):
                p = switching[j]
                entry += u[j] * sp.diff(p, z[a], z[b]) - slope[j] * sp.diff(p, z[a]) * sp.diff(p, z[b])
            hessian[a, b] = hessian[b, a] = entry
    terms = obstacle_terms(system, obstacles)
    value = value + add_terms(terms, gradient, hessian)
    for i, (limit, first, second) in zip(limited, limit_symbols(limited), strict=True):
        value, gradient[i], hessian[i, i] = value + limit, gradient[i] + first, hessian[i, i] + second

    rate = [*gradient[n:], *(-g for g in gradient[:n])]
    jacobian = {}
    for a in range(2 * n):
        for b in range(2 * n):
            entry = hessian[a + n, b] if a < n else -hessian[a - n, b]
            if entry != 0:
                jacobian[a, b] = entry
    first = 3 * m + len(parameters)
    costs = call_costs(terms, limited, first)
    features = " + ".join(term.call("features", first + ENTRIES * len(limited)) for term in terms) or "0"
    sources = {
        **{f"q{i}": f"z[{i}]" for i in range(n)},
        **{f"lam{i}": f"z[{n + i}]" for i in range(n)},
        **{f"parameter{i}": f"data[{3 * m + i}]" for i in range(len(parameters))},
    }
    return _render(sources, switching, value, rate, jacobian, costs, features, import_costs(limited))


class ObstacleTerm(NamedTuple):
    """A part of the proximity cost: that of one disc, or of the rows of an outline with the same joint.

    Attributes:
        joint: the joint; None for one disc at the position.
        states: for x, y, of an outline the angle of the axis, and among moving obstacles the time, the indices of the
            states whose sum it is.
        moves: whether it is the cost of the moving obstacles, not of those at rest.

    """

    joint: int | None
    states: tuple[tuple[int, ...], ...]
    moves: bool = False

    def symbols(self) -> tuple[str, ...]:
        """Return the names of the value, the gradient and the Hessian (upper triangle, by rows)."""
        name, letters = f"{'psi' if self.moves else 'phi'}{self.joint or ''}", "xyht"[: len(self.states)]
        pairs = ["".join(pair) for pair in combinations_with_replacement(letters, 2)]
        return (name, *(f"{name}_{letter}" for letter in (*letters, *pairs)))

    def call(self, name: str, first: int) -> str:
        """Return the call of a function of a disc or of a footprint, whose outline begins at an index of the data."""
        states = ", ".join(" + ".join(f"q{i}" for i in sum_of) for sum_of in self.states)
        prefix = "moving_" if self.moves else ""
        if self.joint is None:
            return f"{prefix}disc_{name}({states}, header_of(field).radius, field)"
        return f"{prefix}footprint_{name}({states}, {self.joint}, data, {first}, field)"


def obstacle_terms(system: ControlAffineSystem, obstacles: Obstacles) -> list[ObstacleTerm]:
    """Return the parts of the proximity cost."""
    if obstacles is None or system.position is None:
        return []
    position = tuple((system.state.index(symbol),) for symbol in system.position)
    if not obstacles or system.heading is None:
        terms = [ObstacleTerm(None, position)]
    else:
        heading = system.state.index(system.heading)
        axes = [(heading, joint) if joint else (heading,) for joint in obstacles]
        terms = [ObstacleTerm(joint, (*position, axis)) for joint, axis in zip(obstacles, axes, strict=True)]
    if system.clock is not None:
        time = (system.state.index(system.clock),)
        terms += [ObstacleTerm(term.joint, (*term.states, time), True) for term in terms]
    return terms


def add_terms(
    terms: Sequence[ObstacleTerm], gradient: list[Any], hessian: dict[tuple[int, int], Any]
) -> sp.Expr | sp.Integer:
    """Add the derivatives of the proximity cost to those entries of a gradient and a Hessian that exist.

    Returns:
        The value.

    """
    value = sp.Integer(0)
    for term in terms:
        phi = [sp.Symbol(name, real=True) for name in term.symbols()]
        value, count = value + phi[0], len(term.states)
        for states, slope in zip(term.states, phi[1:], strict=False):
            for i in states:
                gradient[i] += slope
        pairs = combinations_with_replacement(range(count), 2)
        for (a, b), curvature in zip(pairs, phi[1 + count :], strict=True):
            for first, second in {(a, b), (b, a)}:
                for entry in product(term.states[first], term.states[second]):
                    if entry in hessian:
                        hessian[entry] += curvature
    return value


def limit_symbols(limited: Sequence[int]) -> list[tuple[sp.Symbol, sp.Symbol, sp.Symbol]]:
    """Return the symbols of the cost and its derivatives for each limit of a state."""
    return [sp.symbols(f"limit{k} limit{k}_d limit{k}_dd", real=True) for k in range(len(limited))]


def call_costs(terms: Sequence[ObstacleTerm], limited: Sequence[int], first: int) -> list[str]:
    """Return the lines that compute the costs of the limits of states and the proximity cost.

    Args:
        terms: parts of the proximity cost.
        limited: for each limit the index of the state.
        first: index of the limits in the data, after which the rows of an outline follow.

    """
    lines: list[str] = []
    for k, (i, symbols) in enumerate(zip(limited, limit_symbols(limited), strict=True)):
        lines.append(f"    {', '.join(map(str, symbols))} = limit_cost(q{i}, data, {first + ENTRIES * k})")
    first += ENTRIES * len(limited)
    return [*lines, *(f"    {', '.join(term.symbols())} = {term.call('proximity', first)}" for term in terms)]


def import_costs(limited: Sequence[int]) -> list[str]:
    """Return the lines that import what the lines of `call_costs` call."""
    limits = ["from leapnav.experts.numerics.state_bounds import limit_cost"] if limited else []
    names = "disc_features, disc_proximity, footprint_features, footprint_proximity"
    moving = ", ".join(f"moving_{name}" for name in names.split(", "))
    return [
        f"from leapnav.envs.field.moving import {moving}",
        "from leapnav.envs.field.layout import header_of",
        f"from leapnav.envs.field.proximity import {names}",
        *limits,
    ]


def _render(
    sources: dict[str, str],
    switching: Sequence[Any],
    value: Any,
    rate: list[sp.Expr],
    jacobian: dict[tuple[int, int], sp.Expr],
    costs: list[str],
    features: str,
    imports: list[str],
) -> str:
    """Return the source of a module that computes the given expressions, with common subexpressions removed.

    The functions begin with the variables `sources` that they use, and the flow computes the lines `costs` first. These
    lines and the expression `features` for the number of the closest features call functions of the lines `imports`.
    """
    m, size = len(switching), len(rate)
    expressions = {
        **{f"p{j}": p for j, p in enumerate(switching)},
        "value": value,
        **{f"rate{i}": r for i, r in enumerate(rate)},
        **{f"A{a}_{b}": entry for (a, b), entry in jacobian.items()},
    }
    assign = Assignments(expressions).assign

    controls: list[str] = []
    for j in range(m):
        controls += assign(f"p{j}", f"p{j}", "    ")
        controls += [
            f"    u{j} = -p{j} / data[{j}]; slope{j} = 1.0 / data[{j}]",
            f"    if u{j} < data[{m + j}]: u{j} = data[{m + j}]; slope{j} = 0.0",
            f"    elif u{j} > data[{2 * m + j}]: u{j} = data[{2 * m + j}]; slope{j} = 0.0",
        ]
    control_body = [*controls, *(f"    u[{j}] = u{j}" for j in range(m))]

    piece_body = [*controls, f"    number = {features}"]
    piece_body += [f"    number = 2 * number + (1 if slope{j} == 0.0 else 0)" for j in range(m)]

    lines = [*controls, *costs]
    lines += assign("value", "value", "    ")
    for i in range(size):
        lines += assign(f"dz[{i}]", f"rate{i}", "    ")
    lines.append("    if S.shape[1] > 0:")
    for a, b in jacobian:
        lines += assign(f"A{a}_{b}", f"A{a}_{b}", "        ")
    lines.append("        for c in range(S.shape[1]):")
    lines += [f"            s{b} = S[{b}, c]" for b in sorted({b for _, b in jacobian})]
    for a in range(size):
        terms = [f"A{a}_{b} * s{b}" for b in range(size) if (a, b) in jacobian]
        lines.append(f"            dS[{a}, c] = {' + '.join(terms) or '0.0'}")
    effort = " + ".join(f"0.5 * data[{j}] * u{j} * u{j}" for j in range(m))
    lines.append(f"    return value + {effort}")

    return "\n".join(
        [
            '"""Generated by leapnav.experts.problem.generated_flow: extremal flow and sensitivities. Do not edit."""',
            "import math",
            "from leapnav.envs.kernels import kernel",
            *imports,
            "from leapnav.experts.numerics.flow import CONTROL_SIGNATURE, FLOW_SIGNATURE, PIECE_SIGNATURE",
            "",
            "@kernel(FLOW_SIGNATURE)",
            "def flow(z, data, field, S, dz, dS):",
            *unpack(sources, lines),
            "",
            "@kernel(PIECE_SIGNATURE)",
            "def piece(z, data, field):",
            *unpack(sources, piece_body),
            "    return number",
            "",
            "@kernel(CONTROL_SIGNATURE)",
            "def control(z, data, u):",
            *unpack(sources, control_body),
            "",
        ]
    )
