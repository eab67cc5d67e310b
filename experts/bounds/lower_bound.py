"""Lower bounds of the cost of a scenario, with proofs."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from leapnav.envs.field.layout import read_header
from leapnav.envs.field.proximity import proximity_value
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.bounds.distance import Distance, Medium
from leapnav.experts.bounds.duality import best_energy
from leapnav.experts.bounds.projection import make_constraints
from leapnav.experts.bounds.tube import Tube
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem.extremal import SolveError, Status
from leapnav.experts.proofs.cells import CellSet, Grid
from leapnav.experts.proofs.checker import length_limit, shortest_lengths, spline_value
from leapnav.experts.proofs.inequality import functionals
from leapnav.experts.proofs.proof import Pose, Proof, Spline, Stage, find_ends
from leapnav.experts.proofs.running_cost import running_cost

# Width of the cells of the first level: at most this multiple of the robot's radius, and this fraction of the arena.
SPACING_IN_RADII, SPACING_IN_ARENAS = 0.8, 1 / 24
MAX_CELLS = 8_000_000  # of the first level
MAX_LEVEL = 5
# Quantile of the ratios and visits of the pending cells, per round of a level; further rounds are as the last.
ROUNDS = ((0.95, 8), (0.9, 10), (0.85, 10), (0.8, 10))
# A level ends after a round, not the first, that leaves more than a fraction of the cells: the first fraction if there
# is time for the next level, otherwise the second. If there is time, it ends after MAX_ROUNDS.
PROGRESS, STALLED, MAX_ROUNDS = 0.93, 0.99, 12
TOLERANCE = 1.001  # gradient ratio above which a control point is moved
# Largest Phi of the eikonal equation, relative to that on the optimum, and in E: of the first level and of all others.
CAP_FACTOR, FIRST_CAP_IN_ENERGY, CAP_IN_ENERGY = 1.15, 0.75, 1.2
MIN_GAP, MAX_GAP = 1e-3, 0.999  # apart from the duality gap, and with it
SLACK = 1e-6  # by which a proved value is smaller than what the functions give, relative


class Reference(Protocol):
    """An optimum, such as `Optimum` or the reference of a bank: what `lower_bound` needs of it."""

    @property
    def cost(self) -> float:
        """J."""
        ...

    @property
    def states(self) -> np.ndarray:
        """States (N, n)."""
        ...

    @property
    def controls(self) -> np.ndarray:
        """Controls (N, m)."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class LowerBound:
    """A proved lower bound of the cost of a scenario.

    Attributes:
        value: no collision-free path costs less.
        gap: 1 - value / cost of the optimum.
        seconds: duration of the computation.
        resolution: spacing of the finest cells (m).
        duality_gap: estimate of the gap that remains because the horizon is fixed, however fine the cells are: the
            distance of the optimum from the convex envelope of the optimal cost over the horizon, see
            `leapnav.experts.bounds.duality`; 0 with a free horizon.
        excluded: fraction of the collision-free configuration space that is outside of the last of `tubes`.
        proof: the proof, see `check_proof`.
        tubes: for each spacing, the cells that its stages leave for paths cheaper than `value`. If the last of them do
            not connect start and goal, this completes the proof. If the time was not sufficient, the cells left for
            paths cheaper than the present target, which is larger than `value`.
        free_cells: number of cells of the first level that contain a collision-free point.

    """

    value: float
    gap: float
    seconds: float
    resolution: float
    duality_gap: float
    excluded: float
    proof: Proof
    tubes: tuple[CellSet, ...]
    free_cells: int

    def to_dict(self) -> dict[str, float]:
        """Return the numbers of the result."""
        return {
            "value": self.value,
            "gap": self.gap,
            "seconds": self.seconds,
            "resolution": self.resolution,
            "duality_gap": self.duality_gap,
            "excluded": self.excluded,
        }

    def __repr__(self) -> str:
        return (
            f"LowerBound(value={self.value:.6g}, gap={self.gap:.4g}, resolution={self.resolution:g}, "
            f"excluded={self.excluded:.4g}, seconds={self.seconds:.3g})"
        )


