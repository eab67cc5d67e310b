"""Problems of dynobench, from small files in its format, and its rules."""

import json
from dataclasses import fields

import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import Box, Trailer
from leapnav.envs.scenarios.files import read_scenarios
from leapnav.envs.worlds.dynobench import read_dynobench
from leapnav.envs.worlds.dynobench_rules import TOLERANCES, DiscreteTrajectory, check_trajectory, discretise
from leapnav.experts import minimum_time

MODEL = """dynamics: {dynamics}
min_vel: {slowest}
max_vel: 0.5
size: [0.5, 0.25]
shape: box
dt: 0.1
"""
FURTHER = {
    "unicycle1": "min_angular_vel: -0.5\nmax_angular_vel: 0.5\ndistance_weights: [1, 0.5]\n",
    "unicycle2": "min_angular_vel: -0.5\nmax_angular_vel: 0.5\ndistance_weights: [1, 0.5, 0.25, 0.25]\n"
    "max_acc_abs: 0.25\nmax_angular_acc: 0.25\n",
    "car_with_trailers": "distance_weights: [1, 0.5, 0.5]\nnum_trailers: 1\nl: 0.25\nmax_steering_abs: 1.0\n"
    "shape_trailer: box\nsize_trailer: [0.3, 0.25]\nhitch_lengths: [0.5]\n",
    "quadrotor": "distance_weights: [1]\n",
}
PROBLEM = """name: test
environment:
  min: [0.0, 0.0]
  max: [3.0, 2]
  obstacles:
    - type: box
      center: [1.1, 0.9]
      size: [0.2, 0.4]
robots:
  - type: {model}
    start: {start}
    goal: {goal} # x, y, theta
"""
ENDS = {"start": "[0.8, 1.3, 0]", "goal": "[1.7, 1.3, 0]"}
MODELS = (
    ("unicycle1_v0", "unicycle1", -0.5, ""),
    ("unicycle1_v1", "unicycle1", 0.25, ""),
    ("unicycle2_v0", "unicycle2", -0.5, ", 0, 0"),
    ("car1_v0", "car_with_trailers", -0.1, ", 0"),
    ("car9_v0", "quadrotor", -0.1, ""),
)


@pytest.fixture
def dynobench(tmp_path):
    """A directory with the structure of dynobench: four problems, and one of a robot that leapnav does not have."""
    folder = tmp_path / "dynobench"
    (folder / "models").mkdir(parents=True)
    for model, dynamics, slowest, further in MODELS:
        text = MODEL.format(dynamics=dynamics, slowest=slowest) + FURTHER[dynamics]
        (folder / "models" / f"{model}.yaml").write_text(text)
        solutions = folder / "envs" / model / "wall_0"
        solutions.mkdir(parents=True)
        ends = {name: state.replace("]", f"{further}]") for name, state in ENDS.items()}
        solutions.with_suffix(".yaml").write_text(PROBLEM.format(model=model, **ends))
        for planner, feasible, states in (("idbastar_v0", 1, 41), ("rrt_to_v0", 0, 10)):
            rows = "\n".join("  - [0, 0, 0]" for _ in range(states))
            (solutions / f"{planner}_solution_v0.yaml").write_text(f"feasible: {feasible}\nstates:\n{rows}\n")
    (folder / "envs" / "unicycle1_v0" / "constraints.yaml").write_text("constraints: []\n")
    return folder


def test_problems_of_dynobench_are_scenarios_with_the_durations_of_other_planners(dynobench):
    problems = read_dynobench(dynobench)
    assert sorted(problems) == sorted(f"{model}-wall_0" for model, *_ in MODELS)
    assert all(problem.durations == {"idbastar_v0": 4.0} for problem in problems.values())  # the other is not feasible
    robot = problems["unicycle1_v1-wall_0"].scenario.robot
    assert robot.control_bounds().tolist() == [[0.25, 0.5], [-0.5, 0.5]]
    assert "quadrotor" in problems["car9_v0-wall_0"].reason
    dynamic = problems["unicycle2_v0-wall_0"].scenario
    assert dynamic.robot.state_bounds() == (None, None, None, (-0.5, 0.5), (-0.5, 0.5))
    assert dynamic.robot.control_bounds().tolist() == [[-0.25, 0.25]] * 2
    assert dynamic.start_state == (0.8, 1.3, 0.0, 0.0, 0.0)
    towing = problems["car1_v0-wall_0"].scenario
    assert isinstance(towing.robot, Trailer) and towing.robot.control_bounds()[0].tolist() == [-0.1, 0.5]
    assert towing.outline.tolist() == [[-0.25, 0.25, 0.125, 0, 0], [-0.65, -0.35, 0.125, 0, 4]]
    assert towing.goal_state == (1.7, 1.3, 0.0, None, 0.0)
    scenario = problems["unicycle1_v0-wall_0"].scenario
    assert scenario.arena == (0, 0, 3, 2) and scenario.robot.control_bounds().tolist() == [[-0.5, 0.5]] * 2
    assert scenario.robot.footprint == Box(length=0.5, width=0.25)


