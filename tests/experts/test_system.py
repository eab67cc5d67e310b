import numpy as np
import pytest
import sympy as sp
from helpers import best_known, published_problems

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, solve
from leapnav.experts.problem.code_generation import _check_same
from leapnav.experts.solve import METHODS
from leapnav.experts.solvers.initial_paths import initial_paths

x, v = sp.symbols("x v")

PROBLEMS = {name: problem for name, (problem, _, _) in published_problems().items()}
PROBLEMS["unicycle among discs"] = OptimalControlProblem.from_scenario(best_known()[0][0])


def reduced_hamiltonian(problem, z):
    """Return H* = a'lam + Phi + sum of 1/2 r u^2 + u p, computed from the flow as H = L + lam'q'."""
    n, flow = problem.system.n, problem.arrays.flow
    none, dz = np.empty((len(z), 0)), np.empty(len(z))
    running_cost = flow.function(z, flow.data, flow.field, none, dz, none)
    return running_cost + z[n:] @ dz[:n]


def rates(problem, z):
    return problem.arrays.rates(z)


def sample_points(problem, count=20):
    rng = np.random.default_rng(0)
    n = problem.system.n
    start = np.array(problem.start, dtype=float)
    return [np.concatenate([start + 0.3 * rng.normal(size=n), rng.normal(size=n)]) for _ in range(count)]


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_flow_is_the_symplectic_gradient_of_the_reduced_hamiltonian(name):
    problem = PROBLEMS[name]
    n, h = problem.system.n, 1e-6
    for z in sample_points(problem):
        gradient = np.array(
            [
                (reduced_hamiltonian(problem, z + e) - reduced_hamiltonian(problem, z - e)) / (2 * h)
                for e in h * np.eye(2 * n)
            ]
        )
        assert rates(problem, z) == pytest.approx(np.concatenate([gradient[n:], -gradient[:n]]), abs=1e-6, rel=1e-6)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_sensitivity_equations_are_the_derivative_of_the_flow(name):
    problem = PROBLEMS[name]
    n, h = problem.system.n, 1e-6
    for z in sample_points(problem):
        identity, jacobian, dz = np.eye(2 * n), np.empty((2 * n, 2 * n)), np.empty(2 * n)
        problem.arrays.flow.function(z, problem.arrays.data, problem.arrays.field, identity, dz, jacobian)
        differences = [(rates(problem, z + e) - rates(problem, z - e)) / (2 * h) for e in h * np.eye(2 * n)]
        assert jacobian == pytest.approx(np.array(differences).T, abs=2e-6, rel=2e-6)


def test_bounded_controls_saturate_and_the_flow_follows():
    system = ControlAffineSystem(state=(x, v), drift=(v, 0), fields=((0, 1),))
    problem = OptimalControlProblem(system, (0, 0), (1, 0), 1.0, (2.0,), control_bounds=((-0.5, 1.0),))
    u = np.empty(1)
    for costate, expected in ((0.4, -0.2), (5.0, -0.5), (-1.0, 0.5), (-5.0, 1.0)):
        problem.arrays.control(np.array([0.0, 0.0, 0.3, costate]), problem.arrays.data, u)
        assert u[0] == expected
        assert rates(problem, np.array([0.0, 0.0, 0.3, costate]))[1] == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"state": (x, x)}, "state: expected distinct"),
        ({"state": ("x", "v")}, "state: expected distinct SymPy symbols"),
        ({"drift": (0,)}, "drift: expected 2 expressions, one per state, got 1"),
        ({"fields": ()}, "fields: expected at least one"),
        ({"fields": ((0, 1), (1,))}, r"fields\[1\]: expected 2"),
        ({"fields": ((0, sp.Symbol("k")),)}, r"fields\[0\]: unknown symbol 'k'"),
        ({"angles": (sp.Symbol("theta"),)}, "angles: .*theta"),
    ],
)
def test_a_wrong_declaration_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        ControlAffineSystem(**{"state": (x, v), "drift": (v, 0), "fields": ((0, 1),), **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": (0,)}, "start: expected 2 numbers, got 1"),
        ({"start": (0, None)}, "start: expected finite"),
        ({"goal": (0, float("nan"))}, "goal: expected finite"),
        ({"horizon": 0.0}, "horizon: expected a positive number, or None for a free horizon, got 0.0"),
        ({"control_weight": (-1,)}, "control_weight: .*-1"),
        ({"control_bounds": ((1, 0),)}, r"control_bounds: .*\(1, 0\)"),
        ({"control_bounds": ()}, "control_bounds: expected 1 pairs"),
        ({"state_cost": sp.Symbol("k")}, "state_cost: unknown symbol 'k'"),
    ],
)
def test_a_wrong_problem_is_named(arguments, message):
    system = ControlAffineSystem(state=(x, v), drift=(v, 0), fields=((0, 1),))
    good = {"start": (0, 0), "goal": (1, 0), "horizon": 1.0, "control_weight": (1,)}
    with pytest.raises(ValueError, match=message):
        OptimalControlProblem(system, **{**good, **arguments})


