import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from helpers import best_known, published_problems
from scipy.integrate import solve_ivp

from leapnav.envs import Scenario
from leapnav.envs.obstacles import clearances
from leapnav.experts import ControlAffineSystem, OptimalControlProblem, Path, Status, find_optimum, solve
from leapnav.experts.integrator import propagate
from leapnav.experts.linear import solve_banded, solve_dense
from leapnav.experts.solve import METHODS

SCENARIOS = {s.name: (s, cost) for s, cost in best_known()}
PROBLEMS = published_problems()
# Methods that solve a published problem from the default guess; the others need a guess of the costates.
FROM_A_STRAIGHT_LINE = [
    ("double-integrator-energy", "single_shooting"),
    ("double-integrator-energy", "multiple_shooting"),
    ("double-integrator-energy", "leapfrog"),
    ("se2-far", "multiple_shooting"),
    ("van-der-pol-free-end", "single_shooting"),
    ("van-der-pol-free-end", "multiple_shooting"),
    ("van-der-pol-free-end", "leapfrog"),
]


def shooting_guess(problem, costate):
    """The path that the flow draws from an initial costate."""
    n = problem.system.n

    def flow(_, z):
        dz, empty = np.empty(2 * n), np.empty((2 * n, 0))
        problem.arrays.flow(z, problem.arrays.data, problem.arrays.field, empty, dz, empty)
        return dz

    times = np.linspace(0.0, problem.horizon, 65)
    start = np.concatenate([np.asarray(problem.start, dtype=float), costate])
    z = solve_ivp(flow, (0.0, problem.horizon), start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    return Path(times, z[:, :n], z[:, n:])


@pytest.mark.parametrize(("name", "method"), FROM_A_STRAIGHT_LINE)
def test_published_problems_from_a_straight_line(name, method):
    problem, cost, _ = PROBLEMS[name]
    extremal = solve(problem, method=method)
    assert extremal.success, extremal.certificate
    assert extremal.cost == pytest.approx(cost, rel=1e-7)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("name", "costate"),
    [
        ("se2-far", (-1.0, -0.5, -0.5)),
        ("se2-side-step", (2.9, -5.0, -1.5)),
        ("grushin", (5.0, 6.3)),
        ("van-der-pol-free-end", (1.7, 0.0)),
    ],
)
def test_published_problems_from_a_guess_of_the_costate(name, costate, method):
    problem, cost, _ = PROBLEMS[name]
    extremal = solve(problem, method=method, guess=shooting_guess(problem, costate))
    assert extremal.success, (extremal.status, extremal.certificate)
    assert extremal.cost == pytest.approx(cost, rel=1e-7)


def grushin_geodesic(a, b):
    """End point of the Grushin geodesic from the origin with x1 = (a/b) sin(b t), at t = 1."""
    return a / b * math.sin(b), -(a * a) / b * (0.5 - math.sin(2 * b) / (4 * b))


def test_an_extremal_past_its_conjugate_point_is_no_success():
    # det d(x1, x2)/d(a, b) = a^2 tau (sin tau - tau cos tau) / b^4 with tau = b t: it vanishes where tan tau = tau.
    problem, _, _ = PROBLEMS["grushin"]
    first = 4.493409457909064
    for b, conjugate in ((4.4, None), (5.0, first / 5.0), (6.0, first / 6.0)):
        beyond = replace(problem, goal=grushin_geodesic(2.5, b))
        extremal = solve(beyond, method="single_shooting", guess=shooting_guess(beyond, (-2 * 2.5, 2 * b)))
        assert extremal.cost == pytest.approx(2.5**2, rel=1e-7)
        found = extremal.certificate.conjugate_point
        if conjugate is None:
            assert extremal.success
            assert found is None
        else:
            assert extremal.status is Status.CONJUGATE_POINT
            assert found == pytest.approx(conjugate, abs=1e-3)


def test_the_other_published_grushin_extremal_is_a_local_minimum_and_dearer():
    # J = 6.333416555 was published as the optimum. Its b is just beyond pi, where it stops being the global minimum,
    # but before 4.49, where it would stop being a local one.
    problem, cost, _ = PROBLEMS["grushin"]
    b = 3.1543
    for _ in range(50):  # fixed point of sin b = -0.01 b / a, with a from the second component
        a = math.sqrt(b / (0.5 - math.sin(2 * b) / (4 * b)))
        b = math.pi + math.asin(0.01 * b / a)
    extremal = solve(problem, method="single_shooting", guess=shooting_guess(problem, (-2 * a, 2 * b)))
    assert extremal.success
    assert extremal.cost == pytest.approx(6.333416555, rel=1e-7)
    assert extremal.cost > cost


