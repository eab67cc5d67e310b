"""An obstacle of a scenario: one shape, given by its kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import SerializationInfo, ValidationError, model_serializer, model_validator
from pydantic_core import InitErrorDetails

from leapnav.envs.shapes import Circle, Polygon, Shape
from leapnav.envs.shapes.base import KINDS
from leapnav.envs.utils.records import Frozen, Positive, inside


class Obstacle(Frozen):
    """An obstacle: exactly one shape, given by its kind, and its mass if the robot can push it.

    In Python `Obstacle(circle=Circle(...), mass=2.0)`, in the scenario file `{"circle": {...}, "mass": 2.0}`. The kinds
    are the registered shapes, see `leapnav.envs.Shape`.

    Attributes:
        shape: the shape.
        mass: mass (kg) of an obstacle that moves while a robot pushes it, with the friction of the ground; None: it
            does not move. The contact is a collision in both cases. Only an environment with
            `terminate_on_collision=False` simulates the motion; the expert, the reference costs and the geodesic
            distances treat the obstacle as fixed.

    """

    shape: Shape
    mass: Positive | None = None

    if TYPE_CHECKING:

        def __init__(self, *, mass: float | None = None, **shape: Shape | None) -> None: ...

    @model_validator(mode="before")
    @classmethod
    def _read_shape(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        given = {kind: shape for kind, shape in fields.items() if shape is not None}
        mass = given.pop("mass", None)
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
                return {"shape": KINDS[kind].model_validate(value), "mass": mass}
            except ValidationError as error:
                raise inside(kind, error) from None
        raise ValidationError.from_exception_data(cls.__name__, faults)

    @model_serializer
    def _serialize(self, info: SerializationInfo) -> dict[str, Any]:
        shape = {self.shape.kind: self.shape.model_dump(mode=info.mode, exclude_none=info.exclude_none)}
        return shape if self.mass is None else {**shape, "mass": self.mass}

    @property
    def circle(self) -> Circle | None:
        """The circle, or None if the shape is another one."""
        return self.shape if isinstance(self.shape, Circle) else None

    @property
    def polygon(self) -> Polygon | None:
        """The polygon, or None if the shape is another one."""
        return self.shape if isinstance(self.shape, Polygon) else None
