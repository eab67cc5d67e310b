"""A family of one's own: caves, made by a cellular automaton, in a larger arena than most built-in families.

A family is a function of a random generator. It returns a layout, for which leapnav samples poses and the horizon, or
a whole scenario.

python examples/caves.py                                                # some scenarios and their optima
leapnav bank build --family caves:caves --count 200 --out caves.bank    # in the directory of this file
leapnav train dagger --family caves:caves --out runs/caves
"""

import numpy as np
import tyro
from scipy.ndimage import uniform_filter

from leapnav.envs import Obstacle, Polygon, ScenarioLayout, register_family, sample_scenario
from leapnav.envs.scenarios.maps import rectangle_vertices
from leapnav.experts import find_optimum

CELL, CELLS = 0.5, 32  # side of a cell (m), and number of cells per side
DENSITY, ROUNDS = 0.43, 4


def caves(rng: np.random.Generator) -> ScenarioLayout:
    """Caves of 16 m: in each round, a cell becomes rock if most of the 3 x 3 cells around it are."""
    rock = rng.random((CELLS, CELLS)) < DENSITY
    for _ in range(ROUNDS):
        rock = uniform_filter(rock.astype(float), 3, mode="constant", cval=1.0) > 0.5
    obstacles = [Obstacle(polygon=Polygon(vertices=part)) for part in rectangle_vertices(rock, CELL)]
    return ScenarioLayout(obstacles, arena=(0.0, 0.0, CELL * CELLS, CELL * CELLS))


def main(count: int = 3) -> None:
    """Find the optima of some scenarios.

    Args:
        count: Number of scenarios.

    """
    register_family("caves", caves)
    for seed in range(count):
        scenario = sample_scenario("caves", seed)
        optimum = find_optimum(scenario)
        outcome = "certified" if optimum.success else optimum.message
        print(f"{scenario.name}: {outcome}, horizon {scenario.horizon:.1f} s, J = {optimum.cost:.4f}")


if __name__ == "__main__":
    tyro.cli(main)
