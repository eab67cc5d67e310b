"""Shortest paths of a disc in the plane: the tangent graph of the enlarged obstacles.

A point that keeps the distance r from the obstacles moves along straight lines, and around their corners on arcs of
the radius r, enlarged by the rounding of the obstacle. Lines touch the arcs at both ends, so the shortest path is that
of a finite graph: of the common tangents of two arcs that no obstacle blocks, and of the arcs between them (Y.-H. Liu
and S. Arimoto, "Path planning using a tangent graph for mobile robots among polygonal and curved obstacles",
International Journal of Robotics Research 11, 1992).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from leapnav.envs.scenarios.scenario import Scenario

ANGLES = 720  # directions on each arc in which its distance from other obstacles is checked
TOLERANCE = 1e-9  # m; lines and arcs may be this much closer to an obstacle than the radius
ARC_STEP = 0.02  # rad between the points of an arc
MAX_CORNERS = 400  # the number of tangents is quadratic in the number of corners, and each is checked


@dataclass(frozen=True)
class PlanePiece:
    """A straight line or an arc of a shortest path.

    Attributes:
        start, end (2,): its ends (m).
        length: m.
        centre (2,): centre (m) of an arc; None for a line.
        side: 1 if the arc turns left, -1 if it turns right, 0 for a line.
        obstacle: index in the scenario of the obstacle that the arc touches; None for a line.

    """

    start: np.ndarray
    end: np.ndarray
    length: float
    centre: np.ndarray | None = None
    side: int = 0
    obstacle: int | None = None

    @property
    def turn(self) -> float:
        """The change of the direction (rad) along it."""
        return 0.0 if self.centre is None else self.side * self.length / float(np.hypot(*(self.start - self.centre)))

    @property
    def heading(self) -> float:
        """The direction (rad) at its beginning."""
        if self.centre is None:
            return math.atan2(*(self.end - self.start)[::-1])
        x, y = self.start - self.centre
        return math.atan2(self.side * x, -self.side * y)

    def points(self) -> np.ndarray:
        """Return positions (K, 2) (m) along it."""
        if self.centre is None:
            return np.stack([self.start, self.end])
        x, y = self.start - self.centre
        count = max(int(abs(self.turn) / ARC_STEP), 1) + 1
        angles = math.atan2(y, x) + np.linspace(0.0, self.turn, count)
        return self.centre + math.hypot(x, y) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


class _Obstacles:
    """The convex polygons (or points, or segments) with a distance from each that a path keeps.

    Attributes:
        polygons: vertices (K, 2) (m) of each.
        distances: the distances (m).
        obstacles: indices in the scenario.
        box: (x_min, y_min, x_max, y_max) (m) in which the path stays.

    """

    def __init__(self, scenario: Scenario, radius: float) -> None:
        self.polygons: list[np.ndarray] = []
        self.distances: list[float] = []
        self.obstacles: list[int] = []
        for index, obstacle in enumerate(scenario.obstacles):
            for part in obstacle.shape.parts():
                vertices, rounding = part.rounded_polygon()
                self.polygons.append(np.asarray(vertices, dtype=float))
                self.distances.append(rounding + radius)
                self.obstacles.append(index)
        x_min, y_min, x_max, y_max = scenario.arena
        self.box = x_min + radius, y_min + radius, x_max - radius, y_max - radius

    def are_free(self, points: np.ndarray) -> np.ndarray:
        """Return which points (N, 2) keep the distances."""
        return self.lines_are_free(points, points)

    def lines_are_free(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return which of the lines between points (N, 2) keep the distances."""
        x_min, y_min, x_max, y_max = self.box
        free = np.ones(len(starts), dtype=bool)
        for points in (starts, ends):
            free &= (points >= (x_min - TOLERANCE, y_min - TOLERANCE)).all(axis=1)
            free &= (points <= (x_max + TOLERANCE, y_max + TOLERANCE)).all(axis=1)
        for vertices, distance in zip(self.polygons, self.distances, strict=True):
            at = np.flatnonzero(free)
            free[at] = _distances(starts[at], ends[at], vertices) >= distance - TOLERANCE
        return free