@pytest.mark.parametrize("model", ["unicycle1_v0", "unicycle2_v0", "car1_v0"])
def test_paths_of_minimum_time_are_accepted_by_the_rules_of_dynobench(model, dynobench):
    problem = read_dynobench(dynobench)[f"{model}-wall_0"]
    found = minimum_time(problem.scenario, 0.2)
    assert found.extremal.success and 0.9 / 0.5 < found.horizon < 4.0  # the distance at the largest speed
    trajectory = discretise(problem, lambda times: found.extremal.evaluate(times)[0], found.horizon)
    assert len(trajectory.actions) == np.ceil(found.horizon / 0.1)
    assert check_trajectory(problem, trajectory).broken == {}


@pytest.mark.parametrize("rule", [field.name for field in fields(TOLERANCES)])
def test_a_trajectory_that_breaks_a_rule_of_dynobench_is_refused(rule, dynobench):
    problem = read_dynobench(dynobench)["unicycle1_v0-wall_0"]
    states = np.column_stack([np.linspace(0.8, 1.7, 19), np.full(19, 1.3), np.zeros(19)])
    actions = np.tile((0.5, 0.0), (18, 1))
    assert check_trajectory(problem, DiscreteTrajectory(states, actions)).broken == {}
    if rule == "jump":
        states[5, 1] += 0.02
    elif rule in ("start", "goal"):
        states[:, 1] += np.linspace(*((0.04, 0.0) if rule == "start" else (0.0, 0.04)), 19)
    elif rule == "collision":  # the box and the obstacle overlap by 0.025 m
        states[:, 1] -= 0.1 * np.sin(np.linspace(0, np.pi, 19))
    elif rule == "state":
        states[9, 0] = -0.1
    else:
        actions[3, 0] = 0.515
    broken = check_trajectory(problem, DiscreteTrajectory(states, actions)).broken
    assert rule in broken
    if rule in ("start", "goal", "action"):  # the others need a jump
        assert list(broken) == [rule]


def test_the_table_of_dynobench(dynobench, tmp_path, capsys):
    out = tmp_path / "table.json"
    assert main(["worlds", "benchmark", "dynobench", str(dynobench), "--tol", "0.2", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "car9_v0-wall_0: left out: dynamics 'quadrotor'" in printed and "idbastar_v0" in printed
    row = json.loads(out.read_text())["unicycle1_v0-wall_0"]
    assert row["idbastar_v0"] == 4.0 and 1.8 < row["leapnav"] < 4.0 and row["clearance"] > 0
    assert main(["worlds", "import", "dynobench", str(dynobench), "--out", str(tmp_path / "scenarios")]) == 0
    names = [name for name, problem in read_dynobench(dynobench).items() if problem.scenario is not None]
    assert sorted(scenario.name for scenario in read_scenarios(tmp_path / "scenarios")) == sorted(names)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("start: [0.8, 1.3, 0]", "start: [0.8, 1.3, 0, 0, 0]", "wall_0.yaml: robots"),
        ("size: [0.2, 0.4]", "size: 1", r"wall_0.yaml: environment.obstacles\[0\].size: expected a list, got 1"),
        ("type: box", "type: ball", r"obstacles\[0\].type: expected 'box', got 'ball'"),
        ("    goal: [1.7, 1.3, 0]", "    end: [0, 0, 0]", r"robots\[0\].goal: missing"),
    ],
)
def test_an_invalid_problem_of_dynobench_is_named(old, new, message, dynobench):
    path = dynobench / "envs" / "unicycle1_v0" / "wall_0.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_dynobench(dynobench)
