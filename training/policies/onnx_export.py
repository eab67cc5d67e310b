"""Export of policies to ONNX, for programs and robots without Python or torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

import leapnav
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import ACTION, observation_entries
from leapnav.envs.utils.files import atomic_path, write_text
from leapnav.envs.utils.json_utils import encode
from leapnav.training.policies.actors import mean_action, policy_of
from leapnav.training.policies.files import load_policy, policy_environment
from leapnav.training.policies.memory import LAGS, memory_of, next_history, stack_frames
from leapnav.training.policies.momentum import add_momentum

INPUT, OUTPUT = "observation", "action"
TOLERANCE = 1e-5  # largest difference of an action from that of torch
N_CHECKED = 64  # random observations with which the exported policy is compared


class _Actor(nn.Module):
    """The deterministic action of a policy, clipped to [-1, 1].

    Attributes:
        states: shape of each state without the axis of the robots; the inputs are the observation and the states.
        outputs: the names of the action and of the next states; the next state of momentum is the action.
        start: what the states are at the start of an episode.

    """

    outputs: tuple[str, ...] = (OUTPUT,)
    start = "zeros"

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy: Any = policy
        self.states: dict[str, tuple[int, ...]] = {}

    def examples(self, observations: th.Tensor) -> dict[str, th.Tensor]:
        """Return random states for observations (N, d)."""
        rng = np.random.default_rng(1)
        shapes = {name: (len(observations), *size) for name, size in self.states.items()}
        return {name: th.as_tensor(rng.uniform(-1.0, 1.0, shape).astype(np.float32)) for name, shape in shapes.items()}

    def action(self, observation: th.Tensor) -> th.Tensor:
        """Return the clipped mean actions for the inputs of `mean_action`."""
        return mean_action(self.policy, observation).clamp(-1.0, 1.0)


class _PlainActor(_Actor):
    """The action of a policy without memory."""

    def forward(self, observation: th.Tensor) -> th.Tensor:
        return self.action(observation)


class _MomentumActor(_Actor):
    """The action of a policy with momentum."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__(policy)
        self.weights = th.tensor(self.policy.effort_weights)
        self.states = {"previous_action": (len(self.weights),)}

    def forward(self, observation: th.Tensor, previous: th.Tensor) -> th.Tensor:
        return add_momentum(self.action(observation), previous, self.weights)


class _StackedActor(_Actor):
    """The action of a policy with stacked observations, and the next history."""

    outputs = (OUTPUT, "next_history")
    start = "the first observation in every row"

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__(policy)
        self.states = {"history": (max(LAGS), self.policy.observation_space.shape[0])}

    def examples(self, observations: th.Tensor) -> dict[str, th.Tensor]:
        """Return histories of the same observations in another order."""
        return {"history": th.stack([observations.roll(k, dims=0) for k in range(1, max(LAGS) + 1)], dim=1)}

    def forward(self, observation: th.Tensor, history: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        current = observation[:, None]
        return self.action(stack_frames(current, history)), next_history(current, history)


def _actor(policy: BasePolicy) -> _Actor:
    """Return the module to export."""
    if getattr(policy, "effort_weights", None) is not None:
        return _MomentumActor(policy)
    return {"none": _PlainActor, "stack": _StackedActor}[memory_of(policy)](policy)


def export_onnx(
    policy: str | Path | BasePolicy | BaseAlgorithm,
    path: str | Path,
    environment: Mapping[str, Any] | None = None,
) -> Path:
    """Export the deterministic actor of a policy to an ONNX file, with a description of its observations beside it.

    The model has the input "observation" (N, d), float32, and the output "action" (N, 2) in [-1, 1]: speed and turn
    rate in units of the robot's limits. A policy with momentum has the second input "previous_action" (N, 2), the last
    action, zeros at the start of an episode. A policy with memory has inputs for its states, and outputs for the next
    ones: "history" (N, H, d), oldest first, or "hidden" and "cell" (N, h). The description, `FILE.json`, lists names,
    units, order and bounds of the entries of an observation, and the arguments of the environment. After the export,
    the actions are compared with those of torch.

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
    actor = _actor(policy_of(policy)).eval().to("cpu")
    settings = EnvironmentSettings(**(environment or {}))
    entries = observation_entries(settings)
    shape = actor.policy.observation_space.shape
    if shape != (len(entries),):
        raise ValueError(f"environment: has observations ({len(entries)},), the policy's are {shape}")
    low, high = (np.array([getattr(entry, side) for entry in entries], np.float32) for side in ("low", "high"))
    examples = np.random.default_rng(0).uniform(np.maximum(low, -10), np.minimum(high, 10), (N_CHECKED, len(entries)))
    observations = th.as_tensor(examples.astype(np.float32))
    inputs = {INPUT: observations, **actor.examples(observations)}
    _export(actor, inputs, path)
    with th.no_grad():
        found, expected = _run(path, inputs), actor(*inputs.values())
    expected = expected if isinstance(expected, tuple) else (expected,)
    difference = max(float(np.abs(a - b.numpy()).max()) for a, b in zip(found, expected, strict=True))
    if not difference <= TOLERANCE:
        path.unlink()
        raise ValueError(f"{path}: the exported policy has other actions, by {difference:.1e}; nothing was written")
    description = {
        "leapnav": leapnav.__version__,
        "input": {"name": INPUT, "shape": ["N", len(entries)], "type": "float32"},
        **_describe_states(actor),
        "output": {"name": OUTPUT, "shape": ["N", *actor.policy.action_space.shape], "type": "float32"},
        "observation": [{"index": k, **asdict(entry)} for k, entry in enumerate(entries)],
        "action": [{"index": k, **asdict(entry)} for k, entry in enumerate(ACTION)],
        "control_period": settings.control_period,
        "environment": asdict(settings),
        "largest_difference_from_torch": difference,
    }
    beside = path.with_suffix(".onnx.json")
    write_text(beside, encode(description, indent=1) + "\n")
    return beside


def _describe_states(actor: _Actor) -> dict[str, Any]:
    """Return the description of each state: shape, type, the output with its next value, and how it starts."""
    following = actor.outputs[1:] or actor.outputs[: len(actor.states)]
    return {
        name: {"shape": ["N", *size], "type": "float32", "next": output, "start": actor.start}
        for (name, size), output in zip(actor.states.items(), following, strict=True)
    }


def _export(actor: _Actor, inputs: Mapping[str, th.Tensor], path: Path) -> None:
    """Write the ONNX file. The exporter prints its progress and warnings of torch's own modules, which are hidden."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    batch = {0: th.export.Dim("batch")}
    try:
        with atomic_path(path) as partial, redirect_stdout(StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            th.onnx.export(
                actor,
                tuple(inputs.values()),
                str(partial),
                input_names=list(inputs),
                output_names=list(actor.outputs),
                dynamo=True,
                dynamic_shapes=(batch,) * len(inputs),
                external_data=False,
            )
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f'the export needs {error.name}: pip install "leapnav[onnx]"') from None


def _run(path: Path, inputs: Mapping[str, th.Tensor]) -> list[np.ndarray]:
    """Return the outputs of an ONNX file."""
    try:
        from onnxruntime import InferenceSession
    except ModuleNotFoundError:
        raise ModuleNotFoundError('the export needs onnxruntime: pip install "leapnav[onnx]"') from None
    session = InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return [np.asarray(output) for output in session.run(None, {name: x.numpy() for name, x in inputs.items()})]
