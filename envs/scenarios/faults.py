"""Faults of a scenario: the error, and its message in one line with field, expectation and value."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from pydantic_core import ErrorDetails

from leapnav.envs.utils.validation import suggestion

MAX_FAULTS = 8  # faults in one message
# Messages for the types of pydantic's errors.
EXPECTED = {
    "bool_parsing": "expected True or False",
    "bool_type": "expected True or False",
    "greater_than": "expected a number > {gt:g}",
    "greater_than_equal": "expected a number >= {ge:g}",
    "less_than": "expected a number < {lt:g}",
    "less_than_equal": "expected a number <= {le:g}",
    "finite_number": "expected a finite number",
    "float_type": "expected a number",
    "float_parsing": "expected a number",
    "string_type": "expected text",
    "literal_error": "expected {expected}",
    "list_type": "expected a list",
    "too_short": "expected at least {min_length} numbers",
    "tuple_type": "expected a list",
    "model_type": "expected an object",
    "model_attributes_type": "expected an object",
}


class ScenarioError(ValueError):
    """A scenario is invalid. The message is one line with the scenario and, for each fault, the field and the value."""


def shorten(value: Any) -> str:
    """Return a value as text of at most 80 characters."""
    text = repr(value).replace("\n", " ")
    return text if len(text) <= 80 else text[:77] + "..."


def one_line(name: Any, faults: list[str]) -> str:
    """Return all faults as one line: scenario, then field, fault and value of each."""
    hidden = len(faults) - MAX_FAULTS
    text = "; ".join(faults[:MAX_FAULTS]) + (f"; and {hidden} more faults" if hidden > 0 else "")
    return " ".join(f"Scenario {shorten(name)}: {text}".splitlines())  # an unknown key may contain line breaks


def fault(details: ErrorDetails, known: Callable[[Sequence[Any]], Iterable[str]], within: tuple[str, ...] = ()) -> str:
    """Return one fault: field, what is expected, and the value.

    Args:
        details: the error.
        known: function from the location of an object in the scenario to the names of its fields.
        within: location of the object that was validated.

    """
    location, context, kind = (*within, *details["loc"]), details.get("ctx", {}), details["type"]
    path = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in location).lstrip(".")
    if kind == "extra_forbidden":
        hint = suggestion(location[-1], known(location[:-1]))
        return f"{path}: unknown field, got {shorten(details['input'])}{hint}"
    if kind == "missing":
        return f"{path}: missing"
    if kind in ("too_long", "tuple_too_long"):
        message = f"expected {context.get('max_length')} numbers"
    elif kind == "value_error":
        message = details["msg"].removeprefix("Value error, ")
    else:
        message = EXPECTED.get(kind, details["msg"]).format(**context)
    # The messages of whole-scenario checks contain field and value.
    return f"{path}: {message}, got {shorten(details['input'])}" if path else message


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the fields of a JSON object.

    Raises:
        ScenarioError: a key appears more than once.

    """
    fields = dict(pairs)
    if len(fields) < len(pairs):
        repeated = next(key for key, _ in pairs if sum(key == other for other, _ in pairs) > 1)
        raise ScenarioError(f"scenario: {repeated}: the key appears more than once")
    return fields


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        OSError: the file cannot be read.

    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a scenario file (JSON), got a directory")
    if not path.exists():
        others = os.listdir(path.parent) if path.parent.is_dir() else []
        raise FileNotFoundError(f"{path}: no such file{suggestion(path.name, others)}")
    return path.read_text(encoding="utf-8-sig")


def check_at_rest(moves: bool, what: str) -> None:
    """Raise ValueError if obstacles move, for what considers obstacles at rest only."""
    if moves:
        raise ValueError(f"obstacles: {what}: expected obstacles at rest, but one has a velocity or a path")


def check_headings(name: str, start: tuple[float, ...], goal: tuple[float | None, ...]) -> None:
    """Check the headings of a scenario that a person has written, perhaps in degrees.

    Raises:
        ScenarioError: a heading is beyond +-2 pi.

    """
    faults = [
        f"{field}: expected a heading in radians, at most 2 pi, got {heading:g}; "
        f"did you mean {math.radians(heading):.4g}?"
        for field, (_, _, heading) in (("start", start), ("goal", goal))
        if heading is not None and abs(heading) > 2 * math.pi
    ]
    if faults:
        raise ScenarioError(f"Scenario {name!r}: {' '.join(faults)}")
