"""Behaviour cloning: regression of a policy's mean action on the expert's actions."""

from __future__ import annotations

import copy
import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch.nn import functional
from torch.optim.lr_scheduler import LambdaLR

from leapnav.envs.unwrapping import unwrap
from leapnav.envs.utils.progress import progress_bar, stop_early
from leapnav.envs.utils.validation import (
    check_choice,
    check_fraction,
    check_integer,
    check_not_negative,
    check_positive,
)
from leapnav.experts.data.demonstrations import Demonstration
from leapnav.training.fit_settings import DEFAULT_EPOCHS, CloningConfig
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.samples import Batch, Samples, split_courses
from leapnav.training.policies.actors import actor_parameters, parts_of_dict, policy_of, set_noise, update_target
from leapnav.training.policies.mixture import Mixture
from leapnav.training.policies.symmetries import Transformation
from leapnav.training.threads import limit_threads

# Gradient steps of a fit with the default epochs, and bounds of the default batch size. A network that has learned from
# a few hundred gradient steps only is worse than the demonstrations allow: 200 demonstrations of "open" gave 51 %
# success after 180 steps, 100 % after 2,700.
MIN_STEPS = 2_500
MIN_BATCH_SIZE, MAX_BATCH_SIZE = 64, 2048
WARM_UP_STEPS = 200  # gradient steps of the linear warm-up of the learning rate
MIN_STD = 0.01  # lower bound of the fitted standard deviation of the actions
MAX_GRADIENT_NORM = 1.0
EVALUATION_BATCH_SIZE = 16_384
HUBER_DELTA = 0.05  # action error (actions are in [-1, 1]) above which Huber's loss is linear


@dataclass(frozen=True)
class EpochLoss:
    """Losses of one epoch, relative to the loss of the mean action of the dataset.

    Attributes:
        epoch: index of the epoch, from 1.
        training: mean loss of the training samples during the epoch.
        validation: loss of the held-out samples after the epoch; NaN if none are held out.

    """

    epoch: int
    training: float
    validation: float


@limit_threads
def behaviour_clone(
    model: BaseAlgorithm | BasePolicy,
    dataset: Dataset | str | os.PathLike[str] | Sequence[Demonstration],
    config: CloningConfig | None = None,
    *,
    progress: bool = True,
    label: str = "Cloning",
    stream: int = 0,
    on_epoch: Callable[[EpochLoss], None] | None = None,
) -> list[EpochLoss]:
    """Fit the mean action of a policy to the expert's actions, in place.

    The standard deviation of a stochastic policy is set to the root mean square of the remaining error, of a mixture to
    that of the component that explains the expert's action. The same model,
    dataset and configuration give the same weights on the same machine. The global random generators are not used.

    Args:
        model: a Stable-Baselines3 algorithm with continuous actions (PPO, A2C, SAC, TQC, TD3, ...) or its policy.
        dataset: a `Dataset`, a directory written by `leapnav rollout`, or demonstrations; observed again if the
            environment of the model has other sensors.
        config: settings.
        progress: show a progress bar.
        label: label of the progress bar.
        stream: offset added to the seed of the sample order and of the augmentation. The validation split depends on
            the seed alone.
        on_epoch: function called with the losses after each epoch.

    Returns:
        The losses of all epochs.

    Raises:
        FileNotFoundError: the dataset does not exist.
        ValueError: the dataset is empty or damaged, its observations do not fit the policy, or a setting is invalid.

    """
    fit = _Fit(policy_of(model), samples_for(model, dataset), config or CloningConfig(), stream)
    with progress_bar(total=fit.epochs * fit.batches, label=label, unit="batches", show=progress) as bar:
        while not fit.finished:
            loss = fit.run_epoch(bar.update)
            bar.set_postfix(fit.shown(loss))
            if on_epoch is not None:
                on_epoch(loss)
        if len(fit.losses) < fit.epochs:
            done = f"stopped after {len(fit.losses)} of {fit.epochs} epochs"
            stop_early(bar, f"{done}, validation loss not lower for {fit.config.patience}")
    fit.finish()
    return fit.losses


