"""The parts of the checker of lower bounds: intervals, gauge, bounds of the running cost, control points."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from helpers import DISC_AND_TRIANGLE

from leapnav.envs.field.clearance import clearance
from leapnav.envs.field.proximity import proximity_value
from leapnav.envs.scenarios.families import sample_scenario
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.proofs.cells import CellSet, Grid
from leapnav.experts.proofs.checker import check_proof
from leapnav.experts.proofs.gauge import gauge, gauge_minimum, gradient_bound, make_source
from leapnav.experts.proofs.inequality import functionals, gradient_ratios, largest_square
from leapnav.experts.proofs.intervals import Interval
from leapnav.experts.proofs.proof import Proof, ProofError, Spline, Stage
from leapnav.experts.proofs.running_cost import running_cost


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_interval_arithmetic_contains_the_exact_result(rng: np.random.Generator):
    for _ in range(500):
        a, b = sorted(rng.normal(size=2).tolist())
        c, d = sorted(rng.normal(size=2).tolist())
        x, y = Fraction(rng.uniform(a, b)), Fraction(rng.uniform(c, d))
        first, second = Interval(a, b), Interval(c, d)
        for result, exact in (
            (first + second, x + y),
            (first - second, x - y),
            (first * second, x * y),
            (2.0 - first, 2 - x),
            (3.0 * first, 3 * x),
        ):
            assert Fraction(result.low) <= exact <= Fraction(result.high)
        if c * d > 0:
            quotient = first / second
            assert Fraction(quotient.low) <= x / y <= Fraction(quotient.high)
    with pytest.raises(ZeroDivisionError):
        Interval(1.0, 2.0) / Interval(-1.0, 1.0)


@pytest.mark.parametrize("radius", [0.4, 1.0, 1.5, 2.0])
def test_the_bound_of_the_gauge_gradient_holds_and_is_close(radius: float, rng: np.random.Generator):
    """Against central differences of the gauge at random poses, for r_v = r_w = 1."""
    source = make_source((0.0, 0.0, 0.0), (1.0, 1.0), radius)
    largest, step = 0.0, 1e-5
    for x, y, heading in rng.uniform(-1, 1, (20000, 3)) * (1.2 * radius, 0.7 * radius, radius):
        height = gauge(x, y, heading, source)
        if not 0.1 * radius < height < 0.98 * radius / source.gradient:
            continue
        dx, dy = step * math.cos(heading), step * math.sin(heading)
        forward = (gauge(x + dx, y + dy, heading, source) - gauge(x - dx, y - dy, heading, source)) / (2 * step)
        turn = (gauge(x, y, heading + step, source) - gauge(x, y, heading - step, source)) / (2 * step)
        largest = max(largest, math.hypot(forward, turn))
    assert largest <= 1.0 + 1e-6
    assert largest > 0.95
    assert gradient_bound(radius) >= 1.0
    with pytest.raises(ValueError, match="radius: expected a number from"):
        gradient_bound(3.0)


def test_the_minimum_of_the_gauge_over_a_box_is_a_lower_bound(rng: np.random.Generator):
    source = make_source((1.0, 2.0, 0.5), (1.0, 0.5), 1.0)
    for _ in range(3000):
        centre = np.array([1.0, 2.0, 0.5]) + rng.normal(size=3) * (0.5, 0.5, 1.5)
        width, angle = rng.uniform(0.0, 0.2, 2).tolist()
        lowest = gauge_minimum(*centre, width, angle, source)
        pose = centre + rng.uniform(-1, 1, 3) * (width, width, angle)
        assert lowest <= gauge(*pose, source)


def walls_and_corners(**cost: float) -> Scenario:
    """A scenario with a passage between two discs that is narrower than the robot."""
    more = (
        {"circle": {"center": (3.3, 2.2), "radius": 0.05}},
        {"polygon": {"vertices": ((3.2, 3.3), (3.8, 3.3), (3.8, 3.9), (3.2, 3.9))}},
    )
    fields = DISC_AND_TRIANGLE.to_dict()
    fields |= {"obstacles": (*fields["obstacles"], *more)}
    return Scenario.from_dict(fields | {"cost": cost})


def barrier_sums(points: np.ndarray, scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return the clearance (N,) and the sum of 1 / (exp(d / scale) - 1) over all obstacles, from their geometry."""
    radius, scale = float(scenario.outline[0, 3]), scenario.cost.proximity_scale
    x_min, y_min, x_max, y_max = scenario.arena
    x, y = points.T
    distances = [x - x_min, x_max - x, y - y_min, y_max - y]
    for obstacle in scenario.to_dict()["obstacles"]:
        if "circle" in obstacle:
            circle = obstacle["circle"]
            distances.append(np.hypot(*(points - circle["center"]).T) - circle["radius"])
            continue
        first = np.array(obstacle["polygon"]["vertices"])
        edges = np.roll(first, -1, axis=0) - first  # counter-clockwise
        offsets = points[:, None] - first
        along = np.clip((offsets * edges).sum(-1) / (edges**2).sum(-1), 0.0, 1.0)
        apart = np.linalg.norm(offsets - along[..., None] * edges, axis=-1).min(axis=1)
        inside = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] > 0).all(axis=1)
        distances.append(np.where(inside, -apart, apart))
    lengths = np.array(distances) - radius
    with np.errstate(divide="ignore", over="ignore"):
        return lengths.min(axis=0), (1.0 / np.expm1(lengths / scale)).sum(axis=0)


