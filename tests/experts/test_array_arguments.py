"""Every public function that passes an array to a kernel checks it first: an error instead of a crash."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import best_known

from leapnav.envs import NavigateEnv, NavigateGoalEnv, NavigateVectorEnv
from leapnav.experts import (
    ExpertPolicy,
    OptimalControlProblem,
    Status,
    Trajectory,
    certify,
    continuation,
    find_reached_optimum,
    solve,
)
from leapnav.experts.acting.feedback import Feedback

SCENARIO = best_known()[0][0]
PROBLEM = OptimalControlProblem.from_scenario(SCENARIO)
TIMES = np.linspace(0.0, SCENARIO.horizon, 9)
STATES = np.linspace(SCENARIO.start_state, [*SCENARIO.goal], 9)


@pytest.fixture(scope="module")
def extremal():
    return solve(SCENARIO, "multiple_shooting")


@pytest.fixture(scope="module")
def feedback(extremal):
    return Feedback(SCENARIO, Trajectory(extremal.times, extremal.states, extremal.costates))


def one_step(problem, guess):
    return solve(problem, "multiple_shooting", guess=guess, max_iterations=1, segments=8)


def expert_value(state):
    env = NavigateEnv(scenario=SCENARIO)
    env.reset()
    return ExpertPolicy(env).value(state)


def expert_with_reference(states):
    env = NavigateEnv(scenario=SCENARIO)
    observation, _ = env.reset()
    return ExpertPolicy(env, {SCENARIO: Trajectory(TIMES, states, STATES)}).predict(observation)


def step(env_class):
    def call(action):
        env = env_class(1, scenario=SCENARIO) if env_class is NavigateVectorEnv else env_class(scenario=SCENARIO)
        env.reset(seed=0)
        return env.step(action)

    return call


# name: (function of the array, a valid array)
ENTRIES = {
    "solve: guess.states": (lambda a: one_step(SCENARIO, Trajectory(TIMES, a)), STATES),
    "solve: guess.times": (lambda a: one_step(SCENARIO, Trajectory(a, STATES)), TIMES),
    "solve: guess.costates": (lambda a: one_step(SCENARIO, Trajectory(TIMES, STATES, a)), STATES),
    "solve: problem": (lambda a: one_step(PROBLEM, Trajectory(TIMES, a)), STATES),
    "problem: start": (lambda a: replace(PROBLEM, start=a), STATES[0]),
    "problem: goal": (lambda a: replace(PROBLEM, goal=a), STATES[-1]),
    "problem: field": (lambda a: replace(PROBLEM, field=a), SCENARIO.field),
    "problem.dynamics": (PROBLEM.dynamics, STATES),
    "problem.estimate_costates: states": (lambda a: PROBLEM.estimate_costates(Trajectory(TIMES, a)), STATES),
    "problem.estimate_costates: times": (lambda a: PROBLEM.estimate_costates(Trajectory(a, STATES)), TIMES),
    "problem.with_winding_of": (PROBLEM.with_winding_of, STATES),
    "trajectory.resample": (Trajectory(TIMES, STATES).resample, TIMES),
    "trajectory.resample: states": (lambda a: Trajectory(TIMES, a).resample(TIMES), STATES),
    "certify: times": (lambda a: certify(PROBLEM, a, np.hstack([STATES, STATES]), Status.STALLED), TIMES),
    "certify: nodes": (lambda a: certify(PROBLEM, TIMES, a, Status.STALLED), np.hstack([STATES, STATES])),
    "find_reached_optimum": (lambda a: find_reached_optimum(SCENARIO, a, 1.0), STATES[-1]),
    "scenario.from_state": (lambda a: SCENARIO.from_state(a, 1.0), STATES[0]),
    "scenario.to_state": (SCENARIO.to_state, STATES[-1]),
    "ExpertPolicy.value": (expert_value, STATES[0]),
    "ExpertPolicy: references": (expert_with_reference, STATES),
    "NavigateEnv.step": (step(NavigateEnv), np.zeros(2, dtype=np.float32)),
    "NavigateGoalEnv.step": (step(NavigateGoalEnv), np.zeros(2, dtype=np.float32)),
    "NavigateVectorEnv.step": (step(NavigateVectorEnv), np.zeros((1, 2), dtype=np.float32)),
}
# Arrays that look wrong and are not: None is a free component of the goal, nodes of a solver that diverged are not
# finite, a path that is not finite is interpolated as such, and some functions take any number of rows or columns.
ACCEPTED = {
    ("certify: nodes", "NaN"),
    ("certify: nodes", "infinite"),
    ("certify: nodes", "objects"),
    ("problem: goal", "objects"),
    ("problem.dynamics", "empty"),
    *(("trajectory.resample", kind) for kind in ("NaN", "infinite", "objects", "empty")),
    *(("trajectory.resample: states", kind) for kind in ("NaN", "infinite", "objects")),
    ("trajectory.resample", "a column more"),
    ("trajectory.resample", "a column less"),
    ("trajectory.resample: states", "a column more"),
    ("trajectory.resample: states", "a column less"),
    ("ExpertPolicy.value", "one dimension more"),
}


def wrong_arrays(valid):
    """Yield arrays that no function can accept in place of a valid one."""
    yield "one dimension more", valid[None]
    yield "a scalar", valid.ravel()[0]
    yield "a column more", np.concatenate([valid, valid[..., :1]], axis=-1) if valid.ndim > 1 else np.append(valid, [0])
    yield "a column less", valid[..., :-1]
    yield "empty", np.empty((0, *valid.shape[1:]))
    yield "text", np.full(valid.shape, "x")
    yield "objects", np.full(valid.shape, None)
    yield "NaN", np.where(np.arange(valid.size).reshape(valid.shape) == valid.size - 1, np.nan, valid)
    yield "infinite", np.where(np.arange(valid.size).reshape(valid.shape) == valid.size - 1, np.inf, valid)


@pytest.mark.parametrize("name", ENTRIES)
def test_wrong_arrays_are_refused(name):
    function, valid = ENTRIES[name]
    for kind, array in wrong_arrays(valid):
        if (name, kind) in ACCEPTED:
            function(array)
            continue
        try:
            function(array)
        except (ValueError, TypeError):
            continue
        pytest.fail(f"{name}: {kind} was accepted")


@pytest.mark.parametrize("name", ENTRIES)
def test_other_memory_layouts_and_types_are_accepted(name):
    function, valid = ENTRIES[name]
    strided = np.repeat(valid, 2, axis=-1)[..., ::2]
    read_only = valid.copy()
    read_only.flags.writeable = False
    for array in (np.asfortranarray(valid), strided, read_only, valid.astype(np.float64), valid.tolist()):
        if not (name in ("problem: field",) and isinstance(array, list)):
            function(array)


def test_times_of_a_result_are_checked(extremal, feedback):
    for times in (np.nan, [0.0, np.inf], [[0.0]], "x"):
        for function in (extremal.evaluate, extremal.interpolate, extremal.cost_to_go):
            with pytest.raises(ValueError, match="expected"):
                function(times)
    for state in (np.zeros(4), np.zeros((1, 3)), [np.nan, 0, 0]):
        with pytest.raises(ValueError, match="state: expected"):
            feedback.value(state, 0.0)
        with pytest.raises(ValueError, match="state: expected"):
            feedback.update(state, 0.0)


def test_continuation_checks_its_guess(extremal):
    other = solve(OptimalControlProblem.from_scenario(SCENARIO), guess=extremal)
    with pytest.raises(ValueError, match="the extremal has 2 states"):
        continuation([PROBLEM], guess=replace(other, states=other.states[:, :2]))


def edits_of_a_field(field, rng):
    """Yield packed fields with one entry changed to a value that a count or an offset must not have."""
    for index in range(len(field)):
        for value in (-1.0, 0.5, 1e8, float(rng.integers(1, 5000)), np.nan):
            edited = field.copy()
            edited[index] = value
            yield edited


def test_an_edited_field_is_refused_or_usable():
    """Counts and offsets that are wrong never reach a kernel; changed coordinates are another scenario."""
    rng = np.random.default_rng(0)
    shapes = [
        {"circle": {"center": [5, 5], "radius": 0.5}},
        {"polygon": {"vertices": [[2, 6], [3, 6], [3, 7]]}},
        {"capsule": {"start": [6, 1], "end": [7, 1], "radius": 0.2}},
    ]
    scenario = SCENARIO.model_copy(update={"obstacles": ()})
    scenario = type(SCENARIO).from_dict(
        {**scenario.to_dict(), "obstacles": shapes, "start": [1, 1, 0], "goal": [9, 9, 0]}
    )
    problem = OptimalControlProblem.from_scenario(scenario)
    nodes = np.hstack([[[1, 1, 0], [9, 9, 0]], np.zeros((2, 3))])
    refused = 0
    for edited in edits_of_a_field(scenario.field, rng):
        try:
            changed = replace(problem, field=edited)
        except ValueError:
            refused += 1
            continue
        certify(changed, np.array([0.0, 0.1]), nodes, Status.STALLED)
    assert refused > 0
