"""Control-affine systems declared in SymPy, and the compiled extremal flow derived from the declaration.

For q' = a(q) + sum_j b_j(q) u_j and running cost 1/2 u'Ru + Phi(q), the minimum principle's reduced Hamiltonian is
H*(q, lam) = a'lam + Phi - sum_j h_j(b_j'lam). Its gradient is the extremal flow z' = J grad H* with z = (q, lam), its
Hessian the sensitivity (variational) equations S' = J hess H* S. Both are derived here once per system, written as a
plain Python module with common subexpressions removed, and compiled by Numba into the user's cache directory.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import platformdirs
import sympy as sp
from numba import types
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter
from sympy.simplify.cse_main import tree_cse

from leapnav.envs.compiling import source_stamp
from leapnav.experts.integrator import CONTROL, FLOW

GENERATOR_VERSION = "3"  # part of the file name: raise it whenever the generated text changes
CALLED = "leapnav.envs.obstacles", "leapnav.experts.integrator"  # what that text imports


@dataclass(frozen=True)
class ControlAffineSystem:
    """q' = drift(q) + sum_j u_j b_j(q) with `fields` b_j, declared with SymPy symbols.

    Args:
        state: the n state symbols.
        drift: a(q), n expressions (numbers allowed).
        fields: b_j(q), one tuple of n expressions per control.
        parameters: symbols in `drift`, `fields` and the state cost that are numbers of the problem, not of the system:
            `OptimalControlProblem(parameters=...)` gives their values, and a new value compiles nothing.
        angles: state symbols that are angles; a goal for them is met modulo 2 pi.
        position: the two state symbols that are a point in the plane, for systems that move among obstacles.

    Raises:
        ValueError: shapes disagree, or an expression uses an unknown symbol.

    Example: the Grushin plane.

        >>> x1, x2 = sympy.symbols("x1 x2")
        >>> grushin = ControlAffineSystem(state=(x1, x2), drift=(0, 0), fields=((1, 0), (0, x1)))

    """

    state: tuple[sp.Symbol, ...]
    drift: tuple[sp.Expr, ...]
    fields: tuple[tuple[sp.Expr, ...], ...]
    angles: tuple[sp.Symbol, ...] = field(default=())
    position: tuple[sp.Symbol, sp.Symbol] | None = None
    parameters: tuple[sp.Symbol, ...] = field(default=())

    def __init__(
        self,
        state: Sequence[sp.Symbol],
        drift: Sequence[Any],
        fields: Sequence[Sequence[Any]],
        angles: Sequence[sp.Symbol] = (),
        position: Sequence[sp.Symbol] | None = None,
        parameters: Sequence[sp.Symbol] = (),
    ) -> None:
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
        values = {
            "state": tuple(state),
            "drift": tuple(as_expression("drift", e) for e in drift),
            "fields": tuple(tuple(as_expression(f"fields[{j}]", e) for e in c) for j, c in enumerate(fields)),
            "angles": tuple(angles),
            "position": None if position is None else tuple(position),
            "parameters": tuple(parameters),
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
        for where, chosen in (("angles", values["angles"]), ("position", values["position"] or ())):
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


def as_expression(where: str, value: Any) -> sp.Expr:
    """A SymPy expression, or what SymPy can make one of.

    Raises:
        ValueError: it is none, or has no value anywhere; the message begins with `where`.

    """
    try:
        expression = sp.sympify(value)
    except (sp.SympifyError, TypeError, AttributeError, SyntaxError):
        expression = None
    if not isinstance(expression, sp.Expr) or expression.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise ValueError(f"{where}: expected an expression, got {value!r}")
    return expression


def unicycle() -> ControlAffineSystem:
    """The two-wheeled robot: q = (x, y, theta), u = (v, omega)."""
    x, y, theta = sp.symbols("x y theta")
    return ControlAffineSystem(
        state=(x, y, theta),
        drift=(0, 0, 0),
        fields=((sp.cos(theta), sp.sin(theta), 0), (0, 0, 1)),
        angles=(theta,),
        position=(x, y),
    )


def differential_drive() -> ControlAffineSystem:
    """The same robot with its wheels' speeds as controls: q = (x, y, theta), u = (left, right) in m/s.

    The parameter is the distance between the wheels (m).
    """
    x, y, theta, track = sp.symbols("x y theta track")
    return ControlAffineSystem(
        state=(x, y, theta),
        drift=(0, 0, 0),
        fields=(
            (sp.cos(theta) / 2, sp.sin(theta) / 2, -1 / track),
            (sp.cos(theta) / 2, sp.sin(theta) / 2, 1 / track),
        ),
        angles=(theta,),
        position=(x, y),
        parameters=(track,),
    )


def unicycle_with_inertia() -> ControlAffineSystem:
    """The robot with inertia: q = (x, y, theta, v, omega), u = (dv/dt, domega/dt)."""
    x, y, theta, v, omega = sp.symbols("x y theta v omega")
    return ControlAffineSystem(
        state=(x, y, theta, v, omega),
        drift=(v * sp.cos(theta), v * sp.sin(theta), omega, 0, 0),
        fields=((0, 0, 0, 1, 0), (0, 0, 0, 0, 1)),
        angles=(theta,),
        position=(x, y),
    )


class CompiledFunction:
    """A compiled function as the argument of a kernel: its type and its address.

    Numba also takes the dispatcher itself, but then resolves its type anew in every call, which takes a tenth of the
    time of a short solve.
    """

    def __init__(self, dispatcher: Any, kind: types.FunctionType) -> None:
        self._numba_type_ = kind
        self._address = types.CompileResultWAP(dispatcher.get_compile_result(kind.signature)).__wrapper_address__()
        self._dispatcher = dispatcher  # keeps the code alive

    def __wrapper_address__(self) -> int:
        return self._address

    def __call__(self, *arguments: Any) -> Any:
        """Calls the function from Python."""
        return self._dispatcher(*arguments)


@lru_cache(maxsize=64)
def compile_flow(
    system: ControlAffineSystem, state_cost: sp.Expr, in_field: bool
) -> tuple[CompiledFunction, CompiledFunction]:
    """A system's compiled `flow(z, data, field, S, dz, dS) -> running cost` and `control(z, data, u)`.

    `state_cost` is a SymPy expression in the state; with `in_field` the proximity cost of a packed obstacle field at
    the system's position is added to it.
    """
    declaration = sp.srepr(
        (system.state, system.parameters, system.drift, system.fields, system.position, state_cost, in_field)
    )
    # What the generated text calls is compiled into it, so its source belongs to the key.
    identity = "\n".join([GENERATOR_VERSION, declaration, *map(source_stamp, CALLED)])
    name = f"flow_{hashlib.sha256(identity.encode()).hexdigest()[:20]}"
    path = cache_directory() / f"{name}.py"
    if not path.exists():
        _write_atomically(path, _generate(system, state_cost, in_field))
    spec = importlib.util.spec_from_file_location(f"leapnav_generated.{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return CompiledFunction(module.flow, FLOW), CompiledFunction(module.control, CONTROL)


def chosen_cache_directory() -> Path:
    """Where compiled systems are to be kept: LEAPNAV_CACHE_DIR, or the user's cache."""
    return Path(os.environ.get("LEAPNAV_CACHE_DIR") or platformdirs.user_cache_dir("leapnav", appauthor=False))


