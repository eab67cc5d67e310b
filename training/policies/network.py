"""The network of the policies: features of an observation, and multi-layer perceptrons for the actor and the critic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from leapnav.envs.settings import CONTROL_PERIOD
from leapnav.envs.simulation.observations import FREE_GOAL_ENTRIES, TIME_LEFT, frame_size, parts_of
from leapnav.experts.data.datasets import ENVIRONMENT
from leapnav.training.policies.navigation_policy import NavigationPolicy
from leapnav.training.policies.symmetries import Transformation

HIDDEN = (256, 256, 256)  # default widths of the hidden layers
ROBOT_RADIUS = 0.25  # radius of the robots in all families (m); a range minus this is the clearance along a beam


class NavigationFeatures(BaseFeaturesExtractor):
    """Features of an observation on several length scales.

    Success depends on the last 0.1 m, and the difference between lidar ranges of 0.3 m and 0.5 m matters more than that
    between 5 m and 10 m. A small network does not resolve such differences in metres and seconds. The features
    therefore contain logarithms, saturated values and exponentials in addition to the scaled values. With a free
    horizon, the features that depend on the time left are missing.

    With a history, the features of all observations follow each other, and then the displacements between them. The
    last action is not a feature, see `leapnav.training.policies.navigation_policy`.
    """

    # Features of the goal part and of each entry of the motion part, with a fixed and with a free horizon
    POSE_FEATURES, FREE_POSE_FEATURES = 23, 14
    MOTION_FEATURES, FREE_MOTION_FEATURES = 7, 3
    BEAM_FEATURES = 3  # features of each lidar beam, and of each detour
    DISTANCE_FEATURES, FREE_DISTANCE_FEATURES = 5, 3  # features of the geodesic distance
    DISPLACEMENT_FEATURES = 4  # features of the displacement from each observation of the history

    def __init__(self, observation_space: spaces.Box) -> None:
        if not isinstance(observation_space, spaces.Box):
            raise ValueError(
                f"observation_space: expected a Box, got {type(observation_space).__name__}; use the environment with "
                "dict_observation=False"
            )
        parts = parts_of(observation_space)
        self._is_timed = parts["goal"].stop > TIME_LEFT
        self._motion, self._lidar = parts["motion"], parts["lidar"]
        self._detours, self._distance = parts.get("detours"), parts.get("distance")
        motion, beams = (part.stop - part.start for part in (self._motion, self._lidar))
        if self._is_timed:
            features = self.POSE_FEATURES + self.MOTION_FEATURES * motion
        else:
            features = self.FREE_POSE_FEATURES + self.FREE_MOTION_FEATURES * motion
        if self._distance is not None:
            features += self.DISTANCE_FEATURES if self._is_timed else self.FREE_DISTANCE_FEATURES
            beams *= 2  # the detours
        features += self.BEAM_FEATURES * beams
        self._velocities = parts.get("velocities")
        if self._velocities is not None:
            features += self._velocities.stop - self._velocities.start
        self._frames = observation_space.shape[0] // frame_size(observation_space)
        super().__init__(observation_space, self._frames * features + (self._frames - 1) * self.DISPLACEMENT_FEATURES)

    @property
    def motion_features(self) -> range:
        """Indices of the features of the part `motion`."""
        if self._is_timed:
            first, per_entry = self.POSE_FEATURES, self.MOTION_FEATURES
        else:
            first, per_entry = self.FREE_POSE_FEATURES, self.FREE_MOTION_FEATURES
        return range(first, first + per_entry * (self._motion.stop - self._motion.start))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features (B, features_dim) of observations (B, d)."""
        if self._frames == 1:
            return self._frame_features(observations)
        frames = observations.unflatten(1, (self._frames, -1))
        features = self._frame_features(frames.flatten(0, 1)).unflatten(0, (-1, self._frames))
        return th.cat([features.flatten(1), _displacements(frames)], dim=1)

    def _frame_features(self, observations: th.Tensor) -> th.Tensor:
        """Return the features of observations (B, d) without a history."""
        features = self._timed_features if self._is_timed else self._free_features
        parts = [*features(observations, observations[:, self._motion]), *_range_features(observations[:, self._lidar])]
        if self._detours is not None and self._distance is not None:
            parts += _detour_features(observations[:, self._detours])
            parts += self._distance_features(observations, observations[:, self._distance])
        if self._velocities is not None:
            parts.append(observations[:, self._velocities])
        return th.cat(parts, dim=1)

    def _distance_features(self, observations: th.Tensor, distance: th.Tensor) -> list[th.Tensor]:
        """Return the features of the geodesic distance (B, 1)."""
        around = distance - observations[:, 0:2].norm(dim=1, keepdim=True)
        parts = [distance / 10, th.log(distance + 0.05), around]
        if self._is_timed:
            needed_speed = distance / observations[:, 4:5].clamp(min=CONTROL_PERIOD)
            parts += [needed_speed.clamp(0, 3), th.tanh(needed_speed)]
        return parts

    def _free_features(self, observations: th.Tensor, motion: th.Tensor) -> list[th.Tensor]:
        """Return the features of the pose and of the motion with a free horizon."""
        goal, heading = observations[:, 0:2], observations[:, 2:4]
        distance = goal.norm(dim=1, keepdim=True)
        error = th.atan2(observations[:, 3:4], observations[:, 2:3])
        bearing = th.atan2(goal[:, 1:2], goal[:, 0:1])
        return [
            goal / 5,
            distance / 5,
            heading,
            goal / (distance + 0.1),
            th.log(distance + 0.05),
            th.tanh(goal / 0.3),
            th.tanh(error / 0.3),
            error,
            th.cos(error - 2 * bearing),  # see `_timed_features`
            th.sin(error - 2 * bearing),
            (motion / 2).clamp(-3, 3),
            th.tanh(motion / 0.3),
            th.tanh(motion / 0.05),
        ]

    def _timed_features(self, observations: th.Tensor, motion: th.Tensor) -> list[th.Tensor]:
        """Return the features of the pose and of the motion with a fixed horizon."""
        goal, time_left = observations[:, 0:2], observations[:, 4:5]
        if not th.compiler.is_compiling() and bool((time_left < 0.0).any()):
            raise ValueError(
                f"observation: time left: expected at least 0 s, got {float(time_left.min()):g}; the network scales "
                "the observations itself, so use VecNormalize with norm_obs=False"
            )
        distance = goal.norm(dim=1, keepdim=True)
        heading = observations[:, 2:4]  # cosine and sine of the heading error
        error = th.atan2(observations[:, 3:4], observations[:, 2:3])
        bearing = th.atan2(goal[:, 1:2], goal[:, 0:1])
        needed_speeds, needed_turn_rate = observations[:, 5:8], observations[:, 8:9]  # to arrive on time
        to_rest = _acceleration_to_rest(motion, th.cat([needed_speeds[:, :1], needed_turn_rate], dim=1), time_left)
        return [
            goal / 5,
            distance / 5,
            heading,
            time_left / 10,
            needed_speeds.clamp(-3, 3),
            (needed_turn_rate / 2).clamp(-3, 3),
            th.tanh(needed_speeds[:, :2]),
            goal / (distance + 0.1),
            th.log(distance + 0.05),
            th.log(time_left + 0.05),
            th.exp(-time_left),
            th.tanh(goal / 0.3),
            th.tanh(error / 0.3),
            error,
            # The angle is zero where a single circular arc reaches the goal pose: the chord of an arc has half its
            # change of heading.
            th.cos(error - 2 * bearing),
            th.sin(error - 2 * bearing),
            (motion / 2).clamp(-3, 3),
            th.tanh(motion / 0.3),
            th.tanh(motion / 0.05),
            (to_rest / 6).clamp(-3, 3),
            th.tanh(to_rest),
        ]


