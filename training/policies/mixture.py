"""Mixtures of actions, of which a policy chooses one (mixture density networks).

Where a small displacement decides on which side the expert passes an obstacle, or whether it drives forwards or
backwards, the expert's actions for similar observations form several groups. A network with one action learns a value
between the groups: the robot drives into the obstacle, or it stops. A mixture density network has several actions with
weights, and the policy takes the mode of their density.

Reference: C. M. Bishop, "Mixture density networks" (Aston University, 1994), with a loss in place of the squared error.
"""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from torch import nn

# Standard deviation of the density of each component, in units of an action. In 4,096 scenarios of clutter, 0.1, 0.2,
# 0.3, 0.5 and 0.8 gave a symmetric policy with lidar 98.6, 98.8, 98.9, 98.9 and 98.8 % success; the component of the
# highest weight alone 98.6 %, and a network with one action that was fitted to the same samples 98.0 %.
BANDWIDTH = 0.3
# Loss at which a component has 1/e of the likelihood of one without loss; the loss of the mean action is 1. After half
# of the epochs, 0.03 and 0.1 gave 97.6 and 98.4 % success in these scenarios.
TEMPERATURE = 0.1
INITIAL_SPREAD = 0.5  # largest initial action of the components, which learn nothing different if they are equal


class Mixture(NamedTuple):
    """Components of a mixture.

    Attributes:
        actions (B, k, m): actions of the components.
        log_weights (B, k): logarithms of their weights.

    """

    actions: th.Tensor
    log_weights: th.Tensor

    @classmethod
    def from_output(cls, output: th.Tensor, components: int) -> Mixture:
        """Return the mixture of the output (B, k (m + 1)) of a network; of one component, (B, m) are the actions."""
        if components == 1:
            return cls(output[:, None], th.zeros_like(output[:, :1]))
        logits, actions = output[:, :components], output[:, components:]
        return cls(actions.unflatten(1, (components, -1)), logits.log_softmax(dim=1))

    def mode(self) -> th.Tensor:
        """Return the actions (B, m) of the highest density.

        The density is a sum of normal distributions around the components. Its mode is found by one step of the mean
        shift from the component at which it is highest. Reference: D. Comaniciu and P. Meer, "Mean shift: a robust
        approach toward feature space analysis" (IEEE TPAMI 24, 2002).
        """
        if self.actions.shape[1] == 1:
            return self.actions[:, 0]
        # The density at the component of the largest weight is at least that weight, so that it is not 0.
        squares = (self.actions[:, :, None] - self.actions[:, None]).square().sum(dim=3)
        densities = (self.log_weights[:, None] - squares / (2 * BANDWIDTH**2)).exp()  # at each, from each
        highest = densities.sum(dim=2).argmax(dim=1)[:, None, None]
        weights = densities.gather(1, highest.expand(-1, 1, densities.shape[2]))  # (B, 1, k)
        return ((weights @ self.actions) / weights.sum(dim=2, keepdim=True))[:, 0]

    def loss(self, losses: th.Tensor) -> th.Tensor:
        """Return the losses (B,) of the mixture for those of its components (B, k), relative to the mean action's.

        The loss is the negative logarithm of the likelihood in units of the temperature. With one component it is the
        loss of that.
        """
        if losses.shape[1] == 1:
            return losses[:, 0]
        return -TEMPERATURE * (self.log_weights - losses / TEMPERATURE).logsumexp(dim=1)

    def responsibilities(self, losses: th.Tensor) -> th.Tensor:
        """Return the probabilities (B, k) with which each component explains an action with these losses (B, k)."""
        return (self.log_weights - losses / TEMPERATURE).softmax(dim=1)


class MixtureDistribution(DiagGaussianDistribution):
    """The normal distribution of Stable-Baselines3 with a network whose output is that of a mixture.

    Args:
        action_dim: number of the actions' components.
        components: number of components of the mixture, at least 2.

    """

    def __init__(self, action_dim: int, components: int) -> None:
        super().__init__(action_dim)
        self._components = components

    def proba_distribution_net(self, latent_dim: int, log_std_init: float = 0.0) -> tuple[nn.Module, nn.Parameter]:
        """Return the last layer, and the logarithm of the standard deviation of the action that is chosen."""
        _, log_std = super().proba_distribution_net(latent_dim, log_std_init)
        return nn.Linear(latent_dim, self._components * (self.action_dim + 1)), log_std

    def spread(self, layer: nn.Linear) -> None:
        """Initialise the actions of the components with different values."""
        nn.init.uniform_(layer.bias[self._components :], -INITIAL_SPREAD, INITIAL_SPREAD)
