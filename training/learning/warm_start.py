"""Warm start: fit an algorithm's actor to the expert's actions, and its critic to the cost-to-go and the costate."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn
from torch.optim.lr_scheduler import LambdaLR

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import CONTROL_PERIOD
from leapnav.envs.simulation.observations import ObservationLayout
from leapnav.envs.simulation.observer import Observer
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_not_negative, check_positive
from leapnav.training.fit_settings import CloningConfig, WarmStartConfig
from leapnav.training.learning.cloning import (
    EpochLoss,
    behaviour_clone,
    check_observations,
    cosine_decay,
    samples_for,
)
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.samples import action_slopes
from leapnav.training.policies.actors import as_observation, copy_actor, policy_of
from leapnav.training.policies.navigation_policy import symmetries_of
from leapnav.training.threads import limit_threads

# Standard deviations (m, m, rad) of the random state offsets over which the slope of the cost-to-go is fitted: small
# compared with the curvature radius of the cost-to-go, large compared with the discontinuities of the lidar ranges.
STATE_OFFSET = 0.02
# Slopes above this multiple of the median are left out, because the costate grows without bound towards the horizon.
MAX_RELATIVE_SLOPE = 10.0
ACTION_NOISE = 0.5  # standard deviation of the actions around the expert's at which a Q function is fitted


@dataclass(frozen=True)
class WarmStart:
    """The result of a warm start.

    Attributes:
        cloning: losses of the clone, epoch by epoch; empty if the actor was not cloned.
        value_error: mean squared error of the critic's values in the last epoch, relative to their variance; NaN if the
            critic was not fitted.
        slope_error: the same for the slopes of the values; NaN if they were not fitted.

    """

    cloning: tuple[EpochLoss, ...]
    value_error: float
    slope_error: float


@limit_threads
def warm_start(
    model: BaseAlgorithm,
    dataset: Dataset | str | os.PathLike[str] | Sequence[Any],
    config: WarmStartConfig | None = None,
    *,
    cloning: CloningConfig | None = None,
    policy: BasePolicy | None = None,
    reward_scale: float = 1.0,
    progress: bool = True,
) -> WarmStart:
    """Fit the actor and the critic of an algorithm to demonstrations of the expert, in place.

    With `gamma` = 1 the expert's value is the negative cost-to-go -J*, and the gradient of the value is the negative
    costate. With a smaller `gamma` the remaining cost is assumed to be spread evenly over the remaining time. Q
    functions are also fitted to other actions than the expert's, with the cost of an action according to the
    Hamiltonian:
    Q(q, u) = -J*(q) - h (H(q, lambda, u) - H(q, lambda, u*)), to first order in the control period h.

    Args:
        model: a Stable-Baselines3 algorithm (PPO, A2C, SAC, TQC, ...).
        dataset: a `Dataset`, a directory written by `leapnav rollout`, or demonstrations.
        config: settings.
        cloning: settings of the clone.
        policy: a policy whose actor is copied instead of fitting a clone.
        reward_scale: factor of the rewards that the model receives.
        progress: show progress bars.

    Returns:
        The losses and errors of the fits.

    Raises:
        TypeError: the model is not an algorithm.
        FileNotFoundError: the dataset does not exist.
        ValueError: the dataset does not fit the model, or a setting is invalid.

    """
    if not isinstance(cast(object, model), BaseAlgorithm):
        raise TypeError(f"model: expected an algorithm of Stable-Baselines3, got {type(model).__name__}")
    config = config or WarmStartConfig()
    check_warm_start(config)
    check_positive("reward_scale", reward_scale)
    samples, target = samples_for(model, dataset), policy_of(model)
    check_observations(target, samples)
    valued = _valued(samples) if config.critic else None
    losses: list[EpochLoss] = []
    if policy is not None:
        copy_actor(policy, target)
        if symmetries_of(policy) and not symmetries_of(target):
            warnings.warn(
                "policy: its actions are equivariant under symmetries, those of the model are not; create the model "
                "with the class NavigationPolicy and policy_kwargs={**network(), 'symmetries': policy.symmetries, "
                "'components': policy.components}",
                stacklevel=3,  # around `limit_threads`
            )
    elif config.actor:
        losses = behaviour_clone(target, samples, cloning, progress=progress)
    value_error = slope_error = math.nan
    if valued is not None:
        gamma = float(getattr(model, "gamma", 1.0))
        robots = model.get_env()
        period = CONTROL_PERIOD if robots is None else float(robots.get_attr("control_period")[0])
        rewards = _Rewards(gamma, period, reward_scale)
        value_error, slope_error = _fit_critic(target, valued, config, rewards, progress)
    return WarmStart(tuple(losses), value_error, slope_error)


@dataclass(frozen=True)
class _Rewards:
    """Discount factor, control period (s) and scale of the rewards that a model receives."""

    gamma: float
    period: float
    scale: float

    def factors(self, time_left: np.ndarray) -> np.ndarray:
        """Ratios (N,) of negative value and cost-to-go, for a cost spread evenly over the remaining time (N,) in s."""
        if self.gamma == 1.0:
            return np.full_like(time_left, self.scale)
        steps = np.maximum(np.ceil(time_left / self.period - 1e-6), 1.0)
        return self.scale * (1 - self.gamma**steps) / (steps * (1 - self.gamma))


def _valued(dataset: Dataset) -> Dataset:
    """Return the samples with a cost-to-go and a costate."""
    known = np.isfinite(dataset.returns) & np.isfinite(dataset.costates).all(axis=1)
    if not known.any():
        raise ValueError("dataset: no sample has a cost-to-go and a costate; start.critic needs them")
    return dataset[known]


def _fit_critic(
    policy: BasePolicy, dataset: Dataset, config: WarmStartConfig, rewards: _Rewards, progress: bool
) -> tuple[float, float]:
    """Fit the critic to samples with values; return the errors of values and slopes in the last epoch."""
    factors = rewards.factors(dataset.time_left)
    samples = _CriticSamples(dataset, factors, rewards.period, policy.device)
    slopes = None
    if config.gradient:
        slopes = _Slopes(dataset, factors, config.slopes, np.random.default_rng(config.seed), policy.device)
    critic = _Critic(policy)
    generator = th.Generator().manual_seed(config.seed)
    batches = math.ceil(len(samples) / config.critic_batch_size)
    total_steps = config.critic_epochs * batches
    optimiser = th.optim.AdamW(critic.parameters, lr=config.critic_learning_rate)
    scheduler = LambdaLR(optimiser, cosine_decay(total_steps))
    errors = np.zeros(2)
    with progress_bar(total=total_steps, label="Critic", unit="batches", show=progress) as bar:
        for _ in range(config.critic_epochs):
            errors[:] = 0.0
            for chosen in th.randperm(len(samples), generator=generator).split(config.critic_batch_size):
                loss, value_loss = samples.losses(critic, chosen, generator, config.gradient_weight)
                if slopes is not None:
                    slope_loss = slopes.loss(critic, config.critic_batch_size // 4, generator)
                    loss = loss + config.gradient_weight * slope_loss
                    errors[1] += float(slope_loss.detach())
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                scheduler.step()
                errors[0] += float(value_loss.detach())
                bar.update()
            bar.set_postfix(value=f"{errors[0] / batches:.4f}", slope=f"{errors[1] / batches:.4f}")
    critic.update_target()
    value_error, slope_error = (errors / batches).tolist()
    return value_error, slope_error if slopes is not None else math.nan


class _CriticSamples:
    """Samples for the critic: observations, the expert's actions, values, and the cost of other actions.

    Args:
        dataset: samples with a known cost-to-go.
        factors (N,): negative value per cost-to-go.
        period: control period (s).
        device: device of the tensors.

    """

    def __init__(self, dataset: Dataset, factors: np.ndarray, period: float, device: th.device) -> None:
        self._observations, self._actions = _tensor(dataset.observations, device), _tensor(dataset.actions, device)
        self._values = _tensor(factors * dataset.returns, device)
        self._variance = self._values.var().clamp(min=1e-8)
        self._weights = _tensor(dataset.weights * dataset.halves**2, device)
        self._slopes, self._factors = _tensor(action_slopes(dataset), device), _tensor(factors, device)
        self._period = period

    def __len__(self) -> int:
        return len(self._values)

    def losses(
        self, critic: _Critic, chosen: th.Tensor, generator: th.Generator, weight: float
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the total loss and the value loss of a batch, relative to the variances.

        For a Q function the total loss includes, with the given weight, the difference of its values at the expert's
        and at random actions. That difference is small compared with the values and would hardly affect their loss.
        """
        observations, actions = self._observations[chosen], self._actions[chosen]
        estimates = critic.values(observations, actions)
        value_loss = (estimates - self._values[chosen][:, None]).square().mean() / self._variance
        if not critic.takes_actions:
            return value_loss, value_loss
        noise = ACTION_NOISE * th.randn(actions.shape, generator=generator).to(actions.device)
        error = (actions + noise).clamp(-1.0, 1.0) - actions
        excess = (0.5 * self._weights[chosen] * error.square() + self._slopes[chosen] * error).sum(dim=1)
        cost = self._period * self._factors[chosen] * excess
        difference = estimates - critic.values(observations, actions + error) - cost[:, None]
        return value_loss + weight * difference.square().mean() / cost.square().mean(), value_loss