def attitude():
    """Return the attitude dynamics of a body with moments of inertia 1, 2, 3, in modified Rodrigues parameters."""
    s, w = sp.Matrix(sp.symbols("s1:4")), sp.Matrix(sp.symbols("w1:4"))
    cross = sp.Matrix([[0, -s[2], s[1]], [s[2], 0, -s[0]], [-s[1], s[0], 0]])
    rates = sp.Rational(1, 4) * ((1 - s.dot(s)) * sp.eye(3) + 2 * cross + 2 * s * s.T) * w
    inertia = sp.diag(1, 2, 3)
    turning = -inertia.inv() * w.cross(inertia * w)
    fields = [(0, 0, 0, *column) for column in inertia.inv().tolist()]
    return ControlAffineSystem(state=(*s, *w), drift=(*rates, *turning), fields=fields)


def test_the_compiled_flow_computes_what_was_declared():
    # sympy.cse with its optimisations returns a wrong expression for this system.
    system = attitude()
    problem = OptimalControlProblem(system, (0,) * 6, (0.3, 0.5, -0.2, 0, 0, 0), 5.0, (1, 1, 1))
    drift = sp.lambdify(system.state, system.drift)
    for z in sample_points(problem):
        control = -np.array([z[9], z[10] / 2, z[11] / 3])
        expected = np.array(drift(*z[:6])) + np.concatenate([np.zeros(3), control / (1, 2, 3)])
        assert rates(problem, z)[:6] == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_all_methods_turn_a_body_at_the_same_cost():
    problem = OptimalControlProblem(attitude(), (0,) * 6, (0.3, 0.5, -0.2, 0, 0, 0), 5.0, (1, 1, 1))
    *_, guess = next(initial_paths(problem))  # the same guess that each solve would compute again
    costs = [solve(problem, method=method, guess=guess).cost for method in METHODS]
    assert costs == pytest.approx([0.80069849692] * 4, rel=1e-9)


def test_a_slip_in_the_generated_code_is_found_before_it_is_used():
    a, b, w0 = sp.symbols("a b w0")
    _check_same([a * b + 1], [(w0, a * b)], [w0 + 1])
    with pytest.raises(RuntimeError, match="does not compute"):
        _check_same([a * b + 1], [(w0, a + b)], [w0 + 1])


@pytest.mark.parametrize(
    ("cost", "fields", "start", "goal", "segments"),
    [
        (sp.sqrt(x**2 + v**2), ((1, 0), (0, 1)), (0, 0), (1, 1), None),
        pytest.param(sp.log(x), ((1, 0), (0, 1)), (0, 0), (1, 1), None, marks=pytest.mark.slow),
        # The singularity is crossed: Leapfrog searches for each arc around it, with 32 segments for a minute.
        pytest.param(0, ((1, 0), (0, 1 / x)), (-1, 0), (1, 1), 2, marks=pytest.mark.slow),
        (0, ((1, sp.sqrt(x)), (0, 1)), (0, 0), (1, 1), None),
    ],
)
def test_expressions_without_a_value_end_in_a_failure_and_not_in_a_crash(cost, fields, start, goal, segments, capfd):
    system = ControlAffineSystem(state=(x, v), drift=(0, 0), fields=fields)
    problem = OptimalControlProblem(system, start, goal, 1.0, (1, 1), state_cost=cost)
    for method in METHODS:
        extremal = solve(problem, method=method, segments=None if method == "single_shooting" else segments)
        assert isinstance(extremal.status.value, str)
    assert "Exception" not in capfd.readouterr().err


def test_kinks_and_any_kind_of_number_are_taken():
    system = ControlAffineSystem(state=(x, v), drift=(v, 0), fields=((0, 1),))
    for cost in (sp.Abs(x), sp.Max(x, 0) ** 2, sp.Integer(10) ** 20 * x**2 / sp.Integer(10) ** 20):
        problem = OptimalControlProblem(
            system, (0, 0), (sp.Integer(1), 0), sp.Integer(2), (np.int64(2),), state_cost=cost
        )
        assert solve(problem, method="multiple_shooting", segments=np.int64(20)).success
