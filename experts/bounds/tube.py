"""The cells that the stages of a proof leave, as a function of L."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from leapnav.experts.proofs.cells import CellSet, Grid, divided
from leapnav.experts.proofs.proof import Pose


@dataclass(frozen=True)
class Tube:
    """Cells, and the lengths that exclude them.

    All stages together exclude a cell if L is at most its length. This holds for each L that is at most the one with
    which the stages were made: their functions satisfy the inequality on fewer cells, too.

    Attributes:
        cells: the cells that are left.
        lengths (m, 8, 8, 8): largest number of all stages for each cell, see `shortest_lengths`, float32.

    """

    cells: CellSet
    lengths: np.ndarray

    @classmethod
    def full(cls, grid: Grid) -> Tube:
        """Return the tube of all cells."""
        cells = CellSet.full(grid)
        return cls(cells, np.full(cells.mask.shape, -np.inf, dtype=np.float32))

    def on(self, cells: CellSet) -> Tube:
        """Return the tube of a part of the cells, whose layout may be another."""
        lengths = np.full(cells.mask.shape, -np.inf, dtype=np.float32)
        slots = self.cells.layout.slots[tuple(cells.layout.blocks.T)]
        lengths[slots >= 0] = self.lengths[slots[slots >= 0]]
        return Tube(cells, lengths)

    def raised(self, lengths: np.ndarray) -> Tube:
        """Return the tube after a further stage."""
        return Tube(self.cells, np.maximum(self.lengths, lengths.astype(np.float32)))

    def below(self, limit: float, start: Pose | None = None) -> Tube:
        """Return the cells that are left with some L, if a start is given those that are connected with it."""
        left = CellSet(self.cells.grid, self.cells.layout, self.cells.mask & (self.lengths < limit))
        return Tube(left if start is None else left.connected_with(start), self.lengths)

    def refined(self) -> Tube:
        """Return the tube with half the spacing."""
        cells = self.cells.refined()
        return Tube(cells, divided(self.lengths, self.cells.layout, cells.layout))

    def length_with(self, count: int) -> float:
        """Return the largest L with which at most this number of cells is left, infinity for all cells."""
        lengths = np.sort(self.lengths[self.cells.mask])
        return float(lengths[max(count, 0)]) if count < len(lengths) else math.inf

    def separating_length(self, ends: tuple[Pose, Pose], low: float, high: float) -> float:
        """Return the largest L, from `low` to `high`, with which the cells left do not connect start and goal.

        It is `low` if there is none; that may be minus infinity.
        """
        lengths = np.unique(self.lengths[self.cells.mask])
        lengths = lengths[(lengths > low) & (lengths < high)]
        first, last = -1, len(lengths)  # the ends are separated with the first, and connected with the last
        while last - first > 1:
            middle = (first + last) // 2
            if self.below(float(lengths[middle]), ends[0]).cells.contains(ends[1]):
                last = middle
            else:
                first = middle
        return float(lengths[first]) if first >= 0 else low
