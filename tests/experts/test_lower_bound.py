"""Lower bounds, their proofs, and attacks on the checker."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import DISC_AND_TRIANGLE as SCENARIO

from leapnav.cli import main
from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.layout import read_header
from leapnav.envs.field.proximity import proximity_value
from leapnav.envs.scenarios.families import sample_scenario
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts import LowerBound, Optimum, Proof, check_proof, find_optimum, lower_bound
from leapnav.experts.bounds.plotting import plot_tube
from leapnav.experts.proofs.cells import BLOCK, CellSet, Grid, gather, make_layout, scatter
from leapnav.experts.proofs.checker import spline_value
from leapnav.experts.proofs.gauge import make_source
from leapnav.experts.proofs.inequality import functionals, gradient_ratios
from leapnav.experts.proofs.near_source import cells_near
from leapnav.experts.proofs.proof import ProofError, Spline, Stage
from leapnav.experts.proofs.running_cost import running_cost

VERTEX = (2.0, 3.4)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def optimum() -> Optimum:
    return find_optimum(SCENARIO)


@pytest.fixture(scope="module")
def bound(optimum: Optimum) -> LowerBound:
    return lower_bound(SCENARIO, optimum, gap=0.06)


def test_the_gap_is_proved_and_the_proof_is_accepted(bound: LowerBound, optimum: Optimum):
    assert bound.gap == pytest.approx(0.06, abs=1e-9)
    assert bound.value == pytest.approx(0.94 * optimum.cost)
    assert 0.9 < bound.excluded < 1.0
    assert check_proof(bound.proof) == bound.value


def test_a_saved_proof_is_the_same(bound: LowerBound, tmp_path: Path):
    bound.proof.save(tmp_path / "proof")
    loaded = Proof.load(tmp_path / "proof")
    assert loaded.scenario == bound.proof.scenario
    assert (loaded.value, loaded.energy, len(loaded.stages)) == (
        bound.proof.value,
        bound.proof.energy,
        len(bound.proof.stages),
    )
    assert check_proof(loaded) == bound.value


def test_the_time_may_be_unlimited(optimum: Optimum):
    assert lower_bound(SCENARIO, optimum, gap=0.2, time_limit=math.inf).gap == pytest.approx(0.2, abs=1e-12)


@pytest.mark.parametrize("time_limit", [1e-3, 0.5])
def test_an_early_answer_is_proved(optimum: Optimum, time_limit: float):
    early = lower_bound(SCENARIO, optimum, gap=0.001, time_limit=time_limit)
    assert 0.001 < early.gap < 0.5
    assert early.value <= optimum.cost
    assert check_proof(early.proof) == early.value


def test_a_bound_that_starts_from_a_local_optimum_is_below_the_optimum(optimum: Optimum):
    """The gap to a more expensive local optimum is at least its difference from the optimum."""
    local = optimum.alternatives[-1]
    found = lower_bound(SCENARIO, local, gap=1e-3, time_limit=1.5)
    assert found.value <= optimum.cost
    assert found.gap >= 1.0 - optimum.cost / local.cost


@pytest.mark.parametrize("robot", ["unicycle", "differential_drive"])
def test_free_horizon(robot: str):
    scenario = Scenario.from_dict(
        SCENARIO.to_dict() | {"horizon": None, "cost": {"time_weight": 0.5}, "robot": {"model": robot}}
    )
    optimum = find_optimum(scenario)
    found = lower_bound(scenario, optimum, gap=0.1)
    assert found.gap == pytest.approx(0.1)
    assert found.value < optimum.cost
    assert check_proof(found.proof) == found.value


def test_a_duality_gap_is_estimated_and_limits_the_bound():
    """A slow path through a narrow passage is expensive at this horizon, and so is a detour at its own energy."""
    wall = (1.9, 3.1)
    scenario = Scenario(
        arena=(0.0, 0.0, 5.0, 5.0),
        start=(0.8, 1.0, 0.0),
        goal=(4.2, 1.0, 0.0),
        horizon=10.0,
        obstacles=tuple(
            {"polygon": {"vertices": ((wall[0], low), (wall[1], low), (wall[1], high), (wall[0], high))}}
            for low, high in ((0.0, 0.66), (1.34, 3.2))
        ),
    )
    optimum = find_optimum(scenario)
    found = lower_bound(scenario, optimum, gap=0.2, time_limit=5.0)
    assert 0.05 < found.duality_gap < 0.1
    assert found.gap > found.duality_gap
    assert found.value > 0.2 * optimum.cost  # reached in the time limit also on a busy machine
    assert check_proof(found.proof) == found.value
    shorter = Scenario.from_dict(scenario.to_dict() | {"horizon": 4.0})
    assert lower_bound(shorter, gap=0.5).duality_gap < 1e-6


# Attacks: each changed proof must be refused.


def changed(proof: Proof, number: int, **fields: Any) -> Proof:
    """Return the proof with other fields of a stage."""
    stages = list(proof.stages)
    stages[number] = replace(stages[number], **fields)
    return replace(proof, stages=tuple(stages))


def with_bump(proof: Proof, number: int, block: int, cell: tuple[int, int, int], height: float) -> Proof:
    """Return the proof with one coefficient of the start's spline changed."""
    spline = proof.stages[number].start
    values = spline.values.copy()
    values[(block, *cell)] += np.float32(height)
    return changed(proof, number, start=replace(spline, values=values))


