"""Another installed version of leapnav compared with this one: times and costs of the same work, in the same run.

    python benchmarks/versions.py PYTHON [--rounds N] [--only TEXT]

PYTHON is the interpreter of an environment with the other version. Two processes, one per version, alternate, so that
other load affects both. Ratios are medians over the rounds; above 1, this version is slower. Only public functions that
both versions have are used.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

Method = Literal["multiple_shooting", "leapfrog", "collocation", "single_shooting"]
Feedback = Literal["resolve", "gains"]

ENV_ID = "leapnav/Navigate-v0"
FAMILIES = ("open", "clutter", "polygons", "rooms", "slalom")
ENVIRONMENTS: dict[str, tuple[int | None, dict[str, Any]]] = {
    "vector, state": (1024, {"observation": "state"}),
    "vector, 32 lidar beams": (1024, {}),
    "vector, map": (1024, {"observation": "map"}),
    "vector, state, shaped reward": (1024, {"observation": "state", "reward": "shaped"}),
    "vector, state, motors": (1024, {"observation": "state", "actuation": "motor"}),
    "vector, 32 lidar beams, disturbed": (1024, {"disturbance": 0.1}),
    "vector of 16, 32 lidar beams": (16, {}),
    "single, 32 lidar beams": (None, {}),
    "single, 32 lidar beams, motors": (None, {"actuation": "motor"}),
}
METHODS: tuple[Method, ...] = get_args(Method)
LAWS: tuple[Feedback, ...] = get_args(Feedback)
N_SCENARIOS, N_STEPS = 30, 40

Work = Callable[[], list[float]]  # returns costs, to be compared between the versions


def environment_steps(robots: int | None, arguments: dict[str, Any]) -> Work:
    """Environment steps with fixed actions."""
    import gymnasium as gym

    import leapnav  # noqa: F401

    env: Any
    if robots is None:
        env = gym.make(ENV_ID, family="clutter", **arguments)
    else:
        mode = "vector_entry_point"
        env = gym.make_vec(ENV_ID, num_envs=robots, vectorization_mode=mode, family="clutter", **arguments)
    steps = 50 * N_STEPS if robots is None else N_STEPS * max(1, 256 // robots)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def work() -> list[float]:
        env.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if robots is None and (terminated or truncated):
                env.reset()
        return []

    return work


def optima(family: str) -> Work:
    """Optima of the first scenarios of the test bank, from the scenarios alone."""
    from leapnav.envs import ScenarioBank
    from leapnav.experts import find_optimum

    scenarios = list(ScenarioBank.shipped(family, "test"))[:N_SCENARIOS]
    return lambda: [find_optimum(scenario).cost for scenario in scenarios]


def dense_optimum(shape: str) -> Work:
    """The optimum among 300 discs or 200 polygons."""
    from leapnav.envs import Scenario
    from leapnav.experts import find_optimum

    rng, obstacles = np.random.default_rng(1), []
    for _ in range(4000):
        x, y, size = *rng.uniform(1.5, 28.5, 2), rng.uniform(0.15, 0.35)
        if all(np.hypot(x - a, y - b) > 1.15 for a, b, _ in obstacles):
            obstacles.append((x, y, size))
    corners = 2 * np.pi * np.arange(5) / 5
    if shape == "polygons":
        shapes: list[dict[str, Any]] = [
            {"polygon": {"vertices": tuple((x + r * np.cos(a), y + r * np.sin(a)) for a in corners)}}
            for x, y, r in obstacles[:200]
        ]
    else:
        shapes = [{"circle": {"center": (x, y), "radius": r}} for x, y, r in obstacles[:300]]
    scenario = Scenario.model_validate(
        {"arena": (0, 0, 30, 30), "start": (0.7, 0.7, 0.8), "goal": (29.3, 29.3, 0.8), "horizon": 60}
        | {"obstacles": tuple(shapes)}
    )
    return lambda: [find_optimum(scenario).cost]


def solutions(method: Method) -> Work:
    """Extremals of clutter scenarios with one method, from the states of the bank's optimum."""
    from leapnav.envs import ScenarioBank
    from leapnav.experts import OptimalControlProblem, solve

    bank = ScenarioBank.shipped("clutter", "test")
    tasks = []
    for index in range(6 if method == "single_shooting" else N_SCENARIOS):
        problem = OptimalControlProblem.from_scenario(bank[index])
        states = np.array(bank.reference(index).states, dtype=float)
        assert problem.horizon is not None
        guess = type(problem.straight_line())(np.linspace(0.0, problem.horizon, len(states)), states)
        tasks.append((problem, guess))
    return lambda: [solve(problem, method=method, guess=guess).cost for problem, guess in tasks]


