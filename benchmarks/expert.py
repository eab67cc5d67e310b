"""The expert in closed loop: time of an action, success and regret by family and setting, and batches of robots."""

import statistics
import time
from typing import Literal, get_args

import numpy as np
from tqdm.auto import tqdm

from leapnav.envs import NavigateEnv, NavigateVectorEnv, ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import ExpertPolicy

Feedback = Literal["resolve", "gains"]

EPISODES, TIMED_EPISODES, ROBOTS, ROUNDS = 10, 6, 256, 25
SETTINGS = [
    ("ideal", {}),
    ("10 % actuation noise", {"disturbance": {"actuation": 0.1}}),
    ("motor", {"actuation": "motor"}),
]


def measure_time(family: str, feedback: Feedback) -> tuple[float, float, float]:
    """Median and 99th percentile of the time of an action, and the median of the first in an episode (ms)."""
    env = NavigateEnv(family, split="test", observation="state")
    expert = ExpertPolicy(env, feedback=feedback, workers=1)
    first, later = [], []
    for index in range(TIMED_EPISODES):
        observation, _ = env.reset(seed=index, options={"index": index})
        terminated = False
        while not terminated:
            start = time.perf_counter()
            action, _ = expert.predict(observation)
            (first if env.time == 0.0 else later).append(1e3 * (time.perf_counter() - start))
            observation, _, terminated, _, _ = env.step(action)
    return statistics.median(later), float(np.quantile(later, 0.99)), statistics.median(first)


def measure_success(family: str, settings: dict) -> tuple[int, float]:
    """Number of successes and median regret on the first test scenarios."""
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
    """Time of the actions of all robots (ms), as a batch and in a loop over single environments."""
    arguments = {"family": "clutter", "split": "test", "observation": "state"}
    venv = NavigateVectorEnv(ROBOTS, **arguments)
    envs = [NavigateEnv(**arguments) for _ in range(ROBOTS)]
    expert, experts = ExpertPolicy(venv), [ExpertPolicy(env) for env in envs]
    observations, _ = venv.reset(seed=0)
    for i, env in enumerate(envs):
        env.reset(seed=i)
    batched, looped = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        actions, _ = expert.predict(observations)
        middle = time.perf_counter()
        single = [one.predict(observations[0])[0] for one in experts]
        end = time.perf_counter()
        assert np.array_equal(actions, single)
        observations, *_ = venv.step(actions)
        for env, action in zip(envs, single, strict=True):
            env.step(action)
        batched.append(1e3 * (middle - start))
        looped.append(1e3 * (end - middle))
    return statistics.median(batched[1:]), statistics.median(looped[1:])  # the first step searches for the optima


def main() -> None:
    batched, looped = measure_batch()
    ratio = looped / batched
    print(f"{ROBOTS} robots: {batched:.1f} ms as a batch, {looped:.1f} ms in a loop, ratio {ratio:.2f} (target 1.5)\n")
    print(f"{'':10}{'feedback':>10}{'median ms':>12}{'99 % ms':>10}{'first ms':>10}   (targets 2 and 30)")
    for family in ALL_FAMILIES:
        for feedback in get_args(Feedback):
            median, slow, first = measure_time(family, feedback)
            print(f"{family:10}{feedback:>10}{median:12.3f}{slow:10.2f}{first:10.1f}")
    print(f"\n{f'successes of {EPISODES}, median regret':32}" + "".join(f"{name:>24}" for name, _ in SETTINGS))
    for family in ALL_FAMILIES:
        cells = [measure_success(family, settings) for _, settings in tqdm(SETTINGS, desc=family, leave=False)]
        print(f"{family:32}" + "".join(f"{f'{success}, {100 * regret:.3f} %':>24}" for success, regret in cells))


if __name__ == "__main__":
    main()
