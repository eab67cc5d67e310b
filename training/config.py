"""Settings of the training runs: plain dataclasses, which the command line shows without loading torch."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, cast, get_args

from leapnav.training.fit_settings import CloningConfig, DAggerConfig, WarmStartConfig

if TYPE_CHECKING:
    from leapnav.envs.robots import RobotModel

_FOLDER = files("leapnav.training")
INHERITED = ("robot", "horizon", "observation", "lidar_beams", "previous_action")  # from the policy at the start
LATER_SENSORS = {"velocities": False, "lidar_fov": math.tau}  # those that older descriptions of policies do not contain
LATER_SETTINGS = {"symmetric": False, "components": 1}  # those that older configurations of runs do not contain
# The settings of an algorithm for another start than that of its defaults, by the name of the profile.
PROFILES: dict[str, Any] = tomllib.loads(_FOLDER.joinpath("profiles.toml").read_text(encoding="utf-8"))

# Literals, which the command line shows and completes; names of the user's own families and robots are other text.
AtRest = Literal["open", "clutter", "polygons", "rooms", "slalom", "maze", "corridors"]
Moving = Literal["crossing", "traffic", "crowd", "doors"]
FamilyName = Literal[AtRest, Moving, "all"] | str
RobotName = Literal["unicycle", "differential_drive", "car", "dynamic_car", "dynamic_unicycle"] | str
if TYPE_CHECKING:
    RobotSetting = RobotName | Mapping[str, Any] | RobotModel
else:  # the command line and stored configurations contain text
    RobotSetting = RobotName
HorizonName = Literal["fixed", "free"]
ObstaclesName = Literal["cost", "hard"]
ObservationName = Literal["lidar", "geodesic"]
LevelsName = Literal["fresh", "uniform", "positive_value_loss", "max_mc", "learnability", "regret"]


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Settings shared by all training runs."""

    out: Path
    """Run directory: configuration, policy, checkpoints, TensorBoard logs, evaluations."""
    family: FamilyName = "clutter"
    """Family of the scenarios: built in, module:function, or a file (.bank, .json)."""
    robot: RobotSetting | None = None
    """Model of the robot, or JSON of one with other parameters; by default that of the scenarios of a file, otherwise
    the unicycle."""
    horizon: HorizonName | None = None
    """Fixed horizon (default, unless a file has another), or free: the episode ends at the goal, and time costs."""
    obstacles: ObstaclesName | None = None
    """Obstacles with a proximity cost (default), or hard obstacles, which cost nothing."""
    seed: int = 0
    """Random seed."""
    resume: bool = False
    """Continuation of the run in the directory."""
    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the hidden layers of the actor and the critic."""
    observation: ObservationName = "lidar"
    """Lidar alone, or with the geodesic distance to the goal and the detour along each beam, from the complete map."""
    lidar_beams: int | None = None
    """Even number of lidar beams; by default 64 with the geodesic observation and 128 with lidar alone; 32 do not
    resolve narrow passages. Demonstrations are observed again with them; a policy to start from must have as many."""
    lidar_fov: float = math.tau
    """Field of view of the lidar (rad)."""
    velocities: bool | None = None
    """Whether the geodesic observation has the velocities of obstacles; by default if those of the family move."""
    history: tuple[float, ...] = ()
    """Ages of earlier observations that are part of the observation, such as 0.4, 1.2 and 2.8 (s)."""
    previous_action: bool | None = None
    """Whether the observation contains the last action, in whose direction the policy moves on where the network
    hesitates (momentum); by default with a free horizon, if the robot has no drift and there is no history."""
    evaluation_scenarios: int = 100
    """Scenarios per family of the training split in evaluations during the run; the last one plays the test split."""

    def __post_init__(self) -> None:
        """Replace a robot by the JSON text of its parameters, which the files of the run contain."""
        is_text = isinstance(self.robot, str) and self.robot.lstrip().startswith("{")
        if self.robot is None or (isinstance(self.robot, str) and not is_text):
            return
        from leapnav.envs.scenarios.scenario import check_robot

        with suppress(ValueError) if is_text else nullcontext():  # `check_config` reports an invalid text
            object.__setattr__(self, "robot", check_robot(self.robot).model_dump_json(exclude_none=True))

    @property
    def task(self) -> dict[str, str]:
        """Robot, horizon and obstacles, those that are not given as in `task_of`.

        The robot is the name of its model, or the JSON text of one with other parameters.
        """
        from leapnav.envs.scenarios.families import task_of

        robot, horizon, obstacles = task_of(self.family, self.robot, self.horizon, self.obstacles)
        is_named = False
        with suppress(ValueError):  # the model has parameters without a default
            is_named = task_of(self.family, robot.model)[0] == robot
        text = robot.model if is_named else robot.model_dump_json(exclude_none=True)
        return {"robot": text, "horizon": horizon, "obstacles": obstacles}

    @property
    def task_environment(self) -> dict[str, Any]:
        """Arguments of an environment with the observation of `environment`, for scenarios of the task."""
        robot = {} if self.robot is None else {"robot": self.task["robot"]}
        return {**self.environment, **robot, "obstacles": self.task["obstacles"]}

    @property
    def fresh_environment(self) -> dict[str, Any]:
        """Arguments of an environment with the observation of `environment` and new scenarios of the family."""
        return {**self.task_environment, "family": self.family, "split": "fresh"}

    @property
    def environment(self) -> dict[str, Any]:
        """Arguments of the environment that determine the observation."""
        from leapnav.envs.scenarios.families import task_of

        robot, horizon, _ = task_of(self.family, self.robot, self.horizon)
        kinds = ("robot", robot.model, "unicycle"), ("horizon", horizon, "fixed")
        task = {name: value for name, value, default in kinds if value != default}
        observation = {} if self.observation == "lidar" else {"observation": self.observation}
        earlier: dict[str, Any] = {"history": self.history} if self.history else {}
        earlier |= {} if self.effort_weights is None else {"previous_action": True}
        beams = (64 if self.observation == "geodesic" else 128) if self.lidar_beams is None else self.lidar_beams
        is_default = self.observation == "geodesic" and self.family in get_args(Moving)
        velocities = {"velocities": True} if self.velocities or (self.velocities is None and is_default) else {}
        view = {} if self.lidar_fov == math.tau else {"lidar_fov": self.lidar_fov}
        return {**observation, **velocities, "lidar_beams": beams, **view, **task, **earlier}

    @property
    def effort_weights(self) -> tuple[float, ...] | None:
        """The weights of a policy with momentum, see `leapnav.training.effort`; None: without.

        Raises:
            ValueError: momentum is not possible, but required by `previous_action`.

        """
        is_default = self.task["horizon"] == "free" and not self.history
        if not (is_default if self.previous_action is None else self.previous_action):
            return None
        from leapnav.envs.scenarios.families import sample_scenario
        from leapnav.training.effort import effort_weights

        found = effort_weights(sample_scenario(self.family, 0, **self.task))
        if self.previous_action and found is None:
            raise ValueError("previous_action: expected a free horizon and a robot without drift, got True")
        return found

    @classmethod
    def tuned(cls, family: str, *, warm: bool | None = None, start: Sequence[Path] = (), **changes: Any) -> Self:
        """Return the settings for a family, tuned for the start of the run: the profile of the algorithm, with changes.

        The defaults of the class are the profile of a run from scratch; DAgger has another one for lidar alone, and PPO
        and SAC for a warm start (file `profiles.toml`). A run that starts from a policy has the robot model, the
        horizon and the observation of that policy.

        Args:
            family: one of the families, or "all".
            warm: whether to use the profile of a warm start; None: if `changes` contains a `warm_start`.
            start: the policy to start from, among other paths; by default in `warm_start` and `policy`.
            changes: values of any settings.

        Raises:
            ValueError: the family does not exist.

        """
        if family != cls.family:  # the default is valid; `--help` does not have to load the environments
            from leapnav.envs.scenarios.families import check_family

            check_family(family)
        own = {setting.name for setting in fields(cls)}
        given = _as_paths(start) or _as_paths(changes.get("warm_start")) or _as_paths(changes.get("policy"))
        inherited = {name: value for name, value in _inherited(given).items() if name in own}
        changes = {**inherited, **changes}
        profile = next(name for name, kind in ALGORITHMS.items() if issubclass(cls, kind))
        if bool(changes.get("warm_start")) if warm is None else warm:
            profile += "-warm"
            if f"{profile}-{changes.get('actuation')}" in PROFILES:
                profile += f"-{changes['actuation']}"
        elif changes.get("observation") == "lidar":
            profile += "-lidar"
        config = cls(out=Path(), family=cast(FamilyName, family))
        return replace(_replace_nested(config, PROFILES.get(profile, {})), **changes)


@dataclass(frozen=True, kw_only=True)
class _ImitationConfig(RunConfig):
    """Settings shared by the runs of imitation learning."""

    observation: ObservationName = "geodesic"
    """With the geodesic distance to the goal and the detour along each beam, from the complete map, or lidar alone."""
    demos: tuple[Path, ...] = ()
    """Directories written by `leapnav rollout`; if none is given, demonstrations are generated in the run directory."""
    scenarios: int = 10_000
    """Number of scenarios to demonstrate if no demonstrations are given."""
    symmetric: bool = True
    """Actions that are equivariant under the symmetries of the robot, as far as the observation has them."""
    components: int = 1
    """Number of actions of the network (mixture density network). With several, the policy takes the mode of their
    density, and decides between paths of similar cost instead of a mean of them."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Settings of the clone, in DAgger the first learner; its loss and batch size are those of all fits. The seed is
    that of the run."""


@dataclass(frozen=True, kw_only=True)
class BCConfig(_ImitationConfig):
    """Behaviour cloning: fit a policy to demonstrations of the expert."""


@dataclass(frozen=True, kw_only=True)
class DAggerRunConfig(_ImitationConfig):
    """Dataset aggregation (DAgger): the learner drives, the expert takes over and provides the labels."""

    policy: Path | None = None
    """Policy whose network is the first learner's, instead of a new clone."""
    n_envs: int = 256
    """Number of parallel robots."""
    dagger: DAggerConfig = field(default_factory=DAggerConfig)
    """Settings of the aggregation; the seed is that of the run."""