def _displacements(frames: th.Tensor) -> th.Tensor:
    """Return the earlier poses (B, 4 (k - 1)) of the robot in the frame of its current pose.

    They are computed from the goal pose relative to the robot, which each observation contains: the goal is the same in
    all of them. A pose is given by x and y in units of 2 m, the sine of the heading, and its cosine minus 1.

    Args:
        frames: (B, k, d), the current observation and the earlier ones, newest first.

    """
    goals, headings = frames[:, :, 0:2], frames[:, :, 2:4]  # the headings of the goal minus those of the robot
    cosine = (headings[:, :1] * headings[:, 1:]).sum(dim=2)
    sine = headings[:, :1, 1] * headings[:, 1:, 0] - headings[:, :1, 0] * headings[:, 1:, 1]
    # A vector of an earlier frame, rotated by the current error minus the earlier one, is one of the current frame.
    x = goals[:, :1, 0] - (cosine * goals[:, 1:, 0] - sine * goals[:, 1:, 1])
    y = goals[:, :1, 1] - (sine * goals[:, 1:, 0] + cosine * goals[:, 1:, 1])
    return th.cat([x / 2, y / 2, sine, cosine - 1.0], dim=1)


def _range_features(ranges: th.Tensor) -> list[th.Tensor]:
    """Return the features of the lidar ranges (B, beams)."""
    return [ranges / 5, th.exp(-(ranges - ROBOT_RADIUS) / 0.3), ROBOT_RADIUS / ranges.clamp(min=0.1)]


