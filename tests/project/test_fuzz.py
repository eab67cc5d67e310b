"""Random input is accepted, or refused in one line. `HYPOTHESIS_PROFILE=long` makes 10,000 cases of each kind."""

import contextlib
import io
import json

import numpy as np
import sympy
from helpers import SOLVERS, scenario_fields
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from leapnav.cli import main, parse
from leapnav.envs import FAMILIES, NavigateEnv, Scenario, ScenarioError
from leapnav.envs.field.clearance import clearances
from leapnav.experts import ControlAffineSystem, OptimalControlProblem, find_optimum, solve, unicycle, verify

# For cases that take tenths of a second each: they are re-integrated by an independent integrator.
# How many random scenarios are valid depends on the constants that hypothesis finds in the code.
EXPENSIVE = settings(
    max_examples=max(10, settings.default.max_examples // 4), suppress_health_check=[HealthCheck.filter_too_much]
)
SMALL_TEXT = st.text(max_size=8)
NUMBERS = st.one_of(
    st.integers(-(10**6), 10**6),
    st.floats(),
    st.sampled_from([0, -0.0, 1e-300, 1e308, float("nan"), float("inf"), 10**400]),
)
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, SMALL_TEXT),
    lambda children: st.one_of(st.lists(children, max_size=4), st.dictionaries(SMALL_TEXT, children, max_size=4)),
    max_leaves=8,
)


def places(value, path=()):
    """The paths of all entries of nested lists and dictionaries."""
    yield path
    if isinstance(value, (list, dict)):
        for key, child in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(child, (*path, key))


@st.composite
def damaged_scenarios(draw):
    """A valid scenario in which some entries are replaced, removed or added."""
    fields = json.loads(json.dumps(scenario_fields()))
    for _ in range(draw(st.integers(1, 3))):
        *path, last = draw(st.sampled_from([place for place in places(fields) if place]))
        parent = fields
        for key in path:
            parent = parent[key]
        action = draw(st.sampled_from(["replace", "replace", "remove", "add"]))
        if action == "replace":
            parent[last] = draw(JSON)
        elif action == "remove":
            del parent[last]
        elif isinstance(parent, dict):
            parent[draw(SMALL_TEXT)] = draw(JSON)
        else:
            parent.insert(0, draw(JSON))
    return fields


def one_line(message):
    return message and "\n" not in message and len(message) < 1000


def outcome(function, *refusals):
    """The result of a function, or the error that it raises."""
    try:
        return function(), None
    except refusals as error:
        return None, error


@given(damaged_scenarios())
def test_fields_are_a_scenario_or_refused_in_one_line(fields):
    scenario, error = outcome(lambda: Scenario.from_dict(fields), ScenarioError)
    if scenario is None:
        assert one_line(str(error))
    else:
        assert Scenario.from_json(scenario.to_json()) == scenario


@given(st.one_of(st.binary(max_size=200), damaged_scenarios().map(lambda fields: json.dumps(fields).encode())))
def test_a_file_that_is_no_scenario_is_refused_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    path.write_bytes(content)
    try:
        Scenario.from_json(path)
    except ScenarioError:
        errors = io.StringIO()
        with contextlib.redirect_stderr(errors):
            assert main(["solve", str(path)]) == 2
        (line,) = errors.getvalue().splitlines()
        assert line.startswith("leapnav: ") and one_line(line)


def spread(low, high):
    """Positive numbers, log-uniform."""
    return st.floats(np.log(low), np.log(high)).map(lambda x: float(np.exp(x)))


@st.composite
def scenarios(draw):
    """Scenarios of all sizes, limits and weights, most of them different from those of the families."""
    size = draw(spread(1.0, 30.0))
    inside = st.floats(0.0, size)
    discs = draw(st.lists(st.tuples(inside, inside, spread(0.02 * size, 0.3 * size)), max_size=6))
    try:
        return Scenario.from_discs(
            discs,
            arena=(0.0, 0.0, size, size),
            start=(draw(inside), draw(inside), draw(st.floats(-4, 4))),
            goal=(draw(inside), draw(inside), draw(st.none() | st.floats(-4, 4))),
            horizon=draw(spread(0.5, 60.0)),
            robot={"radius": draw(spread(0.005, 0.05)) * size, "max_speed": draw(spread(0.1, 10.0))},
            cost={
                "speed_weight": draw(spread(0.1, 10.0)),
                "turn_weight": draw(spread(0.01, 10.0)),
                "proximity_weight": draw(spread(0.01, 10.0)),
                "proximity_scale": draw(spread(0.005, 0.05)) * size,
            },
        )
    except ScenarioError:
        assume(False)


