"""Symmetries of the navigation task, as transformations of observations and actions.

The cost does not depend on the sign of the controls. Hence a mirrored optimum is optimal in the mirrored scenario, if
the robot's model has this symmetry (`RobotModel.mirror`). An optimum with all headings rotated by 180 degrees is
optimal in the scenario with the start and goal headings rotated by 180 degrees, if the model has that symmetry
(`RobotModel.reversal`): the robot follows the same path with the opposite driving mode.
"""

from __future__ import annotations

from collections.abc import Callable

import torch as th

from leapnav.envs.robots import RobotModel, Symmetry, Unicycle
from leapnav.envs.simulation.observations import GOAL_ENTRIES

# Signs of the first entries of the observation (see the docstring of the environment) under each symmetry.
_MIRROR_SIGNS = th.tensor([1.0, -1, 1, -1, 1, 1, -1, 1, -1])
_TIME_REVERSE_SIGNS = th.tensor([-1.0, -1, 1, 1, 1, -1, -1, 1, 1])


def mirror(
    observations: th.Tensor,
    actions: th.Tensor,
    model: type[RobotModel] = Unicycle,
    n_goal: int = GOAL_ENTRIES,
    *,
    geodesic: bool = False,
) -> tuple[th.Tensor, th.Tensor]:
    """Exchange left and right.

    Args:
        observations (B, d): observations with lidar ranges.
        actions (B, m): actions.
        model: the robot's model.
        n_goal: number of entries of the observation's part `goal`.
        geodesic: whether the observations contain detours and the geodesic distance.

    Returns:
        The mirrored observations and actions.

    Raises:
        ValueError: the model has no mirror symmetry.

    """
    symmetry = _require(model, "mirror", model.mirror)

    def reflected(values: th.Tensor) -> th.Tensor:
        return th.cat([values[:, :1], values[:, 1:].flip(1)], dim=1)

    return _transformed(observations, actions, _MIRROR_SIGNS[:n_goal], symmetry, reflected, geodesic)


def time_reverse(
    observations: th.Tensor,
    actions: th.Tensor,
    model: type[RobotModel] = Unicycle,
    n_goal: int = GOAL_ENTRIES,
    *,
    geodesic: bool = False,
) -> tuple[th.Tensor, th.Tensor]:
    """Exchange forwards and backwards: rotate the robot and the goal heading by 180 degrees, and negate the speed.

    Args:
        observations (B, d): observations with an even number of lidar ranges.
        actions (B, m): actions.
        model: the robot's model.
        n_goal: number of entries of the observation's part `goal`.
        geodesic: whether the observations contain detours and the geodesic distance.

    Returns:
        The transformed observations and actions.

    Raises:
        ValueError: the number of lidar beams is odd, or the model has no such symmetry.

    """
    symmetry = _require(model, "reversal", model.reversal)

    def rotated(values: th.Tensor) -> th.Tensor:
        if values.shape[1] % 2:
            raise ValueError(f"time reversal needs an even number of lidar beams, got {values.shape[1]}")
        return values.roll(values.shape[1] // 2, dims=1)

    return _transformed(observations, actions, _TIME_REVERSE_SIGNS[:n_goal], symmetry, rotated, geodesic)


def _require(model: type[RobotModel], name: str, symmetry: Symmetry | None) -> Symmetry:
    if symmetry is None:
        raise ValueError(f"{name}: the robot {model.name()!r} does not have this symmetry")
    return symmetry


def _transformed(
    observations: th.Tensor,
    actions: th.Tensor,
    signs: th.Tensor,
    symmetry: Symmetry,
    moved: Callable[[th.Tensor], th.Tensor],
    geodesic: bool,
) -> tuple[th.Tensor, th.Tensor]:
    """Return observations with other signs of the first entries and moved values of the beams, and the actions."""
    device = observations.device
    signs = th.cat([signs, th.tensor(symmetry.motion, dtype=signs.dtype)]).to(device)
    matrix = th.tensor(symmetry.controls, dtype=actions.dtype, device=device)
    beams = observations[:, len(signs) :]
    if geodesic:
        count = beams.shape[1] // 2
        parts = [moved(beams[:, :count]), moved(beams[:, count:-1]), beams[:, -1:]]
    else:
        parts = [moved(beams)]
    return th.cat([observations[:, : len(signs)] * signs, *parts], dim=1), actions @ matrix.T
