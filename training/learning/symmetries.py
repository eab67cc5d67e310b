"""Symmetries of the navigation task, as transformations of observations and actions.

The robot is a disc, and the cost does not depend on the sign of the controls. Hence a mirrored optimum is optimal in
the mirrored scenario. An optimum with all headings rotated by 180 degrees is optimal in the scenario with the start and
goal headings rotated by 180 degrees: the robot follows the same path with the opposite driving mode.
"""

from __future__ import annotations

import torch as th

from leapnav.envs.simulation.observations import GOAL_ENTRIES

# Signs of the first entries of the observation (see the docstring of the environment) under each symmetry.
_MIRROR_SIGNS = th.tensor([1.0, -1, 1, -1, 1, 1, -1, 1, -1])
_TIME_REVERSE_SIGNS = th.tensor([-1.0, -1, 1, 1, 1, -1, -1, 1, 1])


def mirror(observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Exchange left and right.

    Args:
        observations (B, d): observations with lidar ranges.
        actions (B, 2): actions.

    Returns:
        The mirrored observations and actions.

    """
    ranges = observations[:, GOAL_ENTRIES:]
    ranges = th.cat([ranges[:, :1], ranges[:, 1:].flip(1)], dim=1)
    return _transformed(observations, _MIRROR_SIGNS, ranges), actions * th.tensor([1.0, -1.0], device=actions.device)


def time_reverse(observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Exchange forwards and backwards: rotate the robot and the goal heading by 180 degrees, and negate the speed.

    Args:
        observations (B, d): observations with an even number of lidar ranges.
        actions (B, 2): actions.

    Returns:
        The transformed observations and actions.

    Raises:
        ValueError: the number of lidar beams is odd.

    """
    ranges = observations[:, GOAL_ENTRIES:]
    if ranges.shape[1] % 2:
        raise ValueError(f"time reversal needs an even number of lidar beams, got {ranges.shape[1]}")
    ranges = ranges.roll(ranges.shape[1] // 2, dims=1)
    signs = th.tensor([-1.0, 1.0], device=actions.device)
    return _transformed(observations, _TIME_REVERSE_SIGNS, ranges), actions * signs


def _transformed(observations: th.Tensor, signs: th.Tensor, ranges: th.Tensor) -> th.Tensor:
    """Return the observations with other signs of the first entries and other lidar ranges."""
    return th.cat([observations[:, :GOAL_ENTRIES] * signs.to(ranges.device), ranges], dim=1)
