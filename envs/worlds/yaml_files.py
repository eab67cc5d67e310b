"""Fields of YAML files, with errors that name the file and the field."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Numbers that YAML 1.2 and ROS read, but PyYAML, which implements YAML 1.1, reads as text: 5e-2, nan, and quoted ones.
_NUMBER = re.compile(r"[-+]?((\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|\.?(nan|NaN|NAN|inf|Inf|INF))")
_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


@dataclass(frozen=True)
class YamlFields:
    """The fields of a mapping in a YAML file.

    Attributes:
        place: the file, and the field that contains the mapping.
        values: the fields.

    """

    place: str
    values: dict[str, Any]

    def text(self, name: str) -> str:
        """Return a text."""
        value = self._get(name)
        if not isinstance(value, str):
            raise ValueError(f"{self.place}: {name}: expected a text, got {value!r}")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number."""
        value = self.values.get(name, default)
        number = _as_number(value)
        if number is None or not math.isfinite(number):
            raise ValueError(f"{self.place}: {name}: expected a number, got {value!r}")
        return number

    def numbers(self, name: str, *counts: int, finite: int | None = None) -> list[float]:
        """Return a list of numbers, whose length is one of `counts`; the first `finite`, by default all, are finite."""
        value = self._get(name)
        found = [_as_number(item) for item in value] if isinstance(value, list) else []
        numbers = [number for number in found if number is not None]
        is_valid = len(numbers) == len(found) and len(found) in counts and all(map(math.isfinite, numbers[:finite]))
        if not is_valid:
            expected = " or ".join(map(str, counts))
            raise ValueError(f"{self.place}: {name}: expected {expected} numbers, got {value!r}")
        return numbers

    def flag(self, name: str, default: bool) -> bool:
        """Return a truth value: a bool, 0 or 1, or one of these in quotes."""
        value = self.values.get(name, default)
        known = _FLAGS.get(value.lower(), _as_number(value)) if isinstance(value, str) else value
        if known not in (0, 1):
            raise ValueError(f"{self.place}: {name}: expected 0 or 1, got {value!r}")
        return bool(known)

    def list(self, name: str) -> list[Any]:
        """Return a list."""
        value = self._get(name)
        if not isinstance(value, list):
            raise ValueError(f"{self.place}: {name}: expected a list, got {value!r}")
        return value

    def mapping(self, name: str, index: int | None = None) -> YamlFields:
        """Return a mapping, or one of a list of mappings."""
        value = self._get(name) if index is None else self.list(name)[index]
        place = f"{self.place}: {name}" + ("" if index is None else f"[{index}]")
        if not isinstance(value, dict):
            raise ValueError(f"{place}: expected fields, got {value!r}")
        return YamlFields(place, value)

    def _get(self, name: str) -> Any:
        if name not in self.values:
            raise ValueError(f"{self.place}: {name}: missing")
        return self.values[name]


def read_yaml(path: str | os.PathLike[str]) -> YamlFields:
    """Read the fields of a YAML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not YAML, or contains no fields.
        ModuleNotFoundError: PyYAML is not installed.

    """
    try:
        import yaml
    except ImportError:
        raise ModuleNotFoundError('YAML files need PyYAML: pip install "leapnav[worlds]"') from None
    try:
        fields = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: expected fields, got {type(fields).__name__}")
    return YamlFields(str(path), fields)


def _as_number(value: Any) -> float | None:
    """Return a number, or a text that is one, as a float; None if it is neither."""
    if isinstance(value, str) and _NUMBER.fullmatch(value.strip()):
        return float(value.strip().lower().replace(".nan", "nan").replace(".inf", "inf"))
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
