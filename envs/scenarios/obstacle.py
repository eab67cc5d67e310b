"""An obstacle of a scenario: one shape, given by its kind, at rest or moving."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import SerializationInfo, ValidationError, model_serializer, model_validator
from pydantic_core import InitErrorDetails

from leapnav.envs.field.packing import NO_KNOTS
from leapnav.envs.shapes import Circle, Polygon, Shape
from leapnav.envs.shapes.base import KINDS
from leapnav.envs.utils.records import Finite, Frozen, Point, Positive, inside

OPTIONS = "mass", "velocity", "path"
LONGEST = 1e4  # s, of a path with a constant velocity, in a scenario that begins later


class ObstaclePath(Frozen):
    """The positions of an obstacle over time, with straight lines between them.

    Attributes:
        times: at least two increasing times (s); negative ones are before the start of the episode. The obstacle stands
            at its first point before the first time, and at its last point after the last time.
        points: for each time the position (x, y) (m) of one point of the obstacle. The shape is given where the
            obstacle is at the first one, which is the centre of a circle.

    """

    times: tuple[Finite, ...]
    points: tuple[Point, ...]

    @model_validator(mode="after")
    def _check(self) -> ObstaclePath:
        if len(self.times) < 2 or any(b <= a for a, b in pairwise(self.times)):
            raise ValueError(f"times: expected at least two increasing numbers, got {self.times}")
        if len(self.points) != len(self.times):
            raise ValueError(f"points: expected {len(self.times)}, one for each time, got {len(self.points)}")
        return self


class Obstacle(Frozen):
    """An obstacle: exactly one shape, given by its kind; its mass if the robot can push it, or its motion.

    In Python `Obstacle(circle=Circle(...), mass=2.0)`, in the scenario file `{"circle": {...}, "mass": 2.0}`. The kinds
    are the registered shapes, see `leapnav.envs.Shape`.

    Attributes:
        shape: the shape.
        mass: mass (kg) of an obstacle that moves while a robot pushes it, with the friction of the ground; None: it
            does not move. The contact is a collision in both cases. Only an environment with
            `terminate_on_collision=False` simulates the motion; the expert, the reference costs and the geodesic
            distances treat the obstacle as fixed.
        velocity: constant velocity (x, y) (m/s); the shape is given where the obstacle is at time 0.
        path: positions over time.

    """

    shape: Shape
    mass: Positive | None = None
    velocity: Point | None = None
    path: ObstaclePath | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            mass: float | None = None,
            velocity: Point | None = None,
            path: ObstaclePath | None = None,
            **shape: Shape | None,
        ) -> None: ...

    @model_validator(mode="before")
    @classmethod
    def _read_shape(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        given = {kind: shape for kind, shape in fields.items() if shape is not None}
        options = {name: given.pop(name) for name in OPTIONS if name in given}
        if len(options) > 1:
            raise ValueError(f"an obstacle has only one of {' and '.join(map(repr, options))}")
        faults: list[InitErrorDetails] = [
            {"type": "extra_forbidden", "loc": (kind,), "input": value}
            for kind, value in given.items()
            if kind not in KINDS
        ]
        if not faults and len(given) != 1:
            kinds = [repr(kind) for kind in KINDS]
            raise ValueError(f"an obstacle is exactly one of {', '.join(kinds[:-1])} or {kinds[-1]}")
        if not faults:
            ((kind, value),) = given.items()
            try:
                return {"shape": KINDS[kind].model_validate(value), **options}
            except ValidationError as error:
                raise inside(kind, error) from None
        raise ValidationError.from_exception_data(cls.__name__, faults)

    @model_serializer
    def _serialize(self, info: SerializationInfo) -> dict[str, Any]:
        shape = {self.shape.kind: self.shape.model_dump(mode=info.mode, exclude_none=info.exclude_none)}
        options = {name: getattr(self, name) for name in OPTIONS if getattr(self, name) is not None}
        if self.path is not None:
            options["path"] = self.path.model_dump(mode=info.mode)
        return {**shape, **options}

    @model_validator(mode="after")
    def _check_path(self) -> Obstacle:
        if self.path is not None and isinstance(self.shape, Circle) and self.path.points[0] != self.shape.center:
            center, first = self.shape.center, self.path.points[0]
            raise ValueError(f"path.points[0]: expected the center {center} of the circle, got {first}")
        return self

    @property
    def knots(self) -> np.ndarray:
        """The knots (K, 5) of the path, see `leapnav.envs.field.layout.KNOT`; none if the obstacle does not move."""
        if self.velocity is not None:
            rows = np.array([[0.0, 0.0, 0.0, *self.velocity]])
        elif self.path is not None:
            times, points = np.array(self.path.times), np.array(self.path.points)
            rates = np.diff(points, axis=0) / np.diff(times)[:, None]
            rows = np.column_stack([times, points - points[0], np.vstack([rates, np.zeros(2)])])
        else:
            return NO_KNOTS
        return rows if rows[:, 3:].any() else NO_KNOTS

    def after(self, time: float) -> Obstacle:
        """Return the obstacle of an episode that begins at a time (s) of this one."""
        knots = self.knots
        if len(knots) == 0:
            return self
        path = self.path
        if path is None:
            x, y = self.shape.center if isinstance(self.shape, Circle) else (0.0, 0.0)
            vx, vy = knots[0, 3:].tolist()
            path = ObstaclePath(times=(0.0, LONGEST), points=((x, y), (x + vx * LONGEST, y + vy * LONGEST)))
        path = ObstaclePath(times=tuple(t - time for t in path.times), points=path.points)
        return self.model_copy(update={"velocity": None, "path": path})

    @property
    def circle(self) -> Circle | None:
        """The circle, or None if the shape is another one."""
        return self.shape if isinstance(self.shape, Circle) else None

    @property
    def polygon(self) -> Polygon | None:
        """The polygon, or None if the shape is another one."""
        return self.shape if isinstance(self.shape, Polygon) else None
