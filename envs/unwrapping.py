"""Access to leapnav's environments inside the wrappers of Gymnasium and of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.vector import NavigateVectorEnv


def unwrap(env: Any) -> list[NavigateEnv | NavigateVectorEnv]:
    """Return the leapnav environments inside an environment.

    Args:
        env: `NavigateEnv` or `NavigateVectorEnv`, wrapped or not, or a Stable-Baselines3 `VecEnv` of them.

    Returns:
        One environment, or one for each environment that a `VecEnv` contains.

    Raises:
        TypeError: the environment is not one of leapnav's.

    """
    while hasattr(env, "venv"):  # the `VecEnv` wrappers of Stable-Baselines3, and leapnav's own adapter
        env = env.venv
    env = getattr(env, "unwrapped", env)
    inner = [getattr(one, "unwrapped", one) for one in getattr(env, "envs", [env])]
    for one in inner:
        if not isinstance(one, (NavigateEnv, NavigateVectorEnv)):
            raise TypeError(f"env: expected an environment of leapnav, got {type(one).__name__}")
    return inner
