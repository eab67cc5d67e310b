"""DAgger: the learner drives, the expert takes over, and the learner is fitted to the expert's actions from there.

S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning" (AISTATS 2011), with two changes. First, control passes from the learner to the expert once per episode
instead of at random in each step, as in S. Ross and D. Bagnell, "Reinforcement and imitation learning via interactive
no-regret learning" (2014). The expert then needs one search per takeover instead of one per state, and its actions are
optimal from the state of the takeover. Second, since rollouts of the learner are inexpensive, it drives many scenarios,
and most takeovers are in the episodes in which it failed. In a failed episode the expert takes over at several times,
because most collisions are decided seconds before.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.progress import advance, progress_bar, stop_early
from leapnav.envs.utils.validation import check_at_least, check_choice, check_not_negative, check_positive
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.experts.optimum import EFFORTS, Effort
from leapnav.training.fit_settings import CloningConfig, DAggerConfig
from leapnav.training.learning.cloning import behaviour_clone, check_observations
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.driving import DrivenEpisode, drive_episodes
from leapnav.training.learning.takeovers import Labeller, label_episodes
from leapnav.training.policies.actors import policy_of
from leapnav.training.threads import limit_threads

LABELLED_PER_TASK = 16  # episodes in one task of a worker
SCENARIO_STREAM, TAKEOVER_STREAM = 1, 2  # streams of the seed of a round
# Properties of the environment's settings that DAgger does not support, as named in the error message.
_UNSUPPORTED = {
    "disturbed": "disturbances",
    "motors": "motors",
    "dict_observation": "dict observations",
    "goal_conditioned": "goal conditioning",
}


@dataclass(frozen=True)
class Round:
    """Statistics of one round.

    Attributes:
        number: index of the round, from 1.
        samples: number of samples labelled in the round.
        episodes: number of episodes driven by the learner.
        success, collision: success rate and collision rate of these episodes. They are slightly pessimistic, since
            episodes that are unfinished at the last failure are not counted.
        loss: validation loss of the fit.

    """

    number: int
    samples: int
    episodes: int
    success: float
    collision: float
    loss: float


class DAgger:
    """Dataset aggregation with the optimal controller as the expert.

    Args:
        model: a Stable-Baselines3 algorithm or its policy, trained in place; preferably a clone of the expert.
        scenarios: the name of a family, from which each round draws new scenarios, or a bank.
        config: settings.
        environment: arguments of the environment, such as `observation`, `robot` or `horizon`.
        cloning: settings of the fits, of which `epochs`, `learning_rate` and `patience` are ignored.
        dataset: initial samples: a `Dataset`, a directory written by `leapnav rollout`, or demonstrations.
        folder: directory in which the samples of each round are stored; None keeps them in memory only.
        robots: number of robots that a process simulates together; the scenarios depend on it.
        effort: effort of the expert's searches, see `find_optimum`; "low" misses a few optima, and the scenarios
            without any take most of the time of higher efforts.
        workers: number of processes; the samples do not depend on it.

    Attributes:
        dataset: all samples so far.
        rounds: statistics of the rounds so far.

    Raises:
        TypeError: an argument of the environment is unknown, or another one has a wrong type.
        ValueError: a setting is invalid, or the environment and the observations do not fit.

    """

    def __init__(
        self,
        model: BaseAlgorithm | BasePolicy,
        scenarios: str | ScenarioBank = "clutter",
        config: DAggerConfig | None = None,
        *,
        environment: Mapping[str, Any] | None = None,
        cloning: CloningConfig | None = None,
        dataset: Dataset | str | os.PathLike[str] | Sequence[Any] | None = None,
        folder: str | os.PathLike[str] | None = None,
        robots: int = 256,
        effort: Effort = "low",
        workers: int = 1,
    ) -> None:
        if not isinstance(cast(object, scenarios), (str, ScenarioBank)):
            raise TypeError(
                f"scenarios: expected the name of a family or a ScenarioBank, got {type(scenarios).__name__}"
            )
        if not isinstance(cast(object, config), (DAggerConfig, type(None))):
            raise TypeError(f"config: expected a DAggerConfig, got {type(config).__name__}")
        self.config, self._cloning = config or DAggerConfig(), cloning or CloningConfig()
        check_dagger(self.config)
        check_at_least("workers", workers, 1)
        check_at_least("robots", robots, 1)
        check_choice("effort", effort, EFFORTS)
        chosen = {"bank": scenarios} if isinstance(scenarios, ScenarioBank) else {"family": scenarios, "split": "fresh"}
        env = NavigateVectorEnv(1, **chosen, **(environment or {}))
        self._source, self._settings = env.source, env.settings
        _check_environment(self._settings)
        self._policy, self._robots, self._workers = policy_of(model), robots, workers
        if self._policy.observation_space != env.single_observation_space:
            has, expected = env.single_observation_space.shape, self._policy.observation_space.shape
            raise ValueError(
                f"environment: has observations {has}, the policy's are {expected} or have other bounds; pass the "
                "arguments of gym.make that it was trained with"
            )
        self._effort: Effort = effort
        self._parts: list[Dataset] = [] if dataset is None else [Dataset.of(dataset)]
        if self._parts:
            check_observations(self._policy, self._parts[0])
            self._parts[0].warn_of_other(self._source)
            for name, value in vars(self._parts[0].settings).items():
                if value != (own := getattr(self._settings, name)):
                    raise ValueError(f"dataset: {name}: expected that of the environment, {own!r}, got {value!r}")
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
        """Run the remaining rounds.

        Args:
            progress: show progress bars.
            on_round: function called after each round.

        Returns:
            The statistics of all rounds.

        """
        while not self.finished:
            done = self.run_round(progress=progress)
            if on_round is not None:
                on_round(done)
        return self.rounds

    @limit_threads
    def run_round(self, *, progress: bool = True) -> Round:
        """Run one round: rollouts of the learner, labelling by the expert, and a fit to all samples."""
        number, config = len(self.rounds), self.config
        rng = np.random.default_rng([config.seed, number])
        name = f"Round {number + 1} of {config.rounds}"
        episodes = self._drive(name, progress)
        chosen = self._choose_episodes(episodes, rng)
        with progress_bar(total=len(chosen), label=f"{name}: labelling", unit="episodes", show=progress) as bar:
            samples = self._label(chosen, bar)
        if samples is not None:
            if self._folder is not None:
                samples.save(self._folder / f"round-{number + 1:03d}.npz")
            self._parts.append(samples)
        loss = self._fit(number, progress)
        done = Round(
            number=number + 1,
            samples=0 if samples is None else len(samples),
            episodes=len(episodes),
            success=sum(episode.played.success for episode in episodes) / len(episodes),
            collision=sum(episode.played.collision for episode in episodes) / len(episodes),
            loss=loss,
        )
        self.rounds.append(done)
        return done

    def restore(self, rounds: Sequence[Round]) -> None:
        """Resume after rounds whose samples are in `folder`; the caller restores the model.

        Args:
            rounds: statistics of the rounds.

        Raises:
            FileNotFoundError: the samples of a round are missing.
            ValueError: the samples of a round are damaged.

        """
        assert self._folder is not None
        for done in rounds:
            self.rounds.append(done)
            if done.samples == 0:
                continue
            self._parts.append(Dataset.load(self._folder / f"round-{done.number:03d}.npz"))

    def _drive(self, name: str, progress: bool) -> list[DrivenEpisode]:
        """Return the episodes that the learner drives in a round."""
        config, seed = self.config, (self.config.seed, len(self.rounds), SCENARIO_STREAM)
        episodes: list[DrivenEpisode] = []
        failures, robots = 0, min(self._robots, config.max_episodes)
        driving = drive_episodes(self._policy, self._source, self._settings, seed, robots=robots, workers=self._workers)
        label = f"{name}: driving"
        with progress_bar(total=config.max_failures, label=label, unit="failures", show=progress) as bar:
            while failures < config.max_failures and len(episodes) < config.max_episodes:
                episodes.append(next(driving))
                failures += not episodes[-1].played.success
                advance(bar, not episodes[-1].played.success)
            if failures < config.max_failures:
                stop_early(bar, f"{len(episodes)} episodes with {failures} failures")
        driving.close()
        return episodes

    def _choose_episodes(self, episodes: Sequence[DrivenEpisode], rng: np.random.Generator) -> list[DrivenEpisode]:
        """Return all failed and some of the successful episodes, in random order."""
        failed = [episode for episode in episodes if not episode.played.success]
        succeeded = [episode for episode in episodes if episode.played.success]
        count = round(self.config.successes * max(1, len(failed)))
        chosen = failed + [succeeded[i] for i in rng.permutation(len(succeeded))[:count]]
        return [chosen[i] for i in rng.permutation(len(chosen))]

    def _label(self, episodes: Sequence[DrivenEpisode], bar: Any) -> Dataset | None:
        """Return the samples of the expert after the takeovers; None if it has no optimum in any of them."""
        # The division into tasks does not depend on the number of workers, and neither do the samples.
        portions = [episodes[k : k + LABELLED_PER_TASK] for k in range(0, len(episodes), LABELLED_PER_TASK)]
        labeller = Labeller(self._settings, self.config.lead, self._effort)
        seed = self.config.seed, len(self.rounds), TAKEOVER_STREAM
        tasks = (delayed(label_episodes)(labeller, portion, (*seed, number)) for number, portion in enumerate(portions))
        labelled = cast(Iterator[list[Dataset]], Parallel(self._workers, return_as="generator")(tasks))
        parts: list[Dataset] = []
        for datasets, portion in zip(labelled, portions, strict=True):
            parts += datasets
            bar.update(len(portion))
        return Dataset.joined(parts) if parts else None

    def _fit(self, number: int, progress: bool) -> float:
        """Fit the policy to all samples after a round, and return the lowest validation loss."""
        config = self.config
        epochs = config.epochs if number + 1 < config.rounds else config.last_epochs
        settings = replace(self._cloning, epochs=epochs, learning_rate=config.learning_rate, patience=0)
        losses = behaviour_clone(
            self._policy, self.dataset, settings, progress=progress, label="Fitting", stream=number + 1
        )
        return min(loss.validation for loss in losses)


def _check_environment(settings: EnvironmentSettings) -> None:
    """Raise ValueError unless an episode can be continued from a state and a time alone."""
    for name, feature in _UNSUPPORTED.items():
        if getattr(settings, name):
            raise ValueError(
                f"environment: expected one without {feature}; the expert starts from states of the robot alone"
            )


def check_dagger(config: DAggerConfig) -> None:
    """Raise ValueError unless the settings of DAgger are valid; the message names the setting and its value."""
    for name in ("rounds", "max_failures", "max_episodes", "epochs", "last_epochs"):
        check_at_least(name, getattr(config, name), 1)
    check_not_negative("successes", config.successes)
    for name in ("learning_rate", "lead"):
        check_positive(name, getattr(config, name))
