"""DAgger: the learner drives, the expert takes over, and the learner fits what the expert did from there.

S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning" (AISTATS 2011), with two changes. Control passes from the learner to the expert once in an episode, not at
random in each step (as in S. Ross and D. Bagnell, "Reinforcement and imitation learning via interactive no-regret
learning", 2014): the expert then needs one search, not one for each state, and what it drives is optimal from where it
took over. And driving is cheap, so the learner drives many scenarios, and mostly the episodes in which it failed are
gone back to: the others have little to teach. There the expert takes over earlier and later, until it is too late: most
of what ends in a collision was decided seconds before.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenario import Scenario
from leapnav.envs.settings import Settings
from leapnav.experts.policy import ExpertPolicy, NoOptimumError
from leapnav.training.actors import policy_of
from leapnav.training.cloning import Cloning, check_observations
from leapnav.training.config import CloningConfig, DAggerConfig
from leapnav.training.dataset import Dataset
from leapnav.training.vec_env import NavigateVecEnv, environment_seed

PORTION = 16  # episodes that are labelled together
# s before a collision at which the expert takes over, closer where it matters more; in an episode that misses its goal
# it takes over as often, at any time.
BEFORE = np.array([8.0, 6.5, 5.0, 4.0, 3.25, 2.5, 2.0, 1.5, 1.1, 0.8, 0.5, 0.3])
SPREAD = 0.2  # of these times, relative
TOO_LATE = 1.0  # s before the horizon from which on nobody takes over


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
        expert: an `ExpertPolicy` for `venv`; with `quick=True` best: the tasks that it cannot solve are the dearest.
        venv: the robots, from `make_vec_env`; fresh scenarios (`split="fresh"`) teach most.
        config: settings.
        cloning: settings of the fits' loss and batches.
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
        _check_robots(venv.venv.settings)
        self._parts: list[Dataset] = [] if dataset is None else [Dataset.of(dataset)]
        if self._parts:
            check_observations(self._policy, self._parts[0])
            for name, value in vars(self._parts[0].settings).items():
                if value != (own := getattr(venv.venv.settings, name)):
                    raise ValueError(f"dataset: {name}: expected that of the robots, {own!r}, got {value!r}")
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
        episodes = self._drive(name, progress)
        failed = [episode for episode in episodes if not episode.success]
        succeeded = [episode for episode in episodes if episode.success]
        count = round(config.successes * max(1, len(failed)))
        chosen = failed + [succeeded[i] for i in rng.permutation(len(succeeded))[:count]]
        turns = [_takeovers(episode, self._venv.venv.settings.control_period, rng) for episode in chosen]
        turns = [turns[i] for i in rng.permutation(len(turns)) if turns[i]]
        with tqdm(total=len(turns), desc=f"{name}: labelling", unit="episode", disable=not progress) as bar:
            samples = self._label(turns, bar)
        if samples is not None:
            if self._folder is not None:
                samples.save(self._folder / f"round-{number + 1:03d}.npz")
            self._parts.append(samples)
        epochs = config.epochs if number + 1 < config.rounds else config.last_epochs
        settings = replace(self._cloning, epochs=epochs, learning_rate=config.learning_rate, patience=0)
        fit = Cloning(self._policy, self.dataset, settings, stream=number + 1)
        with tqdm(total=settings.epochs * fit.batches, desc="Fitting", unit="batch", disable=not progress) as bar:
            while not fit.finished:
                fit.run_epoch(bar.update)
        fit.finish()
        done = Round(
            number=number + 1,
            samples=0 if samples is None else len(samples),
            episodes=len(episodes),
            success=len(succeeded) / len(episodes),
            collision=sum(episode.collision for episode in episodes) / len(episodes),
            loss=min(loss.validation for loss in fit.losses),
        )
        self.rounds.append(done)
        return done

    def restore(self, rounds: Sequence[Round]) -> None:
        """Takes up a run after these rounds, whose samples are in the folder; the model is the caller's business.

        Raises:
            FileNotFoundError, ValueError: a round's samples are not there, or damaged.

        """
        assert self._folder is not None
        for done in rounds:
            self.rounds.append(done)
            if done.samples == 0:
                continue
            self._parts.append(Dataset.load(self._folder / f"round-{done.number:03d}.npz"))

    def _drive(self, name: str, progress: bool) -> list[_Episode]:
        """The episodes that the learner drives in a round."""
        count = self._venv.num_envs
        observations = np.asarray(self._venv.reset())
        playing = self._venv.get_attr("scenario")
        paths: list[list[np.ndarray]] = [[] for _ in range(count)]
        episodes: list[_Episode] = []
        failures = 0
        with tqdm(total=self.config.failures, desc=f"{name}: driving", unit="failure", disable=not progress) as bar:
            while failures < self.config.failures and len(episodes) < self.config.episodes:
                for path, pose in zip(paths, self._venv.venv.poses, strict=True):
                    path.append(pose)
                actions, _ = self._policy.predict(observations, deterministic=True)
                stepped, _, dones, infos = self._venv.step(actions)
                observations = np.asarray(stepped)
                for i in np.flatnonzero(dones).tolist():
                    success, collision = bool(infos[i]["is_success"]), bool(infos[i]["collision"])
                    episodes.append(_Episode(playing[i], np.array(paths[i]), success, collision))
                    paths[i] = []
                    failures += not success
                    bar.update(not success)
                if dones.any():
                    playing = self._venv.get_attr("scenario")
        return episodes

    def _label(self, turns: Sequence[Sequence[Scenario]], bar: Any) -> Dataset | None:
        """What the expert does where it takes over, None if it can do nothing anywhere."""
        # Always the same portions, so that the number of workers changes nothing.
        portions = [turns[k : k + PORTION] for k in range(0, len(turns), PORTION)]
        settings, run = self._venv.venv.settings, delayed(_label)
        tasks = (run(settings, self._expert.settings, portion, self.config.lead) for portion in portions)
        labelled = cast(Iterator[list[Dataset]], Parallel(self._workers, return_as="generator")(tasks))
        parts: list[Dataset] = []
        for found, portion in zip(labelled, portions, strict=True):
            parts += found
            bar.update(len(portion))
        return Dataset.joined(parts) if parts else None


@dataclass(frozen=True)
class _Episode:
    """What the learner drove: the poses (K, 3) before its K actions."""

    scenario: Scenario
    poses: np.ndarray
    success: bool
    collision: bool


def _takeovers(episode: _Episode, period: float, rng: np.random.Generator) -> list[Scenario]:
    """The rests of an episode, from where the expert takes over, the longest first."""
    end, horizon = len(episode.poses) * period, episode.scenario.horizon
    if episode.success:
        times = rng.uniform(0.0, end, 1)
    elif episode.collision:
        times = end - BEFORE * rng.uniform(1 - SPREAD, 1 + SPREAD, len(BEFORE))
    else:
        times = np.sort(rng.uniform(0.0, end, len(BEFORE)))
    steps = np.unique((times / period).round().astype(int))
    found = []
    for step in steps[(steps > 0) & (steps < len(episode.poses))].tolist():
        if horizon - step * period < TOO_LATE:
            break
        rest = {"start": tuple(episode.poses[step].tolist()), "horizon": round(horizon - step * period, 9)}
        found.append(episode.scenario.model_copy(update=rest))
    return found


def _label(
    settings: Settings, expert: dict[str, Any], turns: Sequence[Sequence[Scenario]], lead: float
) -> list[Dataset]:
    """What an expert does in the first seconds of scenarios: of several of one episode until it cannot save it."""
    arguments = {name: value for name, value in vars(settings).items() if name != "goal_conditioned"}
    env = NavigateEnv(split="fresh", **arguments)
    driver = ExpertPolicy(env, workers=1, **expert)
    found = []
    for scenarios in turns:
        for scenario in scenarios:
            samples = _demonstrated(env, driver, scenario, lead)
            if samples is None:
                break
            found.append(samples)
    return found


def _demonstrated(env: NavigateEnv, driver: ExpertPolicy, scenario: Scenario, lead: float) -> Dataset | None:
    """The samples of the first seconds that the expert drives, None if it has no optimum."""
    observation, info = env.reset(options={"scenario": scenario})
    rows: list[tuple[Any, ...]] = []
    done = False
    while not done and env.time < lead - 1e-9:
        try:
            action, _ = driver.predict(observation)
        except NoOptimumError:
            return None
        cost, costate = driver.labels()
        if not math.isfinite(cost[0]):  # the goal is out of reach: what it does then is no label
            break
        before = observation, action, -cost[0], costate[0], info["pose"], info["time"]
        observation, reward, done, _, info = env.step(action)
        rows.append((*before, action, reward))
    if not rows:
        return None
    names = "observations", "actions", "returns", "costates", "states", "times", "executed", "rewards"
    columns: dict[str, Any] = {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    columns["episodes"] = np.zeros(len(rows), dtype=int)
    return Dataset(**columns, scenarios=(scenario.to_json(),), settings=env.settings)


def _check_robots(settings: Settings) -> None:
    """Refuses robots whose episodes a pose and a time do not continue."""
    for name in ("disturbed", "motors", "dict_observation", "goal_conditioned"):
        if getattr(settings, name):
            raise ValueError(f"venv: DAgger needs robots that are not {name}: the expert goes on from poses alone")


def check_dagger(config: DAggerConfig) -> None:
    """Checks the settings of dataset aggregation.

    Raises:
        ValueError: one is impossible; the message names it and its value.

    """
    for name in ("rounds", "failures", "episodes", "epochs", "last_epochs"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}: expected at least 1, got {getattr(config, name)!r}")
    if not (math.isfinite(config.successes) and config.successes >= 0):
        raise ValueError(f"successes: expected a number >= 0, got {config.successes!r}")
    for name in ("learning_rate", "lead"):
        if not (math.isfinite(getattr(config, name)) and getattr(config, name) > 0):
            raise ValueError(f"{name}: expected a positive number, got {getattr(config, name)!r}")
