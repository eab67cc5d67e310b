"""Gymnasium: the vector environments in one process and in several, with the wrapper that records returns."""

from functools import partial

import gymnasium as gym
from common import ID, included, report
from gymnasium.wrappers.vector import RecordEpisodeStatistics

if __name__ == "__main__":
    arguments, act, expected = included()
    make = partial(gym.make, ID, **arguments)
    for name, build in {
        "`gym.make_vec`": partial(gym.make_vec, ID, 2, "vector_entry_point", **arguments),
        "`SyncVectorEnv`": partial(gym.vector.SyncVectorEnv, [make, make]),
        "`AsyncVectorEnv`": partial(gym.vector.AsyncVectorEnv, [make, make]),
    }.items():
        envs = RecordEpisodeStatistics(build())
        observations, _ = envs.reset(seed=0)
        while not envs.return_queue:
            observations, *_ = envs.step(act(observations))
        report(name, envs.return_queue[0], expected)
        envs.close()