def first_cells(proof: Proof) -> tuple[CellSet, np.ndarray]:
    """Return the cells of the first stage, and which of them must satisfy the inequality."""
    grid = Grid.over(SCENARIO.arena, proof.spacing, proof.headings)
    full = CellSet.full(grid)
    cost = running_cost(SCENARIO, grid, full.columns())
    cells = full.without(~np.isfinite(cost.lowest)).on(make_layout(grid, proof.stages[0].blocks))
    assert cells is not None
    spline = proof.stages[0].start
    source = make_source(SCENARIO.start, SCENARIO.robot.metric(SCENARIO.cost), spline.limit)
    return cells, cells.mask & ~cells_near(source, cells, cells.mask, spline.radius)


def nearest_cell(proof: Proof, x: float, y: float, heading: float) -> tuple[int, tuple[int, int, int]]:
    """Return the block and the local indices of the cell nearest to a pose on which the inequality is required."""
    cells, required = first_cells(proof)
    block, k, i, j = np.nonzero(required)
    origin = cells.layout.blocks[block] * BLOCK
    grid = cells.grid
    px = grid.x + (origin[:, 1] + i + 0.5) * grid.spacing
    py = grid.y + (origin[:, 2] + j + 0.5) * grid.spacing
    turn = (origin[:, 0] + k + 0.5) * grid.angle - heading
    distance = np.hypot(px - x, py - y) + np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    best = int(distance.argmin())
    return int(block[best]), (int(k[best]), int(i[best]), int(j[best]))


@pytest.mark.parametrize(
    ("place", "pose"),
    [
        ("inside the arena", (3.5, 1.5, 2.0)),
        ("at the seam of the heading", (3.5, 1.5, 0.0)),
        ("on the other side of the seam", (3.5, 1.5, 2 * math.pi - 1e-3)),
        ("in the corner of two walls", (4.75, 0.25, 1.0)),
        ("beside the vertex of a polygon", (VERTEX[0] + 0.26, VERTEX[1], 3.0)),
        ("between an obstacle and a wall", (0.3, 3.6, 1.5)),
    ],
)
def test_a_violation_in_one_cell_is_refused(bound: LowerBound, place: str, pose: tuple[float, float, float]):
    block, cell = nearest_cell(bound.proof, *pose)
    height = 3.0 * bound.proof.spacing * math.sqrt(2 * (bound.proof.energy + 3.0))
    for sign in (1, -1):
        with pytest.raises(ProofError, match="stage 0: start: the gradient"):
            check_proof(with_bump(bound.proof, 0, block, cell, sign * height))


def test_a_violation_at_a_cell_edge_is_refused(bound: LowerBound):
    """Two neighbouring coefficients, so that the gradient is too large only near the face between their cells."""
    block, cell = nearest_cell(bound.proof, 3.5, 1.5, 1.6)
    step = 1.0 * bound.proof.spacing * math.sqrt(2 * (bound.proof.energy + 1.0))
    once = with_bump(bound.proof, 0, block, cell, step)
    other = (cell[0], cell[1], cell[2] + (1 if cell[2] < BLOCK - 1 else -1))
    with pytest.raises(ProofError, match="stage 0: start: the gradient"):
        check_proof(with_bump(once, 0, block, other, -step))


