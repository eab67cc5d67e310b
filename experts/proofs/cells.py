"""Sparse sets of cells of configuration space, in blocks of 8 x 8 x 8 (kernels).

A cell is a box in (heading, x, y) of a `Grid`; headings are periodic. A spline has one coefficient at the centre of
each cell: it is the tensor product of quadratic B-splines with knots at the cells' faces, so it is once continuously
differentiable, and on a cell it depends on the coefficients of the 27 cells around. Halving the spacing divides each
cell into 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, int32, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, NOTHING, tuple_of

BLOCK = 8  # cells per axis of a block
EMPTY = 1e6  # value of a coefficient that is not stored
MARGIN = 4  # cells around a set of cells that its blocks contain as well

VALUES = float32[:, :, :, ::1]
MASKS = types.Array(boolean, 4, "C")


class Geometry(NamedTuple):
    """Corner (m), spacing (m) and width in the heading (rad) of a grid's cells."""

    x: float
    y: float
    spacing: float
    angle: float


GEOMETRY = record_type(Geometry, x=float64, y=float64, spacing=float64, angle=float64)


@dataclass(frozen=True)
class Grid:
    """A uniform grid of cells in configuration space.

    Attributes:
        x, y: the corner of cell (., 0, 0) (m).
        spacing: width of the cells in x and y (m).
        headings: number of cells in the heading, a multiple of 8; cell 0 begins at heading 0.
        columns, lines: number of cells in x and y, multiples of 8.

    """

    x: float
    y: float
    spacing: float
    headings: int
    columns: int
    lines: int

    @classmethod
    def over(cls, arena: tuple[float, float, float, float], spacing: float, headings: int) -> Grid:
        """Return the grid that covers an arena with two further cells on each side."""
        x, y = arena[0] - 2 * spacing, arena[1] - 2 * spacing
        columns, lines = (
            BLOCK * math.ceil((high - low + 4 * spacing) / spacing / BLOCK - 1e-9)
            for low, high in ((arena[0], arena[2]), (arena[1], arena[3]))
        )
        return cls(x, y, spacing, headings, columns, lines)

    def refined(self) -> Grid:
        """Return the grid with half the spacing."""
        return Grid(self.x, self.y, self.spacing / 2, 2 * self.headings, 2 * self.columns, 2 * self.lines)

    @property
    def geometry(self) -> Geometry:
        """The numbers that kernels need."""
        return Geometry(self.x, self.y, self.spacing, self.angle)

    @property
    def angle(self) -> float:
        """Width of the cells in the heading (rad)."""
        return 2 * math.pi / self.headings

    def cell(self, pose: tuple[float, float, float]) -> tuple[int, int, int]:
        """Return the indices (heading, x, y) of the cell that contains a pose (x, y, heading)."""
        x, y, heading = pose
        return (
            int(heading % (2 * math.pi) / self.angle) % self.headings,
            math.floor((x - self.x) / self.spacing),
            math.floor((y - self.y) / self.spacing),
        )


class Layout(NamedTuple):
    """The blocks that are stored.

    Attributes:
        slots (headings / 8, columns / 8, lines / 8): index of each block of the grid, -1 if it is not stored.
        blocks (m, 3): position (heading, x, y) of each block in `slots`, in ascending order.

    """

    slots: np.ndarray
    blocks: np.ndarray


LAYOUT = record_type(Layout, slots=int32[:, :, ::1], blocks=int32[:, ::1])


