"""Access to the actor of a Stable-Baselines3 policy, for all supported algorithms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.sac.policies import Actor
from torch import nn

from leapnav.envs.simulation.observations import OFFSETS
from leapnav.training.policies.mixture import Mixture
from leapnav.training.policies.navigation_policy import MomentumActor, components_of, network_mixture
from leapnav.training.policies.network import NavigationFeatures


def policy_of(model: BaseAlgorithm | BasePolicy) -> BasePolicy:
    """Return the policy of an algorithm, or the policy itself.

    Raises:
        TypeError: `model` is neither of the two, or the policy has no actor with continuous actions.
        ValueError: `VecNormalize` normalises the observations of the model; its statistics are no part of the policy.

    """
    if isinstance(model, BaseAlgorithm):
        statistics = model.get_vec_normalize_env()
        if statistics is not None and statistics.norm_obs:
            raise ValueError(
                "model: its observations are normalised by VecNormalize, whose statistics are no part of the policy; "
                "use VecNormalize with norm_obs=False and policy_kwargs=network(), which scales the observations"
            )
    policy = model.policy if isinstance(model, BaseAlgorithm) else model
    if not isinstance(policy, BasePolicy):
        raise TypeError(f"model: expected one of Stable-Baselines3 or its policy, got {type(model).__name__}")
    if not isinstance(policy, ActorCriticPolicy) and not isinstance(getattr(policy, "actor", None), BasePolicy):
        raise TypeError(f"model: expected a policy with an actor, got {type(policy).__name__}")
    return policy


def _actor(policy: BasePolicy) -> Any:
    """Return the actor of an off-policy algorithm; `BasePolicy` does not declare it."""
    return policy.actor


def actor_parameters(policy: BasePolicy) -> list[nn.Parameter]:
    """Return the parameters of the actor: of an on-policy algorithm those of the mean action, without the noise."""
    if isinstance(policy, ActorCriticPolicy):
        modules = policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net
        return [parameter for module in modules for parameter in module.parameters()]
    return list(_actor(policy).parameters())


def action_range(space: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half width (m,), float32, of an action space, or 0 and 1 if it has no bounds."""
    if not np.isfinite(space.low).all() or not np.isfinite(space.high).all():
        return np.zeros(space.shape, np.float32), np.ones(space.shape, np.float32)
    return (space.high + space.low) / np.float32(2), (space.high - space.low) / np.float32(2)


def parts_of_dict(space: spaces.Dict) -> dict[str, int]:
    """Return the sizes of the parts of an observation in a Dict, in the order of the observation in one vector.

    Raises:
        ValueError: the Dict is not that of `dict_observation=True`, but for example that of `NavigateGoalEnv`.

    """
    sizes = {name: spaces.flatdim(space[name]) for name in OFFSETS.names or () if name in space.spaces}
    if set(sizes) != set(space.spaces) or "goal" not in sizes:
        names = ", ".join(space.spaces)
        raise ValueError(f"model: expected the parts of an observation of dict_observation=True, got {names}")
    return sizes


def as_observation(policy: BasePolicy, rows: Any) -> Any:
    """Return observations (B, d) in one vector as those of a policy, which may be a Dict of the parts."""
    space = policy.observation_space
    if not isinstance(space, spaces.Dict) or isinstance(rows, Mapping):
        return rows
    sizes = parts_of_dict(space)
    return dict(zip(sizes, rows.split(list(sizes.values()), dim=1), strict=True))


def mean_action(policy: BasePolicy, observations: th.Tensor) -> th.Tensor:
    """Compute the actions (B, m) of a policy's network; of a mixture, its mode.

    Arguments and units are those of `action_mixture`.
    """
    return action_mixture(policy, observations).mode()


def action_mixture(policy: BasePolicy, observations: th.Tensor) -> Mixture:
    """Compute the mixture of a policy's network, without momentum and symmetries, not clipped, with gradients.

    The actions are in units of [-1, 1] also if the bounds of the policy's action space are others, as with Gymnasium's
    `RescaleAction`. A policy without a mixture has one component.

    Args:
        policy: the policy.
        observations: (B, d), or a dictionary of their parts.

    """
    observations = as_observation(policy, observations)
    if isinstance(policy, ActorCriticPolicy):
        actions, log_weights = network_mixture(policy, observations)
        middle, half = (th.as_tensor(part, device=actions.device) for part in action_range(policy.action_space))
        return Mixture((actions - middle) / half, log_weights)
    actor = _actor(policy)
    if isinstance(actor, MomentumActor):
        actions = th.tanh(Actor.get_action_dist_params(actor, cast(Any, observations))[0])
    elif hasattr(actor, "get_action_dist_params"):  # SAC and TQC squash a Gaussian
        actions = th.tanh(actor.get_action_dist_params(observations)[0])
    else:
        actions = actor(observations)
    return Mixture.from_output(actions, 1)


