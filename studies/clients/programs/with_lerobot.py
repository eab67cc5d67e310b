"""LeRobot: demonstrations as a `LeRobotDataset`, and the replay of an episode of it."""

import gymnasium as gym
import numpy as np
from common import BANK, ID, one_scenario, report
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from leapnav.envs import ScenarioBank
from leapnav.experts import rollout
from leapnav.experts.data.datasets import open_dataset

if __name__ == "__main__":
    env = gym.make(ID, **one_scenario())
    rollout(ScenarioBank(BANK), 1, "demonstrations", progress=False)
    episodes = list(open_dataset("demonstrations"))
    sizes = {"observation.state": env.observation_space.shape, "action": env.action_space.shape}
    features = {name: {"dtype": "float32", "shape": shape, "names": None} for name, shape in sizes.items()}
    fps = round(1 / env.unwrapped.settings.control_period)
    converted = LeRobotDataset.create("leapnav/one", fps, features, "lerobot", use_videos=False)
    for episode in episodes:
        for observation, action in zip(episode.observations, episode.actions, strict=False):
            converted.add_frame({"observation.state": observation, "action": action, "task": "navigate"})
        converted.save_episode()
    converted.finalize()
    total = 0.0
    env.reset(seed=0)
    for frame in LeRobotDataset("leapnav/one", "lerobot", episodes=[0]):
        total += float(env.step(frame["action"].numpy())[1])
    report("demonstrations as a `LeRobotDataset`, replayed", total, float(np.sum(episodes[0].rewards)))
