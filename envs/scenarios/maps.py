"""Obstacles from other sources: arrays of discs, and the grid maps of the Moving AI Lab as rectangles.

N. Sturtevant, "Benchmarks for grid-based pathfinding", IEEE Trans. Comput. Intell. AI Games 4 (2012); the maps are at
https://movingai.com/benchmarks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

FREE_CELLS, CELLS = ".GS", ".GS@OTW"  # swamp (S) is free; water (W) and trees (T) are blocked
ARENA_MARGIN = 1.0  # m around the obstacles and poses, where no arena is given


def disc_arena(discs: np.ndarray, points: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """Return the smallest arena with a margin of 1 m around the discs (n, 3) and the points (m, 2)."""
    boxes = np.concatenate([discs, [(*point, 0.0) for point in points]])
    low = (boxes[:, :2] - boxes[:, 2:]).min(axis=0) - ARENA_MARGIN
    high = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) + ARENA_MARGIN
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def check_discs(discs: object) -> np.ndarray:
    """Return discs as an array (n, 3) of x, y and radius.

    Raises:
        ValueError: they are invalid; the message names the first invalid disc.

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
    """Read which cells of a map are blocked.

    Returns:
        An array (height, width) of bool. The first line is the top of the map.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a valid map; the message names the file and the line.

    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
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
        if len(row) != width or not set(row) <= set(CELLS):
            raise ValueError(f"{path}: line {number + 5}: expected {width} cells of {CELLS}, got {row[:80]!r}")
    return np.array([[cell not in FREE_CELLS for cell in row] for row in rows])


def rectangles(blocked: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Cover the blocked cells that have a free neighbour, diagonal ones included, with few rectangles.

    The other blocked cells cannot be reached and may stay uncovered. Rectangles contain blocked cells only; they may
    overlap. Cells outside the map count as blocked.

    Args:
        blocked (height, width): bool.

    Returns:
        For each rectangle its first line, first column, last line + 1 and last column + 1.

    """
    free = np.pad(~blocked, 1)
    exposed = np.zeros_like(blocked)
    height, width = blocked.shape
    for line in range(3):
        for column in range(3):
            exposed |= free[line : line + height, column : column + width]
    uncovered = blocked & exposed
    found = []
    for line, column in np.argwhere(uncovered).tolist():
        if not uncovered[line, column]:  # covered in the meantime
            continue
        widest, tallest = _grow(blocked, line, column), _grow(blocked.T, column, line)
        candidates = [widest, (tallest[1], tallest[0], tallest[3], tallest[2])]
        best = max(candidates, key=lambda r: int(uncovered[r[0] : r[2], r[1] : r[3]].sum()))
        uncovered[best[0] : best[2], best[1] : best[3]] = False
        found.append(best)
    return found


def rectangle_vertices(
    blocked: np.ndarray, cell_size: float, origin: tuple[float, float] = (0.0, 0.0)
) -> list[tuple[tuple[float, float], ...]]:
    """Return the vertices (m) of the rectangles that cover the blocked cells, see `rectangles`.

    Args:
        blocked (height, width): bool; the first line is the top of the map.
        cell_size: side length of a cell (m).
        origin: position of the lower left corner of the map (m).

    """
    height, (x, y) = len(blocked), origin
    found = []
    for top, left, bottom, right in rectangles(blocked):
        x_min, x_max = x + cell_size * left, x + cell_size * right
        low, high = y + cell_size * (height - bottom), y + cell_size * (height - top)
        found.append(((x_min, low), (x_max, low), (x_max, high), (x_min, high)))
    return found


def _grow(blocked: np.ndarray, line: int, column: int) -> tuple[int, int, int, int]:
    """Return the rectangle of blocked cells with the maximum width at a cell, and the maximum height at this width."""
    row: np.ndarray = blocked[line]
    left = column - int(np.argmin(row[column::-1])) + 1 if not row[: column + 1].all() else 0
    right = column + int(np.argmin(row[column:])) if not row[column:].all() else len(row)
    whole: np.ndarray = np.all(blocked[:, left:right], axis=1)
    top = line - int(np.argmin(whole[line::-1])) + 1 if not whole[: line + 1].all() else 0
    bottom = line + int(np.argmin(whole[line:])) if not whole[line:].all() else len(whole)
    return top, left, bottom, right
