"""Symmetries of the task, applied to observations and actions: each turns a demonstration into another one.

The robot is a disc, so the optimum of a mirrored task is the mirrored optimum, and a robot turned round by 180 degrees
(goal heading included) drives the same path in the other gear.
"""

from __future__ import annotations

import torch as th

from leapnav.envs.observations import GOAL_ENTRIES

# Signs of the observation's first entries (see the environment's docstring) under each symmetry.
_MIRROR = th.tensor([1.0, -1, 1, -1, 1, 1, -1, 1, -1])
_TURN = th.tensor([-1.0, -1, 1, 1, 1, -1, -1, 1, 1])


def mirror(observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Left and right exchanged: observations (B, d), actions (B, 2)."""
    ranges = observations[:, GOAL_ENTRIES:]
    ranges = th.cat([ranges[:, :1], ranges[:, 1:].flip(1)], dim=1)
    return th.cat([observations[:, :GOAL_ENTRIES] * _MIRROR.to(ranges.device), ranges], dim=1), actions * th.tensor(
        [1.0, -1.0], device=actions.device
    )


def turn_round(observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Front and back exchanged; the number of lidar beams must be even."""
    ranges = observations[:, GOAL_ENTRIES:]
    if ranges.shape[1] % 2:
        raise ValueError(f"turning round needs an even number of lidar beams, got {ranges.shape[1]}")
    ranges = ranges.roll(ranges.shape[1] // 2, dims=1)
    return th.cat([observations[:, :GOAL_ENTRIES] * _TURN.to(ranges.device), ranges], dim=1), actions * th.tensor(
        [-1.0, 1.0], device=actions.device
    )
