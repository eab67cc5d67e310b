"""Steps per second of leapnav/Navigate-v0 with lidar, beside Gymnasium's Pendulum-v1, in the same process.

The two take turns, so that what else the machine does hits both; the figures are medians.
"""

import statistics
import time

import gymnasium as gym
import numpy as np

import leapnav  # noqa: F401

ROUNDS, STEPS = 15, 3000


def rate(env: gym.Env, seed: int) -> float:
    """Steps per second over STEPS steps, resets left out."""
    actions = 0.1 * np.random.default_rng(seed).normal(size=(STEPS, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=seed)
    spent = 0.0
    for action in actions:
        start = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(action)
        spent += time.perf_counter() - start
        if terminated or truncated:
            env.reset()
    return STEPS / spent


def main() -> None:
    ours, peer = gym.make("leapnav/Navigate-v0", family="clutter"), gym.make("Pendulum-v1")
    rate(ours, 0), rate(peer, 0)  # compiled, cached, warm
    rates = [(rate(ours, seed), rate(peer, seed)) for seed in range(ROUNDS)]
    navigate, pendulum = (statistics.median(column) for column in zip(*rates, strict=True))
    ratio = statistics.median(a / b for a, b in rates)
    print(f"leapnav/Navigate-v0, 32 lidar beams   {navigate:10,.0f} steps/s")
    print(f"Pendulum-v1                           {pendulum:10,.0f} steps/s")
    print(f"ratio                                 {ratio:10.2f}")


if __name__ == "__main__":
    main()
