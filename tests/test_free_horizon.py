"""Problems with a free horizon: closed forms, consistency with the fixed horizon, certificate, errors."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import brentq, minimize_scalar

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, Trajectory, continuation, solve
from leapnav.experts.problem.system import unicycle
from leapnav.experts.solve import METHODS

TIME_WEIGHT, SPEED_WEIGHT, TURN_WEIGHT = 0.5, 1.0, 0.3
X, V = sp.symbols("x v")
DOUBLE_INTEGRATOR = ControlAffineSystem((X, V), (V, 0), ((0, 1),))
GRUSHIN = ControlAffineSystem((X, V), (0, 0), ((1, 0), (0, X)))


def drive(goal, horizon=None, **changes):
    weights = (SPEED_WEIGHT, TURN_WEIGHT)
    return OptimalControlProblem(unicycle(), (0, 0, 0), goal, horizon, weights, time_weight=TIME_WEIGHT, **changes)


def of_distance(distance):
    """Cost and horizon of a geodesic: the kinetic energy equals the time weight all the way."""
    return distance * math.sqrt(2 * TIME_WEIGHT), distance / math.sqrt(2 * TIME_WEIGHT)


def rest_to_rest(distance=2.0, weight=0.7):
    """J = 6 r d^2 / T^3 + c T is minimal at T^4 = 18 r d^2 / c."""
    problem = OptimalControlProblem(DOUBLE_INTEGRATOR, (0, 0), (distance, 0), None, (weight,), time_weight=TIME_WEIGHT)
    horizon = (18 * weight * distance**2 / TIME_WEIGHT) ** 0.25
    return problem, 6 * weight * distance**2 / horizon**3 + TIME_WEIGHT * horizon, horizon


def grushin(x=0.8, y=0.3):
    """Geodesics of unit speed from the origin: x = sin(k s) / k, y = (s / 2 - sin(2 k s) / (4 k)) / k."""
    problem = OptimalControlProblem(GRUSHIN, (0, 0), (x, y), None, (1, 1), time_weight=TIME_WEIGHT)

    def miss(angle):  # k s, on the branch before the first conjugate point
        k = math.sin(angle) / x
        return (angle / (2 * k) - math.sin(2 * angle) / (4 * k)) / k - y

    angle = brentq(miss, 1e-3, math.pi - 1e-3, xtol=1e-15)
    return problem, *of_distance(angle * x / math.sin(angle))


CLOSED_FORMS = {
    "straight line": lambda: (drive((3, 0, 0)), *of_distance(3 * math.sqrt(SPEED_WEIGHT))),
    "rotation": lambda: (drive((0, 0, 1.2)), *of_distance(1.2 * math.sqrt(TURN_WEIGHT))),
    "double integrator": rest_to_rest,
    "Grushin": grushin,
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_cost_and_horizon_are_those_of_the_closed_form(name, method):
    problem, cost, horizon = CLOSED_FORMS[name]()
    extremal = solve(problem, method)
    assert extremal.success
    assert extremal.cost == pytest.approx(cost, rel=1e-10)
    assert extremal.horizon == pytest.approx(horizon, rel=1e-8)
    assert np.abs(extremal.hamiltonian).max() < 1e-8
    assert extremal.certificate.time_curvature > 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("goal", [(0, 2, 0), (1.5, -1, 2), (-1, 0.5, 0.5), (2, 1, None)])
def test_a_geodesic_costs_its_length(goal, method):
    # Without obstacles the optimum in a fixed time T costs d^2 / (2 T) + c T, with the distance d.
    fixed = solve(drive(goal, 2.0))
    distance = math.sqrt(2 * 2.0 * (fixed.cost - 2.0 * TIME_WEIGHT))
    cost, horizon = of_distance(distance)
    extremal = solve(drive(goal), method)
    assert extremal.success
    assert extremal.cost == pytest.approx(cost, rel=1e-8)
    assert extremal.horizon == pytest.approx(horizon, rel=1e-7)


def swing_up():
    """A pendulum with a state cost; the optimum over T of the fixed horizon is not known in closed form."""
    pendulum = ControlAffineSystem((X, V), (V, -sp.sin(X)), ((0, 1),), angles=(X,))
    state_cost = 0.1 * (1 + sp.cos(X)) + 0.05 * V**2
    return OptimalControlProblem(
        pendulum, (0, 0), (math.pi, 0), None, (1.0,), state_cost, ((-2.0, 2.0),), time_weight=0.1
    )


@pytest.mark.parametrize("problem", [swing_up(), drive((2, 1.5, 1), control_bounds=((-0.8, 0.8), (-1.0, 1.0)))])
def test_the_horizon_minimises_the_cost_of_the_fixed_horizon(problem):
    extremal = solve(problem, "multiple_shooting")
    assert extremal.success

    def fixed(horizon):
        return solve(replace(problem, horizon=horizon), "multiple_shooting", guess=extremal)

    found = minimize_scalar(
        lambda horizon: fixed(horizon).cost,
        bounds=(0.9 * extremal.horizon, 1.1 * extremal.horizon),
        method="bounded",
        options={"xatol": 1e-6},
    )
    assert extremal.cost == pytest.approx(found.fun, rel=1e-9)
    assert extremal.horizon == pytest.approx(found.x, rel=1e-4)
    step = 1e-3 * extremal.horizon
    shorter, same, longer = (fixed(extremal.horizon + change) for change in (-step, 0.0, step))
    # dJ/dT = H, and the derivative of that is the curvature of the certificate.
    assert (longer.cost - shorter.cost) / (2 * step) == pytest.approx(same.hamiltonian.mean(), abs=1e-4)
    slopes = [e.hamiltonian.mean() for e in (shorter, longer)]
    assert (slopes[1] - slopes[0]) / (2 * step) == pytest.approx(extremal.certificate.time_curvature, rel=1e-3)


def test_leapfrog_stays_feasible_and_its_cost_never_increases():
    problem = drive((1, 2, 1))
    extremal = solve(
        problem,
        "leapfrog",
        guess=Trajectory(np.linspace(0, 9, 17), drive((1, 2, 1)).straight_line(17).states),
        polish=False,
    )
    assert extremal.success
    sweeps = [row for row in extremal.history if row.phase in ("sweep", "reduce")]
    assert len(sweeps) > 3
    costs = [row.cost for row in sweeps]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(costs))
    assert all(row.residual < 1e-8 for row in sweeps)
    assert sweeps[0].times[-1] != pytest.approx(extremal.horizon, rel=1e-3)  # the times were scaled


def test_continuation_follows_a_free_horizon():
    problems = [replace(drive((2, 1, 1)), time_weight=weight) for weight in (0.5, 2.0, 8.0)]
    extremals = continuation(problems)
    assert [extremal.success for extremal in extremals] == [True] * 3
    # T = d / sqrt(2 c): four times the weight halves the horizon.
    assert extremals[1].horizon == pytest.approx(extremals[0].horizon / 2, rel=1e-8)
    assert extremals[2].horizon == pytest.approx(extremals[1].horizon / 2, rel=1e-8)
    with pytest.raises(ValueError, match="free horizon"):
        continuation([problems[0], drive((2, 1, 1), 3.0)])


def test_a_time_weight_adds_a_constant_to_the_cost_of_a_fixed_horizon():
    weighted = solve(drive((2, 1, 1), 3.0))
    plain = solve(replace(drive((2, 1, 1), 3.0), time_weight=0.0))
    assert weighted.cost == pytest.approx(plain.cost + 3.0 * TIME_WEIGHT, rel=1e-12)
    assert weighted.horizon == 3.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_weight": 0.0}, "time_weight: expected a positive number with a free horizon, got 0"),
        ({"time_weight": -1.0}, "time_weight: expected a number of at least 0, got -1.0"),
        ({"horizon": math.nan}, "horizon: expected a positive number, or None for a free horizon, got nan"),
    ],
)
def test_invalid_values_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(drive((1, 0, 0)), **changes)