def lower_bound(
    scenario: Scenario,
    optimum: Reference | None = None,
    gap: float = 0.05,
    time_limit: float = 60.0,
    *,
    threads: int = 2,
) -> LowerBound:
    """Prove that no collision-free path of a scenario costs less than (1 - gap) times the cost of an optimum.

    Functions that bound the distance from the start and to the goal exclude the cells of configuration space through
    which no cheaper path can run. In the cells that are left the spacing is halved, until start and goal are too far
    apart or excluded. See `leapnav.experts.proofs.checker` for the theorem.

    Args:
        scenario: the scenario, with a unicycle or a differential drive, and fixed or free horizon.
        optimum: the best known path; None computes it with `find_optimum`.
        gap: the relative optimality gap to prove; if that is impossible because of the duality gap, their sum.
        time_limit: time after which the best bound that is proved so far is returned (s); a step that has begun is
            finished first.
        threads: 1, or 2 to compute the distances from the start and from the goal at the same time.

    Returns:
        The lower bound. Its gap is larger than the argument if the time was not sufficient.

    Raises:
        SolveError: there is no certified optimum.
        ValueError: lower bounds cannot be proved for such a scenario, or an argument is out of range.

    """
    ends = find_ends(scenario)
    if not 0.0 < gap < 1.0:
        raise ValueError(f"gap: expected a number between 0 and 1, got {gap!r}")
    if not time_limit > 0:
        raise ValueError(f"time_limit: expected a positive number (s), got {time_limit!r}")
    check_at_least("threads", threads, 1)
    start = time.perf_counter()
    if optimum is None:
        found = find_optimum(scenario, "medium")
        if found.status is not Status.SUCCESS:
            raise SolveError(found, scenario.name)
        optimum = found
    return _Producer(scenario, ends, optimum, gap, threads).run(start, time_limit)


@dataclass(frozen=True)
class _Pace:
    """How fast a level is computed.

    Attributes:
        end: when the time is over (s).
        count: number of cells of the level.
        begun: when the level began (s).

    """

    end: float
    count: int
    begun: float = field(default_factory=time.perf_counter)

    def is_over(self) -> bool:
        """Whether the time is over."""
        return time.perf_counter() > self.end

    def affordable(self) -> float:
        """Return the number of cells of a next level for which the time is sufficient, at the rate of this level."""
        now = time.perf_counter()
        return (self.end - now) * self.count / (now - self.begun)