def feedback(family: str, law: Feedback) -> Work:
    """The expert's actions in three episodes, without the first action of each, which finds the optimum."""
    from leapnav.envs import NavigateEnv
    from leapnav.experts import ExpertPolicy

    env = NavigateEnv(family, split="test", observation="state")
    expert = ExpertPolicy(env, feedback=law, workers=1)

    def work() -> list[float]:
        for index in range(3):
            observation, _ = env.reset(seed=index, options={"index": index})
            terminated = False
            while not terminated:
                observation, _, terminated, _, _ = env.step(expert.predict(observation)[0])
        return []

    return work


def rows() -> dict[str, Callable[[], Work]]:
    """Functions that prepare the work of each row and return it, by the name of the row."""
    return {
        **{name: lambda given=given: environment_steps(*given) for name, given in ENVIRONMENTS.items()},
        **{f"find_optimum, {family}": lambda family=family: optima(family) for family in FAMILIES},
        **{f"find_optimum, dense {shape}": lambda shape=shape: dense_optimum(shape) for shape in ("discs", "polygons")},
        **{f"solve, {method}": lambda method=method: solutions(method) for method in METHODS},
        **{
            f"expert's episodes, {family}, {law}": lambda family=family, law=law: feedback(family, law)
            for family in ("clutter", "rooms")
            for law in LAWS
        },
    }


def serve() -> None:
    """The loop of one version's process: reads the name of a row, does the work once, writes time and costs."""
    prepared: dict[str, Work] = {}
    for line in sys.stdin:
        name = line.strip()
        if name not in prepared:
            prepared.clear()
            prepared[name] = rows()[name]()
            prepared[name]()  # compiles or loads the kernels
        start = time.perf_counter()
        costs = prepared[name]()
        print(json.dumps([time.perf_counter() - start, costs]), flush=True)


class Version:
    """A process with one version of leapnav."""

    def __init__(self, python: str) -> None:
        command = [python, str(Path(__file__).resolve()), "--serve"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd="/")

    def measure(self, row: str) -> tuple[float, list[float]]:
        """Seconds and costs of a row."""
        assert self.process.stdin is not None and self.process.stdout is not None
        print(row, file=self.process.stdin, flush=True)
        seconds, costs = json.loads(self.process.stdout.readline())
        return seconds, costs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("python", nargs="?", help="interpreter of an environment with the other version")
    parser.add_argument("--rounds", type=int, default=9, help="number of times that each row is measured")
    parser.add_argument("--only", default="", help="measure the rows whose names contain this text")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve()
        return
    if arguments.python is None:
        parser.error("PYTHON is missing")
    this, other = Version(sys.executable), Version(arguments.python)
    print(f"{'':36}{'this (ms)':>12}{'other (ms)':>12}{'ratio':>8}{'quartiles':>16}{'costs deviate by':>19}")
    for row in rows():
        if arguments.only not in row:
            continue
        seconds: dict[Version, list[float]] = {this: [], other: []}
        costs: dict[Version, list[float]] = {}
        for version in (this, other):
            version.measure(row)
        for i in range(arguments.rounds):
            for version in (this, other) if i % 2 == 0 else (other, this):
                duration, costs[version] = version.measure(row)
                seconds[version].append(duration)
        ratios = [a / b for a, b in zip(seconds[this], seconds[other], strict=True)]
        low, _, high = statistics.quantiles(ratios, n=4)
        times = [1e3 * statistics.median(seconds[version]) for version in (this, other)]
        pairs = list(zip(costs[this], costs[other], strict=True))
        deviation = f"{max(abs(a / b - 1) for a, b in pairs):.1e}" if pairs else ""
        ratio = statistics.median(ratios)
        print(
            f"{row:36}{times[0]:12.1f}{times[1]:12.1f}{ratio:8.3f}{f'{low:.3f} - {high:.3f}':>16}{deviation:>19}",
            flush=True,
        )


if __name__ == "__main__":
    main()