def _distances(starts: np.ndarray, ends: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of lines from a convex polygon; 0 if they intersect."""
    distances = np.min([_to_line(vertex[None], starts, ends) for vertex in vertices], axis=0)
    if len(vertices) == 1:
        return distances
    following = np.roll(vertices, -1, axis=0)
    inside = np.ones(len(starts), dtype=bool)
    for a, b in zip(vertices, following, strict=True):
        for points in (starts, ends):
            distances = np.minimum(distances, _to_line(points, a[None], b[None]))
        crosses = (_area(starts, ends, a[None]) * _area(starts, ends, b[None]) < 0) & (
            _area(a[None], b[None], starts) * _area(a[None], b[None], ends) < 0
        )
        distances = np.where(crosses, 0.0, distances)
        inside &= _area(a[None], b[None], starts) > 0
    return distances if len(vertices) == 2 else np.where(inside, 0.0, distances)


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the signed areas of triangles."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _to_line(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the distances of points from the lines between two points."""
    along = ends - starts
    squared = np.maximum((along**2).sum(axis=1), 1e-300)
    fractions = (((points - starts) * along).sum(axis=1) / squared).clip(0.0, 1.0)
    return np.hypot(*(points - starts - fractions[:, None] * along).T)


def corner_count(scenario: Scenario) -> int:
    """Return the number of corners of the obstacles; a disc is one."""
    return sum(len(part.rounded_polygon()[0]) for obstacle in scenario.obstacles for part in obstacle.shape.parts())


def shortest_plane_path(scenario: Scenario, radius: float) -> list[PlanePiece] | None:
    """Return the shortest path of the centre of a disc from start to goal; None if there is none.

    Args:
        scenario: the scenario, of which the robot is ignored.
        radius: radius (m) of the disc.

    Raises:
        ValueError: the obstacles have more than MAX_CORNERS corners.

    """
    count = corner_count(scenario)
    if count > MAX_CORNERS:
        raise ValueError(f"obstacles: expected at most {MAX_CORNERS} corners, got {count}")
    obstacles = _Obstacles(scenario, radius)
    return _Graph(obstacles, np.array([scenario.start[:2], scenario.goal[:2]])).shortest()


class _Graph:
    """The tangent graph; the start and the goal are arcs of radius 0.

    Attributes:
        centres (K, 2), radii (K,): the arcs (m): the start, the goal, and the corners of the obstacles.
        owners (K,): indices of their obstacles.

    """

    def __init__(self, obstacles: _Obstacles, ends: np.ndarray) -> None:
        sizes = [len(vertices) for vertices in obstacles.polygons]
        self.obstacles = obstacles
        self.centres = np.concatenate([ends, *obstacles.polygons])
        self.radii = np.concatenate([[0.0, 0.0], np.repeat(obstacles.distances, sizes)])
        self.owners = np.concatenate([[-1, -1], np.repeat(obstacles.obstacles, sizes)]).astype(int)

    def shortest(self) -> list[PlanePiece] | None:
        """Return the pieces of the shortest path."""
        first, last, sides, points, lengths = self._tangents()
        count = len(first)
        # Node 2 k is the beginning of tangent k, node 2 k + 1 its end.
        arcs = np.concatenate([first[:, None], last[:, None]], axis=1).ravel()
        turns = sides.ravel()
        angles = np.arctan2(*(points.reshape(-1, 2) - self.centres[arcs]).T[::-1])
        rows, columns = [np.arange(0, 2 * count, 2)], [np.arange(1, 2 * count, 2)]
        weights = [lengths]
        masks = self._masks()
        for index in range(2, len(self.centres)):
            for side in (1, -1):
                on_arc = np.flatnonzero((arcs == index) & (turns == side))
                if len(on_arc) > 1:
                    order = on_arc[np.argsort(side * angles[on_arc], kind="stable")]
                    steps = np.remainder(side * (np.roll(angles[order], -1) - angles[order]), 2 * math.pi)
                    kept = [
                        self._is_arc_free(masks[index], angles[a], side * step)
                        for a, step in zip(order, steps, strict=True)
                    ]
                    rows.append(order[kept])
                    columns.append(np.roll(order, -1)[kept])
                    weights.append(self.radii[index] * steps[kept])
        source, sink = 2 * count, 2 * count + 1
        starts, goals = np.flatnonzero(first == 0) * 2, np.flatnonzero(last == 1) * 2 + 1
        rows += [np.full(len(starts), source), goals]
        columns += [starts, np.full(len(goals), sink)]
        weights += [np.full(len(starts) + len(goals), 0.0)]
        # Zero is no edge of a sparse matrix.
        data = np.maximum(np.concatenate(weights), 1e-15)
        matrix = coo_matrix((data, (np.concatenate(rows), np.concatenate(columns))), shape=(sink + 1, sink + 1))
        # Parallel edges would be added; there are none between different nodes.
        distances, before = dijkstra(matrix.tocsr(), indices=source, return_predecessors=True)
        if not math.isfinite(distances[sink]):
            return None
        nodes = [int(before[sink])]
        while before[nodes[-1]] != source:
            nodes.append(int(before[nodes[-1]]))
        return self._pieces(nodes[::-1], arcs, turns, points.reshape(-1, 2))

    def _pieces(
        self, nodes: Sequence[int], arcs: np.ndarray, turns: np.ndarray, points: np.ndarray
    ) -> list[PlanePiece]:
        """Return the pieces along nodes; arcs around one corner are one piece."""
        pieces: list[PlanePiece] = []
        for a, b in itertools.pairwise(nodes):
            if a // 2 == b // 2:
                pieces.append(PlanePiece(points[a], points[b], float(np.hypot(*(points[b] - points[a])))))
                continue
            centre, side = self.centres[arcs[a]], int(turns[a])
            angles = [math.atan2(*(points[node] - centre)[::-1]) for node in (a, b)]
            length = float(self.radii[arcs[a]]) * math.remainder(side * (angles[1] - angles[0]), 2 * math.pi)
            if length < 0.0:
                length += 2 * math.pi * float(self.radii[arcs[a]])
            last = pieces[-1]
            start = points[a]
            if last.centre is not None and (last.centre == centre).all():
                pieces.pop()
                start, length = last.start, last.length + length
            pieces.append(PlanePiece(start, points[b], length, centre, side, int(self.owners[arcs[a]])))
        return [piece for piece in pieces if piece.length > TOLERANCE]

    def _tangents(self) -> tuple[np.ndarray, ...]:
        """Return first and last arcs, sides (N, 2), ends (N, 2, 2) and lengths of the tangents that are free."""
        count = len(self.centres)
        first, last = (array.ravel() for array in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
        kept = (first != last) & (first != 1) & (last != 0)
        first, last = first[kept], last[kept]
        found = []
        for one in (1, -1):
            for two in (1, -1):
                # The sides of the start and of the goal do not matter.
                use = ~((one == -1) & (first == 0)) & ~((two == -1) & (last == 1))
                found.append(self._tangents_of(first[use], last[use], one, two))
        return tuple(np.concatenate(columns) for columns in zip(*found, strict=True))

    def _tangents_of(self, first: np.ndarray, last: np.ndarray, one: int, two: int) -> tuple[np.ndarray, ...]:
        """Return the free tangents between arcs with given sides, see `_tangents`."""
        across = self.centres[last] - self.centres[first]
        distance = np.hypot(*across.T)
        offset = two * self.radii[last] - one * self.radii[first]
        exists = distance > np.abs(offset) + TOLERANCE
        first, last, across, distance, offset = (a[exists] for a in (first, last, across, distance, offset))
        direction = np.arctan2(across[:, 1], across[:, 0]) + np.arcsin(-offset / distance)
        right = np.stack([np.sin(direction), -np.cos(direction)], axis=1)
        starts = self.centres[first] + one * self.radii[first, None] * right
        ends = self.centres[last] + two * self.radii[last, None] * right
        free = self.obstacles.lines_are_free(starts, ends)
        sides = np.tile([one, two], (int(free.sum()), 1))
        points = np.stack([starts[free], ends[free]], axis=1)
        return first[free], last[free], sides, points, np.hypot(*(ends[free] - starts[free]).T)

    def _masks(self) -> np.ndarray:
        """Return for each arc the numbers (K, 2 ANGLES + 1) of blocked directions before each of two rounds."""
        angles = np.arange(ANGLES) * (2 * math.pi / ANGLES)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        masks = np.zeros((len(self.centres), 2 * ANGLES + 1), dtype=int)
        for index, (centre, radius) in enumerate(zip(self.centres, self.radii, strict=True)):
            blocked = ~self.obstacles.are_free(centre + radius * circle)
            masks[index, 1:] = np.cumsum(np.tile(blocked, 2))
        return masks

    def _is_arc_free(self, mask: np.ndarray, angle: float, turn: float) -> bool:
        """Return whether no direction of an arc from an angle by a signed turn is blocked."""
        low = min(angle, angle + turn) / (2 * math.pi) * ANGLES
        high = max(angle, angle + turn) / (2 * math.pi) * ANGLES
        shift = ANGLES * math.floor(low / ANGLES)
        begin, end = math.ceil(low - shift), math.floor(high - shift)
        return end < begin or mask[end + 1] == mask[begin]
