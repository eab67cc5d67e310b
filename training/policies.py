"""The network that learns to navigate, as a Stable-Baselines3 policy, and its files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

import leapnav
from leapnav.envs.observations import GOAL_ENTRIES

FORMAT = 1
HIDDEN = (256, 256, 256)
ROBOT_RADIUS = 0.25  # m, the scale on which a near obstacle matters


class NavigationFeatures(BaseFeaturesExtractor):
    """The observation on the scales that matter: far and near the goal, far and near an obstacle.

    The last decimetre decides over success, and a lidar range of 0.3 m differs from one of 0.5 m more than 5 m from
    10 m do; raw metres and seconds hide both from a small network.
    """

    # Columns of `_features` that do not depend on the number of beams, and lidar encodings per beam.
    POSE_FEATURES, BEAM_FEATURES = 23, 3

    def __init__(self, observation_space: spaces.Box) -> None:
        beams = observation_space.shape[0] - GOAL_ENTRIES
        super().__init__(observation_space, self.POSE_FEATURES + self.BEAM_FEATURES * beams)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Features (B, features_dim) of observations (B, d)."""
        goal, time = observations[:, 0:2], observations[:, 4:5]
        distance = goal.norm(dim=1, keepdim=True)
        facing = observations[:, 2:4]  # cosine and sine of the heading error
        error = th.atan2(observations[:, 3:4], observations[:, 2:3])
        bearing = th.atan2(goal[:, 1:2], goal[:, 0:1])
        needed, needed_turn = observations[:, 5:8], observations[:, 8:9]
        ranges = observations[:, GOAL_ENTRIES:]
        return th.cat(
            [
                goal / 5,
                distance / 5,
                facing,
                time / 10,
                needed.clamp(-3, 3),
                (needed_turn / 2).clamp(-3, 3),
                th.tanh(needed[:, :2]),
                goal / (distance + 0.1),
                th.log(distance + 0.05),
                th.log(time + 0.05),
                th.exp(-time),
                th.tanh(goal / 0.3),
                th.tanh(error / 0.3),
                error,
                # Zero where one circular arc ends in the goal pose: its chord halves the turn.
                th.cos(error - 2 * bearing),
                th.sin(error - 2 * bearing),
                ranges / 5,
                th.exp(-(ranges - ROBOT_RADIUS) / 0.3),
                ROBOT_RADIUS / ranges.clamp(min=0.1),
            ],
            dim=1,
        )


def make_policy(observation_space: spaces.Space, action_space: spaces.Space, seed: int = 0) -> ActorCriticPolicy:
    """A freshly initialised actor-critic for `leapnav/Navigate-v0`, which PPO and A2C can go on training.

    Raises:
        ValueError: the spaces are not the environment's.

    """
    box = isinstance(observation_space, spaces.Box) and observation_space.shape[0] > GOAL_ENTRIES
    if not box or not isinstance(action_space, spaces.Box):
        raise ValueError(f"observation_space: expected one of leapnav/Navigate-v0, got {observation_space}")
    with th.random.fork_rng(devices=[]):  # the caller's generator stays as it is
        th.manual_seed(seed)
        return ActorCriticPolicy(
            observation_space,
            action_space,
            lr_schedule=lambda _: 3e-4,
            net_arch={"pi": list(HIDDEN), "vf": list(HIDDEN)},
            activation_fn=nn.ReLU,
            log_std_init=-2.0,
            features_extractor_class=NavigationFeatures,
        )


def save_policy(policy: ActorCriticPolicy, folder: str | Path, environment: dict[str, Any]) -> None:
    """Writes `policy.json` (what it is) and `weights.pt` (tensors only) into a folder.

    Args:
        environment: the arguments of `gym.make` that the policy was trained for.

    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    assert isinstance(policy.observation_space, spaces.Box)
    th.save(policy.state_dict(), folder / "weights.pt")
    description = {
        "format": FORMAT,
        "leapnav": leapnav.__version__,
        "environment": environment,
        "observation_low": policy.observation_space.low.tolist(),
        "observation_high": policy.observation_space.high.tolist(),
    }
    (folder / "policy.json").write_text(json.dumps(description, indent=1) + "\n")


def load_policy(folder: str | Path, env: gym.Env | None = None) -> ActorCriticPolicy:
    """Reads a policy that `save_policy` wrote. Nothing of the file is executed.

    Args:
        env: if given, the environment that the policy is to drive; its spaces must be the policy's.

    Raises:
        FileNotFoundError: the folder holds no policy.
        ValueError: the files are broken, of another format or for another observation; the message says which.

    """
    folder = Path(folder)
    try:
        description = json.loads((folder / "policy.json").read_text())
        low, high = (np.array(description[key], np.float32) for key in ("observation_low", "observation_high"))
        found = description["format"]
    except (ValueError, KeyError, TypeError) as error:  # ValueError: syntax, encoding, numbers
        raise ValueError(f"{folder / 'policy.json'}: not a policy's description: {error!r}") from None
    if found != FORMAT:
        raise ValueError(f"{folder / 'policy.json'}: format: expected {FORMAT}, got {found!r}")
    observation_space = spaces.Box(low, high, dtype=np.float32)
    if env is not None and env.observation_space != observation_space:
        raise ValueError(
            f"{folder}: the policy observes {len(low)} numbers with other bounds than the environment's "
            f"{env.observation_space.shape}; make the environment with the arguments in policy.json"
        )
    policy = make_policy(observation_space, spaces.Box(-1.0, 1.0, (2,), np.float32))
    try:
        policy.load_state_dict(th.load(folder / "weights.pt", weights_only=True, map_location="cpu"))
    except FileNotFoundError:
        raise
    except Exception as error:  # torch raises many kinds for a broken file
        raise ValueError(f"{folder / 'weights.pt'}: not this policy's weights: {str(error).splitlines()[0]}") from None
    policy.set_training_mode(False)
    return policy
