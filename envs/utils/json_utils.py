"""JSON: parsing, and encoding of results.

Dataclasses, paths and enums are supported; NaN and infinity become null.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from pydantic_core import to_json, to_jsonable_python


def encode(value: Any, *, indent: int | None = None) -> str:
    """Return a value as JSON text.

    Args:
        value: dictionaries, lists, numbers, strings, dataclasses, paths or enums, nested in any way.
        indent: spaces per level; None for a single line.

    """
    return to_json(value, indent=indent, inf_nan_mode="null", fallback=_from_numpy).decode()


def plain(value: Any) -> Any:
    """Return a value as dictionaries, lists, numbers and strings; NaN and infinity become None."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_from_numpy)


def _from_numpy(value: Any) -> Any:
    """Return a NumPy scalar or array as Python numbers."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no representation in JSON")


def parse_json(name: str, text: str) -> Any:
    """Return the value of JSON text.

    Raises:
        ValueError: it is not valid JSON; the message contains the name.

    """
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"{name}: not valid JSON: {error}, got {text!r}") from None
