import numpy as np
import pytest
from helpers import ROBOTS, best_known, scenario_fields

from leapnav.envs import Scenario
from leapnav.experts import OptimalControlProblem, Trajectory, find_optimum
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.path_class import SeenPaths, shape_of
from leapnav.experts.transcription.direct import DirectPath, discretise, optimise

BEST_KNOWN = best_known()


def first_candidate(scenario):
    candidate = next(CandidateSearch(Lattice(scenario)).candidates())
    path = Trajectory(candidate.times, candidate.poses)
    return OptimalControlProblem.from_scenario(scenario).with_winding_of(path.states), path


def test_paths_are_interpolated_as_by_numpy():
    rng = np.random.default_rng(0)
    for _ in range(50):
        times, rows = np.cumsum(rng.uniform(0.01, 1.0, 20)), rng.normal(size=(20, 3))
        at = np.concatenate([rng.uniform(-1.0, times[-1] + 1.0, 30), times, times[-1:]])
        expected = np.stack([np.interp(at, times, column) for column in rows.T], axis=1)
        path = Trajectory(times, rows, np.asfortranarray(-rows)).resample(at)
        assert (path.states == expected).all()
        assert (path.costates == -expected).all()


@pytest.mark.parametrize("scenario", [s for s, _ in BEST_KNOWN[::6]], ids=lambda s: s.name)
def test_it_converges_to_the_extremal_with_order_two(scenario):
    optimum = find_optimum(scenario)
    path = Trajectory(
        np.linspace(0.0, scenario.horizon, 65), optimum.evaluate(np.linspace(0.0, scenario.horizon, 65))[0]
    )
    direct = optimise(optimum.problem, discretise(optimum.problem, path))
    errors = []
    for _ in range(4):
        assert direct.converged
        assert direct.violation < 1e-4
        errors.append(abs(direct.cost - optimum.cost))
        direct = optimise(optimum.problem, direct.refined())
    assert errors[-1] < 1e-4 * optimum.cost
    assert errors[1] / errors[3] > 10  # 16 with each interval a quarter as long
    states, _, costates = optimum.evaluate(direct.times)
    assert np.abs(direct.states - states).max() < 1e-2
    # The multipliers are the costates.
    assert np.abs(direct.costates - costates).max() < 0.02 * np.abs(costates).max()


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_step_of_the_path_is_one_of_the_midpoint_rule_and_ends_at_the_goal(robot):
    optimum = find_optimum(Scenario.from_dict({**BEST_KNOWN[0][0].to_dict(), "robot": {"model": robot}}))
    problem, times = optimum.problem, np.linspace(0.0, optimum.horizon, 65)
    direct = optimise(problem, discretise(problem, Trajectory(times, optimum.evaluate(times)[0])))
    assert direct.converged
    assert direct.states[0] == pytest.approx(problem.start)
    fixed = ~problem.arrays.free
    assert direct.states[-1, fixed] == pytest.approx(problem.arrays.goal[fixed], abs=1e-5)
    steps, q, u = np.diff(direct.times)[:, None], direct.states[:-1], direct.controls
    drift, fields = problem.dynamics(q)
    middle = q + 0.5 * steps * (drift + np.einsum("kij,kj->ki", fields, u))
    drift, fields = problem.dynamics(middle)
    assert q + steps * (drift + np.einsum("kij,kj->ki", fields, u)) == pytest.approx(direct.states[1:], abs=1e-4)


def test_controls_stay_within_the_robot_s_limits():
    fields = scenario_fields(obstacles=[], start=[1, 1, 0.0], goal=[8.0, 1.0, 0.0], horizon=5.5)
    fields["robot"] |= {"max_speed": 1.3, "max_turn_rate": 0.8}
    fields["goal"] = [6.0, 4.0, 2.0]
    scenario = Scenario.from_dict(fields)
    problem, path = first_candidate(scenario)
    direct = optimise(problem, discretise(problem, path))
    assert direct.converged
    assert np.abs(direct.controls[:, 0]).max() == pytest.approx(1.3)
    assert np.abs(direct.controls[:, 1]).max() <= 0.8
    assert direct.violation < 1e-4


