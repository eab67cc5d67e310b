"""Actor-critic policy with less exploration near the horizon."""

from __future__ import annotations

from typing import Any, cast

import torch as th
from gymnasium.spaces import Box
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution

from leapnav.envs.simulation.observations import TIME_LEFT, parts_of
from leapnav.training.policies.momentum import MomentumPolicy

# Fraction of the action noise that remains at the horizon. Without any noise the likelihoods would be infinite.
MIN_NOISE_FRACTION = 0.3


class TimedNoisePolicy(MomentumPolicy):
    """An actor-critic policy whose actions have less noise near the horizon.

    Args:
        args, kwargs: arguments of `MomentumPolicy`.
        quiet: time before the horizon at which the standard deviation of the actions starts to decrease (s). It is
            proportional to the remaining time from then on, but not below 30 %; 0: it does not decrease. An error
            shortly before the horizon cannot be corrected, and would hide the effect of earlier actions on the return.
            Not used with a free horizon.

    """

    def __init__(self, *args: Any, quiet: float = 0.0, **kwargs: Any) -> None:
        self.quiet = quiet
        # Factor (B, 1) of the standard deviation for the current batch: the base class builds the distribution from the
        # latent features alone, which do not contain the remaining time.
        self._noise_fraction: th.Tensor | float = 1.0
        super().__init__(*args, **kwargs)
        self._is_timed = parts_of(cast(Box, self.observation_space))["goal"].stop > TIME_LEFT

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "quiet": self.quiet}

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

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        fraction, log_std = self._noise_fraction, self.log_std
        reduced = log_std + fraction.log() if isinstance(fraction, th.Tensor) else log_std
        return cast(DiagGaussianDistribution, self.action_dist).proba_distribution(self.action_net(latent_pi), reduced)

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log-likelihoods of the actions, and the entropy."""
        self._noise_fraction = self._fraction_of_noise(obs)
        return super().evaluate_actions(obs, actions)
