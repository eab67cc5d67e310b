"""Records read from YAML files, with errors that name the file and the field."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from leapnav.envs.scenarios.faults import fault


def _refuse_flag(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


# Numbers may be texts: PyYAML implements YAML 1.1, which takes 5e-2 for one, and some files quote numbers.
AnyNumber = Annotated[float, BeforeValidator(_refuse_flag)]
Number = Annotated[AnyNumber, Field(allow_inf_nan=False)]
Pair = tuple[Number, Number]


class YamlRecord(BaseModel):
    """Some of the fields of a mapping in a YAML file; the others are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


Record = TypeVar("Record", bound=YamlRecord)


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Read a YAML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not YAML.
        ModuleNotFoundError: PyYAML is not installed.

    """
    try:
        import yaml
    except ImportError:
        raise ModuleNotFoundError('YAML files need PyYAML: pip install "leapnav[worlds]"') from None
    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None


def as_record(kind: type[Record], content: Any, path: str | os.PathLike[str]) -> Record:
    """Return the content of a YAML file as a record.

    Raises:
        ValueError: it is invalid; the message names the file and the field.

    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        faults = [fault(details, lambda _: ()) for details in error.errors(include_url=False)]
        raise ValueError(f"{path}: {'; '.join(faults)}") from None
