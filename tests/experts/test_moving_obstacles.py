"""Optima among moving obstacles: before or behind, waiting, certificates, and what is refused."""

import math

import numpy as np
import pytest
from helpers import scenario_fields

from leapnav.envs import NavigateEnv, Scenario, sample_scenario
from leapnav.envs.field.packing import displacements
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS
from leapnav.experts import (
    ExpertPolicy,
    OptimalControlProblem,
    build_bank_of,
    find_optimum,
    lower_bound,
    minimum_length,
    plot_extremal,
    solve,
    verify,
)
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.problem.frames import orthonormalise
from leapnav.experts.problem.problem import Trajectory
from leapnav.experts.search.path_class import path_sides
from leapnav.experts.second_opinion import second_opinion
from leapnav.experts.spacetime.clock import with_clock


def crossing(velocity, **changes):
    """A disc that crosses the way from (1, 5) to (9, 5) where a robot at constant speed would be."""
    horizon = changes.get("horizon", 8.0) or 8.0
    obstacle = {"circle": {"center": [5.0, 5.0 - velocity * horizon / 2], "radius": 0.6}, "velocity": [0.0, velocity]}
    fields = {"start": [1, 5, 0], "goal": [9, 5, 0], "horizon": 8.0, "obstacles": [obstacle], **changes}
    return Scenario.from_dict(scenario_fields(**fields))


def random_crossing(seed):
    rng = np.random.default_rng(seed)
    start, goal = [1.0, rng.uniform(2, 8), rng.uniform(-3, 3)], [9.0, rng.uniform(2, 8), rng.uniform(-3, 3)]
    obstacles = []
    for _ in range(4):
        share, speed, angle = rng.uniform(0.3, 0.7), rng.uniform(0.3, 1.2), rng.uniform(-3, 3)
        velocity = speed * np.array([math.cos(angle), math.sin(angle)])
        at = np.array(start[:2]) + share * np.subtract(goal[:2], start[:2])
        circle = {"center": (at - velocity * 11.0 * share).tolist(), "radius": 0.4}
        obstacles.append({"circle": circle, "velocity": velocity.tolist()})
    return Scenario.from_dict(scenario_fields(start=start, goal=goal, horizon=11.0, obstacles=obstacles))


def clearances(scenario, optimum):
    times = np.linspace(0.0, optimum.horizon, 3001)
    states = optimum.interpolate(times)[:, :2]
    distances = []
    for obstacle in scenario.obstacles:
        centres = obstacle.circle.center + displacements(obstacle.knots, times)
        distances.append(np.hypot(*(states - centres).T) - obstacle.circle.radius - scenario.robot.radius)
    return np.array(distances)


@pytest.mark.parametrize("velocity", [0.3, 0.8, 1.5])
def test_before_and_behind_are_separate_optima(velocity):
    scenario = crossing(velocity)
    optimum = find_optimum(scenario)
    assert optimum.success
    mirrored = optimum.alternatives[0]  # the scene is symmetric in space and time
    assert mirrored.cost == pytest.approx(optimum.cost, rel=1e-8)
    assert {optimum.path_class, mirrored.path_class} == {("left",), ("right",)}
    for extremal in (optimum, mirrored):
        assert extremal.certificate.clearance == pytest.approx(clearances(scenario, extremal).min(), abs=1e-4)
        assert verify(extremal) < 1e-7
        assert extremal.costates[-1, 3] == pytest.approx(0.0, abs=1e-8)  # of the time, which is free at the end
        np.testing.assert_allclose(extremal.states[:, 3], extremal.times, atol=1e-9)


def test_the_best_order_changes_with_the_phase_of_the_obstacle():
    """If the disc is late, the robot passes in front of it; if it is early, behind it."""
    classes = []
    for shift in (-1.5, 1.5):
        obstacle = {"circle": {"center": [5.0, 1.8 + shift], "radius": 0.6}, "velocity": [0.0, 0.8]}
        classes.append(find_optimum(crossing(0.8, obstacles=[obstacle])).path_class)
    assert set(classes) == {("left",), ("right",)}


def test_the_robot_waits_at_a_door():
    """A disc goes through a door that has room for one; the robot waits or goes first."""
    walls = [[[4.8, 0], [5.2, 0], [5.2, 4.3], [4.8, 4.3]], [[4.8, 5.7], [5.2, 5.7], [5.2, 10], [4.8, 10]]]
    disc = {"circle": {"center": [9.0, 5.0], "radius": 0.4}, "path": {"times": [0, 12], "points": [[9, 5], [1, 5]]}}
    fields = {"start": [1, 3, 0], "goal": [9, 7, 0], "horizon": 14.0}
    scenario = crossing(0.8, obstacles=[*({"polygon": {"vertices": wall}} for wall in walls), disc], **fields)
    optimum = find_optimum(scenario)
    assert optimum.success
    assert optimum.certificate.clearance > 0
    at = np.interp(5.0, optimum.states[:, 0], optimum.times)  # when the robot is in the door
    assert abs(at - 6.0) > 0.8  # the disc is there after 6 s


