"""skrl: the wrappers of single and vector environments; its memories and trainers are not tried."""

import gymnasium as gym
import torch
from common import ID, included, report
from skrl.envs.wrappers.torch import wrap_env

if __name__ == "__main__":
    arguments, act, expected = included()
    for name, env in {
        "`wrap_env(gym.make(...))`": gym.make(ID, **arguments),
        "`wrap_env(gym.make_vec(...))`": gym.make_vec(ID, 2, "vector_entry_point", **arguments),
    }.items():
        wrapped, total = wrap_env(env), 0.0
        observations, _ = wrapped.reset()
        ended = torch.zeros(1, 1)
        while not ended[0]:
            actions = torch.as_tensor(act(observations.cpu().numpy()), device=wrapped.device)
            observations, rewards, terminated, truncated, _ = wrapped.step(actions)
            total, ended = total + rewards[0].item(), terminated | truncated
        report(name, total, expected)
