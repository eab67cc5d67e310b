"""Plots of paths, extremals and banks with Matplotlib."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy as sp
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from leapnav.envs.field.clearance import clearance
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.colors import ALTERNATIVES, CURVES, EDGE, GOAL, OBSTACLE, OPTIMUM, START, WALL
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.optimum import Optimum
from leapnav.experts.plotting.scenes import draw_robot, draw_scenario
from leapnav.experts.problem.extremal import Extremal, Iteration
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.problem.system import ControlAffineSystem
from leapnav.experts.search.structure import Piece
from leapnav.experts.solvers.feasible_path import dense_path, select_sweeps

MAX_MODES = 3  # driving modes that are named in the legend
PIECES = {"straight": OPTIMUM, "turn": CURVES[4], "contact": WALL}  # colors of the pieces of a path
MAX_ALTERNATIVES = len(ALTERNATIVES)
N_ROBOTS = 9  # robot outlines along a path, evenly spaced in time
N_POINTS = 400  # points of a dense path
N_FIELD_POINTS = 200  # sample points per side of an obstacle field
MAX_BOUND = 3.0  # control bounds up to this multiple of the largest control are within the axes
MIN_DRIFT = 1e-9  # smallest half-height of the Hamiltonian's axes, so that rounding errors do not fill them
SWEEPS = ("sweep", "reduce")  # Leapfrog's phases, whose iterates have a feasible path
MAX_SWEEPS, N_FIRST_SWEEPS = 12, 4
MIN_DISTANCE = 1e-10  # relative distance of costs: the end error that Leapfrog allows an arc
MAX_LINEAR_SPREAD = 100.0  # in units of the smallest distance; a larger spread of costs is drawn on a logarithmic axis


def plot_solution(scenario: Scenario, extremal: Extremal, path: str | os.PathLike[str]) -> None:
    """Write a plot of a scenario's extremal to a file, see `plot_extremal`.

    Raises:
        ValueError: the extremal has no path, or the extension of the file is not an image format.

    """
    plot_extremal(extremal, path, scenario)


def plot_pieces(scenario: Scenario, pieces: Sequence[Piece], path: str | os.PathLike[str]) -> None:
    """Write a plot of the pieces of a path to a file, with a color for each kind and the numbers of the pieces.

    Args:
        scenario: the scenario.
        pieces: `MinimumTime.pieces` or `MinimumLength.pieces`.
        path: file; its extension is the format.

    """
    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    axes = figure.subplots()
    draw_scenario(axes, scenario)
    for number, piece in enumerate(pieces, start=1):
        axes.plot(*piece.points.T, color=PIECES[piece.kind], linewidth=2.0)
        axes.plot(*piece.points[0], "o", color=PIECES[piece.kind], markersize=3.0)
        middle = piece.points[len(piece.points) // 2] if len(piece.points) > 2 else piece.points.mean(axis=0)
        axes.annotate(str(number), middle, xytext=(4, 4), textcoords="offset points", fontsize=8)
    kinds = sorted({piece.kind for piece in pieces})
    handles = [axes.plot([], [], color=PIECES[kind], linewidth=2.0, label=kind)[0] for kind in kinds]
    axes.legend(handles=handles, loc="upper right", fontsize=8)
    figure.savefig(path, dpi=130)


def plot_extremal(
    extremal: Extremal,
    path: str | os.PathLike[str] | None = None,
    scenario: Scenario | None = None,
    title: str | None = None,
) -> Figure:
    """Plot states, controls, costates and Hamiltonian of an extremal over time.

    For a system with a position, the path in the plane is added. For a Leapfrog solution, the feasible paths of its
    sweeps are added from light to dark, in the plane of the position or of the first two states, and the cost of each
    sweep in the same colours. The optimum of a scenario is drawn with its alternatives.

    Args:
        extremal: extremal of any problem, certified or not.
        path: file to write; None writes no file.
        scenario: the scenario of the problem, for its arena and obstacles. Without it, the region in which the robot's
            centre cannot be is drawn.
        title: None uses the name of the scenario, the cost and the status.

    Raises:
        ValueError: the extremal has no path, or the extension of the file is not an image format.

    """
    if len(extremal.times) == 0:
        raise ValueError(f"there is no path to draw: {extremal.status.value}")
    in_plane = extremal.problem.system.position is not None
    sweeps = [row for row in extremal.history if row.phase in SWEEPS and np.isfinite(row.cost)]
    if in_plane or sweeps:
        figure = Figure(figsize=(11.5, 7.4 if sweeps else 6.4), layout="constrained")
        grid = figure.add_gridspec(4, 2, width_ratios=(1.2, 1))
        plane = figure.add_subplot(grid[:3, 0] if sweeps else grid[:, 0])
        if in_plane:
            if isinstance(extremal, Optimum):
                _draw_alternatives(plane, extremal, legend_top=-0.09 if scenario is None else 0.0)
            _draw_plane(plane, extremal, scenario, sweeps)
        else:
            _draw_state_space(plane, extremal, sweeps)
        if sweeps:
            _draw_costs(figure.add_subplot(grid[3, 0]), extremal, sweeps)
        panels = [figure.add_subplot(grid[row, 1]) for row in range(4)]
    else:
        figure = Figure(figsize=(10.5, 5.2), layout="constrained")
        panels = list(figure.subplots(2, 2).ravel())
    _draw_over_time(panels, extremal, "time (s)" if scenario is not None else "time")
    if title is None:
        name = "" if scenario is None else f"{scenario.name}: "
        free = "" if extremal.problem.horizon is not None else f"T = {extremal.horizon:.5g} s (free), "
        title = f"{name}J = {extremal.cost:.7g}, {free}{extremal.status.name}"
    figure.suptitle(title)
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure


def _dense_times(extremal: Extremal) -> np.ndarray:
    """Evenly spaced times and the steps of the integrator, which are dense in sharp turns; shape (K,)."""
    return np.union1d(extremal.times, np.linspace(0.0, extremal.horizon, N_POINTS))


def _labels(system: ControlAffineSystem) -> list[str]:
    """Labels of the states and controls (n + m)."""
    states = [f"${sp.latex(symbol)}$" for symbol in system.state]
    return list(system.labels) or [*states, *(f"$u_{{{j + 1}}}$" for j in range(system.m))]


def _draw_over_time(panels: Sequence[Axes], extremal: Extremal, label: str) -> None:
    """Draw states, controls, costates and Hamiltonian on four axes."""
    problem, horizon = extremal.problem, extremal.horizon
    system = problem.system
    names, known = [sp.latex(symbol) for symbol in system.state], _labels(system)
    times = _dense_times(extremal)
    states, controls, costates = extremal.evaluate(times)
    for axes, values, name, labels in (
        (panels[0], states, "states", known[: system.n]),
        (panels[1], controls, "controls", known[system.n :]),
        (panels[2], costates, "costates", [rf"$\lambda_{{{name}}}$" for name in names]),
    ):
        for k, (column, symbol) in enumerate(zip(values.T, labels, strict=True)):
            axes.plot(times, column, color=CURVES[k % len(CURVES)], linewidth=1.5, label=symbol)
        axes.set_ylabel(name)
    for axes, values, bounds in (
        (panels[0], states, problem.state_bounds),
        (panels[1], controls, problem.control_bounds),
    ):
        if bounds is not None:
            _draw_bounds(axes, values, bounds)
    _draw_hamiltonian(panels[3], extremal)
    last = panels[-1].get_subplotspec()
    for axes in panels:
        axes.set_xlim(0.0, horizon)
        axes.grid(alpha=0.3)
        # Beside the axes, so that it covers no curve.
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.05), frameon=False, fontsize=9, handlelength=1.2)
        spec = axes.get_subplotspec()
        if spec is not None and last is not None and spec.rowspan.stop == last.rowspan.stop:
            axes.set_xlabel(label)
        else:
            axes.tick_params(labelbottom=False)


def _draw_bounds(axes: Axes, values: np.ndarray, bounds: Sequence[tuple[float, float] | None]) -> None:
    """Draw bounds as faint lines; those far from the values are outside the axes, to keep the scale."""
    low, high = axes.get_ylim()
    limit = MAX_BOUND * float(np.abs(values).max())
    for k, pair in enumerate(bounds):
        for bound in pair or ():
            if np.isfinite(bound):
                color = CURVES[k % len(CURVES)]
                axes.axhline(bound, color=color, linewidth=0.9, linestyle=(0, (4, 3)), alpha=0.5, zorder=1)
            if abs(bound) <= limit:
                low, high = min(low, 1.06 * bound), max(high, 1.06 * bound)
    axes.set_ylim(low, high)


def _draw_hamiltonian(axes: Axes, extremal: Extremal) -> None:
    """Draw H minus its mean at the steps of the integrator, where the interpolation error is zero."""
    mean = float(extremal.hamiltonian.mean())
    deviation = extremal.hamiltonian - mean
    axes.plot(
        extremal.times,
        deviation,
        color=CURVES[0],
        linewidth=1.0,
        marker=".",
        markersize=3,
        label=r"$H - \bar{H}$" + "\n" + rf"$\bar{{H}} = {mean:.5g}$",
    )
    limit = 1.25 * max(MIN_DRIFT, float(np.abs(deviation).max()))
    axes.set(ylabel="Hamiltonian", ylim=(-limit, limit))


def _draw_plane(axes: Axes, extremal: Extremal, scenario: Scenario | None, sweeps: Sequence[Iteration]) -> None:
    """Draw the path of a system with a position over the obstacles, with headings if it has a state theta."""
    system = extremal.problem.system
    assert system.position is not None
    ix, iy = (system.state.index(symbol) for symbol in system.position)
    names = [str(symbol) for symbol in system.state]
    heading = names.index("theta") if "theta" in names else None
    states = extremal.evaluate(_dense_times(extremal))[0]
    _draw_sweeps(axes, extremal.problem, sweeps, lambda _, states: (states[:, ix], states[:, iy]))
    axes.plot(states[:, ix], states[:, iy], color=OPTIMUM, linewidth=1.8, zorder=3)
    drawn = extremal.evaluate(np.linspace(0.0, extremal.horizon, N_ROBOTS + 2))[0]
    if scenario is not None:
        draw_scenario(axes, scenario)
        for state in drawn[1:-1].tolist():
            draw_robot(axes, state, scenario.outline, OPTIMUM, alpha=0.3, zorder=3)
        return
    poses = [(q[ix], q[iy], None if heading is None else q[heading]) for q in drawn]
    low, high = np.array(axes.dataLim.min), np.array(axes.dataLim.max)
    center, reach = (low + high) / 2, 0.6 * float((high - low).max()) or 1.0
    if extremal.problem.field is not None:
        _draw_field(axes, extremal.problem.field, center, reach)
    if heading is not None:
        x, y, angle = np.array(poses, dtype=float).T
        style = {"angles": "xy", "scale": 18, "width": 0.005, "color": OPTIMUM, "alpha": 0.6}
        axes.quiver(x, y, np.cos(angle), np.sin(angle), **style)
    for pose, color in ((poses[0], START), (poses[-1], GOAL)):
        axes.plot(pose[0], pose[1], "o", color=color, markersize=7, zorder=4)
    axes.set(
        xlim=(center[0] - reach, center[0] + reach),
        ylim=(center[1] - reach, center[1] + reach),
        aspect="equal",
        xlabel=_labels(system)[ix],
        ylabel=_labels(system)[iy],
    )
    axes.grid(alpha=0.3)


def _draw_alternatives(axes: Axes, optimum: Optimum, legend_top: float) -> None:
    """Draw the best other local optima, with costs and path classes in a legend below the axes.

    Its upper edge is at `legend_top`, in units of the height of the axes: below the labels of the ticks.
    """
    shown = optimum.alternatives[:MAX_ALTERNATIVES]
    if not shown:
        return
    entries = [(optimum, OPTIMUM, 1.8), *((other, ALTERNATIVES[k], 1.3) for k, other in enumerate(shown))]
    for other, color, width in entries:
        positions = other.evaluate(_dense_times(other))[0][:, :2]
        label = f"J = {other.cost:.4g}"
        if other is not optimum and optimum.cost > 0:
            label += f" (+{100 * (other.cost / optimum.cost - 1):.2g} %)"
        if other.is_of_robot:
            label += _driving_label(other)
        axes.plot(*positions.T, color=color, linewidth=width, zorder=2.5, label=label)
    hidden = len(optimum.alternatives) - len(shown)
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, legend_top),
        frameon=False,
        fontsize=9,
        title=f"the best of {hidden + len(entries)} local optima" if hidden else None,
        title_fontsize=9,
    )


def _driving_label(optimum: Optimum) -> str:
    modes = optimum.driving_modes
    if len(modes) > MAX_MODES:
        label = f", {len(modes)} parts, first {modes[0]}"
    else:
        label = f", {', '.join(modes) or 'rotation in place'}"
    winding = optimum.heading_winding
    return f"{label}, winding {winding:+d}" if winding else label


def plot_bank(bank: ScenarioBank, path: str | os.PathLike[str], count: int = 24, columns: int = 6) -> None:
    """Plot scenarios of a bank with their optima, side by side.

    Args:
        bank: the bank.
        path: file to write.
        count: maximum number of scenarios, evenly spaced in the bank.
        columns: maximum number of columns.

    Raises:
        ValueError: count < 1, or the extension of the file is not an image format.

    """
    check_at_least("count", count, 1)
    chosen = np.unique(np.linspace(0, len(bank) - 1, min(count, len(bank))).round().astype(int))
    columns = min(columns, len(chosen))
    rows = math.ceil(len(chosen) / columns)
    figure = Figure(figsize=(2.4 * columns, 2.65 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, index in zip(grid[: len(chosen)], chosen.tolist(), strict=True):
        reference = bank.reference(index)
        draw_scenario(axes, bank[index])
        axes.plot(*reference.states[:, :2].T, color=OPTIMUM, linewidth=1.4)
        axes.set_title(f"{index}: J* = {reference.cost:.3g}, {bank.horizons[index]:.3g} s", fontsize=8)
    for axes in grid[len(chosen) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=130)


def _draw_field(axes: Axes, field: np.ndarray, center: np.ndarray, reach: float) -> None:
    """Draw the region in which the robot's centre cannot be, in a square of half-side `reach` (m)."""
    x, y = (np.linspace(c - reach, c + reach, N_FIELD_POINTS) for c in center)
    distance = np.array([[clearance(a, b, field)[0] for a in x] for b in y])
    if distance.min() < 0:
        axes.contourf(x, y, distance, levels=[distance.min(), 0.0], colors=[OBSTACLE], zorder=0)


