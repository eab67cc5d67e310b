"""Footprints of box-shaped robots as discs along the robot's axis."""

from __future__ import annotations

import math

from leapnav.envs.robots.base import Disc
from leapnav.envs.utils.validation import check_at_least, check_positive


def box_footprint(
    front: float, rear: float, width: float, count: int = 4, *, rounded: bool = False
) -> tuple[Disc, ...]:
    """Return discs along the axis of a robot whose outline is a rectangle.

    Discs that cover the corners protrude: with `count` discs, by half the difference of their diameter and the width at
    the sides, and by more at the ends. Rounded discs have the width of the rectangle and end where it ends, so that its
    corners are left out, and between the discs a narrow part of its sides.

    Args:
        front, rear: distances (m) from (x, y) to the front and to the rear end.
        width: width (m).
        count: number of discs.
        rounded: whether to leave out the corners instead of covering them.

    Raises:
        ValueError: an argument is not positive; with `rounded`, the rectangle is not longer than wide, or the discs do
            not overlap.

    """
    for name, value in (("front", front), ("rear", rear), ("width", width)):
        check_positive(name, value)
    check_at_least("count", count, 1)
    length = front + rear
    if not rounded:
        part = length / count
        radius = math.hypot(part / 2, width / 2)
        return tuple(Disc(offset=-rear + part * (k + 0.5), radius=radius) for k in range(count))
    if length <= width:
        raise ValueError(f"width: expected less than the length {length:g} of a rounded footprint, got {width:g}")
    needed = math.ceil((length - width) / width - 1e-9) + 1
    if count < needed:
        raise ValueError(f"count: expected at least {needed} discs that overlap, got {count}")
    step = (length - width) / (count - 1)
    return tuple(Disc(offset=-rear + width / 2 + step * k, radius=width / 2) for k in range(count))
