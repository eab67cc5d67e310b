"""Settings of the fits, which the settings of the runs contain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DEFAULT_EPOCHS = 12  # of a clone, if there are enough samples


@dataclass(frozen=True)
class CloningConfig:
    """Settings of behaviour cloning."""

    epochs: int | None = None
    """Maximum number of passes over the samples; by default 12, and with few samples more: at least 2,500 gradient
    steps."""
    patience: int = 5
    """Epochs without a lower validation loss before the fit stops; 0: no early stopping. The weights of the best epoch
    are kept."""
    batch_size: int | None = None
    """Samples per gradient step; by default 2,048, and with few samples fewer, down to 64."""
    learning_rate: float = 2e-3
    """Peak learning rate (cosine decay to zero)."""
    weight_decay: float = 1e-4
    """AdamW weight decay."""
    validation_share: float = 0.05
    """Fraction of the obstacle courses held out for the validation loss."""
    loss: Literal["action", "hamiltonian"] = "action"
    """Loss of an action: "action": Huber loss of the error, each component in units of its spread; "hamiltonian": cost
    of the error per second, H(q, lambda, u) - H(q, lambda, u*) with the expert's costate lambda."""
    augment: bool = True
    """Augmentation with mirrored and time-reversed samples, if the robot and the observation have these symmetries."""
    seed: int = 0
    """Random seed of the validation split, the order of the samples and the augmentation."""


@dataclass(frozen=True)
class DAggerConfig:
    """Settings of dataset aggregation (DAgger)."""

    rounds: int = 3
    """Number of rounds: rollouts of the learner, takeovers by the expert, fit to all samples."""
    max_failures: int = 200
    """Failed episodes per round before relabelling; the expert takes over at most 12 times in each."""
    max_episodes: int = 8_000
    """Maximum number of episodes per round."""
    successes: float = 1.0
    """Successful episodes with one takeover each, per failed episode."""
    lead: float = 3.0
    """Time that the expert drives after a takeover (s)."""
    epochs: int = 2
    """Passes over all samples after each round except the last."""
    last_epochs: int = 6
    """Passes over all samples after the last round."""
    learning_rate: float = 1e-3
    """Peak learning rate of each round (cosine decay to zero)."""
    seed: int = 0
    """Random seed of the scenarios and the times of the takeovers."""


@dataclass(frozen=True)
class WarmStartConfig:
    """Settings of a warm start from demonstrations. Each of its parts can be switched off."""

    actor: bool = True
    """Behaviour cloning of the actor."""
    critic: bool = True
    """Fit of the critic to the expert's cost-to-go."""
    gradient: bool = True
    """Fit of the critic's gradient to the costate."""
    critic_epochs: int = 3
    """Passes over the samples for the critic."""
    critic_learning_rate: float = 3e-3
    """Peak learning rate of the critic (cosine decay to zero)."""
    critic_batch_size: int = 4096
    """Samples per gradient step of the critic."""
    gradient_weight: float = 0.3
    """Weight of the error of the gradient (of Q functions also by the action) relative to that of the value."""
    slopes: int = 200_000
    """Number of samples at which the gradient is fitted."""
    seed: int = 0
    """Random seed of the order of the samples and the directions of the gradient."""
