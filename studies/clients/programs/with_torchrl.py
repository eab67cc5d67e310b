"""TorchRL: `GymEnv` in one process and in several, `GymWrapper` of the vector environment."""

import gymnasium as gym
import torch
from common import ID, included, report
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv, GymWrapper

import leapnav  # the processes of `GymEnv(num_envs=2)` import this module

assert leapnav

if __name__ == "__main__":
    arguments, act, expected = included()
    policy = TensorDictModule(
        lambda observation: torch.as_tensor(act(observation.numpy())), ["observation"], ["action"]
    )
    vector = gym.make_vec(ID, 2, "vector_entry_point", autoreset_mode="SameStep", **arguments)
    for name, env in {
        "`GymEnv`": GymEnv(ID, **arguments),
        "`GymEnv(num_envs=2)`": GymEnv(ID, num_envs=2, **arguments),
        "`GymWrapper(gym.make_vec(...))`": GymWrapper(vector),
    }.items():
        episode = env.rollout(1000, policy)  # ends with the first episode
        rewards = episode["next", "reward"].squeeze(-1)
        report(name, (rewards if rewards.ndim == 1 else rewards[0]).sum().item(), expected)
        env.close()
