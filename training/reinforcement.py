"""Runs of reinforcement learning: PPO and SAC (TQC), from scratch or from the optimum."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import ALL, FAMILIES
from leapnav.training.actors import actor_parameters, copy_actor, set_noise
from leapnav.training.anchored import AnchoredPolicy
from leapnav.training.checks import check_config
from leapnav.training.config import PPOConfig, SACConfig
from leapnav.training.dataset import Dataset
from leapnav.training.evaluation import Evaluation
from leapnav.training.imitation import robot_of, settings_of, show
from leapnav.training.jump_start import JumpStart
from leapnav.training.policies import load_policy, network, policy_folder
from leapnav.training.replay import DemonstrationReplayBuffer, imitate
from leapnav.training.rewards import GradedMiss, ScaledReward
from leapnav.training.runs import Run
from leapnav.training.vec_env import environment_seed, make_vec_env
from leapnav.training.warmstart import warm_start

Config = PPOConfig | SACConfig


def train_ppo(config: PPOConfig, *, progress: bool = True) -> list[Evaluation]:
    """Proximal policy optimisation; a run that was stopped goes on with `config.resume`, to the same bits.

    Returns:
        The last evaluation, of each family.

    Raises:
        TypeError: the configuration is another algorithm's.
        FileNotFoundError, FileExistsError, ValueError: see `Run`, `Dataset.of` and `load_policy`.

    """
    if not isinstance(cast(object, config), PPOConfig):
        raise TypeError(f"config: expected a PPOConfig, got {type(config).__name__}")

    def make(venv: VecEnv, dataset: Dataset | None) -> BaseAlgorithm:
        return PPO(
            AnchoredPolicy,
            venv,
            n_steps=config.n_steps,
            batch_size=config.batch_size,
            n_epochs=config.n_epochs,
            learning_rate=LinearSchedule(config.learning_rate, 0.0, 1.0),
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            ent_coef=1.0,  # the policy weighs the entropy, and the divergence from its anchor, itself
            policy_kwargs={
                **network(config.hidden),
                "log_std_init": math.log(config.std),
                "entropy_weight": config.ent_coef,
                "quiet": config.quiet,
            },
            seed=config.seed,
            device="cpu",
        )

    return _train("ppo", config, make, progress)


def train_sac(config: SACConfig, *, progress: bool = True) -> list[Evaluation]:
    """Soft actor-critic or truncated quantile critics; returns and errors are those of `train_ppo`.

    Raises:
        ModuleNotFoundError: TQC without the extra `contrib`.

    """
    if not isinstance(cast(object, config), SACConfig):
        raise TypeError(f"config: expected a SACConfig, got {type(config).__name__}")
    if config.algorithm not in ("sac", "tqc"):
        raise ValueError(f"algorithm: expected sac or tqc, got {config.algorithm!r}")
    kind: Any = SAC
    if config.algorithm == "tqc":
        try:
            from sb3_contrib import TQC as kind  # noqa: N811 (a class like SAC)
        except ModuleNotFoundError:
            raise ModuleNotFoundError('TQC needs sb3-contrib: pip install "leapnav[contrib]"') from None

    def make(venv: VecEnv, dataset: Dataset | None) -> BaseAlgorithm:
        return kind(
            "MlpPolicy",
            venv,
            learning_rate=LinearSchedule(config.learning_rate, 0.0, 1.0),
            buffer_size=config.buffer_size,
            learning_starts=config.learning_starts,
            batch_size=config.batch_size,
            gamma=config.gamma,
            gradient_steps=config.gradient_steps,
            ent_coef=config.ent_coef if config.ent_coef.startswith("auto") else float(config.ent_coef),
            policy_kwargs=network(config.hidden),
            seed=config.seed,
            device="cpu",
            **_buffer(config, dataset),
        )

    return _train(config.algorithm, config, make, progress)


def _train(
    algorithm: str, config: Config, make: Callable[[VecEnv, Dataset | None], BaseAlgorithm], progress: bool
) -> list[Evaluation]:
    # What can be wrong is found before the folder is made.
    check_config(config)
    demos, start = _start(config)
    if demos and config.reward != "cost":
        raise ValueError(f"reward: demonstrations have the rewards of 'cost', got {config.reward!r}")
    if isinstance(config, PPOConfig) and config.divergence > 0 and not (config.warm_start and config.start.actor):
        raise ValueError(f"divergence: without a clone there is nothing to diverge from, got {config.divergence!r}")
    dataset = Dataset.of(demos).observed(settings_of(config)) if demos else None
    venv = _robots(config)
    model = make(venv, dataset)
    venv.seed(environment_seed(config.seed))  # Stable-Baselines3 has given it the model's
    if start is not None and config.start.actor:
        copy_actor(start, model.policy)
    run = Run(algorithm, config)
    found = run.load_checkpoint() if config.resume else None
    if found is None:
        _warm_start(model, config, dataset, copied=start is not None, progress=progress)
    else:
        model = _load(type(model), found[0], venv, dataset, config)
    model.set_logger(run.logger)
    if isinstance(config, SACConfig) and config.imitation > 0 and dataset is not None:
        imitate(cast(OffPolicyAlgorithm, model), dataset, config.imitation)
    callback = _Keeper(run, config, venv, found[1] if found else None, progress)
    if found is not None:
        run.restore_generators()
    remaining = config.total_timesteps - model.num_timesteps
    if remaining > 0:
        model.learn(remaining, callback=callback, reset_num_timesteps=found is None)
        callback.keep()
    callback.bar.close()
    if isinstance(config, PPOConfig) and config.last_std > 0:
        set_noise(model.policy, th.full((2,), config.last_std))
    evaluations = run.evaluate(model.policy, model.num_timesteps, final=True)
    run.save_policy(model.policy)
    return evaluations


def _start(config: Config) -> tuple[list[Path], BasePolicy | None]:
    """The folders of demonstrations, and the policy, among what a warm start is given."""
    given: Any = config.warm_start
    places = [Path(place) for place in ([given] if isinstance(given, (str, Path)) else given)]
    policies = [place for place in places if (policy_folder(place) / "policy.json").is_file()]
    if len(policies) > 1:
        raise ValueError(f"warm_start: expected at most one policy, got {policies[0]} and {policies[1]}")
    for place in places:
        if place not in policies and not place.is_dir():
            raise FileNotFoundError(f"warm_start: {place}: no such folder of demonstrations or of a policy")
    start = load_policy(policies[0], robot_of(config)) if policies else None
    return [place for place in places if place not in policies], start


def _robots(config: Config) -> VecEnv:
    """The training environment: fresh scenarios without end."""
    task: dict[str, Any] = {}
    if isinstance(config, PPOConfig):
        penalty = config.penalty
        task = {"control_period": config.control_period, "collision_penalty": penalty, "miss_penalty": penalty}
    robots = make_vec_env(
        n_envs=config.n_envs,
        family=config.family,
        split="fresh",
        reward=config.reward,
        discount=config.gamma,
        **config.environment,
        **task,
    )
    venv: VecEnv = robots
    if config.jump_start > 0:
        families = FAMILIES if config.family == ALL else (config.family,)
        banks = [ScenarioBank.shipped(family, "train") for family in families]
        venv = JumpStart(robots, banks, config.jump_start, seed=config.seed)
    if config.graded_miss:
        venv = GradedMiss(venv)
    return ScaledReward(venv, config.reward_scale)


def _warm_start(model: BaseAlgorithm, config: Config, dataset: Dataset | None, *, copied: bool, progress: bool) -> None:
    """What is left of a warm start when a policy's actor may have been copied already."""
    if dataset is not None:
        warm_start(
            model,
            dataset,
            replace(config.start, seed=config.seed, actor=config.start.actor and not copied),
            cloning=replace(config.cloning, seed=config.seed),
            reward_scale=config.reward_scale,
            progress=progress,
        )
    if isinstance(config, PPOConfig) and isinstance(model.policy, AnchoredPolicy):
        set_noise(model.policy, th.full((2,), config.std))
        model.policy.drop_anchor()