def set_noise(policy: BasePolicy, std: th.Tensor | float) -> None:
    """Set the standard deviation, (m,) or a number, of a stochastic policy's actions for all observations."""
    std = th.as_tensor(std)
    with th.no_grad():
        if isinstance(policy, ActorCriticPolicy):
            half = th.as_tensor(action_range(policy.action_space)[1], device=std.device)
            policy.log_std.copy_((std * half).log())
        elif isinstance(getattr(_actor(policy), "log_std", None), nn.Linear):
            # This is the standard deviation before squashing, almost the same for actions close to 0.
            _actor(policy).log_std.weight.zero_()
            _actor(policy).log_std.bias.copy_(std.log())


def copy_actor(source: BasePolicy, target: BasePolicy) -> None:
    """Copy the weights of the mean action between policies with the same network, without momentum and symmetries.

    If the observation of the target has a part `motion` and that of the source has none, the weights of its features
    are 0, so that the actions do not depend on it yet.

    Raises:
        ValueError: the networks differ otherwise, or only one of the policies squashes its actions.

    """
    if isinstance(source, ActorCriticPolicy) != isinstance(target, ActorCriticPolicy):
        raise ValueError(
            f"policy: expected the same squashing of the actions, got a {type(source).__name__} for a "
            f"{type(target).__name__}; start from demonstrations instead"
        )
    if (found := components_of(source)) != (expected := components_of(target)):
        raise ValueError(
            f"policy: its network has {found} components, that of the model {expected}; give --components {found}, or "
            f"create the model with the class NavigationPolicy and policy_kwargs={{**network(), 'components': {found}}}"
        )
    tensors = _actor_tensors(source), _actor_tensors(target)
    extractors = [_extractor(policy) for policy in (source, target)]
    if all(isinstance(extractor, NavigationFeatures) for extractor in extractors):
        tensors[0][0] = _with_motion(tensors[0][0], tensors[1][0], *cast(Any, extractors))
    if [t.shape for t in tensors[0]] != [t.shape for t in tensors[1]]:
        inputs, widths = zip(*(_sizes(of_one) for of_one in tensors), strict=True)
        name, (found, expected) = ("features", inputs) if inputs[0] != inputs[1] else ("hidden", widths)
        raise ValueError(
            f"policy: its network has {name} {found}, that of the model {expected}; give the settings of the policy "
            "(--hidden, --observation, --lidar-beams)"
        )
    with th.no_grad():
        for a, b in zip(*tensors, strict=True):
            b.copy_(a)
    update_target(target)


def _extractor(policy: BasePolicy) -> nn.Module:
    """Return the features extractor of the mean action."""
    if isinstance(policy, ActorCriticPolicy):
        return cast(nn.Module, policy.pi_features_extractor)
    return _actor(policy).features_extractor


def _with_motion(
    weights: th.Tensor, expected: th.Tensor, source: NavigationFeatures, target: NavigationFeatures
) -> th.Tensor:
    """Return the weights of a first layer with columns of zeros for the features of the motion, if only these miss."""
    missing = expected.shape[1] - weights.shape[1]
    first = source.motion_features.start
    if len(source.motion_features) or missing != len(target.motion_features) or first != target.motion_features.start:
        return weights
    return th.cat([weights[:, :first], weights.new_zeros(len(weights), missing), weights[:, first:]], dim=1)


def update_target(policy: BasePolicy) -> None:
    """Copy the weights of the actor to the target actor, if the algorithm has one."""
    target: Any = getattr(policy, "actor_target", None)
    if target is not None:
        target.load_state_dict(_actor(policy).state_dict())


def _actor_tensors(policy: BasePolicy) -> list[th.Tensor]:
    """Return the weights between the observation and the mean action, in order."""
    if isinstance(policy, ActorCriticPolicy):
        return [p.data for p in actor_parameters(policy)]
    noise = getattr(_actor(policy), "log_std", None)
    skipped = {id(p) for p in noise.parameters()} if isinstance(noise, nn.Module) else set()
    return [p.data for p in _actor(policy).parameters() if id(p) not in skipped]


def _sizes(tensors: list[th.Tensor]) -> tuple[int, tuple[int, ...]]:
    """Return the number of inputs of a network, and the widths of its hidden layers."""
    matrices = [tensor for tensor in tensors if tensor.ndim == 2]
    return matrices[0].shape[1], tuple(len(matrix) for matrix in matrices[:-1])
