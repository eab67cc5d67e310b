"""Policies of Stable-Baselines3 for the environment: mixtures, momentum, less noise near the horizon, and symmetries.

With a free horizon and without drift, an optimal action a has an effort of at least a known size, sum(w a^2) >= 1. The
action of a network that averages two paths of similar cost is smaller, and because neither the last action nor the time
is an input of the network, the robot would stay there. With momentum, the missing effort is added in the direction of
the last action, which the observation contains with `previous_action=True`. The network does not depend on it: fitted
to demonstrations, it would repeat the last action.

The actions of a network that was fitted to a symmetric task are symmetric only approximately. The mean over all
symmetries is symmetric, see `leapnav.training.policies.symmetries.Symmetrised`. A mixture has several actions, of which
the policy takes one, see `leapnav.training.policies.mixture`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import torch as th
from gymnasium.spaces import Box
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from leapnav.envs.simulation.observations import TIME_LEFT, parts_of
from leapnav.envs.utils.validation import check_integer
from leapnav.training.policies.mixture import Mixture, MixtureDistribution
from leapnav.training.policies.symmetries import Symmetrised, Transformation

# Fraction of the action noise that remains at the horizon. Without any noise the likelihoods would be infinite.
MIN_NOISE_FRACTION = 0.3
# Weight of the last action, per missing unit of the norm. In 500 scenarios of clutter, weights of 0, 1/2, 1, 2 and 4
# gave a policy 96.4, 98.2, 98.4, 99.2 and 98.8 % success.
MOMENTUM = 2.0
MIN_NORM = 1e-6  # of an action that is scaled
MAX_SQUASHED = 1.0 - 1e-6  # absolute value of an action whose inverse hyperbolic tangent is taken


def add_momentum(actions: th.Tensor, previous: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """Return actions (B, m) whose effort is that of an optimal action at least.

    Args:
        actions: (B, m), of the network.
        previous: (B, m), the last actions, 0 at the start of an episode.
        weights: (m,), see `leapnav.training.effort`.

    """

    def norms(values: th.Tensor) -> th.Tensor:
        return (weights * values.square()).sum(dim=-1, keepdim=True).clamp(min=MIN_NORM**2).sqrt()

    norm = norms(actions)
    moved = actions + MOMENTUM * (1.0 - norm).clamp(min=0.0) * previous
    return th.where(norm < 1.0, moved / norms(moved).clamp(max=1.0), actions)


class _Momentum:
    """The momentum of a policy for observations with the part `action`.

    Args:
        space: the observation space.
        weights: see `leapnav.training.effort`.

    Raises:
        ValueError: the observations do not contain the last action.

    """

    def __init__(self, space: Any, weights: Sequence[float]) -> None:
        part = parts_of(space).get("action")
        if part is None:
            raise ValueError("effort_weights: expected None for observations without the last action, got numbers")
        self._part, self._weights = part, tuple(map(float, weights))

    def __call__(self, actions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """Return actions (B, m) with momentum."""
        return add_momentum(actions, observations[:, self._part], actions.new_tensor(self._weights))


def network_mixture(policy: ActorCriticPolicy, observations: Any) -> Mixture:
    """Return the mixture of the network of a policy, without what `NavigationPolicy` adds."""
    features = cast(th.Tensor, policy.extract_features(observations, policy.pi_features_extractor))
    return Mixture.from_output(policy.action_net(policy.mlp_extractor.forward_actor(features)), components_of(policy))


class NavigationPolicy(ActorCriticPolicy):
    """An actor-critic policy with a mixture, momentum, less noise near the horizon, and symmetric actions.

    Args:
        args, kwargs: arguments of `ActorCriticPolicy`.
        effort_weights: see `leapnav.training.effort`; None: no momentum.
        quiet: time before the horizon at which the standard deviation of the actions starts to decrease (s). It is
            proportional to the remaining time from then on, but not below 30 %; 0: it does not decrease. An error
            shortly before the horizon cannot be corrected, and would hide the effect of earlier actions on the return.
            Not used with a free horizon.
        symmetries: transformations of observations and actions under which the actions are equivariant, see
            `leapnav.training.policies.symmetries`.
        components: number of components of the mixture, see `leapnav.training.policies.mixture`.

    Raises:
        ValueError: symmetries or a mixture for actions with other bounds than -1 and 1, symmetries of other
            observations, or `components` is not an integer of at least 1.

    """

    def __init__(
        self,
        *args: Any,
        effort_weights: Sequence[float] | None = None,
        quiet: float = 0.0,
        symmetries: Sequence[Any] = (),
        components: int = 1,
        **kwargs: Any,
    ) -> None:
        check_integer("components", components, 1)
        self.effort_weights = None if effort_weights is None else tuple(map(float, effort_weights))
        self.quiet = quiet
        self.symmetries = tuple(Transformation(tuple(one), tuple(map(tuple, two))) for one, two in symmetries)
        self.components = components
        self._symmetrised = Symmetrised(self.symmetries) if symmetries else None
        # The current batch: the base class makes the distribution from the latent features alone.
        self._batch: th.Tensor | None = None
        super().__init__(*args, **kwargs)
        space = cast(Box, self.observation_space)
        self._momentum = None if self.effort_weights is None else _Momentum(space, self.effort_weights)
        self._is_quiet = quiet > 0 and parts_of(space)["goal"].stop > TIME_LEFT
        actions = cast(Box, self.action_space)
        for name, is_set in (("symmetries", bool(symmetries)), ("components", components > 1)):
            if is_set and not ((actions.low == -1).all() and (actions.high == 1).all()):
                raise ValueError(f"{name}: expected none for actions with other bounds than -1 and 1, got {actions}")
        shape, expected = self.observation_space.shape, [(len(one.observation),) for one in self.symmetries]
        if any(shape != one for one in expected):
            raise ValueError(f"symmetries: expected those of observations of shape {shape}, got {expected[0]}")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"effort_weights": self.effort_weights, "quiet": self.quiet, "symmetries": self.symmetries}
        return {**super()._get_constructor_parameters(), **own, "components": self.components}

    def _build(self, lr_schedule: Any) -> None:
        if self.components > 1:
            self.action_dist = MixtureDistribution(cast(Box, self.action_space).shape[0], self.components)
        super()._build(lr_schedule)
        if isinstance(self.action_dist, MixtureDistribution):
            self.action_dist.spread(cast(nn.Linear, self.action_net))

    def forward(self, obs: Any, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return actions, values and log-likelihoods."""
        self._batch = obs
        return super().forward(obs, deterministic)

    def get_distribution(self, obs: Any) -> Distribution:
        """Return the distribution of the actions."""
        self._batch = obs
        return super().get_distribution(obs)

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log-likelihoods of the actions, and the entropy."""
        self._batch = obs
        return super().evaluate_actions(obs, actions)

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        log_std, batch = self.log_std, self._batch
        assert batch is not None  # set by the methods above
        self._batch = None
        if self._symmetrised is None:
            mean = Mixture.from_output(self.action_net(latent_pi), self.components).mode()
        else:
            mean = self._symmetrised(partial(network_mixture, self), batch)
        if self._momentum is not None:
            mean = self._momentum(mean, batch)
        if self._is_quiet:
            log_std = log_std + (batch[:, TIME_LEFT, None] / self.quiet).clamp(MIN_NOISE_FRACTION, 1.0).log()
        return cast(DiagGaussianDistribution, self.action_dist).proba_distribution(mean, log_std)


class MomentumActor(Actor):
    """The actor of SAC with momentum: the arguments of `Actor`, and `effort_weights`."""

    def __init__(self, observation_space: Any, *args: Any, effort_weights: Sequence[float], **kwargs: Any) -> None:
        super().__init__(observation_space, *args, **kwargs)
        self._momentum = _Momentum(observation_space, effort_weights)

    def get_action_dist_params(self, obs: Any) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Return the mean and the logarithm of the standard deviation of the actions before they are squashed."""
        mean, log_std, further = super().get_action_dist_params(obs)
        moved = self._momentum(th.tanh(mean), obs).clamp(-MAX_SQUASHED, MAX_SQUASHED)
        return th.atanh(moved), log_std, further


