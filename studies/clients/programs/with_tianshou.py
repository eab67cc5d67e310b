"""Tianshou: a policy and the collector on its vector environment."""

from typing import Any

import gymnasium as gym
from common import ID, included, report
from tianshou.data import Batch, Collector
from tianshou.env import DummyVectorEnv
from tianshou.policy import BasePolicy


class Included(BasePolicy):
    """The included policy."""

    def forward(self, batch: Batch, state: Any = None, **_: Any) -> Batch:
        """Return the actions."""
        return Batch(act=act(batch.obs), state=state)

    def learn(self, *_: Any, **__: Any) -> dict[str, Any]:
        """Learn nothing."""
        return {}


if __name__ == "__main__":
    arguments, act, expected = included()
    envs = DummyVectorEnv([lambda: gym.make(ID, **arguments) for _ in range(2)])
    found = Collector(Included(action_space=envs.action_space[0]), envs).collect(n_episode=2)
    report("`Collector` with `DummyVectorEnv`", found["rews"][0], expected)
