"""What tells the local optima of a scenario apart: sides of the obstacles, driving modes, windings of the heading."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from leapnav.envs.fields import obstacle_centres

Side = Literal["left", "right"]
Mode = Literal["forward", "backward"]

# Shorter stretches (m) in one gear are not counted.
SHORTEST_STRETCH = 0.02


def path_sides(positions: np.ndarray, field: np.ndarray) -> tuple[Side, ...]:
    """On which side of the path each obstacle lies, in the scenario's order.

    The angle that the path sweeps as seen from the obstacle's middle is positive if the obstacle lies to its left.
    Between the same ends it differs by multiples of 2 pi from path to path, so paths with the same sides can be pulled
    into each other, short of loops around an obstacle.

    Args:
        positions: (N, 2), dense.
        field: packed obstacles (`Scenario.field`).

    """
    away = positions[:, None] - obstacle_centres(field)
    bearing = np.unwrap(np.arctan2(away[..., 1], away[..., 0]), axis=0)
    return tuple("left" if swept > 0 else "right" for swept in bearing[-1] - bearing[0])


def driving_modes(times: np.ndarray, speeds: np.ndarray) -> tuple[Mode, ...]:
    """Forwards and backwards in turn, stretches of a few centimetres left out; empty for a turn on the spot.

    Args:
        times: (N,).
        speeds: (N,), signed.

    """
    ways = np.diff(times) * (speeds[1:] + speeds[:-1]) / 2
    modes: list[Mode] = []
    stretch = 0.0
    for way in ways:
        stretch = way if stretch * way < 0 else stretch + way
        mode: Mode = "forward" if stretch > 0 else "backward"
        if abs(stretch) >= SHORTEST_STRETCH and modes[-1:] != [mode]:
            modes.append(mode)
    return tuple(modes)


def heading_winding(headings: np.ndarray) -> int:
    """Full turns of the heading beyond the smaller angle between its two ends; positive: counter-clockwise."""
    turn = float(headings[-1] - headings[0])
    return round((turn - math.remainder(turn, 2 * math.pi)) / (2 * math.pi))