@pytest.mark.parametrize(
    "changes",
    [
        {"horizon": None, "cost": {"time_weight": 1.0}},
        {"cost": {"proximity_weight": 0.0}},
        {"robot": {"model": "car"}},
        {"robot": {"model": "dynamic_unicycle"}},
        {"robot": {"model": "unicycle", "footprint": {"box": {"length": 0.5, "width": 0.3}}}},
    ],
    ids=["free", "hard", "car", "dynamic_unicycle", "box"],
)
def test_other_tasks_are_solved(changes):
    optimum = find_optimum(crossing(0.8, **changes))
    assert optimum.success
    assert optimum.certificate.clearance > 0
    if changes.get("horizon", 8.0) is None:
        assert np.abs(optimum.hamiltonian).max() < 1e-7


@pytest.mark.parametrize("seed", range(5))
def test_random_scenes_are_certified(seed):
    scenario = random_crossing(seed)
    optimum = find_optimum(scenario, "medium")
    assert optimum.success
    assert clearances(scenario, optimum).min() > 0


def test_the_search_misses_few_optima_of_static_scenarios():
    """With an obstacle far away that moves, the search over position and time finds what the lattice finds."""
    obstacle = {"circle": {"center": [4.5, 4.4], "radius": 0.8}}
    far = {"circle": {"center": [1000.0, 1000.0], "radius": 0.1}, "velocity": [1.0, 0.0]}
    still = Scenario.from_dict(scenario_fields(obstacles=[obstacle]))
    timed = Scenario.from_dict(scenario_fields(obstacles=[obstacle, far]))
    assert find_optimum(timed).cost == pytest.approx(find_optimum(still).cost, rel=1e-9)


def test_an_obstacle_without_velocity_is_at_rest():
    obstacle = {"circle": {"center": [4.5, 4.4], "radius": 0.8}}
    still, zero = (scenario_fields(obstacles=[{**obstacle, **motion}]) for motion in ({}, {"velocity": [0.0, 0.0]}))
    assert find_optimum(Scenario.from_dict(zero)).cost == find_optimum(Scenario.from_dict(still)).cost


def test_a_guess_is_solved_and_an_optimum_is_drawn(tmp_path):
    scenario = crossing(0.8)
    optimum = find_optimum(scenario)
    again = solve(OptimalControlProblem.from_scenario(scenario), "multiple_shooting", guess=optimum)
    assert again.success
    assert again.cost == pytest.approx(optimum.cost, rel=1e-9)
    plot_extremal(optimum, tmp_path / "optimum.png", scenario)


def test_the_sides_of_a_moving_obstacle_are_those_where_it_is():
    field = crossing(1.0).field
    times = np.linspace(0.0, 8.0, 100)
    line = np.column_stack([1.0 + times, np.full(100, 5.0)])
    early, late = line.copy(), line.copy()
    early[:, 0] += 1.5 * np.sin(np.pi * times / 8)
    late[:, 0] -= 1.5 * np.sin(np.pi * times / 8)
    # In front of the disc, which comes from the right; then it passes on the right.
    assert path_sides(times, early, field) == ("right",)
    assert path_sides(times, late, field) == ("left",)


def test_what_considers_obstacles_at_rest_only_refuses_others():
    scenario = crossing(0.8)
    for call in (lambda: minimum_length(scenario), lambda: lower_bound(scenario)):
        with pytest.raises(ValueError, match="expected obstacles at rest, but one has a velocity or a path"):
            call()


@pytest.mark.parametrize("family", MOVING_LAYOUTS)
def test_scenarios_of_families_are_certified_without_a_doubt(family):
    for seed in range(4):
        optimum = find_optimum(sample_scenario(family, seed), "medium")
        assert optimum.success and not optimum.doubts


def test_paths_of_a_class_that_wait_elsewhere_are_found():
    """The best path and the one with cost 4.391 are in one class; the best cost is confirmed by IPOPT."""
    assert find_optimum(sample_scenario("doors", 60013)).cost == pytest.approx(4.307168, rel=1e-6)


@pytest.mark.parametrize("family", ["crossing", *(pytest.param(one, marks=pytest.mark.slow) for one in MOVING_LAYOUTS)])
def test_no_second_search_finds_better(family):
    opinion = second_opinion(sample_scenario(family, 0))
    assert math.isfinite(opinion.cost) and opinion.doubts == 0
    assert opinion.improvement < 1e-3
    assert opinion.tried > 150


