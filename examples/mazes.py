"""Families of one's own: mazes, and blocks between corridors, in larger arenas than the built-in families.

A family is a function of a random generator. It returns a layout, for which leapnav samples poses and the horizon, or
a whole scenario.

python examples/mazes.py                                                # some scenarios and their optima
leapnav bank build --family mazes:maze --count 200 --out maze.bank      # in the directory of this file
leapnav train dagger --family mazes:maze --out runs/maze
"""

from dataclasses import dataclass

import numpy as np
import tyro

from leapnav.envs import Obstacle, Polygon, ScenarioLayout, register_family, sample_scenario
from leapnav.experts import find_optimum


def maze(rng: np.random.Generator) -> ScenarioLayout:
    """A maze of 6 x 6 to 8 x 8 cells of 2 m: a random spanning tree, and 1/8 of the other openings."""
    n, size = int(rng.integers(6, 9)), 2.0
    # closed[axis][i, j]: wall between the cells (i, j) and (i + 1, j), or (i, j) and (i, j + 1)
    closed = [np.ones((n - 1, n), dtype=bool), np.ones((n, n - 1), dtype=bool)]
    visited, stack = {(0, 0)}, [(0, 0)]
    while stack:
        i, j = stack[int(rng.integers(len(stack)))]  # a random cell of the tree: short dead ends
        free = [cell for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if min(cell) >= 0 and max(cell) < n]
        free = [cell for cell in free if cell not in visited]
        if not free:
            stack.remove((i, j))
            continue
        k, m = free[int(rng.integers(len(free)))]
        closed[0 if k != i else 1][min(i, k), min(j, m)] = False
        visited.add((k, m))
        stack.append((k, m))
    closed = [walls & (rng.random(walls.shape) >= 1 / 8) for walls in closed]
    found = []
    for axis, walls in enumerate((closed[0], closed[1].T)):
        for line, row in enumerate(walls):
            across = size * (line + 1)
            for first, last in runs(row):
                ends = max(0.0, size * first - 0.1), min(size * n, size * last + 0.1)
                box = (across - 0.1, ends[0], across + 0.1, ends[1])
                found.append(rectangle(*(box if axis == 0 else (box[1], box[0], box[3], box[2]))))
    return ScenarioLayout(found, arena=(0.0, 0.0, size * n, size * n))


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the first index and the last index + 1 of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def corridors(rng: np.random.Generator) -> ScenarioLayout:
    """Blocks between 4 or 5 corridors in each direction (0.9 to 1.5 m wide), of whose sections 1/6 are closed; 16 m."""
    size = 16.0
    columns, rows = (divide(rng, int(rng.integers(4, 6)), size) for _ in range(2))
    found = [rectangle(x[0], y[0], x[1], y[1]) for x in columns.blocks for y in rows.blocks]
    for x in columns.corridors:
        for y in rows.blocks:
            if rng.random() < 1 / 6:
                at = rng.uniform(y[0], y[1] - 0.2)
                found.append(rectangle(x[0], at, x[1], at + 0.2))
    for y in rows.corridors:
        for x in columns.blocks:
            if rng.random() < 1 / 6:
                at = rng.uniform(x[0], x[1] - 0.2)
                found.append(rectangle(at, y[0], at + 0.2, y[1]))
    return ScenarioLayout(found, arena=(0.0, 0.0, size, size))


@dataclass(frozen=True)
class Cuts:
    """Intervals of the corridors and of the blocks between them along an axis."""

    corridors: list[tuple[float, float]]
    blocks: list[tuple[float, float]]


def divide(rng: np.random.Generator, count: int, size: float) -> Cuts:
    """Divide a length into `count` corridors, the first and the last along the walls, and the blocks between them."""
    widths = rng.uniform(0.9, 1.5, count)
    shares = rng.uniform(0.5, 1.5, count - 1)
    lengths = np.empty(2 * count - 1)
    lengths[0::2], lengths[1::2] = widths, (size - widths.sum()) * shares / shares.sum()
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    intervals = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
    return Cuts(intervals[0::2], intervals[1::2])


def rectangle(x_min: float, y_min: float, x_max: float, y_max: float) -> Obstacle:
    """Return a rectangle."""
    corners = np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]).round(4)
    return Obstacle(polygon=Polygon(vertices=tuple(map(tuple, corners.tolist()))))


def main(count: int = 3) -> None:
    """Find the optima of some scenarios.

    Args:
        count: Number of scenarios of each family.

    """
    for sample in (maze, corridors):
        register_family(sample.__name__, sample)
        for seed in range(count):
            scenario = sample_scenario(sample.__name__, seed)
            optimum = find_optimum(scenario)
            outcome = "certified" if optimum.success else optimum.message
            print(f"{scenario.name}: {outcome}, horizon {scenario.horizon:.1f} s, J = {optimum.cost:.4f}")


if __name__ == "__main__":
    tyro.cli(main)
