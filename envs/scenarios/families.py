"""Random scenarios by family: the built-in families, and those of users.

A family is a function of a random generator that returns a layout or a whole scenario. Robot, cost, poses and horizon
are sampled in the same way for all layouts.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np

from leapnav.envs.field.clearance import clearances, footprint_clearances
from leapnav.envs.field.packing import pack_field
from leapnav.envs.robots import RobotModel
from leapnav.envs.robots.footprints import sizes_of
from leapnav.envs.scenarios.cost import Cost, cruise_speed
from leapnav.envs.scenarios.files import read_scenarios
from leapnav.envs.scenarios.layouts.at_rest import LAYOUTS_AT_REST
from leapnav.envs.scenarios.layouts.layout import ARENA, Area, ScenarioLayout, rounded
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS
from leapnav.envs.scenarios.scenario import TIME_LIMIT_FACTOR, Scenario, check_robot
from leapnav.envs.settings import HORIZONS, OBSTACLE_KINDS
from leapnav.envs.utils.validation import check_choice, suggestion

REFERENCE_SPEED = 0.8  # m/s: the horizon is the length of the shortest path divided by this speed
MAX_HORIZON = 40.0  # s, in an arena of 10 m; in larger ones in proportion to the longer side
TIME_WEIGHT = 0.5  # cost per second if the horizon is free
# Duration of an optimum with a free horizon, relative to the shortest path at the cruise speed: the median of the
# families is 1.07 to 1.15, because it also turns.
RELATIVE_DURATION = 1.1
MIN_DISTANCE = 0.4  # between start and goal, as a fraction of the shorter side of the arena
MIN_POSE_CLEARANCE = 0.25  # m at the start and the goal
# Time (s) in which no obstacle comes closer to the start at first, and to the goal at the end; number of checks.
POSE_TIME, N_POSE_TIMES = 1.0, 11
PASSAGE_MARGIN = 0.1  # m on either side of the robot, in the narrowest passage that a scenario may require
GRID_SPACING = 0.25  # m, of the grid on which the shortest path is computed
MAX_DRAWS = 10_000  # of a layout and poses, until start and goal are connected
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
BANK_ENDING, FILE_ENDING = ".bank", ".json"  # of names that stand for stored scenarios

Sample = Callable[[np.random.Generator], ScenarioLayout | Scenario]

FAMILIES: dict[str, Sample] = {**LAYOUTS_AT_REST, **MOVING_LAYOUTS}
REGISTERED: dict[str, Sample] = {}
ALL = "all"  # the family is sampled, too
ALL_FAMILIES = ("open", "clutter", "polygons", "rooms", "slalom")  # those that "all" stands for, in arenas of 10 m


@dataclass(frozen=True)
class CustomFamily:
    """A family that is not built in, as other processes need it.

    Attributes:
        name: its name.
        sample: its function.
        names_scenarios: whether the scenarios keep the names that the function gives them.

    """

    name: str
    sample: Sample
    names_scenarios: bool = False


@dataclass(frozen=True)
class StoredScenarios:
    """A family that draws one of the scenarios of a bank, or of scenario files."""

    file: str

    def __call__(self, rng: np.random.Generator) -> Scenario:
        """Return a random one of the scenarios."""
        scenarios = _stored(self.file)
        return scenarios[int(rng.integers(len(scenarios)))]


@lru_cache(maxsize=8)
def _stored(file: str) -> Sequence[Scenario]:
    """Return the scenarios of a bank or of scenario files.

    Raises:
        FileNotFoundError, ValueError: see `ScenarioBank` and `read_scenarios`; a bank without scenarios.

    """
    if not file.endswith(BANK_ENDING):
        return read_scenarios(file)
    from leapnav.envs.scenarios.bank import ScenarioBank  # takes long to import, and not every program uses one

    bank = ScenarioBank(file)
    if len(bank) == 0:
        raise ValueError(f"family: expected at least one scenario, {file} has none")
    return bank


def register_family(name: str, sample: Sample) -> None:
    """Register a family of scenarios under a name, which is accepted wherever a built-in family is.

    A function in a module need not be registered: its family is "module:function". The module is imported; if Python
    does not find it, the current directory is appended to `sys.path`.

    Args:
        name: letters, digits and underscores.
        sample: function of a `numpy.random.Generator`, the only source of randomness. It returns a `ScenarioLayout`,
            for which poses and horizon are sampled, or a `Scenario`, which is not changed, except for its name.

    Raises:
        TypeError: `sample` is not a function.
        ValueError: the name is not valid, or that of a built-in family or of another function.

    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"name: expected letters, digits and underscores, got {name!r}")
    if name in (*FAMILIES, ALL):
        raise ValueError(f"name: {name!r} is a built-in family")
    if not callable(sample):
        raise TypeError(f"sample: expected a function of a random generator, got {type(sample).__name__}")
    known = REGISTERED.get(name)
    if known is not None and _origin(known) != _origin(sample):  # a notebook may define the function again
        raise ValueError(f"name: {name!r} is the name of {'.'.join(_origin(known))}")
    REGISTERED[name] = sample