def _detour_features(detours: th.Tensor) -> list[th.Tensor]:
    """Return the features of the detours (B, beams)."""
    return [detours, th.exp(-detours / 0.5), th.exp(-detours / 0.1)]


def _acceleration_to_rest(rates: th.Tensor, needed: th.Tensor, time_left: th.Tensor) -> th.Tensor:
    """Return the accelerations with which double integrators arrive at rest, for each pair of a rate and a distance.

    The acceleration of least effort, the integral of its square, is linear in time (A. E. Bryson and Y.-C. Ho, Applied
    Optimal Control, 1975, section 5.2); the result is its mean over the next control period.

    Args:
        rates: (B, k), rates of change.
        needed: (B, 2), distances divided by the time left.
        time_left: (B, 1), time until the arrival (s).

    Returns:
        (B, 2k), accelerations.

    """
    time_left = time_left.clamp(min=CONTROL_PERIOD)
    elapsed = CONTROL_PERIOD / time_left  # fraction of the time left that the next control period takes
    rates, needed = rates.unsqueeze(2), needed.unsqueeze(1)
    elapsed, time_left = elapsed.unsqueeze(2), time_left.unsqueeze(2)
    return ((6 * (1 - elapsed) * needed - (4 - 3 * elapsed) * rates) / time_left).flatten(1)


def network(hidden: Sequence[int] = HIDDEN, critic: Sequence[int] | None = None) -> dict[str, Any]:
    """Return the `policy_kwargs` with which PPO, A2C, SAC or TQC uses the network of this module.

    Args:
        hidden: widths of the actor's hidden layers.
        critic: widths of the critic's hidden layers; None: those of the actor.

    """
    widths = list(hidden if critic is None else critic)
    return {
        "net_arch": {"pi": list(hidden), "vf": widths, "qf": widths},
        "activation_fn": nn.ReLU,
        "features_extractor_class": NavigationFeatures,
    }


def make_policy(
    observation_space: spaces.Space,
    action_space: spaces.Space,
    seed: int = 0,
    hidden: Sequence[int] = HIDDEN,
    critic: Sequence[int] | None = None,
    effort_weights: Sequence[float] | None = None,
    symmetries: Sequence[Transformation] = (),
    components: int = 1,
) -> ActorCriticPolicy:
    """Create an untrained actor-critic policy for `leapnav/Navigate-v0`, which PPO and A2C can train.

    Args:
        observation_space, action_space: spaces of the environment.
        seed: random seed of the weights; the global random generator is not changed.
        hidden: widths of the actor's hidden layers.
        critic: widths of the critic's hidden layers; None: those of the actor.
        effort_weights: weights of a policy with momentum, see `leapnav.training.policies.navigation_policy`; None:
            without.
        symmetries: transformations under which the actions are equivariant, see
            `leapnav.training.policies.symmetries`.
        components: number of components of the mixture, see `leapnav.training.policies.mixture`.

    Raises:
        ValueError: the spaces are not those of the environment with a lidar, the observations of a policy with
            momentum do not contain the last action, the symmetries are those of other observations, or `components` is
            less than 1.

    """
    check_spaces(observation_space, action_space)
    arguments = network(hidden, critic)
    kind: Any = ActorCriticPolicy
    if effort_weights is not None or symmetries or components != 1:
        kind = NavigationPolicy
        own = {"effort_weights": effort_weights, "symmetries": symmetries, "components": components}
        arguments = {**arguments, **own}
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        return kind(observation_space, action_space, lr_schedule=lambda _: 3e-4, log_std_init=-2.0, **arguments)


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Check that the spaces are those of `leapnav/Navigate-v0` with a lidar.

    Raises:
        ValueError: they are not.

    """
    shape = observation_space.shape if isinstance(observation_space, spaces.Box) else ()
    if not (len(shape) == 1 and shape[0] > FREE_GOAL_ENTRIES):
        got = f"a Box of shape {shape}" if shape else type(observation_space).__name__
        raise ValueError(f"observation_space: expected that of {ENVIRONMENT} with a lidar, got {got}")
    if not (isinstance(action_space, spaces.Box) and len(action_space.shape) == 1):
        raise ValueError(f"action_space: expected that of {ENVIRONMENT}, got {action_space}")
