"""Moving obstacles: steps of the vector environment compared with obstacles at rest, and time and yield of the search.

The environments alternate in one process, so that other load affects both; the results are medians.

python benchmarks/moving.py            # 1,024 robots with 20 discs each; 25 scenarios of each family
"""

import statistics
from time import perf_counter

import numpy as np

from leapnav.envs import Circle, NavigateVectorEnv, Obstacle, Scenario, sample_scenario
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS
from leapnav.experts import find_optimum

ROBOTS, DISCS, ROUNDS, STEPS = 1024, 20, 7, 60
SCENARIOS, FIRST_SEED = 25, 500_000
EFFORTS = "high", "medium"


def scene(moving: bool) -> Scenario:
    """A scenario with discs at a distance from the robot, which move at right angles to its direction, or stand."""
    rng = np.random.default_rng(0)
    obstacles = []
    for _ in range(DISCS):
        angle, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.1, 0.3)
        center = tuple(np.array([10.0, 10.0]) + rng.uniform(4.0, 8.0) * np.array([np.cos(angle), np.sin(angle)]))
        velocity = (-speed * np.sin(angle), speed * np.cos(angle)) if moving else None
        obstacles.append(Obstacle(circle=Circle(center=center, radius=0.3), velocity=velocity))
    return Scenario(arena=(0, 0, 20, 20), start=(9, 10, 0), goal=(11, 10, 0), horizon=20, obstacles=tuple(obstacles))


def step_times(observation: str) -> tuple[float, float]:
    """Median time (us) of a step of one robot with obstacles at rest, and with moving ones."""
    actions = np.tile(np.array([0.05, 0.0], np.float32), (ROBOTS, 1))
    venvs = [NavigateVectorEnv(ROBOTS, scenario=scene(moving), observation=observation) for moving in (False, True)]
    found: list[list[float]] = [[], []]
    for venv in venvs:
        venv.reset(seed=0)
    for _ in range(ROUNDS):
        for venv, times in zip(venvs, found, strict=True):
            start = perf_counter()
            for _ in range(STEPS):
                venv.step(actions)
            times.append(1e6 * (perf_counter() - start) / STEPS / ROBOTS)
    at_rest, moving = map(statistics.median, found)
    return at_rest, moving


def main() -> None:
    """Print both."""
    for observation in ("state", "lidar", "map", "geodesic"):
        at_rest, moving = step_times(observation)
        ratio = at_rest / moving
        print(f"{observation:9} step of a robot: at rest {at_rest:.2f} us, moving {moving:.2f} us, rate {ratio:.2f}")
    for family in MOVING_LAYOUTS:
        scenarios = [sample_scenario(family, FIRST_SEED + k) for k in range(SCENARIOS)]
        for effort in EFFORTS:
            times, certified, doubtful = [], 0, 0
            for scenario in scenarios:
                start = perf_counter()
                optimum = find_optimum(scenario, effort)
                times.append(perf_counter() - start)
                certified += optimum.success
                doubtful += bool(optimum.doubts)
            print(
                f"{family:9} {effort:7} certified {certified} of {SCENARIOS}, doubtful {doubtful}, "
                f"median {1e3 * statistics.median(times):.0f} ms"
            )


if __name__ == "__main__":
    main()
