"""Runs of imitation learning: behaviour cloning and DAgger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from tqdm.auto import tqdm

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.families import sample_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.progress import progress_bar, stop_early
from leapnav.experts.acting.policy import ExpertPolicy
from leapnav.experts.data.rollouts import rollout
from leapnav.training.config import BCConfig, DAggerRunConfig, RunConfig
from leapnav.training.learning.cloning import Cloning, behaviour_clone
from leapnav.training.learning.dagger import DAgger, Round
from leapnav.training.learning.dataset import Dataset
from leapnav.training.policies.actors import copy_actor
from leapnav.training.policies.files import load_policy
from leapnav.training.policies.momentum import effort_weights
from leapnav.training.policies.network import make_policy
from leapnav.training.robots.vec_env import environment_seed, make_vec_env
from leapnav.training.runs.checks import check_config
from leapnav.training.runs.run import Run
from leapnav.training.scoring.results import Evaluation
from leapnav.training.threads import limit_threads

DEMONSTRATION_STREAM = 1_000_000  # stream of the run's seed, larger than those of the rounds of DAgger


@limit_threads
def train_bc(config: BCConfig, *, workers: int = 1, progress: bool = True) -> list[Evaluation]:
    """Clone the expert.

    With `config.resume` the run resumes after any interruption, with bitwise identical results.

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
    run = Run("bc", config)
    dataset = (given or _demonstrations(run, config.scenarios, workers, progress)).observed(observed_settings(config))
    policy = _new_policy(config)
    return _clone(run, policy, dataset, config, progress)


def _clone(run: Run, policy: ActorCriticPolicy, dataset: Dataset, config: BCConfig, progress: bool) -> list[Evaluation]:
    """Fit a policy, with an evaluation and a checkpoint after each epoch."""
    fit = Cloning(policy, dataset, replace(config.cloning, seed=config.seed))
    checkpoint = run.load_checkpoint() if config.resume else None
    if checkpoint is not None:
        state = th.load(checkpoint[0] / "fit.pt", weights_only=True)
        policy.load_state_dict(state["policy"])
        fit.load_state_dict(state["fit"])
        run.restore_generators()
    done = len(fit.losses) * fit.batches
    label = f"Cloning {config.family}"
    with progress_bar(total=fit.epochs * fit.batches, label=label, unit="batches", initial=done, show=progress) as bar:
        while not fit.finished:
            loss = fit.run_epoch(bar.update)
            samples = loss.epoch * fit.batches * fit.batch_size
            run.logger.record("loss/training", loss.training)
            run.logger.record("loss/validation", loss.validation)
            evaluations = run.evaluate(policy, samples)
            show_scores(bar, evaluations, loss=f"{loss.validation:.4f}")
            run.save_policy(policy)
            state = {"policy": policy.state_dict(), "fit": fit.state_dict()}
            run.save_checkpoint(lambda folder, state=state: th.save(state, folder / "fit.pt"), {"epochs": loss.epoch})
        if fit.stopped_early is not None:
            stop_early(bar, fit.stopped_early)
    fit.finish()
    samples = len(fit.losses) * fit.batches * fit.batch_size
    evaluations = run.evaluate(policy, samples, final=True)
    run.save_policy(policy)
    return evaluations


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
    policy = _new_policy(config)
    if config.policy is not None:
        copy_actor(load_policy(config.policy, make_env(config)), policy)
    run = Run("dagger", config)
    dataset = dataset or _demonstrations(run, config.scenarios, workers, progress)
    dataset = dataset.observed(observed_settings(config))  # replaced, to release the memory of the other observations
    venv = make_vec_env(n_envs=config.n_envs, **config.fresh_scenarios, **config.environment)
    dagger = DAgger(
        policy,
        ExpertPolicy(venv, quick=True),
        venv,
        replace(config.dagger, seed=config.seed),
        cloning=replace(config.cloning, seed=config.seed),
        dataset=dataset,
        folder=run.folder / "rounds",
        workers=workers,
    )
    checkpoint = run.load_checkpoint() if config.resume else None
    if checkpoint is not None:
        policy.load_state_dict(th.load(checkpoint[0] / "policy.pt", weights_only=True))
        dagger.restore([Round(**completed) for completed in checkpoint[1]["rounds"]])
        run.restore_generators()
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
            success, soc = _mean_scores(evaluations)
            tqdm.write(f"round {completed.number}: success {100 * success:.1f} %, SOC {soc:.3f}")
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
        config = run.config
        task: dict[str, Any] = {"robot": config.robot, "horizon": config.horizon, "obstacles": config.obstacles}
        rollout(config.family, count, folder, **task, seed=seed, workers=workers, progress=progress)
    return Dataset.of(folder)


def make_env(config: RunConfig) -> NavigateEnv:
    """Return an environment with the observations of a run."""
    return NavigateEnv(**config.fresh_scenarios, **config.environment)


def observed_settings(config: RunConfig) -> EnvironmentSettings:
    """Return the settings of an environment with the observations of a run."""
    return make_env(config).settings


def _new_policy(config: BCConfig | DAggerRunConfig) -> ActorCriticPolicy:
    """Return an untrained policy with the network and the observations of a run."""
    env = make_env(config)
    # With a memory, the network itself can continue in the direction of the last actions.
    weights = momentum_of(config) if config.memory == "none" else None
    return make_policy(
        env.observation_space,
        env.action_space,
        config.seed,
        config.hidden,
        effort_weights=weights,
        memory=config.memory,
    )


def momentum_of(config: RunConfig) -> tuple[float, ...] | None:
    """Return the weights with which policies of a run have momentum, see `effort_weights`."""
    return effort_weights(sample_scenario(config.family, 0, config.robot, config.horizon, config.obstacles))


def show_scores(bar: Any, evaluations: Sequence[Evaluation], **more: Any) -> None:
    """Show success rate and SOC, means over the families, next to a progress bar."""
    success, soc = _mean_scores(evaluations)
    bar.set_postfix(success=f"{100 * success:.1f} %", SOC=f"{soc:.3f}", **more)


def _mean_scores(evaluations: Sequence[Evaluation]) -> tuple[float, float]:
    """Return success rate and SOC, means over the families."""
    success, soc = (float(np.mean([getattr(one, name) for one in evaluations])) for name in ("success", "soc"))
    return success, soc