@EXPENSIVE
@given(scenarios())
def test_an_optimum_that_is_called_one_is_one(scenario):
    optimum = find_optimum(scenario, "low")
    assert optimum.status.name and one_line(optimum.status.value)
    if not optimum.success:
        return
    assert verify(optimum) < 1e-6
    path = optimum.interpolate(np.linspace(0.0, scenario.horizon, 2001))
    assert clearances(path[:, :2], scenario.field).min() > 0
    np.testing.assert_allclose(path[0, :3], scenario.start, atol=1e-7)
    np.testing.assert_allclose(path[-1, :2], scenario.goal[:2], atol=1e-7)
    if scenario.goal[2] is not None:
        assert abs(np.cos(path[-1, 2] - scenario.goal[2]) - 1) < 1e-12
    distance = np.linalg.norm(np.subtract(scenario.goal[:2], scenario.start[:2]))
    assert optimum.cost >= 0.5 * scenario.cost.speed_weight * distance**2 / scenario.horizon * (1 - 1e-9)
    assert np.abs(optimum.controls[:, 0]).max() <= scenario.robot.max_speed * (1 + 1e-12)
    for other in optimum.alternatives:
        assert other.success and other.cost >= optimum.cost


ENTRIES = st.one_of(NUMBERS, st.none(), st.booleans(), SMALL_TEXT)


@given(
    start=st.lists(ENTRIES, min_size=2, max_size=4),
    goal=st.lists(ENTRIES, min_size=2, max_size=4),
    horizon=ENTRIES,
    weight=st.lists(ENTRIES, min_size=1, max_size=3),
    bounds=st.none() | st.lists(st.tuples(ENTRIES, ENTRIES), max_size=3),
)
def test_a_problem_is_declared_or_refused(start, goal, horizon, weight, bounds):
    _, error = outcome(
        lambda: OptimalControlProblem(unicycle(), start, goal, horizon, weight, control_bounds=bounds),
        ValueError,
    )
    assert error is None or (one_line(str(error)) and ": expected " in str(error))


@given(
    state=st.lists(st.sampled_from(["x", "y", "x ", "", 1, None]), max_size=3),
    drift=st.lists(st.sampled_from(["0", "x", "y*x", "z", "sin(x)", "1/0", "x +", None, 0]), max_size=3),
    fields=st.lists(st.lists(st.sampled_from(["0", "1", "x", "w", None, 1.5]), max_size=3), max_size=3),
)
def test_a_system_is_declared_or_refused(state, drift, fields):
    symbols = [sympy.Symbol(name) if isinstance(name, str) and name else name for name in state]
    _, error = outcome(lambda: ControlAffineSystem(symbols, drift, fields), ValueError)
    assert error is None or one_line(str(error))


POSES = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-7, 7))


@EXPENSIVE
@given(
    start=POSES,
    goal=POSES,
    free=st.booleans(),
    horizon=spread(0.1, 30.0),
    weight=st.tuples(spread(0.01, 100.0), spread(0.01, 100.0)),
    bound=st.none() | spread(0.1, 10.0),
    method=st.sampled_from(sorted(SOLVERS)),
)
def test_a_solution_that_is_called_one_is_one(start, goal, free, horizon, weight, bound, method):
    goal = (*goal[:2], None) if free else goal
    bounds = None if bound is None else ((-bound, bound), (-bound, bound))
    problem = OptimalControlProblem(unicycle(), start, goal, horizon, weight, control_bounds=bounds)
    extremal = solve(problem, method=method, max_iterations=20)
    if extremal.success:
        assert verify(extremal) < 1e-6
        distance = np.hypot(goal[0] - start[0], goal[1] - start[1])
        assert extremal.cost >= 0.5 * weight[0] * distance**2 / horizon * (1 - 1e-6) - 1e-9


@given(
    family=st.sampled_from(list(FAMILIES)),
    index=st.integers(0, 199),
    actuation=st.sampled_from(["velocity", "motor"]),
    actions=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=30),
    period=st.sampled_from([0.05, 0.1, 1.0]),
)
def test_actions_are_driven_or_refused_and_nothing_is_broken(family, index, actuation, actions, period):
    env = NavigateEnv(family, split="test", actuation=actuation, control_period=period)
    observation, info = env.reset(seed=0, options={"index": index})
    for action in actions:
        before = info["pose"]
        try:
            observation, reward, done, _, info = env.step(np.array(action, dtype=float))
        except (ValueError, OverflowError):
            assert tuple(env.pose) == tuple(before)
            continue
        assert observation in env.observation_space
        assert np.isfinite(reward) and np.isfinite(info["pose"]).all()
        assert info["clearance"] > -1e-3
        if done:
            break
    env.close()


VOCABULARY = """
    solve bank build show compile rollout train bc dagger ppo sac evaluate report watch play demo doctor --help -h --out
    --family clutter all moon --count --seed 3 -1 1e3 x.json --json --plot a.png --method leapfrog --warm-start --policy
    expert --resume --no-resume --cloning.epochs --hidden 32 --split test --bank --port --host
"""
WORDS = st.sampled_from(VOCABULARY.split()) | SMALL_TEXT.filter(lambda text: "\0" not in text)


@EXPENSIVE
@given(st.lists(WORDS, max_size=6))
def test_words_are_a_command_or_refused(words):
    streams = io.StringIO()
    with contextlib.redirect_stdout(streams), contextlib.redirect_stderr(streams):
        command, error = outcome(lambda: parse(words), SystemExit, ValueError, OSError)
    if isinstance(error, SystemExit):
        assert error.code in (0, 2)
    elif error is not None:
        assert one_line(str(error))
    else:
        assert callable(command.run)
