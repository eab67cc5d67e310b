"""Splines that nearly are the distance from a pose and satisfy the inequality: what a stage of a proof consists of.

`Distance` solves the eikonal equation, and `improve` turns the solution into a spline that satisfies the inequality:

1. A function of S, with slope 1 / R(S), where R is a quantile of the gradient ratios of the cells at this value of S.
2. The maximum of this and the last result, that of the level before with half the spacing at first.
3. Projections onto the inequality of the cells that still violate it. If large violations remain, except in the first
   round of the first level, 1 to 3 are repeated with R the maximum of the ratios.
4. The same function with R the maximum, or a common factor, for what is left.

Repeated, the quantile is below 1 where the inequality has slack, so that S grows from round to round.
"""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import NOTHING
from leapnav.experts.bounds.eikonal import make_medium, solve_eikonal
from leapnav.experts.bounds.projection import Constraints, project_once
from leapnav.experts.bounds.prolongation import prolonged
from leapnav.experts.proofs.cells import (
    BLOCK,
    EMPTY,
    GEOMETRY,
    LAYOUT,
    MASKS,
    VALUES,
    CellSet,
    control_points,
    gather,
)
from leapnav.experts.proofs.checker import Bound, source_offset, source_slope
from leapnav.experts.proofs.gauge import SOURCE, Source, gauge, make_source
from leapnav.experts.proofs.inequality import Functionals, gradient_ratios
from leapnav.experts.proofs.near_source import cells_near
from leapnav.experts.proofs.proof import Spline
from leapnav.experts.proofs.running_cost import RunningCost

# The gauge describes the surroundings of a source up to this lateral distance in spacings, and up to a radius in
# sqrt(r_w) beyond which the bound of its gradient is too large (it is 1.015 here).
SOURCE_WIDTH, MAX_GAUGE = 5.66, 1.5
# Difference of radius and limit: at most these spacings, and this part of the largest gauge.
MARGIN, MAX_MARGIN = 4.0, 0.25
CORRECTIONS, TOLERANCE = 3, 3e-3  # of the eikonal equation; in n times the spacing
# n in obstacles grows by exp(depth / (1.2 spacings)), and is constant from 2.2 spacings on.
DEPTH, MAX_EXPONENT, WALL_DEPTH, WALL = 1.2, 8.0, 2.2, 50.0
BINS_PER_SPACING = 2  # of the function of S
SAMPLE = 2  # the first function of S is determined by every second cell along each axis
MIN_RATIO = 0.8  # of its quantile
ACCEPTED = 1.02  # maximum ratio after projections, with a quantile of the ratios before
ENOUGH = 1.003  # maximum ratio that is removed by a common factor
KEPT_OFFSET = 0.7  # part of the offset of a spline by which it is lowered on the cells with half the spacing
MORE_VISITS, FEW = 60, 0.25  # further visits while at most this fraction of the cells is pending


@dataclass(frozen=True, eq=False)
class Medium:
    """What all distances of a level share.

    Attributes:
        cells: the cells, with a margin.
        cost: lower bounds of Phi.
        table: the functionals.
        constraints: the same in single precision.
        metric: r_v, r_w.
        energy: E.
        highest: Phi above which it is replaced by this value, so that S is less steep near obstacles.

    """

    cells: CellSet
    cost: RunningCost
    table: Functionals
    constraints: Constraints
    metric: tuple[float, float]
    energy: float
    highest: float

    @property
    def scale(self) -> float:
        """Change of S over a spacing without obstacles."""
        return math.sqrt(2 * self.energy * self.metric[0]) * self.cells.grid.spacing

    def free(self, cells: CellSet) -> np.ndarray:
        """Return the mask of the collision-free cells in the blocks that a stage with some cells contains."""
        used = self.cells.layout.slots[tuple(cells.with_margin().layout.blocks.T)]
        mask = np.zeros_like(cells.mask)
        mask[used] = True
        return CellSet(cells.grid, cells.layout, mask).without(~np.isfinite(self.cost.lowest)).mask

    def slowness(self) -> np.ndarray:
        """Return n (columns, lines), continued into obstacles."""
        spacing, clearance = self.cells.grid.spacing, self.cost.clearance
        depth = np.minimum(np.maximum(-clearance, 0.0) / (DEPTH * spacing), MAX_EXPONENT)
        # With the lowest Phi of a cell instead of that at its centre, S is less steep near obstacles, where it would
        # violate the inequality in most cells.
        proximity = np.minimum(np.minimum(self.cost.lowest, self.cost.centre), self.highest)
        n = np.sqrt(2 * (self.energy + proximity * np.exp(depth)))
        return np.where(clearance < -WALL_DEPTH * spacing, WALL * math.sqrt(2 * self.energy), n)


