"""Code generation of the extremal flow: derived in SymPy, written as a Python module, compiled by Numba.

For q' = a(q) + sum_j b_j(q) u_j and running cost 1/2 u'Ru + Phi(q), the reduced Hamiltonian of the minimum principle is
H*(q, lam) = a'lam + Phi - sum_j h_j(b_j'lam). Its gradient is the extremal flow z' = J grad H* with z = (q, lam), and
its Hessian gives the sensitivity (variational) equations S' = J hess H* S. Both are derived once per system, written as
a Python module with common subexpressions removed, and compiled into the user's cache directory.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import sympy as sp
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter
from sympy.simplify.cse_main import tree_cse

from leapnav.envs.kernels.decorator import cache_root, source_stamp
from leapnav.envs.kernels.numba_internals import FunctionPointer
from leapnav.envs.utils.files import write_text
from leapnav.experts.numerics.flow import CONTROL_FUNCTION, FLOW_FUNCTION
from leapnav.experts.problem.system import ControlAffineSystem

GENERATOR_VERSION = "4"  # part of the file name; to be increased whenever the generated code changes
# The modules that the generated module imports.
IMPORTED = "leapnav.envs.shapes.proximity", "leapnav.experts.numerics.flow"


@lru_cache(maxsize=64)
def compile_flow(
    system: ControlAffineSystem, state_cost: sp.Expr, in_field: bool
) -> tuple[FunctionPointer, FunctionPointer]:
    """Compile the extremal flow and the control law of a system.

    Args:
        system: the system.
        state_cost: SymPy expression in the state and the parameters.
        in_field: whether to add the proximity cost of a packed obstacle field at the system's position.

    Returns:
        `flow(z, data, field, S, dz, dS) -> running cost` and `control(z, data, u)`, see
        `leapnav.experts.numerics.flow`.

    Raises:
        ValueError: `in_field`, and the system has no position.

    """
    declaration = sp.srepr(
        (system.state, system.parameters, system.drift, system.fields, system.position, state_cost, in_field)
    )
    # The functions that the generated module calls are compiled into it, so the key includes their source.
    identity = "\n".join([GENERATOR_VERSION, declaration, *map(source_stamp, IMPORTED)])
    name = f"flow_{hashlib.sha256(identity.encode()).hexdigest()[:20]}"
    path = cache_root() / f"{name}.py"
    if not path.exists():
        write_text(path, _generate(system, state_cost, in_field))
    spec = importlib.util.spec_from_file_location(f"leapnav_generated.{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return FunctionPointer(module.flow, FLOW_FUNCTION), FunctionPointer(module.control, CONTROL_FUNCTION)


def _generate(system: ControlAffineSystem, state_cost: sp.Expr, in_field: bool) -> str:
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
    at: list[int] = []
    if in_field:
        if system.position is None:
            raise ValueError("position: expected two state symbols for a problem with obstacles, got None")
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
    """Printer of Python code in which all numbers are floats.

    In compiled code a division of floats by zero raises no error, and large integers do not overflow.
    """

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
    """Raise RuntimeError if an expression and its reduced form differ at a sample point.

    A wrong flow would not be noticed later: the certificate is computed with the same flow.
    """
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
    """Replace the distributions in the second derivatives of |x| and max(x, 0) by their values away from x = 0."""
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
    """Return the source of a module that computes the given expressions, with common subexpressions removed."""
    names = [
        *(f"p{j}" for j in range(m)),
        "value",
        *(f"rate{i}" for i in range(2 * n)),
        *(f"A{a}_{b}" for a, b in jacobian),
    ]
    plain = [_smooth(sp.sympify(e)) for e in (*switching, value, *rate, *jacobian.values())]
    # Common subtrees only: the optimisations of sympy.cse are known to have turned a sum into a product.
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
            '"""Generated by leapnav.experts.problem.generated_flow: extremal flow and sensitivities. Do not edit."""',
            "import math",
            "from leapnav.envs.kernels import kernel",
            "from leapnav.envs.shapes.proximity import proximity",
            "from leapnav.experts.numerics.flow import CONTROL_SIGNATURE, FLOW_SIGNATURE",
            "",
            "@kernel(FLOW_SIGNATURE)",
            "def flow(z, data, field, S, dz, dS):",
            *lines,
            "",
            "@kernel(CONTROL_SIGNATURE)",
            "def control(z, data, u):",
            *unpack,
            *control_body,
            "",
        ]
    )
