"""Comparison of paths: duplicates, sides of the obstacles, driving modes and winding of the heading."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from leapnav.envs.field.packing import obstacle_centres
from leapnav.experts.numerics.interpolation import interpolate
from leapnav.experts.transcription.descent import KnownPaths

Side = Literal["left", "right"]
Mode = Literal["forward", "backward"]

MIN_MODE_DISTANCE = 0.02  # m; shorter sections in one driving mode are ignored
COMPARED_FRACTIONS = np.linspace(0.0, 1.0, 65)  # of the horizon, at which paths are compared


def shape_of(times: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the poses (65, 3) of a path at fixed fractions of the horizon, to compare it with others."""
    return interpolate(COMPARED_FRACTIONS * times[-1], times, np.ascontiguousarray(states[:, :3]))


class SeenPaths:
    """Paths that were found, each given by its `shape_of`, to recognise duplicates.

    Args:
        distance: distance (m, and rad for the heading) within which two paths are duplicates.

    Attributes:
        known: the paths as an argument of `optimise`.

    """

    def __init__(self, distance: float) -> None:
        self.known = KnownPaths(np.empty((0, len(COMPARED_FRACTIONS), 3)), distance)

    def add(self, *shapes: np.ndarray) -> None:
        """Add paths."""
        self.known = self.known._replace(points=np.concatenate([self.known.points, shapes]))

    def contain(self, shape: np.ndarray) -> bool:
        """Return whether a path is a duplicate of one of them."""
        return bool((np.abs(self.known.points - shape).max(axis=(1, 2)) < self.known.distance).any())

    def are_close(self, shape: np.ndarray, other: np.ndarray) -> bool:
        """Return whether two paths are duplicates of each other."""
        return bool(np.abs(shape - other).max() < self.known.distance)


def path_sides(times: np.ndarray, positions: np.ndarray, field: np.ndarray) -> tuple[Side, ...]:
    """Return the side of a path on which each obstacle lies, in the order of the scenario.

    The bearing of the path from the centre of an obstacle changes by a positive angle if the obstacle lies to the left.
    For paths with the same ends this angle differs by multiples of 2 pi, so paths with the same sides are homotopic
    unless one of them encircles an obstacle. The bearing from a moving obstacle is that from where it is at the time:
    a path that passes in front of it has it on one side, and a path that passes behind it on the other.

    Args:
        times: (N,) (s).
        positions: x, y (m) of a densely sampled path, (N, 2).
        field: packed obstacles (`Scenario.field`).

    """
    offsets = positions[:, None] - obstacle_centres(field, times)
    bearing = np.unwrap(np.arctan2(offsets[..., 1], offsets[..., 0]), axis=0)
    return tuple("left" if swept > 0 else "right" for swept in bearing[-1] - bearing[0])


def driving_modes(times: np.ndarray, speeds: np.ndarray) -> tuple[Mode, ...]:
    """Return the sequence of driving modes of a path, without sections of a few centimetres.

    It is empty if the robot only rotates in place.

    Args:
        times: s, (N,).
        speeds: signed speed (m/s), (N,).

    """
    steps = np.diff(times) * (speeds[1:] + speeds[:-1]) / 2
    modes: list[Mode] = []
    distance = 0.0  # signed, since the last change of direction
    for step in steps:
        distance = step if distance * step < 0 else distance + step
        mode: Mode = "forward" if distance > 0 else "backward"
        if abs(distance) >= MIN_MODE_DISTANCE and modes[-1:] != [mode]:
            modes.append(mode)
    return tuple(modes)


def heading_winding(headings: np.ndarray) -> int:
    """Return the full turns of the heading beyond the smaller angle between its ends; positive: counter-clockwise."""
    turn = float(headings[-1] - headings[0])
    return round((turn - math.remainder(turn, 2 * math.pi)) / (2 * math.pi))
