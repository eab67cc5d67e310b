import math
import pickle

import numpy as np
import pytest
import sympy as sp
from helpers import best_known, known_problems, published_problems, scenario_fields, shooting_guess

from leapnav.envs import Scenario
from leapnav.experts import (
    ControlAffineSystem,
    OptimalControlProblem,
    SolveError,
    Status,
    Trajectory,
    find_optimum,
    solve,
)
from leapnav.experts.hard_limits import BARRIER_TOLERANCE
from leapnav.experts.minimum_time import minimum_time
from leapnav.experts.problem.system import differential_drive, unicycle_with_inertia
from leapnav.experts.solve import METHODS

SCENARIOS = {s.name: (s, cost) for s, cost in best_known()}
PROBLEMS = published_problems()
# Only `minimum_time` solves problems without control cost.
KNOWN, KNOWN_TIMES = (
    [
        pytest.param(entry, id=f"{entry.name}-{entry.method}", marks=pytest.mark.slow if entry.is_slow else ())
        for entry in known_problems()
        if (entry.method == "minimum_time") == is_time
    ]
    for is_time in (False, True)
)

x, v, y, z = sp.symbols("x v y z")
DOUBLE_INTEGRATOR = ControlAffineSystem(state=(x, v), drift=(v, 0), fields=((0, 1),))
HEISENBERG = ControlAffineSystem(state=(x, y, z), drift=(0, 0, 0), fields=((1, 0, -y / 2), (0, 1, x / 2)))
# Angular velocities of a body with moments of inertia 1, 2, 3 and a torque about each axis.
RIGID_BODY = ControlAffineSystem(
    state=(x, y, z),
    drift=(-y * z, x * z, -x * y / 3),
    fields=((1, 0, 0), (0, sp.Rational(1, 2), 0), (0, 0, sp.Rational(1, 3))),
)
PENDULUM = ControlAffineSystem(state=(x, v), drift=(v, -sp.sin(x)), fields=((0, 1),), angles=(x,))
# Costs by hand: x' = -x + u is linear; R. W. Brockett, Control theory and singular Riemannian geometry (1981), for the
# loop of least energy around a given area; the free rigid body is braked along its own rotation, J = sum I_i^2 w_i^2 /
# (2 T), since its gyroscopic torques do no work; a double integrator from rest to rest with |u| <= 5 saturates at both
# ends, J = 12.5 - 50 sqrt(0.15) / 3.
BY_HAND = {
    "exponential": (
        OptimalControlProblem(ControlAffineSystem(state=(x,), drift=(-x,), fields=((1,),)), (-1,), (0,), 1.0, (1.0,)),
        math.exp(-2) / (1 - math.exp(-2)),
    ),
    "heisenberg": (OptimalControlProblem(HEISENBERG, (0, 0, 0), (0, 0, 1), 1.0, (1, 1)), 2 * math.pi),
    "rigid-body": (OptimalControlProblem(RIGID_BODY, (0.1, 0.5, 0.3), (0, 0, 0), 5.0, (1, 1, 1)), 0.182),
    "bounded": (
        OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 0), (1, 0), 1.0, (1.0,), control_bounds=((-5, 5),)),
        12.5 - 50 * math.sqrt(0.15) / 3,
    ),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_published_problems_are_solved_from_nothing(name, method):
    problem, cost, _ = PROBLEMS[name]
    extremal = solve(problem, method=method)
    assert extremal.success, (extremal.status, extremal.certificate)
    assert extremal.cost == pytest.approx(cost, rel=1e-7)
    assert extremal.certificate.hamiltonian_drift <= 1e-8
    assert extremal.n_evaluations > 0
    assert extremal.history


