"""A start near the optimum: the actor a clone of the expert, the critic its cost-to-go and the costate."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn
from tqdm.auto import tqdm

from leapnav.envs.observations import TIME_LEFT
from leapnav.envs.observer import Observer
from leapnav.envs.scenario import Scenario
from leapnav.experts.demonstrations import CONTROL_PERIOD
from leapnav.training.actors import copy_actor, policy_of
from leapnav.training.cloning import EpochLoss, action_slopes, behaviour_clone, check_observations
from leapnav.training.config import CloningConfig, WarmStartConfig
from leapnav.training.dataset import Dataset

# The slope of the cost-to-go is fitted over this distance either way (m, m, rad; standard deviations of a random
# direction): short beside what bends the cost-to-go, long beside a lidar's steps from one beam to the next.
REACH = np.array([0.02, 0.02, 0.02])
STEEPEST = 10.0  # of the slopes' spread; at the goal's end the costate grows without bound
ACTION_NOISE = 0.5  # standard deviation of the actions, round the expert's, whose cost a Q function is fitted to


@dataclass(frozen=True)
class WarmStart:
    """What a warm start did: the losses of the clone, and the error of the critic's values and slopes.

    Both errors are mean squares in units of the variance, after the last epoch; NaN where nothing was fitted.
    """

    cloning: tuple[EpochLoss, ...]
    value_error: float
    slope_error: float


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
    """Fits an algorithm's actor and critic to the expert's demonstrations, in place.

    With `gamma` = 1 the value of the expert is minus its cost-to-go J*, and the value's gradient minus the costate.
    With a smaller one the rest of the cost is taken as spread evenly over the time that is left. A Q function is fitted
    to the value and, for other actions than the expert's, to what the Hamiltonian says that they cost:
    Q(q, u) = -J*(q) - h (H(q, lambda, u) - H(q, lambda, u*)), to first order in the control period h.

    Args:
        model: PPO, A2C, SAC, TQC, ... of Stable-Baselines3.
        dataset: a `Dataset`, a folder that `leapnav rollout` wrote, or demonstrations.
        config: settings.
        cloning: settings of the actor's clone.
        policy: a policy whose actor is copied instead.
        reward_scale: factor of the rewards that the model sees.
        progress: show progress bars.

    Raises:
        TypeError: the model is no algorithm.
        FileNotFoundError: there is no such dataset.
        ValueError: the dataset does not fit, or a setting is impossible.

    """
    if not isinstance(cast(object, model), BaseAlgorithm):
        raise TypeError(f"model: expected an algorithm of Stable-Baselines3, got {type(model).__name__}")
    config = config or WarmStartConfig()
    check_warm_start(config)
    if not (math.isfinite(reward_scale) and reward_scale > 0):
        raise ValueError(f"reward_scale: expected a positive number, got {reward_scale!r}")
    samples, target = Dataset.of(dataset), policy_of(model)
    check_observations(target, samples)
    losses: list[EpochLoss] = []
    if policy is not None:
        copy_actor(policy, target)
    elif config.actor:
        losses = behaviour_clone(model, samples, cloning, progress=progress)
    value_error = slope_error = math.nan
    if config.critic:
        gamma = float(getattr(model, "gamma", 1.0))
        robots = model.get_env()
        period = CONTROL_PERIOD if robots is None else float(robots.get_attr("control_period")[0])
        rewards = _Rewards(gamma, period, reward_scale)
        value_error, slope_error = _fit_critic(target, samples, config, rewards, progress)
    return WarmStart(tuple(losses), value_error, slope_error)


@dataclass(frozen=True)
class _Rewards:
    """What the model makes of rewards: discount factor, control period (s) of its robots, scale."""

    gamma: float
    period: float
    scale: float

    def factors(self, time_left: np.ndarray) -> np.ndarray:
        """What turns a cost to go (N,) into minus a value: the cost is taken as spread evenly over the time left."""
        if self.gamma == 1.0:
            return np.full_like(time_left, self.scale)
        steps = np.maximum(np.ceil(time_left / self.period - 1e-6), 1.0)
        return self.scale * (1 - self.gamma**steps) / (steps * (1 - self.gamma))


def _fit_critic(
    policy: BasePolicy, dataset: Dataset, config: WarmStartConfig, rewards: _Rewards, progress: bool
) -> tuple[float, float]:
    """Mean squared errors of values and slopes in the last epoch, in units of their variance."""
    device, rng = policy.device, np.random.default_rng(config.seed)
    known = np.isfinite(dataset.returns) & np.isfinite(dataset.costates).all(axis=1)
    if not known.any():
        raise ValueError("dataset: no sample has a cost-to-go and a costate; start.critic needs them")
    dataset = dataset[known]
    shrinking = rewards.factors(dataset.observations[:, TIME_LEFT])
    values = _tensor(shrinking * dataset.returns, device)
    observations, actions = _tensor(dataset.observations, device), _tensor(dataset.actions, device)
    columns = dataset.weights * dataset.limits**2, action_slopes(dataset), shrinking
    curvature, slope, shrunk = (_tensor(column, device) for column in columns)
    critic = _Critic(policy)
    optimiser = th.optim.AdamW(critic.parameters, lr=config.critic_learning_rate)
    generator = th.Generator().manual_seed(config.seed)
    slopes = _Slopes(dataset, shrinking, config.slopes, rng, device) if config.gradient else None
    spread = values.var().clamp(min=1e-8)
    batches = math.ceil(len(values) / config.critic_batch_size)
    total, step, errors = config.critic_epochs * batches, 0, np.zeros(2)
    with tqdm(total=total, desc="Critic", unit="batch", disable=not progress) as bar:
        for _ in range(config.critic_epochs):
            errors[:] = 0.0
            for chosen in th.randperm(len(values), generator=generator).split(config.critic_batch_size):
                for group in optimiser.param_groups:
                    group["lr"] = config.critic_learning_rate * 0.5 * (1 + math.cos(math.pi * step / total))
                inputs, target, taken = observations[chosen], values[chosen], actions[chosen]
                estimates = critic.values(inputs, taken)
                value_loss = (estimates - target[:, None]).square().mean() / spread
                loss = value_loss
                if critic.takes_actions:
                    # What other actions cost is little beside the values, so it has a loss of its own.
                    noise = ACTION_NOISE * th.randn(taken.shape, generator=generator).to(device)
                    error = (taken + noise).clamp(-1.0, 1.0) - taken
                    dearer = (0.5 * curvature[chosen] * error.square() + slope[chosen] * error).sum(dim=1)
                    cost = rewards.period * shrunk[chosen] * dearer
                    difference = estimates - critic.values(inputs, taken + error) - cost[:, None]
                    loss = loss + config.gradient_weight * difference.square().mean() / cost.square().mean()
                if slopes is not None:
                    slope_loss = slopes.loss(critic, config.critic_batch_size // 4, generator)
                    loss = loss + config.gradient_weight * slope_loss
                    errors[1] += float(slope_loss.detach())
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                errors[0] += float(value_loss.detach())
                step += 1
                bar.update()
            bar.set_postfix(value=f"{errors[0] / batches:.4f}", slope=f"{errors[1] / batches:.4f}")
    critic.finish()
    value_error, slope_error = (errors / batches).tolist()
    return value_error, slope_error if slopes is not None else math.nan


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
        """Estimates (B, n): of the one value network, of each Q function, or of their quantiles."""
        if isinstance(self._policy, ActorCriticPolicy):
            return self._policy.predict_values(observations)
        found = self._functions(observations, actions)
        if isinstance(found, tuple):
            return th.cat(found, dim=1)
        return found.flatten(start_dim=1)

    def finish(self) -> None:
        """Makes a target network the same."""
        target: Any = getattr(self._policy, "critic_target", None)
        if target is not None:
            target.load_state_dict(self._functions.state_dict())


class _Slopes:
    """How the value changes from one side of a state to the other, for some of the samples.

    The costate is the gradient of J* by the state; the network knows observations only. So the robot is put a little
    to either side of the state, in a random direction, and the values of what it observes there must differ by what the
    costate says.
    """

    def __init__(
        self, dataset: Dataset, shrinking: np.ndarray, count: int, rng: np.random.Generator, device: th.device
    ) -> None:
        chosen = np.sort(rng.permutation(len(dataset))[:count])
        part = dataset[chosen]
        step = rng.normal(size=(len(part), 3)) * REACH
        parsed = {episode: Scenario.from_json(dataset.scenarios[episode]) for episode in np.unique(part.episodes)}
        scenarios = [parsed[episode] for episode in part.episodes.tolist()]
        observer = Observer(dataset.settings)
        sides = [observer.observe(scenarios, part.states + sign * step, part.times) for sign in (1.0, -1.0)]
        rise = -2.0 * shrinking[chosen] * (part.costates * step).sum(axis=1)
        usual = np.abs(rise) <= STEEPEST * np.median(np.abs(rise))
        self._sides = [_tensor(side[usual], device) for side in sides]
        self._actions, self._rise = _tensor(part.actions[usual], device), _tensor(rise[usual], device)
        self._spread = self._rise.square().mean().clamp(min=1e-12)

    def loss(self, critic: _Critic, size: int, generator: th.Generator) -> th.Tensor:
        """Mean squared error of a random batch, in units of the mean square."""
        chosen = th.randint(len(self._rise), (size,), generator=generator)
        above, below = (critic.values(side[chosen], self._actions[chosen]) for side in self._sides)
        return (above - below - self._rise[chosen][:, None]).square().mean() / self._spread


def check_warm_start(config: WarmStartConfig) -> None:
    """Checks the settings of a warm start.

    Raises:
        ValueError: one is impossible; the message names it and its value.

    """
    for name in ("critic_epochs", "critic_batch_size", "critic_learning_rate", "slopes"):
        if not (math.isfinite(getattr(config, name)) and getattr(config, name) > 0):
            raise ValueError(f"{name}: expected a positive number, got {getattr(config, name)!r}")
    if not (math.isfinite(config.gradient_weight) and config.gradient_weight >= 0):
        raise ValueError(f"gradient_weight: expected a number >= 0, got {config.gradient_weight!r}")