class _Fit:
    """A fit that runs epoch by epoch; the arguments are those of `behaviour_clone`.

    Attributes:
        config: settings.
        epochs: maximum number of epochs.
        batches: gradient steps per epoch.
        losses: losses of the epochs so far.

    """

    def __init__(self, policy: BasePolicy, dataset: Dataset, config: CloningConfig, stream: int) -> None:
        check_cloning(config)
        check_observations(policy, dataset)
        self._symmetries = dataset.symmetries
        self.config = config
        self.losses: list[EpochLoss] = []
        self._policy = policy
        self._rng = th.Generator().manual_seed(config.seed + stream)
        self._train, self._held_out = (
            Samples(dataset, chosen, policy.device)
            for chosen in split_courses(dataset, config.validation_share, config.seed)
        )
        if config.validation_share > 0 and not len(self._held_out):
            warnings.warn(
                f"validation_share: {config.validation_share} of {len(set(dataset.course_texts))} obstacle courses is "
                "less than one; the fit has no validation loss and runs all its epochs",
                stacklevel=4,
            )
        self._scale = _scale(self._train, config.loss)
        self._batch_size = config.batch_size or _default_batch_size(len(self._train))
        self.batches = self._train.n_batches(self._batch_size)
        self.epochs = config.epochs or max(DEFAULT_EPOCHS, math.ceil(MIN_STEPS / self.batches))
        parameters = actor_parameters(policy)
        self._optimiser = th.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
        self._scheduler = LambdaLR(self._optimiser, warm_up_and_cosine(self.epochs * self.batches))
        self._best: tuple[float, dict[str, th.Tensor]] | None = None

    @property
    def finished(self) -> bool:
        """Whether all epochs have run, or the validation loss has not decreased for `patience` epochs."""
        done, patience = len(self.losses), self.config.patience
        if done >= self.epochs:
            return True
        validation = [loss.validation for loss in self.losses]
        return bool(patience and done > patience and min(validation[:-patience]) <= min(validation[-patience:]))

    def shown(self, loss: EpochLoss) -> dict[str, str]:
        """Return the losses of an epoch as text, that of the validation only if there are held-out samples."""
        values = {"training": loss.training, **({"validation": loss.validation} if len(self._held_out) else {})}
        return {name: f"{value:.4f}" for name, value in values.items()}

    def run_epoch(self, on_batch: Callable[[], Any] = lambda: None) -> EpochLoss:
        """Run one pass over the training samples.

        Args:
            on_batch: function called after each gradient step.

        Returns:
            The losses of the epoch.

        Raises:
            ValueError: the loss is not finite.

        """
        config, total = self.config, 0.0
        self._policy.set_training_mode(True)
        for chosen in self._train.shuffled(self._batch_size, self._rng):
            batch = self._train.batch(chosen, self._random_symmetries() if config.augment else ())
            loss = self._loss(batch)
            if not th.isfinite(loss):
                raise ValueError(
                    f"learning_rate: the fit diverged in epoch {len(self.losses) + 1} at {config.learning_rate!r}; "
                    "choose a smaller one"
                )
            self._optimiser.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(actor_parameters(self._policy), MAX_GRADIENT_NORM)
            self._optimiser.step()
            self._scheduler.step()
            total += float(loss.detach()) * len(batch)
            on_batch()
        self._policy.set_training_mode(False)
        losses = EpochLoss(len(self.losses) + 1, total / len(self._train), self._validation_loss())
        # Without held-out samples the last epoch counts as the best.
        if self._best is None or losses.validation < self._best[0] or not len(self._held_out):
            self._best = (losses.validation, copy.deepcopy(self._policy.state_dict()))
        self.losses.append(losses)
        return losses

    def finish(self) -> None:
        """Restore the weights of the best epoch, and set the action noise to the remaining error."""
        if self._best is not None:
            self._policy.load_state_dict(self._best[1])
        samples = self._held_out if len(self._held_out) else self._train
        squares = []
        with th.no_grad():
            for batch in map(samples.batch, samples.in_order(EVALUATION_BATCH_SIZE)):
                mixture, error, losses = self._errors(batch)
                squares.append((mixture.responsibilities(losses)[:, :, None] * error.square()).sum(dim=(0, 1)))
        set_noise(self._policy, (th.stack(squares).sum(dim=0) / len(samples)).sqrt().clamp(min=MIN_STD))
        update_target(self._policy)

    def _random_symmetries(self) -> list[Transformation]:
        """Return a random combination of the robot's symmetries."""
        combination = int(th.randint(2 ** len(self._symmetries), (1,), generator=self._rng))
        return [transform for number, transform in enumerate(self._symmetries) if combination & 2**number]

    def _loss(self, batch: Batch) -> th.Tensor:
        mixture, _, losses = self._errors(batch)
        return mixture.loss(losses).mean()

    def _errors(self, batch: Batch) -> tuple[Mixture, th.Tensor, th.Tensor]:
        """Return the mixture for a batch, and errors (B, k, m) and losses (B, k) of its components."""
        mixture = batch.mixture_of(self._policy)
        error = mixture.actions - batch.actions[:, None]
        if self.config.loss == "action":
            losses = _action_loss(error)
        else:
            losses = _hamiltonian_loss(error, batch.slopes[:, None], batch.weights[:, None])
        return mixture, error, losses.mul(self._scale).sum(dim=2)

    def _validation_loss(self) -> float:
        if not len(self._held_out):
            return math.nan
        with th.no_grad():
            batches = map(self._held_out.batch, self._held_out.in_order(EVALUATION_BATCH_SIZE))
            losses = [float(self._loss(batch)) * len(batch) for batch in batches]
        return sum(losses) / len(self._held_out)