@pytest.mark.parametrize("method", ["leapfrog", "collocation"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_published_problems_are_solved_without_a_polish(name, method):
    problem, cost, _ = PROBLEMS[name]
    extremal = solve(problem, method=method, polish=False)
    assert extremal.success, (extremal.status, extremal.certificate)
    assert extremal.cost == pytest.approx(cost, rel=1e-7)
    assert all(row.phase != "newton" for row in extremal.history)


@pytest.mark.parametrize("entry", KNOWN)
def test_known_problems_are_solved_from_nothing(entry):
    extremal = solve(entry.problem, method=entry.method)
    assert extremal.success, (extremal.status, extremal.certificate)
    if entry.problem.has_hard_limits:
        # The path is feasible, so it costs at least as much; too much by at most the barrier, see docs/theory.md.
        assert 0 <= (extremal.cost - entry.value) / abs(entry.value) <= extremal.barrier <= BARRIER_TOLERANCE
    else:
        assert extremal.cost == pytest.approx(entry.value, rel=1e-7)


@pytest.mark.parametrize("entry", KNOWN_TIMES)
def test_known_minimum_times_are_found(entry):
    found = minimum_time(entry.problem)
    assert found.extremal.success and found.extremal.barrier <= BARRIER_TOLERANCE
    assert 0 <= found.horizon / entry.value - 1 <= 1e-5 + found.extremal.barrier


@pytest.mark.parametrize("method", METHODS)
def test_an_abnormal_extremal_has_one_status(method):
    """The straight line is a minimiser, but no change of the costate moves the end in z (R. Montgomery, 1994)."""
    martinet = ControlAffineSystem(state=(x, y, z), drift=(0, 0, 0), fields=((1, 0, y**2 / 2), (0, 1, 0)))
    line = solve(OptimalControlProblem(martinet, (0, 0, 0), (1, 0, 0), 1.0, (1, 1)), method)
    assert line.status is Status.SINGULAR
    assert line.cost == pytest.approx(0.5, rel=1e-9)
    assert line.certificate.defect < 1e-8 and line.certificate.controllability < 1e-9
    other = solve(OptimalControlProblem(martinet, (0, 0, 0), (1, 0, 0.1), 1.0, (1, 1)), method)
    assert other.success and other.certificate.controllability > 0.01


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", BY_HAND)
def test_problems_solved_by_hand(name, method):
    problem, cost = BY_HAND[name]
    extremal = solve(problem, method=method)
    assert extremal.success, (extremal.status, extremal.certificate)
    assert extremal.cost == pytest.approx(cost, rel=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_controls_that_saturate_do_so_to_the_last_digit(method):
    problem, _ = BY_HAND["bounded"]
    controls = solve(problem, method=method).controls
    assert np.abs(controls).max() == 5.0
    assert np.mean(np.abs(controls) == 5.0) > 0.1


@pytest.mark.parametrize("method", ["multiple_shooting", "leapfrog", "collocation"])
def test_a_horizon_too_long_for_single_shooting(method):
    # Single shooting would need the costate to a precision of e^-T.
    costs = []
    for horizon in (10.0, 25.0, 100.0):
        extremal = solve(hyper_sensitive(horizon), method=method)
        assert extremal.success, extremal.status
        costs.append(extremal.cost)
    assert costs[2] == pytest.approx(costs[1], rel=1e-8)  # the extremal is at rest except at the ends
    assert not solve(hyper_sensitive(100.0), method="single_shooting").success


def test_multiple_shooting_divides_segments_that_need_it():
    problem = hyper_sensitive(1000.0)
    extremal = solve(problem, method="multiple_shooting")
    assert extremal.success
    assert extremal.history[-1].segments > extremal.history[0].segments
    assert solve(problem, method="multiple_shooting", segments=64).status is Status.DIVERGED


@pytest.mark.parametrize("method", METHODS)
def test_an_angle_is_reached_by_its_cheapest_winding(method):
    # The pendulum swings up on either side; a goal a turn too high is the same goal.
    costs = [
        solve(OptimalControlProblem(PENDULUM, (0.3, 0), (goal, 0), 5.0, (1.0,)), method=method).cost
        for goal in (math.pi, -math.pi, 5 * math.pi)
    ]
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-8)
    plain = ControlAffineSystem(state=(x, v), drift=(v, -sp.sin(x)), fields=((0, 1),))
    sides = [solve(OptimalControlProblem(plain, (0.3, 0), (goal, 0), 5.0, (1.0,))).cost for goal in (math.pi, -math.pi)]
    assert costs[0] == pytest.approx(min(sides), rel=1e-8)
    assert abs(sides[0] - sides[1]) > 1e-3


def test_initial_paths_that_cost_more_than_the_best_extremal_are_not_solved(monkeypatch):
    solver, calls = METHODS["multiple_shooting"], []
    monkeypatch.setitem(METHODS, "multiple_shooting", lambda *given: calls.append(given) or solver(*given))
    # The other windings cost at least four times as much.
    problem = OptimalControlProblem(PENDULUM, (0, 0), (math.pi / 2, 0), 1.0, (1.0,))
    assert solve(problem, "multiple_shooting").success
    assert len(calls) == 1


def test_the_robot_with_other_controls_or_with_inertia():
    # Speeds of the wheels are a linear change of the unicycle's controls: (left^2 + right^2) / 2 = v^2 + (track omega /
    # 2)^2, so with these weights it is the same problem.
    track = 0.4
    scenario = SCENARIOS["clutter-5"][0]
    wheels = OptimalControlProblem(
        differential_drive(),
        scenario.start,
        scenario.goal,
        scenario.horizon,
        (1.0, 1.0),
        field=scenario.field,
        parameters=(track,),
    )
    unicycle_problem = OptimalControlProblem(
        OptimalControlProblem.from_scenario(scenario).system,
        scenario.start,
        scenario.goal,
        scenario.horizon,
        (2.0, track**2 / 2),
        field=scenario.field,
    )
    optimum = find_optimum(scenario)
    guess = Trajectory(optimum.times, optimum.states)
    same = solve(unicycle_problem, method="multiple_shooting", guess=guess)
    assert same.success
    found = solve(wheels, method="multiple_shooting", guess=guess)
    assert found.success
    assert found.cost == pytest.approx(same.cost, rel=1e-9)
    speed = found.controls.mean(axis=1)
    assert np.interp(same.times, found.times, speed) == pytest.approx(same.controls[:, 0], abs=0.05)

    times = np.linspace(0.0, scenario.horizon, 100)
    states, controls, _ = optimum.evaluate(times)
    heavy = OptimalControlProblem(
        unicycle_with_inertia(),
        (*scenario.start, 0.0, 0.0),
        (*scenario.goal, 0.0, 0.0),
        scenario.horizon,
        (1.0, 1.0),
        field=scenario.field,
    )
    found = solve(heavy, method="multiple_shooting", guess=Trajectory(times, np.hstack([states, controls])))
    assert found.success
    assert found.states[-1, 3:] == pytest.approx((0.0, 0.0), abs=1e-8)
    assert found.certificate.clearance > 0


def test_a_parameter_is_a_number_of_the_problem():
    gravity = sp.Symbol("g")
    system = ControlAffineSystem(state=(x, v), drift=(v, -gravity * sp.sin(x)), fields=((0, 1),), parameters=(gravity,))
    fixed = ControlAffineSystem(state=(x, v), drift=(v, -2 * sp.sin(x)), fields=((0, 1),))
    costs = [
        solve(OptimalControlProblem(system, (0, 0), (2, 0), 3.0, (1.0,), gravity * x**2 / 9, parameters=(2.0,))).cost,
        solve(OptimalControlProblem(fixed, (0, 0), (2, 0), 3.0, (1.0,), 2 * x**2 / 9)).cost,
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-10)
    with pytest.raises(ValueError, match="parameters: expected 1 numbers, got 0"):
        OptimalControlProblem(system, (0, 0), (2, 0), 3.0, (1.0,))


def unreachable():
    return OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 0), (10, 0), 1.0, (1.0,), control_bounds=((-1, 1),))


