"""Settings of the training runs: plain data, so that the command line can show them without loading torch."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, Self

# Of the runs, by the name of their class; "-warm" for warm starts; in a table of its own what holds for a family alone.
_DEFAULTS: dict[str, Any] = tomllib.loads(files("leapnav.training").joinpath("defaults.toml").read_text())


@dataclass(frozen=True)
class CloningConfig:
    """Settings of behaviour cloning."""

    epochs: int = 12
    """Passes over the samples, at most."""
    patience: int = 5
    """Stop after so many epochs without a lower validation loss; 0: never. The best epoch's weights are kept."""
    batch_size: int = 2048
    """Samples per gradient step."""
    learning_rate: float = 2e-3
    """Peak of the learning rate, which then falls to zero along a cosine."""
    weight_decay: float = 1e-4
    """Of AdamW."""
    validation_share: float = 0.05
    """Share of the obstacle courses that is held out to measure the loss."""
    loss: Literal["action", "hamiltonian"] = "action"
    """"action": Huber's loss of the error, each component in units of its spread; "hamiltonian": what the error costs
    per second, H(q, lambda, u) - H(q, lambda, u*) with the expert's costate."""
    augment: bool = True
    """Use the mirrored and the turned-round twins of the samples too."""
    seed: int = 0
    """Of the split, the order of the samples and the twins."""


@dataclass(frozen=True)
class DAggerConfig:
    """Settings of dataset aggregation."""

    rounds: int = 8
    """How often the learner drives, the expert takes over, and the learner is fitted to all that the expert did."""
    failures: int = 300
    """Failed episodes after which a round's driving ends; in each the expert takes over a dozen times at most."""
    episodes: int = 15_000
    """Episodes that the learner drives in a round at most."""
    successes: float = 1.0
    """For each failed episode so many others in which the expert takes over, once each."""
    lead: float = 3.0
    """s for which the expert drives; then it is where demonstrations lead anyway."""
    epochs: int = 2
    """Passes over all samples after each round but the last."""
    last_epochs: int = 8
    """Passes over all samples after the last round."""
    learning_rate: float = 1e-3
    """Peak of the learning rate after each round, which then falls to zero along a cosine."""
    seed: int = 0
    """Of the scenarios and of when the expert takes over."""


@dataclass(frozen=True)
class WarmStartConfig:
    """Settings of a warm start; each part can be left out."""

    actor: bool = True
    """Clone the expert's actions."""
    critic: bool = True
    """Fit the critic to the expert's cost-to-go."""
    gradient: bool = True
    """Fit the critic's gradient to the costate too."""
    critic_epochs: int = 3
    """Passes over the samples, for the critic."""
    critic_learning_rate: float = 3e-3
    """Peak of the critic's learning rate, which then falls to zero along a cosine."""
    critic_batch_size: int = 4096
    """Samples per gradient step, for the critic."""
    gradient_weight: float = 0.3
    """Of the error of the gradient by the state, and for Q functions by the action, beside that of the value; each in
    units of its spread."""
    slopes: int = 200_000
    """How many samples the gradient is fitted at."""
    seed: int = 0
    """Of the order of the samples and of the directions of the gradient."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What all training runs have in common."""

    out: Path
    """Folder of the run: configuration, policy, checkpoints, TensorBoard logs, evaluations."""
    family: str = "clutter"
    """Family of the scenarios: open, clutter, polygons, rooms, slalom or all."""
    seed: int = 0
    """Of everything that is random."""
    resume: bool = False
    """Go on with the run that the folder holds."""
    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the actor's and the critic's hidden layers."""
    lidar_beams: int = 128
    """Beams of the robot's lidar. Demonstrations were seen with those of the environment's defaults, and are seen anew
    with these: with 32 many a gap looks wide enough that is not. A policy to start from must have as many."""
    evaluation_scenarios: int = 100
    """Scenarios of each family's test split that an evaluation on the way plays; the last one plays all."""

    @property
    def environment(self) -> dict[str, Any]:
        """The arguments of the environment that what is observed depends on."""
        return {"lidar_beams": self.lidar_beams}

    @classmethod
    def tuned(cls, family: str, *, warm: bool | None = None, **changes: Any) -> Self:
        """The settings that were tuned for a family, from the file `defaults.toml`, with changes.

        Args:
            family: one of the families, or "all".
            warm: whether those for a warm start; None: if `changes` have a `warm_start`.
            changes: of any settings.

        Raises:
            ValueError: there is no such family.

        """
        if family != cls.family:  # the default is one; whoever only asks for help need not wait for the others
            from leapnav.envs.families import check_family

            check_family(family)
        if warm is None:
            warm = bool(changes.get("warm_start"))
        config = cls(out=Path(), family=family)
        for section in ("RunConfig", cls.__name__, f"{cls.__name__}-warm")[: 3 if warm else 2]:
            table = _DEFAULTS.get(section, {})
            settings = {setting.name for setting in fields(config)}
            common = {name: value for name, value in table.items() if name in settings}  # the others are families
            config = _changed(_changed(config, common), table.get(family, {}))
        return replace(config, **changes)


