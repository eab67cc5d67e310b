"""Code generation: SymPy expressions as Numba kernels in a module that is written to the user's cache directory."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import sympy as sp
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter
from sympy.simplify.cse_main import tree_cse

from leapnav.envs.kernels.compilation import GENERATED, import_generated
from leapnav.envs.kernels.decorator import cache_root
from leapnav.envs.utils.files import write_text


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


PRINTER = _Printer({"fully_qualified_modules": True})


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


class Assignments:
    """Python assignments of expressions with common subexpressions removed.

    Each common subexpression is computed once, before its first use, in the order in which `assign` is called. A
    subexpression that was first assigned inside a branch is not available outside of it.

    Args:
        expressions: the expressions by name.

    """

    def __init__(self, expressions: dict[str, Any]) -> None:
        plain = [_smooth(sp.sympify(e)) for e in expressions.values()]
        # Common subtrees only: the optimisations of sympy.cse are known to have turned a sum into a product.
        self._shared, reduced = tree_cse(plain, sp.numbered_symbols("w"), order="none")
        _check_same(plain, self._shared, reduced)
        self._reduced: dict[str, Any] = dict(zip(expressions, reduced, strict=True))
        self._emitted: set[sp.Symbol] = set()

    def assign(self, target: str, name: str, indent: str) -> list[str]:
        """Return the lines that assign an expression, given by its name, to a target."""
        lines: list[str] = []

        def require(e: sp.Expr) -> None:
            for symbol, definition in self._shared:
                if symbol in e.free_symbols and symbol not in self._emitted:
                    require(definition)
                    self._emitted.add(symbol)
                    lines.append(f"{indent}{symbol} = {PRINTER.doprint(definition)}")

        expression = self._reduced[name]
        require(expression)
        return [*lines, f"{indent}{target} = {PRINTER.doprint(expression)}"]


def unpack(sources: Mapping[str, str], body: Sequence[str]) -> list[str]:
    """Return the lines of a body after those that assign the variables it uses; `sources` are their expressions."""
    used = set(re.findall(r"\w+", "\n".join(body)))
    return [*(f"    {name} = {source}" for name, source in sources.items() if name in used), *body]


def load(kind: str, generator: str, declaration: str, generate: Callable[[], str]) -> ModuleType:
    """Return a generated module, which is written if the cache does not contain it.

    Args:
        kind: prefix of the module's name.
        generator: source file of the module that generates it. The content depends on it, on the other generators of
            this package, which it may call, and on the version of SymPy.
        declaration: text that determines the content of the module, together with the generator.
        generate: function that returns the source.

    """
    files = [*sorted(Path(__file__).parent.glob("generated_*.py")), Path(__file__), Path(generator)]
    sources = (file.read_text(encoding="utf-8") for file in files)
    identity = "\n".join([sp.__version__, declaration, *sources])
    name = f"{kind}_{hashlib.sha256(identity.encode()).hexdigest()[:20]}"
    path = cache_root() / f"{name}.py"
    if not path.exists():
        write_text(path, generate())
    return import_generated(f"{GENERATED}.{name}")