@dataclass(frozen=True, kw_only=True)
class _LearnerConfig(RunConfig):
    """Settings shared by the runs of reinforcement learning."""

    actuation: Literal["velocity", "motor"] = "velocity"
    """Ideal speed control, or motors with inertia and tyres that slip. A policy of the ideal robot can initialise one
    of a robot with motors."""
    disturbance: float = 0.0
    """Noise on actuation and sensing, in training and evaluation: relative standard deviation of speed and turn rate,
    wheel slip, and a tenth of it in sensing (m, rad)."""
    reward_scale: float = 0.1
    """Factor of the rewards."""
    graded_miss: bool = True
    """Penalty of a missed goal during training graded by the distance from the goal pose, from 1/5 of the penalty up to
    the full penalty. Without it, the learner has no information about the goal and may learn to stand still; PPO from
    a clone does not need it."""
    warm_start: tuple[Path, ...] = ()
    """Demonstrations (directories written by `leapnav rollout`) and at most one policy (a run directory) to start from:
    the actor is the policy's, or else a clone of the demonstrations; the critic is fitted to the demonstrations."""
    start: WarmStartConfig = field(default_factory=WarmStartConfig)
    """Settings of the warm start; the seed is that of the run."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Settings of the clone made by a warm start; the seed is that of the run."""
    evaluate_every: int = 200_000
    """Environment steps between evaluations."""
    checkpoint_every: int = 200_000
    """Environment steps between checkpoints."""

    @property
    def environment(self) -> dict[str, Any]:
        """Arguments of the environment that determine the observation and the motion."""
        actuation = {} if self.actuation == "velocity" else {"actuation": self.actuation}
        disturbance = {} if self.disturbance == 0.0 else {"disturbance": self.disturbance}
        return {**super().environment, **actuation, **disturbance}