@pytest.mark.parametrize("name", ["clutter-0", "clutter-9", "rooms-11", "slalom-4"])
def test_leapfrog_and_multiple_shooting_find_the_same_extremal_of_a_scenario(name):
    scenario, _ = SCENARIOS[name]
    reference = find_optimum(scenario)
    assert reference.success
    again = solve(scenario, method="multiple_shooting", guess=reference)
    assert again.cost == pytest.approx(reference.cost, rel=1e-9)
    leapfrog = solve(scenario, method="leapfrog", guess=Path(reference.times, reference.states))
    assert leapfrog.success
    assert leapfrog.cost == pytest.approx(reference.cost, rel=1e-9)


def gaps(problem, times, nodes):
    """Jumps of the states from arc to arc, and what the boundary conditions miss."""
    n, arrays = problem.system.n, problem.arrays
    found = [np.abs(nodes[0, :n] - arrays.start).max()]
    found.append(np.abs(np.where(arrays.free, nodes[-1, n:], nodes[-1, :n] - arrays.goal)).max())
    for k in range(len(times) - 1):
        z, none = nodes[k].copy(), np.empty((2 * n, 0))
        propagate(arrays.flow, z, none, times[k + 1] - times[k], arrays.data, arrays.field, 1e-13, 0.0, False)
        found.append(np.abs(z[:n] - nodes[k + 1, :n]).max())
    return max(found)


@pytest.mark.parametrize("polish", [True, False])
@pytest.mark.parametrize("order", ["sequential", "red_black"])
@pytest.mark.parametrize("update", ["mean_time", "half_cost"])
@pytest.mark.parametrize("name", ["clutter-0", "clutter-3", "clutter-9", "polygons-9"])
def test_every_path_of_leapfrog_is_feasible_and_its_cost_never_rises(name, update, order, polish):
    scenario, _ = SCENARIOS[name]
    extremal = solve(scenario, method="leapfrog", update=update, order=order, polish=polish)
    assert extremal.success
    sweeps = [row for row in extremal.history if row.phase in ("sweep", "reduce")]
    assert len(sweeps) >= 2
    assert np.all(np.diff([row.cost for row in sweeps]) <= 1e-12)
    assert extremal.cost <= sweeps[-1].cost + 1e-8
    for row in sweeps:
        assert len(row.times) == row.segments + 1
        assert np.all(np.diff(row.times) > 0)
        # Over arcs of several seconds, which only the reduction makes, errors of rounding grow by a factor of 1e4.
        assert gaps(extremal.problem, row.times, row.nodes) <= (1e-9 if polish else 1e-8)
        assert row.residual == pytest.approx(gaps(extremal.problem, row.times, row.nodes), abs=1e-9)
    if update == "half_cost":
        assert not np.allclose(sweeps[1].times, sweeps[0].times)
    if not polish:
        assert min(row.segments for row in sweeps) <= 4


def test_the_costate_is_the_gradient_of_the_optimal_cost():
    scenario, _ = SCENARIOS["clutter-5"]
    reference = find_optimum(scenario)
    h = 2e-5  # third derivatives are large near an obstacle

    def cost(**changes):
        fields = scenario.to_dict()
        moved = Scenario.from_dict({**fields, **{k: v(fields[k]) for k, v in changes.items()}})
        extremal = solve(moved, method="multiple_shooting", guess=reference, tol=1e-11)
        assert extremal.success
        return extremal.cost

    def shift(i, by):
        return lambda values: [v + by * (k == i) for k, v in enumerate(values)]

    for i in range(3):
        at_start = (cost(start=shift(i, h)) - cost(start=shift(i, -h))) / (2 * h)
        assert at_start == pytest.approx(reference.costates[0, i], rel=1e-5, abs=1e-6)
        at_goal = (cost(goal=shift(i, h)) - cost(goal=shift(i, -h))) / (2 * h)
        assert at_goal == pytest.approx(-reference.costates[-1, i], rel=1e-5, abs=1e-6)
    by_time = (cost(horizon=lambda t: t + h) - cost(horizon=lambda t: t - h)) / (2 * h)
    assert by_time == pytest.approx(reference.hamiltonian[0], rel=1e-5)


def test_speed_and_turn_rate_stay_within_the_robot_s_limits():
    fields = SCENARIOS["clutter-5"][0].to_dict()
    free = find_optimum(Scenario.from_dict(fields))
    fastest = np.abs(free.controls).max(axis=0)
    limits = 0.97 * fastest[0], 0.9 * fastest[1]
    fields["robot"] |= {"max_speed": limits[0], "max_turn_rate": limits[1]}
    bounded = find_optimum(Scenario.from_dict(fields))
    assert bounded.success
    assert np.all(np.abs(bounded.controls) <= np.array(limits) + 1e-12)
    assert bounded.cost > free.cost