@pytest.mark.parametrize(
    ("spacing", "weight"),
    [
        *[(0.2, 0.0), (0.2, 1.0), (0.05, 0.0), (0.05, 0.03), (0.0125, 0.03)],
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(0.2, 0.03), (0.05, 1.0), (0.0125, 0.0), (0.0125, 1.0)]
        ),
    ],
)
def test_the_running_cost_is_bounded_on_every_square(spacing: float, weight: float, rng: np.random.Generator):
    """At 49 points of each square, with its corners, and close to contact; Phi is computed without the kernels."""
    scenario = walls_and_corners(proximity_weight=weight)
    grid = Grid.over(scenario.arena, spacing, 8)
    cost = running_cost(scenario, grid, np.ones((grid.columns, grid.lines), dtype=bool))
    n = cost.squares.shape[2]
    width = spacing / n
    squares = np.stack(np.meshgrid(np.arange(n * grid.columns), np.arange(n * grid.lines), indexing="ij"), axis=-1)
    squares = squares.reshape(-1, 2)
    if len(squares) > 40000:  # those near contact, and some others
        centres = (grid.x, grid.y) + (squares + 0.5) * width
        near = np.abs(barrier_sums(centres, scenario)[0]) < 0.75 * width
        others = rng.permutation(np.flatnonzero(~near))
        squares = squares[np.concatenate([np.flatnonzero(near)[:15000], others[:15000]])]
    steps = np.array([0.0, 1e-3, 0.2, 0.5, 0.7, 1.0 - 1e-3, 1.0])
    checked, tightest = 0, np.inf
    for u in steps:
        for v in steps:
            points = (grid.x, grid.y) + (squares + np.array([u, v])) * width
            clearances, sums = barrier_sums(points, scenario)
            free = clearances > 1e-9
            i, j = squares[free].T // n
            a, b = squares[free].T % n
            bounds, phi = cost.squares[i, j, a, b], weight * np.minimum(sums[free], 1e12)
            assert not np.isnan(bounds).any()  # a collision-free point
            assert (bounds <= phi * (1 + 1e-9)).all()
            assert (cost.lowest[i, j] <= bounds * (1 + 1e-6)).all()  # which is in single precision
            checked += len(phi)
            if weight > 0.0:
                tightest = min(tightest, float((phi / bounds)[sums[free] > 1e-3].min()))
    assert checked > 100_000
    if weight > 0.0:  # at a corner
        assert tightest < 1.01