def test_a_bump_of_a_millionth_in_the_tightest_cell_is_refused(bound: LowerBound):
    """The coefficient and the sign that increase the largest gradient ratio of the stage."""
    proof = bound.proof
    spline = proof.stages[0].start
    cells, required = first_cells(proof)
    cost = running_cost(SCENARIO, cells.grid, cells.columns())
    table = functionals(cells.grid, SCENARIO.robot.metric(SCENARIO.cost), cost.squares.shape[2])
    ratios = np.zeros(required.shape, dtype=np.float32)
    gradient_ratios(spline.values, cells.layout, required, cost, table, proof.energy, 0.0, ratios)
    block, k, i, j = (int(v) for v in np.unravel_index(int(ratios.argmax()), ratios.shape))
    local = np.empty((BLOCK + 2, BLOCK + 2, BLOCK + 2))
    gather(spline.values, cells.layout, block, local)
    around = local[k : k + 3, i : i + 3, j : j + 3].ravel()
    heading, column, line = cells.layout.blocks[block] * BLOCK + (k, i, j)
    best = (0.0, np.zeros(27))
    for part, phi in enumerate([cost.lowest[column, line], *cost.squares[column, line].ravel()]):
        if part > 0 and np.isfinite(phi):
            matrix = table.matrices[heading, part]
            points = (around - around[13]) @ matrix
            square = (points[:36] ** 2 + points[36:72] ** 2) / (2 * (proof.energy + phi))
            r = int(square.argmax())
            best = max(
                best, (square[r], points[r] * matrix[:, r] + points[36 + r] * matrix[:, 36 + r]), key=lambda x: x[0]
            )
    change = int(np.abs(best[1]).argmax())
    a, b, c = np.unravel_index(change, (3, 3, 3))
    values = spline.values.copy()
    # The largest change below a millionth of the cost that single precision represents.
    local[k + a, i + b, j + c] += math.copysign(1e-6 * bound.value, best[1][change])
    scatter(local, cells.layout, block, values)
    assert np.abs(values - spline.values).max() < 2e-6 * bound.value
    with pytest.raises(ProofError, match="stage 0: start: the gradient"):
        check_proof(changed(proof, 0, start=replace(spline, values=values)))
    with pytest.raises(ProofError, match="stage 0: start: the gradient"):
        check_proof(changed(proof, 0, start=replace(spline, scale=spline.scale * (1 + 1e-6))))


def test_other_false_claims_are_refused(bound: LowerBound, optimum: Optimum):
    proof = bound.proof
    first = proof.stages[0]
    everything = 50.0
    nan = first.start.values.copy()
    nan[0, 0, 0, 0] = np.nan
    for false, message in (
        (replace(proof, value=optimum.cost), "do not prove|gradient|neither excluded"),
        (replace(proof, value=math.nan), "finite"),
        (replace(proof, energy=2 * proof.energy), "stage|do not prove"),
        (replace(proof, energy=-1.0), "positive"),
        (replace(proof, headings=proof.headings + 4), "headings"),
        (replace(proof, spacing=math.nan), "spacing"),
        (replace(proof, spacing=-0.2), "spacing"),
        (replace(proof, spacing=1e-5), "cells"),
        (replace(proof, energy=1e300), "energy"),
        (changed(proof, 0, start=replace(first.start, scale=math.inf)), "finite values, scale"),
        (replace(proof, stages=()), "do not prove"),
        (replace(proof, stages=proof.stages[-1:]), "neither excluded nor in a block|gradient"),
        (changed(proof, 0, blocks=first.blocks[:-1]), "neither excluded|expected float32"),
        (changed(proof, 0, blocks=first.blocks[::-1].copy()), "ascending"),
        (changed(proof, 0, blocks=first.blocks + 1000), "positions"),
        (changed(proof, 0, level=99), "level"),
        (changed(proof, 0, start=replace(first.start, values=nan)), "finite values"),
        (changed(proof, 0, start=replace(first.start, values=first.start.values.astype(float))), "float32"),
        (changed(proof, 0, start=replace(first.start, scale=-1.0)), "positive scale"),
        (changed(proof, 0, start=replace(first.start, radius=first.start.limit * 2)), "radius"),
        (changed(proof, 0, start=replace(first.start, radius=1e-9, limit=1e-9)), "limit: radius"),
    ):
        with pytest.raises(ProofError, match=message):
            check_proof(false)
    # If all cells count as near the source, the inequality is not required anywhere, but nothing is proved either.
    exempt = tuple(
        replace(
            stage,
            start=replace(stage.start, radius=everything, limit=everything),
            goal=replace(stage.goal, radius=everything, limit=everything),
        )
        for stage in proof.stages
    )
    with pytest.raises(ProofError):
        check_proof(replace(proof, stages=exempt))


