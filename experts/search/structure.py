"""The pieces of a path: straight lines, turns, and contact with obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.kernels.types import constant
from leapnav.experts.problem.extremal import Extremal

Kind = Literal["straight", "turn", "contact"]

POINTS = 2001  # at which a path is examined
MIN_PIECE = 0.01  # fraction of the duration; shorter pieces are transitions
MIN_TURN_RATE = 0.1  # relative to the largest turn rate; slower turns are straight lines
# Barrier in units of the mean running cost above which an obstacle is touched. Close to the limit the integral of the
# barrier is at most 1e-3 of the cost, and far from obstacles it is smaller by orders of magnitude.
MIN_BARRIER = 1e-3
WALL = "wall"  # the name of the walls of the arena


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a path.

    Attributes:
        kind: "straight", "turn" (also in place) or "contact" with an obstacle.
        duration: s; NaN if the path has no times.
        length: length (m) of the path of the robot's position, driven in either direction.
        turn: change of the heading (rad), positive counter-clockwise.
        obstacle: of a contact, the obstacle ("obstacles[2]", or "wall"); otherwise None.
        points: positions (K, 2) (m) along it.

    """

    kind: Kind
    duration: float
    length: float
    turn: float
    obstacle: str | None
    points: np.ndarray


def obstacle_name(index: int) -> str:
    """Return the name of an obstacle in messages and tables; a negative index is a wall."""
    return WALL if index < 0 else f"obstacles[{index}]"


def format_pieces(pieces: Sequence[Piece]) -> str:
    """Return a table of pieces as text, one line for each."""
    lines = [f"{'piece':<10}{'time (s)':>10}{'length (m)':>12}{'turn (deg)':>12}  obstacle"]
    for piece in pieces:
        duration = "" if math.isnan(piece.duration) else f"{piece.duration:.3f}"
        columns = f"{piece.kind:<10}{duration:>10}{piece.length:>12.3f}{math.degrees(piece.turn):>12.1f}"
        lines.append(f"{columns}  {piece.obstacle or ''}".rstrip())
    return "\n".join(lines)


def pieces_of(extremal: Extremal) -> tuple[Piece, ...]:
    """Return the pieces of an extremal, in their order; none if its system has no position and heading.

    The turn rate is compared with the largest one, and the barrier of hard obstacles with the running cost. Pieces
    shorter than 1 % of the duration belong to their neighbours.
    """
    system, problem = extremal.problem.system, extremal.problem
    if system.position is None or system.heading is None or len(extremal.times) == 0:
        return ()
    times = np.linspace(0.0, extremal.horizon, POINTS)
    states = np.ascontiguousarray(extremal.evaluate(times)[0])
    poses = states[:, [system.state.index(symbol) for symbol in (*system.position, system.heading)]]
    rates = np.gradient(poses[:, 2], times)
    largest = np.abs(rates).max()
    labels = np.where(np.abs(rates) > MIN_TURN_RATE * largest, np.sign(rates), 0.0).astype(int)
    if largest * extremal.horizon < 1e-6:
        labels[:] = 0
    touched = np.full(POINTS, -2)
    if problem.field is not None and problem.barrier_weight > 0.0:
        is_close = problem.barrier_cost(states) > MIN_BARRIER * extremal.cost / extremal.horizon
        has_joints = problem.outline[:, 4].any()  # only the outline of a robot model has them
        rows = states if has_joints else np.ascontiguousarray(poses)
        for k in np.flatnonzero(is_close):
            touched[k] = footprint_clearance(constant(rows[k]), problem.outline, problem.field)[1]
    labels = np.where(touched > -2, touched + 10, labels)
    return tuple(
        _piece(poses[first : last + 1], float(times[last] - times[first]), int(labels[(first + last) // 2]))
        for first, last in _runs(labels)
    )


def _piece(poses: np.ndarray, duration: float, label: int) -> Piece:
    """Return the piece of a label: 0 straight, -1 and 1 a turn, and at least 9 the number of an obstacle plus 10."""
    kind: Kind = "straight" if label == 0 else "contact" if label >= 9 else "turn"
    length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    obstacle = obstacle_name(label - 10) if kind == "contact" else None
    return Piece(kind, duration, length, float(poses[-1, 2] - poses[0, 2]), obstacle, poses[:, :2].copy())


def _runs(labels: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last points of the runs of equal labels; short runs belong to the longer neighbour."""
    labels = labels.copy()
    while True:
        first = np.append(0, np.flatnonzero(np.diff(labels)) + 1)
        last = np.append(first[1:], len(labels)) - 1
        sizes = last - first + 1
        shortest = int(sizes.argmin())
        if len(sizes) == 1 or sizes[shortest] >= MIN_PIECE * len(labels):
            # Pieces share their ends.
            return [(int(a), min(int(b) + 1, len(labels) - 1)) for a, b in zip(first, last, strict=True)]
        neighbours = [k for k in (shortest - 1, shortest + 1) if 0 <= k < len(sizes)]
        longer = max(neighbours, key=lambda k: int(sizes[k]))
        labels[first[shortest] : last[shortest] + 1] = labels[first[longer]]