def cache_directory() -> Path:
    """The same folder, which is made, or a new temporary one if it cannot be written."""
    directory = chosen_cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        directory = Path(tempfile.mkdtemp(prefix="leapnav-"))
    return directory if os.access(directory, os.W_OK) else Path(tempfile.mkdtemp(prefix="leapnav-"))


def _write_atomically(path: Path, text: str) -> None:
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
        file.write(text)
    os.replace(file.name, path)


def _generate(system: ControlAffineSystem, state_cost: sp.Expr, in_field: bool) -> str:
    """The text of the generated module."""
    n, m = system.n, system.m
    # Fixed names inside the module, whatever the user called the symbols.
    q = sp.symbols(f"q:{n}", real=True)
    lam = sp.symbols(f"lam:{n}", real=True)
    u = sp.symbols(f"u:{m}", real=True)
    slope = sp.symbols(f"slope:{m}", real=True)  # h_j'': 1 / r_j inside the control bounds, 0 beyond
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
    at: list[int] = []
    if in_field:
        if system.position is None:
            raise ValueError("the system has no position, so it cannot move among obstacles")
        phi = sp.symbols("phi phi_x phi_y phi_xx phi_xy phi_yy", real=True)
        at = [system.state.index(s) for s in system.position]
        value = value + phi[0]
        for k in range(2):
            gradient[at[k]] += phi[1 + k]
        for k, row, column in ((3, 0, 0), (4, 0, 1), (4, 1, 0), (5, 1, 1)):
            hessian[at[row], at[column]] += phi[k]

    rate = [*gradient[n:], *(-g for g in gradient[:n])]
    jacobian = {}
    for a in range(2 * n):
        for b in range(2 * n):
            entry = hessian[a + n, b] if a < n else -hessian[a - n, b]
            if entry != 0:
                jacobian[a, b] = entry
    return _render(n, m, len(parameters), switching, value, rate, jacobian, at)