def _draw_state_space(axes: Axes, extremal: Extremal, sweeps: Sequence[Iteration]) -> None:
    """Draw the first two states against each other, or a single state over time."""
    times = _dense_times(extremal)
    states = extremal.evaluate(times)[0]
    names = _labels(extremal.problem.system)[: extremal.problem.system.n]

    def project(times: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (times, states[:, 0]) if states.shape[1] == 1 else (states[:, 0], states[:, 1])

    _draw_sweeps(axes, extremal.problem, sweeps, project)
    x, y = project(times, states)
    axes.plot(x, y, color=OPTIMUM, linewidth=1.8, zorder=3)
    for k, color in ((0, START), (-1, GOAL)):
        axes.plot(x[k], y[k], "o", color=color, markersize=7, zorder=4)
    axes.set(xlabel=names[0] if len(names) > 1 else "time", ylabel=names[1] if len(names) > 1 else names[0])
    axes.grid(alpha=0.3)


def _draw_sweeps(
    axes: Axes,
    problem: OptimalControlProblem,
    sweeps: Sequence[Iteration],
    project: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> None:
    """Draw feasible paths and nodes of selected sweeps; `project` maps times (K,) and states (K, n) to the axes."""
    for k, color in _sweep_colors(sweeps).items():
        times, nodes = sweeps[k].times, sweeps[k].nodes
        assert times is not None and nodes is not None
        axes.plot(
            *project(*dense_path(problem, times, nodes, N_POINTS)), color=color, linewidth=1.0, label=f"sweep {k}"
        )
        axes.plot(*project(times, nodes[:, : problem.system.n]), ".", color=color, markersize=3.5)


def _sweep_colors(sweeps: Sequence[Iteration]) -> dict[int, Any]:
    """Indices of the sweeps to draw, and their colours from light to dark."""
    numbers = select_sweeps(len(sweeps), N_FIRST_SWEEPS, MAX_SWEEPS)
    return dict(zip(numbers, colormaps["viridis_r"](np.linspace(0.12, 0.92, len(numbers))), strict=True))


def _draw_costs(axes: Axes, extremal: Extremal, sweeps: Sequence[Iteration]) -> None:
    """Draw the cost of each iterate, sweeps in the colours of their paths, and the number of segments if it changes."""
    rows = [row for row in extremal.history if np.isfinite(row.cost)]
    costs, phases = np.array([row.cost for row in rows]), np.array([row.phase for row in rows])
    swept = np.flatnonzero(np.isin(phases, SWEEPS))
    # The path of a sweep is feasible: its cost is below the extremal's only by the end errors of its arcs. The path of
    # a Newton step is not feasible.
    distance = np.abs(costs - extremal.cost)
    distance[swept] = costs[swept] - extremal.cost
    smallest = MIN_DISTANCE * (1 + abs(extremal.cost))
    # A failure may cost more than its sweeps.
    logarithmic = distance.max() > MAX_LINEAR_SPREAD * smallest and distance.min() > -MAX_LINEAR_SPREAD * smallest
    values = np.maximum(distance, smallest) if logarithmic else costs
    label = "sweep (colour of its path)"
    axes.plot(swept, values[swept], color=EDGE, linewidth=0.8, marker=".", markersize=3, zorder=1, label=label)
    for k, color in _sweep_colors(sweeps).items():
        axes.plot(swept[k], values[swept[k]], "o", color=color, markersize=5)
    for phase, marker, label in (("reduce", "s", "nodes removed"), ("newton", "x", "Newton step")):
        numbers = np.flatnonzero(phases == phase)
        if len(numbers):
            style = {"markersize": 8 if marker == "s" else 5, "markerfacecolor": "none", "markeredgecolor": OPTIMUM}
            axes.plot(numbers, values[numbers], marker, label=label, **style)
    if logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(numticks=5))
        axes.yaxis.set_minor_locator(NullLocator())
    axes.set(
        xlabel="sweep" if len(swept) == len(rows) else "iteration", ylabel="$|J_k - J|$" if logarithmic else "$J_k$"
    )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    segments = [row.segments for row in rows]
    if len(set(segments)) > 1:
        side = axes.twinx()
        side.step(range(len(rows)), segments, where="mid", color=OBSTACLE, linewidth=2.0)
        side.set(ylabel="segments", ylim=(0, 1.1 * max(segments)))
        side.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        side.yaxis.label.set_color(EDGE)
        side.tick_params(colors=EDGE)
        # Draw the steps behind the costs.
        axes.set_zorder(side.get_zorder() + 1)
        axes.patch.set_visible(False)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.97), ncols=3, frameon=False, fontsize=8)
