"""The cells near a source, and by how much a spline exceeds the gauge there (kernels)."""

from __future__ import annotations

import numpy as np
from numba import float64, int64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CUBE, NOTHING
from leapnav.experts.proofs.cells import (
    BLOCK,
    GEOMETRY,
    LAYOUT,
    MASKS,
    VALUES,
    CellSet,
    connected,
    control_points,
    gather,
)
from leapnav.experts.proofs.gauge import SOURCE, Source, gauge_minimum

MAX_DIVISIONS = 8  # of a cell, per axis, for the bound of the excess


def cells_near(source: Source, cells: CellSet, free: np.ndarray, radius: float) -> np.ndarray:
    """Return the mask of the cells that may meet {gauge < radius} and are connected to the cell of the source.

    Args:
        source: the source.
        cells: the cells.
        free (m, 8, 8, 8): cells of the same layout through which they may be connected.
        radius: the radius.

    """
    layout = cells.layout
    near, found = np.zeros_like(cells.mask), np.zeros_like(cells.mask)
    _mark_near(free, layout, source, cells.grid.geometry, radius, near)
    k, i, j = cells.grid.cell((source.x, source.y, source.heading))
    if layout.slots[k // BLOCK, i // BLOCK, j // BLOCK] >= 0:
        connected(near, layout, k, i, j, found)
    return found & cells.mask


@kernel(NOTHING(MASKS, LAYOUT, SOURCE, GEOMETRY, float64, MASKS))
def _mark_near(mask, layout, source, geometry, radius, near):
    """Mark the cells of a set that may meet {gauge < radius}."""
    spacing, angle = geometry.spacing, geometry.angle
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        for k in range(BLOCK):
            heading = (layout.blocks[b, 0] * BLOCK + k + 0.5) * angle
            for i in range(BLOCK):
                px = geometry.x + (layout.blocks[b, 1] * BLOCK + i + 0.5) * spacing
                for j in range(BLOCK):
                    py = geometry.y + (layout.blocks[b, 2] * BLOCK + j + 0.5) * spacing
                    if mask[b, k, i, j]:
                        lowest = gauge_minimum(px, py, heading, spacing / 2, angle / 2, source)
                        near[b, k, i, j] = lowest < radius


@kernel(float64(VALUES, LAYOUT, MASKS, SOURCE, GEOMETRY, float64, float64, float64))
def excess(values, layout, mask, source, geometry, scale, slope, radius):
    """Upper bound of scale * S - slope * min(gauge, radius) over the cells of a set.

    Cells are divided into MAX_DIVISIONS parts per axis if the bound from the whole cell exceeds the one found so far.

    Args:
        values, layout, mask: the spline S and the set.
        source: the source of the gauge.
        geometry: the grid.
        scale: factor of the spline.
        slope, radius: factor and limit of the gauge.

    """
    spacing, angle = geometry.spacing, geometry.angle
    local, points = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2)), np.empty((3, 3, 3))
    slab, part = np.empty((3, 3, 3)), np.empty((3, 3, 3))
    n, best = MAX_DIVISIONS, -np.inf
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        gather(values, layout, b, local)
        for k in range(BLOCK):
            heading = (layout.blocks[b, 0] * BLOCK + k + 0.5) * angle
            for i in range(BLOCK):
                px = geometry.x + (layout.blocks[b, 1] * BLOCK + i + 0.5) * spacing
                for j in range(BLOCK):
                    if not mask[b, k, i, j]:
                        continue
                    py = geometry.y + (layout.blocks[b, 2] * BLOCK + j + 0.5) * spacing
                    control_points(local, k + 1, i + 1, j + 1, points)
                    lowest = min(gauge_minimum(px, py, heading, spacing / 2, angle / 2, source), radius)
                    if scale * points.max() - slope * lowest <= best:
                        continue
                    for p in range(n):
                        middle = heading + ((p + 0.5) / n - 0.5) * angle
                        _restrict(points, 0, p / n, (p + 1) / n, slab)
                        lowest = min(gauge_minimum(px, py, middle, spacing / 2, angle / 2 / n, source), radius)
                        if scale * slab.max() - slope * lowest <= best:
                            continue
                        for q in range(n * n):
                            u, v = q // n, q % n
                            cx, cy = px + ((u + 0.5) / n - 0.5) * spacing, py + ((v + 0.5) / n - 0.5) * spacing
                            lowest = min(gauge_minimum(cx, cy, middle, spacing / 2 / n, angle / 2 / n, source), radius)
                            if scale * slab.max() - slope * lowest <= best:
                                continue
                            _restrict(slab, 1, u / n, (u + 1) / n, part)
                            _restrict(part, 2, v / n, (v + 1) / n, part)
                            best = max(best, scale * part.max() - slope * lowest)
    return best


@kernel(NOTHING(CUBE, int64, float64, float64, CUBE))
def _restrict(points, axis, low, high, result):
    """Control points of a part of a cell, from `low` to `high` along one axis; `result` may be `points`."""
    for a in range(3):
        for b in range(3):
            i0, j0, k0 = (0, a, b) if axis == 0 else ((a, 0, b) if axis == 1 else (a, b, 0))
            i1, j1, k1 = (1, a, b) if axis == 0 else ((a, 1, b) if axis == 1 else (a, b, 1))
            i2, j2, k2 = (2, a, b) if axis == 0 else ((a, 2, b) if axis == 1 else (a, b, 2))
            p0, p1, p2 = points[i0, j0, k0], points[i1, j1, k1], points[i2, j2, k2]
            result[i0, j0, k0] = (1 - low) * (1 - low) * p0 + 2 * low * (1 - low) * p1 + low * low * p2
            result[i1, j1, k1] = (
                (1 - low) * (1 - high) * p0 + (low * (1 - high) + high * (1 - low)) * p1 + low * high * p2
            )
            result[i2, j2, k2] = (1 - high) * (1 - high) * p0 + 2 * high * (1 - high) * p1 + high * high * p2
