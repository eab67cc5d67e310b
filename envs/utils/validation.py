"""Validation of arguments. Each error message names the argument, what was expected, and the value."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any, TypeGuard

import numpy as np


def check_positive(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a finite number > 0."""
    if not (is_finite_number(value) and value > 0):
        raise ValueError(f"{name}: expected a positive number, got {value!r}")


def check_not_negative(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a finite number >= 0."""
    if not (is_finite_number(value) and value >= 0):
        raise ValueError(f"{name}: expected a number >= 0, got {value!r}")


def check_at_least(name: str, value: Any, minimum: float, *, unit: str = "") -> None:
    """Raise ValueError unless the value is a finite number >= `minimum`; the message states the minimum's `unit`."""
    if not (is_finite_number(value) and value >= minimum):
        raise ValueError(f"{name}: expected at least {minimum}{unit and f' {unit}'}, got {value!r}")


def check_fraction(name: str, value: Any, *, zero: bool = True, one: bool = True) -> None:
    """Raise ValueError unless the value is a number in [0, 1]; `zero=False` and `one=False` exclude an end."""
    if not (is_finite_number(value) and 0 <= value <= 1 and (zero or value > 0) and (one or value < 1)):
        raise ValueError(f"{name}: expected a number in {'[' if zero else '('}0, 1{']' if one else ')'}, got {value!r}")


def check_integer(name: str, value: Any, minimum: int, maximum: int | None = None) -> int:
    """Return the value as an int.

    Raises:
        ValueError: it is not an integer from `minimum` to `maximum`.

    """
    if not is_integer(value) or value < minimum or (maximum is not None and value > maximum):
        expected = f">= {minimum}" if maximum is None else f"from {minimum} to {maximum}"
        raise ValueError(f"{name}: expected an integer {expected}, got {value!r}")
    return int(value)


def in_words(count: int) -> str:
    """Return a small number as a word, a larger one in digits."""
    return {1: "one", 2: "two", 3: "three"}.get(count, str(count))


def check_choice(name: str, value: Any, choices: Iterable[str]) -> None:
    """Raise ValueError unless the value is one of the choices."""
    known = tuple(choices)
    if value not in known:
        raise ValueError(f"{name}: expected one of {', '.join(known)}, got {value!r}{suggestion(value, known)}")


def suggestion(value: object, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" if a known name is close to the value, else an empty text."""
    close = difflib.get_close_matches(value, list(known), n=1, cutoff=0.7) if isinstance(value, str) else []
    return f"; did you mean {close[0]!r}?" if close else ""


def check_flag(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a boolean of Python or NumPy."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}: expected True or False, got {value!r}")


def is_integer(value: Any) -> TypeGuard[int]:
    """Return whether a value is an integer of Python or NumPy; booleans are not."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a real number of Python or NumPy, finite or not; booleans are not."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def is_finite_number(value: Any) -> bool:
    """Return whether a value is a finite real number of Python or NumPy; booleans are not."""
    return is_number(value) and math.isfinite(value)


def as_vector(name: str, values: Any, length: int | None = None, *, finite: bool = True) -> np.ndarray:
    """Return values as a vector of floats that kernels can read: contiguous, of a given length, finite.

    Raises:
        ValueError: the shape is another one, a value is not a number, or not finite unless `finite` is False.

    """
    return _as_array(name, values, (length,), finite)


def as_matrix(
    name: str, values: Any, rows: int | None, columns: int | None = None, *, finite: bool = True
) -> np.ndarray:
    """Return values as a matrix of floats that kernels can read; None accepts any size. See `as_vector`."""
    return _as_array(name, values, (rows, columns), finite)


def _as_array(name: str, values: Any, shape: tuple[int | None, ...], finite: bool) -> np.ndarray:
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers of the shape {_in_words(shape)}, got {values!r}") from None
    found = array.shape if isinstance(values, np.ndarray) and values.ndim else np.shape(values)
    if len(found) != len(shape) or any(size not in (None, actual) for size, actual in zip(shape, found, strict=True)):
        raise ValueError(f"{name}: expected the shape {_in_words(shape)}, got {found}")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)][0]}")
    return array if array.flags.writeable else array.copy()


def _in_words(shape: tuple[int | None, ...]) -> str:
    sizes = ", ".join("any" if size is None else str(size) for size in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"
