"""Behaviour cloning: a policy fitted to the expert's actions by regression."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn import functional
from tqdm.auto import tqdm

from leapnav.experts.demonstrations import Demonstration
from leapnav.training.config import CloningConfig
from leapnav.training.symmetries import mirror, turn_round

WARM_UP = 200  # steps over which the learning rate rises
SMALLEST_STD = 0.01  # of the fitted action noise


@dataclass(frozen=True)
class EpochLoss:
    """Mean squared action error in units of the actions' standard deviation, after an epoch; NaN without validation."""

    epoch: int
    training: float
    validation: float


def behaviour_clone(
    policy: ActorCriticPolicy,
    demonstrations: Sequence[Demonstration],
    config: CloningConfig | None = None,
    *,
    progress: bool = True,
) -> list[EpochLoss]:
    """Fits the policy's mean action to the demonstrations, in place, and its noise to what error remains.

    The same policy, demonstrations and configuration give the same weights on the same machine.

    Raises:
        ValueError: there are no demonstrations, or a setting is impossible.

    """
    config = config or CloningConfig()
    if not demonstrations:
        raise ValueError("demonstrations: expected at least one, got none")
    for name in ("epochs", "batch_size", "learning_rate"):
        if not (math.isfinite(getattr(config, name)) and getattr(config, name) > 0):
            raise ValueError(f"{name}: expected a positive number, got {getattr(config, name)!r}")
    if not (math.isfinite(config.weight_decay) and config.weight_decay >= 0):
        raise ValueError(f"weight_decay: expected a number >= 0, got {config.weight_decay!r}")
    if not 0 <= config.seed < 2**63:
        raise ValueError(f"seed: expected a number from 0 to 2^63 - 1, got {config.seed!r}")
    if not 0 <= config.validation_share < 1:
        raise ValueError(f"validation_share: expected a number in [0, 1), got {config.validation_share!r}")
    rng = th.Generator().manual_seed(config.seed)
    train, held_out = _split(demonstrations, config, rng)
    observations, actions = _samples(train)
    spread = actions.std(dim=0).clamp(min=1e-3)
    optimiser = th.optim.AdamW(policy.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    batches = math.ceil(len(observations) / config.batch_size)
    total = config.epochs * batches
    losses, step = [], 0
    policy.set_training_mode(True)
    with tqdm(total=total, desc="Cloning", unit="batch", disable=not progress) as bar:
        for epoch in range(config.epochs):
            order = th.randperm(len(observations), generator=rng)
            summed = 0.0
            for chosen in order.split(config.batch_size):
                for group in optimiser.param_groups:
                    decay = 0.5 * (1 + math.cos(math.pi * step / total))
                    group["lr"] = config.learning_rate * min(1.0, (step + 1) / WARM_UP) * decay
                inputs, targets = observations[chosen], actions[chosen]
                if config.augment:
                    twin = int(th.randint(4, (1,), generator=rng))
                    inputs, targets = mirror(inputs, targets) if twin & 1 else (inputs, targets)
                    inputs, targets = turn_round(inputs, targets) if twin & 2 else (inputs, targets)
                loss = functional.mse_loss(_mean_action(policy, inputs) / spread, targets / spread)
                optimiser.zero_grad()
                loss.backward()
                th.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
                optimiser.step()
                summed += float(loss.detach()) * len(chosen)
                step += 1
                bar.update()
            losses.append(EpochLoss(epoch + 1, summed / len(observations), _loss(policy, held_out, spread)))
            bar.set_postfix(training=f"{losses[-1].training:.4f}", validation=f"{losses[-1].validation:.4f}")
    policy.set_training_mode(False)
    with th.no_grad():
        policy.log_std.copy_((math.sqrt(losses[-1].training) * spread).clamp(min=SMALLEST_STD).log())
    return losses


def _mean_action(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    features = cast(th.Tensor, policy.extract_features(observations, policy.pi_features_extractor))
    return policy.action_net(policy.mlp_extractor.forward_actor(features))


def _split(
    demonstrations: Sequence[Demonstration], config: CloningConfig, rng: th.Generator
) -> tuple[list[Demonstration], list[Demonstration]]:
    """Training and validation demonstrations, with no obstacle course in both."""
    courses = {}
    for demonstration in demonstrations:
        courses.setdefault((demonstration.scenario.obstacles, demonstration.scenario.goal), []).append(demonstration)
    order = th.randperm(len(courses), generator=rng).tolist()
    groups = list(courses.values())
    held_out = {order[i] for i in range(int(config.validation_share * len(groups)))}
    train = [d for i, group in enumerate(groups) if i not in held_out for d in group]
    return train, [d for i in sorted(held_out) for d in groups[i]]


def _samples(demonstrations: Sequence[Demonstration]) -> tuple[th.Tensor, th.Tensor]:
    """Observations (N, d) and actions (N, 2) of all steps."""
    observations = np.concatenate([d.observations[:-1] for d in demonstrations])
    actions = np.concatenate([d.actions for d in demonstrations])
    return th.as_tensor(observations, dtype=th.float32), th.as_tensor(actions, dtype=th.float32)


def _loss(policy: ActorCriticPolicy, demonstrations: Sequence[Demonstration], spread: th.Tensor) -> float:
    if not demonstrations:
        return math.nan
    observations, actions = _samples(demonstrations)
    with th.no_grad():
        return float(functional.mse_loss(_mean_action(policy, observations) / spread, actions / spread))