@dataclass(frozen=True, kw_only=True)
class BCConfig(RunConfig):
    """Clone the expert: a policy fitted to its demonstrations."""

    demos: tuple[Path, ...] = ()
    """Folders that `leapnav rollout` wrote; without any, demonstrations are made first, in the run's folder."""
    scenarios: int = 10_000
    """How many scenarios are demonstrated if none are given."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Settings of the fit; its seed is the run's."""


@dataclass(frozen=True, kw_only=True)
class DAggerRunConfig(RunConfig):
    """Dataset aggregation: the learner drives, the expert says what it would have done there."""

    demos: tuple[Path, ...] = ()
    """Folders that `leapnav rollout` wrote, for the clone that is the first learner and among the samples; without any,
    demonstrations are made first, in the run's folder."""
    scenarios: int = 10_000
    """How many scenarios are demonstrated if none are given."""
    policy: Path | None = None
    """A policy that is the first learner instead of a new clone."""
    n_envs: int = 256
    """Robots that drive at once."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Settings of the first clone, and of the loss and the batches of all fits; its seed is the run's."""
    dagger: DAggerConfig = field(default_factory=DAggerConfig)
    """Settings of the aggregation; its seed is the run's."""


@dataclass(frozen=True, kw_only=True)
class _LearnerConfig(RunConfig):
    """What the runs of reinforcement learning have in common."""

    reward_scale: float = 0.1
    """Factor of the rewards."""
    graded_miss: bool = True
    """While it learns a miss costs from a fifth of the penalty on, by how far from the goal the episode ends. Otherwise
    nothing says where success lies, and standing still is best. PPO from a clone knows where."""
    warm_start: tuple[Path, ...] = ()
    """Demonstrations (folders that `leapnav rollout` wrote) and at most one policy (a run's folder) to start from: the
    actor is a clone of the demonstrations, or the policy's; the critic is fitted to the demonstrations, if any."""
    start: WarmStartConfig = field(default_factory=WarmStartConfig)
    """Settings of the warm start; its seed is the run's."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Settings of the clone that a warm start makes; its seed is the run's."""
    jump_start: float = 0.0
    """Share of an episode's time that the expert drives at most, at first; it falls to zero along a line. 0: none."""
    jump_start_until: float = 0.5
    """Share of the steps after which the expert drives no more."""
    evaluate_every: int = 200_000
    """Steps between evaluations."""
    checkpoint_every: int = 200_000
    """Steps between checkpoints."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig(_LearnerConfig):
    """Proximal policy optimisation. These are the settings from scratch; `tuned` knows those of a warm start."""

    total_timesteps: int = 5_000_000
    """Control periods of all robots together."""
    n_envs: int = 64
    """Robots that drive at once."""
    learning_rate: float = 1e-3
    """At first; it falls to zero along a line."""
    gamma: float = 1.0
    """Discount factor. The horizon is finite and observed, so 1 is possible, and the critic's values are minus the
    costs to go then."""
    control_period: float = 0.2
    """s between actions while it learns: with fewer decisions in an episode each matters more. What it learns is
    evaluated with the environment's own."""
    penalty: float = 50.0
    """Of a collision, which is a miss too, and of a miss while it learns. The defaults of most warm starts have less
    than the environment's own: most episodes succeed then, and the noise of a high penalty would drown the cost."""
    reward: Literal["cost", "shaped"] = "shaped"
    """Reward of the environment; "shaped" tells on the way how near the goal is."""
    n_steps: int = 64
    """Control periods of each robot between two updates."""
    batch_size: int = 512
    """Samples per gradient step."""
    n_epochs: int = 6
    """Passes over the samples of an update."""
    gae_lambda: float = 0.95
    """Of the generalised advantage estimate."""
    clip_range: float = 0.2
    """Of the ratio of likelihoods."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    std: float = 0.3
    """Standard deviation of the actions at first."""
    last_std: float = 0.1
    """Standard deviation of the actions at the end, to which it goes along a line; 0: it is learned."""
    quiet: float = 2.0
    """s before the horizon from which on that noise fades, to a third."""
    critic_first: float = 0.0
    """Share of the steps, at first, in which the critic alone learns."""
    divergence: float = 0.0
    """Weight of the divergence from the clone, at first; it falls to zero along a line. 0: none."""
    divergence_until: float = 0.5
    """Share of the steps after which the divergence does not count any more."""


@dataclass(frozen=True, kw_only=True)
class SACConfig(_LearnerConfig):
    """Soft actor-critic, or its variant with truncated quantile critics, from scratch or from a warm start."""

    algorithm: Literal["sac", "tqc"] = "sac"
    """"tqc" needs the extra `contrib`."""
    total_timesteps: int = 200_000
    """Control periods of all robots together."""
    n_envs: int = 16
    """Robots that drive at once."""
    learning_rate: float = 3e-4
    """At first; it falls to zero along a line."""
    gamma: float = 0.99
    """Discount factor."""
    reward: Literal["cost", "shaped"] = "shaped"
    """Reward of the environment; "shaped" tells on the way how near the goal is."""
    batch_size: int = 512
    """Samples per gradient step."""
    gradient_steps: int = 4
    """Per control period of all robots."""
    buffer_size: int = 500_000
    """Transitions that are remembered."""
    learning_starts: int = 5_000
    """Steps of random actions before the first gradient step; a warm start's defaults have none."""
    ent_coef: str = "auto_0.01"
    """Weight of the entropy: a number, or "auto" with the first value."""
    demonstrations: float = 0.25
    """Share of each batch that is demonstrations, if a warm start has some."""
    imitation: float = 0.0
    """Weight, in the actor's loss, of the error of the demonstrations' actions, if a warm start has some; beside values
    in units of `reward_scale`. What a single action is worth is small beside the critic's errors, which would soon
    spoil a clone."""
    evaluate_every: int = 20_000
    """Steps between evaluations."""
    checkpoint_every: int = 50_000
    """Steps between checkpoints."""