def uncontrollable():
    system = ControlAffineSystem(state=(x, v), drift=(0, 0), fields=((1, 0),))
    return OptimalControlProblem(system, (0, 0), (1, 1), 1.0, (1.0,))


def hyper_sensitive(horizon):
    # A. V. Rao and K. D. Mease, Optim. Control Appl. Meth. 20 (1999).
    system = ControlAffineSystem(state=(x,), drift=(-(x**3),), fields=((1,),))
    return OptimalControlProblem(system, (1.5,), (1.0,), horizon, (1.0,), state_cost=x**2 / 2)


def oscillator(horizon=None):
    """Back to the start with a free horizon: J has minima close to multiples of the period, and maxima in between."""
    system = ControlAffineSystem(state=(x, y), drift=(y, -x), fields=((0, 1),))
    return OptimalControlProblem(system, (1, 0), (1, 0), horizon, (1.0,), time_weight=0.02)


def past_a_conjugate_point():
    # x = 0 minimises the integral of (u^2 - x^2) / 2 from 0 to 0 only up to T = pi.
    system = ControlAffineSystem(state=(x,), drift=(0,), fields=((1,),))
    return OptimalControlProblem(system, (0,), (0,), 4.0, (1.0,), state_cost=-(x**2) / 2)


def blocked():
    walls = [{"polygon": {"vertices": [[5, y], [5.5, y], [5.5, y + 5.0], [5, y + 5.0]]}} for y in (0.0, 5.0)]
    fields = SCENARIOS["clutter-0"][0].to_dict()
    return Scenario.from_dict({**fields, "obstacles": walls, "start": [2, 5, 0.0], "goal": [8, 5, 0.0]})