@pytest.mark.parametrize(("height", "scale"), [(3e38, 1.0), (1e20, 1.0), (1e15, 1.0), (1e9, 1.0), (2.0, 1e308)])
def test_a_large_constant_proves_nothing(bound: LowerBound, height: float, scale: float):
    """Its gradient is 0, and sums with it have large rounding errors."""
    stage = bound.proof.stages[0]
    flat = replace(stage.start, values=np.full_like(stage.start.values, height), scale=scale)
    false = changed(replace(bound.proof, value=1e-3, stages=(stage,)), 0, start=flat, goal=flat)
    with pytest.raises(ProofError):
        check_proof(replace(false, energy=1e-6))


def test_a_goal_heading_just_below_zero_is_in_the_first_cell(bound: LowerBound):
    cells, _ = first_cells(bound.proof)
    values = np.random.default_rng(0).normal(size=cells.mask.shape).astype(np.float32)
    at_zero = spline_value(values, cells, (2.0, 2.0, 0.0))
    for heading in (-1e-16, -2.4e-16, 2 * math.pi, -1e-12):
        assert spline_value(values, cells, (2.0, 2.0, heading)) == pytest.approx(at_zero, abs=1e-6)


def test_phi_deep_in_an_obstacle_does_not_block_free_squares():
    """Phi overflows at the centre of a square of which another part is free."""
    scenario = Scenario.from_dict(
        SCENARIO.to_dict()
        | {"cost": {"proximity_scale": 1e-4}, "obstacles": [{"circle": {"center": [2.6, 2.2], "radius": 0.4}}]}
    )
    grid = Grid.over(scenario.arena, 4.0, 8)
    cost = running_cost(scenario, grid, np.ones((grid.columns, grid.lines), dtype=bool))
    for x, y in np.random.default_rng(0).uniform(0.3, 4.7, (500, 2)):
        if clearance(x, y, scenario.field)[0] > 0:
            assert np.isfinite(cost.lowest[int((x - grid.x) / 4.0), int((y - grid.y) / 4.0)])


def test_the_start_and_the_goal_cannot_be_exchanged_for_poses_that_are_closer(bound: LowerBound):
    moved = SCENARIO.to_dict() | {"goal": [3.8, 3.6, 1.2]}
    with pytest.raises(ProofError):
        check_proof(replace(bound.proof, scenario=Scenario.from_dict(moved)))


def test_removing_an_obstacle_refutes_the_proof(bound: LowerBound):
    fewer = SCENARIO.to_dict()
    fewer["obstacles"] = fewer["obstacles"][1:]
    with pytest.raises(ProofError, match=r"gradient|neither"):
        check_proof(replace(bound.proof, scenario=Scenario.from_dict(fewer)))


# The theorem, checked against paths.


