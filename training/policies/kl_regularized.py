"""Actor-critic policy with a KL penalty towards a reference policy and less exploration near the horizon."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch as th
from gymnasium.spaces import Box
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from torch import nn
from torch.distributions import Normal, kl_divergence

from leapnav.envs.simulation.observations import TIME_LEFT, parts_of
from leapnav.training.policies.momentum import MomentumPolicy

# Fraction of the action noise that remains at the horizon. Without any noise the likelihoods would be infinite.
MIN_NOISE_FRACTION = 0.3


class KLRegularizedPolicy(MomentumPolicy):
    """An actor-critic policy whose loss includes the KL divergence from a reference policy.

    The reference policy is a frozen copy of the actor, made by `set_reference`. PPO and A2C subtract `ent_coef` times
    the entropy returned by `evaluate_actions` from their loss. This policy returns
    `entropy_weight * entropy - divergence_weight * KL(policy || reference)` instead, so use `ent_coef=1`. Both weights
    may be changed at any time, for example by a callback.

    Args:
        args, kwargs: arguments of `MomentumPolicy`.
        entropy_weight: weight of the entropy.
        divergence_weight: weight of the KL divergence.
        quiet: time before the horizon at which the standard deviation of the actions starts to decrease (s). It is
            proportional to the remaining time from then on, but not below 30 %; 0: it does not decrease. An error
            shortly before the horizon cannot be corrected, and would hide the effect of earlier actions on the return.
            Not used with a free horizon.

    Attributes:
        divergence: mean KL divergence of the last batch.

    """

    def __init__(
        self,
        *args: Any,
        entropy_weight: float = 0.0,
        divergence_weight: float = 0.0,
        quiet: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.quiet = quiet
        # Factor (B, 1) of the standard deviation for the current batch: the base class builds the distribution from the
        # latent features alone, which do not contain the remaining time.
        self._noise_fraction: th.Tensor | float = 1.0
        super().__init__(*args, **kwargs)
        self._is_timed = parts_of(cast(Box, self.observation_space))["goal"].stop > TIME_LEFT
        self.entropy_weight, self.divergence_weight = entropy_weight, divergence_weight
        self.divergence = 0.0
        # The reference is part of the policy, so that checkpoints contain it, but is not optimised.
        self.reference_actor = copy.deepcopy(self._actor_modules()).requires_grad_(False)
        self.register_buffer("reference_log_std", self.log_std.detach().clone())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("entropy_weight", "divergence_weight", "quiet")}
        return {**super()._get_constructor_parameters(), **own}

    def _actor_modules(self) -> nn.ModuleList:
        return nn.ModuleList([self.pi_features_extractor, self.mlp_extractor.policy_net, self.action_net])

    def set_reference(self) -> None:
        """Make a copy of the current actor the reference policy."""
        self.reference_actor.load_state_dict(self._actor_modules().state_dict())
        cast(th.Tensor, self.reference_log_std).copy_(self.log_std.detach())

    def forward(self, obs: Any, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return actions, values and log-likelihoods."""
        self._noise_fraction = self._fraction_of_noise(obs)
        return super().forward(obs, deterministic)

    def get_distribution(self, obs: Any) -> Distribution:
        """Return the distribution of the actions."""
        self._noise_fraction = self._fraction_of_noise(obs)
        return super().get_distribution(obs)

    def _fraction_of_noise(self, observations: th.Tensor) -> th.Tensor | float:
        if self.quiet == 0 or not self._is_timed:
            return 1.0
        return (observations[:, TIME_LEFT, None] / self.quiet).clamp(MIN_NOISE_FRACTION, 1.0)

    def _reduced(self, log_std: th.Tensor) -> th.Tensor:
        """Apply the noise fraction of the current batch to the logarithm of a standard deviation."""
        return log_std + self._noise_fraction.log() if isinstance(self._noise_fraction, th.Tensor) else log_std

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        distribution = cast(DiagGaussianDistribution, self.action_dist)
        return distribution.proba_distribution(self.action_net(latent_pi), self._reduced(self.log_std))

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log-likelihoods of the actions, and the weighted sum of entropy and divergence."""
        self._noise_fraction = self._fraction_of_noise(obs)
        values, log_likelihood, entropy = super().evaluate_actions(obs, actions)
        assert entropy is not None  # a diagonal Gaussian has a closed form
        total = self.entropy_weight * entropy
        if self.divergence_weight > 0:
            divergence = self._divergence(obs)
            self.divergence = float(divergence.detach().mean())
            total = total - self.divergence_weight * divergence
        return values, log_likelihood, total

    def _divergence(self, observations: th.Tensor) -> th.Tensor:
        """KL(policy || reference) (B,) of the action distributions."""
        own = cast(Normal, self.get_distribution(observations).distribution)
        features, latent, action_net = self.reference_actor
        with th.no_grad():
            mean = action_net(latent(features(observations)))
        std = self._reduced(cast(th.Tensor, self.reference_log_std)).exp()
        return kl_divergence(own, Normal(mean, std.expand_as(mean))).sum(dim=1)
