"""Export of policies to ONNX, for programs and robots without Python or torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

import leapnav
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import Entry, observation_entries
from leapnav.envs.utils.files import atomic_path, write_text
from leapnav.envs.utils.json_utils import encode
from leapnav.training.policies.actors import action_mixture, parts_of_dict, policy_of
from leapnav.training.policies.files import load_policy, policy_environment
from leapnav.training.policies.navigation_policy import deterministic_action

INPUT, OUTPUT = "observation", "action"
TOLERANCE = 1e-5  # largest difference of an action from that of torch
N_CHECKED = 64  # random observations with which the exported policy is compared


class _Actor(nn.Module):
    """The deterministic action of a policy, clipped to [-1, 1]."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy: Any = policy

    def forward(self, observation: th.Tensor) -> th.Tensor:
        return deterministic_action(self.policy, partial(action_mixture, self.policy), observation)


def export_onnx(
    policy: str | Path | BasePolicy | BaseAlgorithm,
    path: str | Path,
    environment: Mapping[str, Any] | None = None,
) -> Path:
    """Export the deterministic actor of a policy to an ONNX file, with a description of its observations beside it.

    The model has the input "observation" (N, d), float32, also for a policy with observations in a Dict, and the output
    "action" (N, 2) in [-1, 1]: speed and turn rate in units of the robot's limits. The description, `FILE.json`, lists
    names, units, order and bounds of the entries of an observation, and the arguments of the environment. After the
    export, the actions are compared with those of torch.

    Args:
        policy: a policy or model of Stable-Baselines3, or the name of one, see `load_policy`.
        path: the file, with the suffix `.onnx`.
        environment: the arguments of `gym.make` for which the policy was trained; None: those of the policy's file, or
            the defaults.

    Returns:
        The file of the description.

    Raises:
        FileNotFoundError: there is no policy of this name.
        ModuleNotFoundError: the extra `onnx` is not installed.
        TypeError: the model is not a Stable-Baselines3 algorithm or policy with an actor.
        ValueError: the suffix is not `.onnx`, the observations are not those of the environment, or the exported policy
            has other actions.

    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"{path}: expected a name that ends in .onnx")
    if isinstance(policy, (str, Path)):
        environment = policy_environment(policy) if environment is None else environment
        policy = load_policy(policy)
    actor = _Actor(policy_of(policy)).eval().to("cpu")
    settings = EnvironmentSettings(**(environment or {}))
    space, flat = actor.policy.observation_space, settings
    if isinstance(space, spaces.Dict):
        parts_of_dict(space)
        flat = replace(settings, dict_observation=False)
    entries = observation_entries(flat)
    if spaces.flatdim(space) != len(entries):
        expected = spaces.flatdim(space)
        raise ValueError(f"environment: has observations of {len(entries)} numbers, the policy's {expected}")
    low, high = (np.array([getattr(entry, side) for entry in entries], np.float32) for side in ("low", "high"))
    examples = np.random.default_rng(0).uniform(np.maximum(low, -10), np.minimum(high, 10), (N_CHECKED, len(entries)))
    observations = th.as_tensor(examples.astype(np.float32))
    _export(actor, observations, path)
    with th.no_grad():
        difference = float(np.abs(_run(path, observations) - actor(observations).numpy()).max())
    if not difference <= TOLERANCE:
        path.unlink()
        raise ValueError(f"{path}: the exported policy has other actions, by {difference:.1e}; nothing was written")
    description = {
        "leapnav": leapnav.__version__,
        "input": {"name": INPUT, "shape": ["N", len(entries)], "type": "float32"},
        "output": {"name": OUTPUT, "shape": ["N", *actor.policy.action_space.shape], "type": "float32"},
        "observation": [{"index": k, **asdict(entry)} for k, entry in enumerate(entries)],
        "action": [
            {"index": k, **asdict(Entry(f"{name} / max_{name}", "1", -1.0, 1.0))}
            for k, name in enumerate(settings.model.control_names)
        ],
        "control_period": settings.control_period,
        "environment": asdict(settings),
        "largest_difference_from_torch": difference,
    }
    beside = path.with_suffix(".onnx.json")
    write_text(beside, encode(description, indent=1) + "\n")
    return beside


def _export(actor: _Actor, observations: th.Tensor, path: Path) -> None:
    """Write the ONNX file. The exporter prints its progress and warnings of torch's own modules, which are hidden."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with atomic_path(path) as partial, redirect_stdout(StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            th.onnx.export(
                actor,
                (observations,),
                str(partial),
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamo=True,
                dynamic_shapes=({0: th.export.Dim("batch")},),
                external_data=False,
            )
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f'the export needs {error.name}: pip install "leapnav[onnx]"') from None


def _run(path: Path, observations: th.Tensor) -> np.ndarray:
    """Return the actions of an ONNX file."""
    try:
        from onnxruntime import InferenceSession
    except ModuleNotFoundError:
        raise ModuleNotFoundError('the export needs onnxruntime: pip install "leapnav[onnx]"') from None
    session = InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {INPUT: observations.numpy()})[0])
