"""The reaction of every caller of the integrator to a flow that diverges."""

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from helpers import best_known

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, Status, certify, find_optimum, solve
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.acting.tracking import follow, follow_all
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.problem import certificate as certificate_module
from leapnav.experts.problem.conjugate_points import conjugate_time, first_focal_time
from leapnav.experts.problem.frames import DIVERGED, carry_back
from leapnav.experts.problem.problem import Trajectory
from leapnav.experts.solvers.feasible_path import FeasiblePath, dense_path
from leapnav.experts.solvers.newton import segment_growth
from leapnav.experts.solvers.sweeps import ArcPath, _half_cost, measure_defects, sweep

SCENARIO = best_known()[0][0]


def explosive(horizon=1.0):
    """x' = x^2 + u, which reaches infinity in the time 1 / x without a control."""
    x = sp.Symbol("x")
    system = ControlAffineSystem(state=(x,), drift=[x**2], fields=[[1]])
    return OptimalControlProblem(system, [0.1], [0.3], horizon, [1.0])


@pytest.fixture(scope="module")
def problem():
    return explosive()


@pytest.fixture(scope="module")
def extremal(problem):
    found = solve(problem, "multiple_shooting")
    assert found.success
    return found


BLOWN = np.array([[50.0, 0.0], [50.0, 0.0], [0.3, 0.0]])  # nodes whose flow diverges within 0.02 s
TIMES = np.array([0.0, 0.5, 1.0])


def test_the_integrator_reports_success_and_leaves_no_usable_result(problem):
    z, S = np.array([50.0, 0.0]), np.eye(2)
    success, cost, _, _, evaluations = propagate(problem.arrays.flow, z, S, 1.0, 1e-9, 0.0, False)
    assert not success
    assert evaluations > 0
    assert math.isnan(cost) and np.isnan(z).all() and np.isnan(S).all()
    z = np.array([0.1, 0.0])
    success, cost, *_ = propagate(problem.arrays.flow, z, np.eye(2), 1.0, 1e-9, 0.0, False)
    assert success and math.isfinite(cost) and np.isfinite(z).all()


def test_growth_and_defects_are_infinite(problem):
    arrays, growth = problem.arrays, np.empty(2)
    segment_growth(arrays.flow, TIMES, BLOWN, growth)
    assert (growth == np.inf).all()
    states, costates, _ = measure_defects(arrays.flow, ArcPath(TIMES, BLOWN, np.zeros(2)), arrays.end, 1e-10)
    assert states == costates == np.inf


def test_half_of_the_cost_is_not_found(problem):
    z = BLOWN[0].copy()
    success, _, _, evaluations = _half_cost(problem.arrays.flow, z, 0.5, 1.0, 1e-10)
    assert not success and evaluations > 0 and np.isnan(z).all()


@pytest.mark.parametrize("half_cost", [False, True])
def test_a_sweep_keeps_a_node_that_it_cannot_move(problem, extremal, half_cost, monkeypatch):
    """An arc that shooting connects, but whose middle the integrator does not reach at the accuracy asked for."""
    iterate = FeasiblePath(problem, TIMES.copy(), extremal.interpolate(TIMES), 1e-10, 1e-12, half_cost)
    before = iterate.nodes.copy()
    rejected = np.zeros(3, dtype=bool)
    newton = iterate._newton(12)._replace(accuracy=1e-300)  # no step is accepted, so that all integrations fail
    sweep(problem.arrays.flow, iterate._arcs, problem.arrays.end, newton, half_cost, 1, 1, rejected)
    assert rejected[1]
    np.testing.assert_array_equal(iterate.nodes, before)


def test_an_arc_that_diverges_is_not_split(problem, extremal):
    iterate = FeasiblePath(problem, TIMES.copy(), extremal.interpolate(TIMES), 1e-10, 1e-12)
    assert iterate.split() and iterate.segments == 4
    iterate.nodes[:, 0] = 50.0
    nodes = iterate.nodes.copy()
    assert not iterate.split()
    np.testing.assert_array_equal(iterate.nodes, nodes)


def test_a_displayed_path_has_a_gap(problem):
    times, states = dense_path(problem, TIMES, np.array([[0.1, 0.0], [50.0, 0.0], [0.3, 0.0]]), 40)
    assert np.isfinite(states[times <= 0.5]).all()
    assert np.isnan(states[-1]).all()


def test_a_conjugate_point_that_cannot_be_decided_is_no_certificate(problem, extremal, monkeypatch):
    blown = replace(extremal, states=np.full_like(extremal.states, 50.0))
    with pytest.raises(FloatingPointError, match="sensitivities diverge"):
        conjugate_time(replace(blown, times=np.linspace(0.0, 1.0, len(blown.times))), 0, np.eye(2)[:, 1:])
    frames, determinants = np.empty((3, 2, 1)), np.zeros(3)
    frames[0] = [[0.0], [1.0]]
    assert carry_back(problem.arrays.flow, TIMES, BLOWN, frames, determinants) == DIVERGED
    with pytest.raises(FloatingPointError, match="sensitivities diverge"):
        first_focal_time(replace(blown, times=np.linspace(0.0, 1.0, len(blown.times))), np.array([True]))

    def diverges(*_):
        raise FloatingPointError

    monkeypatch.setattr(certificate_module, "first_even_conjugate_time", diverges)
    nodes = np.concatenate([extremal.states, extremal.costates], axis=1)
    found = certify(problem, extremal.times, nodes, Status.SUCCESS)
    assert found.status is Status.NOT_CERTIFIED
    assert math.isnan(found.certificate.conjugate_point)
    assert found.to_dict()["status"] == "NOT_CERTIFIED"


def test_feedback_does_not_act_on_a_solution_that_diverges():
    optimum = find_optimum(SCENARIO)
    feedback = Feedback(SCENARIO, Trajectory(optimum.times, optimum.states, optimum.costates))
    good = feedback._stored
    feedback._stored = good._replace(nodes=np.full_like(good.nodes, 1e15))
    assert np.isnan(follow(good.arrays.flow, *feedback._stored[:2], 0.1)).all()
    assert np.isnan(follow_all(good.arrays.flow, *feedback._stored[:2], np.array([0.1, 0.2]))).all()
    with pytest.raises(FloatingPointError, match=r"diverges before 0\.1 s"):
        feedback.control(0.1)
    with pytest.raises(FloatingPointError, match="diverge"):
        feedback.gains()
    # A new search replaces it.
    assert feedback.update(optimum.evaluate(0.3)[0], 0.3)
    assert feedback.searches == 1
    np.testing.assert_allclose(feedback.control(0.3), optimum.evaluate(0.3)[1], atol=1e-5)
