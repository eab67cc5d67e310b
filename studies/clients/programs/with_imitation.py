"""imitation: behaviour cloning from the demonstrations, and its own rollouts."""

import gymnasium as gym
import numpy as np
from common import ID, one_scenario, report, return_of
from imitation.algorithms.bc import BC
from imitation.data.rollout import make_sample_until, rollout, rollout_stats
from imitation.data.types import TrajectoryWithRew
from imitation.data.wrappers import RolloutInfoWrapper
from stable_baselines3.common.vec_env import DummyVecEnv

from leapnav.experts import rollout as demonstrate
from leapnav.experts.data.datasets import open_dataset

if __name__ == "__main__":
    arguments = one_scenario()
    demonstrate("open", 20, "demonstrations", seed=2, progress=False)
    trajectories = [
        TrajectoryWithRew(episode.observations, episode.actions, None, True, episode.rewards)
        for episode in open_dataset("demonstrations")
    ]
    env = gym.make(ID, **arguments)
    rng = np.random.default_rng(0)
    learner = BC(
        observation_space=env.observation_space,
        action_space=env.action_space,
        demonstrations=trajectories,
        rng=rng,
    )
    learner.train(n_epochs=5, progress_bar=False)
    envs = DummyVecEnv([lambda: RolloutInfoWrapper(env)])
    enough = make_sample_until(min_episodes=1)
    played = rollout(learner.policy, envs, enough, rng=rng, deterministic_policy=True)
    report("`BC` from demonstrations, `rollout`", rollout_stats(played)["return_mean"], return_of(learner.policy))