def test_the_running_cost_is_bounded_where_squares_are_small_in_proximity_scales(rng: np.random.Generator):
    """Near contact, the kernels replace the barrier by a polynomial, which the bound must not exceed either."""
    scenario = walls_and_corners(proximity_scale=1e4)
    grid = Grid.over(scenario.arena, 0.1, 8)
    cost = running_cost(scenario, grid, np.ones((grid.columns, grid.lines), dtype=bool))
    for x, y in rng.uniform(0.2, 4.8, (4000, 2)):
        if clearance(x, y, scenario.field)[0] > 0:
            lowest = cost.lowest[int((x - grid.x) / 0.1), int((y - grid.y) / 0.1)]
            assert 0.0 < lowest <= proximity_value(x, y, scenario.robot.radius, scenario.field)


def test_control_points_bound_the_gradient(rng: np.random.Generator):
    """At random points of a cell, and its squares, of a random spline."""
    grid = Grid(0.0, 0.0, 0.1, 32, 8, 8)
    table = functionals(grid, (1.0, 0.5), 2)
    for _ in range(200):
        k = int(rng.integers(32))
        c = rng.normal(size=(3, 3, 3))
        points = (c.ravel() - c[1, 1, 1]) @ table.matrices[k, 0]
        highest = largest_square(points, table.excess, table.rounding * 10)
        t = rng.uniform(0, 1, 3)
        value = [np.array([0.5 * (1 - s) ** 2, 0.5 + s * (1 - s), 0.5 * s * s]) for s in t]
        slope = [np.array([s - 1, 1 - 2 * s, s]) for s in t]
        turn = np.einsum("a,b,c,abc", slope[0], value[1], value[2], c) / grid.angle
        s_x = np.einsum("a,b,c,abc", value[0], slope[1], value[2], c) / grid.spacing
        s_y = np.einsum("a,b,c,abc", value[0], value[1], slope[2], c) / grid.spacing
        heading = (k + t[0]) * grid.angle
        forward = math.cos(heading) * s_x + math.sin(heading) * s_y
        assert forward**2 + turn**2 / 0.5 <= highest


@pytest.mark.filterwarnings("ignore:overflow")
def test_functionals_that_overflow_are_refused():
    """In an arena of 1e-175 m the control points of a step in the heading are infinite, or no numbers."""
    width, headings = 1e-175, 64
    angle = 2 * math.pi / headings
    scenario = Scenario(
        arena=(0.0, 0.0, width, width),
        start=(0.3 * width, 0.5 * width, 4.5 * angle),
        goal=(0.7 * width, 0.5 * width, 36.5 * angle),
        horizon=None,
        cost={"time_weight": 0.5, "speed_weight": 1e-300, "turn_weight": 1.0, "proximity_weight": 0.0},
        robot={"radius": 0.05 * width},
    )
    cells = CellSet.full(Grid.over(scenario.arena, width / 10, headings))
    step = np.full(cells.mask.shape, 1e6, dtype=np.float32)
    first = np.flatnonzero(cells.layout.blocks[:, 0] == 0)
    step[first, 2:7] = 0.0
    start, goal = Spline(step, 1.0, 1e-3, 1e-3), Spline(np.zeros_like(step), 1.0, 1e-3, 1e-3)
    proof = Proof(scenario, 5e5, 0.5, width / 10, headings, (Stage(0, cells.layout.blocks, start, goal),))
    with pytest.raises(ProofError, match="the cells are too small"):
        check_proof(proof)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_coefficients_that_are_not_finite_bound_nothing(value: float):
    """The compiler must not assume that there is no NaN or infinity: the ratio of such a cell is not finite."""
    scenario = sample_scenario("open", seed=0)
    grid = Grid.over(scenario.arena, 1.0, 8)
    cells = CellSet.full(grid)
    cost = running_cost(scenario, grid, cells.columns())
    table = functionals(grid, (1.0, 0.5), cost.squares.shape[2])
    values = np.zeros(cells.mask.shape, dtype=np.float32)
    ratios = np.zeros_like(values)
    _, worst = gradient_ratios(values, cells.layout, cells.mask, cost, table, 1.0, 1.0, ratios)
    assert worst <= 1.0
    values[0, 3, 4, 4] = value
    _, worst = gradient_ratios(values, cells.layout, cells.mask, cost, table, 1.0, 1.0, ratios)
    assert not worst <= 1e30
    assert largest_square(np.full(99, 0.5), 0.1, np.nan) == np.inf