def test_a_free_goal_heading_has_no_costate_at_the_end():
    fields = scenario_fields(goal=[8.0, 8.0, None])
    del fields["goal"][2]
    scenario = Scenario.from_dict({**fields, "goal": [8.0, 8.0, None]})
    problem, path = first_candidate(scenario)
    direct = optimise(problem, discretise(problem, path))
    assert direct.converged
    assert direct.costates[-1, 2] == pytest.approx(0.0, abs=1e-6)


def test_weights_in_other_units_change_the_cost_and_not_the_path():
    def refined(fields):
        problem, path = first_candidate(Scenario.from_dict(fields))
        return optimise(problem, optimise(problem, discretise(problem, path)).refined())

    fields = scenario_fields()
    one = refined(fields)
    fields["cost"] = {name: value * (1 if name == "proximity_scale" else 100) for name, value in fields["cost"].items()}
    other = refined(fields)
    assert other.cost == pytest.approx(100 * one.cost, rel=1e-9)
    assert other.states == pytest.approx(one.states, abs=1e-6)
    assert other.costates == pytest.approx(100 * one.costates, abs=1e-3)


def test_an_infeasible_problem_does_not_converge():
    """Three metres in a second at two metres a second."""
    fields = scenario_fields(obstacles=[], start=[2.0, 5.0, 0.0], goal=[5.0, 5.0, 0.0], horizon=1.0)
    problem = OptimalControlProblem.from_scenario(Scenario.from_dict(fields))
    times, states = np.linspace(0.0, 1.0, 33), np.linspace(problem.start, problem.goal, 33)
    controls = np.full((32, 2), [2.0, 0.0])
    guess = DirectPath(times, states, controls, np.zeros((33, 3)), np.inf, np.inf, False)
    direct = optimise(problem, guess)
    assert not direct.converged or direct.violation > 0.5


def test_the_descent_ends_close_to_a_known_path_and_nowhere_else():
    problem, path = first_candidate(BEST_KNOWN[0][0])
    guess, seen, other = discretise(problem, path), SeenPaths(0.15), SeenPaths(0.15)
    full = optimise(problem, guess)
    shape = shape_of(full.times, full.states)
    seen.add(shape + 0.3, shape)
    elsewhere = shape.copy()
    elsewhere[40, 2] += 0.3
    other.add(elsewhere)
    stopped = optimise(problem, guess, known=seen.known)
    assert full.converged and not full.known
    assert stopped.known and not stopped.converged
    assert seen.contain(shape_of(stopped.times, stopped.states))
    assert (stopped.states != full.states).any()
    continued = optimise(problem, guess, known=other.known)
    assert continued.converged and not continued.known
    assert (continued.states == full.states).all()


@pytest.mark.parametrize("robot", ["car", "dynamic_car", "trailer"])
def test_the_derivatives_of_a_step_are_those_of_finite_differences(robot):
    fields = {**scenario_fields(), "robot": {"model": robot}}
    problem = OptimalControlProblem.from_scenario(Scenario.from_dict(fields))
    functions, data, rng = problem.compiled_dynamics, problem.arrays.data, np.random.default_rng(0)
    n, m, h = problem.system.n, problem.system.m, 0.2
    lam, point = rng.normal(size=n), 0.3 * rng.normal(size=n + m)

    def end(point):
        found = np.empty(n)
        functions.step(point[:n].copy(), point[n:].copy(), h, data, found)
        return found

    def jacobian(point):
        A, B, W = np.empty((n, n)), np.empty((n, m)), np.empty((n + m, n + m))
        functions.step_derivatives(point[:n].copy(), point[n:].copy(), h, lam, data, A, B, W)
        return np.hstack([A, B]), W

    def differences(function):
        return np.stack([(function(point + d) - function(point - d)) / 2e-6 for d in 1e-6 * np.eye(n + m)], axis=-1)

    found, hessian = jacobian(point)
    assert found == pytest.approx(differences(end), abs=1e-8)
    assert hessian == pytest.approx(differences(lambda point: lam @ jacobian(point)[0]), abs=1e-8)
