"""The interface of an obstacle shape, and the registry of shapes by kind.

A shape is one file: its fields, its signed distance, a smooth distance with derivatives for the proximity cost (two
kernels), and its outline. `register` adds a shape from outside the package.
"""

from __future__ import annotations

import sys
import zlib
from abc import abstractmethod
from typing import Any, ClassVar, TypeVar

import numpy as np
from numba import float64, types

from leapnav.envs.kernels import prepare
from leapnav.envs.kernels.numba_internals import FunctionTable, Kernel
from leapnav.envs.kernels.types import CONSTANT
from leapnav.envs.utils.records import Frozen

# distance(x, y, values) -> Euclidean distance (m) from the point (x, y) (m), negative inside.
DISTANCE_SIGNATURE = float64(float64, float64, CONSTANT)
# smooth_distance(x, y, scale, values) -> (d, d_x, d_y, d_xx, d_xy, d_yy), with the proximity scale (m).
SMOOTH_DISTANCE_SIGNATURE = types.UniTuple(float64, 6)(float64, float64, float64, CONSTANT)
N_NUMBERS = 4093  # numbers of kinds; a prime


class Shape(Frozen):
    """An obstacle shape: the base class of all shapes.

    The kernels receive the numbers of `values` as an array, not the object. Scenarios that are blended (continuation)
    blend these numbers.

    Attributes:
        kind: name of the shape, the key of the obstacle in a scenario file: `{"circle": {...}}`.
        distance: kernel of DISTANCE_SIGNATURE, the Euclidean distance. Clearance, contacts and lidar use it.
        smooth_distance: kernel of SMOOTH_DISTANCE_SIGNATURE, a twice continuously differentiable approximation of the
            distance (m), with gradient and Hessian. It may deviate from the distance, by the order of the scale near
            corners, and more inside. The proximity cost is weight * exp(-(d - robot radius) / scale).
        is_lipschitz: whether `distance` is the Euclidean distance everywhere, inside as well, and the gradient of
            `smooth_distance` never exceeds 1. Proofs of lower bounds need both.

    """

    kind: ClassVar[str]
    distance: ClassVar[Any]
    smooth_distance: ClassVar[Any]
    is_lipschitz: ClassVar[bool] = False

    @abstractmethod
    def values(self) -> tuple[float, ...]:
        """Return the numbers that the kernels receive."""

    @abstractmethod
    def outline(self) -> np.ndarray:
        """Return points (K, 2) (m) on the boundary, in order, for drawing.

        The polygon through them deviates from the shape by at most 1 % of the shape's size. For contacts, it must be
        star-shaped about `centre`.
        """

    def centre(self) -> tuple[float, float]:
        """Return a point (x, y) (m) inside; by default the centre of the bounding box.

        A path passes the obstacle on the left or right of this point.
        """
        x_min, y_min, x_max, y_max = self.bounds()
        return (x_min + x_max) / 2, (y_min + y_max) / 2

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the bounding box (x_min, y_min, x_max, y_max) (m) of the outline."""
        points = self.outline()
        (x_min, y_min), (x_max, y_max) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return x_min, y_min, x_max, y_max

    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return vertices (K, 2) and a radius (m): the shape as a polygon, enlarged by the radius on all sides.

        Contacts and `observation="map"` use it. By default it is the outline with radius 0. One vertex makes a disc,
        two vertices a thick segment.
        """
        return self.outline(), 0.0


KINDS: dict[str, type[Shape]] = {}
ShapeClass = TypeVar("ShapeClass", bound=type[Shape])


def kind_number(kind: str) -> int:
    """Return the number (>= 1) of a kind in packed fields. It depends on the name only."""
    return zlib.crc32(kind.encode()) % N_NUMBERS + 1


def register(shape: ShapeClass) -> ShapeClass:
    """Register an obstacle shape under its `kind`; usable as a class decorator.

    Processes that read its scenarios must import the file that defines it.

    Raises:
        ValueError: another class has this kind or the number that follows from it.
        TypeError: the shape has no kind, or `distance` or `smooth_distance` is not a kernel of its signature.

    """
    kind = getattr(shape, "kind", None)
    if not isinstance(kind, str) or not kind.isidentifier():
        raise TypeError(f"kind: expected a name for {shape.__qualname__}, got {kind!r}")
    for name, signature in (("distance", DISTANCE_SIGNATURE), ("smooth_distance", SMOOTH_DISTANCE_SIGNATURE)):
        found = getattr(shape, name, None)
        if not isinstance(found, Kernel) or found.declared_signature != signature:
            raise TypeError(f"{name}: expected a kernel of {name.upper()}_SIGNATURE for {kind!r}, got {found!r}")
    number = kind_number(kind)
    known = next((known for known in KINDS.values() if kind_number(known.kind) == number), None)
    if known is not None and known.__qualname__ != shape.__qualname__:
        raise ValueError(f"kind: {kind!r} is taken by {known.__module__}.{known.__qualname__} ({known.kind!r})")
    KINDS[kind] = shape
    for index in (2 * number, 2 * number + 1):
        FUNCTIONS.clear(index)
    return shape


def shape_class(number: int) -> type[Shape]:
    """Return the shape whose kind has a number.

    Raises:
        ValueError: there is no such shape in this process.

    """
    found = next((shape for shape in KINDS.values() if kind_number(shape.kind) == number), None)
    if found is None:
        raise ValueError(
            f"obstacles: a shape that is not registered in this process; registered are {', '.join(KINDS)}. "
            "Import the file that defines it"
        )
    return found


def _find(index: int) -> Kernel | None:
    """Return the kernel of an entry of FUNCTIONS, or None if its shape is not registered in this process."""
    try:
        shape = shape_class(index // 2)
    except ValueError as error:
        print(f"leapnav: {error}", file=sys.stderr)
        return None
    return shape.smooth_distance if index % 2 else shape.distance


def compile_shape(shape: type[Shape]) -> None:
    """Compile the kernels of a shape, which other kernels call by number."""
    prepare(shape.distance, shape.smooth_distance)


# distance and smooth_distance of each kind, at 2 number and 2 number + 1.
FUNCTIONS = FunctionTable("shapes", 2 * (N_NUMBERS + 1), _find)
call_distance = FUNCTIONS.caller(DISTANCE_SIGNATURE)
call_smooth_distance = FUNCTIONS.caller(SMOOTH_DISTANCE_SIGNATURE)