@dataclass(frozen=True, kw_only=True)
class PPOConfig(_LearnerConfig):
    """Proximal policy optimisation. The defaults are for training from scratch; a warm start has others."""

    lidar_beams: int | None = 32
    """Number of lidar beams, an even number; with 128, learning takes twice as long."""
    total_timesteps: int = 5_000_000
    """Environment steps of all robots together."""
    levels: LevelsName = "fresh"
    """Scenarios of the episodes: "fresh": new ones; "uniform": those of a bank, with equal probability; otherwise the
    score by which prioritized level replay chooses them from a bank."""
    level_bank: Path | None = None
    """Bank of the levels; by default the included training split of the family."""
    n_envs: int = 64
    """Number of parallel robots."""
    learning_rate: float = 1e-3
    """Initial learning rate (linear decay to zero)."""
    gamma: float | None = None
    """Discount factor. By default 1 with a fixed horizon, which is observed, so that the critic's values are the
    negative cost-to-go, and 0.995 with a free horizon, where the time left is not observed: a time constant of 40 s."""
    control_period: float = 0.2
    """Time between actions during training (s); evaluations use the environment's default. With fewer decisions per
    episode, each has a larger effect."""
    penalty: float = 50.0
    """Penalty of a collision or of a missed goal during training."""
    reward: Literal["cost", "shaped"] = "shaped"
    """Reward of the environment; "shaped" adds potential-based shaping towards the goal."""
    n_steps: int = 64
    """Environment steps of each robot between two updates."""
    batch_size: int = 512
    """Samples per gradient step."""
    n_epochs: int = 6
    """Passes over the samples per update."""
    gae_lambda: float = 0.95
    """Factor lambda of the generalised advantage estimate."""
    clip_range: float = 0.2
    """Clipping range of the probability ratio."""
    ent_coef: float = 0.0
    """Entropy coefficient."""
    std: float = 0.3
    """Initial standard deviation of the actions."""
    last_std: float = 0.1
    """Final standard deviation of the actions (linear schedule); 0: the standard deviation is learned."""
    quiet: float = 2.0
    """Time before the horizon at which the action noise starts to decrease, to 30 % of its standard deviation (s)."""
    critic_first: float = 0.0
    """Fraction of the run, from its start, in which only the critic learns."""

    @property
    def discount(self) -> float:
        """Discount factor."""
        return (1.0 if self.task["horizon"] == "fixed" else 0.995) if self.gamma is None else self.gamma


