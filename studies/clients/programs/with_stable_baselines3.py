"""Stable-Baselines3: PPO with VecNormalize, PPO and HER with observations in dictionaries."""

import gymnasium as gym
from common import ID, one_scenario, report, return_of
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

STEPS = 256

if __name__ == "__main__":
    arguments = one_scenario()
    envs = VecNormalize(make_vec_env(ID, 2, env_kwargs=arguments), norm_reward=False)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, seed=0).learn(STEPS)
    envs.training = False
    report("PPO with `VecNormalize`", evaluate_policy(model, envs, 1, warn=False)[0], return_of(model))

    env = gym.make(ID, **arguments, dict_observation=True)
    model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, seed=0).learn(STEPS)
    report("PPO, `dict_observation=True`", evaluate_policy(model, env, 1, warn=False)[0], return_of(model))

    env = gym.make("leapnav/NavigateGoal-v0", **arguments, reward="cost")
    replay = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"copy_info_dict": True}}
    model = SAC("MultiInputPolicy", env, **replay, learning_starts=210, seed=0)
    model.learn(STEPS)
    report("SAC with HER on `NavigateGoal-v0`", evaluate_policy(model, env, 1, warn=False)[0], return_of(model))
