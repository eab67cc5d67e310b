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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from leapnav.envs.goal_navigation import NavigateGoalEnv
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots.base import robot_class
from leapnav.envs.simulation.observations import FREE_GOAL_ENTRIES, GOAL_ENTRIES
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
# A replay buffer is not needed; that of hindsight experience replay would need an environment.
NO_BUFFER = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1}
ADVICE = "trust=True (--trust) loads it with Stable-Baselines3, which executes code from the file"


def is_zip(path: str | Path) -> bool:
    """Return whether a path is that of a model saved by Stable-Baselines3."""
    return Path(path).suffix == ".zip"


def load_zip(
    path: str | Path, environment: Mapping[str, Any] | None = None, *, trust: bool = False
) -> tuple[BasePolicy, dict[str, Any]]:
    """Load the policy of a model saved by Stable-Baselines3.

    Args:
        path: the file, written by `model.save` of PPO, A2C, SAC, TD3, DDPG or TQC; with `trust` also
            of CrossQ, TRPO, RecurrentPPO and ARS, and with observations in a Dict.
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
    if trust:
        policy = _algorithm(path, data).load(path, device="cpu", custom_objects=NO_BUFFER).policy
        arguments, _ = _environment(path, _Space.of(policy.observation_space), environment)
    else:
        arguments, space = _environment(path, _Space.described(data), environment)
        n_controls = robot_class(arguments.get("robot", "unicycle")).sizes()[1]
        policy = _architecture(path, data).make(space, _action_space(path, data, n_controls))
        _load_actor(path, policy, weights)
    policy.set_training_mode(False)
    return policy, arguments


@dataclass(frozen=True)
class _Space:
    """An observation space, or the description of one in a file.

    Attributes:
        keys: the keys of a Dict, none for a Box.
        sizes: number of entries of each part of a Dict, or of the Box.
        bounds: text of the bounds of each, low and high; NumPy shortens that of a long vector.

    """

    keys: tuple[str, ...]
    sizes: tuple[int, ...]
    bounds: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, space: Any) -> _Space:
        """Return the description of a space."""
        parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}
        boxes = [part for part in parts.values() if isinstance(part, spaces.Box) and len(part.shape) == 1]
        keys = tuple(parts) if isinstance(space, spaces.Dict) else ()
        if len(boxes) < len(parts):
            return cls(keys, (), ())
        return cls(keys, tuple(box.shape[0] for box in boxes), tuple((str(box.low), str(box.high)) for box in boxes))

    @classmethod
    def described(cls, data: Mapping[str, Any]) -> _Space:
        """Return the description of a Box in a file; without entries if it is none."""
        stored = _described(data.get("observation_space"))
        shape = stored.get("_shape")
        if not (isinstance(shape, list) and len(shape) == 1):
            return cls((), (), ())
        return cls((), (shape[0],), ((str(stored.get("low")), str(stored.get("high"))),))

    @property
    def is_goal(self) -> bool:
        """Whether it is that of the goal-conditioned environment."""
        return "achieved_goal" in self.keys

    def guesses(self) -> Iterator[dict[str, Any]]:
        """Yield arguments of an environment with a lidar, or with the state or the map, that may have this space."""
        sized = dict(zip(self.keys or ("observation",), zip(self.sizes, self.bounds, strict=True), strict=False))
        if not sized:
            return
        size, (_, high) = sized.get("lidar") or sized.get("observation") or next(iter(sized.values()))
        # The range of the lidar is the last bound; NumPy's text of a long vector contains it, too.
        numbers = [float(number) for number in re.findall(r"[-+]?\d[\d.e+-]*", high)] or [10.0]
        form = {"dict_observation": True} if self.keys and not self.is_goal else {}
        for kind, n_goal in (({}, GOAL_ENTRIES), ({"horizon": "free"}, FREE_GOAL_ENTRIES)):
            others = 0 if form else int(not kind) if self.is_goal else n_goal  # entries that are not of the lidar
            if size > others:
                yield {"lidar_beams": size - others, "lidar_range": numbers[-1], **kind, **form}
            if not self.is_goal:
                yield from ({"observation": name, **kind, **form} for name in ("state", "map"))


def _environment(path: Path, stored: _Space, given: Mapping[str, Any] | None) -> tuple[dict[str, Any], Any]:
    """Return the arguments of the environment and its observation space, which is compared with that of the model."""
    arguments = dict(given or {})
    make = NavigateGoalEnv if stored.is_goal else NavigateEnv
    for guess in stored.guesses() if given is None else ():
        if _Space.of(make(split="fresh", **guess).observation_space) == stored:
            arguments = guess
            break
    space: Any = make(split="fresh", **arguments).observation_space
    if not stored.sizes:
        raise ValueError(f"{path}: its observations are not a vector; {ADVICE}")
    if _Space.of(space) != stored:
        shape = f"a Box of shape {stored.sizes}" if not stored.keys else f"a Dict of {', '.join(stored.keys)}"
        raise ValueError(
            f"{path}: its observations ({shape}) are not those of the environment with "
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
    own = {name: arguments.pop(name) for name in ("effort_weights", "symmetries", "components") if name in arguments}
    activation = _class_name(arguments.pop("activation_fn", "Tanh" if kind == "actor-critic" else "ReLU"))
    extractor = _class_name(arguments.pop("features_extractor_class", "FlattenExtractor"))
    extractors = {value.__name__: name for name, value in EXTRACTORS.items()}
    if activation not in ACTIVATIONS or extractor not in extractors or arguments:
        unknown = next(iter(arguments), extractor if extractor not in extractors else activation)
        raise ValueError(f"{path}: policy_kwargs: {unknown} is not supported; {ADVICE}")
    return Architecture(kind, hidden, critic, extractors[extractor], activation, **own)


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
    contributed = {"sb3_contrib.crossq.policies": "CrossQ", "sb3_contrib.ars.policies": "ARS"}
    if module in contributed:
        import sb3_contrib  # from the extra `contrib`

        return getattr(sb3_contrib, contributed[module])
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
