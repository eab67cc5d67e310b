"""Sets of cells and splines on them: refinement, connection, and the lengths that exclude cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from leapnav.experts.bounds.prolongation import prolonged
from leapnav.experts.bounds.tube import Tube
from leapnav.experts.proofs.cells import BLOCK, CellSet, Grid, divided, make_layout
from leapnav.experts.proofs.checker import Bound, shortest_lengths, spline_value, without_excluded

GRID = Grid(x=-1.0, y=2.0, spacing=0.5, headings=16, columns=16, lines=16)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def pose_in(k: int, i: int, j: int) -> tuple[float, float, float]:
    """Return the centre of a cell of `GRID`, as a pose (x, y, heading)."""
    return GRID.x + (i + 0.5) * GRID.spacing, GRID.y + (j + 0.5) * GRID.spacing, (k + 0.5) * GRID.angle


def cells_of(*indices: tuple[int, int, int]) -> CellSet:
    """Return a set of cells of `GRID`."""
    full = CellSet.full(GRID)
    mask = np.zeros_like(full.mask)
    for k, i, j in indices:
        mask[full.layout.slots[k // BLOCK, i // BLOCK, j // BLOCK], k % BLOCK, i % BLOCK, j % BLOCK] = True
    return CellSet(GRID, full.layout, mask)


def test_half_the_spacing_divides_each_cell_into_eight(rng: np.random.Generator):
    cells = CellSet.full(GRID)
    cells = CellSet(GRID, cells.layout, rng.random(cells.mask.shape) < 0.01)
    numbers = rng.normal(size=cells.mask.shape)
    finer = cells.refined()
    parts = divided(numbers, cells.layout, finer.layout)
    assert len(finer) == 8 * len(cells)
    for _ in range(2000):
        x, y, heading = rng.uniform((-1, 2, -math.pi), (7, 10, math.pi))
        assert finer.contains((x, y, heading)) == cells.contains((x, y, heading))
        (k, i, j), (a, b, c) = GRID.cell((x, y, heading)), finer.grid.cell((x, y, heading))
        parent = cells.layout.slots[k // BLOCK, i // BLOCK, j // BLOCK]
        slot = finer.layout.slots[a // BLOCK, b // BLOCK, c // BLOCK]
        if slot >= 0:
            expected = numbers[parent, k % BLOCK, i % BLOCK, j % BLOCK]
            assert parts[slot, a % BLOCK, b % BLOCK, c % BLOCK] == expected


def test_a_prolonged_spline_is_the_same_function(rng: np.random.Generator):
    cells = CellSet.full(GRID)
    values = rng.normal(size=cells.mask.shape).astype(np.float32)
    finer = cells.refined()
    found = prolonged(values, cells.layout, finer.layout)
    for x, y, heading in rng.uniform((0, 3, -math.pi), (6, 9, math.pi), (200, 3)).tolist():
        expected = spline_value(values, cells, (x, y, heading))
        assert spline_value(found, finer, (x, y, heading)) == pytest.approx(expected, abs=1e-5)


def test_a_prolonged_spline_is_unknown_where_coefficients_are_not_stored(rng: np.random.Generator):
    cells = CellSet.full(GRID)
    layout = make_layout(GRID, np.array([[0, 0, 0], [1, 0, 0]]))
    values = rng.normal(size=(2, BLOCK, BLOCK, BLOCK)).astype(np.float32)
    found = prolonged(values, layout, cells.refined().layout)
    assert np.isfinite(found).sum() == 32 * 14 * 14  # without the cells at the edges of the blocks in x and y
    assert found.max() < values.max()


@pytest.mark.parametrize(
    ("other", "connected"),
    [
        ((5, 6, 5), True),  # by a face
        ((6, 6, 6), True),  # by a corner
        ((7, 8, 8), False),
        ((5, 7, 5), False),
    ],
)
def test_cells_are_connected_by_faces_edges_and_corners(other: tuple[int, int, int], connected: bool):
    found = cells_of((5, 5, 5), other).connected_with(pose_in(5, 5, 5))
    assert found.contains(pose_in(*other)) is connected


def test_cells_are_connected_across_the_seam_of_the_heading_and_not_across_the_border():
    assert len(cells_of((0, 3, 3), (15, 4, 3)).connected_with(pose_in(0, 3, 3))) == 2
    assert len(cells_of((0, 0, 3), (0, 15, 3)).connected_with(pose_in(0, 0, 3))) == 1


def test_nothing_is_connected_with_a_cell_outside_of_the_set():
    assert len(cells_of((0, 3, 3)).connected_with(pose_in(0, 4, 3))) == 0


def test_a_stage_keeps_the_cells_that_are_connected_with_the_start(rng: np.random.Generator):
    """Cells between start and goal are excluded, and with them those on the side of the goal."""
    cells = CellSet.full(GRID)
    high = np.zeros(cells.mask.shape, dtype=np.float32)
    for b, block in enumerate(cells.layout.blocks):
        columns = block[1] * BLOCK + np.arange(BLOCK)
        high[b, :, (columns > 5) & (columns < 10)] = 1.0
    start, goal = Bound(high, 1.0, 0.1), Bound(np.zeros_like(high), 1.0, 0.2)
    lengths = shortest_lengths(cells, start, goal)
    assert lengths.max() == pytest.approx(0.9)
    assert lengths.min() == pytest.approx(-0.1)
    left = without_excluded(cells, start, goal, 0.9 - 1e-6, pose_in(3, 2, 2))
    assert left.contains(pose_in(9, 4, 9))
    assert not left.contains(pose_in(3, 12, 2))
    assert without_excluded(cells, start, goal, 0.9 + 1e-6, pose_in(3, 2, 2)).contains(pose_in(3, 12, 2))


def test_the_separating_length_is_the_largest_that_separates(rng: np.random.Generator):
    full = Tube.full(GRID)
    ends = pose_in(1, 1, 1), pose_in(9, 14, 12)
    tube = full.raised(rng.random(full.cells.mask.shape)).raised(np.zeros(full.cells.mask.shape))
    found = tube.separating_length(ends, -math.inf, math.inf)
    assert not tube.below(found, ends[0]).cells.contains(ends[1])
    larger = np.sort(tube.lengths[tube.lengths > found])[0]
    assert tube.below(float(np.nextafter(larger, np.float32(2))), ends[0]).cells.contains(ends[1])
    assert tube.separating_length(ends, found + 1e-3, 1.0) == found + 1e-3
    assert tube.separating_length(ends, 0.0, found - 1e-3) <= found - 1e-3


def test_a_tube_keeps_its_lengths_when_it_is_refined(rng: np.random.Generator):
    full = Tube.full(GRID)
    tube = full.raised(rng.random(full.cells.mask.shape))
    limit = tube.length_with(50)
    few = Tube(CellSet(GRID, tube.cells.layout, tube.lengths < limit), tube.lengths)
    assert len(few.cells) == 50
    assert tube.length_with(len(tube.cells)) == math.inf
    finer = few.refined()
    assert len(finer.cells) == 400
    assert finer.lengths[finer.cells.mask].max() < limit
