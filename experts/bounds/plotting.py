"""Plots of what the proof of a lower bound leaves."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from leapnav.envs.utils.colors import ALTERNATIVES, OPTIMUM
from leapnav.experts.bounds.lower_bound import LowerBound
from leapnav.experts.optimum import Optimum
from leapnav.experts.plotting.scenes import draw_scenario
from leapnav.experts.proofs.cells import BLOCK, CellSet

TUBE = LinearSegmentedColormap.from_list("tube", ["#d7e8f7", "#2f6fab"])
N_POINTS = 400  # points of a path


def plot_tube(bound: LowerBound, path: str | os.PathLike[str] | None = None, optimum: Optimum | None = None) -> Figure:
    """Plot, for each spacing of the cells, where a path cheaper than the lower bound has not been excluded.

    The darker a position, the more headings are left. The optimum is drawn, and its alternatives: dashed if they leave
    the cells, so that they cost more than the lower bound.

    Args:
        bound: the lower bound.
        path: file to write; None writes no file.
        optimum: the optimum with its alternatives; None draws none.

    Raises:
        ValueError: the extension of the file is not an image format.

    """
    scenario, tubes = bound.proof.scenario, bound.tubes
    figure = Figure(figsize=(4.6 * len(tubes) + 0.4, 5.2), layout="constrained")
    panels = figure.subplots(1, len(tubes), squeeze=False)[0]
    for axes, cells in zip(panels, tubes, strict=True):
        draw_scenario(axes, scenario)
        _draw_cells(axes, cells)
        for index, local in enumerate(() if optimum is None else (optimum, *optimum.alternatives)):
            _draw_path(axes, cells, local, index)
        axes.set_title(f"cells of {cells.grid.spacing:.3g} m: {_fraction(bound, cells)} left", fontsize=10)
    figure.suptitle(f"{scenario.name}: no path costs less than {bound.value:.6g} (gap {100 * bound.gap:.2g} %)")
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure


def _fraction(bound: LowerBound, cells: CellSet) -> str:
    """Describe the volume of cells relative to the collision-free configuration space."""
    level = round(np.log2(bound.proof.spacing / cells.grid.spacing))
    return f"{100 * len(cells) / 8**level / bound.free_cells:.2g} %"


def _draw_cells(axes: Axes, cells: CellSet) -> None:
    """Draw the number of headings that are left at each position."""
    count = np.zeros((cells.grid.columns, cells.grid.lines))
    for block, mask in zip(cells.layout.blocks, cells.mask, strict=True):
        i, j = block[1] * BLOCK, block[2] * BLOCK
        count[i : i + BLOCK, j : j + BLOCK] += mask.sum(axis=0)
    grid = cells.grid
    extent = (grid.x, grid.x + grid.columns * grid.spacing, grid.y, grid.y + grid.lines * grid.spacing)
    image: Any = np.ma.masked_equal(count.T, 0.0)
    axes.imshow(image, origin="lower", extent=extent, cmap=TUBE, vmin=1, vmax=max(count.max(), 2.0), zorder=0.5)


def _draw_path(axes: Axes, cells: CellSet, extremal: Optimum, index: int) -> None:
    """Draw a path, dashed if it leaves the cells."""
    states = extremal.interpolate(np.linspace(0.0, extremal.horizon, N_POINTS))
    inside = all(cells.contains((x, y, heading)) for x, y, heading in states[:, :3].tolist())
    color = OPTIMUM if index == 0 else ALTERNATIVES[(index - 1) % len(ALTERNATIVES)]
    style = "-" if inside else (0, (3, 2))
    axes.plot(states[:, 0], states[:, 1], color=color, linewidth=1.8 if index == 0 else 1.1, linestyle=style, zorder=3)
