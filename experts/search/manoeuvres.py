"""Manoeuvres in narrow places: paths of arcs on which the footprint does not touch an obstacle, found by hybrid A*.

The poses of a lattice path have one of 16 headings, which is too coarse where the footprint hardly fits. Hybrid A* (D.
Dolgov et al., Path planning for autonomous vehicles in unknown semi-structured environments, International Journal of
Robotics Research 29, 2010) keeps the poses that arcs lead to, and one pose for each cell, heading and driving mode. The
search starts at the goal, which is usually the narrow end, and ends near the start. It minimises the duration at the
limits of the car, which turns its wheels at standstill.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.field.clearance import footprint_clearance, footprint_clearances
from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, MATRIX, VECTOR, tuple_of
from leapnav.envs.robots import Car, DynamicCar, Trailer
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.transcription.direct import DirectPath

CELLS_PER_RADIUS = 16  # cells of the grid per smallest radius of a turn
CELLS_PER_ARC = 1.5  # length of an arc (cells): each arc leaves its cell
STEERING = np.linspace(-math.pi / 2, math.pi / 2, 5)  # states of the steering (rad)
MARGIN_RADII = 6.0  # smallest radii of a turn around start and goal that the grid covers
MAX_NODES, MAX_CELLS = 1_000_000, 50_000_000
# Distances from the obstacles (proximity scales), tried in this order, and costs of a change of the driving mode (s).
CLEARANCES, MODE_COSTS = (1.0, 0.5, 0.1), (0.0, 2.0)
SPEED_FRACTION = 0.7  # of the limits on the path: an initial guess at the limits leaves no room to change it
PIECES = 8  # intervals of an arc, and of a change of the steering by pi / 4


class Grid(NamedTuple):
    """The grid of poses, and the limits of the car.

    Attributes:
        low, high: (2,), corners of the area (m).
        cell: size of a cell (m).
        headings: number of headings.
        curvature: largest curvature (1/m).
        ahead, behind: speeds (m/s, positive) of the driving modes; 0 if there is no such mode.
        steering_rate: rate of the steering state (rad/s).
        mode_cost: cost (s) of a change of the driving mode.
        clearance: smallest clearance (m).

    """

    low: np.ndarray
    high: np.ndarray
    cell: float
    headings: int
    curvature: float
    ahead: float
    behind: float
    steering_rate: float
    mode_cost: float
    clearance: float


GRID = record_type(
    Grid,
    low=VECTOR,
    high=VECTOR,
    cell=float64,
    headings=int64,
    curvature=float64,
    ahead=float64,
    behind=float64,
    steering_rate=float64,
    mode_cost=float64,
    clearance=float64,
)


@kernel(int64(GRID, float64, float64, float64, boolean))
def _index(grid, x, y, heading, ahead):
    """Return the index of a pose and driving mode, -1 outside the grid."""
    if not (grid.low[0] <= x <= grid.high[0] and grid.low[1] <= y <= grid.high[1]):
        return -1
    columns = int((grid.high[1] - grid.low[1]) / grid.cell) + 1
    cell = int((x - grid.low[0]) / grid.cell) * columns + int((y - grid.low[1]) / grid.cell)
    turn = int(heading % (2.0 * math.pi) / (2.0 * math.pi) * grid.headings) % grid.headings
    return 2 * (cell * grid.headings + turn) + (1 if ahead else 0)


@kernel(tuple_of(float64, float64, float64)(VECTOR, float64, float64))
def _along(pose, curvature, length):
    """Return the pose at the end of an arc."""
    turn = curvature * length
    if abs(turn) < 1e-9:
        dx, dy = length, 0.0
    else:
        dx, dy = math.sin(turn) / curvature, (1.0 - math.cos(turn)) / curvature
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + dx * cos - dy * sin, pose[1] + dx * sin + dy * cos, pose[2] + turn


@kernel(MATRIX(GRID, VECTOR, VECTOR, CONSTANT_MATRIX, CONSTANT))
def _arcs(grid, goal, start, outline, field):
    """Return the arcs (K, 5) from a pose near the start to the goal: first pose, state of the steering, and length.

    The length is negative backwards. Without a path, K is 0.
    """
    size = (int((grid.high[0] - grid.low[0]) / grid.cell) + 1) * (int((grid.high[1] - grid.low[1]) / grid.cell) + 1)
    best = np.full(2 * size * grid.headings, np.inf)
    poses, costs = np.empty((MAX_NODES, 3)), np.empty(MAX_NODES)
    parents, moves = np.empty(MAX_NODES, dtype=np.int64), np.empty(MAX_NODES, dtype=np.int64)
    poses[0], costs[0], parents[0], moves[0] = goal, 0.0, -1, -1
    count, found, length = 1, -1, CELLS_PER_ARC * grid.cell
    fastest, tolerance = max(grid.ahead, grid.behind), 2.0 * math.pi / grid.headings
    heap = [(math.hypot(start[0] - goal[0], start[1] - goal[1]) / fastest, 0)]
    pose = np.empty(3)
    while len(heap) > 0 and found < 0:
        _, node = heappop(heap)
        turn = abs((poses[node, 2] - start[2] + math.pi) % (2.0 * math.pi) - math.pi)
        if math.hypot(poses[node, 0] - start[0], poses[node, 1] - start[1]) < grid.cell and turn < tolerance:
            found = node
            break
        at = _index(grid, poses[node, 0], poses[node, 1], poses[node, 2], moves[node] < len(STEERING))
        if costs[node] > best[at]:
            continue
        for move in range(2 * len(STEERING)):
            ahead, steering = move < len(STEERING), STEERING[move % len(STEERING)]
            speed = grid.ahead if ahead else grid.behind
            if speed == 0.0:
                continue
            cost = costs[node] + length / speed
            if moves[node] >= 0:
                before = STEERING[moves[node] % len(STEERING)]
                cost += abs(steering - before) / grid.steering_rate
                if (moves[node] < len(STEERING)) != ahead:
                    cost += grid.mode_cost
            curvature = grid.curvature * math.sin(steering)
            step = -length if ahead else length  # towards the start
            pose[0], pose[1], pose[2] = _along(poses[node], curvature, step)
            at = _index(grid, pose[0], pose[1], pose[2], ahead)
            if at < 0 or cost >= best[at] or footprint_clearance(pose, outline, field)[0] < grid.clearance:
                continue
            pose[0], pose[1], pose[2] = _along(poses[node], curvature, 0.5 * step)
            if footprint_clearance(pose, outline, field)[0] < grid.clearance:
                continue
            if count == MAX_NODES:
                return np.empty((0, 5))
            pose[0], pose[1], pose[2] = _along(poses[node], curvature, step)
            best[at], poses[count], costs[count], parents[count], moves[count] = cost, pose, cost, node, move
            heappush(heap, (cost + math.hypot(pose[0] - start[0], pose[1] - start[1]) / fastest, count))
            count += 1
    arcs = np.empty((count if found >= 0 else 0, 5))
    k = 0
    while found > 0:
        arcs[k, :3], arcs[k, 3] = poses[found], STEERING[moves[found] % len(STEERING)]
        arcs[k, 4] = length if moves[found] < len(STEERING) else -length
        found, k = parents[found], k + 1
    return arcs[:k]


def manoeuvres(scenario: Scenario) -> Iterator[DirectPath]:
    """Yield paths of a car from near the start to the goal, as initial guesses of direct transcription.

    There are none for other robots or for cars that cannot stop, slow down or steer to both sides, and none if start
    and goal are too far from each other for the grid.
    """
    robot, field, outline = scenario.robot, scenario.field, scenario.outline
    if not isinstance(robot, Car) or isinstance(robot, Trailer) or robot.slowest_speed() > 0.0:
        return
    rates = [robot.interval(name) for name in robot.limited if name != "speed"]
    if not all(low < 0.0 < high for low, high in rates):
        return
    start, goal = np.array(scenario.start), np.array(scenario.goal)
    cell, margin = 1.0 / (CELLS_PER_RADIUS * robot.max_curvature), MARGIN_RADII / robot.max_curvature
    low = np.maximum(np.minimum(start, goal)[:2] - margin, scenario.arena[:2])
    high = np.minimum(np.maximum(start, goal)[:2] + margin, scenario.arena[2:])
    # On the tightest turn, the heading changes by one step along an arc.
    headings = math.ceil(2.0 * math.pi * CELLS_PER_RADIUS / CELLS_PER_ARC)
    if 2.0 * headings * math.prod((high - low) / cell + 1.0) > MAX_CELLS:
        return
    behind, ahead = robot.interval("speed")
    steering_rate = min(-robot.interval("steering_rate")[0], robot.interval("steering_rate")[1])
    free = float(footprint_clearances(np.stack([start, goal]), outline, field).min())
    for mode_cost in MODE_COSTS:
        for clearance in CLEARANCES:
            least = min(clearance * scenario.cost.proximity_scale, 0.5 * free)
            limits = robot.max_curvature, max(ahead, 0.0), max(-behind, 0.0), steering_rate
            grid = Grid(low, high, cell, headings, *limits, mode_cost, least)
            arcs = _arcs(grid, goal, start, outline, field)
            if len(arcs):
                yield _guess(scenario, robot, arcs)
                break


def _guess(scenario: Scenario, robot: Car, arcs: np.ndarray) -> DirectPath:
    """Return the path along arcs (K, 5), see `_arcs`, with changes of the steering at standstill."""
    slowest, fastest = robot.interval("steering_rate")
    state = np.array([*arcs[0, :3], scenario.start_state[3], 0.0])
    state[2] += 2.0 * math.pi * round((scenario.start[2] - state[2]) / (2.0 * math.pi))
    steps, states, controls = [], [state], []
    for k in np.flatnonzero(np.append(1.0, np.diff(arcs[:, 3:], axis=0).any(axis=1))).tolist():
        steering, length = arcs[k, 3:].tolist()
        count = next((i for i, arc in enumerate(arcs[k:, 3:]) if arc.tolist() != [steering, length]), len(arcs) - k)
        change = steering - states[-1][3]
        if abs(change) > 1e-9:
            pieces = math.ceil(PIECES * abs(change) / (math.pi / 4))
            rate = SPEED_FRACTION * (fastest if change > 0 else slowest)
            states += [states[-1] + (0.0, 0.0, 0.0, change * (i + 1) / pieces, 0.0) for i in range(pieces)]
            controls += pieces * [(0.0, rate)]
            steps += pieces * [change / rate / pieces]
        start = states[-1]
        for step, control, distance, speed in _drive(robot, count * length, PIECES * count):
            states.append(
                np.array([*_along(start, robot.max_curvature * math.sin(steering), distance), steering, speed])
            )
            controls.append((control, 0.0))
            steps.append(step)
    times = np.append(0.0, np.cumsum(steps))
    stacked = np.ascontiguousarray(np.stack(states)[:, : len(robot.state_names)])
    return DirectPath(times, stacked, np.array(controls), np.zeros_like(stacked), math.inf, math.inf, False)


def _drive(robot: Car, length: float, pieces: int) -> Iterator[tuple[float, float, float, float]]:
    """Yield the intervals of a drive of a given length (m): duration, control, and distance and speed at the end."""
    behind, ahead = robot.interval("speed")
    cruise = SPEED_FRACTION * (ahead if length > 0 else behind)
    if not isinstance(robot, DynamicCar):
        for i in range(pieces):
            yield length / cruise / pieces, cruise, length * (i + 1) / pieces, 0.0
        return
    lowest, highest = robot.interval("acceleration")
    first, last = (highest, lowest) if length > 0 else (lowest, highest)
    per_square = (
        0.5 / SPEED_FRACTION * (1.0 / first - 1.0 / last)
    )  # distance without cruise per square of the top speed
    top = math.copysign(min(abs(cruise), math.sqrt(length / per_square)), length)
    first, last = SPEED_FRACTION * first, SPEED_FRACTION * last
    distance = speed = 0.0
    for acceleration, duration in (
        (first, top / first),
        (0.0, (length - per_square * top**2) / top),
        (last, -top / last),
    ):
        step = duration / pieces
        for _ in range(pieces if duration > 1e-9 else 0):
            distance += (speed + 0.5 * acceleration * step) * step
            speed += acceleration * step
            yield step, acceleration, distance, speed