def _changed(config: Any, table: dict[str, Any]) -> Any:
    """A configuration with what a table says otherwise; its tables are those of the configuration's parts."""
    changes: dict[str, Any] = {}
    for name, value in table.items():
        part = _changed(getattr(config, name), value) if isinstance(value, dict) else value
        changes[name] = tuple(part) if isinstance(part, list) else part
    return replace(config, **changes)


ALGORITHMS: dict[str, type[RunConfig]] = {
    "bc": BCConfig,
    "dagger": DAggerRunConfig,
    "ppo": PPOConfig,
    "sac": SACConfig,
}


def read_config(folder: Path) -> tuple[str, RunConfig]:
    """The algorithm and the configuration of the run in a folder.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged.

    """
    from pydantic import TypeAdapter, ValidationError

    record = folder / "config.json"
    if not record.is_file():
        raise FileNotFoundError(f"{record}: there is no run in this folder")
    try:
        found: dict[str, Any] = json.loads(record.read_text())["config"]
        algorithm = "sac" if found["algorithm"] == "tqc" else str(found["algorithm"])
        return algorithm, TypeAdapter(ALGORITHMS[algorithm]).validate_python(
            {name: value for name, value in found.items() if name != "algorithm" or algorithm == "sac"}
        )
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise ValueError(f"{record}: {name}: {first['msg']}, got {first['input']!r}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{record}: not a run's configuration: {error!r}") from None