class _Printer(PythonCodePrinter):
    """Python text whose numbers are floats: compiled, they divide by zero without an error, and none is too large."""

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802
        return f"{float(expr)!r}"

    def _print_Rational(self, expr: Any) -> str:  # noqa: N802
        return f"{float(expr)!r}"

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802
        base, exponent = expr.as_base_exp()
        text = self.parenthesize(base, PRECEDENCE["Atom"])
        if exponent.is_Integer and 0 < abs(int(exponent)) <= 4:
            power = "*".join([text] * abs(int(exponent)))
            return f"({power})" if exponent > 0 else f"(1.0/({power}))"
        if exponent == sp.Rational(1, 2):
            return f"math.sqrt({self.doprint(base)})"
        if exponent == sp.Rational(-1, 2):
            return f"(1.0/math.sqrt({self.doprint(base)}))"
        return f"({text}**({self.doprint(exponent)}))"


_PRINTER = _Printer({"fully_qualified_modules": True})


def _check_same(plain: list[Any], shared: Sequence[tuple[Any, Any]], reduced: Sequence[Any]) -> None:
    """Compares expressions with their reduced forms at a point: nothing that comes later could tell a wrong flow."""
    symbols = sorted(set().union(*(e.free_symbols for e in plain)), key=str)
    point = {symbol: sp.Float(0.3 + 0.61803398875 * k % 0.5) for k, symbol in enumerate(symbols)}
    values = dict(point)
    for symbol, definition in shared:
        values[symbol] = sp.sympify(definition).xreplace(values)
    for expression, short in zip(plain, reduced, strict=True):
        expected, found = (complex(sp.sympify(e).xreplace(values).evalf()) for e in (expression, short))
        if abs(expected - found) > 1e-9 * (1.0 + abs(expected)):
            raise RuntimeError(f"the generated code does not compute {expression}: {found} instead of {expected}")


def _smooth(expression: Any) -> Any:
    """Second derivatives of |x| and max(x, 0) as they are off the kink."""
    expression = expression.replace(sp.DiracDelta, lambda *_: sp.Integer(0))
    return expression.replace(sp.Heaviside, lambda x, *_: (1 + sp.sign(x)) / 2)