@dataclass(eq=False)
class Distance:
    """The distance from a pose, as a spline on the cells of a level.

    Attributes:
        medium: the level.
        pose: the pose (x, y, heading).
        values (m, 8, 8, 8): coefficients.
        ratios (m, 8, 8, 8): gradient ratios of `values`, 0 where they are not known.
        source: the gauge around the pose.
        radius, limit: see `leapnav.experts.proofs.proof.Spline`.
        spline, offset: the last result, and its offset, see `Bound`.
        lowest (m, 8, 8, 8): coefficients of a function that satisfies the inequality, which S should not be below: the
            last result, or the last of the level before, minus infinity where it is not known; None at first.
        cautious: whether a quantile of the ratios was too small at this level or the one before.

    """

    medium: Medium
    pose: tuple[float, float, float]
    previous: InitVar[Distance | None] = None
    values: np.ndarray = field(init=False)
    ratios: np.ndarray = field(init=False)
    source: Source = field(init=False)
    radius: float = field(init=False)
    limit: float = field(init=False)
    spline: Spline | None = field(init=False, default=None)
    offset: float = field(init=False, default=0.0)
    lowest: np.ndarray | None = field(init=False, default=None)
    cautious: bool = field(init=False, default=False)

    def __post_init__(self, previous: Distance | None) -> None:
        medium, cells = self.medium, self.medium.cells
        r_v, r_w = medium.metric
        spacing = cells.grid.spacing
        largest = MAX_GAUGE * math.sqrt(r_w)
        margin = min(MARGIN * spacing * math.sqrt(r_v), MAX_MARGIN * largest)
        self.radius = min(math.sqrt(4 * SOURCE_WIDTH * spacing * math.sqrt(r_v * r_w)), largest - margin)
        self.limit = self.radius + margin
        self.source = make_source(self.pose, medium.metric, self.limit)
        if previous is not None and previous.spline is not None:
            self.cautious = previous.cautious
            lowest = prolonged(previous.spline.values, previous.medium.cells.layout, cells.layout)
            self.lowest = previous.spline.scale * lowest - KEPT_OFFSET * previous.offset
        self.solve()

    def solve(self) -> None:
        """Solve the eikonal equation, with the values of the gauge near the source."""
        medium, cells = self.medium, self.medium.cells
        layout, grid = cells.layout, cells.grid
        self.values = np.full(cells.mask.shape, EMPTY, dtype=np.float32)
        free = medium.free(cells)
        slope = source_slope(self.source, cells, free, medium.cost, medium.energy, self.limit)
        passable = medium.cost.clearance > -1.5 * grid.spacing
        around = CellSet(grid, layout, np.ones_like(cells.mask)).without(~passable)
        locked = cells_near(self.source, around, around.mask, self.limit)
        _plant(self.values, layout, locked, self.source, grid.geometry, slope)
        equation = make_medium(grid, medium.metric, medium.slowness())
        tolerance = TOLERANCE * medium.scale
        solve_eikonal(self.values, locked, layout, equation, corrections=CORRECTIONS, tolerance=tolerance)
        exempt = cells_near(self.source, cells, free, self.radius)
        self._lower_tip(exempt, cells.mask & ~exempt)
        sample = np.zeros_like(exempt)
        sample[:, ::SAMPLE, ::SAMPLE, ::SAMPLE] = True
        self.measure(cells.mask & ~exempt & sample)

    def _lower_tip(self, exempt: np.ndarray, others: np.ndarray) -> None:
        """Lower the coefficients that only exempt cells use, so that the spline does not exceed the gauge there."""
        needed = np.zeros_like(others)
        _mark_neighbours(others, self.medium.cells.layout, needed)
        self.values[exempt & ~needed] -= np.float32(0.35 * self.radius)

    def measure(self, required: np.ndarray) -> float:
        """Compute the gradient ratios on the cells of a mask, and return the largest."""
        medium = self.medium
        self.ratios = np.zeros(required.shape, dtype=np.float32)
        args = (medium.cost, medium.table, medium.energy, 1.0, self.ratios)
        return gradient_ratios(self.values, medium.cells.layout, required, *args)[1]

    def improve(self, cells: CellSet, quantile: float, visits: int) -> tuple[Spline, Bound]:
        """Make the spline satisfy the inequality on cells.

        Args:
            cells: the cells, on the layout of the level.
            quantile: quantile of the ratios that the function of S removes before the projections.
            visits: number of visits of the pending cells; more follow if only few are pending.

        Returns:
            The spline, and what it proves on the cells.

        """
        medium = self.medium
        free = medium.free(cells)
        exempt = cells_near(self.source, cells, free, self.radius)
        required = cells.mask & ~exempt
        worst = self._project(cells, required, quantile, visits)
        kept, ratios = self.values, self.ratios
        if worst > ENOUGH:
            self.values = self._rescaled(required, 1.0)
            worst = self.measure(required)
        scale = 1.0 / max(1.0, worst * (1.0 + 1e-9))
        spline = Spline(self.values, scale, self.radius, self.limit)
        slope = source_slope(self.source, cells, free, medium.cost, medium.energy, self.limit)
        offset = source_offset(spline, self.source, cells, exempt, slope)
        self.spline, self.offset, self.lowest = spline, offset, scale * spline.values
        self.values, self.ratios = kept.copy(), ratios
        return spline, Bound(spline.values, scale, offset)

    def _project(self, cells: CellSet, required: np.ndarray, quantile: float, visits: int) -> float:
        """Remove violations by the function of S and by projections; return the largest ratio that is left.

        If it is too large, which happens where S must change over many cells, the maximum of the ratios replaces their
        quantile. This is known from the level before for the first round of a level.
        """
        medium, values, ratios = self.medium, self.values, self.ratios
        first = self.spline is None
        worst = math.inf
        for attempt in (1.0,) if first and self.cautious else (quantile, 1.0):
            self.values, self.ratios = values, ratios
            self.values = self._rescaled(required, attempt)
            if self.lowest is not None:
                np.maximum(self.values, self.lowest, out=self.values)
            pending = required.copy()
            for visit in range(visits + MORE_VISITS):
                count = project_once(self.values, cells.layout, required, pending, medium.cost, medium.constraints)
                if count == 0 or (visit >= visits and pending.sum() > FEW * required.sum()):
                    break
            worst = self.measure(required)
            if worst <= ACCEPTED or self.lowest is None:
                break
            self.cautious = True
        return worst

    def _rescaled(self, required: np.ndarray, quantile: float) -> np.ndarray:
        """Return the coefficients of a function of S whose slope is 1 / R(S), see the module."""
        known = required & (self.ratios > 0)
        lowest, highest = np.zeros_like(self.values), np.zeros_like(self.values)
        _ranges(self.values, self.medium.cells.layout, known, lowest, highest)
        known &= highest < 0.5 * EMPTY
        low, high, ratios = lowest[known], highest[known], self.ratios[known]
        if not len(low):
            return self.values.copy()
        width = self.medium.scale / BINS_PER_SPACING
        origin = min(0.0, float(low.min()))
        first, last = ((low - origin) / width).astype(int), ((high - origin) / width).astype(int)
        count = int(last.max()) + 1
        if quantile >= 1.0:
            slowest = _largest_per_bin(first, last, ratios, count)
        else:
            slowest = np.maximum(_quantile_per_bin((first + last) // 2, ratios, count, quantile), MIN_RATIO)
            slowest = np.convolve(np.pad(slowest, 2, mode="edge"), np.full(5, 0.2), mode="valid")
        edges = origin + width * np.arange(count + 1)
        heights = origin + width * np.concatenate([[0.0], np.cumsum(1.0 / slowest)])
        inside = np.interp(self.values, edges, heights)
        below, above = np.minimum(self.values - origin, 0.0), np.maximum(self.values - edges[-1], 0.0)
        return np.where(self.values < 0.5 * EMPTY, inside + below + above, self.values).astype(np.float32)


def _largest_per_bin(first: np.ndarray, last: np.ndarray, ratios: np.ndarray, count: int) -> np.ndarray:
    """Return the largest ratio, at least 1, of the cells whose bins, `first` to `last`, include each bin."""
    largest = np.ones(count)
    for step in range(int((last - first).max()) + 1):
        np.maximum.at(largest, np.minimum(first + step, last), ratios)
    return largest


def _quantile_per_bin(bins: np.ndarray, ratios: np.ndarray, count: int, quantile: float) -> np.ndarray:
    """Return a quantile of the ratios in each bin, 1 in empty bins."""
    order = np.lexsort((ratios, bins))
    starts = np.searchsorted(bins[order], np.arange(count + 1))
    sizes = np.diff(starts)
    filled = np.flatnonzero(sizes)
    found = np.ones(count)
    found[filled] = ratios[order][starts[filled] + (quantile * (sizes[filled] - 1)).astype(int)]
    return found


@kernel(NOTHING(VALUES, LAYOUT, MASKS, SOURCE, GEOMETRY, float64))
def _plant(values, layout, locked, source, geometry, slope):
    """Set the coefficients of the locked cells to the gauge at their centres, times the slope.

    Cells at whose centre the gauge of Koranyi has reached its limit are released.
    """
    for block in range(len(locked)):
        for k in range(BLOCK):
            heading = (layout.blocks[block, 0] * BLOCK + k + 0.5) * geometry.angle
            for i in range(BLOCK):
                x = geometry.x + (layout.blocks[block, 1] * BLOCK + i + 0.5) * geometry.spacing
                for j in range(BLOCK):
                    y = geometry.y + (layout.blocks[block, 2] * BLOCK + j + 0.5) * geometry.spacing
                    if not locked[block, k, i, j]:
                        continue
                    height = gauge(x, y, heading, source)
                    locked[block, k, i, j] = height < 0.999 * source.limit / source.gradient
                    if locked[block, k, i, j]:
                        values[block, k, i, j] = slope * height


@kernel(NOTHING(VALUES, LAYOUT, MASKS, VALUES, VALUES))
def _ranges(values, layout, mask, lowest, highest):
    """Smallest and largest control points of the spline on the cells of a set."""
    local, points = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2)), np.empty((3, 3, 3))
    for block in range(len(mask)):
        if not mask[block].any():
            continue
        gather(values, layout, block, local)
        for k in range(BLOCK):
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if mask[block, k, i, j]:
                        lowest[block, k, i, j] = control_points(local, k + 1, i + 1, j + 1, points)
                        highest[block, k, i, j] = points.max()


@kernel(NOTHING(MASKS, LAYOUT, MASKS))
def _mark_neighbours(mask, layout, marked):
    """Mark the cells of a set and the 26 cells around each."""
    n_k, n_i, n_j = layout.slots.shape
    for block in range(len(mask)):
        if not mask[block].any():
            continue
        for k in range(BLOCK):
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if not mask[block, k, i, j]:
                        continue
                    for dk in range(-1, 2):
                        a = (layout.blocks[block, 0] * BLOCK + k + dk) % (n_k * BLOCK)
                        for di in range(-1, 2):
                            b = layout.blocks[block, 1] * BLOCK + i + di
                            for dj in range(-1, 2):
                                c = layout.blocks[block, 2] * BLOCK + j + dj
                                if not (0 <= b < n_i * BLOCK and 0 <= c < n_j * BLOCK):
                                    continue
                                slot = layout.slots[a // BLOCK, b // BLOCK, c // BLOCK]
                                if slot >= 0:
                                    marked[slot, a % BLOCK, b % BLOCK, c % BLOCK] = True