def _tensor(values: np.ndarray, device: th.device) -> th.Tensor:
    return th.as_tensor(np.asarray(values, dtype=np.float32), device=device)


class _Critic:
    """A state-value network, or the Q functions of an off-policy algorithm."""

    def __init__(self, policy: BasePolicy) -> None:
        self._policy = policy
        self.takes_actions = not isinstance(policy, ActorCriticPolicy)
        self._functions: Any = getattr(policy, "critic", None)
        modules: tuple[nn.Module, ...] = (self._functions,)
        if isinstance(policy, ActorCriticPolicy):
            modules = policy.vf_features_extractor, policy.mlp_extractor.value_net, policy.value_net
        self.parameters = [parameter for module in modules for parameter in module.parameters()]

    def values(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Compute estimates (B, n) of the value network, of each Q function, or of the quantiles of all Q functions."""
        if isinstance(self._policy, ActorCriticPolicy):
            return self._policy.predict_values(as_observation(self._policy, observations))
        estimates = self._functions(as_observation(self._policy, observations), actions)
        if isinstance(estimates, tuple):
            return th.cat(estimates, dim=1)
        return estimates.flatten(start_dim=1)

    def update_target(self) -> None:
        """Copy the weights to the target network, if there is one."""
        target: Any = getattr(self._policy, "critic_target", None)
        if target is not None:
            target.load_state_dict(self._functions.state_dict())


class _Slopes:
    """Central differences of the value in the state, for a random subset of the samples.

    The costate is the gradient of J* with respect to the state, but the critic depends on the observation. Therefore
    the robot is displaced to both sides of the state in a random direction, and the difference of the critic's values
    of the two observations is fitted to the difference given by the costate.

    Args:
        dataset: samples with a known costate.
        factors (N,): negative value per cost-to-go.
        count: maximum number of samples.
        rng: random generator.
        device: device of the tensors.

    """

    def __init__(
        self, dataset: Dataset, factors: np.ndarray, count: int, rng: np.random.Generator, device: th.device
    ) -> None:
        chosen = np.sort(rng.permutation(len(dataset))[:count])
        subset = dataset[chosen]
        step = rng.normal(size=subset.states.shape) * STATE_OFFSET
        parsed = {episode: Scenario.from_json(dataset.scenarios[episode]) for episode in np.unique(subset.episodes)}
        scenarios = [parsed[episode] for episode in subset.episodes.tolist()]
        observer, layout = Observer(dataset.settings), ObservationLayout(dataset.settings)
        parts = [np.arange(part.start, part.stop) for name, part in layout.parts.items() if name != "action"]
        moved = np.concatenate(parts)
        sides = [subset.observations.copy(), subset.observations.copy()]
        for side, sign in zip(sides, (1.0, -1.0), strict=True):  # the history and the last action are not displaced
            observed = observer.observe(scenarios, subset.states + sign * step, subset.times)
            side[:, moved] = observed[:, moved]
        difference = -2.0 * factors[chosen] * (subset.costates * step).sum(axis=1)
        usual = np.abs(difference) <= MAX_RELATIVE_SLOPE * np.median(np.abs(difference))
        self._sides = [_tensor(side[usual], device) for side in sides]
        self._actions, self._difference = _tensor(subset.actions[usual], device), _tensor(difference[usual], device)
        self._mean_square = self._difference.square().mean().clamp(min=1e-12)

    def loss(self, critic: _Critic, size: int, generator: th.Generator) -> th.Tensor:
        """Compute the mean squared error of a random batch, relative to the mean square."""
        chosen = th.randint(len(self._difference), (size,), generator=generator)
        above, below = (critic.values(side[chosen], self._actions[chosen]) for side in self._sides)
        return (above - below - self._difference[chosen][:, None]).square().mean() / self._mean_square


def check_warm_start(config: WarmStartConfig) -> None:
    """Raise ValueError unless the settings of a warm start are valid; the message names the setting and its value."""
    for name in ("critic_epochs", "critic_batch_size", "critic_learning_rate", "slopes"):
        check_positive(name, getattr(config, name))
    check_not_negative("gradient_weight", config.gradient_weight)