@pytest.mark.parametrize("horizon", ["fixed", "free"])
@pytest.mark.parametrize("feedback", ["resolve", "gains"])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_expert_reaches_the_goal_in_closed_loop(horizon, feedback, noise):
    env = NavigateEnv("crossing", split="fresh", horizon=horizon)
    expert = ExpertPolicy(env, feedback=feedback)
    rng = np.random.default_rng(0)
    scenario = sample_scenario("crossing", 5, horizon=horizon)
    observation, info = env.reset(options={"scenario": scenario})
    done = False
    while not done:
        action, _ = expert.predict(observation)
        action = np.clip(action + noise * rng.standard_normal(2), -1, 1).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    assert info["is_success"]
    if noise == 0.0:  # with a free horizon, the episode ends within the tolerances of the goal
        assert info["cost"] == pytest.approx(find_optimum(scenario).cost, rel=1e-3 if horizon == "fixed" else 0.02)


def test_value_and_costate_of_the_expert_are_those_of_the_rest_of_the_episode():
    scenario = sample_scenario("crowd", 3)
    optimum = find_optimum(scenario)
    env = NavigateEnv(scenario=scenario)
    env.reset(seed=0)
    expert = ExpertPolicy(env)
    time = 2.0
    state = optimum.interpolate(np.array([time]))[0]
    assert expert.value(state[:3], time) == pytest.approx(optimum.cost_to_go(time), rel=1e-6)
    assert expert.costate(state[:3], time) == pytest.approx(state[4:7], abs=1e-5)
    rest = find_optimum(scenario.from_state(state[:3], time))
    assert rest.cost == pytest.approx(optimum.cost_to_go(time), rel=1e-6)


def test_a_new_search_on_the_way_continues_in_the_time_of_the_episode():
    scenario = crossing(0.8)
    optimum = find_optimum(scenario)
    feedback = Feedback(scenario, optimum)
    found = feedback._search(optimum.interpolate(np.array([1.5]))[0, :3], 1.5)
    assert found.times[0] == 1.5 and found.nodes[0, 3] == pytest.approx(1.5, abs=1e-12)
    assert found.cost == pytest.approx(optimum.cost_to_go(1.5), rel=1e-5)  # nodes to 1e-6


def test_a_bank_stores_the_states_of_the_robot_and_the_expert_reads_them(tmp_path):
    scenarios = [sample_scenario(family, 1) for family in ("crossing", "traffic", "crowd", "doors")]
    named = [one.model_copy(update={"name": f"moving-{k}"}) for k, one in enumerate(scenarios)]
    bank = build_bank_of(named, tmp_path / "moving.bank", progress=False)
    assert len(bank) == 4
    for index, scenario in enumerate(bank):
        reference = bank.reference(index)
        assert reference.states.shape[1] == reference.costates.shape[1] == 3
        path = Trajectory(reference.times, reference.states.astype(float), reference.costates.astype(float))
        again = solve(scenario, "multiple_shooting", guess=path)
        assert again.success and again.cost == pytest.approx(bank.costs[index], rel=1e-9)
        assert again.states.shape[1] == 4
        timed = with_clock(OptimalControlProblem.from_scenario(scenario), path)
        at = again.evaluate(reference.times)
        np.testing.assert_allclose(timed.costates[:, 3], at[2][:, 3], atol=1e-4)  # that of the time, from H
    env = NavigateEnv(bank=bank)
    observation, info = env.reset(options={"index": 0})
    assert info["reference_cost"] == bank.costs[0]
    assert np.abs(ExpertPolicy(env).predict(observation)[0]).max() <= 1.0


def test_steps_end_at_the_knots_of_a_path():
    """Without that, the costate of the time is not accurate enough for a certificate."""
    times = np.arange(0.0, 9.0, 0.4)
    points = np.column_stack([5.0 + 0.3 * (-1.0) ** np.arange(len(times)), 1.0 + 0.9 * times])
    path = {"times": times.tolist(), "points": points.tolist()}
    obstacle = {"circle": {"center": points[0].tolist(), "radius": 0.5}, "path": path}
    scenario = crossing(0.5, obstacles=[obstacle])
    optimum = find_optimum(scenario)
    assert optimum.success and optimum.certificate.defect < 1e-9
    assert optimum.certificate.hamiltonian_drift < 1e-8
    assert np.diff(optimum.times).min() > 0.0
    assert verify(optimum) < 1e-6  # SciPy's integrator does not know the knots
    assert (np.abs(optimum.times[:, None] - times) < 1e-9).any(axis=0)[1:].sum() >= 15


def test_the_certificate_excludes_the_time_from_conjugate_points():
    """No control changes the time, so that its costate takes its place in the determinant."""
    problem = OptimalControlProblem.from_scenario(crossing(0.8))
    frame = np.random.default_rng(0).normal(size=(8, 4))
    rows = [0, 1, 2, 7]
    expected = np.linalg.det(np.linalg.qr(frame).Q[rows])
    assert problem.clock == 3
    assert abs(orthonormalise(frame.copy(), 3)) == pytest.approx(abs(expected), rel=1e-9)
    found = solve(crossing(0.8), "multiple_shooting")
    assert found.success and found.certificate.conjugate_point is None
    assert found.certificate.controllability is not None
