"""Limits of states: closed forms, derivatives of the barrier, units, errors."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, Status, continuation, plot_extremal, solve
from leapnav.experts.continuation import blend
from leapnav.experts.problem.system import unicycle
from leapnav.experts.solve import METHODS
from leapnav.experts.solvers.initial_paths import first_barrier_weight
from leapnav.experts.transcription.direct import discretise, optimise

INF = math.inf
X, V, A = sp.symbols("x v a")
DOUBLE_INTEGRATOR = ControlAffineSystem((X, V), (V, 0), ((0, 1),))


def bryson_denham(limit, *, length=1.0, duration=1.0, cost=1.0, **changes):
    """From (0, 1) to (0, -1) in time 1 with x <= limit, in other units of length, time and cost."""
    speed, weight = length / duration, cost * duration**3 / length**2
    bounds = (-INF, limit * length), None
    return OptimalControlProblem(
        DOUBLE_INTEGRATOR, (0, speed), (0, -speed), duration, (weight,), state_bounds=bounds, **changes
    )


def bryson_denham_cost(limit):
    """An arc on the limit, a contact, or neither (A. E. Bryson, W. F. Denham, S. E. Dreyfus, 1963)."""
    if limit <= 1 / 6:
        return 4 / (9 * limit)
    return 2 + 6 * (1 - 4 * limit) ** 2 if limit < 1 / 4 else 2.0


def drive_at_most(speed, distance=1.0, horizon=1.0, **changes):
    """From rest to rest, with a lower limit of the speed that is not active."""
    return OptimalControlProblem(
        DOUBLE_INTEGRATOR, (0, 0), (distance, 0), horizon, (1,), state_bounds=(None, (-0.1, speed)), **changes
    )


@pytest.mark.parametrize("limit", [1 / 12, 1 / 9, 1 / 5, 0.3])
@pytest.mark.parametrize("method", METHODS)
def test_bryson_denham(limit, method):
    extremal = solve(bryson_denham(limit), method)
    if method == "single_shooting" and limit == 1 / 12:
        # The barrier amplifies errors too much for shooting over the whole horizon, and the certificate refuses it.
        assert extremal.status is Status.NOT_CERTIFIED
        return
    assert extremal.success
    assert 0 < extremal.barrier <= 1e-3
    # The path is feasible, so it costs no less than the optimum.
    assert 0 <= extremal.cost / bryson_denham_cost(limit) - 1 <= 1e-3
    assert extremal.certificate.state_margin > 0
    assert extremal.evaluate(np.linspace(0, 1, 1001))[0][:, 0].max() < limit


def test_costates_of_bryson_denham_jump_where_the_arc_on_the_limit_begins_and_ends():
    limit = 1 / 9
    extremal = solve(bryson_denham(limit), "multiple_shooting")
    costates = extremal.evaluate([0.1, 0.25, 0.5, 0.75, 0.9])[2][:, 0]
    assert costates == pytest.approx(2 / (9 * limit**2) * np.array([1, 1, 0, -1, -1]), abs=0.1)
    times = np.linspace(0, 1, 2001)
    rates = np.abs(np.gradient(extremal.evaluate(times)[2][:, 0], times))
    assert times[:1001][rates[:1001].argmax()] == pytest.approx(3 * limit, abs=0.02)
    assert times[1000:][rates[1000:].argmax()] == pytest.approx(1 - 3 * limit, abs=0.02)


def test_a_smaller_tolerance_gives_a_smaller_cost():
    costs = [solve(bryson_denham(1 / 9), "multiple_shooting", barrier_tolerance=tol).cost for tol in (1e-2, 1e-3, 2e-4)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == pytest.approx(4.0, rel=2e-4)


def test_limit_of_the_speed():
    """The acceleration decreases linearly to zero, at 3/2 (1 - 1 / v) where the speed is at its limit v."""
    speed = 1.2
    extremal = solve(drive_at_most(speed), "multiple_shooting")
    duration = 1.5 * (1 - 1 / speed)
    exact = 4 * speed**2 / (3 * duration)
    assert extremal.success
    assert 0 <= extremal.cost / exact - 1 <= 1e-3


def test_limit_of_the_speed_with_a_free_horizon():
    """H = 0 gives the first acceleration, and with it the duration until the limit is reached."""
    speed, distance = 1.2, 10.0
    extremal = solve(drive_at_most(speed, distance, None, time_weight=1), "multiple_shooting")
    first = math.sqrt(2)
    ramp = 2 * speed / first
    horizon = 2 * ramp + (distance - 4 / 3 * speed * ramp) / speed
    assert extremal.success
    assert 0 <= extremal.cost / (horizon + first**2 * ramp / 3) - 1 <= 1e-3
    assert extremal.horizon == pytest.approx(horizon, rel=5e-3)


def test_limits_on_both_sides_are_met():
    """From (0, 1) to (0, 1) in time 1: without limits x = t (1 - t) (1 - 2 t), whose extrema are +-sqrt(3) / 18."""
    limit = 0.06
    free = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 1), (0, 1), 1, (1,))
    without, bounded = (
        solve(problem, "multiple_shooting") for problem in (free, replace(free, state_bounds=((-limit, limit), None)))
    )
    assert np.ptp(without.evaluate(np.linspace(0, 1, 2001))[0][:, 0]) == pytest.approx(math.sqrt(3) / 9, rel=1e-5)
    assert bounded.success and bounded.barrier <= 1e-3 and bounded.cost > without.cost
    positions = bounded.evaluate(np.linspace(0, 1, 2001))[0][:, 0]
    assert 0.99 * limit < positions.max() < limit
    assert positions == pytest.approx(-positions[::-1], abs=1e-9)


@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_gradient_and_hessian_of_the_flow_agree_with_finite_differences(weight):
    system = ControlAffineSystem((X, V, A), (V, A * sp.cos(X), 0), ((0, 0, 1),))
    problem = OptimalControlProblem(
        *(system, (0, 0, 0), (1, 0.1, 0), 2, (1.5,)),
        state_cost=X**2 * V,
        state_bounds=((-0.5, 2.0), None, (-INF, 0.7)),
        barrier_weight=weight,
        time_weight=0.3,
    )
    arrays, n = problem.arrays, 3
    rng = np.random.default_rng(0)

    def flow(z, S, arrays=arrays):
        dz, dS = np.empty(2 * n), np.empty(S.shape)
        return arrays.flow.function(z, arrays.data, arrays.field, S, dz, dS), dz, dS

    def state_cost(q):
        gradient, hessian = np.empty(n), np.empty((n, n))
        problem.compiled_dynamics.state_cost(q.copy(), arrays.data, arrays.field, gradient, hessian)
        return gradient, hessian

    for _ in range(20):
        # Also beyond the limits, where the barrier is a polynomial.
        z = np.concatenate([rng.uniform([-0.6, -1, -2], [2.1, 1, 0.8]), rng.normal(size=n)])
        none = np.empty((2 * n, 0))
        value, _, dS = flow(z, np.eye(2 * n))
        without, _, _ = flow(z, none, replace(problem, state_bounds=None).arrays)
        assert value == pytest.approx(without + float(problem.barrier_cost(z[None, :n])[0]))
        gradient, hessian = state_cost(z[:n])
        # The steps are small in units of the distance, also next to a limit.
        step = 1e-5 * min(abs(z[0] + 0.5), abs(z[0] - 2.0), abs(z[2] - 0.7))
        scale = 1 + np.abs(dS).max()
        for i, direction in enumerate(np.eye(2 * n)):
            above, below = z + step * direction, z - step * direction
            (high, up, _), (low, down, _) = flow(above, none), flow(below, none)
            assert dS[:, i] == pytest.approx((up - down) / (2 * step), rel=1e-5, abs=1e-6 * scale)
            if i < n:
                assert gradient[i] == pytest.approx((high - low) / (2 * step), rel=1e-5, abs=1e-5 * (1 + abs(value)))
                column = (state_cost(above[:n])[0] - state_cost(below[:n])[0]) / (2 * step)
                assert hessian[:, i] == pytest.approx(column, rel=1e-5, abs=1e-6 * scale)


@pytest.mark.parametrize("units", [{"length": 10.0}, {"duration": 10.0}, {"cost": 10.0}])
def test_units_do_not_change_the_result(units):
    plain, scaled = bryson_denham(1 / 9), bryson_denham(1 / 9, **units)
    cost, duration, length = (units.get(name, 1.0) for name in ("cost", "duration", "length"))
    assert first_barrier_weight(scaled) == pytest.approx(first_barrier_weight(plain) * cost / duration, rel=1e-6)
    first, second = (solve(problem, "multiple_shooting") for problem in (plain, scaled))
    # Both contain a remaining barrier of up to 1e-3 of the cost, which depends on the weights on the way.
    assert second.cost == pytest.approx(cost * first.cost, rel=5e-4)
    fractions = np.linspace(0, 1, 11)
    assert second.evaluate(duration * fractions)[0][:, 0] == pytest.approx(
        length * first.evaluate(fractions)[0][:, 0], abs=1e-3 * length
    )


def test_infinite_bounds_are_none():
    free = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 1), (0, -1), 1, (1,))
    for bounds in ((None, None), (None, (-INF, INF))):
        problem = replace(free, state_bounds=bounds)
        assert problem.state_bounds == (None, None)
        assert not problem.has_hard_limits
        assert problem.arrays.flow.function is free.arrays.flow.function
        assert problem.arrays.data == pytest.approx(free.arrays.data)
        assert solve(problem, "multiple_shooting").cost == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"state_bounds": ((0, 1),)},
            "state_bounds: expected 2 entries, a pair or None for each state",
        ),
        ({"state_bounds": "no"}, "state_bounds: expected 2 entries, a pair or None for each state, got 'no'"),
        ({"state_bounds": (None, 3)}, r"state_bounds\[1\]: expected a pair \(lowest, highest\) or None, got 3"),
        ({"state_bounds": ((1, 2, 3), None)}, r"state_bounds\[0\]: expected a pair \(lowest, highest\) or None"),
        ({"state_bounds": (("a", 2), None)}, r"state_bounds\[0\]: expected a pair \(lowest, highest\) or None"),
        ({"state_bounds": ((2, 1), None)}, r"state_bounds\[0\]: expected lowest < highest, got \(2\.0, 1\.0\)"),
        ({"state_bounds": ((math.nan, 1), None)}, r"state_bounds\[0\]: expected lowest < highest, got \(nan, 1\.0\)"),
        ({"state_bounds": ((INF, INF), None)}, r"state_bounds\[0\]: expected lowest < highest"),
        (
            {"state_bounds": ((0, 1), None)},
            r"start\[0\]: expected a number between the state bounds 0\.0 and 1\.0, not on them, .* got 0\.0",
        ),
        ({"state_bounds": (None, (-0.5, 2))}, r"goal\[1\]: expected a number between the state bounds -0\.5 and 2\.0"),
        ({"barrier_weight": -1}, "barrier_weight: expected a number of at least 0, got -1"),
    ],
)
def test_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 1), (0, -1), 1, (1,)), **changes)


def test_a_free_component_of_the_goal_has_no_bounds_to_meet():
    problem = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 1), (None, None), 1, (1,), state_bounds=((-INF, 0.5), None))
    extremal = solve(problem, "multiple_shooting")
    # The path without control ends at 1. To stop at 1/2 costs 3/8: the acceleration 3/2 decreases linearly to zero.
    assert extremal.success
    assert 0 <= extremal.cost / (3 / 8) - 1 <= 1e-3


def test_an_extremal_beyond_the_bounds_is_not_certified():
    free = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 1), (0, -1), 1, (1,))
    guess = solve(free, "multiple_shooting")
    assert guess.certificate.state_margin is None
    # So small a weight has no effect, even beyond the limit.
    extremal = solve(bryson_denham(0.2, barrier_weight=1e-20), "multiple_shooting", guess=guess)
    assert extremal.status is Status.BEYOND_LIMITS
    assert extremal.certificate.state_margin == pytest.approx((0.2 - 0.25) / 0.2, rel=1e-4)  # of points along the path


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=pytest.mark.slow) if name == "leapfrog" else name for name in METHODS]
)
def test_bounds_that_cannot_be_met_are_no_success(method):
    assert not solve(drive_at_most(0.9), method).success


def test_problems_and_extremals_with_bounds_are_pickled():
    extremal = solve(bryson_denham(0.2), "multiple_shooting")
    copy = pickle.loads(pickle.dumps(extremal))
    assert copy.problem.state_bounds == extremal.problem.state_bounds == ((-INF, 0.2), None)
    assert copy.problem.state_limits == extremal.problem.state_limits
    assert copy.barrier == extremal.barrier
    states = extremal.states
    assert copy.problem.barrier_cost(states) == pytest.approx(extremal.problem.barrier_cost(states))
    assert "state_bounds=((-inf, 0.2), None)" in repr(copy.problem)


def test_continuation_in_the_bounds():
    weight = first_barrier_weight(bryson_denham(0.2))
    problems = [bryson_denham(limit, barrier_weight=weight) for limit in (0.3, 0.1, 1 / 30)]
    found = continuation(problems, "multiple_shooting")
    assert all(extremal.success for extremal in found)
    assert found[-1].cost == pytest.approx(solve(problems[-1], "multiple_shooting").cost)
    middle = blend(problems[0], replace(problems[1], barrier_weight=0.0), 0.5)
    assert middle.state_bounds is not None and middle.state_bounds[0] == (-INF, pytest.approx(0.2))
    assert middle.barrier_weight == pytest.approx(weight / 2)
    for other in (((-1, INF), None), ((-1, 0.3), None), None):
        with pytest.raises(ValueError, match="differ in which states have finite bounds"):
            blend(problems[0], replace(problems[0], state_bounds=other), 0.5)


def test_bounds_of_an_angle_exclude_other_windings():
    """The goal is the winding that was given, although the one closest to the start is cheaper."""
    heading = sp.Symbol("theta")
    system = ControlAffineSystem((heading, V), (V, 0), ((0, 1),), angles=(heading,))
    goal = 1.5 * math.pi
    free = OptimalControlProblem(system, (0, 0), (goal, 0), 1, (1,))
    assert solve(free, "multiple_shooting").states[-1, 0] == pytest.approx(goal - 2 * math.pi)
    bounded = solve(replace(free, state_bounds=((-1, 5), None)), "multiple_shooting")
    assert bounded.success
    assert bounded.states[-1, 0] == pytest.approx(goal)


def test_direct_transcription_of_a_unicycle_with_bounds_keeps_them():
    """Without bounds, the unicycle would be moved along arcs, whose kernels have no barrier."""
    problem = OptimalControlProblem(
        *(unicycle(), (0, 0, 0), (0, 1, 0), 3, (1, 0.3)),
        state_bounds=((-1, 0.3), (-0.1, 1.1), None),
        barrier_weight=0.03,
    )
    extremal = solve(problem, "multiple_shooting")
    path = extremal.problem.straight_line(65)
    states = extremal.evaluate(path.times)[0]
    found = optimise(extremal.problem, discretise(extremal.problem, replace(path, states=states)))
    assert found.converged
    assert found.cost == pytest.approx(extremal.cost, rel=5e-3)


def test_bounds_are_drawn():
    extremal = solve(bryson_denham(1 / 9), "multiple_shooting")
    states, controls, costates, _ = plot_extremal(extremal).axes
    lines = [line for line in states.lines if np.ptp(line.get_ydata()) == 0]
    assert [line.get_ydata()[0] for line in lines] == [pytest.approx(1 / 9)]
    assert all(np.ptp(line.get_ydata()) > 0 for axes in (controls, costates) for line in axes.lines)
