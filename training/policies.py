"""The network that learns to navigate, as a Stable-Baselines3 policy, and its files."""

from __future__ import annotations

import errno
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

import leapnav
from leapnav.envs.families import ALL, FAMILIES
from leapnav.envs.observations import GOAL_ENTRIES
from leapnav.envs.settings import SENSORS, Settings
from leapnav.experts.demonstrations import ENVIRONMENT
from leapnav.training.actors import policy_of

FORMAT = 2
SHIPPED = Path(__file__).parent / "pretrained"
HIDDEN = (256, 256, 256)
ROBOT_RADIUS = 0.25  # m, the scale on which a near obstacle matters


class NavigationFeatures(BaseFeaturesExtractor):
    """The observation on the scales that matter: far and near the goal, far and near an obstacle.

    The last decimetre decides over success, and a lidar range of 0.3 m differs from one of 0.5 m more than 5 m from
    10 m do; raw metres and seconds hide both from a small network.
    """

    # Columns of `_features` that do not depend on the number of beams, and lidar encodings per beam.
    POSE_FEATURES, BEAM_FEATURES = 23, 3

    def __init__(self, observation_space: spaces.Box) -> None:
        beams = observation_space.shape[0] - GOAL_ENTRIES
        super().__init__(observation_space, self.POSE_FEATURES + self.BEAM_FEATURES * beams)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Features (B, features_dim) of observations (B, d)."""
        goal, time = observations[:, 0:2], observations[:, 4:5]
        distance = goal.norm(dim=1, keepdim=True)
        facing = observations[:, 2:4]  # cosine and sine of the heading error
        error = th.atan2(observations[:, 3:4], observations[:, 2:3])
        bearing = th.atan2(goal[:, 1:2], goal[:, 0:1])
        needed, needed_turn = observations[:, 5:8], observations[:, 8:9]
        ranges = observations[:, GOAL_ENTRIES:]
        return th.cat(
            [
                goal / 5,
                distance / 5,
                facing,
                time / 10,
                needed.clamp(-3, 3),
                (needed_turn / 2).clamp(-3, 3),
                th.tanh(needed[:, :2]),
                goal / (distance + 0.1),
                th.log(distance + 0.05),
                th.log(time + 0.05),
                th.exp(-time),
                th.tanh(goal / 0.3),
                th.tanh(error / 0.3),
                error,
                # Zero where one circular arc ends in the goal pose: its chord halves the turn.
                th.cos(error - 2 * bearing),
                th.sin(error - 2 * bearing),
                ranges / 5,
                th.exp(-(ranges - ROBOT_RADIUS) / 0.3),
                ROBOT_RADIUS / ranges.clamp(min=0.1),
            ],
            dim=1,
        )


def network(hidden: Sequence[int] = HIDDEN, critic: Sequence[int] | None = None) -> dict[str, Any]:
    """The `policy_kwargs` of PPO, A2C, SAC or TQC for the network of this module.

    Args:
        hidden: widths of the actor's hidden layers.
        critic: of the critic's, the same if not given.

    """
    widths = list(hidden if critic is None else critic)
    return {
        "net_arch": {"pi": list(hidden), "vf": widths, "qf": widths},
        "activation_fn": nn.ReLU,
        "features_extractor_class": NavigationFeatures,
    }


def make_policy(
    observation_space: spaces.Space,
    action_space: spaces.Space,
    seed: int = 0,
    hidden: Sequence[int] = HIDDEN,
    critic: Sequence[int] | None = None,
) -> ActorCriticPolicy:
    """A freshly initialised actor-critic for `leapnav/Navigate-v0`, which PPO and A2C can go on training.

    Raises:
        ValueError: the spaces are not the environment's.

    """
    _check_spaces(observation_space, action_space)
    with th.random.fork_rng(devices=[]):  # the caller's generator stays as it is
        th.manual_seed(seed)
        return ActorCriticPolicy(
            observation_space,
            action_space,
            lr_schedule=lambda _: 3e-4,
            log_std_init=-2.0,
            **network(hidden, critic),
        )


def _check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    shape = observation_space.shape if isinstance(observation_space, spaces.Box) else ()
    if not (len(shape) == 1 and shape[0] > GOAL_ENTRIES):
        got = f"a Box of shape {shape}" if shape else type(observation_space).__name__
        raise ValueError(f"observation_space: expected that of {ENVIRONMENT} with a lidar, got {got}")
    if not (isinstance(action_space, spaces.Box) and action_space.shape == (2,)):
        raise ValueError(f"action_space: expected that of {ENVIRONMENT}, got {action_space}")


def save_policy(
    model: BaseAlgorithm | BasePolicy,
    folder: str | Path,
    environment: Mapping[str, Any] | None = None,
    *,
    training: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Writes `policy.json` (what it is) and `weights.pt` (tensors only) into a folder.

    Args:
        model: an algorithm with the network of this module (PPO, A2C, SAC or TQC), or its policy.
        folder: made if it is not there.
        environment: the arguments of `gym.make` that the policy was trained for, besides the family: `observation` and
            so on.
        training: what to remember of how it came about; JSON.
        half: store the actor alone, in half precision: a fifth of the size, and actions that differ by about 1e-3.

    Raises:
        ValueError: the policy has another network, or an argument of the environment is impossible.

    """
    policy, folder = policy_of(model), Path(folder)
    kind = next((name for name, type_ in _kinds().items() if isinstance(policy, type_)), None)
    if kind is None or policy.features_extractor_class is not NavigationFeatures:
        raise ValueError(
            f"model: expected a policy made with policy_kwargs=leapnav.training.network(), got {type(policy).__name__}"
        )
    assert isinstance(policy.observation_space, spaces.Box)
    folder.mkdir(parents=True, exist_ok=True)
    # The anchor of PPO's divergence belongs to the run, not to the policy.
    weights = {name: value for name, value in policy.state_dict().items() if not name.startswith("anchor")}
    if half:
        weights = {name: value.half() for name, value in weights.items() if _is_of_actor(name)}
    widths: Any = policy.net_arch
    description = {
        "format": FORMAT,
        "leapnav": leapnav.__version__,
        "environment": {"id": ENVIRONMENT, **_plain(Settings(**(environment or {})))},
        "observation_low": policy.observation_space.low.tolist(),
        "observation_high": policy.observation_space.high.tolist(),
        "kind": kind,
        "hidden": widths["pi"],
        "critic": widths["vf"],
        "actor_only": half,
        "training": dict(training or {}),
    }
    partial = folder / ".weights.pt.partial"
    th.save(weights, partial)
    description["sha256"] = hashlib.sha256(partial.read_bytes()).hexdigest()
    partial.replace(folder / "weights.pt")
    partial = folder / ".policy.json.partial"
    partial.write_text(json.dumps(description, indent=1) + "\n")
    partial.replace(folder / "policy.json")


