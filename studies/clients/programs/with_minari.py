"""Minari: an episode that `DataCollector` records, and the replay of its actions."""

import gymnasium as gym
from common import ID, included, report
from minari import DataCollector

if __name__ == "__main__":
    arguments, act, expected = included()
    env = DataCollector(gym.make(ID, **arguments), record_infos=True)
    observation, _ = env.reset(seed=0)
    ended = False
    while not ended:
        observation, _, terminated, truncated, _ = env.step(act(observation))
        ended = terminated or truncated
    dataset = env.create_dataset("leapnav/included-v0")
    (episode,) = dataset.iterate_episodes()
    report("`DataCollector`", episode.rewards.sum(), expected)
    replayed, total = dataset.recover_environment(), 0.0
    replayed.reset(seed=0)
    for action in episode.actions:
        total += float(replayed.step(action)[1])
    report("`recover_environment`, replayed", total, expected)
