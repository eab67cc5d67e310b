"""Models saved by `model.save` of Stable-Baselines3 (`.zip`), read without executing anything that they contain.

Such a file holds pickled Python objects, which can execute any code when they are loaded. Beside each object the file
describes it as text. This module reads only these descriptions and the tensors of the weights
(`torch.load(weights_only=True)`), and makes the network from its own code. Models that need more (custom networks or
feature extractors) are loaded by `trust=True` with the loader of Stable-Baselines3.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots.base import robot_class
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import FREE_GOAL_ENTRIES, GOAL_ENTRIES, ObservationLayout
from leapnav.training.policies.architecture import ACTIVATIONS, EXTRACTORS, Architecture, is_actor_weight, widths

# Kinds of policies by the module of their class, with the default widths of Stable-Baselines3.
KINDS: dict[str, tuple[str, list[int]]] = {
    "stable_baselines3.common.policies": ("actor-critic", [64, 64]),
    "stable_baselines3.sac.policies": ("sac", [256, 256]),
    "stable_baselines3.td3.policies": ("td3", [400, 300]),
    "sb3_contrib.tqc.policies": ("tqc", [256, 256]),
    "leapnav.training.policies.navigation_policy": ("actor-critic", [64, 64]),
}
# Settings of the policy that do not change its deterministic action.
IGNORED = frozenset({"log_std_init", "ortho_init", "optimizer_class", "optimizer_kwargs", "normalize_images"}) | {
    *("n_critics", "n_quantiles"),  # of the critics, which are not loaded
    "quiet",  # of NavigationPolicy
}
ADVICE = "trust=True (--trust) loads it with Stable-Baselines3, which executes code from the file"


def is_zip(path: str | Path) -> bool:
    """Return whether a path is that of a model saved by Stable-Baselines3."""
    return Path(path).suffix == ".zip"


def load_zip(
    path: str | Path, environment: Mapping[str, Any] | None = None, *, trust: bool = False
) -> tuple[BasePolicy, dict[str, Any]]:
    """Load the policy of a model saved by Stable-Baselines3.

    Args:
        path: the file, written by `model.save` of PPO, A2C, SAC, TD3, DDPG or TQC; with `trust` also of CrossQ.
        environment: arguments of the environment with which it was trained; None: derived from the observation space,
            for a lidar.
        trust: load with Stable-Baselines3, which executes code from the file; for models with custom classes.

    Returns:
        The policy, whose critic is not loaded unless `trust` is set, and the arguments of its environment.

    Raises:
        FileNotFoundError: there is no such file.
        ModuleNotFoundError: a TQC model needs the extra `contrib`.
        ValueError: the file is damaged, the model is of no supported kind, or its observations are not those of the
            environment.

    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with zipfile.ZipFile(path) as file:
            data: dict[str, Any] = json.loads(file.read("data"))
            weights: dict[str, th.Tensor] = th.load(
                io.BytesIO(file.read("policy.pth")), weights_only=True, map_location="cpu"
            )
    except Exception as error:  # zipfile, json and torch raise many types of errors for a damaged file
        raise ValueError(f"{path}: not a model of Stable-Baselines3, or damaged: {error}".splitlines()[0]) from None
    arguments, space = _environment(path, data, environment)
    if trust:
        policy = _algorithm(path, data).load(path, device="cpu").policy
    else:
        n_controls = robot_class(arguments.get("robot", "unicycle")).sizes()[1]
        policy = _architecture(path, data).make(space, _action_space(path, data, n_controls))
        _load_actor(path, policy, weights)
    policy.set_training_mode(False)
    return policy, arguments


def _environment(path: Path, data: Mapping[str, Any], given: Mapping[str, Any] | None) -> tuple[dict[str, Any], Any]:
    """Return the arguments of the environment and its observation space, which is compared with the file's."""
    stored = _described(data.get("observation_space"))
    shape = stored.get("_shape")
    arguments = dict(given or {})
    if given is None and isinstance(shape, list) and len(shape) == 1 and shape[0] > FREE_GOAL_ENTRIES:
        # The range of the lidar is the last bound; NumPy's text of a long vector contains it, too.
        high = [float(number) for number in re.findall(r"[-+]?\d[\d.e+-]*", str(stored.get("high")))] or [10.0]
        for kind, n_goal in (({}, GOAL_ENTRIES), ({"horizon": "free"}, FREE_GOAL_ENTRIES)):
            arguments = {"lidar_beams": max(shape[0] - n_goal, 0), "lidar_range": high[-1], **kind}
            if _has_bounds(ObservationLayout(EnvironmentSettings(**arguments)).space, stored):
                break
    space: Any = NavigateEnv(split="fresh", **arguments).observation_space
    is_box = isinstance(space, spaces.Box) and shape == list(space.shape)
    if not is_box or not _has_bounds(space, stored):
        kind = "a Box" if shape else "no Box"
        raise ValueError(
            f"{path}: its observations ({kind} of shape {tuple(shape or ())}) are not those of the environment with "
            f"{arguments or 'the defaults'}; give the arguments it was trained with (--env observation=map, ...)"
        )
    return arguments, space


