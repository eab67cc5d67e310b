"""The interface of an obstacle shape, and the registry of shapes by kind.

The kernels know discs, capsules and convex polygons. Any other shape is a union of these: a class with fields and the
method `parts`, without kernels. `register` adds a shape from outside the package.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, TypeVar

import numpy as np
from pydantic import model_validator

from leapnav.envs.utils.records import Frozen


class Shape(Frozen):
    """An obstacle shape: a union of discs, capsules and convex polygons.

    Attributes:
        kind: name of the shape, the key of the obstacle in a scenario file: `{"circle": {...}}`.

    """

    kind: ClassVar[str]

    @abstractmethod
    def parts(self) -> tuple[Part, ...]:
        """Return the discs, capsules and convex polygons (`Circle`, `Capsule`, `Polygon`) whose union is the shape.

        They may overlap. The clearance is that of the union. The proximity cost is the sum over the parts.
        """

    @model_validator(mode="after")
    def _check_parts(self) -> Shape:
        parts: object = self.parts()
        if not isinstance(parts, tuple) or not parts or not all(isinstance(part, Part) for part in parts):
            raise ValueError(f"{self.kind}: parts(): expected a tuple of Circle, Capsule and Polygon, got {parts!r}")
        return self


class Part(Shape):
    """A shape that the kernels know: the convex hull of its vertices, enlarged by a radius on all sides."""

    def parts(self) -> tuple[Part, ...]:
        """Return the shape itself."""
        return (self,)

    @abstractmethod
    def rounded_polygon(self) -> tuple[np.ndarray, float]:
        """Return vertices (K, 2) (m) and the radius (m). One vertex makes a disc, two vertices a capsule."""

    @abstractmethod
    def outline(self) -> np.ndarray:
        """Return points (K, 2) (m) on the boundary, in order, for drawing; within 1 % of the shape's size."""


KINDS: dict[str, type[Shape]] = {}
ShapeClass = TypeVar("ShapeClass", bound=type[Shape])


def register(shape: ShapeClass) -> ShapeClass:
    """Register an obstacle shape under its `kind`; usable as a class decorator.

    Processes that read its scenarios must import the file that defines it.

    Raises:
        ValueError: another class has this kind.
        TypeError: the shape has no kind, or does not define `parts`.

    """
    kind = getattr(shape, "kind", None)
    if not isinstance(kind, str) or not kind.isidentifier():
        raise TypeError(f"kind: expected a name for {shape.__qualname__}, got {kind!r}")
    if shape.parts is Shape.parts:
        raise TypeError(f"parts: expected a method of {shape.__qualname__} that returns the parts of {kind!r}")
    known = KINDS.get(kind)
    if known is not None and known.__qualname__ != shape.__qualname__:
        raise ValueError(f"kind: {kind!r} is taken by {known.__module__}.{known.__qualname__}")
    KINDS[kind] = shape
    return shape
