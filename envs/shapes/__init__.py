"""Obstacle shapes, one file each, see `leapnav.envs.shapes.base`, and the packed field of a scenario (kernels)."""

from leapnav.envs.shapes.base import Part, Shape, register
from leapnav.envs.shapes.capsule import Capsule
from leapnav.envs.shapes.circle import Circle
from leapnav.envs.shapes.polygon import Polygon

__all__ = ["Capsule", "Circle", "Part", "Polygon", "Shape", "register"]
