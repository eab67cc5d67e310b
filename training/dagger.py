"""DAgger: the learner drives, the expert says what it would have done there, and the learner fits all of it.

S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning" (AISTATS 2011), with two changes. Who drives is drawn for each episode, not for each step: a robot that
changes hands at every step would see what neither of the two leads to. And labels are dear but driving is cheap, so the
learner drives many scenarios and mostly the episodes in which it failed are labelled: the others have little to teach.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from joblib import Parallel, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from leapnav.envs.families import sample_scenario
from leapnav.envs.scenario import Scenario
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.experts.policy import ExpertPolicy, NoOptimumError
from leapnav.training.actors import policy_of
from leapnav.training.cloning import Cloning, check_observations
from leapnav.training.config import CloningConfig, DAggerConfig
from leapnav.training.dataset import Dataset
from leapnav.training.vec_env import NavigateVecEnv, environment_seed

PORTION = 32  # episodes that are labelled together


@dataclass(frozen=True)
class Round:
    """What a round of DAgger brought.

    Attributes:
        number: from 1 on.
        samples: labelled in this round.
        episodes: that the learner drove before.
        success, collision: their rates; a little pessimistic, for episodes in play at the last failure do not count.
        loss: validation loss of the fit after it.

    """

    number: int
    samples: int
    episodes: int
    success: float
    collision: float
    loss: float


class DAgger:
    """Dataset aggregation with the optimum as the expert.

    Args:
        model: an algorithm of Stable-Baselines3 or its policy, trained in place; best a clone already.
        expert: an `ExpertPolicy` for `venv`; with `reconsider`, so that its labels depend on where the robot is alone.
        venv: the robots, from `make_vec_env`; fresh scenarios (`split="fresh"`) teach most.
        config: settings.
        cloning: settings of the last fit, over all samples; its loss and its batches are those of the others too.
        dataset: what is there already: a `Dataset`, a folder, or demonstrations.
        folder: where each round's samples are kept; None keeps them in memory.
        workers: processes that label; their number changes nothing in the samples.

    Attributes:
        dataset: all samples so far.
        rounds: what each brought.

    Raises:
        TypeError: the robots are none of leapnav's.
        ValueError: a setting is impossible, or observations do not fit.

    """

    def __init__(
        self,
        model: BaseAlgorithm | BasePolicy,
        expert: ExpertPolicy,
        venv: VecEnv,
        config: DAggerConfig | None = None,
        *,
        cloning: CloningConfig | None = None,
        dataset: Dataset | str | os.PathLike[str] | Sequence[Any] | None = None,
        folder: str | os.PathLike[str] | None = None,
        workers: int = 1,
    ) -> None:
        if not isinstance(venv, NavigateVecEnv):
            raise TypeError(f"venv: expected one from leapnav.training.make_vec_env, got {type(venv).__name__}")
        if not expert.drives(venv):
            raise ValueError("expert: expected one for venv; make it with ExpertPolicy(venv)")
        self.config, self._cloning = config or DAggerConfig(), cloning or CloningConfig()
        check_dagger(self.config)
        if workers < 1:
            raise ValueError(f"workers: expected at least 1, got {workers!r}")
        self._policy, self._expert, self._venv, self._workers = policy_of(model), expert, venv, workers
        self._parts: list[Dataset] = [] if dataset is None else [Dataset.of(dataset)]
        if self._parts:
            check_observations(self._policy, self._parts[0])
        self._folder = None if folder is None else Path(folder)
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
        self.rounds: list[Round] = []

    @property
    def dataset(self) -> Dataset:  # noqa: D102 (an attribute, see the class)
        return Dataset.joined(self._parts)

    @property
    def finished(self) -> bool:
        """Whether all rounds have run."""
        return len(self.rounds) >= self.config.rounds

    def run(self, *, progress: bool = True, on_round: Callable[[Round], None] | None = None) -> list[Round]:
        """Runs the rounds that remain.

        Args:
            progress: show progress bars.
            on_round: called after each round.

        """
        while not self.finished:
            found = self.run_round(progress=progress)
            if on_round is not None:
                on_round(found)
        return self.rounds

    def run_round(self, *, progress: bool = True) -> Round:
        """Drives, labels and fits once."""
        number, config = len(self.rounds), self.config
        rng = np.random.default_rng([config.seed, number])
        name = f"Round {number + 1} of {config.rounds}"
        self._venv.seed(environment_seed(config.seed, number))
        failed, succeeded, collision = self._drive(name, progress)
        count = len(failed) + len(succeeded)
        chosen = failed[: config.failures]
        chosen += [succeeded[i] for i in rng.permutation(len(succeeded))[: config.successes]]
        if not chosen:
            raise ValueError(
                f"successes: expected at least 1, got {config.successes}: the learner did not fail in {count} episodes"
            )
        chosen = [chosen[i] for i in rng.permutation(len(chosen))]
        with tqdm(total=len(chosen), desc=f"{name}: labelling", unit="episode", disable=not progress) as bar:
            samples = self._label(chosen, number, rng, bar)
        if self._folder is not None:
            samples.save(self._folder / f"round-{number + 1:03d}.npz")
        self._parts.append(samples)
        settings = self._cloning
        if number + 1 < config.rounds:
            settings = replace(settings, epochs=config.epochs, learning_rate=config.learning_rate, patience=0)
        fit = Cloning(self._policy, self.dataset, settings, stream=number + 1)
        with tqdm(total=settings.epochs * fit.batches, desc="Fitting", unit="batch", disable=not progress) as bar:
            while not fit.finished:
                fit.run_epoch(bar.update)
        fit.finish()
        validation = min(loss.validation for loss in fit.losses)
        done = Round(number + 1, len(samples), count, len(succeeded) / count, collision / count, validation)
        self.rounds.append(done)
        return done

    def restore(self, rounds: Sequence[Round]) -> None:
        """Takes up a run after these rounds, whose samples are in the folder; the model is the caller's business.

        Raises:
            FileNotFoundError, ValueError: a round's samples are not there, or damaged.

        """
        assert self._folder is not None
        for done in rounds:
            self._parts.append(Dataset.load(self._folder / f"round-{done.number:03d}.npz"))
            self.rounds.append(done)

    def _drive(self, name: str, progress: bool) -> tuple[list[Scenario], list[Scenario], int]:
        """The scenarios in which the learner failed and those in which it succeeded, and how often it collided."""
        failed, succeeded, collisions = list[Scenario](), list[Scenario](), 0
        observations = np.asarray(self._venv.reset())
        playing = self._venv.get_attr("scenario")
        with tqdm(total=self.config.failures, desc=f"{name}: driving", unit="failure", disable=not progress) as bar:
            while len(failed) < self.config.failures and len(failed) + len(succeeded) < self.config.episodes:
                actions, _ = self._policy.predict(observations, deterministic=True)
                stepped, _, dones, infos = self._venv.step(actions)
                observations = np.asarray(stepped)
                for i in np.flatnonzero(dones).tolist():
                    (succeeded if infos[i]["is_success"] else failed).append(playing[i])
                    collisions += bool(infos[i]["collision"])
                    bar.update(not infos[i]["is_success"])
                if dones.any():
                    playing = self._venv.get_attr("scenario")
        return failed, succeeded, collisions

    def _label(self, scenarios: Sequence[Scenario], number: int, rng: np.random.Generator, bar: Any) -> Dataset:
        """Drives scenarios once more, with the expert's labels."""
        share = self.config.expert_share * self.config.expert_decay**number
        guided = rng.random(len(scenarios)) < share
        # Always the same portions, so that the number of workers changes nothing.
        portions = [
            _Portion(scenarios[k : k + PORTION], guided[k : k + PORTION], self.config.forgiven)
            for k in range(0, len(scenarios), PORTION)
        ]
        if self._workers == 1:
            jobs = (_label(self._venv, self._expert, self._policy, portion) for portion in portions)
        else:
            run = delayed(_label_elsewhere)
            tasks = (run(self._venv.venv, self._expert.settings, self._policy, portion) for portion in portions)
            jobs = Parallel(self._workers, return_as="generator")(tasks)
        parts = []
        for part, portion in zip(jobs, portions, strict=True):
            parts += [] if part is None else [part]
            bar.update(len(portion.scenarios))
        return Dataset.joined(parts)


