"""Runs of imitation: a clone of the expert, and dataset aggregation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from tqdm.auto import tqdm

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.settings import Settings
from leapnav.experts.policy import ExpertPolicy
from leapnav.experts.rollouts import rollout
from leapnav.training.actors import copy_actor
from leapnav.training.checks import check_config
from leapnav.training.cloning import Cloning, behaviour_clone
from leapnav.training.config import BCConfig, DAggerRunConfig, RunConfig
from leapnav.training.dagger import DAgger, Round
from leapnav.training.dataset import Dataset
from leapnav.training.evaluation import Evaluation
from leapnav.training.policies import load_policy, make_policy
from leapnav.training.runs import Run
from leapnav.training.vec_env import environment_seed, make_vec_env

DEMONSTRATIONS = 1_000_000  # stream of a run's seed, after those of DAgger's rounds


def train_bc(config: BCConfig, *, workers: int = 1, progress: bool = True) -> list[Evaluation]:
    """Clones the expert into the run's folder; a run that was stopped goes on with `config.resume`, to the same bits.

    Args:
        config: settings.
        workers: processes that make demonstrations, if none are given.
        progress: show progress bars.

    Returns:
        The last evaluation, of each family.

    Raises:
        FileNotFoundError, FileExistsError, ValueError: see `Run` and `Dataset.of`.

    """
    check_config(config)  # what is wrong is found before the folder is made
    given = Dataset.of(config.demos) if config.demos else None
    run = Run("bc", config)
    dataset = (given or demonstrations(run, config.scenarios, workers, progress)).observed(settings_of(config))
    policy = new_policy(config)
    return clone(run, policy, dataset, config, progress)


def clone(
    run: Run, policy: ActorCriticPolicy, dataset: Dataset, config: BCConfig | DAggerRunConfig, progress: bool
) -> list[Evaluation]:
    """Fits a policy epoch by epoch, with a checkpoint and an evaluation after each."""
    fit = Cloning(policy, dataset, replace(config.cloning, seed=config.seed))
    found = run.load_checkpoint() if config.resume else None
    if found is not None:
        state = th.load(found[0] / "fit.pt", weights_only=True)
        policy.load_state_dict(state["policy"])
        fit.load_state_dict(state["fit"])
        run.restore_generators()
    done = len(fit.losses) * fit.batches
    with tqdm(total=fit.config.epochs * fit.batches, initial=done, unit="batch", disable=not progress) as bar:
        bar.set_description(f"Cloning {config.family}")
        while not fit.finished:
            loss = fit.run_epoch(bar.update)
            samples = loss.epoch * fit.batches * config.cloning.batch_size
            run.logger.record("loss/training", loss.training)
            run.logger.record("loss/validation", loss.validation)
            evaluations = run.evaluate(policy, samples)
            show(bar, evaluations, loss=f"{loss.validation:.4f}")
            run.save_policy(policy)
            state = {"policy": policy.state_dict(), "fit": fit.state_dict()}
            run.save_checkpoint(lambda folder, state=state: th.save(state, folder / "fit.pt"), {"epochs": loss.epoch})
    fit.finish()
    samples = len(fit.losses) * fit.batches * config.cloning.batch_size
    evaluations = run.evaluate(policy, samples, final=True)
    run.save_policy(policy)
    return evaluations


def train_dagger(config: DAggerRunConfig, *, workers: int = 1, progress: bool = True) -> list[Evaluation]:
    """Aggregates a dataset in the run's folder; a run that was stopped goes on with `config.resume`, round by round.

    Args, returns and errors are those of `train_bc`.
    """
    check_config(config)
    dataset = Dataset.of(config.demos) if config.demos else None
    first = None if config.policy is None else load_policy(config.policy, robot_of(config))
    run = Run("dagger", config)
    dataset = dataset or demonstrations(run, config.scenarios, workers, progress)
    dataset = dataset.observed(settings_of(config))  # what was observed before is not needed again
    policy = new_policy(config)
    venv = make_vec_env(n_envs=config.n_envs, family=config.family, split="fresh", **config.environment)
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
    found = run.load_checkpoint() if config.resume else None
    if found is not None:
        policy.load_state_dict(th.load(found[0] / "policy.pt", weights_only=True))
        dagger.restore([Round(**done) for done in found[1]["rounds"]])
        run.restore_generators()
    elif first is not None:
        copy_actor(first, policy)
    else:
        behaviour_clone(policy, dataset, replace(config.cloning, seed=config.seed), progress=progress)
        _save_round(run, policy, dagger)
    evaluations: list[Evaluation] = []
    while not dagger.finished:
        done = dagger.run_round(progress=progress)
        samples = sum(one.samples for one in dagger.rounds)
        for name in ("success", "collision", "loss"):
            run.logger.record(f"learner/{name}", getattr(done, name))
        evaluations = run.evaluate(policy, samples)
        if progress:
            tqdm.write(f"round {done.number}: {describe(evaluations)}")
        run.save_policy(policy)
        _save_round(run, policy, dagger)
    evaluations = run.evaluate(policy, sum(one.samples for one in dagger.rounds), final=True)
    run.save_policy(policy)
    return evaluations


def _save_round(run: Run, policy: ActorCriticPolicy, dagger: DAgger) -> None:
    state = policy.state_dict()
    rounds = [asdict(done) for done in dagger.rounds]
    run.save_checkpoint(lambda folder: th.save(state, folder / "policy.pt"), {"rounds": rounds})


def demonstrations(run: Run, count: int, workers: int, progress: bool) -> Dataset:
    """Demonstrations of a run's own, made only once."""
    folder = run.folder / "demonstrations"
    if not any(folder.glob("**/metadata.json")):
        seed = demonstration_seed(run.config.seed)
        rollout(run.config.family, count, folder, seed=seed, workers=workers, progress=progress)
    return Dataset.of(folder)


def demonstration_seed(seed: int) -> int:
    """The first scenario's seed of a run's own demonstrations: those of other seeds are other scenarios."""
    return environment_seed(seed, DEMONSTRATIONS)


def robot_of(config: RunConfig) -> NavigateEnv:
    """An environment like those that a run learns in."""
    return NavigateEnv(config.family, split="fresh", **config.environment)


def settings_of(config: RunConfig) -> Settings:
    """What a run's robots observe."""
    return robot_of(config).settings


def new_policy(config: RunConfig) -> ActorCriticPolicy:
    """A policy for a run's robots."""
    env = robot_of(config)
    return make_policy(env.observation_space, env.action_space, config.seed, config.hidden)


def show(bar: Any, evaluations: Sequence[Evaluation], **more: Any) -> None:
    """Writes success and SOC, means over the families, behind a progress bar."""
    success, soc = (float(np.mean([getattr(e, name) for e in evaluations])) for name in ("success", "soc"))
    bar.set_postfix(success=f"{100 * success:.1f} %", SOC=f"{soc:.3f}", **more)


def describe(evaluations: Sequence[Evaluation]) -> str:
    """Success and SOC, means over the families."""
    success, soc = (float(np.mean([getattr(e, name) for e in evaluations])) for name in ("success", "soc"))
    return f"success {100 * success:.1f} %, SOC {soc:.3f}"
