"""Files of policies: saving, loading, and the policies included in leapnav."""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

import leapnav
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots.base import RobotModel, robot_class
from leapnav.envs.scenarios.families import ALL, FAMILIES
from leapnav.envs.scenarios.scenario import check_robot
from leapnav.envs.settings import CONTROL_PERIOD, SENSORS, EnvironmentSettings
from leapnav.envs.unwrapping import observation_wrappers, unwrap
from leapnav.envs.utils.files import atomic_path, write_text
from leapnav.envs.utils.json_utils import encode
from leapnav.envs.utils.validation import suggestion
from leapnav.experts.data.datasets import ENVIRONMENT
from leapnav.training.config import LATER_SENSORS
from leapnav.training.policies.actors import policy_of
from leapnav.training.policies.architecture import KINDS, Architecture, is_actor_weight
from leapnav.training.policies.zips import is_zip, load_zip

BASELINES = ("expert", "random", "go-to-goal", "dwa", "mppi", "lattice", "freespace")  # policies without a file
FORMAT = 6  # version of policy.json
SHIPPED = Path(__file__).parent / "pretrained"
# Settings of the environment that determine the observation and the meaning of an action.
OBSERVED = (*SENSORS, "robot", "horizon", "actuation", "dict_observation")
# Fields of policy.json with their types, besides `format` and `environment`.
FIELDS = {"kind": str, "hidden": list, "critic": list, "actor_only": bool, "training": dict, "sha256": str}


