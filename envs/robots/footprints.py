"""Footprints: the outlines of robots that are not one disc around their reference point."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, WrapValidator, model_serializer

from leapnav.envs.kernels.types import constant
from leapnav.envs.utils.records import Finite, Frozen, Positive, as_tuples, inside


class Disc(Frozen):
    """A disc of a footprint: offset of its centre along the robot's axis, positive ahead, and radius (m)."""

    offset: Finite = 0.0
    radius: Positive


class Box(Frozen):
    """A rectangular footprint: length along the robot's axis, width, and offset of its centre, positive ahead (m).

    In Python `Unicycle(footprint=Box(length=0.5, width=0.25))`, in the scenario file
    `"footprint": {"box": {"length": 0.5, "width": 0.25}}`.
    """

    length: Positive
    width: Positive
    offset: Finite = 0.0

    @model_serializer(mode="wrap")
    def _serialize(self, handler: Any) -> dict[str, Any]:
        return {"box": handler(self)}


DISCS = TypeAdapter(Annotated[tuple[Disc, ...], Field(min_length=1)])


def _read(value: Any, _: Any) -> tuple[Disc, ...] | Box:
    """Return a footprint from its form in a scenario file; the locations of faults are without names of union types."""
    if isinstance(value, Box):
        return value
    if not isinstance(value, Mapping):
        return DISCS.validate_python(as_tuples(value))
    if set(value) != {"box"}:
        raise ValueError('expected discs or {"box": {"length": ..., "width": ...}}')
    try:
        return Box.model_validate(value["box"])
    except ValidationError as error:
        raise inside("box", error) from None


Footprint = Annotated[tuple[Disc, ...] | Box, WrapValidator(_read)]


def outline_of(footprint: Sequence[Disc] | Box, ahead: float = 0.0, joint: int = 0) -> np.ndarray:
    """Return an outline (K, 5): rear, front, half width, radius (m) and joint of discs and rectangles, read-only.

    A row is the rectangle from `rear` to `front` along an axis through (x, y), enlarged by the radius; of a disc, the
    rectangle is its centre, and of a `Box` the radius is 0. The axis has the robot's heading plus the state whose index
    is the joint, such as the hitch angle of a trailer, or the robot's heading if the joint is 0.

    Args:
        footprint: discs or a rectangle.
        ahead: distance (m) of its reference point ahead of (x, y) along the axis.
        joint: see above.

    """
    if isinstance(footprint, Box):
        middle, half = ahead + footprint.offset, footprint.length / 2
        rows = [(middle - half, middle + half, footprint.width / 2, 0.0, joint)]
    else:
        rows = [(ahead + disc.offset, ahead + disc.offset, 0.0, disc.radius, joint) for disc in footprint]
    return constant(rows)


def sizes_of(outline: np.ndarray) -> tuple[float, float]:
    """Return radius and extent (m) of an outline, see `leapnav.envs.field.layout.HEADER`."""
    rear, front, half_width, radius = outline.T[:4]
    return float((half_width + radius).max()), float((np.hypot((front - rear) / 2, half_width) + radius).max())


def arm_of(outline: np.ndarray) -> float:
    """Return the largest distance (m) from the reference point of a point by which the robot may touch an obstacle.

    These are the centres of discs, whose radius is constant, and the corners of rectangles.
    """
    return float(np.hypot(np.abs(outline[:, :2]).max(axis=1), outline[:, 2]).max())


def enclosed_radius(outline: np.ndarray) -> float:
    """Return the radius (m) of the largest disc around the reference point in an outline; negative outside of it."""
    rear, front, half_width, radius = outline[outline[:, 4] == 0].T[:4]
    return float((np.minimum(half_width, np.minimum(front, -rear)) + radius).max())


def axis_of(row: Sequence[float], state: Sequence[float]) -> float:
    """Return the angle (rad) of the axis of a row of an outline at a state of the robot."""
    return state[2] + (state[int(row[4])] if row[4] else 0.0)


def corners_of(row: Sequence[float], state: Sequence[float]) -> np.ndarray:
    """Return the corners (4, 2) (m) of a rectangle of an outline at a state, counter-clockwise."""
    rear, front, half_width = row[:3]
    x, y, heading = *state[:2], axis_of(row, state)
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = np.array([rear, front, front, rear])
    left = np.array([-half_width, -half_width, half_width, half_width])
    return np.column_stack([x + ahead * cos - left * sin, y + ahead * sin + left * cos])
