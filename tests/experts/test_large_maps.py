"""Grid maps of 64 to 512 cells: rooms, mazes and random cells, solved or shown to have no path."""

import math
from collections import deque

import numpy as np
import pytest

from leapnav.envs import Circle, Obstacle, Polygon, Scenario, Unicycle
from leapnav.envs.scenarios.maps import read_movingai
from leapnav.experts import find_optimum
from leapnav.experts.problem.extremal import Status
from leapnav.experts.search.lattice import is_connected

SPEED = 0.8  # m/s; the horizon is the length of the grid's path at this speed


def rooms(size, width, rng):
    """Rooms of `width` cells with doors of one cell; a few walls have none."""
    blocked = np.zeros((size, size), dtype=bool)
    walls = np.arange(0, size, width + 1)
    blocked[walls], blocked[:, walls] = True, True
    for line in walls:
        for column in walls:
            doors = np.add((column, line), rng.integers(1, width + 1, size=2))
            for at in ((line, doors[0]), (doors[1], column)):
                if max(at) < size and rng.random() < 0.85:
                    blocked[at] = False
    return blocked


def maze(size, width, rng):
    """A maze without loops, with corridors of `width` cells, by depth-first search."""
    count = (size - 1) // (width + 1)
    blocked = np.ones((size, size), dtype=bool)
    spans = [slice(1 + k * (width + 1), (k + 1) * (width + 1)) for k in range(count)]
    blocked[spans[0], spans[0]] = False
    visited, stack = {(0, 0)}, [(0, 0)]
    while stack:
        i, j = stack[-1]
        around = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        free = [cell for cell in around if min(cell) >= 0 and max(cell) < count and cell not in visited]
        if not free:
            stack.pop()
            continue
        a, b = free[rng.integers(len(free))]
        lines = slice(min(spans[i].start, spans[a].start), max(spans[i].stop, spans[a].stop))
        columns = slice(min(spans[j].start, spans[b].start), max(spans[j].stop, spans[b].stop))
        blocked[lines, columns] = False
        visited.add((a, b))
        stack.append((a, b))
    return blocked


def random_cells(size, percentage, rng):
    return rng.random((size, size)) < percentage / 100


# Maker, size, and width or percentage.
SMALL = [
    (rooms, 64, 7),
    (maze, 512, 7),
    (maze, 64, 5),
    (random_cells, 64, 20),
    (random_cells, 64, 45),
]
LARGE = [
    *((rooms, *sizes) for sizes in ((64, 15), (128, 7), (128, 31), (256, 7), (256, 15), (256, 31))),
    *((rooms, *sizes) for sizes in ((512, 7), (512, 15), (512, 31))),
    *((maze, *sizes) for sizes in ((64, 1), (64, 3), (128, 1), (128, 7), (256, 3), (256, 7))),
    *((maze, *sizes) for sizes in ((512, 7), (512, 15), (512, 31))),
    *((random_cells, *sizes) for sizes in ((64, 38), (128, 20), (128, 38), (128, 42), (256, 10), (256, 30))),
    *((random_cells, *sizes) for sizes in ((256, 42), (512, 10))),
]


def write_map(path, blocked):
    height, width = blocked.shape
    lines = ["".join("@" if cell else "." for cell in row) for row in blocked]
    path.write_text("\n".join(["type octile", f"height {height}", f"width {width}", "map", *lines]) + "\n")


def flood_fill(blocked, start, goal):
    """Return the length of the path over sides of free cells, or None if there is none.

    The robot fits through a free cell, but not between two that touch at a corner.
    """
    lengths, queue = {start: 0}, deque([start])
    while queue and goal not in lengths:
        line, column = queue.popleft()
        for cell in ((line + 1, column), (line - 1, column), (line, column + 1), (line, column - 1)):
            inside = min(cell) >= 0 and max(cell) < len(blocked)
            if inside and not blocked[cell] and cell not in lengths:
                lengths[cell] = lengths[line, column] + 1
                queue.append(cell)
    return lengths.get(goal)


