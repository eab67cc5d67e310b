"""Runs of reinforcement learning: PPO, SAC and TQC, from scratch or with a warm start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import task_of
from leapnav.envs.unwrapping import unwrap
from leapnav.envs.utils.progress import advance, progress_bar
from leapnav.envs.utils.validation import check_choice
from leapnav.envs.vector import NavigateVectorEnv
from leapnav.training.config import PPOConfig, SACConfig
from leapnav.training.environments.level_samplers import VALUE_SCORES, PrioritizedSampler, UniformSampler
from leapnav.training.environments.level_scoring import LevelScoring
from leapnav.training.environments.vec_env import environment_seed, make_vec_env
from leapnav.training.learning.dataset import Dataset
from leapnav.training.learning.replay import DemonstrationReplayBuffer, imitate
from leapnav.training.learning.warm_start import warm_start
from leapnav.training.policies.actors import actor_parameters, copy_actor, set_noise
from leapnav.training.policies.files import load_policy, policy_environment, policy_folder
from leapnav.training.policies.navigation_policy import (
    MomentumSACPolicy,
    NavigationPolicy,
    components_of,
    symmetries_of,
)
from leapnav.training.policies.network import network
from leapnav.training.policies.symmetries import Transformation, symmetries
from leapnav.training.runs.checks import check_config, check_demonstrations, check_robots, warn_of_family
from leapnav.training.runs.imitation import mean_scores, observed_settings
from leapnav.training.runs.run import Run
from leapnav.training.scoring.results import Evaluation
from leapnav.training.threads import limit_threads

Config = PPOConfig | SACConfig


@limit_threads
def train_ppo(
    config: PPOConfig,
    *,
    callback: MaybeCallback = None,
    wrapper: Callable[[VecEnv], VecEnv] | None = None,
    progress: bool = True,
) -> list[Evaluation]:
    """Train a policy by proximal policy optimisation.

    With `config.resume` the run resumes from its last checkpoint, with new episodes and without scores of levels.

    Args:
        config: settings.
        callback: further callbacks of Stable-Baselines3, one or a list.
        wrapper: function that wraps the training environment; it must not change the observations.
        progress: show progress bars.

    Returns:
        The final evaluation of each family.

    Raises:
        TypeError: the configuration is not a `PPOConfig`.
        BankError, FileNotFoundError, FileExistsError, ValueError: see `Run`, `Dataset.of` and `load_policy`.

    """
    if not isinstance(cast(object, config), PPOConfig):
        raise TypeError(f"config: expected a PPOConfig, got {type(config).__name__}")

    def make(venv: VecEnv, dataset: Dataset | None, start: BasePolicy | None) -> BaseAlgorithm:
        return PPO(
            NavigationPolicy,
            venv,
            n_steps=config.n_steps,
            batch_size=config.batch_size,
            n_epochs=config.n_epochs,
            learning_rate=LinearSchedule(config.learning_rate, 0.0, 1.0),
            gamma=config.discount,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            ent_coef=config.ent_coef,
            policy_kwargs={
                **network(config.hidden),
                "log_std_init": math.log(config.std),
                "quiet": config.quiet,
                "effort_weights": config.effort_weights,
                "symmetries": _symmetries(start, venv) if config.start.actor else (),
                "components": components_of(start) if config.start.actor else 1,
            },
            seed=config.seed,
            device="cpu",
        )

    return _train("ppo", config, make, callback, wrapper, progress)


@limit_threads
def train_sac(
    config: SACConfig,
    *,
    callback: MaybeCallback = None,
    wrapper: Callable[[VecEnv], VecEnv] | None = None,
    progress: bool = True,
) -> list[Evaluation]:
    """Train a policy by soft actor-critic or truncated quantile critics.

    Arguments, returns and further errors are those of `train_ppo`.

    Raises:
        TypeError: the configuration is not a `SACConfig`.
        ModuleNotFoundError: TQC without the extra `contrib`.

    """
    if not isinstance(cast(object, config), SACConfig):
        raise TypeError(f"config: expected a SACConfig, got {type(config).__name__}")
    check_choice("algorithm", config.algorithm, ("sac", "tqc"))
    algorithm: Any = SAC
    if config.algorithm == "tqc":
        try:
            from sb3_contrib import TQC as algorithm  # noqa: N811 (a class like SAC)
        except ModuleNotFoundError:
            raise ModuleNotFoundError('TQC needs sb3-contrib: pip install "leapnav[contrib]"') from None

    def make(venv: VecEnv, dataset: Dataset | None, start: BasePolicy | None) -> BaseAlgorithm:
        weights = config.effort_weights
        policy, options = "MlpPolicy", network(config.hidden)
        if weights is not None:
            policy, options = MomentumSACPolicy, {**options, "effort_weights": weights}
        return algorithm(
            policy,
            venv,
            learning_rate=LinearSchedule(config.learning_rate, 0.0, 1.0),
            buffer_size=config.buffer_size,
            learning_starts=config.learning_starts,
            batch_size=config.batch_size,
            gamma=config.discount,
            gradient_steps=config.gradient_steps,
            ent_coef=config.ent_coef if config.ent_coef.startswith("auto") else float(config.ent_coef),
            policy_kwargs=options,
            seed=config.seed,
            device="cpu",
            **_buffer_arguments(config, dataset),
        )

    return _train(config.algorithm, config, make, callback, wrapper, progress)


def _train(
    algorithm: str,
    config: Config,
    make: Callable[[VecEnv, Dataset | None, BasePolicy | None], BaseAlgorithm],
    callback: MaybeCallback,
    wrapper: Callable[[VecEnv], VecEnv] | None,
    progress: bool,
) -> list[Evaluation]:
    """Train the model that `make` returns for the training environment, the demonstrations and the first policy."""
    # Invalid arguments are reported before the run directory is created.
    check_config(config)
    demos, start = _resolve_warm_start(config)
    if demos and config.reward != "cost":
        raise ValueError(f"reward: expected 'cost', the reward of demonstrations, got {config.reward!r}")
    dataset = Dataset.of(demos) if demos else None
    if dataset is not None:
        check_demonstrations(config, dataset)
        dataset = dataset.observed(observed_settings(config))
    venv = make_training_env(config)
    if wrapper is not None:
        venv = wrapper(venv)
        if not isinstance(cast(object, venv), VecEnv):
            raise TypeError(f"wrapper: expected a function that returns a VecEnv, got {type(venv).__name__}")
    model = make(venv, dataset, start)
    if start is not None and config.start.actor:
        copy_actor(start, model.policy)
    run = Run(algorithm, config)
    checkpoint = run.load_checkpoint() if config.resume else None
    if checkpoint is None:
        _warm_start(model, config, dataset, actor_copied=start is not None, progress=progress)
    else:
        model = _load_model(type(model), checkpoint[0], venv, dataset, config)
    # Stable-Baselines3 has seeded the environment with the seed of the run itself, see `environment_seed`.
    venv.seed(environment_seed(config.seed, model.num_timesteps))
    model.set_logger(run.logger)
    if isinstance(config, SACConfig) and config.imitation > 0 and dataset is not None:
        imitate(cast(OffPolicyAlgorithm, model), dataset, config.imitation)
    own = _RunCallback(run, config, checkpoint[1] if checkpoint else None, progress)
    remaining = config.total_timesteps - model.num_timesteps
    if remaining > 0:
        further = callback if isinstance(callback, list) else [] if callback is None else [callback]
        chosen = [own, *_level_scoring(venv), *further]
        model.learn(remaining, callback=chosen, reset_num_timesteps=checkpoint is None)
        own.save_checkpoint()
    own.bar.close()
    if isinstance(config, PPOConfig) and config.last_std > 0:
        set_noise(model.policy, config.last_std)
    evaluations = run.evaluate(model.policy, model.num_timesteps, final=True)
    run.save_policy(model.policy)
    return evaluations


def _symmetries(start: BasePolicy | None, venv: VecEnv) -> tuple[Transformation, ...]:
    """Return the symmetries of the first policy; for other observations, as with motors, those of the environment."""
    found = symmetries_of(start)
    if start is None or start.observation_space == venv.observation_space:
        return found
    inner = unwrap(venv)[0]
    return symmetries(inner.settings, [inner.source.robot]) if found else ()


def _resolve_warm_start(config: Config) -> tuple[list[Path], BasePolicy | None]:
    """Return the directories of demonstrations and the policy among the paths in `config.warm_start`."""
    given: Any = config.warm_start
    paths = [Path(path) for path in ([given] if isinstance(given, (str, Path)) else given)]
    policies = [path for path in paths if (policy_folder(path) / "policy.json").is_file()]
    if len(policies) > 1:
        raise ValueError(f"warm_start: expected at most one policy, got {policies[0]} and {policies[1]}")
    for path in paths:
        if path not in policies and not path.is_dir():
            raise FileNotFoundError(f"warm_start: {path}: no such directory of demonstrations or of a policy")
    start = _load_start(policies[0], config) if policies else None
    return [path for path in paths if path not in policies], start


def _load_start(path: Path, config: Config) -> BasePolicy:
    """Load the policy to start from: one of the same observations, or of a robot without motors."""
    warn_of_family("warm_start", path, config)
    arguments = config.fresh_environment
    if policy_environment(path).get("actuation", "velocity") == "velocity":
        arguments = {name: value for name, value in arguments.items() if name != "actuation"}
    return load_policy(path, NavigateEnv(**arguments))


def make_training_env(config: Config) -> VecEnv:
    """Return the training environment, which samples a new scenario for each episode."""
    task: dict[str, Any] = {}
    if isinstance(config, PPOConfig):
        penalty = config.penalty
        task = {"control_period": config.control_period, "collision_penalty": penalty, "miss_penalty": penalty}
    return make_vec_env(
        n_envs=config.n_envs,
        **{**config.environment, **_scenarios(config)},
        reward=config.reward,
        discount=config.discount,
        graded_miss=config.graded_miss,
        reward_scale=config.reward_scale,
        **task,
    )


def _scenarios(config: Config) -> dict[str, Any]:
    """Return the arguments of the training environment that choose the scenarios."""
    if not isinstance(config, PPOConfig) or config.levels == "fresh":
        return config.fresh_environment
    if config.level_bank is not None:
        bank = ScenarioBank(config.level_bank)
        robot, horizon, obstacles = task_of(config.family, config.robot, config.horizon, config.obstacles)
        check_robots("level_bank", robot, bank.robot)
        for name, expected, found in (("horizon", horizon, bank.horizon), ("obstacles", obstacles, bank.obstacles)):
            if found != expected:
                raise ValueError(f"level_bank: {name}: expected {expected!r}, got {found!r}")
    else:
        bank = ScenarioBank.shipped(config.family, "train", **config.task)
    sampler = UniformSampler(bank) if config.levels == "uniform" else PrioritizedSampler(bank, config.levels)
    return {"bank": bank, "sampler": sampler}


def _level_scoring(venv: VecEnv) -> list[LevelScoring]:
    """Return the callback that scores the levels of the training environment, if its sampler needs one."""
    robots = unwrap(venv)[0]
    assert isinstance(robots, NavigateVectorEnv)
    sampler = robots.sampler
    if isinstance(sampler, PrioritizedSampler) and sampler.score in VALUE_SCORES:
        return [LevelScoring(sampler)]
    return []


def _warm_start(
    model: BaseAlgorithm, config: Config, dataset: Dataset | None, *, actor_copied: bool, progress: bool
) -> None:
    """Fit the model to the demonstrations, and set the initial noise and the reference policy of PPO.

    Args:
        model: the model, in place.
        config: settings of the run.
        dataset: the demonstrations, if any.
        actor_copied: whether the actor is that of a given policy; then only the critic is fitted.
        progress: show progress bars.

    """
    if dataset is not None:
        warm_start(
            model,
            dataset,
            replace(config.start, seed=config.seed, actor=config.start.actor and not actor_copied),
            cloning=replace(config.cloning, seed=config.seed),
            reward_scale=config.reward_scale,
            progress=progress,
        )
    if isinstance(config, PPOConfig):
        set_noise(model.policy, config.std)


def _load_model(kind: Any, folder: Path, venv: VecEnv, dataset: Dataset | None, config: Config) -> BaseAlgorithm:
    """Load the model of a checkpoint."""
    buffer = folder / "replay_buffer.pkl"
    arguments = _buffer_arguments(config, dataset) if isinstance(config, SACConfig) else {}
    schedule = LinearSchedule(config.learning_rate, 0.0, 1.0)  # of an extended run, it may be another one
    model = kind.load(folder / "model.zip", env=venv, device="cpu", learning_rate=schedule, **arguments)
    if buffer.exists():
        model.load_replay_buffer(buffer)
        if isinstance(model.replay_buffer, DemonstrationReplayBuffer):
            assert dataset is not None  # the configuration is that of the stored run
            model.replay_buffer.demonstrate(dataset, config.reward_scale)
    return model


def _buffer_arguments(config: SACConfig, dataset: Dataset | None) -> dict[str, Any]:
    """Return the arguments of SAC for a replay buffer with demonstrations, if there are any."""
    if dataset is None or config.demonstrations == 0:
        return {}
    fraction, scale = config.demonstrations, config.reward_scale
    return {
        "replay_buffer_class": DemonstrationReplayBuffer,
        "replay_buffer_kwargs": {"dataset": dataset, "share": fraction, "reward_scale": scale},
    }


class _RunCallback(BaseCallback):
    """Evaluations, checkpoints, schedules and the progress bar of a run.

    Args:
        run: the run directory.
        config: settings of the run.
        progress: the progress stored in the checkpoint; None for a new run.
        show_bar: show a progress bar.

    """

    def __init__(self, run: Run, config: Config, progress: dict[str, Any] | None, show_bar: bool) -> None:
        super().__init__()
        self._run, self._config = run, config
        self._evaluated_step = -1 if progress is None else int(progress["evaluated"])
        self._checkpoint_step = 0 if progress is None else int(progress["step"])
        self.bar = progress_bar(
            total=config.total_timesteps,
            label=run.algorithm.upper(),
            unit="steps",
            initial=self._checkpoint_step,
            show=show_bar,
        )

    def _on_step(self) -> bool:
        advance(self.bar, self._config.n_envs)  # the last rollout may exceed the total
        return True

    def _on_rollout_start(self) -> None:
        # The state is complete here: the last update is done, and the next environment steps have not begun.
        step, config = self.num_timesteps, self._config
        if step // config.evaluate_every > self._evaluated_step // config.evaluate_every or self._evaluated_step < 0:
            success, soc = mean_scores(self._run.evaluate(self.model.policy, step))
            self.bar.set_postfix(success=f"{100 * success:.1f} %", SOC=f"{soc:.3f}")
            self._run.save_policy(self.model.policy)
            self._evaluated_step = step
        if step // config.checkpoint_every > self._checkpoint_step // config.checkpoint_every:
            self.save_checkpoint()
        self._apply_schedules(step / config.total_timesteps)

    def _apply_schedules(self, completed: float) -> None:
        """Set everything that depends on the completed fraction of the run."""
        config, policy = self._config, self.model.policy
        if isinstance(config, PPOConfig) and isinstance(policy, NavigationPolicy):
            for parameter in actor_parameters(policy):
                parameter.requires_grad_(completed >= config.critic_first)
            policy.log_std.requires_grad_(completed >= config.critic_first and config.last_std == 0)
            if config.last_std > 0:
                std = config.std + min(1.0, completed) * (config.last_std - config.std)
                set_noise(policy, std)

    def save_checkpoint(self) -> None:
        """Replace the checkpoint."""
        self._checkpoint_step = self.model.num_timesteps
        progress = {"step": self._checkpoint_step, "evaluated": self._evaluated_step}
        self._run.save_checkpoint(self._write_checkpoint, progress)

    def _write_checkpoint(self, folder: Path) -> None:
        self.model.save(folder / "model.zip", exclude=["replay_buffer_kwargs"])
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.save_replay_buffer(folder / "replay_buffer.pkl")
