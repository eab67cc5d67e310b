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
from leapnav.experts.proofs.gauge import SOURCE, Source, gauge, gauge_minimum

MAX_HALVINGS = 2  # of a cell, for the bound of the excess


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
        k0, i0, j0 = (layout.blocks[b, 0] + 0.5, layout.blocks[b, 1] + 0.5, layout.blocks[b, 2] + 0.5)
        px, py = geometry.x + i0 * BLOCK * spacing, geometry.y + j0 * BLOCK * spacing
        width, angle_width = BLOCK / 2 * spacing, BLOCK / 2 * angle
        if not (gauge_minimum(px, py, k0 * BLOCK * angle, width, angle_width, source) < radius and mask[b].any()):
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


@kernel(float64(VALUES, LAYOUT, MASKS, SOURCE, GEOMETRY, float64, float64, float64))
def _largest_at_centres(values, layout, mask, source, geometry, scale, slope, radius):
    """The excess at the centres of the cells, from which most other cells need no division."""
    spacing, angle = geometry.spacing, geometry.angle
    local, points, best = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2)), np.empty((3, 3, 3)), -np.inf
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        gather(values, layout, b, local)
        for k in range(BLOCK):
            heading = (layout.blocks[b, 0] * BLOCK + k + 0.5) * angle
            for i in range(BLOCK):
                px = geometry.x + (layout.blocks[b, 1] * BLOCK + i + 0.5) * spacing
                for j in range(BLOCK):
                    if mask[b, k, i, j]:
                        py = geometry.y + (layout.blocks[b, 2] * BLOCK + j + 0.5) * spacing
                        control_points(local, k + 1, i + 1, j + 1, points)
                        value = 0.0
                        for a in range(27):  # Bernstein polynomials of degree 2 at 1/2: 1/4, 1/2, 1/4
                            u, v, w = a // 9, a // 3 % 3, a % 3
                            value += (1 + u % 2) * (1 + v % 2) * (1 + w % 2) / 64.0 * points[u, v, w]
                        best = max(best, scale * value - slope * min(gauge(px, py, heading, source), radius))
    return best


@kernel(float64(VALUES, LAYOUT, MASKS, SOURCE, GEOMETRY, float64, float64, float64))
def excess(values, layout, mask, source, geometry, scale, slope, radius):
    """Upper bound of scale * S - slope * min(gauge, radius) over the cells of a set.

    A cell is halved along all axes while its bound exceeds the largest value found so far, at most MAX_HALVINGS times.

    Args:
        values, layout, mask: the spline S and the set.
        source: the source of the gauge.
        geometry: the grid.
        scale: factor of the spline.
        slope, radius: factor and limit of the gauge.

    """
    spacing, angle = geometry.spacing, geometry.angle
    local, points = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2)), np.empty((3, 3, 3))
    part, stack = np.empty((3, 3, 3)), np.empty((8 * MAX_HALVINGS + 1, 4), dtype=np.int64)
    best = _largest_at_centres(values, layout, mask, source, geometry, scale, slope, radius)
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        gather(values, layout, b, local)
        for k in range(BLOCK):
            heading = (layout.blocks[b, 0] * BLOCK + k) * angle
            for i in range(BLOCK):
                x = geometry.x + (layout.blocks[b, 1] * BLOCK + i) * spacing
                for j in range(BLOCK):
                    if not mask[b, k, i, j]:
                        continue
                    y = geometry.y + (layout.blocks[b, 2] * BLOCK + j) * spacing
                    control_points(local, k + 1, i + 1, j + 1, points)
                    stack[0], size = 0, 1
                    while size > 0:
                        size -= 1
                        # A part: its depth, and its position on the grid of parts of this depth.
                        depth, p, q, r = stack[size, 0], stack[size, 1], stack[size, 2], stack[size, 3]
                        width = 0.5**depth
                        cx, cy = x + (q + 0.5) * width * spacing, y + (r + 0.5) * width * spacing
                        middle, half = heading + (p + 0.5) * width * angle, width / 2
                        lowest = gauge_minimum(cx, cy, middle, half * spacing, half * angle, source)
                        _restrict(points, 0, p * width, (p + 1) * width, part)
                        _restrict(part, 1, q * width, (q + 1) * width, part)
                        _restrict(part, 2, r * width, (r + 1) * width, part)
                        bound = scale * part.max() - slope * min(lowest, radius)
                        if bound <= best:
                            continue
                        if depth == MAX_HALVINGS:
                            best = bound
                            continue
                        for child in range(8):
                            stack[size, 0], stack[size, 1] = depth + 1, 2 * p + child // 4
                            stack[size, 2], stack[size, 3] = 2 * q + child // 2 % 2, 2 * r + child % 2
                            size += 1
    return best