def in_the_way():
    # A thin disc on the straight path, from which Newton's method does not move out of it.
    fields = SCENARIOS["clutter-0"][0].to_dict()
    fields["cost"]["proximity_weight"] = 1e-3
    disc = [{"circle": {"center": [5, 5], "radius": 0.02}}]
    fields |= {"obstacles": disc, "start": [2, 5, 0.0], "goal": [8, 5, 0.0], "horizon": 6.0}
    return Scenario.from_dict(fields)


def straight(problem):
    return OptimalControlProblem.from_scenario(problem).straight_line()


AT_GOAL = {"goal": [1, 1, 2 * math.pi], "horizon": None, "cost": {"time_weight": 0.5}}  # of scenario_fields
VAN_DER_POL = PROBLEMS["van-der-pol-free-end"][0]
# A solve that ends with each status; only find_optimum returns HORIZON_TOO_SHORT, see test_optimum; for
# BEYOND_LIMITS see test_state_bounds.
FAILURES = {
    Status.NO_PATH: lambda: solve(blocked()),
    Status.ZERO_HORIZON: lambda: solve(Scenario.from_dict(scenario_fields(**AT_GOAL))),
    Status.STALLED: lambda: solve(unreachable(), method="multiple_shooting"),
    Status.DIVERGED: lambda: solve(hyper_sensitive(100.0), method="single_shooting"),
    Status.SINGULAR: lambda: solve(uncontrollable(), method="multiple_shooting"),
    Status.MAX_ITERATIONS: lambda: solve(VAN_DER_POL, method="multiple_shooting", max_iterations=1),
    Status.NOT_CERTIFIED: lambda: solve(VAN_DER_POL, method="multiple_shooting", tol=1e-2),
    Status.COLLISION: lambda: solve(in_the_way(), method="multiple_shooting", guess=straight(in_the_way())),
    Status.CONJUGATE_POINT: lambda: solve(past_a_conjugate_point(), method="multiple_shooting"),
    Status.TIME_NOT_MINIMAL: lambda: solve(oscillator(), guess=solve(oscillator(2.6)), method="multiple_shooting"),
    Status.SUBPROBLEM: lambda: solve(unreachable(), method="leapfrog"),
}