def _origin(sample: Sample) -> tuple[str, str]:
    return sample.__module__, getattr(sample, "__qualname__", type(sample).__qualname__)


def find_family(name: object) -> str | CustomFamily:
    """Return the name of a built-in family or "all", or another family.

    Raises:
        FileNotFoundError: the name is that of a file or a pattern, and there is no such file.
        ValueError: there is no such family.

    """
    if isinstance(name, str):
        if name in FAMILIES or name == ALL:
            return name
        if name in REGISTERED:
            return CustomFamily(name, REGISTERED[name])
        if name.endswith((BANK_ENDING, FILE_ENDING)):
            path = str(Path(name).absolute())  # independent of the working directory, which differs between processes
            _stored(path)
            return CustomFamily(name, StoredScenarios(path), names_scenarios=True)
        if ":" in name:
            return CustomFamily(name, _import(name))
    known = ", ".join((*FAMILIES, *REGISTERED, ALL))
    raise ValueError(
        f"family: expected one of {known}, module:function or a file (.bank, .json), got {name!r}"
        f"{suggestion(name, (*FAMILIES, ALL, *REGISTERED))}"
    )


def _import(name: str) -> Sample:
    """Return the function that is named as module:function."""
    module, _, function = name.partition(":")
    try:
        sample = getattr(_import_module(module), function)
    except ImportError as error:
        raise ValueError(f"family: {name!r}: cannot import the module {module!r}: {error}") from None
    except AttributeError:
        raise ValueError(f"family: the module {module!r} has no function {function!r}") from None
    if not callable(sample):
        raise ValueError(f"family: {name!r} is not a function, but a {type(sample).__name__}")
    return cast(Sample, sample)


