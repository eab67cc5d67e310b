import numpy as np
import pytest
from helpers import best_known, published_problems
from scipy.integrate import solve_ivp

from leapnav.envs import sample_scenario
from leapnav.experts import OptimalControlProblem, find_optimum
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.linear import eliminate, solve_banded, substitute

SCENARIOS = {s.name: (s, cost) for s, cost in best_known()}
PROBLEMS = published_problems()


def test_the_integrator_s_error_falls_with_order_eight_down_to_rounding():
    problem, _, _ = PROBLEMS["van-der-pol-free-end"]
    arrays = problem.arrays

    def end(steps):
        z, S = np.array([1.0, 0.0, 1.7, 0.0]), np.eye(4)
        for _ in range(steps):
            # With such a loose tolerance every step is accepted.
            propagate(arrays.flow, z, S, problem.horizon / steps, 1e9, 0.0, False)
        return z, S

    exact, exact_sensitivity = end(400)
    steps = np.array([4, 6, 8, 12, 16])
    for which, reference in ((0, exact), (1, exact_sensitivity)):
        errors = np.array([np.abs(end(count)[which] - reference).max() for count in steps])
        orders = np.log(errors[:-1] / errors[1:]) / np.log(steps[1:] / steps[:-1])
        assert np.all(orders > 7.5), (errors, orders)
    assert np.abs(end(100)[0] - exact).max() < 1e-13


def test_the_integrator_s_error_follows_its_tolerance():
    scenario, _ = SCENARIOS["clutter-9"]
    problem = OptimalControlProblem.from_scenario(scenario)
    optimum = find_optimum(scenario)
    start = np.concatenate([optimum.states[0], optimum.costates[0]])
    exact = np.concatenate(optimum.evaluate(3.0)[::2])
    errors = []
    for tolerance in (1e-5, 1e-7, 1e-9):
        z, S = start.copy(), np.empty((6, 0))
        propagate(problem.arrays.flow, z, S, 3.0, tolerance, 0.0, False)
        errors.append(np.abs(z - exact).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-6


def test_steps_end_where_the_closest_edge_or_vertex_of_a_polygon_changes():
    # The curvature of the distance is discontinuous there, and a step across it has a low order.
    optimum = find_optimum(sample_scenario("rooms", 0))
    flow, duration = optimum.problem.arrays.flow, optimum.horizon / 60
    smooth = flow._replace(piece=PROBLEMS["van-der-pol-free-end"][0].arrays.flow.piece)  # always the same number
    errors, evaluations = [], []
    for t in np.arange(60) * duration:
        z = np.concatenate(optimum.evaluate(t)[::2])
        end, across, S, S_across = z.copy(), z.copy(), np.eye(6), np.eye(6)
        counts = (
            propagate(flow, end, S, duration, 1e-9, 0.0, False)[-1],
            propagate(smooth, across, S_across, duration, 1e-9, 0.0, False)[-1],
        )
        if counts[0] == counts[1]:
            continue
        differences = np.empty((6, 6))
        for j, shift in enumerate(1e-6 * np.eye(6)):
            above, below = z + shift, z - shift
            propagate(flow, above, np.empty((6, 0)), duration, 1e-13, 0.0, False)
            propagate(flow, below, np.empty((6, 0)), duration, 1e-13, 0.0, False)
            differences[:, j] = (above - below) / 2e-6
        scale = np.abs(differences).max()
        assert end == pytest.approx(across, abs=1e-7)
        errors.append((np.abs(S - differences).max() / scale, np.abs(S_across - differences).max() / scale))
        evaluations.append(counts)
    ending, crossing = np.array(errors).T
    assert len(errors) >= 4 and ending.max() < 1e-7 < np.median(crossing)
    assert np.sum(evaluations, axis=0)[0] < 0.6 * np.sum(evaluations, axis=0)[1]


def test_a_control_at_its_limit_is_another_piece_of_the_flow():
    problem = OptimalControlProblem.from_scenario(sample_scenario("open", 1))
    flow, limits = problem.arrays.flow, np.array(problem.control_bounds)
    controls, numbers = np.empty((401, 2)), np.empty(401, dtype=int)
    for k, scale in enumerate(np.linspace(-8.0, 8.0, 401)):
        z = np.array([5.0, 5.0, 0.3, scale, 0.2, 0.4 * scale])
        problem.arrays.control(z, flow.data, controls[k])
        numbers[k] = flow.piece(z, flow.data, flow.field)
    saturated = (controls == limits[:, 0]) | (controls == limits[:, 1])
    assert saturated.any(axis=0).all() and not saturated.all(axis=0).any()
    assert ((numbers[1:] != numbers[:-1]) == (saturated[1:] != saturated[:-1]).any(axis=1)).all()


def test_dense_evaluation_agrees_with_independent_integration():
    scenario, _ = SCENARIOS["clutter-9"]
    extremal = find_optimum(scenario)

    def flow(_, z):
        return extremal.problem.arrays.rates(z)

    # Forward integration is well-conditioned over a part of the horizon only.
    for start in (0.0, scenario.horizon / 2):
        q, _, lam = extremal.evaluate(start)
        times = start + np.linspace(0.0, 1.5, 40)
        found = solve_ivp(flow, (times[0], times[-1]), [*q, *lam], "DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
        states, controls, costates = extremal.evaluate(times)
        assert np.hstack([states, costates]) == pytest.approx(found, abs=1e-7)
        assert controls[:, 1] == pytest.approx(-costates[:, 2] / 0.5, abs=1e-9)
    assert extremal.cost_to_go(0.0) == extremal.cost
    assert extremal.cost_to_go(scenario.horizon) == pytest.approx(0.0, abs=1e-12)


def test_the_linear_solvers_agree_with_numpy():
    rng = np.random.default_rng(0)
    for n, half in ((3, 1), (20, 2), (60, 8)):
        A, b = rng.normal(size=(n, n)), rng.normal(size=n)
        A[np.abs(np.subtract.outer(np.arange(n), np.arange(n))) > half] = 0.0
        expected = np.linalg.solve(A, b)
        rows = np.zeros((n, 3 * half + 1))
        for i in range(n):
            for j in range(max(0, i - half), min(n, i + half + 1)):
                rows[i, j - i + half] = A[i, j]
        banded, dense = b.copy(), b.copy()
        assert solve_banded(rows, banded, half)
        extended = np.column_stack([A, b])
        assert eliminate(extended, True, 0.0) != 0.0
        substitute(extended, dense)
        assert banded == pytest.approx(expected, rel=1e-8, abs=1e-10)
        assert dense == pytest.approx(expected, rel=1e-8, abs=1e-10)
    assert eliminate(np.zeros((2, 3)), True, 0.0) == 0.0
    assert not solve_banded(np.zeros((4, 4)), np.ones(4), 1)


@pytest.mark.parametrize("factor", [1e-200, 1e-15, 1.0, 1e15, 1e200])
def test_the_unit_of_a_banded_system_does_not_matter(factor):
    rng = np.random.default_rng(1)
    half, size = 2, 12
    rows = np.zeros((size, 3 * half + 1))
    for i in range(size):
        for j in range(max(0, i - half), min(size, i + half + 1)):
            rows[i, j - i + half] = rng.normal() + (4.0 if i == j else 0.0)
    right = rng.normal(size=size)
    expected, found = right.copy(), factor * right
    assert solve_banded(rows.copy(), expected, half)
    assert solve_banded(factor * rows, found, half)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    rows[5] = 0.0  # singular in every unit
    assert not solve_banded(factor * rows, factor * right, half)
