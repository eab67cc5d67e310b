r"""The checker of lower bounds: whoever trusts this module and those it imports need not trust how a proof was found.

Notation. q = (x, y, theta); a path has the velocity x' = v cos(theta), y' = v sin(theta), theta' = omega and costs
J = int (c + 1/2 (r_v v^2 + r_w omega^2) + Phi(x, y)) dt. E > 0 is a number, n(q) = sqrt(2 (E + Phi)), and
grad_H S = ((cos(theta) S_x + sin(theta) S_y) / sqrt(r_v), S_theta / sqrt(r_w)) is the horizontal gradient.

**Theorem.** Let A be a set of closed cells of configuration space, periodic in theta, and let S be a function that is
Lipschitz continuous along paths in A and satisfies

    |grad_H S(q)| <= n(q)     almost everywhere along paths in A.                                                  (1)

Then every collision-free path in A from q_0 to q_1 in time T costs J >= S(q_1) - S(q_0) + (c - E) T.

Proof. By Cauchy's inequality, dS/dt <= |grad_H S| |(sqrt(r_v) v, sqrt(r_w) omega)| <= n |...|, and by that of
arithmetic and geometric means, n |...| <= 1/2 n^2 + 1/2 (r_v v^2 + r_w omega^2) = E + Phi + 1/2 (...). Integrate.

Limits of the controls only exclude paths, so the bound holds with them. With a free horizon E = c is used, and the last
term vanishes. Write L for V + (E - c) T: to prove J >= V is to prove S(q_1) - S(q_0) >= L for all paths with J < V.

**The functions.** A quadratic spline s satisfies (1) on a cell if `gradient_ratios` proves it there. Near the start q_0
it cannot. Let N be the gauge of `leapnav.experts.proofs.gauge`, and C the cells of A that are connected to the cell of
q_0 by cells that contain a collision-free point and may meet {N < b}. The function g = m min(N, b) on C, g = m b
elsewhere, is continuous on A, since the cells of A that adjoin C do not meet {N < b}; and it satisfies (1) if
m^2 <= 2 (E + Phi) on C. Let D be a part of C with s - k <= g on D. Then S = max(g, s - k) satisfies (1) on A if s does
on A without D: on D, S = g, and elsewhere S is the maximum of two functions that satisfy (1), and has the derivative of
one of them at almost every time. S(q_0) = 0, since q_0 is in D. `source_offset` computes k. The same holds for the
goal, since (1) does not change with the sign of S.

**Exclusion.** Let S_0 and S_1 be such functions for the start and the goal. A path in A with J < V through q satisfies
S_0(q) + S_1(q) < L. So if s_0 + s_1 - k_0 - k_1 >= L on a cell, or s_0 - k_0 >= L, or s_1 - k_1 >= L, no path with
J < V that stays in A meets the cell: all of them stay in the cells that are left, and among these in those that are
connected with the cell of q_0 by faces, edges or corners. A proof consists of stages. The first has for A all cells
that contain a collision-free point, each further one the cells that are left, after the spacing was halved or not.
J >= V is proved once the cell of the start or of the goal is not left, or s_0(q_1) - k_0 >= L.

**Rounding.** Functions of cells are bounded by their control points, whose rounding errors are bounded by
`Functionals.rounding`. Other errors are covered by margins: `ROUNDING` of the modules used, and of this one for L.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import NOTHING
from leapnav.experts.proofs.cells import (
    BLOCK,
    EMPTY,
    LAYOUT,
    MASKS,
    VALUES,
    CellSet,
    Grid,
    Layout,
    control_points,
    gather,
    make_layout,
    whole,
)
from leapnav.experts.proofs.gauge import Source, make_source
from leapnav.experts.proofs.inequality import Functionals, functionals, gradient_ratios
from leapnav.experts.proofs.near_source import cells_near, excess
from leapnav.experts.proofs.proof import Pose, Proof, ProofError, Spline, find_ends
from leapnav.experts.proofs.running_cost import RunningCost, running_cost

ROUNDING = 1e-9  # relative to L and its terms, or to 1 if that is larger
SPLINE_ROUNDING = 1e-14  # of sums of coefficients, relative to the largest coefficient: 90 units
MAX_LEVEL = 8
MAX_NUMBER = 1e12  # of V, E and the coefficients, so that nothing overflows
MAX_PRODUCT = 1e100  # of rounding errors of control points, for the same reason
MAX_CELLS = 1e9  # of level 0


@dataclass(frozen=True)
class Bound:
    """A function S of the theorem in a stage: max(g, scale * s - offset).

    Attributes:
        values, scale: the spline s.
        offset: k.

    """

    values: np.ndarray
    scale: float
    offset: float


def check_proof(proof: Proof) -> float:
    """Check a proof and return the lower bound that it proves.

    Raises:
        ProofError: the proof is wrong or incomplete; the message names the stage and the fault.
        ValueError: lower bounds cannot be proved for such a scenario.

    """
    scenario = proof.scenario
    ends = find_ends(scenario)
    limit = length_limit(proof)
    _check_grid(proof)
    cells = CellSet.full(Grid.over(scenario.arena, proof.spacing, proof.headings))
    level, table = 0, cast(Functionals | None, None)
    for number, stage in enumerate(proof.stages):
        name = f"stage {number}"
        if not (isinstance(cast(object, stage.level), int) and level <= stage.level <= MAX_LEVEL):
            raise ProofError(f"{name}: level: expected {level} to {MAX_LEVEL}, got {stage.level}")
        while level < stage.level:
            cells, level, table = cells.refined(), level + 1, None
        full = whole(cells.grid, _stage_layout(cells.grid, stage.blocks, name))
        cost = running_cost(scenario, cells.grid, cells.columns() | full.columns())
        free = full.without(~np.isfinite(cost.lowest)).mask
        placed = cells.without(~np.isfinite(cost.lowest)).on(full.layout)
        if placed is None:
            raise ProofError(f"{name}: blocks: some cells are neither excluded nor in a block")
        cells = placed
        if table is None:
            table = functionals(cells.grid, scenario.robot.metric(scenario.cost), cost.squares.shape[2])
        bounds = []
        for side, spline, pose in (("start", stage.start, ends[0]), ("goal", stage.goal, ends[1])):
            try:
                bounds.append(prove_bound(proof, spline, pose, cells, free, cost, table))
            except ProofError as error:
                raise ProofError(f"{name}: {side}: {error}") from None
        cells = without_excluded(cells, bounds[0], bounds[1], limit, ends[0])
        if is_proved(cells, ends, bounds[0], limit):
            return proof.value
    raise ProofError(f"value: the stages do not prove {proof.value!r}")


def _check_grid(proof: Proof) -> None:
    """Check that the cells of level 0 cover configuration space.

    Raises:
        ProofError: they may not.

    """
    x_min, y_min, x_max, y_max = proof.scenario.arena
    spacing, headings = proof.spacing, proof.headings
    if not 0.0 < spacing <= max(x_max - x_min, y_max - y_min):
        raise ProofError(f"spacing: expected a positive number, at most the size of the arena, got {spacing!r}")
    if not (isinstance(cast(object, headings), int) and headings > 0 and headings % BLOCK == 0):
        raise ProofError(f"headings: expected a multiple of {BLOCK}, got {headings!r}")
    if not headings * ((x_max - x_min) / spacing) * ((y_max - y_min) / spacing) <= MAX_CELLS:
        raise ProofError(f"spacing, headings: expected at most {MAX_CELLS:g} cells, got {spacing!r} and {headings!r}")


def length_limit(proof: Proof) -> float:
    """Return L, rounded up.

    Raises:
        ProofError: E or V is no number with which a bound can be proved.

    """
    scenario, energy = proof.scenario, proof.energy
    weight = scenario.cost.time_weight
    if not (0 < energy <= MAX_NUMBER and abs(proof.value) <= MAX_NUMBER):
        raise ProofError(f"energy, value: expected a positive and a finite number, got {energy!r} and {proof.value!r}")
    if scenario.horizon is None and energy != weight:
        raise ProofError(f"energy: expected the time weight {weight!r}, since the horizon is free, got {energy!r}")
    shift = 0.0 if scenario.horizon is None else (energy - weight) * scenario.horizon
    return proof.value + shift + ROUNDING * max(1.0, abs(proof.value), abs(shift))


def _stage_layout(grid: Grid, blocks: np.ndarray, name: str) -> Layout:
    """Return the layout of a stage.

    Raises:
        ProofError: the blocks are not distinct positions in the grid, in ascending order.

    """
    shape = np.array([grid.headings, grid.columns, grid.lines]) // BLOCK
    if blocks.ndim != 2 or blocks.shape[1:] != (3,) or (blocks < 0).any() or (blocks >= shape).any():
        raise ProofError(f"{name}: blocks: expected positions in a grid of {shape.tolist()} blocks")
    layout = make_layout(grid, blocks)
    if not np.array_equal(layout.blocks, blocks):
        raise ProofError(f"{name}: blocks: expected distinct blocks in ascending order")
    return layout


def prove_bound(
    proof: Proof,
    spline: Spline,
    pose: Pose,
    cells: CellSet,
    free: np.ndarray,
    cost: RunningCost,
    table: Functionals,
) -> Bound:
    """Prove that a spline satisfies the inequality, and return the function S.

    Args:
        proof: the proof.
        spline: the spline, on the layout of the cells.
        pose: the start or the goal.
        cells: A, on the layout of the stage.
        free (m, 8, 8, 8): the cells of the layout that contain a collision-free point.
        cost: lower bounds of Phi.
        table: the functionals of the grid.

    Raises:
        ProofError: it does not satisfy the inequality.

    """
    if spline.values.shape != cells.mask.shape or spline.values.dtype != np.float32:
        raise ProofError(f"values: expected float32 of the shape {cells.mask.shape}, got {spline.values.shape}")
    numbers = spline.scale, spline.radius, spline.limit
    if not (np.isfinite(spline.values).all() and np.isfinite(numbers).all()):
        raise ProofError("expected finite values, scale, radius and limit")
    if not (spline.scale > 0 and 0 < spline.radius <= spline.limit):
        raise ProofError("expected a positive scale and 0 < radius <= limit")
    if not spline.scale * max(EMPTY, float(np.abs(spline.values).max())) <= MAX_NUMBER:
        raise ProofError(f"expected coefficients of at most {MAX_NUMBER:g}")
    spline = replace(spline, values=np.ascontiguousarray(spline.values))
    values = spline.values
    # Products of coefficients and functionals are finite, and so are the squares of their sums.
    if not table.rounding * max(EMPTY, float(np.abs(values).max())) <= MAX_PRODUCT:
        raise ProofError("the cells are too small, or the weights of the cost too different")
    try:
        source = make_source(pose, proof.scenario.robot.metric(proof.scenario.cost), spline.limit)
    except ValueError as error:
        raise ProofError(f"limit: {error}") from None
    exempt = cells_near(source, cells, free, spline.radius)
    if not CellSet(cells.grid, cells.layout, exempt).contains(pose):
        raise ProofError("the cell of the pose is not in the set")
    others = cells.mask & ~exempt
    allowed = (1.0 - 1e-12) / spline.scale
    ratios = np.zeros(cells.mask.shape, dtype=np.float32)
    worst = gradient_ratios(values, cells.layout, others, cost, table, proof.energy, allowed, ratios)[1]
    if not worst <= allowed:
        k, i, j = worst_cell(cells, ratios)
        x, y = cells.grid.x + (i + 0.5) * cells.grid.spacing, cells.grid.y + (j + 0.5) * cells.grid.spacing
        raise ProofError(
            f"the gradient may be {worst * spline.scale:.6g} times as large as allowed at ({x:.4g}, {y:.4g}, "
            f"{(k + 0.5) * cells.grid.angle:.4g})"
        )
    slope = source_slope(source, cells, free, cost, proof.energy, spline.limit)
    return Bound(values, spline.scale, source_offset(spline, source, cells, exempt, slope))


def source_offset(spline: Spline, source: Source, cells: CellSet, exempt: np.ndarray, slope: float) -> float:
    """Return k: an upper bound of the spline minus g on the cells where the inequality is not required."""
    args = (spline.values, cells.layout, exempt, source, cells.grid.geometry, spline.scale, slope, spline.limit)
    magnitude = spline.scale * max(EMPTY, float(np.abs(spline.values).max()))
    return max(excess(*args), 0.0) + ROUNDING + SPLINE_ROUNDING * magnitude


def source_slope(
    source: Source, cells: CellSet, free: np.ndarray, cost: RunningCost, energy: float, limit: float
) -> float:
    """Return m: the square root of a lower bound of 2 (E + Phi) on the cells that may meet {N < limit}."""
    near = cells_near(source, cells, free, limit)
    blocks = cells.layout.blocks
    lowest = cost.lowest.reshape(cost.lowest.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
    lowest = np.broadcast_to(lowest[blocks[:, 1], blocks[:, 2]][:, None], near.shape)
    return float(np.sqrt(2.0 * (energy + lowest[near].min(initial=np.inf if near.any() else 0.0)))) * (1.0 - 1e-12)


def worst_cell(cells: CellSet, ratios: np.ndarray) -> tuple[int, int, int]:
    """Return the indices of the cell with the largest ratio."""
    b, k, i, j = np.unravel_index(int(ratios.argmax()), ratios.shape)
    block = cells.layout.blocks[b]
    return int(block[0] * BLOCK + k), int(block[1] * BLOCK + i), int(block[2] * BLOCK + j)


def without_excluded(cells: CellSet, start: Bound, goal: Bound, limit: float, pose: Pose) -> CellSet:
    """Return the cells that are not excluded and are connected with the cell of the start, whose pose is given."""
    left = CellSet(cells.grid, cells.layout, cells.mask & ~(shortest_lengths(cells, start, goal) >= limit))
    return left.connected_with(pose)


def shortest_lengths(cells: CellSet, start: Bound, goal: Bound) -> np.ndarray:
    """Return a lower bound of the length of paths through each cell (m, 8, 8, 8), 0 for other cells.

    It is the largest L with which the cell is excluded.
    """
    lengths = np.zeros(cells.mask.shape)
    shifts = Shifts(start.scale, goal.scale, start.offset, goal.offset)
    _shortest(start.values, goal.values, cells.layout, cells.mask, shifts, lengths)
    return lengths


class Shifts(NamedTuple):
    """Factors and offsets of both splines."""

    start_scale: float
    goal_scale: float
    start: float
    goal: float


SHIFTS = record_type(Shifts, **dict.fromkeys(Shifts._fields, float64))


@kernel(NOTHING(VALUES, VALUES, LAYOUT, MASKS, SHIFTS, float64[:, :, :, ::1]))
def _shortest(start, goal, layout, mask, shifts, lengths):
    """See `shortest_lengths`."""
    shape = (BLOCK + 2, BLOCK + 2, BLOCK + 2)
    first, second, total = np.empty(shape), np.empty(shape), np.empty(shape)
    points = np.empty((3, 3, 3))
    for b in range(len(mask)):
        if not mask[b].any():
            continue
        gather(start, layout, b, first)
        gather(goal, layout, b, second)
        first *= shifts.start_scale
        second *= shifts.goal_scale
        total[:] = first + second
        for k in range(BLOCK):
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if mask[b, k, i, j]:
                        lengths[b, k, i, j] = max(
                            control_points(total, k + 1, i + 1, j + 1, points) - shifts.start - shifts.goal,
                            control_points(first, k + 1, i + 1, j + 1, points) - shifts.start,
                            control_points(second, k + 1, i + 1, j + 1, points) - shifts.goal,
                        )


def is_proved(cells: CellSet, ends: tuple[Pose, Pose], start: Bound, limit: float) -> bool:
    """Whether no path that stays in the cells can be cheaper: the ends are excluded, or the goal is too far."""
    if not all(map(cells.contains, ends)):
        return True
    return start.scale * spline_value(start.values, cells, ends[1]) - start.offset >= limit + ROUNDING


def spline_value(values: np.ndarray, cells: CellSet, pose: Pose) -> float:
    """Return the value of a spline at a pose in a cell of the set."""
    k, i, j = cells.grid.cell(pose)
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    slot = int(cells.layout.slots[k // BLOCK, i // BLOCK, j // BLOCK])
    gather(values, cells.layout, slot, local)
    around = local[k % BLOCK : k % BLOCK + 3, i % BLOCK : i % BLOCK + 3, j % BLOCK : j % BLOCK + 3]
    x, y, heading = pose
    # Relative to the cell; a heading just below 0 is 2 pi modulo 2 pi by rounding, in cell 0.
    places = (
        heading % (2 * np.pi) / cells.grid.angle,
        (x - cells.grid.x) / cells.grid.spacing,
        (y - cells.grid.y) / cells.grid.spacing,
    )
    weights = [np.array([0.5 * (1 - t) ** 2, 0.5 + t * (1 - t), 0.5 * t * t]) for t in np.mod(places, 1.0)]
    return float(np.einsum("a,b,c,abc", *weights, around))