class _Producer:
    """The construction of a proof: its stages, and the cells that are left.

    What the stages exclude is known for each smaller L as well, see `Tube`: when the time is over, or too short for the
    next level, a smaller L is chosen.
    """

    def __init__(
        self, scenario: Scenario, ends: tuple[Pose, Pose], optimum: Reference, gap: float, threads: int
    ) -> None:
        self.scenario, self.ends, self.cost, self.threads = scenario, ends, optimum.cost, threads
        states, controls = np.asarray(optimum.states, dtype=float), np.asarray(optimum.controls, dtype=float)
        radius = float(read_header(scenario.field)["radius"])
        proximity = np.array([proximity_value(x, y, radius, scenario.field) for x, y in states[:, :2]])
        self.duality_gap = 0.0
        if scenario.horizon is None:
            self.energy = scenario.cost.time_weight
        else:
            weights = np.array(scenario.robot.control_weight(scenario.cost))
            self.energy = float(np.median(0.5 * (controls**2) @ weights - proximity))
            if self.energy > 0:
                self.energy, self.duality_gap = best_energy(scenario, self.cost, self.energy)
        if not self.energy > 0:
            raise ValueError(
                f"horizon: lower bounds need a positive kinetic energy minus proximity cost on the optimum, got "
                f"{self.energy:.4g}; the horizon is too long"
            )
        self.highest = CAP_FACTOR * float(proximity.max())
        grid = first_grid(scenario)
        if gap < min(self.duality_gap + MIN_GAP, MAX_GAP):
            gap = min(gap + self.duality_gap, MAX_GAP)
        target = Proof(scenario, (1.0 - gap) * self.cost, self.energy, grid.spacing, grid.headings, ())
        limit = length_limit(target)
        self.target, self.shift = target.value, limit - target.value
        # Larger by the slack, by which a proved value is smaller.
        self.limit = self.first_limit = limit + SLACK * max(1.0, abs(limit))
        self.tube = Tube.full(grid)
        self.stages, self.levels, self.free_cells = list[Stage](), list[CellSet](), 0
        self.distances: list[Distance | None] = [None, None]
        self.proved = -math.inf  # the largest L that is proved

    def run(self, start: float, time_limit: float) -> LowerBound:
        """Add stages until the value is proved or the time is over."""
        for level in range(MAX_LEVEL + 1):
            pace = _Pace(start + time_limit, len(self.tube.cells))
            self._level(level, pace)
            self.levels.append(self.tube.cells)
            if self.proved == self.limit or level == MAX_LEVEL or not self._refine(pace.affordable()):
                break
        if self.proved < self.limit:
            self.proved = self.tube.separating_length(self.ends, self.proved, self.limit)
        left = len(self.levels[-1]) / 8 ** (len(self.levels) - 1)
        value = self.target
        if self.proved < self.first_limit:
            value = self.proved - self.shift - SLACK * max(1.0, abs(self.proved))
        first, last = self.levels[0].grid, self.levels[-1].grid
        proof = Proof(self.scenario, value, self.energy, first.spacing, first.headings, tuple(self.stages))
        return LowerBound(
            value=value,
            gap=1.0 - value / self.cost,
            seconds=time.perf_counter() - start,
            resolution=last.spacing,
            duality_gap=self.duality_gap,
            excluded=1.0 - left / self.free_cells,
            proof=proof,
            tubes=tuple(self.levels),
            free_cells=self.free_cells,
        )

    def _level(self, level: int, pace: _Pace) -> None:
        """Add the stages of a level."""
        scenario, cells = self.scenario, self.tube.cells.with_margin()
        cost = running_cost(scenario, cells.grid, cells.columns())
        cells = cells.without(~np.isfinite(cost.lowest)).with_margin()
        self.tube = self.tube.on(cells)
        if level == 0:
            self.free_cells = len(cells)
        metric = scenario.robot.metric(scenario.cost)
        table = functionals(cells.grid, metric, cost.squares.shape[2])
        constraints = make_constraints(table, cost.squares, self.energy, TOLERANCE)
        highest = max((CAP_IN_ENERGY if level else FIRST_CAP_IN_ENERGY) * self.energy, self.highest)
        medium = Medium(cells, cost, table, constraints, metric, self.energy, highest)
        self.distances = self._both(lambda side: Distance(medium, self.ends[side], self.distances[side]), (0, 1))
        for number in itertools.count():
            quantile, visits = ROUNDS[min(number, len(ROUNDS) - 1)]
            before = self.tube.cells
            found = self._both(lambda distance: distance.improve(before, quantile, visits), self.distances)  # noqa: B023
            (first, start), (second, goal) = found
            self.stages.append(_stage(level, before, first, second))
            self.tube = self.tube.raised(shortest_lengths(before, start, goal)).below(self.limit)
            connected = self.tube.below(self.limit, self.ends[0])
            cells = connected.cells
            if not cells.contains(self.ends[1]):
                self.proved = self.limit
                return
            self.tube = connected
            length = start.scale * spline_value(start.values, cells, self.ends[1]) - start.offset
            self.proved = min(max(self.proved, length), self.limit)
            if self.proved == self.limit or pace.is_over() or (number > 0 and len(cells) > STALLED * len(before)):
                return
            next_fits = level < MAX_LEVEL and 8 * len(cells) <= pace.affordable()
            if next_fits and number > 0 and (len(cells) > PROGRESS * len(before) or number == MAX_ROUNDS - 1):
                return

    def _refine(self, affordable: float) -> bool:
        """Halve the spacing, with a smaller L if the next level had too many cells; return False if that is useless."""
        largest = self.tube.length_with(int(min(affordable / 8, len(self.tube.cells))))
        if largest < self.limit:
            tube = self.tube.below(largest, self.ends[0])
            if largest <= self.proved or not tube.cells.contains(self.ends[1]):
                return False
            self.limit, self.tube = largest, tube
        self.tube = self.tube.refined()
        return True

    def _both(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> list[Any]:
        """Apply a function to both arguments, in two threads if there are two."""
        if self.threads < 2:
            return [function(argument) for argument in arguments]
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(function, arguments))


def _stage(level: int, cells: CellSet, start: Spline, goal: Spline) -> Stage:
    """Return a stage with the blocks that the cells need."""
    layout = cells.with_margin().layout
    used = cells.layout.slots[tuple(layout.blocks.T)]
    first, second = (replace(spline, values=spline.values[used]) for spline in (start, goal))
    return Stage(level, layout.blocks, first, second)


def first_grid(scenario: Scenario) -> Grid:
    """Return the grid of the first level.

    Raises:
        ValueError: the arena is too large for the robot's radius.

    """
    x_min, y_min, x_max, y_max = scenario.arena
    radius = float(scenario.outline[0, 3])
    spacing = min(SPACING_IN_RADII * radius, SPACING_IN_ARENAS * max(x_max - x_min, y_max - y_min))
    metric = scenario.robot.metric(scenario.cost)
    turns = 2 * math.pi * math.sqrt(metric[1] / metric[0]) / (0.7 * spacing)
    headings = min(max(8 * round(turns / 8), 32), 64)
    grid = Grid.over(scenario.arena, spacing, headings)
    count = grid.headings * grid.columns * grid.lines
    if count > MAX_CELLS:
        raise ValueError(
            f"arena: lower bounds need at most {MAX_CELLS:,} cells of {spacing:.3g} m, got {count:,}; the arena is too "
            "large for the robot's radius"
        )
    return grid