def save_policy(
    model: BaseAlgorithm | BasePolicy,
    folder: str | Path,
    environment: Mapping[str, Any] | None = None,
    *,
    training: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Save a policy as `policy.json` (description) and `weights.pt` (tensors only) in a directory.

    Args:
        model: a Stable-Baselines3 algorithm (PPO, A2C, SAC, TD3, DDPG or TQC) with an "MlpPolicy", with the default
            network or that of `leapnav.training.network`, or with a "MultiInputPolicy" for `dict_observation=True`; or
            its policy.
        folder: the directory; created if it does not exist. A policy in it is replaced.
        environment: the arguments of `gym.make` for which the policy was trained, except the family; None: those of
            the model's environment, if it has one.
        training: description of the training, as JSON.
        half: save only the actor, in half precision: about 1/5 of the size; the actions change by about 1e-3.

    Raises:
        FileExistsError: the directory is that of a training run.
        TypeError: the model is not a Stable-Baselines3 algorithm or policy with an actor.
        ValueError: the policy has another network, an argument of the environment is invalid, or the environment has
            other observations than the policy.

    """
    if _is_run(Path(folder)):
        raise FileExistsError(f"{folder}: the directory of a training run, whose policy would be replaced")
    write_policy(model, folder, environment, training=training, half=half)
    warn_of_wrappers(model, 2)


def _is_run(folder: Path) -> bool:
    """Return whether a directory is that of a training run."""
    try:
        return "algorithm" in json.loads((folder / "config.json").read_text(encoding="utf-8"))["config"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_policy(
    model: BaseAlgorithm | BasePolicy,
    folder: str | Path,
    environment: Mapping[str, Any] | None,
    *,
    training: Mapping[str, Any] | None,
    half: bool = False,
) -> None:
    """Save a policy as `save_policy` does, also in the directory of its run."""
    policy, folder = policy_of(model), Path(folder)
    architecture = Architecture.of(policy)
    assert isinstance(policy.action_space, spaces.Box)  # checked above
    environment = environment_of(model) if environment is None else environment
    space = NavigateEnv(split="fresh", **environment).observation_space
    if space != policy.observation_space:
        raise ValueError(
            f"environment: has observations {space.shape or 'in a dict'}, the policy's are "
            f"{policy.observation_space.shape or 'in a dict'} or have other bounds; pass the arguments of gym.make "
            "that it was trained with"
        )
    folder.mkdir(parents=True, exist_ok=True)
    weights = policy.state_dict()
    if half:
        weights = {name: value.half() for name, value in weights.items() if is_actor_weight(name)}
    # Torch stores the name of the file in the file; that of a buffer is always the same.
    buffer = io.BytesIO()
    th.save(weights, buffer)
    with atomic_path(folder / "weights.pt") as partial:
        partial.write_bytes(buffer.getvalue())
    description = {
        "format": FORMAT,
        "leapnav": leapnav.__version__,
        "environment": {"id": ENVIRONMENT, **_as_dict(EnvironmentSettings(**environment))},
        "observation_low": _bounds(policy.observation_space, "low"),
        "observation_high": _bounds(policy.observation_space, "high"),
        "action_low": policy.action_space.low.tolist(),
        "action_high": policy.action_space.high.tolist(),
        **asdict(architecture),
        "actor_only": half,
        "training": dict(training or {}),
    }
    description["sha256"] = _checksum(folder, description)
    write_text(folder / "policy.json", encode(description, indent=1) + "\n")


def _bounds(space: spaces.Space, side: str) -> Any:
    """Return the bounds of a Box as a list, those of a Dict by their names."""
    if isinstance(space, spaces.Dict):
        return {name: _bounds(part, side) for name, part in space.spaces.items()}
    return getattr(space, side).tolist()


def _space(low: Any, high: Any) -> Any:
    """Return the space with the given `_bounds`."""
    if isinstance(low, dict):
        return spaces.Dict({name: _space(low[name], high[name]) for name in low})
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def _checksum(folder: Path, description: Mapping[str, Any]) -> str:
    """Return the SHA-256 checksum of the weights and the description of a policy as hexadecimal digits."""
    content = encode({name: value for name, value in description.items() if name != "sha256"})
    return hashlib.sha256(content.encode() + (folder / "weights.pt").read_bytes()).hexdigest()


def read_description(folder: str | Path) -> dict[str, Any]:
    """Read `policy.json`.

    Args:
        folder: see `load_policy`.

    Raises:
        FileNotFoundError: the directory contains no policy.
        ValueError: the file is damaged, or has another format or environment; the message contains the cause.

    """
    path = policy_folder(folder) / "policy.json"
    if not path.parent.exists():
        names = (*BASELINES, *shipped_policies())
        raise FileNotFoundError(
            f"{folder}: no such policy; expected a directory, a .zip of Stable-Baselines3 or one of {', '.join(names)}"
            f"{suggestion(str(folder), names)}"
        )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; {folder} is not the directory of a policy")
    text = path.read_text(encoding="utf-8")
    try:
        description = json.loads(text)
        found = description["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the description of a policy: {error!r}") from None
    if found != FORMAT:
        raise ValueError(f"{path}: format: expected {FORMAT}, got {found!r}; train the policy again")
    try:
        environment = description["environment"]["id"]
        if environment != ENVIRONMENT:
            raise ValueError(f"{path}: a policy for {environment}; expected one for {ENVIRONMENT}")
        for name, type_ in FIELDS.items():
            if not isinstance(description[name], type_):
                raise TypeError(f"{name} is {description[name]!r}")
        if description["kind"] not in KINDS:
            raise ValueError(f"{path}: kind: expected one of {', '.join(KINDS)}, got {description['kind']!r}")
        description["environment"]["history"] = tuple(description["environment"]["history"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the description of a policy: {error!r}") from None
    return description


def policy_environment(policy: str | Path | BaseAlgorithm) -> dict[str, Any]:
    """Return the arguments of `gym.make` for an environment with the observations that a policy was trained with.

    Those of a model saved by Stable-Baselines3 are derived from its observations, of a lidar, the state or the map. The
    robot is the name of its model; its parameters are those of the scenarios. The control period is contained if it is
    not the default.

    Args:
        policy: see `folder` of `load_policy`; or a model of Stable-Baselines3 with one of leapnav's environments.

    Raises:
        FileNotFoundError: see `load_policy`.
        TypeError: `policy` is neither a name, a path nor a model.
        ValueError: see `load_policy`; or the model has no environment of leapnav in this process.

    """
    if isinstance(policy, BaseAlgorithm):
        found = environment_of(policy)
        if not found:
            raise ValueError(f"policy: expected a model with one of leapnav's environments, got {policy.get_env()!r}")
        return found
    if not isinstance(policy, (str, Path)):
        raise TypeError(f"policy: expected a name, a path or a model of Stable-Baselines3, got {type(policy).__name__}")
    if is_zip(policy):
        return load_zip(policy)[1]
    description = read_description(policy)
    return {**_observed(description), **_period(description["environment"])}


def environment_of(model: Any) -> dict[str, Any]:
    """Return the arguments of `gym.make` that determine the observations and the period of a model's environment.

    They are empty if the model has no environment, not one of leapnav, or one in processes that have ended.
    """
    venv = model.get_env() if isinstance(model, BaseAlgorithm) else None
    try:
        settings = venv.get_attr("settings", 0)[0] if venv is not None and venv.has_attr("settings") else None
    except (EOFError, OSError):  # the environment is closed, and its processes have ended
        return {}
    if not isinstance(settings, EnvironmentSettings):
        return {}
    return {**{name: getattr(settings, name) for name in OBSERVED}, **_period(_as_dict(settings))}


def warn_of_wrappers(model: Any, stacklevel: int) -> None:
    """Warn if a model was trained with wrappers that change the observations of its environment."""
    venv = model.get_env() if isinstance(model, BaseAlgorithm) else None
    if names := [] if venv is None else observation_wrappers(venv):
        text = f"the model was trained with the wrappers {', '.join(names)}, which are not applied"
        warnings.warn(text, stacklevel=stacklevel + 1)


def _period(environment: Mapping[str, Any]) -> dict[str, float]:
    """Return the control period among the settings of an environment, unless it is the default."""
    period = environment.get("control_period", CONTROL_PERIOD)
    return {} if period == CONTROL_PERIOD else {"control_period": period}


def _observed(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of the environment in the description of a policy that determine the observation."""
    environment = description["environment"]
    # A policy that is older than one of these settings observes what was observed without it.
    return {**LATER_SENSORS, **{name: environment[name] for name in OBSERVED if name in environment}}


def load_policy(folder: str | Path, env: Any = None) -> BasePolicy:
    """Load a policy saved by `save_policy`, or the policy of a model saved by Stable-Baselines3.

    No code from the files is executed; see `leapnav.training.policies.zips.load_zip` for models that need that.

    Args:
        folder: the directory of the policy or of the run that trained it; the file of a model (`.zip`); or the name of
            a family ("clutter", ...) or "all" for an included policy (actor only, in half precision).
        env: an environment for the policy, single or vector; its observations are checked.

    Returns:
        A Stable-Baselines3 policy: `policy.predict(observation, deterministic=True)[0]` is the action.

    Raises:
        FileNotFoundError: the directory contains no policy.
        TypeError: `env` is not an environment of leapnav.
        ValueError: the files are damaged, or have another format or other observations; the message contains the cause.

    """
    if is_zip(folder):
        return _load_model(Path(folder), env)
    description = read_description(folder)
    folder = policy_folder(folder)
    try:
        observation_space = _space(description["observation_low"], description["observation_high"])
        n_controls = _n_controls(description["environment"])
        least, most = (  # older files do not contain these bounds, which are -1 and 1 without a wrapper of actions
            np.array(description.get(name, [bound] * n_controls), np.float32)
            for name, bound in (("action_low", -1.0), ("action_high", 1.0))
        )
        action_space = spaces.Box(least, most, dtype=np.float32)
        # Older files contain no `symmetries` and `components`.
        known = {field.name: description[field.name] for field in fields(Architecture) if field.name in description}
        architecture = Architecture(**known)
        policy = architecture.make(observation_space, action_space)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # a damaged description may raise any error in gymnasium or torch
        raise ValueError(f"{folder / 'policy.json'}: not the description of a policy: {error!r}") from None
    if env is not None:
        _check_environment(folder, description, observation_space, env)
    path = folder / "weights.pt"
    try:
        if _checksum(folder, description) != description["sha256"]:
            raise ValueError("damaged, or of another policy, or policy.json has been edited")
        weights = th.load(path, weights_only=True, map_location="cpu")
        if description["actor_only"]:
            initial = policy.state_dict()
            differing = sorted({name for name in initial if is_actor_weight(name)} ^ set(weights))
            if differing:
                raise ValueError(f"{differing[0]} is missing or unknown")
            weights = {**initial, **{name: value.float() for name, value in weights.items()}}
        policy.load_state_dict(weights)
    except FileNotFoundError:
        raise
    except Exception as error:  # torch raises many types of errors for a damaged file
        raise ValueError(f"{path}: not the weights of this policy: {str(error).splitlines()[0]}") from None
    policy.set_training_mode(False)
    return policy


def _load_model(path: Path, env: Any) -> BasePolicy:
    """Load the policy of a model saved by Stable-Baselines3, for the environment if one is given."""
    if env is None:
        return load_zip(path)[0]
    arguments = {name: value for name, value in _as_dict(unwrap(env)[0].settings).items() if name in OBSERVED}
    return load_zip(path, arguments)[0]


def _n_controls(environment: Mapping[str, Any]) -> int:
    """Return the number of controls of the robot in the description of an environment.

    Raises:
        ValueError: the robot's model is not registered.

    """
    return robot_class(environment["robot"]).sizes()[1]


def _check_environment(folder: Path, description: dict[str, Any], space: spaces.Space, env: Any) -> None:
    """Check that an environment has the observations that the policy was trained with."""
    trained = _observed(description)
    for inner in unwrap(env):
        settings = _as_dict(inner.settings)
        differing = [
            f"{name}={trained.get(name)!r} (here {settings.get(name)!r})"
            for name in OBSERVED
            if trained.get(name) != settings.get(name)
        ]
        robot = trained_robot(description)
        others = robot.differences(inner.source.robot) if robot is not None and not differing else []
        if others:
            warnings.warn(f"{folder}: trained with another robot: {'; '.join(others)}", stacklevel=3)
        if differing or getattr(inner, "single_observation_space", inner.observation_space) != space:
            difference = ", ".join(differing) or "other bounds"
            raise ValueError(f"{folder}: the policy was trained with other observations: {difference}")


def trained_robot(description: Mapping[str, Any]) -> RobotModel | None:
    """Return the robot of the training in the description of a policy; None if its parameters are unknown."""
    training = description["training"]
    robot: Any = training.get("robot")
    if not isinstance(robot, Mapping):
        robot = description["environment"].get("robot") if training.get("family") in (*FAMILIES, ALL) else None
    return None if robot is None else check_robot(robot)


def shipped_policies() -> list[str]:
    """Return the names of the policies included in leapnav.

    A name is that of a family, or "all" for a policy for all families, with a prefix for a free horizon ("free") or
    another robot, and the suffix "lidar" if the policy does not know the map.
    """
    names = [path.parent.name for path in SHIPPED.glob("*/policy.json")]
    known = (*FAMILIES, ALL)
    return sorted(names, key=lambda name: (name not in known, known.index(name) if name in known else 0, name))


def policy_folder(folder: str | Path) -> Path:
    """Return the directory of a policy, given as a directory or as the name of an included policy."""
    path = Path(folder)
    return SHIPPED / path if str(folder) in shipped_policies() and not path.exists() else path


def _as_dict(settings: EnvironmentSettings) -> dict[str, Any]:
    """Return the settings that are not None as a dictionary."""
    return {name: value for name, value in asdict(settings).items() if value is not None}
