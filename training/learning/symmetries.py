"""Symmetries of the navigation task, as transformations of observations and actions.

The cost does not depend on the sign of the controls. Hence a mirrored optimum is optimal in the mirrored scenario, if
the robot's model has this symmetry (`RobotModel.mirror`). An optimum with all headings rotated by 180 degrees is
optimal in the scenario with the start and goal headings rotated by 180 degrees, if the model has that symmetry
(`RobotModel.reversal`): the robot follows the same path with the opposite driving mode.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch as th

from leapnav.envs.robots import Symmetry
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import ObservationLayout

# Signs of the first entries of the observation (see the docstring of the environment) under each symmetry.
_MIRROR_SIGNS = th.tensor([1.0, -1, 1, -1, 1, 1, -1, 1, -1])
_TIME_REVERSE_SIGNS = th.tensor([-1.0, -1, 1, 1, 1, -1, -1, 1, 1])


def mirror(
    observations: th.Tensor, actions: th.Tensor, settings: EnvironmentSettings | None = None
) -> tuple[th.Tensor, th.Tensor]:
    """Exchange left and right.

    Args:
        observations (B, d): observations with lidar ranges.
        actions (B, m): actions.
        settings: settings of the environment of the observations; None for its defaults.

    Returns:
        The mirrored observations and actions.

    Raises:
        ValueError: the model has no mirror symmetry.

    """
    settings = settings or EnvironmentSettings()
    symmetry = _require(settings, "mirror", settings.model.mirror)

    def reflected(values: th.Tensor) -> th.Tensor:
        if not settings.has_full_circle:
            return values.flip(1)
        return th.cat([values[:, :1], values[:, 1:].flip(1)], dim=1)

    return _transformed(observations, actions, settings, _MIRROR_SIGNS, symmetry, reflected)


def time_reverse(
    observations: th.Tensor, actions: th.Tensor, settings: EnvironmentSettings | None = None
) -> tuple[th.Tensor, th.Tensor]:
    """Exchange forwards and backwards: rotate the robot and the goal heading by 180 degrees, and negate the speed.

    Args:
        observations (B, d): observations with an even number of lidar ranges.
        actions (B, m): actions.
        settings: settings of the environment of the observations; None for its defaults.

    Returns:
        The transformed observations and actions.

    Raises:
        ValueError: the number of lidar beams is odd, their field of view is not the full circle, or the model has no
            such symmetry.

    """
    settings = settings or EnvironmentSettings()
    symmetry = _require(settings, "reversal", settings.model.reversal)
    if settings.has_lidar and not settings.has_full_circle:
        raise ValueError(f"time reversal needs a lidar_fov of 2 pi rad, got {settings.lidar_fov:g}")

    def rotated(values: th.Tensor) -> th.Tensor:
        if values.shape[1] % 2:
            raise ValueError(f"time reversal needs an even number of lidar beams, got {values.shape[1]}")
        return values.roll(values.shape[1] // 2, dims=1)

    return _transformed(observations, actions, settings, _TIME_REVERSE_SIGNS, symmetry, rotated)


@cache
def _layout(settings: EnvironmentSettings) -> ObservationLayout:
    """Return the layout of observations; it is needed for each batch of samples."""
    return ObservationLayout(settings)


def _require(settings: EnvironmentSettings, name: str, symmetry: Symmetry | None) -> Symmetry:
    if symmetry is None:
        raise ValueError(f"{name}: the robot {settings.robot!r} does not have this symmetry")
    return symmetry


def _transformed(
    observations: th.Tensor,
    actions: th.Tensor,
    settings: EnvironmentSettings,
    signs: th.Tensor,
    symmetry: Symmetry,
    moved: Callable[[th.Tensor], th.Tensor],
) -> tuple[th.Tensor, th.Tensor]:
    """Return observations with other signs of goal and motion and moved values of the beams, and the actions."""

    def velocities(values: th.Tensor) -> th.Tensor:
        ahead, left = (moved(half) for half in values.chunk(2, dim=1))  # the velocity of what each beam meets
        return th.cat([float(signs[0]) * ahead, float(signs[1]) * left], dim=1)

    matrix = th.tensor(symmetry.controls, dtype=actions.dtype, device=actions.device)
    changes: dict[str, Callable[[th.Tensor], th.Tensor]] = {
        "goal": lambda values: values * signs[: values.shape[1]].to(values),
        "motion": lambda values: values * th.tensor(symmetry.motion).to(values),
        "action": lambda values: values @ matrix.T.to(values),
        "lidar": moved,
        "detours": moved,
        "distance": lambda values: values,
        "velocities": velocities,
    }
    layout = _layout(settings)
    frames = observations.reshape(-1, layout.frame)  # those of the history are transformed like the current one
    changed = th.cat([changes[name](frames[:, part]) for name, part in layout.parts.items()], dim=1)
    return changed.reshape(observations.shape), actions @ matrix.T
