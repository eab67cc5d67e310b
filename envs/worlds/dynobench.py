"""The problems of dynobench for robots that leapnav has: minimum time among boxes.

J. Ortiz-Haro, W. Hoenig, V. Hartmann, M. Toussaint, "iDb-A*: Iterative search and optimization for optimal kinodynamic
motion planning", IEEE Transactions on Robotics 41 (2025). The problems and solutions of several planners are part of
the repository https://github.com/quimortiz/dynobench (MIT licence), in the directory `envs`.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from leapnav.envs.robots import Box, DynamicUnicycle, RobotModel, Trailer, Unicycle
from leapnav.envs.robots.base import magnitude
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Polygon
from leapnav.envs.worlds.yaml_files import Number, Pair, YamlRecord, as_record, read_yaml

# The dynamics that leapnav has: velocities or accelerations as controls, and a car with a trailer.
KINEMATIC, DYNAMIC, TOWING = "unicycle1", "unicycle2", "car_with_trailers"
STATE_WEIGHT = 1e-6  # of the squared velocities of a robot with accelerations as controls, whose cost is the time
# Scale (m) of the barrier. With 0.1 m, the minimum time of one of five problems was 3 % longer, another local minimum.
PROXIMITY_SCALE = 0.02
# rad/s, of the steering state, which dynobench does not limit.
STEERING_RATE = 10.0
SOLUTION = "_solution_"  # part of the names of the files of solutions


@dataclass(frozen=True)
class DynobenchProblem:
    """A problem of dynobench.

    Attributes:
        scenario: the scenario, with a free horizon and the time weight 1; None if its robot is not one of leapnav.
        reason: why there is no scenario, or an empty string.
        durations: durations (s) of the feasible solutions in the repository, by the name of the planner.
        time_step: of its trajectories (s).
        distance_weights: weights of the position, the heading and further states in its distance of two states.

    """

    scenario: Scenario | None
    reason: str
    durations: dict[str, float]
    time_step: float
    distance_weights: tuple[float, ...]


def read_dynobench(folder: str | os.PathLike[str]) -> dict[str, DynobenchProblem]:
    """Read the problems of dynobench with one wheeled robot, by their names such as "unicycle1_v0-kink_0".

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
        content = read_yaml(path)
        if isinstance(content, dict) and len(as_record(_Robots, content, path).robots) == 1:
            found[f"{path.parent.name}-{path.stem}"] = _problem(root, path, content)
    return found


class _Kind(YamlRecord):
    type: str


class _Robots(YamlRecord):
    robots: tuple[_Kind, ...] = ()


class _Model(YamlRecord):
    dynamics: str
    shape: str
    dt: Number
    distance_weights: tuple[Number, ...]


class _BoxModel(YamlRecord):
    size: Pair
    min_vel: Number
    max_vel: Number
    min_angular_vel: Number
    max_angular_vel: Number


class _DynamicModel(_BoxModel):
    max_acc_abs: Number
    max_angular_acc: Number


class _TowingModel(YamlRecord):
    size: Pair
    size_trailer: Pair
    shape_trailer: Literal["box"]
    num_trailers: Literal[1]
    hitch_lengths: tuple[Number]
    l: Number  # noqa: E741 (the wheelbase)
    min_vel: Number
    max_vel: Number
    max_steering_abs: Number


class _Box(YamlRecord):
    type: Literal["box"]
    center: Pair
    size: Pair


class _Environment(YamlRecord):
    min: Pair
    max: Pair
    obstacles: tuple[_Box, ...]


class _Poses(YamlRecord):
    start: tuple[Number, Number, Number]
    goal: tuple[Number, Number, Number]


class _TowingPoses(YamlRecord):
    start: tuple[Number, Number, Number, Number]
    goal: tuple[Number, Number, Number, Number]


class _States(YamlRecord):
    start: tuple[Number, Number, Number, Number, Number]
    goal: tuple[Number, Number, Number, Number, Number]


class _Problem(YamlRecord):
    environment: _Environment
    robots: tuple[_Poses]


class _DynamicProblem(YamlRecord):
    environment: _Environment
    robots: tuple[_States]


class _TowingProblem(YamlRecord):
    environment: _Environment
    robots: tuple[_TowingPoses]


# The records of model and problem for each of the dynamics.
KINDS: dict[str, tuple[type[YamlRecord], type[YamlRecord]]] = {
    KINEMATIC: (_BoxModel, _Problem),
    DYNAMIC: (_DynamicModel, _DynamicProblem),
    TOWING: (_TowingModel, _TowingProblem),
}