def test_a_free_goal_heading_ends_with_a_vanishing_costate():
    fields = SCENARIOS["clutter-5"][0].to_dict()
    fixed = find_optimum(Scenario.from_dict(fields))
    goal = fields["goal"]
    free = find_optimum(Scenario.from_dict({**fields, "goal": [goal[0], goal[1], None]}))
    assert free.success
    assert free.costates[-1, 2] == pytest.approx(0.0, abs=1e-8)
    assert free.cost < fixed.cost


def test_dense_evaluation_agrees_with_independent_integration():
    scenario, _ = SCENARIOS["clutter-9"]
    extremal = find_optimum(scenario)
    arrays = extremal.problem.arrays
    dz, empty = np.empty(6), np.empty((6, 0))

    def flow(_, z):
        arrays.flow(z, arrays.data, arrays.field, empty, dz, empty)
        return dz.copy()

    # From the middle outwards, which is where forward integration is still well-conditioned.
    for start in (0.0, scenario.horizon / 2):
        q, _, lam = extremal.evaluate(start)
        times = start + np.linspace(0.0, 1.5, 40)
        found = solve_ivp(flow, (times[0], times[-1]), [*q, *lam], "DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
        states, controls, costates = extremal.evaluate(times)
        assert np.hstack([states, costates]) == pytest.approx(found, abs=1e-7)
        assert controls[:, 1] == pytest.approx(-costates[:, 2] / 0.5, abs=1e-9)
    assert extremal.cost_to_go(0.0) == extremal.cost
    assert extremal.cost_to_go(scenario.horizon) == pytest.approx(0.0, abs=1e-12)


def test_the_integrator_s_error_falls_with_order_eight_down_to_rounding():
    problem, _, _ = PROBLEMS["van-der-pol-free-end"]
    arrays = problem.arrays

    def end(steps):
        z, S = np.array([1.0, 0.0, 1.7, 0.0]), np.eye(4)
        for _ in range(steps):
            # A tolerance this loose accepts the given step as it is.
            propagate(arrays.flow, z, S, problem.horizon / steps, arrays.data, arrays.field, 1e9, 0.0, False)
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
        propagate(problem.arrays.flow, z, S, 3.0, problem.arrays.data, problem.arrays.field, tolerance, 0.0, False)
        errors.append(np.abs(z - exact).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-6


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
        assert solve_dense(A.copy(), dense)
        assert banded == pytest.approx(expected, rel=1e-8, abs=1e-10)
        assert dense == pytest.approx(expected, rel=1e-8, abs=1e-10)
    assert not solve_dense(np.zeros((2, 2)), np.ones(2))
    assert not solve_banded(np.zeros((4, 4)), np.ones(4), 1)


def test_no_path_has_its_own_status():
    walls = [{"polygon": {"vertices": [[5, y], [5.5, y], [5.5, y + 5.0], [5, y + 5.0]]}} for y in (0.0, 5.0)]
    fields = {**SCENARIOS["clutter-0"][0].to_dict(), "obstacles": walls, "start": [2, 5, 0.0], "goal": [8, 5, 0.0]}
    for extremal in (find_optimum(Scenario.from_dict(fields)), solve(Scenario.from_dict(fields))):
        assert extremal.status is Status.NO_PATH
        assert not extremal.success
        assert "path" in extremal.status.value
        assert extremal.to_dict()["cost"] is None
        for use in (lambda e=extremal: e.evaluate(0.0), lambda e=extremal: e.cost_to_go(0.0)):
            with pytest.raises(ValueError, match="there is no path"):
                use()
        with pytest.raises(ValueError, match="guess: the extremal has no path"):
            solve(Scenario.from_dict(fields), guess=extremal)


def test_a_path_through_an_obstacle_is_a_collision():
    # A thin disc in the middle of the way, driven through because the guess does.
    fields = {
        **SCENARIOS["clutter-0"][0].to_dict(),
        "obstacles": [{"circle": {"center": [5, 5], "radius": 0.02}}],
        "cost": {"speed_weight": 1.0, "turn_weight": 0.5, "proximity_weight": 1e-3, "proximity_scale": 0.1},
        "start": [2, 5, 0.0],
        "goal": [8, 5, 0.0],
        "horizon": 6.0,
    }
    scenario = Scenario.from_dict(fields)
    times = np.linspace(0, 6, 61)
    guess = Path(times, np.stack([2 + times, np.full(61, 5.0), np.zeros(61)], axis=1))
    extremal = solve(scenario, method="multiple_shooting", guess=guess)
    assert extremal.status is Status.COLLISION
    assert extremal.certificate.clearance == pytest.approx(-0.27, abs=1e-3)


def test_too_few_iterations_have_their_own_status():
    scenario, _ = SCENARIOS["clutter-9"]
    extremal = solve(scenario, method="multiple_shooting", max_iterations=1)
    assert extremal.status is Status.MAX_ITERATIONS
    assert "max_iterations" in extremal.status.value


def test_a_goal_that_cannot_be_reached_stalls():
    x, v = sp.symbols("x v")
    system = ControlAffineSystem(state=(x, v), drift=(v, 0), fields=((0, 1),))
    problem = OptimalControlProblem(system, (0, 0), (10, 0), 1.0, (1.0,), control_bounds=((-1, 1),))
    assert solve(problem, method="single_shooting").status in (Status.STALLED, Status.SINGULAR)


def test_an_uncontrollable_system_is_singular():
    x, v = sp.symbols("x v")
    system = ControlAffineSystem(state=(x, v), drift=(0, 0), fields=((1, 0),))
    problem = OptimalControlProblem(system, (0, 0), (1, 1), 1.0, (1.0,))
    for method in METHODS:
        expected = Status.SUBPROBLEM if method == "leapfrog" else Status.SINGULAR
        assert solve(problem, method=method).status is expected


def test_a_flow_that_blows_up_diverges():
    x = sp.Symbol("x")
    system = ControlAffineSystem(state=(x,), drift=(x**3,), fields=((1,),))
    problem = OptimalControlProblem(system, (1,), (0,), 10.0, (1.0,))
    assert solve(problem, method="single_shooting").status is Status.DIVERGED


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "newton"}, "method: expected one of .*'newton'"),
        ({"tol": 0.0}, "tol: .*0.0"),
        ({"max_iterations": 0}, "max_iterations: .*0"),
        ({"segments": 0}, "segments: .*0"),
        ({"guess": Path(np.array([0.0]), np.zeros((1, 3)))}, "guess: its times"),
        (
            {"guess": Path(np.array([0.0, 1.0]), np.zeros((2, 3)))},
            "guess: its times must run from 0 to 5.4, not 0 to 1",
        ),
        ({"guess": Path(np.array([0.0, 5.4]), np.zeros((2, 2)))}, "guess: its states must have shape"),
        ({"guess": Path(np.array([0.0, 5.4]), np.full((2, 3), np.nan))}, "guess: its states are not finite"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(SCENARIOS["clutter-0"][0], **arguments)


def test_an_obstacle_between_two_integrator_steps_is_seen():
    # The flow does not feel this disc, so the integrator's steps are decimetres long.
    fields = {
        **SCENARIOS["clutter-0"][0].to_dict(),
        "robot": {"model": "unicycle", "radius": 0.01, "max_speed": 2.0, "max_turn_rate": 3.0},
        "obstacles": [{"circle": {"center": [5.03, 5.0], "radius": 0.02}}],
        "cost": {"speed_weight": 1.0, "turn_weight": 0.5, "proximity_weight": 0.0, "proximity_scale": 0.1},
        "start": [2, 5, 0.0],
        "goal": [8, 5, 0.0],
        "horizon": 6.0,
    }
    extremal = find_optimum(Scenario.from_dict(fields))
    assert not extremal.success
    assert extremal.status is Status.COLLISION
    assert extremal.certificate.clearance == pytest.approx(-0.03, abs=1e-3)


def test_a_focal_point_of_free_end_components_is_no_success():
    # x' = u, Phi = -x^2/2, free end: x = 0 is an extremal, and a minimum only for horizons below pi/2.
    x = sp.Symbol("x")
    system = ControlAffineSystem(state=(x,), drift=(0,), fields=((1,),))
    for horizon in (1.5, 1.6, 2.0, 3.0):
        problem = OptimalControlProblem(system, (0,), (None,), horizon, (1.0,), state_cost=-(x**2) / 2)
        extremal = solve(problem, method="multiple_shooting")
        if horizon < math.pi / 2:
            assert extremal.success
        else:
            assert extremal.status is Status.CONJUGATE_POINT
            assert extremal.certificate.conjugate_point == pytest.approx(horizon - math.pi / 2, abs=1e-3)


def test_a_clearance_between_the_nodes_is_seen():
    """The certificate looks at the dense path: its clearance is that of a thousand points, not of the nodes."""
    extremal = find_optimum(SCENARIOS["slalom-4"][0])
    states = extremal.evaluate(np.linspace(0, extremal.problem.horizon, 20_000))[0]
    dense = clearances(np.ascontiguousarray(states), extremal.problem.field).min()
    assert extremal.certificate.clearance == pytest.approx(dense, abs=1e-4)
