"""Checks of arguments shared by the single and the vector environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leapnav.envs.utils.validation import in_words


def check_render_mode(mode: str | None, modes: Sequence[str]) -> None:
    """Raise ValueError unless the mode is None or one of `modes`."""
    if mode is not None and mode not in modes:
        raise ValueError(f"render_mode: expected None or one of {', '.join(modes)}, got {mode!r}")


def check_options(options: Mapping[str, Any], *known: str) -> None:
    """Raise ValueError for an unknown option of a reset."""
    for name in options:
        if name not in known:
            names = " or ".join(repr(name) for name in known)
            raise ValueError(f"options: expected {names}, got {name!r}")


def check_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return actions as float64.

    Raises:
        ValueError: they have another shape, or are not numbers.

    """
    try:
        values = np.asarray(actions)
    except (TypeError, ValueError):  # rows of different lengths
        values = np.empty(0, dtype=object)
    if values.shape != shape or values.dtype.kind not in "fiu":
        expected = f"{in_words(shape[0])} finite numbers" if len(shape) == 1 else f"finite numbers of shape {shape}"
        is_batch = values.ndim > 1 and values.dtype.kind in "fiu"
        raise ValueError(f"action: expected {expected}, got {f'shape {values.shape}' if is_batch else repr(actions)}")
    return np.ascontiguousarray(values, dtype=np.float64)
