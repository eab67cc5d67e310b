"""Code generation of the dynamics with controls as arguments, for direct transcription.

The extremal flow (`generated_flow`) determines the controls from the costates. Direct transcription varies states and
controls independently, and needs the dynamics f(q, u) = a(q) + B(q) u, their Jacobians and the Hessian of lambda'f.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import NamedTuple

import sympy as sp
from numba import float64, types

from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING, VECTOR
from leapnav.envs.utils.caching import computed_once
from leapnav.experts.problem.code_generation import Assignments, load
from leapnav.experts.problem.generated_flow import (
    PHI,
    Obstacles,
    call_costs,
    check_obstacles,
    declare,
    import_costs,
    limit_symbols,
    obstacle_states,
)
from leapnav.experts.problem.system import ControlAffineSystem

# rates(q, u, data, f): fills f(q, u) (n,).
RATES_SIGNATURE = NOTHING(VECTOR, VECTOR, CONSTANT, VECTOR)
# derivatives(q, u, lam, data, fq, fu, hqq, hqu): fills df/dq (n, n), B(q) (n, m), and of lam'f the Hessian (n, n) in q
# and the mixed derivatives (n, m).
DERIVATIVES_SIGNATURE = NOTHING(VECTOR, VECTOR, VECTOR, CONSTANT, MATRIX, MATRIX, MATRIX, MATRIX)
# state_cost(q, data, field, gradient, hessian) -> Phi(q): fills its gradient (n,) and Hessian (n, n).
STATE_COST_SIGNATURE = float64(VECTOR, CONSTANT, CONSTANT, VECTOR, MATRIX)
RATES_FUNCTION = types.FunctionType(RATES_SIGNATURE)
DERIVATIVES_FUNCTION = types.FunctionType(DERIVATIVES_SIGNATURE)
STATE_COST_FUNCTION = types.FunctionType(STATE_COST_SIGNATURE)


class CompiledDynamics(NamedTuple):
    """The compiled dynamics of a system and its state cost, see the signatures of this module."""

    rates: FunctionPointer
    derivatives: FunctionPointer
    state_cost: FunctionPointer


@computed_once(maxsize=64)
def compile_dynamics(
    system: ControlAffineSystem, state_cost: sp.Expr, obstacles: Obstacles, limited: tuple[int, ...] = ()
) -> CompiledDynamics:
    """Compile the dynamics and the state cost of a system, see `leapnav.experts.problem.generated_flow.compile_flow`.

    Raises:
        ValueError: there are obstacles, and the system has no position, or no heading for a footprint.

    """
    check_obstacles(system, obstacles)
    declaration = declare(system, state_cost, obstacles, limited)
    module = load("dynamics", __file__, declaration, lambda: _generate(system, state_cost, obstacles, limited))
    return CompiledDynamics(
        FunctionPointer(module.rates, RATES_FUNCTION),
        FunctionPointer(module.derivatives, DERIVATIVES_FUNCTION),
        FunctionPointer(module.state_cost, STATE_COST_FUNCTION),
    )


def _generate(system: ControlAffineSystem, state_cost: sp.Expr, obstacles: Obstacles, limited: tuple[int, ...]) -> str:
    """Return the source of the generated module."""
    n, m, k = system.n, system.m, len(system.parameters)
    q, lam, u = (sp.symbols(f"{name}:{count}", real=True) for name, count in (("q", n), ("lam", n), ("u", m)))
    parameters = sp.symbols(f"parameter:{k}", real=True) if k else ()
    rename = dict(zip((*system.state, *system.parameters), (*q, *parameters), strict=True))
    fields = [[sp.sympify(e).xreplace(rename) for e in column] for column in system.fields]
    rates = [
        sp.sympify(a).xreplace(rename) + sp.Add(*(u[j] * fields[j][i] for j in range(m)))
        for i, a in enumerate(system.drift)
    ]
    weighted = sum((p * f for p, f in zip(lam, rates, strict=True)), sp.Integer(0))
    cost = sp.sympify(state_cost).xreplace(rename)
    at = obstacle_states(system, obstacles)
    phi = [sp.Symbol(name, real=True) for name in PHI[len(at)]]
    gradient = [sp.diff(cost, s) for s in q]
    hessian = {pair: sp.diff(cost, q[pair[0]], q[pair[1]]) for pair in combinations_with_replacement(range(n), 2)}
    value = cost
    if at:
        value = value + phi[0]
        for i in range(len(at)):
            gradient[at[i]] += phi[1 + i]
        for i, pair in enumerate(combinations_with_replacement(at, 2)):
            hessian[min(pair), max(pair)] += phi[1 + len(at) + i]
    for i, (limit, first, second) in zip(limited, limit_symbols(limited), strict=True):
        value, gradient[i], hessian[i, i] = value + limit, gradient[i] + first, hessian[i, i] + second

    unpack_q = "    " + "; ".join(f"q{i} = q[{i}]" for i in range(n))
    unpack_u = "    " + "; ".join(f"u{j} = u[{j}]" for j in range(m))
    unpack_lam = "    " + "; ".join(f"lam{i} = lam[{i}]" for i in range(n))
    unpack_parameters = [f"    parameter{i} = data[{3 * m + i}]" for i in range(k)]
    jacobians = {
        **{f"fq[{i}, {j}]": sp.diff(rates[i], q[j]) for i in range(n) for j in range(n)},
        **{f"fu[{i}, {j}]": fields[j][i] for i in range(n) for j in range(m)},
        **{f"hqq[{i}, {j}]": sp.diff(weighted, q[min(i, j)], q[max(i, j)]) for i in range(n) for j in range(n)},
        **{f"hqu[{i}, {j}]": sp.diff(weighted, q[i], u[j]) for i in range(n) for j in range(m)},
    }
    costs = {
        "value": value,
        **{f"gradient[{i}]": g for i, g in enumerate(gradient)},
        **{f"hessian[{i}, {j}]": hessian[min(i, j), max(i, j)] for i in range(n) for j in range(n)},
    }
    bodies = [_body(expressions) for expressions in ({f"f[{i}]": r for i, r in enumerate(rates)}, jacobians, costs)]
    return "\n".join(
        [
            '"""Generated by leapnav.experts.problem.generated_dynamics: dynamics and state cost. Do not edit."""',
            "import math",
            "from leapnav.envs.kernels import kernel",
            *import_costs(limited),
            "from leapnav.experts.problem.generated_dynamics import (",
            "    DERIVATIVES_SIGNATURE, RATES_SIGNATURE, STATE_COST_SIGNATURE,",
            ")",
            "",
            "@kernel(RATES_SIGNATURE)",
            "def rates(q, u, data, f):",
            *(unpack_q, unpack_u, *unpack_parameters, *bodies[0]),
            "",
            "@kernel(DERIVATIVES_SIGNATURE)",
            "def derivatives(q, u, lam, data, fq, fu, hqq, hqu):",
            *(unpack_q, unpack_u, unpack_lam, *unpack_parameters, *bodies[1]),
            "",
            "@kernel(STATE_COST_SIGNATURE)",
            "def state_cost(q, data, field, gradient, hessian):",
            *(unpack_q, *unpack_parameters, *call_costs(at, limited, 3 * m + k), *bodies[2]),
            "    return value",
            "",
        ]
    )


def _body(expressions: dict[str, sp.Expr]) -> list[str]:
    """Return the lines that compute expressions, by target."""
    assignments = Assignments(expressions)
    return [line for target in expressions for line in assignments.assign(target, target, "    ")]