def make_layout(grid: Grid, blocks: np.ndarray) -> Layout:
    """Return the layout with some blocks (m, 3)."""
    blocks = np.unique(np.ascontiguousarray(blocks, dtype=np.int32), axis=0)
    slots = np.full((grid.headings // BLOCK, grid.columns // BLOCK, grid.lines // BLOCK), -1, dtype=np.int32)
    slots[tuple(blocks.T)] = np.arange(len(blocks))
    return Layout(slots, np.ascontiguousarray(blocks))


@dataclass(frozen=True)
class CellSet:
    """A set of cells.

    Attributes:
        grid: the grid.
        layout: the blocks that contain cells of the set, and possibly others.
        mask (m, 8, 8, 8): which cells of the blocks belong to the set.

    """

    grid: Grid
    layout: Layout
    mask: np.ndarray

    @classmethod
    def full(cls, grid: Grid) -> CellSet:
        """Return the set of all cells."""
        blocks = np.argwhere(np.ones((grid.headings // BLOCK, grid.columns // BLOCK, grid.lines // BLOCK), dtype=bool))
        return cls(grid, make_layout(grid, blocks), np.ones((len(blocks), BLOCK, BLOCK, BLOCK), dtype=bool))

    def __len__(self) -> int:
        return int(self.mask.sum())

    def refined(self) -> CellSet:
        """Return the set of the cells into which halving the spacing divides the cells of this set."""
        grid, used = self.grid.refined(), self.mask.any(axis=(1, 2, 3))
        offsets = np.argwhere(np.ones((2, 2, 2)))
        layout = make_layout(grid, (2 * self.layout.blocks[used][:, None] + offsets).reshape(-1, 3))
        return CellSet(grid, layout, divided(self.mask, self.layout, layout))

    def on(self, layout: Layout) -> CellSet | None:
        """Return the set on the blocks of another layout, or None if that does not contain all cells of the set."""
        used = np.flatnonzero(self.mask.any(axis=(1, 2, 3)))
        slots = layout.slots[tuple(self.layout.blocks[used].T)]
        if (slots < 0).any():
            return None
        mask = np.zeros((len(layout.blocks), BLOCK, BLOCK, BLOCK), dtype=bool)
        mask[slots] = self.mask[used]
        return CellSet(self.grid, layout, mask)

    def with_margin(self) -> CellSet:
        """Return the set on the blocks that contain all cells within MARGIN cells of it, inside the grid."""
        needed = np.zeros(self.layout.slots.shape, dtype=np.bool_)
        mark_blocks(self.mask, self.layout, needed)
        found = self.on(make_layout(self.grid, np.argwhere(needed)))
        assert found is not None
        return found

    def without(self, columns: np.ndarray) -> CellSet:
        """Return the cells that do not lie above some columns, a mask (columns, lines)."""
        blocked = columns.reshape(columns.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
        blocks = self.layout.blocks
        return CellSet(self.grid, self.layout, self.mask & ~blocked[blocks[:, 1], blocks[:, 2]][:, None])

    def columns(self) -> np.ndarray:
        """Return which columns (columns, lines) contain blocks of the layout."""
        used = np.zeros(self.layout.slots.shape[1:], dtype=np.bool_)
        used[self.layout.blocks[:, 1], self.layout.blocks[:, 2]] = True
        return used.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)

    def connected_with(self, pose: tuple[float, float, float]) -> CellSet:
        """Return the cells that are connected, by faces, edges or corners, with the cell of a pose."""
        mask = np.zeros_like(self.mask)
        if self.contains(pose):
            connected(self.mask, self.layout, *self.grid.cell(pose), mask)
        return CellSet(self.grid, self.layout, mask)

    def contains(self, pose: tuple[float, float, float]) -> bool:
        """Whether the cell of a pose belongs to the set."""
        k, i, j = self.grid.cell(pose)
        slot = self.layout.slots[k // BLOCK, i // BLOCK, j // BLOCK]
        return bool(slot >= 0 and self.mask[slot, k % BLOCK, i % BLOCK, j % BLOCK])


def whole(grid: Grid, layout: Layout) -> CellSet:
    """Return the set of all cells of a layout."""
    return CellSet(grid, layout, np.ones((len(layout.blocks), BLOCK, BLOCK, BLOCK), dtype=bool))


def divided(array: np.ndarray, layout: Layout, finer: Layout) -> np.ndarray:
    """Return the numbers of cells (m, 8, 8, 8) for the cells into which halving the spacing divides them.

    Args:
        array: one number for each cell of the layout.
        layout: the layout.
        finer: a layout of the grid with half the spacing, whose blocks are parts of those of the layout.

    """
    parents, parts = layout.slots[tuple((finer.blocks // 2).T)], finer.blocks % 2 * (BLOCK // 2)
    indices = np.arange(BLOCK) // 2 + parts[:, :, None]  # (m, 3, 8)
    k, i, j = indices[:, 0, :, None, None], indices[:, 1, None, :, None], indices[:, 2, None, None, :]
    return array[parents[:, None, None, None], k, i, j]


@kernel(NOTHING(MASKS, LAYOUT, types.Array(boolean, 3, "C")))
def mark_blocks(mask, layout, needed):
    """Mark the blocks within MARGIN cells of the cells of a set."""
    n_k, n_i, n_j = layout.slots.shape
    for b in range(len(mask)):
        k0, i0, j0 = layout.blocks[b, 0], layout.blocks[b, 1], layout.blocks[b, 2]
        for k in range(BLOCK):
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if not mask[b, k, i, j]:
                        continue
                    for dk in range((k - MARGIN) // BLOCK, (k + MARGIN) // BLOCK + 1):
                        for di in range((i - MARGIN) // BLOCK, (i + MARGIN) // BLOCK + 1):
                            for dj in range((j - MARGIN) // BLOCK, (j + MARGIN) // BLOCK + 1):
                                if 0 <= i0 + di < n_i and 0 <= j0 + dj < n_j:
                                    needed[(k0 + dk) % n_k, i0 + di, j0 + dj] = True


@kernel(tuple_of(int64, int64, int64)(int64))
def halo(side):
    """First and last local index, and first index in the neighbour, of what lies on one side (-1, 0, 1) of a block."""
    if side < 0:
        return 0, 1, BLOCK - 1
    if side == 0:
        return 1, BLOCK + 1, 0
    return BLOCK + 1, BLOCK + 2, 0


@kernel(NOTHING(VALUES, LAYOUT, int64, CUBE))
def gather(values, layout, block, local):
    """Copy a block and the layer of coefficients around it to `local` (10, 10, 10)."""
    n_k, n_i, n_j = layout.slots.shape
    for dk in range(-1, 2):
        k = (layout.blocks[block, 0] + dk) % n_k
        k0, k1, k_from = halo(dk)
        for di in range(-1, 2):
            i = layout.blocks[block, 1] + di
            i0, i1, i_from = halo(di)
            for dj in range(-1, 2):
                j = layout.blocks[block, 2] + dj
                j0, j1, j_from = halo(dj)
                slot = layout.slots[k, i, j] if 0 <= i < n_i and 0 <= j < n_j else -1
                for a in range(k0, k1):
                    for b in range(i0, i1):
                        for c in range(j0, j1):
                            if slot < 0:
                                local[a, b, c] = EMPTY
                            else:
                                local[a, b, c] = values[slot, a - k0 + k_from, b - i0 + i_from, c - j0 + j_from]


@kernel(NOTHING(CUBE, LAYOUT, int64, VALUES))
def scatter(local, layout, block, values):
    """Copy `local`, see `gather`, back to the block and those around it."""
    n_k, n_i, n_j = layout.slots.shape
    for dk in range(-1, 2):
        k = (layout.blocks[block, 0] + dk) % n_k
        k0, k1, k_from = halo(dk)
        for di in range(-1, 2):
            i = layout.blocks[block, 1] + di
            i0, i1, i_from = halo(di)
            for dj in range(-1, 2):
                j = layout.blocks[block, 2] + dj
                j0, j1, j_from = halo(dj)
                slot = layout.slots[k, i, j] if 0 <= i < n_i and 0 <= j < n_j else -1
                if slot < 0:
                    continue
                for a in range(k0, k1):
                    for b in range(i0, i1):
                        for c in range(j0, j1):
                            values[slot, a - k0 + k_from, b - i0 + i_from, c - j0 + j_from] = local[a, b, c]


@kernel(NOTHING(MASKS, LAYOUT, int64, int64, int64, MASKS))
def connected(mask, layout, k, i, j, found):
    """Mark the cells of a set that are connected to cell (k, i, j) by faces, edges or corners.

    Cell (k, i, j) itself must be stored.
    """
    n_k, n_i, n_j = layout.slots.shape
    stack = np.empty((len(mask) * BLOCK**3, 3), dtype=np.int32)
    stack[0, 0], stack[0, 1], stack[0, 2] = k, i, j
    found[layout.slots[k // BLOCK, i // BLOCK, j // BLOCK], k % BLOCK, i % BLOCK, j % BLOCK] = True
    size = 1
    while size > 0:
        size -= 1
        k0, i0, j0 = stack[size, 0], stack[size, 1], stack[size, 2]
        for dk in range(-1, 2):
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    a, b, c = (k0 + dk) % (n_k * BLOCK), i0 + di, j0 + dj
                    if b < 0 or b >= n_i * BLOCK or c < 0 or c >= n_j * BLOCK:
                        continue
                    slot = layout.slots[a // BLOCK, b // BLOCK, c // BLOCK]
                    if slot < 0 or not mask[slot, a % BLOCK, b % BLOCK, c % BLOCK]:
                        continue
                    if not found[slot, a % BLOCK, b % BLOCK, c % BLOCK]:
                        found[slot, a % BLOCK, b % BLOCK, c % BLOCK] = True
                        stack[size, 0], stack[size, 1], stack[size, 2] = a, b, c
                        size += 1


@kernel(float64(CUBE, int64, int64, int64, CUBE))
def control_points(local, k, i, j, points):
    """Control points (3, 3, 3) of the spline on the cell with local indices (k, i, j); return the smallest.

    The spline on the cell is a convex combination of them.
    """
    smallest = np.inf
    for a in range(3):
        ka, kb = k - (a == 0), k + (a == 2)
        for b in range(3):
            ia, ib = i - (b == 0), i + (b == 2)
            for c in range(3):
                ja, jb = j - (c == 0), j + (c == 2)
                value = 0.125 * (
                    local[ka, ia, ja]
                    + local[ka, ia, jb]
                    + local[ka, ib, ja]
                    + local[ka, ib, jb]
                    + local[kb, ia, ja]
                    + local[kb, ia, jb]
                    + local[kb, ib, ja]
                    + local[kb, ib, jb]
                )
                points[a, b, c] = value
                smallest = min(smallest, value)
    return smallest