def _load(kind: Any, folder: Path, venv: VecEnv, dataset: Dataset | None, config: Config) -> BaseAlgorithm:
    """The model of a checkpoint, and its robots where they were."""
    buffer = folder / "replay_buffer.pkl"
    arguments = _buffer(config, dataset) if isinstance(config, SACConfig) else {}
    model = kind.load(folder / "model.zip", env=venv, device="cpu", force_reset=False, **arguments)
    if buffer.exists():
        model.load_replay_buffer(buffer)
        if isinstance(model.replay_buffer, DemonstrationReplayBuffer):
            assert dataset is not None  # as the configuration, which is the same, says
            model.replay_buffer.demonstrate(dataset, config.reward_scale)
    with (folder / "robots.pkl").open("rb") as file:
        states, actions = pickle.load(file)
    # Loading has seeded it anew; before learning starts an off-policy algorithm draws its actions from it.
    model.action_space.np_random.bit_generator.state = actions
    for part, state in zip(_parts(venv), states, strict=True):
        part.load_state_dict(state)
    return model


def _buffer(config: SACConfig, dataset: Dataset | None) -> dict[str, Any]:
    """The arguments for a replay buffer with demonstrations, if there are any."""
    if dataset is None or config.demonstrations == 0:
        return {}
    share, scale = config.demonstrations, config.reward_scale
    return {
        "replay_buffer_class": DemonstrationReplayBuffer,
        "replay_buffer_kwargs": {"dataset": dataset, "share": share, "reward_scale": scale},
    }