def _import_module(name: str) -> ModuleType:
    """Import a module; one that Python does not find otherwise is searched in the current directory."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        folder = str(Path.cwd())
        if folder in sys.path or "" in sys.path:
            raise
        sys.path.append(folder)  # stays there for imports in functions of the module, and for worker processes
        try:
            return import_module(name)
        except BaseException:
            sys.path.remove(folder)
            raise


def check_family(family: object) -> None:
    """Check that a family exists.

    Raises:
        ValueError: it is neither built in nor registered nor a function in a module nor "all".

    """
    find_family(family)


def is_built_in(family: str) -> bool:
    """Return whether a family is built in."""
    return family in FAMILIES


def has_moving_obstacles(family: str) -> bool:
    """Return whether a family is built in, and its obstacles move."""
    return family in MOVING_LAYOUTS


def families_of(family: str) -> tuple[str, ...]:
    """Return the families that a name stands for: several for "all"."""
    return ALL_FAMILIES if family == ALL else (family,)


def sample_scenario(
    family: str | CustomFamily,
    seed: int | np.random.Generator,
    robot: RobotModel | Mapping[str, Any] | str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
) -> Scenario:
    """Sample a random scenario; the same family and seed give the same scenario.

    Start and goal are at least 4 m apart (0.4 times the shorter side of the arena) and connected by a path with a
    margin of 0.1 m on either side of the robot. The horizon is the length of the shortest such path divided by 0.8 m/s,
    and at most 40 s (4 s per metre of the longer side of the arena); or it is free with the time weight 0.5, and the
    time limit is 3 times an estimate of the duration of the optimum. A scenario that a family of one's own returns is
    not changed, except for its name.

    Args:
        family: one of `FAMILIES`; "all" to sample one of the families of `ALL_FAMILIES`, too; a registered family;
            "module:function"; or the file of a bank (`.bank`), a scenario file or a pattern of them (`.json`), of which
            one scenario is drawn, with its name.
        seed: an integer, or a random generator.
        robot: name of a robot model, a dict of its fields with `model`, or a robot. Robots with the same footprint
            get the same obstacles and poses. None: see `task_of`.
        horizon: "fixed" or "free"; both have the same obstacles and poses. None: see `task_of`.
        obstacles: "cost" for a proximity cost with the weight 1; "hard" for the weight 0, with which the obstacles are
            hard constraints and cost nothing. Both have the same obstacles, poses and horizon. None: see `task_of`.

    Raises:
        TypeError: the function of the family returns something else.
        ValueError: an argument is invalid, a scenario of the family has another robot (of another model, if the
            parameters are not given), kind of horizon or kind of obstacles, or none of its layouts connects start and
            goal.

    """
    chosen = family if isinstance(family, CustomFamily) else find_family(family)
    body, horizon, obstacles = task_of(chosen, robot, horizon, obstacles)
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    if chosen == ALL:
        chosen = ALL_FAMILIES[rng.integers(len(ALL_FAMILIES))]
    custom = chosen if isinstance(chosen, CustomFamily) else CustomFamily(chosen, FAMILIES[chosen])
    name = custom.name if isinstance(seed, np.random.Generator) else f"{custom.name}-{seed}"
    for _ in range(MAX_DRAWS):  # rejection sampling: the draws are independent
        layout = custom.sample(rng)
        if isinstance(layout, Scenario):
            scenario = _checked(layout, custom, body, horizon, obstacles)
            return scenario if custom.names_scenarios else scenario.model_copy(update={"name": name})
        if not isinstance(layout, ScenarioLayout):
            raise TypeError(
                f"family: {custom.name!r}: expected a ScenarioLayout or a Scenario, got {type(layout).__name__}"
            )
        found = _sample_task(layout, rng, body, horizon, obstacles)
        if found is not None:
            return Scenario(name=name, arena=layout.arena, robot=body, obstacles=tuple(layout.obstacles), **found)
    raise ValueError(f"family: {custom.name!r}: no layout connects start and goal in {MAX_DRAWS} draws")


def task_of(
    family: str | CustomFamily,
    robot: RobotModel | Mapping[str, Any] | str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
) -> tuple[RobotModel, str, str]:
    """Return robot, kind of horizon and kind of obstacles of new scenarios of a family.

    Those that are not given are those of the first scenario if the family consists of whole scenarios (a file, or a
    function that returns them), otherwise the unicycle, "fixed" and "cost". The name of the model of that scenario's
    robot selects this robot, whose parameters may differ from the defaults.

    Args:
        family, robot, horizon, obstacles: see `sample_scenario`.

    Raises:
        FileNotFoundError, ValueError: an argument is invalid, or the file cannot be read.

    """
    chosen = family if isinstance(family, CustomFamily) else find_family(family)
    if horizon is not None:
        check_choice("horizon", horizon, HORIZONS)
    if obstacles is not None:
        check_choice("obstacles", obstacles, OBSTACLE_KINDS)
    first = _first_scenario(chosen) if isinstance(chosen, CustomFamily) else None
    if first is None:
        return check_robot("unicycle" if robot is None else robot), horizon or "fixed", obstacles or "cost"
    body = first.robot if robot in (None, first.robot.model) else check_robot(robot)
    return body, horizon or first.horizon_kind, obstacles or first.cost.obstacles


@lru_cache(maxsize=8)
def _first_scenario(family: CustomFamily) -> Scenario | None:
    """Return the first scenario of a family that consists of whole scenarios, otherwise None."""
    if isinstance(family.sample, StoredScenarios):
        return _stored(family.sample.file)[0]
    layout = family.sample(np.random.default_rng(0))
    return layout if isinstance(layout, Scenario) else None


def random_cost(horizon: str, obstacles: str) -> Cost:
    """Return the cost of random scenarios with a kind of horizon and of obstacles."""
    return Cost(
        time_weight=TIME_WEIGHT if horizon == "free" else 0.0, proximity_weight=0.0 if obstacles == "hard" else 1.0
    )


def _checked(scenario: Scenario, family: CustomFamily, robot: RobotModel, horizon: str, obstacles: str) -> Scenario:
    """Return a scenario of a family if it has the robot and the kinds of horizon and obstacles.

    The robots of a family may have different parameters if none but that of its first scenario is asked for.
    """
    first = _first_scenario(family)
    is_default = first is not None and first.robot == robot
    if scenario.robot != robot and not (is_default and scenario.robot.model == robot.model):
        raise ValueError(f"robot: expected that of the scenarios of {family.name!r}, {scenario.robot!r}, got {robot!r}")
    for name, kind, wanted in (
        ("horizon", scenario.horizon_kind, horizon),
        ("obstacles", scenario.cost.obstacles, obstacles),
    ):
        if kind != wanted:
            raise ValueError(f"{name}: expected that of the scenarios of {family.name!r}, {kind!r}, got {wanted!r}")
    return scenario


def _sample_task(
    layout: ScenarioLayout, rng: np.random.Generator, body: RobotModel, horizon: str, obstacles: str
) -> dict[str, Any] | None:
    """Return random poses, the horizon and the cost; None if the poses are too close or not connected."""
    outline, cost = body.outline(), random_cost(horizon, obstacles)
    areas = layout.regions
    poses = np.column_stack([rng.uniform(areas[:, :2], areas[:, 2:]), rng.uniform(-math.pi, math.pi, 2)])
    x_min, y_min, x_max, y_max = layout.arena
    sides = x_max - x_min, y_max - y_min
    if math.dist(poses[0, :2], poses[1, :2]) < MIN_DISTANCE * min(sides):
        return None
    settings = layout.arena, sizes_of(outline), cost.proximity_weight, cost.proximity_scale
    at_rest = [one for one in layout.obstacles if not len(one.knots)]
    field = pack_field([one.shape for one in at_rest], *settings, grid=False)
    n = body.sizes()[0]
    states = np.pad(poses, ((0, 0), (0, n - 3)))
    if footprint_clearances(states, outline, field).min() < MIN_POSE_CLEARANCE:
        return None
    length = _shortest_path(layout.arena, field, poses[0, :2], poses[1, :2])
    if length is None:
        return None
    start, goal = (tuple(rounded(value) for value in pose) for pose in poses)
    longest = MAX_HORIZON * max(1.0, max(sides) / (ARENA[2] - ARENA[0]))
    duration = round(min(length / REFERENCE_SPEED + layout.waiting, longest), 1)
    moving = [one for one in layout.obstacles if len(one.knots)]
    if moving:
        motions = [one.knots for one in moving]
        field = pack_field([one.shape for one in moving], *settings, grid=False, motions=motions, clock=n)
        moments = np.linspace(0.0, POSE_TIME, N_POSE_TIMES)
        timed = [
            np.append(state, t)
            for state, first in zip(states, (0.0, duration - POSE_TIME), strict=True)
            for t in first + moments
        ]
        if footprint_clearances(np.array(timed), outline, field).min() < MIN_POSE_CLEARANCE:
            return None
    times: dict[str, Any] = {"horizon": duration}
    if horizon == "free":
        limit = TIME_LIMIT_FACTOR * (RELATIVE_DURATION * length / cruise_speed(body, cost) + layout.waiting)
        times = {"horizon": None, "time_limit": round(limit, 1)}
    return {"start": start, "goal": goal, "cost": cost, **times}


@dataclass(frozen=True, eq=False)
class _Grid:
    """Grid points (P, 2) of an arena, and the tails, heads, middles and lengths of the edges in 16 directions."""

    points: np.ndarray
    tails: np.ndarray
    heads: np.ndarray
    middles: np.ndarray
    lengths: np.ndarray


@lru_cache(maxsize=8)
def _grid(arena: Area) -> _Grid:
    x_min, y_min, x_max, y_max = arena
    columns = np.arange(x_min + GRID_SPACING, x_max, GRID_SPACING)
    rows = np.arange(y_min + GRID_SPACING, y_max, GRID_SPACING)
    points = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(len(points)).reshape(len(columns), len(rows))
    tails, heads, lengths = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        low, high = max(0, -dy), len(rows) - max(0, dy)
        a = index[: len(columns) - dx, low:high]
        tails.append(a.ravel())
        heads.append(index[dx:, low + dy : high + dy].ravel())
        lengths.append(np.full(a.size, GRID_SPACING * math.hypot(dx, dy)))
    tail, head = np.concatenate(tails), np.concatenate(heads)
    return _Grid(points, tail, head, (points[tail] + points[head]) / 2, np.concatenate(lengths))


def _shortest_path(arena: Area, field: np.ndarray, start: np.ndarray, goal: np.ndarray) -> float | None:
    """Return the length (m) of the shortest path on the grid, with the passage margin; None if there is no path."""
    grid = _grid(arena)
    free = clearances(grid.points, field) > PASSAGE_MARGIN
    ends = [int(np.argmin(np.where(free, np.sum((grid.points - p) ** 2, axis=1), np.inf))) for p in (start, goal)]
    usable = free[grid.tails] & free[grid.heads]
    usable[usable] = clearances(grid.middles[usable], field) > PASSAGE_MARGIN
    size = len(grid.points)
    # Imported here because only fresh scenarios need it.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    graph = csr_array((grid.lengths[usable], (grid.tails[usable], grid.heads[usable])), shape=(size, size))
    length = float(dijkstra(graph, directed=False, indices=ends[0])[ends[1]])
    if not math.isfinite(length):
        return None
    return max(length, math.dist(start, goal))