def read_description(folder: str | Path) -> dict[str, Any]:
    """What `policy.json` says of a policy.

    Raises:
        FileNotFoundError: the folder holds no policy.
        ValueError: the file is broken, of another format or for another environment; the message says which.

    """
    path = policy_folder(folder) / "policy.json"
    if not path.parent.exists():
        shipped = ", ".join(shipped_policies())
        raise FileNotFoundError(errno.ENOENT, f"no such policy, and none of that name ships ({shipped})", str(folder))
    text = path.read_text()
    try:
        description = json.loads(text)
        found = description["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a policy's description: {error!r}") from None
    if found != FORMAT:
        raise ValueError(f"{path}: format: expected {FORMAT}, got {found!r}; train the policy anew")
    try:
        environment = description["environment"]["id"]
        if environment != ENVIRONMENT:
            raise ValueError(f"{path}: a policy for {environment}; this leapnav has {ENVIRONMENT}")
        for name, type_ in (
            ("kind", str),
            ("hidden", list),
            ("critic", list),
            ("actor_only", bool),
            ("training", dict),
            ("sha256", str),
        ):
            if not isinstance(description[name], type_):
                raise TypeError(f"{name} is {description[name]!r}")
        if description["kind"] not in _KINDS:
            raise ValueError(f"{path}: kind: expected one of {', '.join(_KINDS)}, got {description['kind']!r}")
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a policy's description: {error!r}") from None
    return description


def policy_environment(folder: str | Path) -> dict[str, Any]:
    """The arguments of `gym.make` that a policy needs to see what it has learned to see.

    Args:
        folder: see `load_policy`.

    Raises:
        FileNotFoundError, ValueError: see `load_policy`.

    """
    found = read_description(folder)["environment"]
    return {name: found[name] for name in OBSERVED if name in found}