def _parts(venv: Any) -> list[Any]:
    """The wrappers and the robots that have a state."""
    found = []
    while isinstance(venv, VecEnv):
        if "state_dict" in type(venv).__dict__:
            found.append(venv)
        venv = getattr(venv, "venv", None)
    return found


class _Keeper(BaseCallback):
    """Evaluates, keeps checkpoints, lets what is to fade fade, and shows how far the run is."""

    def __init__(self, run: Run, config: Config, venv: VecEnv, progress: dict[str, Any] | None, bar: bool) -> None:
        super().__init__()
        self._run, self._config, self._venv = run, config, venv
        self._evaluated = -1 if progress is None else int(progress["evaluated"])
        self._kept = 0 if progress is None else int(progress["step"])
        self.bar = tqdm(
            total=config.total_timesteps, initial=self._kept, desc=run.algorithm.upper(), unit="step", disable=not bar
        )

    def _on_step(self) -> bool:
        self.bar.update(self._config.n_envs)
        return True

    def _on_rollout_start(self) -> None:
        # Nothing is in flight here: the last update is done, the next steps have not been driven.
        step, config = self.num_timesteps, self._config
        if step // config.evaluate_every > self._evaluated // config.evaluate_every or self._evaluated < 0:
            show(self.bar, self._run.evaluate(self.model.policy, step))
            self._run.save_policy(self.model.policy)
            self._evaluated = step
        if step // config.checkpoint_every > self._kept // config.checkpoint_every:
            self.keep()
        done = step / config.total_timesteps
        if isinstance(config, PPOConfig) and isinstance(self.model.policy, AnchoredPolicy):
            policy = self.model.policy
            policy.divergence_weight = _fading(config.divergence, config.divergence_until, done)
            self.logger.record("train/divergence", policy.divergence)
            for parameter in actor_parameters(policy):
                parameter.requires_grad_(done >= config.critic_first)
            policy.log_std.requires_grad_(done >= config.critic_first and config.last_std == 0)
            if config.last_std > 0:
                set_noise(policy, th.full((2,), config.std + min(1.0, done) * (config.last_std - config.std)))
        for part in _parts(self._venv):
            if isinstance(part, JumpStart):
                part.share = _fading(config.jump_start, config.jump_start_until, done)

    def keep(self) -> None:
        """Replaces the checkpoint."""
        self._kept = self.model.num_timesteps
        self._run.save_checkpoint(self._write, {"step": self._kept, "evaluated": self._evaluated})

    def _write(self, folder: Path) -> None:
        self.model.save(folder / "model.zip", exclude=["replay_buffer_kwargs"])
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.save_replay_buffer(folder / "replay_buffer.pkl")
        with (folder / "robots.pkl").open("wb") as file:
            actions = self.model.action_space.np_random.bit_generator.state
            pickle.dump(([part.state_dict() for part in _parts(self._venv)], actions), file)


def _fading(first: float, until: float, done: float) -> float:
    """A weight that falls along a line to zero at the share `until` of the run."""
    return first * max(0.0, 1.0 - done / until) if until > 0 else 0.0
