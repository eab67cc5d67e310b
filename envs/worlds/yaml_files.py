"""Fields of YAML files, with errors that name the file and the field."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any


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
        if not _is_number(value):
            raise ValueError(f"{self.place}: {name}: expected a number, got {value!r}")
        return float(value)

    def numbers(self, name: str, *counts: int) -> list[float]:
        """Return a list of finite numbers, whose length is one of `counts`."""
        value = self._get(name)
        if not isinstance(value, list) or len(value) not in counts or not all(map(_is_number, value)):
            expected = " or ".join(map(str, counts))
            raise ValueError(f"{self.place}: {name}: expected {expected} numbers, got {value!r}")
        return [float(item) for item in value]

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


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