def _render(
    n: int,
    m: int,
    parameters: int,
    switching: Sequence[Any],
    value: Any,
    rate: list[sp.Expr],
    jacobian: dict[tuple[int, int], sp.Expr],
    position: list[int],
) -> str:
    names = [
        *(f"p{j}" for j in range(m)),
        "value",
        *(f"rate{i}" for i in range(2 * n)),
        *(f"A{a}_{b}" for a, b in jacobian),
    ]
    plain = [_smooth(sp.sympify(e)) for e in (*switching, value, *rate, *jacobian.values())]
    # Common subtrees only: the optimisations of sympy.cse have turned a sum into a product.
    shared, reduced = tree_cse(plain, sp.numbered_symbols("w"), order="none")
    _check_same(plain, shared, reduced)
    expressions: dict[str, Any] = dict(zip(names, reduced, strict=True))

    emitted: set[sp.Symbol] = set()

    def assign(target: str, expression: sp.Expr, indent: str) -> list[str]:
        lines: list[str] = []

        def require(e: sp.Expr) -> None:
            for symbol, definition in shared:
                if symbol in e.free_symbols and symbol not in emitted:
                    require(definition)
                    emitted.add(symbol)
                    lines.append(f"{indent}{symbol} = {_PRINTER.doprint(definition)}")

        require(expression)
        return [*lines, f"{indent}{target} = {_PRINTER.doprint(expression)}"]

    unpack = [
        "    " + "; ".join(f"q{i} = z[{i}]" for i in range(n)),
        "    " + "; ".join(f"lam{i} = z[{n + i}]" for i in range(n)),
        *(f"    parameter{i} = data[{3 * m + i}]" for i in range(parameters)),
    ]
    controls: list[str] = []
    for j in range(m):
        controls += assign(f"p{j}", expressions[f"p{j}"], "    ")
        controls += [
            f"    u{j} = -p{j} / data[{j}]; slope{j} = 1.0 / data[{j}]",
            f"    if u{j} < data[{m + j}]: u{j} = data[{m + j}]; slope{j} = 0.0",
            f"    elif u{j} > data[{2 * m + j}]: u{j} = data[{2 * m + j}]; slope{j} = 0.0",
        ]
    control_body = [*controls, *(f"    u[{j}] = u{j}" for j in range(m))]

    lines = [*unpack, *controls]
    if position:
        lines.append(
            f"    phi, phi_x, phi_y, phi_xx, phi_xy, phi_yy = proximity(q{position[0]}, q{position[1]}, field)"
        )
    lines += assign("value", expressions["value"], "    ")
    for i in range(2 * n):
        lines += assign(f"dz[{i}]", expressions[f"rate{i}"], "    ")
    lines.append("    if S.shape[1] > 0:")
    for a, b in jacobian:
        lines += assign(f"A{a}_{b}", expressions[f"A{a}_{b}"], "        ")
    lines.append("        for c in range(S.shape[1]):")
    for a in range(2 * n):
        terms = [f"A{a}_{b} * S[{b}, c]" for b in range(2 * n) if (a, b) in jacobian]
        lines.append(f"            dS[{a}, c] = {' + '.join(terms) or '0.0'}")
    effort = " + ".join(f"0.5 * data[{j}] * u{j} * u{j}" for j in range(m))
    lines.append(f"    return value + {effort}")

    return "\n".join(
        [
            '"""Generated by leapnav.experts.system: extremal flow and sensitivities. Do not edit."""',
            "import math",
            "from numba import njit",
            "from leapnav.envs.obstacles import proximity",
            "from leapnav.experts.integrator import CONTROL_SIGNATURE, FLOW_SIGNATURE",
            "",
            '@njit(FLOW_SIGNATURE, cache=True, error_model="numpy", nogil=True)',
            "def flow(z, data, field, S, dz, dS):",
            *lines,
            "",
            '@njit(CONTROL_SIGNATURE, cache=True, error_model="numpy", nogil=True)',
            "def control(z, data, u):",
            *unpack,
            *control_body,
            "",
        ]
    )
