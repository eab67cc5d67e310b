"""Policies with memory: of earlier observations (frame stacking).

What the lidar does not show now may have been visible before: the other side of a wall, or the way from which the robot
has come. A policy with memory carries it in the `state` of `predict`, as the recurrent policies of sb3-contrib do.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

MEMORIES = ("none", "stack")
# Ages of the earlier observations in the input of a network with stacked frames (control periods), newest first: 0.4,
# 1.2 and 2.8 s at the default control period of 0.05 s.
LAGS = (8, 24, 56)


def history_length(policy: BasePolicy) -> int:
    """Return the number of earlier observations on which the action of a policy can depend."""
    return max(LAGS) if isinstance(policy, FrameStackPolicy) else 0


def memory_of(policy: BasePolicy) -> str:
    """Return the kind of the memory of a policy, one of `MEMORIES`."""
    return "stack" if isinstance(policy, FrameStackPolicy) else "none"


class StackedFeatures(BaseFeaturesExtractor):
    """The features of several observations, and the displacements between them.

    Args:
        observation_space: the space of stacked observations (k d,), newest first.
        extractor: class of the features extractor of one observation.

    """

    DISPLACEMENT_FEATURES = 4

    def __init__(self, observation_space: spaces.Box, extractor: type[BaseFeaturesExtractor]) -> None:
        self._frames = len(LAGS) + 1
        width = observation_space.shape[0] // self._frames
        space = spaces.Box(observation_space.low[:width], observation_space.high[:width], dtype=np.float32)
        features: Any = extractor(space)
        super().__init__(
            observation_space, self._frames * features.features_dim + len(LAGS) * self.DISPLACEMENT_FEATURES
        )
        self.features = features

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features (B, features_dim) of stacked observations (B, k d)."""
        frames = observations.unflatten(1, (self._frames, -1))
        features = self.features(frames.flatten(0, 1)).unflatten(0, (-1, self._frames))
        return th.cat([features.flatten(1), _displacements(frames)], dim=1)


def _displacements(frames: th.Tensor) -> th.Tensor:
    """Return the earlier poses relative to the current one, from the goal as it was seen: (B, 4 (k - 1)).

    The goal pose is the same in all frames, so the poses of the robot follow from it. For each earlier frame: position
    (x and y in units of 2 m), and the sine and the cosine (minus 1) of its heading.

    Args:
        frames: (B, k, d), newest first.

    """
    goals, headings = frames[:, :, 0:2], frames[:, :, 2:4]  # the headings of the goal minus those of the robot
    cosine = (headings[:, :1] * headings[:, 1:]).sum(dim=2)
    sine = headings[:, :1, 1] * headings[:, 1:, 0] - headings[:, :1, 0] * headings[:, 1:, 1]
    # A vector of an earlier frame, rotated by the current error minus the earlier one, is one of the current frame.
    x = goals[:, :1, 0] - (cosine * goals[:, 1:, 0] - sine * goals[:, 1:, 1])
    y = goals[:, :1, 1] - (sine * goals[:, 1:, 0] + cosine * goals[:, 1:, 1])
    return th.cat([x / 2, y / 2, sine, cosine - 1.0], dim=1)


class FrameStackPolicy(ActorCriticPolicy):
    """An actor-critic policy of the current observation and of those 0.4, 1.2 and 2.8 s before (`LAGS`).

    The modules of the policy take stacked observations (B, k d), newest first; `predict` takes the observations of the
    environment, and its state contains the earlier ones. Before the first observation of an episode, the first one is
    used.

    Args:
        observation_space: the space of one observation, (d,).
        action_space: the action space.
        lr_schedule: learning rate as a function of the progress, see `ActorCriticPolicy`.
        features_extractor_class: class of the features extractor of one observation.
        kwargs: further arguments of `ActorCriticPolicy`.

    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Space,
        lr_schedule: Any,
        *,
        features_extractor_class: type[BaseFeaturesExtractor],
        **kwargs: Any,
    ) -> None:
        low, high = (np.tile(side, len(LAGS) + 1) for side in (observation_space.low, observation_space.high))
        self.frame_extractor_class = features_extractor_class
        super().__init__(
            spaces.Box(low, high, dtype=np.float32),
            action_space,
            lr_schedule,
            features_extractor_class=StackedFeatures,
            features_extractor_kwargs={"extractor": features_extractor_class},
            **kwargs,
        )
        self.observation_space = observation_space

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # The base class adds its own arguments, of which this class determines the extractor's.
        parameters = super()._get_constructor_parameters()
        del parameters["features_extractor_kwargs"]
        return {**parameters, "features_extractor_class": self.frame_extractor_class}

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for an observation or a batch of them, and the state for the next call.

        Args:
            observation: observations (d,) or (N, d).
            state: the state that the last call returned; None at the start of an episode.
            episode_start: (N,), bool, the episodes that start with these observations.
            deterministic: whether to return the mean action.

        """
        self.set_training_mode(False)
        tensor, is_batch = self.obs_to_tensor(observation)
        current = cast(th.Tensor, tensor).cpu().numpy()[:, None]
        history = np.repeat(current, max(LAGS), axis=1) if state is None else state[0]
        if episode_start is not None:
            starts = np.asarray(episode_start, dtype=bool).reshape(-1, 1, 1)
            history = np.where(starts, current, history)
        with th.no_grad():
            actions = self._predict(th.as_tensor(stack_frames(current, history)), deterministic).cpu().numpy()
        actions = np.clip(actions.reshape(-1, *self.action_space.shape), -1.0, 1.0)  # type: ignore[misc]
        return actions if is_batch else actions[0], (next_history(current, history),)


def stack_frames(current: Any, history: Any) -> Any:
    """Return the input (N, k d) of the network for the current observations (N, 1, d) and the history (N, H, d)."""
    concatenate = th.cat if isinstance(current, th.Tensor) else np.concatenate
    return concatenate([current[:, 0], *(history[:, -lag] for lag in LAGS)], 1)


def next_history(current: Any, history: Any) -> Any:
    """Return the history (N, H, d), oldest first, with the current observations (N, 1, d)."""
    concatenate = th.cat if isinstance(current, th.Tensor) else np.concatenate
    return concatenate([history[:, 1:], current], 1)
