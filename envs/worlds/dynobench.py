"""The problems of dynobench for robots that leapnav has: minimum time among boxes.

J. Ortiz-Haro, W. Hoenig, V. Hartmann, M. Toussaint, "iDb-A*: Iterative search and optimization for optimal kinodynamic
motion planning", IEEE Transactions on Robotics 41 (2025). The problems and solutions of several planners are part of
the repository https://github.com/quimortiz/dynobench (MIT licence), in the directory `envs`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from leapnav.envs.robots import Unicycle, box_footprint
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Polygon
from leapnav.envs.worlds.yaml_files import YamlFields, read_yaml

MODEL = "unicycle1"  # the dynamics that leapnav has: speed and turn rate with symmetric limits
DISCS = 5  # of the footprint that covers the robot's box
# The proximity cost is small except within a few centimetres of the obstacles, so that its optimum is close to that of
# the minimum-time problem, in which obstacles cost nothing until they are hit.
PROXIMITY_WEIGHT, PROXIMITY_SCALE = 1.0, 0.02
SOLUTION = "_solution_"  # part of the names of the files of solutions


@dataclass(frozen=True)
class DynobenchProblem:
    """A problem of dynobench.

    Attributes:
        scenario: the scenario, with a free horizon and the time weight 1; None if its robot is not one of leapnav.
        reason: why there is no scenario, or an empty string.
        durations: durations (s) of the feasible solutions in the repository, by the name of the planner.

    """

    scenario: Scenario | None
    reason: str
    durations: dict[str, float]


def read_dynobench(folder: str | os.PathLike[str]) -> dict[str, DynobenchProblem]:
    """Read the problems of dynobench with one wheeled robot, by their names such as "unicycle1_v0-kink_0".

    The robot's box is covered by discs, which protrude at its front and rear, see `box_footprint`.

    Args:
        folder: a clone of the repository, with the directories `envs` and `models`.

    Raises:
        FileNotFoundError: the folder has no problems of wheeled robots.
        ValueError: a file is invalid; the message names the file and the field.
        ModuleNotFoundError: PyYAML is not installed.

    """
    root = Path(folder)
    paths = sorted(path for kind in ("unicycle", "car") for path in (root / "envs").glob(f"{kind}*_v*/*.yaml"))
    if not paths:
        raise FileNotFoundError(f"{root}: expected the directories envs and models of dynobench")
    found = {}
    for path in paths:
        fields = read_yaml(path)
        robots = fields.list("robots") if "robots" in fields.values else []
        if len(robots) == 1:
            found[f"{path.parent.name}-{path.stem}"] = _problem(root, path, fields)
    return found


def _problem(root: Path, path: Path, fields: YamlFields) -> DynobenchProblem:
    robot = fields.mapping("robots", 0)
    name = robot.text("type")
    model = read_yaml(root / "models" / f"{name}.yaml")
    reason = _difference(model)
    scenario = None if reason else _scenario(f"{path.parent.name}-{path.stem}", fields, robot, model)
    return DynobenchProblem(scenario, reason, _durations(path.with_suffix(""), model.number("dt")))


def _difference(model: YamlFields) -> str:
    """Return in what the model differs from the robots of leapnav, or an empty string."""
    if model.text("dynamics") != MODEL:
        return f"dynamics {model.text('dynamics')!r}"
    if model.text("shape") != "box":
        return f"shape {model.text('shape')!r}"
    for limit in ("vel", "angular_vel"):
        low, high = model.number(f"min_{limit}"), model.number(f"max_{limit}")
        if low != -high:
            return f"min_{limit} {low:g} and max_{limit} {high:g}: the limits are not symmetric"
    return ""


def _scenario(name: str, fields: YamlFields, robot: YamlFields, model: YamlFields) -> Scenario:
    environment = fields.mapping("environment")
    obstacles = []
    for k in range(len(environment.list("obstacles"))):
        box = environment.mapping("obstacles", k)
        if box.text("type") != "box":
            raise ValueError(f"{box.place}: type: expected box, got {box.text('type')!r}")
        (x, y), (width, height) = box.numbers("center", 2), box.numbers("size", 2)
        low, high = (x - width / 2, y - height / 2), (x + width / 2, y + height / 2)
        corners = (low, (high[0], low[1]), high, (low[0], high[1]))
        obstacles.append(Obstacle(polygon=Polygon(vertices=corners)))
    length, width = model.numbers("size", 2)
    speed, turn_rate = model.number("max_vel"), model.number("max_angular_vel")
    start, goal = robot.numbers("start", 3), robot.numbers("goal", 3)
    low, high = environment.numbers("min", 2), environment.numbers("max", 2)
    return Scenario(
        name=name,
        arena=(low[0], low[1], high[0], high[1]),
        robot=Unicycle(
            footprint=box_footprint(length / 2, length / 2, width, DISCS), max_speed=speed, max_turn_rate=turn_rate
        ),
        start=(start[0], start[1], start[2]),
        goal=(goal[0], goal[1], goal[2]),
        horizon=None,
        obstacles=tuple(obstacles),
        cost=Cost(
            time_weight=1.0,
            speed_weight=1.0 / speed**2,
            turn_weight=1.0 / turn_rate**2,
            proximity_weight=PROXIMITY_WEIGHT,
            proximity_scale=PROXIMITY_SCALE,
        ),
    )


def _durations(folder: Path, dt: float) -> dict[str, float]:
    """Return the durations (s) of the feasible solutions in a directory."""
    found: dict[str, float] = {}
    for path in sorted(folder.glob(f"*{SOLUTION}*.yaml")):
        fields = read_yaml(path)
        if fields.flag("feasible", False):
            planner = path.stem.partition(SOLUTION)[0]
            found[planner] = round(dt * (len(fields.list("states")) - 1), 6)
    return found