@dataclass(frozen=True)
class _Portion:
    """Scenarios to label, in which of them the expert drives, and how long before the horizon labels end (s)."""

    scenarios: Sequence[Scenario]
    guided: np.ndarray
    forgiven: float


def _label_elsewhere(
    robots: NavigateVectorEnv, expert: dict[str, Any], policy: BasePolicy, portion: _Portion
) -> Dataset | None:
    """`_label` in another process, with robots and an expert of its own."""
    th.set_num_threads(1)  # the processes share the cores
    venv = NavigateVecEnv(robots)
    return _label(venv, ExpertPolicy(venv, workers=1, **expert), policy, portion)


def _label(venv: NavigateVecEnv, expert: ExpertPolicy, policy: BasePolicy, portion: _Portion) -> Dataset | None:
    """The samples of a portion, None if there are none."""
    count = venv.num_envs
    waiting = list(enumerate(portion.scenarios))[::-1]
    playing: list[tuple[int, Scenario] | None] = [None] * count  # of each robot: number and scenario
    columns: list[dict[str, np.ndarray]] = []
    observations = np.asarray(venv.reset())
    idle = sample_scenario("open", 0)  # what robots without a task play: nobody looks, and its labels cost little
    ended = np.ones(count, dtype=bool)
    while True:
        for i in np.flatnonzero(ended).tolist():
            playing[i] = waiting.pop() if waiting else None
        if all(task is None for task in playing):
            break
        if ended.any():
            observations = np.asarray(venv.restart(ended, [task[1] if task else idle for task in playing]))
        try:
            labels, _ = expert.predict(observations)
        except NoOptimumError as error:  # of a fresh scenario: nobody has promised one
            ended = np.array([task is not None and task[1] is error.scenario for task in playing])
            continue
        costs, costates = expert.labels()
        times = np.array(venv.get_attr("time"))
        left = np.array([-math.inf if task is None else task[1].horizon for task in playing]) - times
        samples = {
            "observations": observations.copy(),
            "actions": labels,
            "returns": -costs,
            "costates": costates,
            "states": np.array(venv.get_attr("pose")),
            "times": times,
            "executed": np.full(labels.shape, np.nan, np.float32),  # what is driven is not what is labelled
            "rewards": np.full(count, np.nan),
            "episodes": np.array([-1 if task is None else task[0] for task in playing]),
        }
        # Of the robots that can still reach their goals, and have time for it.
        known = np.isfinite(costs) & (left >= portion.forgiven)
        columns.append({name: values[known] for name, values in samples.items()})
        guided = np.array([task is not None and portion.guided[task[0]] for task in playing])
        actions, _ = policy.predict(observations, deterministic=True)
        stepped, _, dones, _ = venv.step(np.where(guided[:, None], labels, actions))
        observations = np.asarray(stepped)
        ended = dones | ~np.isfinite(costs)  # out of reach of the goal there is nothing more to say
    if not any(len(part["actions"]) for part in columns):
        return None
    joined = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
    return Dataset(**joined, scenarios=tuple(scenario.to_json() for scenario in portion.scenarios))


def check_dagger(config: DAggerConfig) -> None:
    """Checks the settings of dataset aggregation.

    Raises:
        ValueError: one is impossible; the message names it and its value.

    """
    for name in ("rounds", "failures", "episodes", "epochs"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}: expected at least 1, got {getattr(config, name)!r}")
    if config.successes < 0:
        raise ValueError(f"successes: expected at least 0, got {config.successes!r}")
    for name in ("expert_share", "expert_decay"):
        if not 0 <= getattr(config, name) <= 1:
            raise ValueError(f"{name}: expected a number in [0, 1], got {getattr(config, name)!r}")
    if not (math.isfinite(config.learning_rate) and config.learning_rate > 0):
        raise ValueError(f"learning_rate: expected a positive number, got {config.learning_rate!r}")
