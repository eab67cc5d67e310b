"""Runs of imitation learning: behaviour cloning and DAgger."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from tqdm.auto import tqdm

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts.data.rollouts import rollout
from leapnav.training.config import BCConfig, DAggerRunConfig, RunConfig
from leapnav.training.environments.vec_env import environment_seed
from leapnav.training.learning.cloning import EpochLoss, behaviour_clone
from leapnav.training.learning.dagger import DAgger, Round
from leapnav.training.learning.dataset import Dataset
from leapnav.training.policies.actors import copy_actor
from leapnav.training.policies.files import load_policy
from leapnav.training.policies.network import make_policy
from leapnav.training.policies.symmetries import symmetries
from leapnav.training.runs.checks import check_config, check_demonstrations, warn_of_family
from leapnav.training.runs.run import Run
from leapnav.training.scoring.results import Evaluation
from leapnav.training.threads import limit_threads

DEMONSTRATION_STREAM = 1_000_000  # stream of the run's seed, larger than those of the rounds of DAgger


@limit_threads
def train_bc(config: BCConfig, *, workers: int = 1, progress: bool = True) -> list[Evaluation]:
    """Clone the expert.

    With `config.resume` an interrupted run uses its demonstrations, and repeats the fit unless it was complete.

    Args:
        config: settings.
        workers: processes that generate demonstrations, if none are given.
        progress: show progress bars.

    Returns:
        The final evaluation of each family.

    Raises:
        FileNotFoundError, FileExistsError, ValueError: see `Run` and `Dataset.of`.

    """
    # Invalid arguments are reported before the run directory is created.
    check_config(config)
    given = Dataset.of(config.demos) if config.demos else None
    if given is not None:
        check_demonstrations(config, given)
        given.warn_of_other(make_env(config).source)
    run = Run("bc", config)
    policy = _new_policy(config)
    checkpoint = run.load_checkpoint() if config.resume else None
    if checkpoint is not None:
        policy.load_state_dict(th.load(checkpoint[0] / "policy.pt", weights_only=True))
        samples = checkpoint[1]["samples"]
    else:
        dataset = given or _demonstrations(run, config.scenarios, workers, progress)
        samples = _clone(run, policy, dataset.observed(observed_settings(config)), config, progress)
        run.save_checkpoint(lambda folder: th.save(policy.state_dict(), folder / "policy.pt"), {"samples": samples})
    evaluations = run.evaluate(policy, samples, final=True)
    run.save_policy(policy)
    return evaluations


def _clone(run: Run, policy: ActorCriticPolicy, dataset: Dataset, config: BCConfig, progress: bool) -> int:
    """Fit a policy, with an evaluation after each epoch; return the number of samples of all epochs."""

    def record(loss: EpochLoss) -> None:
        run.logger.record("loss/training", loss.training)
        run.logger.record("loss/validation", loss.validation)
        evaluations = run.evaluate(policy, loss.epoch * len(dataset))
        if progress:
            validation = "" if math.isnan(loss.validation) else f", loss {loss.validation:.4f}"  # nothing held out
            tqdm.write(f"epoch {loss.epoch}: {_scores(evaluations)}{validation}")
        run.save_policy(policy)

    settings = replace(config.cloning, seed=config.seed)
    label = f"Cloning {config.family}"
    losses = behaviour_clone(policy, dataset, settings, progress=progress, label=label, on_epoch=record)
    return len(losses) * len(dataset)


@limit_threads
def train_dagger(config: DAggerRunConfig, *, workers: int = 1, progress: bool = True) -> list[Evaluation]:
    """Train a policy by dataset aggregation.

    With `config.resume` the run resumes after any interruption, from the last complete round.

    Args:
        config: settings.
        workers: processes that generate demonstrations and labels.
        progress: show progress bars.

    Returns:
        The final evaluation of each family.

    Raises:
        FileNotFoundError, FileExistsError, ValueError: see `Run`, `Dataset.of` and `load_policy`.

    """
    check_config(config)
    dataset = Dataset.of(config.demos) if config.demos else None
    if dataset is not None:
        check_demonstrations(config, dataset)
    policy = _new_policy(config)
    if config.policy is not None:
        warn_of_family("policy", config.policy, config)
        copy_actor(load_policy(config.policy, make_env(config)), policy)
    run = Run("dagger", config)
    dataset = dataset or _demonstrations(run, config.scenarios, workers, progress)
    dataset = dataset.observed(observed_settings(config))  # replaced, to release the memory of the other observations
    dagger = DAgger(
        policy,
        config.family,
        replace(config.dagger, seed=config.seed),
        environment=config.task_environment,
        robots=config.n_envs,
        cloning=replace(config.cloning, seed=config.seed),
        dataset=dataset,
        folder=run.folder / "rounds",
        workers=workers,
    )
    checkpoint = run.load_checkpoint() if config.resume else None
    if checkpoint is not None:
        policy.load_state_dict(th.load(checkpoint[0] / "policy.pt", weights_only=True))
        dagger.restore([Round(**completed) for completed in checkpoint[1]["rounds"]])
    elif config.policy is None:
        behaviour_clone(policy, dataset, replace(config.cloning, seed=config.seed), progress=progress)
        _save_round(run, policy, dagger)
    evaluations: list[Evaluation] = []
    while not dagger.finished:
        completed = dagger.run_round(progress=progress)
        samples = sum(one.samples for one in dagger.rounds)
        for name in ("success", "collision", "loss"):
            run.logger.record(f"learner/{name}", getattr(completed, name))
        evaluations = run.evaluate(policy, samples)
        if progress:
            tqdm.write(f"round {completed.number}: {_scores(evaluations)}")
        run.save_policy(policy)
        _save_round(run, policy, dagger)
    evaluations = run.evaluate(policy, sum(one.samples for one in dagger.rounds), final=True)
    run.save_policy(policy)
    return evaluations


def _save_round(run: Run, policy: ActorCriticPolicy, dagger: DAgger) -> None:
    """Save a checkpoint after a round; the samples are saved by `DAgger`."""
    state = policy.state_dict()
    rounds = [asdict(completed) for completed in dagger.rounds]
    run.save_checkpoint(lambda folder: th.save(state, folder / "policy.pt"), {"rounds": rounds})


def _demonstrations(run: Run, count: int, workers: int, progress: bool) -> Dataset:
    """Return the demonstrations in the run directory; generate them if there are none."""
    folder = run.folder / "demonstrations"
    if not any(folder.glob("**/metadata.json")):
        # The scenarios depend on the seed of the run.
        seed = environment_seed(run.config.seed, DEMONSTRATION_STREAM)
        options: dict[str, Any] = {"seed": seed, "workers": workers, "progress": progress}
        rollout(run.config.family, count, folder, **run.config.task, **options)
    return Dataset.of(folder)


def make_env(config: RunConfig) -> NavigateEnv:
    """Return an environment with the observations of a run."""
    return NavigateEnv(**config.fresh_environment)


def observed_settings(config: RunConfig) -> EnvironmentSettings:
    """Return the settings of an environment with the observations of a run."""
    return make_env(config).settings


def _new_policy(config: BCConfig | DAggerRunConfig) -> ActorCriticPolicy:
    """Return an untrained policy with the network and the observations of a run."""
    env = make_env(config)
    spaces = env.observation_space, env.action_space
    return make_policy(
        *spaces,
        config.seed,
        config.hidden,
        effort_weights=config.effort_weights,
        symmetries=symmetries(env.settings, [env.source.robot]) if config.symmetric else (),
        components=config.components,
    )


def mean_scores(evaluations: Sequence[Evaluation]) -> tuple[float, float]:
    """Return success rate and SOC, means over the families."""
    success, soc = (float(np.mean([getattr(one, name) for one in evaluations])) for name in ("success", "soc"))
    return success, soc


def _scores(evaluations: Sequence[Evaluation]) -> str:
    success, soc = mean_scores(evaluations)
    return f"success {100 * success:.1f} %, SOC {soc:.3f}"
