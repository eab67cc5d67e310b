"""Validated, immutable records: the base class of everything that a scenario file contains, and its field types."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails

# Squares of larger numbers (m or s) would leave too little of a double's precision for distances of the robot's size.
MAX_MAGNITUDE = 1e6
Finite = Annotated[float, Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=MAX_MAGNITUDE, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_MAGNITUDE, allow_inf_nan=False)]
Point = tuple[Finite, Finite]


def _check_interval(interval: tuple[float, float]) -> tuple[float, float]:
    if not interval[0] < interval[1]:
        raise ValueError("expected (lowest, highest) with lowest < highest")
    return interval


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_check_interval)]


class Frozen(BaseModel):
    """An immutable record that accepts no unknown fields and converts no types, except lists to tuples."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_validator(mode="before")
    @classmethod
    def _accept_lists(cls, fields: Any) -> Any:
        if isinstance(fields, dict) and any(isinstance(value, list) for value in fields.values()):
            return {name: as_tuples(value) if isinstance(value, list) else value for name, value in fields.items()}
        return fields


def as_tuples(value: Any) -> Any:
    """Return a value with lists replaced by tuples, as strict validation of immutable fields requires."""
    if isinstance(value, dict):
        return {key: as_tuples(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(as_tuples(item) for item in value)
    return value


def inside(key: str, error: ValidationError) -> ValidationError:
    """Return an error whose faults are those of the value of a key."""
    faults: list[InitErrorDetails] = []
    for details in error.errors(include_url=False):
        fault: InitErrorDetails = {"type": details["type"], "loc": (key, *details["loc"]), "input": details["input"]}
        if "ctx" in details:
            fault["ctx"] = details["ctx"]
        faults.append(fault)
    return ValidationError.from_exception_data(error.title, faults)