class MomentumSACPolicy(SACPolicy):
    """A policy of SAC with momentum: the arguments of `SACPolicy`, and `effort_weights`."""

    def __init__(self, *args: Any, effort_weights: Sequence[float], **kwargs: Any) -> None:
        self.effort_weights = tuple(map(float, effort_weights))
        super().__init__(*args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "effort_weights": self.effort_weights}

    def make_actor(self, features_extractor: Any = None) -> Actor:
        """Return a new actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return MomentumActor(**arguments, effort_weights=self.effort_weights).to(self.device)


def has_momentum(policy: Any) -> bool:
    """Return whether the actions of a policy contain momentum."""
    return getattr(policy, "effort_weights", None) is not None


def deterministic_action(policy: Any, network: Callable[[th.Tensor], Mixture], observations: th.Tensor) -> th.Tensor:
    """Return the deterministic actions (B, m) of a policy with the given network, clipped."""
    transformations = symmetries_of(policy)
    mean = Symmetrised(transformations)(network, observations) if transformations else network(observations).mode()
    if has_momentum(policy):
        mean = _Momentum(policy.observation_space, policy.effort_weights)(mean, observations)
    return mean.clamp(-1.0, 1.0)


def symmetries_of(policy: Any) -> tuple[Transformation, ...]:
    """Return the transformations under which the actions of a policy are equivariant; empty without."""
    return getattr(policy, "symmetries", ())


def components_of(policy: Any) -> int:
    """Return the number of components of the mixture of a policy; 1 without."""
    return getattr(policy, "components", 1)
