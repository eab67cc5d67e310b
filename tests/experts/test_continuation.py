import math

import numpy as np
import pytest
import sympy as sp
from helpers import best_known, published_problems

from leapnav.envs import Scenario
from leapnav.experts import (
    ControlAffineSystem,
    OptimalControlProblem,
    SolveError,
    continuation,
    find_optimum,
    solve,
)
from leapnav.experts.continuation import blend
from leapnav.experts.solve import METHODS

SCENARIO = {s.name: s for s, _ in best_known()}["clutter-5"]


def changed(shift, goal=0.0, horizon=1.0):
    fields = SCENARIO.to_dict()
    fields["obstacles"][0]["circle"]["center"][0] += shift
    fields["goal"][0] += goal
    fields["horizon"] *= horizon
    return Scenario.from_dict(fields)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "single_shooting"])
@pytest.mark.parametrize("change", [(0.2, 0.0, 1.0), (0.0, 0.2, 1.0), (0.0, 0.0, 0.8), (0.1, -0.1, 1.1)])
def test_a_warm_start_finds_the_moved_extremal(change, method):
    reference = find_optimum(SCENARIO)
    cold = find_optimum(changed(*change))
    warm = solve(changed(*change), method=method, guess=reference)
    assert warm.success
    assert warm.cost == pytest.approx(cold.cost, rel=1e-8)


def test_a_sequence_follows_one_extremal():
    shifts = np.linspace(0.0, 1.2, 7)
    found = continuation([changed(s, goal=s / 3, horizon=1 - s / 4) for s in shifts], guess=find_optimum(SCENARIO))
    assert len(found) == 7
    assert all(extremal.success for extremal in found)
    costs = [extremal.cost for extremal in found]
    assert np.all(np.diff(costs) > 0)
    at_once = continuation([changed(0.0), changed(1.2, goal=0.4, horizon=0.7)])
    assert at_once[1].cost == pytest.approx(costs[-1], rel=1e-9)


def pendulum(horizon, bound=None, weight=1.0):
    x, v, gravity = sp.symbols("x v g")
    system = ControlAffineSystem(state=(x, v), drift=(v, -gravity * sp.sin(x)), fields=((0, 1),), parameters=(gravity,))
    bounds = None if bound is None else ((-bound, bound),)
    return OptimalControlProblem(
        system, (0, 0), (math.pi, 0), horizon, (weight,), control_bounds=bounds, parameters=(1.0,)
    )


@pytest.mark.parametrize("method", ["single_shooting", "multiple_shooting"])
def test_step_control_reaches_what_one_step_does_not(method):
    # With four times the horizon, a direct swing-up becomes one with preliminary swings.
    first, last = pendulum(2.0), pendulum(8.0)
    start = solve(first, method=method)
    assert start.success
    assert not solve(last, method=method, guess=start).success
    found = continuation([first, last], method=method, guess=start)
    assert [extremal.success for extremal in found] == [True, True]
    assert found[-1].problem.horizon == 8.0


def test_control_bounds_are_tightened_step_by_step():
    found = continuation([pendulum(5.0, bound) for bound in (5.0, 1.0, 0.95, 0.9)])
    assert all(extremal.success for extremal in found)
    assert np.all(np.diff([extremal.cost for extremal in found]) >= 0)
    assert np.abs(found[-1].controls).max() == 0.9


def test_a_sequence_ends_with_its_first_failure():
    problems = [pendulum(2.0, bound=20.0), pendulum(2.0, bound=0.1), pendulum(3.0, bound=20.0)]
    found = continuation(problems)
    assert [extremal.success for extremal in found] == [True, False]
    with pytest.raises(SolveError, match="problem 1: "):
        continuation(problems, raise_on_failure=True)


def test_problems_that_cannot_be_blended_are_named():
    problem = pendulum(2.0)
    with pytest.raises(ValueError, match="differ in their system"):
        continuation([problem, published_problems()["grushin"][0]])
    with pytest.raises(ValueError, match="only one of two successive problems has control bounds"):
        continuation([problem, pendulum(2.0, bound=1.0)])
    fewer = SCENARIO.model_copy(update={"obstacles": SCENARIO.obstacles[1:]})
    with pytest.raises(ValueError, match="the same kinds of obstacles"):
        continuation([SCENARIO, fewer.model_copy(update={"horizon": 0.5})])
    with pytest.raises(ValueError, match=r"smallest_step: .*0"):
        continuation([problem], smallest_step=0.0)


def test_a_blend_lies_between():
    first = OptimalControlProblem.from_scenario(changed(0.0))
    second = OptimalControlProblem.from_scenario(changed(0.4, goal=0.2, horizon=0.5))
    middle = blend(first, second, 0.5)
    expected = OptimalControlProblem.from_scenario(changed(0.2, goal=0.1, horizon=0.75))
    assert middle.horizon == pytest.approx(expected.horizon)
    assert middle.goal == pytest.approx(expected.goal)
    assert middle.field == pytest.approx(expected.field)


def test_start_headings_are_equivalent_modulo_2_pi():
    turned = SCENARIO.model_copy(update={"start": (*SCENARIO.start[:2], SCENARIO.start[2] + 2 * math.pi)})
    reference = find_optimum(SCENARIO)
    found = continuation([SCENARIO, turned], guess=reference)
    assert [extremal.success for extremal in found] == [True, True]
    assert found[1].cost == pytest.approx(reference.cost, rel=1e-9)


def test_a_failure_is_that_of_the_target_problem():
    found = continuation([pendulum(2.0, bound=20.0), pendulum(2.0, bound=0.1)])
    assert found[1].problem.control_bounds == ((-0.1, 0.1),)
