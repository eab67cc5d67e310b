"""A policy that is held near another one and explores less near the goal: PPO's way on from a clone."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from leapnav.envs.observations import TIME_LEFT

LEAST_NOISE = 0.3  # share of the noise that is left at the horizon: with none the likelihoods would be infinite


class AnchoredPolicy(ActorCriticPolicy):
    """An actor-critic whose loss has a term for the divergence from a frozen copy of its actor, the anchor.

    PPO and A2C subtract `ent_coef` times what `evaluate_actions` returns as the entropy. This policy returns
    `entropy_weight * entropy - divergence_weight * KL(policy || anchor)` there, so use `ent_coef=1`. The weights may be
    changed at any time, `divergence_weight` by a callback that lets it fall to zero.

    Args:
        args, kwargs: of `ActorCriticPolicy`.
        entropy_weight: of the entropy.
        divergence_weight: of the divergence, in both cases 0 for none.
        quiet: s before the horizon from which on the noise of the actions fades, to a third: an error that is made
            there cannot be made good, and would hide from the learner what its actions are worth. 0: it does not fade.

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
        self._noise: th.Tensor | float = 1.0  # shares (B, 1) of the standard deviation, for the batch in hand
        super().__init__(*args, **kwargs)
        self.entropy_weight, self.divergence_weight = entropy_weight, divergence_weight
        self.divergence = 0.0  # mean KL of the last batch
        # A part of the policy, so that checkpoints have it; none of the optimiser's parameters.
        self.anchor = nn.ModuleList([self.pi_features_extractor, self.mlp_extractor.policy_net, self.action_net])
        self.anchor = copy.deepcopy(self.anchor).requires_grad_(False)
        self.register_buffer("anchor_log_std", self.log_std.detach().clone())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # What `save` keeps, so that `load` makes the same policy.
        own = {name: getattr(self, name) for name in ("entropy_weight", "divergence_weight", "quiet")}
        return {**super()._get_constructor_parameters(), **own}

    def drop_anchor(self) -> None:
        """Makes the actor as it is now the anchor."""
        own = nn.ModuleList([self.pi_features_extractor, self.mlp_extractor.policy_net, self.action_net])
        self.anchor.load_state_dict(own.state_dict())
        cast(th.Tensor, self.anchor_log_std).copy_(self.log_std.detach())

    def forward(self, obs: Any, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Actions, values and log-likelihoods."""
        self._noise = self._share(obs)
        return super().forward(obs, deterministic)

    def get_distribution(self, obs: Any) -> Distribution:
        """The distribution of the actions."""
        self._noise = self._share(obs)
        return super().get_distribution(obs)

    def _share(self, observations: th.Tensor) -> th.Tensor | float:
        if self.quiet == 0:
            return 1.0
        return (observations[:, TIME_LEFT, None] / self.quiet).clamp(LEAST_NOISE, 1.0)

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        mean, log_std = self.action_net(latent_pi), self.log_std
        if isinstance(self._noise, th.Tensor):
            log_std = log_std + self._noise.log()
        return cast(DiagGaussianDistribution, self.action_dist).proba_distribution(mean, log_std)

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Values, log-likelihoods of the actions, and the weighted sum of entropy and divergence."""
        self._noise = self._share(obs)
        values, log_likelihood, entropy = super().evaluate_actions(obs, actions)
        assert entropy is not None  # a diagonal Gaussian has one
        total = self.entropy_weight * entropy
        if self.divergence_weight > 0:
            divergence = self._divergence(obs)
            self.divergence = float(divergence.detach().mean())
            total = total - self.divergence_weight * divergence
        return values, log_likelihood, total

    def _divergence(self, observations: th.Tensor) -> th.Tensor:
        """KL(policy || anchor) (B,) of diagonal Gaussians."""
        features, latent, action = self.anchor
        with th.no_grad():
            center = action(latent(features(observations)))
        mean = self.action_net(
            self.mlp_extractor.forward_actor(
                cast(th.Tensor, self.extract_features(observations, self.pi_features_extractor))
            )
        )
        log_std = cast(th.Tensor, self.anchor_log_std)
        variance_ratio = (2 * (self.log_std - log_std)).exp()
        distance = ((mean - center) / self._noise).square() * (-2 * log_std).exp()
        return 0.5 * (variance_ratio + distance - 1 - 2 * (self.log_std - log_std)).sum(dim=1)