class _Solution(YamlRecord):
    feasible: bool = False
    states: tuple[Any, ...] = ()


def _problem(root: Path, path: Path, content: Any) -> DynobenchProblem:
    robot = as_record(_Robots, content, path).robots[0]
    place = root / "models" / f"{robot.type}.yaml"
    given = read_yaml(place)
    model = as_record(_Model, given, place)
    reason, scenario = "", None
    if model.dynamics not in KINDS:
        reason = f"dynamics {model.dynamics!r}"
    elif model.shape != "box":
        reason = f"shape {model.shape!r}"
    else:
        model_type, problem_type = KINDS[model.dynamics]
        box, problem = as_record(model_type, given, place), as_record(problem_type, content, path)
        scenario = _scenario(f"{path.parent.name}-{path.stem}", problem, box)
    return DynobenchProblem(
        scenario, reason, _durations(path.with_suffix(""), model.dt), model.dt, model.distance_weights
    )


def _scenario(name: str, problem: Any, model: Any) -> Scenario:
    obstacles = []
    for box in problem.environment.obstacles:
        (x, y), (width, height) = box.center, box.size
        low, high = (x - width / 2, y - height / 2), (x + width / 2, y + height / 2)
        corners = (low, (high[0], low[1]), high, (low[0], high[1]))
        obstacles.append(Obstacle(polygon=Polygon(vertices=corners)))
    (length, width), (poses,) = model.size, problem.robots
    footprint = Box(length=length, width=width)
    weights = {"speed_weight": STATE_WEIGHT, "turn_weight": STATE_WEIGHT}
    motion: dict[str, Any] = {}
    if isinstance(model, _TowingModel):
        robot: RobotModel = Trailer(
            footprint=footprint,
            speed=(model.min_vel, model.max_vel),
            wheelbase=model.l,
            max_steering=model.max_steering_abs,
            max_steering_rate=STEERING_RATE,
            steering_weight=1.0 / STEERING_RATE**2,
            hitch_length=model.hitch_lengths[0],
            trailer=Box(length=model.size_trailer[0], width=model.size_trailer[1]),
        )
        weights["speed_weight"] = 1.0 / magnitude(robot.interval("speed")) ** 2
        start, goal = (math.remainder(pose[3] - pose[2], 2.0 * math.pi) for pose in (poses.start, poses.goal))
        motion = {"start_motion": (0.0, start), "goal_motion": (None, goal)}
    else:
        speed, turn_rate = (model.min_vel, model.max_vel), (model.min_angular_vel, model.max_angular_vel)
        if isinstance(model, _DynamicModel):
            robot = DynamicUnicycle(
                footprint=footprint,
                speed=speed,
                turn_rate=turn_rate,
                max_acceleration=model.max_acc_abs,
                max_angular_acceleration=model.max_angular_acc,
                acceleration_weight=1.0 / model.max_acc_abs**2,
                angular_acceleration_weight=1.0 / model.max_angular_acc**2,
            )
            motion = {"start_motion": poses.start[3:], "goal_motion": poses.goal[3:]}
        else:
            robot = Unicycle(footprint=footprint, speed=speed, turn_rate=turn_rate)
            weights = {"speed_weight": 1.0 / magnitude(speed) ** 2, "turn_weight": 1.0 / magnitude(turn_rate) ** 2}
    return Scenario(
        name=name,
        arena=(*problem.environment.min, *problem.environment.max),
        robot=robot,
        start=poses.start[:3],
        goal=poses.goal[:3],
        horizon=None,
        obstacles=tuple(obstacles),
        cost=Cost(
            time_weight=1.0,
            **{field: weights[field] for field in robot.cost_fields},
            proximity_weight=0.0,
            proximity_scale=PROXIMITY_SCALE,
        ),
        **motion,
    )


def _durations(folder: Path, dt: float) -> dict[str, float]:
    """Return the durations (s) of the feasible solutions in a directory."""
    found: dict[str, float] = {}
    for path in sorted(folder.glob(f"*{SOLUTION}*.yaml")):
        solution = as_record(_Solution, read_yaml(path), path)
        if solution.feasible:
            planner = path.stem.partition(SOLUTION)[0]
            found[planner] = round(dt * (len(solution.states) - 1), 6)
    return found