@dataclass(frozen=True, kw_only=True)
class SACConfig(_LearnerConfig):
    """Soft actor-critic (SAC), or truncated quantile critics (TQC), from scratch or from a warm start."""

    algorithm: Literal["sac", "tqc"] = "sac"
    """Algorithm; "tqc" requires the extra `contrib`."""
    total_timesteps: int = 200_000
    """Environment steps of all robots together."""
    n_envs: int = 16
    """Number of parallel robots."""
    learning_rate: float = 3e-4
    """Initial learning rate (linear decay to zero)."""
    gamma: float | None = None
    """Discount factor; by default 0.99, and 0.999 with a free horizon, where the time left is not observed."""
    reward: Literal["cost", "shaped"] = "shaped"
    """Reward of the environment; "shaped" adds potential-based shaping towards the goal."""
    batch_size: int = 512
    """Samples per gradient step."""
    gradient_steps: int = 4
    """Gradient steps per step of the vector environment."""
    buffer_size: int = 500_000
    """Capacity of the replay buffer (transitions)."""
    learning_starts: int = 5_000
    """Environment steps with random actions before the first gradient step; 0 in the defaults of a warm start."""
    ent_coef: str = "auto_0.01"
    """Entropy coefficient: a number, or "auto" with an optional initial value ("auto_0.01")."""
    demonstrations: float = 0.25
    """Fraction of demonstrations in each batch, if the warm start has any."""
    imitation: float = 0.0
    """Weight of the imitation error in the actor's loss, if the warm start has demonstrations; the values in the loss
    are multiplied by `reward_scale`. Differences between the values of actions are smaller than the critic's errors,
    which would otherwise degrade a clone."""
    evaluate_every: int = 20_000
    """Environment steps between evaluations."""
    checkpoint_every: int = 50_000
    """Environment steps between checkpoints."""

    @property
    def discount(self) -> float:
        """Discount factor."""
        return (0.99 if self.task["horizon"] == "fixed" else 0.999) if self.gamma is None else self.gamma


def _as_paths(value: Any) -> list[Path]:
    """Return one path, several or none as a list."""
    return [Path(path) for path in ([value] if isinstance(value, (str, Path)) else value or ()) if path]


def _inherited(paths: Sequence[Path]) -> dict[str, Any]:
    """Return the task, the sensors and the components of the policy among some paths; empty without one."""
    included = _FOLDER.joinpath("policies", "pretrained")
    for path in paths:
        for folder in (Path(path), included.joinpath(str(path))):
            try:
                description = json.loads(folder.joinpath("policy.json").read_text(encoding="utf-8"))
                environment = description["environment"]
                known = {name: environment[name] for name in INHERITED}
                known |= {"components": description.get("components", LATER_SETTINGS["components"])}
                known |= {name: environment.get(name, value) for name, value in LATER_SENSORS.items()}
                return {**known, "history": tuple(environment["history"])}
            except (OSError, ValueError, KeyError, TypeError):  # `load_policy` reports a damaged file
                continue
    return {}


def _replace_nested(config: Any, table: dict[str, Any]) -> Any:
    """Return a configuration with the values of a table; a nested table changes the nested configuration."""
    changes: dict[str, Any] = {}
    for name, value in table.items():
        part = _replace_nested(getattr(config, name), value) if isinstance(value, dict) else value
        changes[name] = tuple(part) if isinstance(part, list) else part
    return replace(config, **changes)


ALGORITHMS: dict[str, type[RunConfig]] = {"bc": BCConfig, "dagger": DAggerRunConfig, "ppo": PPOConfig, "sac": SACConfig}


def read_config(run: Path) -> tuple[str, RunConfig]:
    """Read the algorithm and the configuration of the run in a directory, or from its file `config.json`.

    Raises:
        FileNotFoundError: the directory contains no run.
        ValueError: the configuration is damaged.

    """
    from pydantic import TypeAdapter, ValidationError

    path = run if run.is_file() else run / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no run in this directory")
    try:
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["config"]
        algorithm = "sac" if stored["algorithm"] == "tqc" else str(stored["algorithm"])
        names = {field.name for field in fields(ALGORITHMS[algorithm])}
        earlier = {name: value for name, value in LATER_SETTINGS.items() if name in names}
        return algorithm, TypeAdapter(ALGORITHMS[algorithm]).validate_python(
            {name: value for name, value in {**earlier, **stored}.items() if name != "algorithm" or algorithm == "sac"}
        )
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise ValueError(f"{path}: {name}: {first['msg']}, got {first['input']!r}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the configuration of a run: {error!r}") from None