def test_every_status_is_provoked():
    assert set(FAILURES) == set(Status) - {Status.SUCCESS, Status.HORIZON_TOO_SHORT, Status.BEYOND_LIMITS}


@pytest.mark.parametrize("status", FAILURES, ids=lambda status: status.name)
def test_a_failure_says_what_to_try_next(status):
    extremal = FAILURES[status]()
    assert extremal.status is status
    assert not extremal.success
    assert any(word in status.value for word in ("Try", "Check", "Move"))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("problem", [unreachable, uncontrollable, past_a_conjugate_point])
def test_what_has_no_solution_is_no_success(problem, method):
    assert not solve(problem(), method=method).success


def test_a_failure_is_raised_on_request_with_the_failed_result():
    with pytest.raises(SolveError, match=r"STALLED: .*Try") as caught:
        solve(unreachable(), method="multiple_shooting", raise_on_failure=True)
    assert caught.value.extremal.status is Status.STALLED
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(SolveError, match="clutter-0: NO_PATH"):
        solve(blocked(), raise_on_failure=True)
    assert solve(VAN_DER_POL, raise_on_failure=True).success


def test_half_of_a_cost_that_is_not_positive_moves_no_node():
    system = ControlAffineSystem(state=(x,), drift=(0,), fields=((1,),))
    problem = OptimalControlProblem(system, (1,), (1,), 2.0, (1.0,), state_cost=-(x**2) / 2)
    for polish in (True, False):
        extremal = solve(problem, method="leapfrog", update="half_cost", polish=polish)
        assert extremal.success
        assert extremal.cost == pytest.approx(-math.tan(1.0), rel=1e-8)


def test_a_tighter_tolerance_gives_a_smaller_residual():
    # H drifts because of the defects at the nodes.
    drifts = [
        solve(PROBLEMS["se2-side-step"][0], method="multiple_shooting", tol=tol).certificate.hamiltonian_drift
        for tol in (1e-6, 1e-11)
    ]
    assert drifts[1] < 1e-9
    assert drifts[1] <= drifts[0]


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "newton"}, "method: expected one of .*'newton'"),
        ({"tol": 0.0}, "tol: .*0.0"),
        ({"max_iterations": 0}, "max_iterations: .*0"),
        ({"segments": 0}, "segments: .*0"),
        ({"guess": Trajectory(np.array([0.0]), np.zeros((1, 3)))}, "guess: its times"),
        (
            {"guess": Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)))},
            "guess: its times must run from 0 to 5.4, not 0 to 1",
        ),
        ({"guess": Trajectory(np.array([0.0, 5.4]), np.zeros((2, 2)))}, "guess.states: expected the shape \\(2, 3\\)"),
        (
            {"guess": Trajectory(np.array([0.0, 5.4]), np.full((2, 3), np.nan))},
            "guess.states: expected finite numbers, got nan",
        ),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(SCENARIOS["clutter-0"][0], **arguments)


def test_a_diverging_collocation_is_reported_and_nothing_is_printed_below(capfd):
    """SuperLU overflows for the Jacobians of a diverging iteration, and the BLAS then prints to standard output."""
    theta, phi = sp.symbols("theta phi")
    car = ControlAffineSystem(
        state=(x, y, theta, phi),
        drift=(0, 0, 0, 0),
        fields=((sp.cos(theta), sp.sin(theta), 2 * sp.tan(phi), 0), (0, 0, 0, 1)),
        position=(x, y),
    )
    goal = (5.433850416929541, 7.6235428761024515, -1.4032183662462445, 0)
    problem = OptimalControlProblem(car, (0, 0, 0, 0), goal, 0.5, (1, 0.3))
    extremal = solve(problem, "collocation", guess=problem.straight_line())
    assert extremal.status is Status.DIVERGED
    assert "On entry to" not in "".join(capfd.readouterr())
