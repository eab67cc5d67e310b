"""Objects and caches that several threads use at once."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import sympy as sp
from helpers import best_known

from leapnav.envs import NavigateVectorEnv, ScenarioBank, ScenarioError, geodesics
from leapnav.envs.geodesics import geodesic_map
from leapnav.envs.utils.caching import computed_once
from leapnav.experts import ControlAffineSystem, ExpertPolicy, Trajectory, find_optimum
from leapnav.experts.acting import feedback as feedback_module
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.problem import generated_dynamics, generated_flow

N_THREADS = 8


def in_threads(function):
    """Call a function with the number of each of eight threads, which start at once."""
    barrier = threading.Barrier(N_THREADS)

    def call(number):
        barrier.wait()
        return function(number)

    with ThreadPoolExecutor(N_THREADS) as pool:
        return list(pool.map(call, range(N_THREADS)))


def test_a_result_is_computed_by_one_thread():
    calls, waiting = [], threading.Event()

    @computed_once()
    def slow(argument):
        calls.append(argument)
        waiting.wait(0.05)
        return object()

    assert len(set(map(id, in_threads(lambda _: slow(1))))) == 1
    assert calls == [1]


def slowed(function, calls):
    """Return a function that notes its calls and lets other threads run before it returns."""

    def call(*arguments, **options):
        calls.append(arguments)
        found = function(*arguments, **options)
        time.sleep(0.01)
        return found

    return call


def test_a_system_is_compiled_once(monkeypatch):
    x, y = sp.symbols("x y")
    system = ControlAffineSystem(state=(x, y), drift=[y, -sp.sin(x) - sp.Rational(17, 1003) * y], fields=[[0, 1]])
    calls = []
    for module in (generated_flow, generated_dynamics):
        monkeypatch.setattr(module, "load", slowed(module.load, calls))

    def functions(_):
        flow = generated_flow.compile_flow(system, sp.Integer(0), None)
        return *flow, generated_dynamics.compile_dynamics(system, sp.Integer(0), None).step

    found = in_threads(functions)
    assert all(one is other for pair in found for one, other in zip(pair, found[0], strict=True))
    assert len(calls) == 2  # the flow and the dynamics


def test_a_value_that_needs_a_search_changes_no_control_of_another_thread(monkeypatch):
    scenario, _ = best_known()[0]
    optimum = find_optimum(scenario)
    feedback = Feedback(scenario, Trajectory(optimum.times, optimum.states, optimum.costates))
    searches = []
    monkeypatch.setattr(feedback_module, "find_optimum", slowed(find_optimum, searches))
    state = next(state for state in free_states(scenario) if feedback.value(state, 0.5) and searches)
    expected = feedback.control(0.5)
    monkeypatch.setattr(feedback_module, "advance", slowed(feedback_module.advance, []))
    done = threading.Event()

    def use(number):
        if number == 0:
            for _ in range(3):
                feedback.value(state, 0.5)
            done.set()
        while not done.is_set():
            if not np.array_equal(feedback.control(0.5), expected):
                return False
        return True

    assert all(in_threads(use))


def free_states(scenario):
    """Yield states of the robot far from its optimum, without contact."""
    for x in np.arange(0.5, 9.5):
        for y in np.arange(0.5, 9.5):
            try:
                yield np.array([*scenario.from_state([x, y, 0.0], 0.5).start])
            except ScenarioError:
                continue


def test_the_value_of_many_states_at_once_is_that_of_each_alone():
    scenario, _ = best_known()[0]
    optimum = find_optimum(scenario)
    path = Trajectory(optimum.times, optimum.states, optimum.costates)
    feedback = Feedback(scenario, path)
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 0.6 * scenario.horizon, N_THREADS)
    states = optimum.evaluate(times)[0] + 0.02 * rng.normal(size=(N_THREADS, 3))
    before = feedback.control(0.5), feedback.stored, feedback.searches
    alone = [Feedback(scenario, path).value(state, time) for state, time in zip(states, times, strict=True)]
    for _ in range(3):
        found = in_threads(lambda number: feedback.value(states[number], times[number]))
        for (cost, costate), (expected, expected_costate) in zip(found, alone, strict=True):
            assert cost == pytest.approx(expected, rel=1e-7)
            np.testing.assert_allclose(costate, expected_costate, atol=1e-5)
    # Also while the stored solution is replaced.
    in_threads(lambda number: feedback.update(states[0], 0.0) if number == 0 else feedback.value(states[0], 0.0))
    feedback = Feedback(scenario, path)
    feedback.value(states[3], times[3])
    np.testing.assert_array_equal(feedback.control(0.5), before[0])
    assert (feedback.stored[0], feedback.searches) == (before[1][0], before[2])


def test_scenarios_and_optima_of_a_bank_are_read_by_threads():
    expected, bank = ScenarioBank.shipped("clutter", "test"), ScenarioBank(ScenarioBank.shipped("clutter", "test").path)

    def read(number):
        order = np.random.default_rng(number).permutation(40)
        return all(
            np.array_equal(bank[i].field, expected[i].field)
            and np.array_equal(bank.reference(i).states, expected.reference(i).states)
            for _ in range(20)
            for i in order.tolist()
        )

    assert all(in_threads(read))


def test_threads_get_the_same_scenarios_of_a_bank():
    path = ScenarioBank.shipped("clutter", "test").path
    for _ in range(20):
        bank = ScenarioBank(path)
        first, *others = in_threads(lambda _, bank=bank: [id(bank[i]) for i in range(4)])
        assert all(other == first for other in others)


def test_geodesic_maps_are_shared_by_threads():
    scenario, _ = best_known()[0]
    goals = [(0.5 + 0.2 * k, 1.0) for k in range(3)]
    expected = [geodesic_map(scenario.field, *goal) for goal in goals]

    def read(number):
        order = np.random.default_rng(number).integers(len(goals), size=40)
        geodesics._solve.cache_clear()  # so that several threads compute maps
        return all(np.array_equal(geodesic_map(scenario.field, *goals[k]), expected[k]) for k in order)

    assert all(in_threads(read))


def test_the_expert_acts_in_threads_as_alone():
    def actions(workers):
        env = NavigateVectorEnv(N_THREADS, "rooms")
        expert = ExpertPolicy(env, workers=workers)
        observations, _ = env.reset(seed=5)
        found = []
        for _ in range(5):
            action, _ = expert.predict(observations)
            found.append(action)
            observations, *_ = env.step(action)
        return np.array(found), expert.value()

    (alone, value), (threaded, threaded_value) = actions(1), actions(N_THREADS)
    np.testing.assert_allclose(threaded, alone, atol=1e-6)
    np.testing.assert_allclose(threaded_value, value, rtol=1e-8)


def test_a_policy_does_not_drive_a_part_of_its_environments():
    envs = [NavigateVectorEnv(2, "open") for _ in range(2)]
    first = ExpertPolicy(envs[0])
    assert first.drives(envs[0])
    assert not first.drives(envs[1])
    first._envs = [*first._envs, *ExpertPolicy(envs[1])._envs]
    assert not first.drives(envs[0])
