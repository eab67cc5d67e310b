"""DAgger: the learner drives, the expert says what it would have done there, and the learner fits all of it.

S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning" (AISTATS 2011). Who drives is drawn for each episode, not for each step: a robot that changes hands at every
step would see what neither of the two leads to.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from leapnav.envs.scenario import Scenario
from leapnav.experts.policy import ExpertPolicy, NoOptimumError
from leapnav.training.actors import policy_of
from leapnav.training.cloning import Cloning, check_observations
from leapnav.training.config import CloningConfig, DAggerConfig
from leapnav.training.dataset import Dataset

SEEDS_PER_ROUND = 1_000_000  # more than there are robots


@dataclass(frozen=True)
class Round:
    """What a round of DAgger brought.

    Attributes:
        number: from 1 on.
        samples: labelled in this round.
        success, collision: rates of the episodes that the learner drove to their end; NaN without any.
        loss: validation loss of the fit after it.

    """

    number: int
    samples: int
    success: float
    collision: float
    loss: float


class DAgger:
    """Dataset aggregation with the optimum as the expert.

    Args:
        model: an algorithm of Stable-Baselines3 or its policy, trained in place; best a clone already.
        expert: an `ExpertPolicy` for `venv`.
        venv: the robots, see `make_vec_env`; fresh scenarios (`split="fresh"`) teach most.
        config: settings.
        cloning: settings of the last fit, over all samples; its loss and its batches are those of the others too.
        dataset: what is there already: a `Dataset`, a folder, or demonstrations.
        folder: where each round's samples are kept; rounds that are there already are not driven again. None keeps them
            in memory.

    Attributes:
        dataset: all samples so far.
        rounds: what each brought.

    Raises:
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
    ) -> None:
        self.config, self._cloning = config or DAggerConfig(), cloning or CloningConfig()
        _check(self.config)
        self._policy, self._expert, self._venv = policy_of(model), expert, venv
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
        number = len(self.rounds)
        path = None if self._folder is None else self._folder / f"round-{number + 1:03d}.npz"
        samples, success, collision = self._drive(number, progress)
        if path is not None:
            samples.save(path)
        self._parts.append(samples)
        last = number + 1 == self.config.rounds
        settings = self._cloning
        if not last:
            settings = replace(settings, epochs=self.config.epochs, learning_rate=self.config.learning_rate, patience=0)
        fit = Cloning(self._policy, self.dataset, replace(settings, seed=settings.seed + number))
        with tqdm(total=settings.epochs * fit.batches, desc="Fitting", unit="batch", disable=not progress) as bar:
            while not fit.finished:
                fit.run_epoch(bar.update)
        fit.finish()
        validation = min(loss.validation for loss in fit.losses)
        self.rounds.append(Round(number + 1, len(samples), success, collision, validation))
        return self.rounds[-1]

    def restore(self, rounds: Sequence[Round]) -> None:
        """Takes up a run after these rounds, whose samples are in the folder; the model is the caller's business.

        Raises:
            FileNotFoundError, ValueError: a round's samples are not there, or damaged.

        """
        assert self._folder is not None
        for done in rounds:
            self._parts.append(Dataset.load(self._folder / f"round-{done.number:03d}.npz"))
            self.rounds.append(done)

    def _drive(self, number: int, progress: bool) -> tuple[Dataset, float, float]:
        """A round's samples, and how the learner's own episodes ended."""
        config, count = self.config, self._venv.num_envs
        rng = np.random.default_rng([config.seed, number])
        share = config.expert_share * config.expert_decay**number
        self._venv.seed(config.seed + SEEDS_PER_ROUND * (number + 1))
        observations = np.asarray(self._venv.reset())
        guided = rng.random(count) < share
        self._playing: list[Scenario | None] = [None] * count  # of each robot, and its number among the texts
        self._episode, self._texts = np.zeros(count, dtype=int), list[str]()
        columns: list[dict[str, np.ndarray]] = []
        ends: list[tuple[bool, bool]] = []
        desc = f"Round {number + 1} of {config.rounds}"
        for _ in tqdm(range(config.steps), desc=desc, unit="step", disable=not progress):
            try:
                labels, _ = self._expert.predict(observations)
            except NoOptimumError:  # of a fresh scenario: nobody has promised one
                observations, guided = np.asarray(self._venv.reset()), rng.random(count) < share
                continue
            columns.append(self._labelled(observations, labels))
            actions, _ = self._policy.predict(observations, deterministic=True)
            actions = np.where(guided[:, None], labels, actions)
            stepped, _, dones, infos = self._venv.step(actions)
            observations = np.asarray(stepped)
            for i in np.flatnonzero(dones).tolist():
                if not guided[i]:
                    ends.append((bool(infos[i]["is_success"]), bool(infos[i]["collision"])))
                guided[i] = rng.random() < share
        joined = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
        samples = Dataset(**joined, scenarios=tuple(self._texts))
        success, collision = np.mean(ends, axis=0).tolist() if ends else (math.nan, math.nan)
        return samples, success, collision

    def _labelled(self, observations: np.ndarray, labels: np.ndarray) -> dict[str, np.ndarray]:
        """What the expert says of the robots that can still reach their goals, and have time for it."""
        costs, costates = self._expert.labels()
        scenarios: list[Scenario] = self._venv.get_attr("scenario")
        for i, scenario in enumerate(scenarios):
            if scenario is not self._playing[i]:  # a new episode
                self._playing[i], self._episode[i] = scenario, len(self._texts)
                self._texts.append(scenario.to_json())
        times = np.array(self._venv.get_attr("time"))
        left = np.array([scenario.horizon for scenario in scenarios]) - times
        known = np.isfinite(costs) & (left >= self.config.forgiven)
        columns = {
            "observations": observations.copy(),
            "actions": labels,
            "returns": -costs,
            "costates": costates,
            "states": np.array(self._venv.get_attr("pose")),
            "times": times,
            "executed": labels,
            "rewards": np.full(len(labels), np.nan),  # what is driven is not what is labelled
            "episodes": self._episode.copy(),
        }
        return {name: values[known] for name, values in columns.items()}


def _check(config: DAggerConfig) -> None:
    for name in ("rounds", "steps", "epochs"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}: expected at least 1, got {getattr(config, name)!r}")
    for name in ("expert_share", "expert_decay"):
        if not 0 <= getattr(config, name) <= 1:
            raise ValueError(f"{name}: expected a number in [0, 1], got {getattr(config, name)!r}")
    if not (math.isfinite(config.learning_rate) and config.learning_rate > 0):
        raise ValueError(f"learning_rate: expected a positive number, got {config.learning_rate!r}")
