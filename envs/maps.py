"""Obstacles from elsewhere: discs as arrays, and the grid maps of the Moving AI Lab as rectangles.

N. Sturtevant, "Benchmarks for grid-based pathfinding", IEEE Trans. Comput. Intell. AI Games 4 (2012); the maps are at
https://movingai.com/benchmarks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

PASSABLE, KNOWN = ".GS", ".GS@OTW"  # swamp can be driven through; water and trees cannot
MARGIN = 1.0  # m round what is to be in an arena, where none is given


def disc_arena(discs: np.ndarray, points: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """The smallest arena with some room round the discs (n, 3) and the points (m, 2)."""
    boxes = np.concatenate([discs, [(*point, 0.0) for point in points]])
    low = (boxes[:, :2] - boxes[:, 2:]).min(axis=0) - MARGIN
    high = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) + MARGIN
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def check_discs(discs: object) -> np.ndarray:
    """Discs as an array (n, 3) of x, y and radius.

    Raises:
        ValueError: they are none; the message names the first that is not.

    """
    try:
        array = np.asarray(discs, dtype=float)
    except (TypeError, ValueError):
        raise ValueError("discs: expected numbers in rows of x, y and radius") from None
    if array.size == 0:
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"discs: expected rows of x, y and radius, got an array of shape {array.shape}")
    for i, (x, y, radius) in enumerate(array.tolist()):
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(radius) and radius > 0):
            raise ValueError(f"discs[{i}]: expected finite numbers and a positive radius, got {(x, y, radius)}")
    return array


def read_movingai(path: str | os.PathLike[str]) -> np.ndarray:
    """Which cells of a map are blocked (height, width), bool, its first line the top.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no such map; the message names the file and the line.

    """
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a map of the Moving AI Lab: not ASCII text") from None
    header = [line.split() for line in lines[:4]]
    names = [words[0] if words else "" for words in header]
    if names != ["type", "height", "width", "map"]:
        raise ValueError(f"{path}: not a map of the Moving AI Lab: expected lines type, height, width and map")
    sizes = []
    for words in header[1:3]:
        if len(words) != 2 or not words[1].isdecimal() or not 0 < int(words[1]) <= 100_000:
            raise ValueError(f"{path}: {words[0]}: expected a number of cells, got {' '.join(words[1:])!r}")
        sizes.append(int(words[1]))
    height, width = sizes
    rows = lines[4 : 4 + height]
    if len(rows) < height:
        raise ValueError(f"{path}: expected {height} lines of cells, got {len(rows)}")
    for number, row in enumerate(rows):
        if len(row) != width or not set(row) <= set(KNOWN):
            raise ValueError(f"{path}: line {number + 5}: expected {width} cells of {KNOWN}, got {row[:80]!r}")
    return np.array([[cell not in PASSABLE for cell in row] for row in rows])


def rectangles(blocked: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Few rectangles of blocked cells that cover all those that touch a free one, a corner included.

    What lies behind these nothing can reach. Rectangles may overlap, and go on behind. Beyond the map all is blocked.

    Args:
        blocked (height, width): bool.

    Returns:
        For each rectangle its first line and column, and those after its last.

    """
    free = np.pad(~blocked, 1)
    near = np.zeros_like(blocked)
    height, width = blocked.shape
    for line in range(3):
        for column in range(3):
            near |= free[line : line + height, column : column + width]
    open_cells = blocked & near
    found = []
    while open_cells.any():
        line, column = map(int, np.unravel_index(np.argmax(open_cells), blocked.shape))
        wide, tall = _grown(blocked, line, column), _grown(blocked.T, column, line)
        candidates = [wide, (tall[1], tall[0], tall[3], tall[2])]
        best = max(candidates, key=lambda r: int(open_cells[r[0] : r[2], r[1] : r[3]].sum()))
        open_cells[best[0] : best[2], best[1] : best[3]] = False
        found.append(best)
    return found


def _grown(blocked: np.ndarray, line: int, column: int) -> tuple[int, int, int, int]:
    """The rectangle of blocked cells that is as wide as can be at a cell, and then as tall as can be."""
    row: np.ndarray = blocked[line]
    left = column - int(np.argmin(row[column::-1])) + 1 if not row[: column + 1].all() else 0
    right = column + int(np.argmin(row[column:])) if not row[column:].all() else len(row)
    whole: np.ndarray = np.all(blocked[:, left:right], axis=1)
    top = line - int(np.argmin(whole[line::-1])) + 1 if not whole[: line + 1].all() else 0
    bottom = line + int(np.argmin(whole[line:])) if not whole[line:].all() else len(whole)
    return top, left, bottom, right
