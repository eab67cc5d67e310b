"""The expert in closed loop: time of a decision, success and regret by family and setting, and many robots at once."""

import statistics
import time

import numpy as np
from tqdm.auto import tqdm

from leapnav.envs import FAMILIES, NavigateEnv, NavigateVectorEnv, ScenarioBank
from leapnav.experts import ExpertPolicy

EPISODES, ROBOTS, ROUNDS = 100, 256, 25
SETTINGS = [
    ("ideal", {}),
    ("10 % actuation noise", {"disturbance": {"actuation": 0.1}}),
    ("motor", {"actuation": "motor"}),
]


def measure_time(family: str, feedback: str) -> tuple[float, float, float]:
    """Median and 99th percentile (ms) of a decision, and the median of an episode's first."""
    env = NavigateEnv(family, split="test", observation="state")
    expert = ExpertPolicy(env, feedback=feedback, workers=1)
    first, later = [], []
    for index in range(12):
        observation, _ = env.reset(seed=index, options={"index": index})
        terminated = False
        while not terminated:
            start = time.perf_counter()
            action, _ = expert.predict(observation)
            (first if env.time == 0.0 else later).append(1e3 * (time.perf_counter() - start))
            observation, _, terminated, _, _ = env.step(action)
    return statistics.median(later), float(np.quantile(later, 0.99)), statistics.median(first)


def measure_success(family: str, settings: dict) -> tuple[int, float]:
    """Successes and median regret over the first test scenarios."""
    bank = ScenarioBank.shipped(family, "test")
    venv = NavigateVectorEnv(EPISODES, bank=bank, observation="state", **settings)
    expert = ExpertPolicy(venv)
    observations, _ = venv.reset(seed=0, options={"index": list(range(EPISODES))})
    ended, success, cost = np.zeros(EPISODES, bool), np.zeros(EPISODES, bool), np.zeros(EPISODES)
    while not ended.all():
        observations, _, terminated, _, infos = venv.step(expert.predict(observations)[0])
        new = terminated & ~ended
        success[new], cost[new] = infos["is_success"][new], infos["cost"][new]
        ended |= terminated
    return int(success.sum()), float(np.median((cost / bank.costs[:EPISODES] - 1)[success]))


def measure_batch() -> tuple[float, float]:
    """Time (ms) of a decision for many robots, at once and in a loop over as many environments."""
    arguments = {"family": "clutter", "split": "test", "observation": "state"}
    venv = NavigateVectorEnv(ROBOTS, **arguments)
    envs = [NavigateEnv(**arguments) for _ in range(ROBOTS)]
    expert, experts = ExpertPolicy(venv), [ExpertPolicy(env) for env in envs]
    observations, _ = venv.reset(seed=0)
    for i, env in enumerate(envs):
        env.reset(seed=i)
    at_once, one_by_one = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        actions, _ = expert.predict(observations)
        middle = time.perf_counter()
        alone = [each.predict(observations[0])[0] for each in experts]
        end = time.perf_counter()
        assert np.array_equal(actions, alone)
        observations, *_ = venv.step(actions)
        for env, action in zip(envs, alone, strict=True):
            env.step(action)
        at_once.append(1e3 * (middle - start))
        one_by_one.append(1e3 * (end - middle))
    return statistics.median(at_once[1:]), statistics.median(one_by_one[1:])  # the first finds the references


def main() -> None:
    at_once, one_by_one = measure_batch()
    ratio = one_by_one / at_once
    print(f"{ROBOTS} robots: {at_once:.1f} ms at once, {one_by_one:.1f} ms in a loop, ratio {ratio:.2f} (bar 1.5)\n")
    print(f"{'':10}{'feedback':>10}{'median ms':>12}{'99 % ms':>10}{'first ms':>10}   (bars 2 and 30)")
    for family in FAMILIES:
        for feedback in ("resolve", "gains"):
            median, slow, first = measure_time(family, feedback)
            print(f"{family:10}{feedback:>10}{median:12.3f}{slow:10.2f}{first:10.1f}")
    print(f"\n{'success of ' + str(EPISODES) + ', median regret':32}" + "".join(f"{name:>24}" for name, _ in SETTINGS))
    for family in FAMILIES:
        cells = [measure_success(family, settings) for _, settings in tqdm(SETTINGS, desc=family, leave=False)]
        print(f"{family:32}" + "".join(f"{f'{success}, {100 * regret:.3f} %':>24}" for success, regret in cells))


if __name__ == "__main__":
    main()