def _action_space(path: Path, data: Mapping[str, Any], n_controls: int) -> spaces.Box:
    """Return the action space, whose bounds are not -1 and 1 if the environment had a wrapper of actions."""
    stored = _described(data.get("action_space"))
    if stored.get("_shape") != [n_controls]:
        raise ValueError(
            f"{path}: its actions have the shape {stored.get('_shape')}, those of the robot ({n_controls},)"
        )
    low, high = (
        np.array([float(number) for number in re.findall(r"-?(?:inf|[\d.]+(?:e[-+]?\d+)?)", str(stored.get(side)))])
        for side in ("low", "high")
    )
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), (n_controls,), np.float32)


def _has_bounds(space: Any, stored: Mapping[str, Any]) -> bool:
    """Return whether the bounds of a space are those that a file describes."""
    return all(str(getattr(space, side)) == stored.get(side) for side in ("low", "high"))


def _architecture(path: Path, data: Mapping[str, Any]) -> Architecture:
    """Return the architecture, from the descriptions of the policy's class and its arguments."""
    module = str(_described(data.get("policy_class")).get("__module__"))
    if module not in KINDS:
        raise ValueError(
            f"{path}: policy class: expected one of PPO, A2C, SAC, TD3, DDPG or TQC, got {module}; {ADVICE}"
        )
    kind, default = KINDS[module]
    arguments = {name: value for name, value in _described(data.get("policy_kwargs")).items() if name not in IGNORED}
    if data.get("use_sde") or arguments.pop("use_sde", False):
        raise ValueError(f"{path}: use_sde: expected False, got True; {ADVICE}")
    hidden, critic = widths(arguments.pop("net_arch", default))
    weights = arguments.pop("effort_weights", None)
    activation = _class_name(arguments.pop("activation_fn", "Tanh" if kind == "actor-critic" else "ReLU"))
    extractor = _class_name(arguments.pop("features_extractor_class", "FlattenExtractor"))
    extractors = {value.__name__: name for name, value in EXTRACTORS.items()}
    if activation not in ACTIVATIONS or extractor not in extractors or arguments:
        unknown = next(iter(arguments), extractor if extractor not in extractors else activation)
        raise ValueError(f"{path}: policy_kwargs: {unknown} is not supported; {ADVICE}")
    return Architecture(kind, hidden, critic, extractors[extractor], activation, weights)


def _load_actor(path: Path, policy: BasePolicy, weights: Mapping[str, th.Tensor]) -> None:
    initial = policy.state_dict()
    actor = {name: value for name, value in weights.items() if is_actor_weight(name)}
    expected = {name: value.shape for name, value in initial.items() if is_actor_weight(name)}
    if {name: value.shape for name, value in actor.items()} != expected:
        raise ValueError(f"{path}: the weights are not those of the network that the file describes; {ADVICE}")
    policy.load_state_dict({**initial, **actor})


def _algorithm(path: Path, data: Mapping[str, Any]) -> type[BaseAlgorithm]:
    """Return the algorithm of a model, which is recognised by its settings."""
    import stable_baselines3 as sb3

    module = str(_described(data.get("policy_class")).get("__module__"))
    if module.startswith("sb3_contrib.crossq"):
        from sb3_contrib import CrossQ  # from the extra `contrib`

        return CrossQ
    if "clip_range" in data:
        return sb3.PPO
    if "gae_lambda" in data:
        return sb3.A2C
    if "top_quantiles_to_drop_per_net" in data:
        from sb3_contrib import TQC  # from the extra `contrib`

        return TQC
    if "target_entropy" in data:
        return sb3.SAC
    if "policy_delay" in data:
        return sb3.TD3
    raise ValueError(f"{path}: expected a model of PPO, A2C, SAC, TD3, DDPG or TQC, got one with the policy {module}")


def _described(value: Any) -> dict[str, Any]:
    """Return the readable part of a stored object."""
    items = value.items() if isinstance(value, dict) else ()
    return {name: item for name, item in items if not name.startswith(":")}


def _class_name(text: Any) -> str:
    """Return the name in "<class 'module.Name'>"; other text is a name already."""
    return str(text).removeprefix("<class '").removesuffix("'>").rpartition(".")[2]