def test_the_functions_bound_the_cost_of_random_paths(bound: LowerBound, rng: np.random.Generator):
    """Along random arcs among the cells of the first stage, S grows by at most the length in the metric n |dq|."""
    proof = bound.proof
    cells, required = first_cells(proof)
    spline = proof.stages[0].start
    field, energy = SCENARIO.field, proof.energy
    r_v, r_w = SCENARIO.robot.metric(SCENARIO.cost)
    n_steps, checked, closest = 200, 0, 0.0
    for _ in range(300):
        x, y, heading = *rng.uniform(0.3, 4.7, 2), rng.uniform(-math.pi, math.pi)
        v, omega = rng.normal(size=2) * (1.0, 1.5)
        poses = [(x, y, heading)]
        for _ in range(n_steps):
            x, y = x + v / n_steps * math.cos(heading), y + v / n_steps * math.sin(heading)
            heading += omega / n_steps
            poses.append((x, y, heading))
        if not all(clearance(*pose[:2], field)[0] > 0 for pose in poses):
            continue
        places = [cells.grid.cell(pose) for pose in poses]
        slots = [cells.layout.slots[k // BLOCK, i // BLOCK, j // BLOCK] for k, i, j in places]
        if not all(required[s, k % BLOCK, i % BLOCK, j % BLOCK] for s, (k, i, j) in zip(slots, places, strict=True)):
            continue
        slowness = [
            math.sqrt(2 * (energy + proximity_value(*pose[:2], read_header(field)["radius"], field))) for pose in poses
        ]
        length = float(np.mean(slowness)) * math.sqrt(r_v * v * v + r_w * omega * omega)
        gain = spline.scale * (
            spline_value(spline.values, cells, poses[-1]) - spline_value(spline.values, cells, poses[0])
        )
        assert abs(gain) <= length * (1 + 1e-3)
        checked += 1
        closest = max(closest, abs(gain) / length)
    assert checked > 50
    assert closest > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_every_local_optimum_costs_more_than_the_bound(seed: int):
    scenario = sample_scenario("clutter", seed)
    optimum = find_optimum(scenario)
    found = lower_bound(scenario, optimum, gap=0.25, time_limit=30.0)
    assert all(found.value <= local.cost for local in (optimum, *optimum.alternatives, *optimum.doubts))


# Input, files, command line.


def test_what_is_not_supported_is_refused(optimum: Optimum):
    fields = SCENARIO.to_dict()
    with pytest.raises(ValueError, match="robot: lower bounds need a unicycle or a differential_drive, got 'car'"):
        lower_bound(Scenario.from_dict({**fields, "robot": {"model": "car"}, "cost": {}}), optimum)
    with pytest.raises(ValueError, match="goal: lower bounds need a heading, got None"):
        lower_bound(Scenario.from_dict({**fields, "goal": [4.2, 4.0, None]}), optimum)
    with pytest.raises(ValueError, match="arena: lower bounds need at most"):
        lower_bound(Scenario.from_dict({**fields, "arena": [0, 0, 500, 500]}), optimum)
    with pytest.raises(ValueError, match="gap: expected a number between 0 and 1, got 0"):
        lower_bound(SCENARIO, optimum, gap=0)
    with pytest.raises(ValueError, match="time_limit: expected a positive number"):
        lower_bound(SCENARIO, optimum, time_limit=0)
    with pytest.raises(ValueError, match="threads: expected"):
        lower_bound(SCENARIO, optimum, threads=0)


def test_files_that_are_no_proofs_are_refused(bound: LowerBound, tmp_path: Path):
    path = tmp_path / "proof"
    path.write_text("no proof")
    with pytest.raises(ProofError, match="not a proof"):
        Proof.load(path)
    bound.proof.save(path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(ProofError, match="not a proof"):
        Proof.load(path)


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scenario, proof, plot = tmp_path / "scenario.json", tmp_path / "a.proof", tmp_path / "tube.png"
    SCENARIO.to_json(scenario)
    assert main(["prove", str(scenario), "--gap", "0.2", "--proof", str(proof), "--plot", str(plot)]) == 0
    assert "gap                20.000 %" in capsys.readouterr().out
    assert plot.stat().st_size > 10_000
    assert main(["proof", "check", str(proof)]) == 0
    assert "no collision-free path costs less than" in capsys.readouterr().out
    assert main(["proof", "check", str(proof), "--scenario", str(scenario)]) == 0
    other = tmp_path / "other.json"
    Scenario.from_dict(SCENARIO.to_dict() | {"horizon": 7.0}).to_json(other)
    assert main(["proof", "check", str(proof), "--scenario", str(other)]) == 1
    false = replace(Proof.load(proof), value=100.0)
    false.save(proof)
    assert main(["proof", "check", str(proof)]) == 1
    proof.write_text("x")
    assert main(["proof", "check", str(proof)]) == 2


def test_a_picture_shows_each_spacing(bound: LowerBound, optimum: Optimum):
    figure = plot_tube(bound, optimum=optimum)
    assert len(figure.axes) == len(bound.tubes)
    assert all(cells.contains(SCENARIO.start) for cells in bound.tubes[:-1])


def test_stages_are_immutable(bound: LowerBound):
    stage, spline = bound.proof.stages[0], bound.proof.stages[0].start
    assert isinstance(stage, Stage)
    assert isinstance(spline, Spline)
    with pytest.raises(AttributeError):
        stage.level = 3  # type: ignore[misc]