def load_policy(folder: str | Path, env: Any = None) -> BasePolicy:
    """Reads a policy that `save_policy` wrote; nothing of the file is executed.

    Args:
        folder: of the policy, or of the run that made it; or the name of a family, "clutter" and so on, or "all", for
            the policy that ships for it (actors only, in half precision).
        env: if given, the environment that the policy is to drive, single or vector; it must show what the policy
            observes.

    Returns:
        A policy of Stable-Baselines3: `policy.predict(observation, deterministic=True)[0]` is the action.

    Raises:
        FileNotFoundError: the folder holds no policy.
        ValueError: the files are broken, of another format or for other observations; the message says which.

    """
    description = read_description(folder)
    folder = policy_folder(folder)
    try:
        low, high = (np.array(description[name], np.float32) for name in ("observation_low", "observation_high"))
        observation_space = spaces.Box(low, high, dtype=np.float32)
        action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        _check_spaces(observation_space, action_space)
        policy = _kind(description["kind"])(
            observation_space,
            action_space,
            lambda _: 3e-4,
            **network(description["hidden"], description["critic"]),
        )
    except ModuleNotFoundError:
        raise
    except Exception as error:  # whatever a damaged description makes of a network
        raise ValueError(f"{folder / 'policy.json'}: not a policy's description: {error!r}") from None
    if env is not None:
        _check_environment(folder, description, observation_space, env)
    try:
        content = (folder / "weights.pt").read_bytes()
        if hashlib.sha256(content).hexdigest() != description["sha256"]:
            raise ValueError("damaged, or of another policy")
        weights = th.load(io.BytesIO(content), weights_only=True, map_location="cpu")
        if description["actor_only"]:
            own = policy.state_dict()
            missing = sorted({name for name in own if _is_of_actor(name)} ^ set(weights))
            if missing:
                raise ValueError(f"{missing[0]} is missing or unknown")
            weights = {**own, **{name: value.float() for name, value in weights.items()}}
        policy.load_state_dict(weights)
    except FileNotFoundError:
        raise
    except Exception as error:  # torch raises many kinds for a broken file
        raise ValueError(f"{folder / 'weights.pt'}: not this policy's weights: {str(error).splitlines()[0]}") from None
    policy.set_training_mode(False)
    return policy


def _check_environment(folder: Path, description: dict[str, Any], space: spaces.Box, env: Any) -> None:
    """Refuses an environment that shows something else than the policy has learned to see."""
    inner: Any = env
    while hasattr(inner, "venv"):  # Stable-Baselines3's wrappers, and leapnav's adapter
        inner = inner.venv
    inner = inner.unwrapped
    trained, given = description["environment"], _plain(inner.settings)
    differing = [
        f"{name}={trained.get(name)!r} (here {given.get(name)!r})"
        for name in OBSERVED
        if trained.get(name) != given.get(name)
    ]
    if differing or getattr(inner, "single_observation_space", inner.observation_space) != space:
        of_what = ", ".join(differing) or "other bounds"
        raise ValueError(f"{folder}: the policy observes another environment than this one: {of_what}")


def shipped_policies() -> list[str]:
    """Names of the policies that ship with leapnav: families, and "all" for one that knows them all."""
    return [name for name in (*FAMILIES, ALL) if (SHIPPED / name / "policy.json").is_file()]


def policy_folder(folder: str | Path) -> Path:
    """The folder of a policy, given itself or by the name of one that ships."""
    place = Path(folder)
    return SHIPPED / place if str(folder) in shipped_policies() and not place.exists() else place


# Settings that what is observed depends on.
OBSERVED = (*SENSORS, "actuation", "dict_observation")


def _plain(settings: Settings) -> dict[str, Any]:
    """Settings as JSON has them."""
    return {field.name: value for field in fields(settings) if (value := asdict(settings)[field.name]) is not None}


_KINDS = ("actor-critic", "sac", "tqc")


def _kind(name: str) -> Any:
    """The class of a policy."""
    if name == "tqc":
        from sb3_contrib.tqc.policies import TQCPolicy  # of the extra `contrib`

        return TQCPolicy
    return {"actor-critic": ActorCriticPolicy, "sac": SACPolicy}[name]


def _kinds() -> dict[str, Any]:
    """The classes that are there."""
    from importlib.util import find_spec

    return {name: _kind(name) for name in _KINDS if name != "tqc" or find_spec("sb3_contrib") is not None}


def _is_of_actor(name: str) -> bool:
    """Whether a weight belongs to the mean action or its noise."""
    return name.startswith(("actor.", "mlp_extractor.policy_net.", "action_net.", "log_std"))