def _default_batch_size(n_samples: int) -> int:
    """Return the batch size with which `DEFAULT_EPOCHS` epochs have about `MIN_STEPS` gradient steps, or more."""
    return min(max(n_samples * DEFAULT_EPOCHS // MIN_STEPS, MIN_BATCH_SIZE), MAX_BATCH_SIZE)


def warm_up_and_cosine(total_steps: int) -> Callable[[int], float]:
    """Return the learning-rate factor per gradient step: linear warm-up, cosine decay to zero."""
    cosine = cosine_decay(total_steps)
    return lambda step: min(1.0, (step + 1) / WARM_UP_STEPS) * cosine(step)


def cosine_decay(total_steps: int) -> Callable[[int], float]:
    """Return the learning-rate factor per gradient step: cosine decay from 1 to 0 after `total_steps`."""
    return lambda step: 0.5 * (1 + math.cos(math.pi * min(1.0, step / total_steps)))


def _action_loss(error: th.Tensor) -> th.Tensor:
    """Huber's loss: quadratic for small errors, linear for large ones.

    Where a small displacement decides on which side the expert passes an obstacle, the mean of both actions, which
    minimises a quadratic loss, leads into the obstacle. The median, which minimises a linear loss, does not.
    """
    return functional.huber_loss(error, th.zeros_like(error), reduction="none", delta=HUBER_DELTA)


def _hamiltonian_loss(error: th.Tensor, slopes: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """H(q, lambda, u) - H(q, lambda, u*) for each component of the action: the cost of an error per second.

    With H = 1/2 u'Ru + Phi + lambda'(a + Bu) and p = B'lambda it is 1/2 r e^2 + (p + r u*) e for the error e of a
    control. The second term vanishes where u* minimises H inside the robot's limits. Where u* is at a limit, the term
    is the cost of moving away from the limit; an action beyond the limit is not rewarded.

    Args:
        error (..., m): action minus the expert's action.
        slopes (..., m): p + r u*, per unit of the action.
        weights (..., m): r, per square unit of the action.

    """
    return 0.5 * weights * error.square() + functional.relu(slopes * error)


def _scale(samples: Samples, loss: str) -> th.Tensor:
    """Factors (m,) of the components of the loss with which the mean action has the loss 1."""
    actions, slopes, weights = samples.columns
    error = actions.mean(dim=0) - actions
    if loss == "action":
        return 0.5 / _action_loss(error).mean(dim=0).clamp(min=1e-6)
    return (1.0 / _hamiltonian_loss(error, slopes, weights).sum(dim=1).mean()).clamp(max=1e6).repeat(actions.shape[1])


def samples_for(
    model: BaseAlgorithm | BasePolicy, dataset: Dataset | str | os.PathLike[str] | Sequence[Demonstration]
) -> Dataset:
    """Return samples with the observations of a model's environment, if that is one of leapnav."""
    samples = Dataset.of(dataset)
    venv = model.get_env() if isinstance(model, BaseAlgorithm) else None
    try:
        env = unwrap(venv)[0]
    except TypeError:  # another environment, or none
        return samples
    samples.warn_of_other(env.source, stacklevel=5)  # where the public function is called, around its `limit_threads`
    settings = env.settings
    if settings.goal_conditioned:  # refused by `check_observations`
        return samples
    return samples.observed(replace(settings, dict_observation=False))


def check_observations(policy: BasePolicy, dataset: Dataset) -> None:
    """Raise ValueError unless the observations of a dataset have the shape that a policy expects."""
    space, width = policy.observation_space, dataset.observations.shape[1]
    shape = (sum(parts_of_dict(space).values()),) if isinstance(space, spaces.Dict) else space.shape or ()
    if shape != (width,):
        expected = " x ".join(map(str, shape))
        raise ValueError(f"dataset: its observations have {width} numbers, the policy's {expected}")


def check_cloning(config: CloningConfig) -> None:
    """Raise ValueError unless the settings of a fit are valid; the message names the setting and its value."""
    for name in ("epochs", "batch_size"):
        if getattr(config, name) is not None:
            check_positive(name, getattr(config, name))
    check_positive("learning_rate", config.learning_rate)
    for name in ("weight_decay", "patience"):
        check_not_negative(name, getattr(config, name))
    check_integer("seed", config.seed, 0, 2**63 - 1)
    check_fraction("validation_share", config.validation_share, one=False)
    check_choice("loss", config.loss, ("action", "hamiltonian"))
