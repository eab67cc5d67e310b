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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from leapnav.envs.episodes import play_episode
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.progress import advance, progress_bar, stop_early
from leapnav.envs.utils.validation import check_at_least, check_not_negative, check_positive
from leapnav.experts.acting.policy import ExpertPolicy, NoOptimumError
from leapnav.experts.data.demonstrations import state_of
from leapnav.training.config import CloningConfig, DAggerConfig
from leapnav.training.learning.cloning import Cloning, check_observations
from leapnav.training.learning.dataset import Dataset
from leapnav.training.policies.actors import policy_of
from leapnav.training.robots.vec_env import NavigateVecEnv, environment_seed
from leapnav.training.threads import limit_threads

EPISODES_PER_TASK = 16  # episodes labelled in one task of a worker
# Times of the takeovers before a collision (s), denser shortly before it. In an episode that misses its goal the number
# of takeovers is the same, at uniformly distributed times. With a free horizon, a robot that misses its goal has mostly
# stopped, between two paths of similar cost: the times are then those before a time shortly after the stop.
TAKEOVER_TIMES = np.array([8.0, 6.5, 5.0, 4.0, 3.25, 2.5, 2.0, 1.5, 1.1, 0.8, 0.5, 0.3])
STOP_DISTANCE, AFTER_STOP = 0.1, 0.6  # m (and rad) from the last state; s
RELATIVE_SPREAD = 0.2  # half-width of the random factor of these times around 1
MIN_TIME_LEFT = 1.0  # s before the horizon, after which the expert does not take over
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
        expert: an `ExpertPolicy` for `venv`, preferably with `quick=True`: the scenarios that it cannot solve take most
            of the time.
        venv: a vector environment from `make_vec_env`, preferably with `split="fresh"`.
        config: settings.
        cloning: settings of the fits, of which `epochs`, `learning_rate` and `patience` are ignored.
        dataset: initial samples: a `Dataset`, a directory written by `leapnav rollout`, or demonstrations.
        folder: directory in which the samples of each round are stored; None keeps them in memory only.
        workers: number of processes for the labelling; it does not affect the samples.

    Attributes:
        dataset: all samples so far.
        rounds: statistics of the rounds so far.

    Raises:
        TypeError: `venv` is not from `make_vec_env`.
        ValueError: a setting is invalid, or the environment, the expert and the observations do not fit.

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
        check_at_least("workers", workers, 1)
        self._policy, self._expert, self._venv, self._workers = policy_of(model), expert, venv, workers
        _check_environment(venv.venv.settings)
        self._parts: list[Dataset] = [] if dataset is None else [Dataset.of(dataset)]
        if self._parts:
            check_observations(self._policy, self._parts[0])
            for name, value in vars(self._parts[0].settings).items():
                if value != (own := getattr(venv.venv.settings, name)):
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
        self._venv.seed(environment_seed(config.seed, number))
        episodes = self._drive(name, progress)
        takeovers = self._choose_takeovers(episodes, rng)
        with progress_bar(total=len(takeovers), label=f"{name}: labelling", unit="episodes", show=progress) as bar:
            samples = self._label(takeovers, bar)
        if samples is not None:
            if self._folder is not None:
                samples.save(self._folder / f"round-{number + 1:03d}.npz")
            self._parts.append(samples)
        loss = self._fit(number, progress)
        done = Round(
            number=number + 1,
            samples=0 if samples is None else len(samples),
            episodes=len(episodes),
            success=sum(episode.success for episode in episodes) / len(episodes),
            collision=sum(episode.collision for episode in episodes) / len(episodes),
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

    def _drive(self, name: str, progress: bool) -> list[_Episode]:
        """Return the episodes that the learner drives in a round."""
        count = self._venv.num_envs
        observations = np.asarray(self._venv.reset())
        playing = self._venv.get_attr("scenario")
        paths: list[list[np.ndarray]] = [[] for _ in range(count)]
        episodes: list[_Episode] = []
        failures = 0
        driving = f"{name}: driving"
        memory, starts = None, np.ones(count, dtype=bool)
        with progress_bar(total=self.config.max_failures, label=driving, unit="failures", show=progress) as bar:
            while failures < self.config.max_failures and len(episodes) < self.config.max_episodes:
                for path, state in zip(paths, self._venv.venv.states, strict=True):
                    path.append(state)
                actions, memory = self._policy.predict(observations, memory, starts, deterministic=True)
                stepped, _, starts, infos = self._venv.step(actions)
                observations = np.asarray(stepped)
                for i in np.flatnonzero(starts).tolist():
                    success, collision = bool(infos[i]["is_success"]), bool(infos[i]["collision"])
                    episodes.append(_Episode(playing[i], np.array(paths[i]), success, collision))
                    paths[i] = []
                    failures += not success
                    advance(bar, not success)
                if starts.any():
                    playing = self._venv.get_attr("scenario")
            if failures < self.config.max_failures:
                stop_early(bar, f"{len(episodes)} episodes with {failures} failures")
        return episodes

    def _choose_takeovers(self, episodes: Sequence[_Episode], rng: np.random.Generator) -> list[list[Scenario]]:
        """Return the scenarios that start at the takeovers, for all failed and some of the successful episodes."""
        failed = [episode for episode in episodes if not episode.success]
        succeeded = [episode for episode in episodes if episode.success]
        count = round(self.config.successes * max(1, len(failed)))
        chosen = failed + [succeeded[i] for i in rng.permutation(len(succeeded))[:count]]
        takeovers = [_takeovers(episode, self._venv.venv.settings.control_period, rng) for episode in chosen]
        return [takeovers[i] for i in rng.permutation(len(takeovers)) if takeovers[i]]

    def _label(self, takeovers: Sequence[Sequence[Scenario]], bar: Any) -> Dataset | None:
        """Return the samples of the expert after the takeovers; None if it has no optimum in any of them."""
        # The division into tasks does not depend on the number of workers, and neither do the samples.
        portions = [takeovers[k : k + EPISODES_PER_TASK] for k in range(0, len(takeovers), EPISODES_PER_TASK)]
        settings, run = self._venv.venv.settings, delayed(_label)
        tasks = (run(settings, self._expert.settings, portion, self.config.lead) for portion in portions)
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
        fit = Cloning(self._policy, self.dataset, settings, stream=number + 1)
        with progress_bar(total=fit.epochs * fit.batches, label="Fitting", unit="batches", show=progress) as bar:
            while not fit.finished:
                fit.run_epoch(bar.update)
        fit.finish()
        return min(loss.validation for loss in fit.losses)


@dataclass(frozen=True)
class _Episode:
    """An episode of the learner: its scenario, the states (K, n) before its K actions, and its outcome."""

    scenario: Scenario
    states: np.ndarray
    success: bool
    collision: bool


def _takeovers(episode: _Episode, period: float, rng: np.random.Generator) -> list[Scenario]:
    """Return scenarios for the rest of an episode, each from a takeover, with decreasing times left."""
    end, horizon = len(episode.states) * period, episode.scenario.horizon
    if episode.success:
        times = rng.uniform(0.0, end, 1)
    elif episode.collision or horizon is None:
        n_takeovers = len(TAKEOVER_TIMES)
        decision = end if episode.collision else min(_stop_time(episode.states, period) + AFTER_STOP, end)
        times = decision - TAKEOVER_TIMES * rng.uniform(1 - RELATIVE_SPREAD, 1 + RELATIVE_SPREAD, n_takeovers)
    else:
        times = np.sort(rng.uniform(0.0, end, len(TAKEOVER_TIMES)))
    steps = np.unique((times / period).round().astype(int))
    scenarios = []
    for step in steps[(steps > 0) & (steps < len(episode.states))].tolist():
        if horizon is not None and horizon - step * period < MIN_TIME_LEFT:
            break
        x, y, heading, *motion = episode.states[step].tolist()
        rest: dict[str, Any] = {"start": (x, y, heading)}
        if horizon is not None:
            rest["horizon"] = round(horizon - step * period, 9)
        if motion:
            rest["start_motion"] = tuple(motion)
        scenarios.append(episode.scenario.model_copy(update=rest))
    return scenarios


def _stop_time(states: np.ndarray, period: float) -> float:
    """Return the time (s) from which the robot stays where the episode ends."""
    distances = np.linalg.norm(states[:, :3] - states[-1, :3], axis=1)
    moving = np.flatnonzero(distances > STOP_DISTANCE)
    return period * (int(moving[-1]) + 1 if len(moving) else 0)


def _label(
    settings: EnvironmentSettings, expert: dict[str, Any], takeovers: Sequence[Sequence[Scenario]], lead: float
) -> list[Dataset]:
    """Return the samples of the first `lead` seconds after takeovers, grouped by episode in order of time.

    After the first takeover of an episode without an optimum the later ones are skipped.
    """
    arguments = {name: value for name, value in vars(settings).items() if name != "goal_conditioned"}
    env = NavigateEnv(split="fresh", **arguments)
    policy = ExpertPolicy(env, workers=1, **expert)
    datasets = []
    for scenarios in takeovers:
        for scenario in scenarios:
            samples = _demonstrated(env, policy, scenario, lead)
            if samples is None:
                break
            datasets.append(samples)
    return datasets


def _demonstrated(env: NavigateEnv, expert: ExpertPolicy, scenario: Scenario, lead: float) -> Dataset | None:
    """Return the samples of the first `lead` seconds of an episode of the expert; None if it has no optimum."""
    rows: list[tuple[Any, ...]] = []

    def act(observation: Any, info: dict[str, Any]) -> np.ndarray | None:
        if info["time"] >= lead - 1e-9:
            return None
        action, _ = expert.predict(observation)
        cost, costate = expert.labels()
        if not np.isfinite(cost[0]):  # the goal cannot be reached any more, so the action is not a label
            return None
        rows.append((observation, action, -cost[0], costate[0], state_of(info), info["time"], action))
        return action

    try:
        _, _, steps = play_episode(env, act, options={"scenario": scenario})
        rewards = [step.reward for step in steps]
    except NoOptimumError:
        return None
    if not rows:
        return None
    names = "observations", "actions", "returns", "costates", "states", "times", "executed"
    columns: dict[str, Any] = {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    return Dataset(
        **columns,
        rewards=np.array(rewards),
        episodes=np.zeros(len(rows), dtype=int),
        scenarios=(scenario.to_json(),),
        settings=env.settings,
    )


def _check_environment(settings: EnvironmentSettings) -> None:
    """Raise ValueError unless an episode can be continued from a state and a time alone."""
    for name, feature in _UNSUPPORTED.items():
        if getattr(settings, name):
            raise ValueError(
                f"venv: expected an environment without {feature}; the expert starts from states of the robot alone"
            )


def check_dagger(config: DAggerConfig) -> None:
    """Raise ValueError unless the settings of DAgger are valid; the message names the setting and its value."""
    for name in ("rounds", "max_failures", "max_episodes", "epochs", "last_epochs"):
        check_at_least(name, getattr(config, name), 1)
    check_not_negative("successes", config.successes)
    for name in ("learning_rate", "lead"):
        check_positive(name, getattr(config, name))
