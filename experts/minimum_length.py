"""Minimum length: the shortest collision-free path of the robot's position, among hard obstacles.

With the time weight v^2 / 2 and a weight of 1 for the square of the speed, the cost divided by v is at least the length
of the path plus the cost of turning, and equal to it at the speed v. In the limit of small weights of turning it is
the length. For a disc that rotates in place the limit is known: the shortest path of its centre among the obstacles
that are enlarged by its radius, see `leapnav.experts.search.tangent_graph`. For any other robot such a path is a lower
bound: that of the largest disc around the reference point that the outline contains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from leapnav.envs.robots import Disc, Unicycle
from leapnav.envs.robots.footprints import enclosed_radius
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.faults import check_at_rest
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_positive
from leapnav.experts.control_weights import limit_of, next_extremal
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem.certificate import failure
from leapnav.experts.problem.extremal import Extremal, SolveError, Status
from leapnav.experts.problem.problem import as_problem
from leapnav.experts.search.structure import Piece, format_pieces, obstacle_name, pieces_of
from leapnav.experts.search.tangent_graph import MAX_CORNERS, PlanePiece, corner_count, shortest_plane_path

# Weight of turning relative to that of the speed (m^2): the first and the smallest one, and the factor between two. At
# 1e-4, discs in 8 scenarios of `clutter` were 0.07 to 0.19 % above the exact length.
FIRST_WEIGHT, LAST_WEIGHT, WEIGHT_FACTOR = 0.1, 1e-6, 0.25
MAX_PATHS = 4  # local optima that are followed
POINTS = 4001  # at which the length of a path is computed
UNIT_LATTICE = (0.25, 1.0, 1.0)  # cell (m) and weights, which do not matter to whether a robot rotates in place
FREE_LIMIT = 100.0  # largest speed (m/s) and turn rate (rad/s) of a robot of which only the path matters


@dataclass(frozen=True, eq=False)
class MinimumLength:
    """The result of `minimum_length`.

    Attributes:
        poses: (N, 3), x, y (m) and heading (rad) along the path. Where the robot rotates in place, positions are
            repeated.
        length: length (m) of the path of the position.
        lower_bound: a lower bound of the minimum length (m); NaN if the reference point is outside of the outline, or
            the obstacles have too many corners.
        tolerance: the length exceeds the minimum by at most this fraction; NaN without a lower bound. For a disc that
            rotates in place it is 0.
        pieces: straight lines, turns and contacts with obstacles.
        extremal: the extremal for the smallest weight of turning; None if the path is exact.

    """

    poses: np.ndarray
    length: float
    lower_bound: float
    tolerance: float
    pieces: tuple[Piece, ...]
    extremal: Extremal | None

    def __str__(self) -> str:
        """Return the length, its bound and the pieces as text."""
        return f"length {self.length:.4f} m, at least {self.lower_bound:.4f} m\n{format_pieces(self.pieces)}"


def minimum_length(scenario: Scenario, tol: float = 1e-3) -> MinimumLength:
    """Find the shortest collision-free path of the robot's position.

    The horizon, the cost weights and the limits of speed and turn rate are ignored, except for a robot that cannot
    stop: its limits determine how tightly it turns. Obstacles cost nothing and must not be touched.

    For a disc that rotates in place the path is exact, and touches the obstacles. For other robots the best local
    optima of a search are followed to small weights of turning, with the barrier of hard obstacles.

    Args:
        scenario: the scenario.
        tol: relative excess over the lower bound at which the weight of turning is small enough, in (0, 1).

    Returns:
        The path, its length and a lower bound.

    Raises:
        TypeError: it is not a scenario.
        ValueError: the first control of the robot is not its speed, or `tol` is invalid.
        SolveError: no path was found; the attribute `extremal` is the failed result.

    """
    if not isinstance(scenario, Scenario):
        raise TypeError(f"scenario: expected a Scenario (see Scenario.from_dict), got {type(scenario).__name__}")
    check_positive("tol", tol)
    check_at_rest(scenario.moves, "minimum_length")
    if not tol < 1:
        raise ValueError(f"tol: expected a number below 1, got {tol!r}")
    bound, pieces = math.nan, None
    radius = enclosed_radius(scenario.outline)
    if radius >= 0.0 and corner_count(scenario) <= MAX_CORNERS:
        pieces = shortest_plane_path(scenario, radius)
        if pieces is None:
            problem = as_problem(scenario)
            raise SolveError(failure(problem, Status.NO_PATH), scenario.name)
        bound = sum(piece.length for piece in pieces)
    rotates = scenario.robot.lattice_moves(*UNIT_LATTICE).rotating
    is_disc = len(scenario.outline) == 1 and not scenario.outline[0, :3].any()
    if rotates and is_disc and pieces is not None:
        poses = _poses(scenario, pieces)
        return MinimumLength(poses, bound, bound, 0.0, _exact_pieces(scenario, pieces), None)
    extremal, length = _followed(_of_length(scenario, rotates), bound, tol)
    poses = extremal.evaluate(np.linspace(0.0, extremal.horizon, POINTS))[0][:, :3]
    return MinimumLength(poses, length, bound, length / bound - 1.0, pieces_of(extremal), extremal)


def _of_length(scenario: Scenario, rotates: bool) -> Scenario:
    """Return the scenario whose cost is proportional to the length plus a small cost of turning."""
    robot = scenario.robot
    if rotates:
        # All robots that rotate in place have the same paths.
        footprint = (Disc(radius=robot.radius),) if robot.footprint is None else robot.footprint
        robot = Unicycle(footprint=footprint, max_speed=FREE_LIMIT, max_turn_rate=FREE_LIMIT)
    elif robot.control_names[0] != "speed":
        raise ValueError(f"robot: expected one whose first control is its speed, got {robot.model!r}")
    speed = _speed(robot.control_bounds()[0].tolist())
    weights = {"turn_weight": FIRST_WEIGHT} if "turn_weight" in robot.cost_fields else {}
    cost = Cost(
        time_weight=0.5 * speed**2,
        speed_weight=1.0,
        proximity_weight=0.0,
        proximity_scale=scenario.cost.proximity_scale,
        **weights,
    )
    update = {"robot": robot, "cost": cost, "horizon": None}
    if rotates:
        update |= {"start_motion": None, "goal_motion": None}
    return scenario.model_copy(update=update)


def _speed(bounds: tuple[float, float]) -> float:
    """Return the speed (m/s) of the optimum: the slowest of a robot that cannot stop, otherwise within the limits."""
    low, high = bounds
    slowest = max(low, -high, 0.0)
    return slowest if slowest > 0.0 else min(1.0, 0.5 * max(high, -low))


def _followed(scenario: Scenario, bound: float, tol: float) -> tuple[Extremal, float]:
    """Return the shortest path that the continuations from several local optima find, and its length (m)."""
    optimum = find_optimum(scenario)
    if not optimum.success:
        raise SolveError(optimum, scenario.name)
    best, shortest = None, math.inf
    for start in [optimum, *optimum.alternatives][:MAX_PATHS]:
        extremal = _follow(start, scenario, bound, tol)
        length = _length(extremal)
        if length < shortest:
            best, shortest = extremal, length
        if shortest <= bound * (1.0 + tol):
            break
    assert best is not None
    return best, shortest


def _follow(start: Extremal, scenario: Scenario, bound: float, tol: float) -> Extremal:
    """Return the extremal for the smallest weight of turning that is reached, or with which it is short enough."""
    extremal, weight = start, FIRST_WEIGHT
    limits = scenario.robot.control_bounds()
    if not (limits[0, 0] > 0.0 or limits[0, 1] < 0.0):
        # Only the directions in which the robot drives matter.
        limits = np.where(limits < 0.0, -np.inf, np.where(limits > 0.0, np.inf, 0.0))
    bounds = tuple((float(low), float(high)) for low, high in limits)
    length, decrease = _length(extremal), math.inf
    # The excess is proportional to the square root of the weight, so about as large as the last decrease.
    while weight > LAST_WEIGHT and not length <= bound * (1.0 + tol) and decrease > tol * length:
        weight *= WEIGHT_FACTOR
        weights = (1.0, *[weight] * (extremal.problem.system.m - 1))
        found = next_extremal(extremal, replace(extremal.problem, control_weight=weights, control_bounds=bounds))
        if not found.success:
            break
        decrease, extremal = length - _length(found), found
        length -= decrease
    return limit_of(extremal)


def _length(extremal: Extremal) -> float:
    """Return the length (m) of the path of the position."""
    states = extremal.evaluate(np.linspace(0.0, extremal.horizon, POINTS))[0]
    return float(np.hypot(*np.diff(states[:, :2], axis=0).T).sum())


def _headings(scenario: Scenario, pieces: list[PlanePiece]) -> list[tuple[float, float]]:
    """Return the headings (rad) at both ends of each piece, without jumps between arcs and lines."""
    heading, found = scenario.start[2], []
    for piece in pieces:
        heading += math.remainder(piece.heading - heading, 2 * math.pi)
        found.append((heading, heading + piece.turn))
        heading += piece.turn
    return found


def _poses(scenario: Scenario, pieces: list[PlanePiece]) -> np.ndarray:
    """Return poses (N, 3) along the path; the robot rotates in place at the start and at the goal."""
    rows = [np.array([scenario.start])]
    for piece, (first, last) in zip(pieces, _headings(scenario, pieces), strict=True):
        points = piece.points()
        rows.append(np.column_stack([points, np.linspace(first, last, len(points))]))
    x, y, heading = scenario.goal
    before = float(rows[-1][-1, 2])
    after = before if heading is None else before + math.remainder(heading - before, 2 * math.pi)
    rows.append(np.array([[x, y, after]]))
    return np.concatenate(rows)


def _exact_pieces(scenario: Scenario, pieces: list[PlanePiece]) -> tuple[Piece, ...]:
    """Return the pieces of the path, with rotations in place at its ends."""
    found = []
    poses = _poses(scenario, pieces)
    for piece, (first, last) in zip(pieces, _headings(scenario, pieces), strict=True):
        points = piece.points()
        if piece.obstacle is None:
            found.append(Piece("straight", math.nan, piece.length, 0.0, None, points))
        else:
            found.append(Piece("contact", math.nan, piece.length, last - first, obstacle_name(piece.obstacle), points))
    ends = [(poses[0], poses[1]), (poses[-2], poses[-1])]
    turns = [Piece("turn", math.nan, 0.0, float(b[2] - a[2]), None, np.stack([a[:2], b[:2]])) for a, b in ends]
    return tuple(piece for piece in (turns[0], *found, turns[1]) if piece.length > 0.0 or abs(piece.turn) > 1e-9)