def check_map(path, make, size, parameter):
    """Solve one problem on a map, and compare the result with a flood fill of its free cells."""
    rng = np.random.default_rng([size, parameter])
    write_map(path, make(size, parameter, rng))
    blocked = read_movingai(path)
    free = np.argwhere(~blocked)
    cells = free[rng.choice(len(free), 2, replace=False)].tolist()
    start, goal = ((column + 0.5, size - line - 0.5) for line, column in cells)
    heading = math.atan2(goal[1] - start[1], goal[0] - start[0])
    length = flood_fill(blocked, *map(tuple, cells))
    horizon = (math.dist(start, goal) if length is None else length) / SPEED
    scenario = Scenario.from_movingai(path, start=(*start, heading), goal=(*goal, None), horizon=horizon)
    optimum = find_optimum(scenario)
    if length is None:
        assert optimum.status is Status.NO_PATH
    else:
        assert optimum.success, f"{make.__name__} {size} {parameter}: {optimum.status}"
    return length


@pytest.mark.parametrize(("make", "size", "parameter"), SMALL)
def test_a_map_has_an_optimum_or_no_path(tmp_path, make, size, parameter):
    length = check_map(tmp_path / "world.map", make, size, parameter)
    assert (length is None) == (parameter == 45)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "size", "parameter"), LARGE)
def test_a_large_map_has_an_optimum_or_no_path(tmp_path, make, size, parameter):
    check_map(tmp_path / "world.map", make, size, parameter)


def wall(*passages):
    """A wall across an arena of 200 m with passages (low, high)."""
    ends = [-100.0, *(end for passage in passages for end in passage), 100.0]
    return [rectangle(-1.0, low, 1.0, high) for low, high in zip(ends[::2], ends[1::2], strict=True)]


def rectangle(x_min, y_min, x_max, y_max):
    return Obstacle(polygon=Polygon(vertices=[(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]))


@pytest.mark.parametrize(("gap", "is_open"), [(0.8, True), (0.4, False)])
def test_a_narrow_passage_of_a_large_arena_is_found(gap, is_open):
    scenario = Scenario(
        arena=(-100, -100, 100, 100),
        start=(-30, 0, 0),
        goal=(30, 0, None),
        horizon=250.0,
        obstacles=wall((63.7 - gap / 2, 63.7 + gap / 2)),
    )
    assert is_connected(scenario) == is_open
    optimum = find_optimum(scenario)
    assert optimum.success == is_open
    if is_open:
        assert optimum.states[:, 1].max() == pytest.approx(63.7, abs=0.5)
    else:
        assert optimum.status is Status.NO_PATH


def test_a_detour_far_away_is_found_although_a_passage_nearby_is_too_narrow():
    """The lattice of the surroundings has candidates, all through the narrow passage."""
    scenario = Scenario(
        arena=(-100, -100, 100, 100),
        start=(-4, 98.5, 0),
        goal=(4, 98.5, None),
        horizon=120.0,
        obstacles=wall((63.1, 64.3), (75.0, 75.44)),
    )
    optimum = find_optimum(scenario)
    assert optimum.success
    assert optimum.states[:, 1].min() == pytest.approx(63.7, abs=1.0)


def test_a_footprint_beside_its_position_is_not_said_to_have_no_path():
    """The position (x, y) of the robot may lie in the thin obstacle, of which its only disc is clear."""
    scenario = Scenario(
        arena=(0, 0, 6, 4),
        robot=Unicycle(footprint=[{"offset": 0.5, "radius": 0.2}]),
        start=(3.0, 2.0, 0.0),
        goal=(4.5, 2.0, 0.0),
        horizon=4.0,
        obstacles=[Obstacle(circle=Circle(center=(2.9, 2.0), radius=0.2))],
    )
    assert is_connected(scenario)


def test_the_plane_and_the_lattice_lead_to_the_same_optimum():
    from leapnav.experts import optimum as module

    scenario = Scenario(
        arena=(0, 0, 60, 60),
        start=(2, 2, 0.5),
        goal=(50, 50, 0.5),
        horizon=90.0,
        obstacles=[rectangle(x, y, x + 3, y + 4) for x in range(5, 55, 9) for y in range(4, 55, 8)],
    )
    plane = find_optimum(scenario)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "LONG_DISTANCE", math.inf)
        lattice = find_optimum(scenario)
    assert plane.success
    assert plane.cost == pytest.approx(lattice.cost, rel=1e-8)
