"""Shortest paths on the lattice (kernels): the graph, trees of shortest paths, and the paths through given nodes.

A node is a cell (i, j) with one of 16 headings; its index is (i * lines + j) * HEADINGS + heading. `speed` is
sqrt(2 (E + Phi)) on the half-cell grid, infinite where the robot cannot be. The cost of an edge is its length in the
metric of the weights times the mean speed along it, by Simpson's rule. The outermost cells are never free, so no move
leaves the grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CUBE, FLAGS, INDICES, INTEGERS, LINKS, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.envs.robots.moves import ANGLES, DIRECTIONS, HEADINGS

# Number of buckets of the circular bucket queue, and number of buckets that cover the cost of the shortest path.
BUCKETS, BUCKETS_PER_COST = 4096, 2000
MAX_BUCKET_INDEX = 1e15  # before the conversion to an integer: costs deep in an obstacle may reach 1e40


# The queue. Each bucket is a list: `bucket` has the index of its first entry, an entry the node and the index of the
# next one; -1 is the end. A node whose cost decreases is queued again. Its earlier entry remains and is ignored,
# because the node is not open any more when that entry is reached.
@kernel(NOTHING(INDICES, LINKS, int64, int64, int64))
def enqueue(bucket, entries, entry, node, index):
    """Put a node into a bucket, as a new entry."""
    entries[entry, 0], entries[entry, 1] = node, bucket[index]
    bucket[index] = entry


@kernel(LINKS(LINKS, int64))
def with_room(entries, count):
    """Return the entries of a queue, of which `count` are needed, in a larger array if necessary."""
    return entries if count <= len(entries) else np.concatenate((entries, np.empty_like(entries)))


class Metric(NamedTuple):
    """The metric of the lattice.

    Attributes:
        speed: (K, ...), sqrt(2 (E + Phi)) on the half-cell grid, infinite where the robot cannot be; one layer for all
            headings, or one for each.
        plane: its minimum over the layers.
        cell: side of a cell (m).
        speed_weight: weight of squared distances.
        turn_weight: weight of squared changes of the heading.
        targets, points, weights: the robot's moves, see `leapnav.envs.robots.moves.Moves`.

    """

    speed: np.ndarray
    plane: np.ndarray
    cell: float
    speed_weight: float
    turn_weight: float
    targets: np.ndarray
    points: np.ndarray
    weights: np.ndarray


class Nodes(NamedTuple):
    """Nodes around the start or the goal.

    Attributes:
        nodes: (N,), indices.
        costs: (N,), costs between the pose and the nodes.

    """

    nodes: np.ndarray
    costs: np.ndarray


class Limits(NamedTuple):
    """Limits of the cost of the paths that `tree` finds.

    Attributes:
        reach: largest cost relative to the cost of the shortest path.
        slack: cost added to that.
        limit: largest cost; infinite if the cost of the shortest path is unknown.

    """

    reach: float
    slack: float
    limit: float


METRIC = record_type(
    Metric,
    speed=CUBE,
    plane=MATRIX,
    cell=float64,
    speed_weight=float64,
    turn_weight=float64,
    targets=types.Array(int64, 3, "C", readonly=True),
    points=int64[:, :, :, ::1],
    weights=CUBE,
)
NODES = record_type(Nodes, nodes=INTEGERS, costs=VECTOR)
LIMITS = record_type(Limits, reach=float64, slack=float64, limit=float64)


@kernel(VECTOR(METRIC, NODES))
def plane_costs(metric, seeds):
    """Return the cost from the seeds (cells) to every cell if rotation were free, a lower bound on the lattice.

    This is a label-correcting search with a bucket queue; it gives the same costs as Dijkstra's algorithm.
    """
    speed = metric.plane
    lines, stride = (speed.shape[1] + 1) // 2, speed.shape[1]
    size = (speed.shape[0] + 1) // 2 * lines
    flat = speed.ravel()
    cost = np.full(size, np.inf)
    ahead, middle, length = np.empty(HEADINGS, np.int64), np.empty(HEADINGS, np.int64), np.empty(HEADINGS)
    for k in range(HEADINGS):
        dx, dy = DIRECTIONS[k, 0], DIRECTIONS[k, 1]
        ahead[k], middle[k] = dx * lines + dy, dx * stride + dy
        length[k] = math.sqrt(metric.speed_weight * (dx * dx + dy * dy)) * metric.cell / 6.0
    min_speed = np.inf
    for k in range(len(flat)):
        min_speed = min(min_speed, flat[k])
    width = 3.0 * min_speed * length[0]  # half of the cheapest edge
    bucket, is_open = np.full(BUCKETS, -1, dtype=np.int32), np.zeros(size, dtype=np.bool_)
    entries = np.empty((max(2 * size, len(seeds.nodes)), 2), dtype=np.int32)
    current, visited, queued = 0, 0, 0
    for k in range(len(seeds.nodes)):
        node = seeds.nodes[k]
        if seeds.costs[k] < cost[node]:
            cost[node], is_open[node] = seeds.costs[k], True
            enqueue(bucket, entries, queued, node, int(min(seeds.costs[k] / width, BUCKETS - 1.0)))
            queued += 1
    while visited < queued:
        entry = bucket[current % BUCKETS]
        if entry < 0:
            current += 1
            continue
        node, bucket[current % BUCKETS] = entries[entry, 0], entries[entry, 1]
        visited += 1
        if not is_open[node]:
            continue
        is_open[node] = False
        entries = with_room(entries, queued + HEADINGS)
        here = 2 * (node // lines) * stride + 2 * (node % lines)
        speed_here = flat[here]
        for k in range(HEADINGS):
            following = node + ahead[k]
            edge = speed_here + 4.0 * flat[here + middle[k]] + flat[here + 2 * middle[k]]
            total = cost[node] + length[k] * edge
            if total < cost[following]:
                cost[following], is_open[following] = total, True
                index = min(max(int(min(total / width, MAX_BUCKET_INDEX)), current), current + BUCKETS - 1)
                enqueue(bucket, entries, queued, following, index % BUCKETS)
                queued += 1
    return cost


@kernel(INDICES(METRIC, VECTOR))
def plane_parents(metric, cost):
    """Return the predecessor of each cell (-1 for none) on the shortest paths with the costs of `plane_costs`."""
    speed = metric.plane
    lines, stride = (speed.shape[1] + 1) // 2, speed.shape[1]
    flat = speed.ravel()
    parent = np.full(len(cost), -1, dtype=np.int32)
    for node in range(len(cost)):
        if cost[node] == np.inf:
            continue
        here = 2 * (node // lines) * stride + 2 * (node % lines)
        lowest = np.inf
        for k in range(HEADINGS):
            dx, dy = DIRECTIONS[k, 0], DIRECTIONS[k, 1]
            before = node + dx * lines + dy
            if before < 0 or before >= len(cost) or cost[before] >= cost[node]:
                continue
            middle = dx * stride + dy
            length = math.sqrt(metric.speed_weight * (dx * dx + dy * dy)) * metric.cell / 6.0
            total = cost[before] + length * (flat[here] + 4.0 * flat[here + middle] + flat[here + 2 * middle])
            # Seeds have a lower cost than any path through their neighbours.
            if total < lowest and total <= cost[node] * (1.0 + 1e-9):
                lowest, parent[node] = total, before
    return parent


@kernel(tuple_of(VECTOR, INDICES, float64)(METRIC, NODES, NODES, VECTOR, boolean, LIMITS))
def tree(metric, seeds, ends, rest, exact, limits):
    """Compute the tree of shortest paths from the seeds by A* search with the lower bounds `rest`.

    `rest` is a lower bound of the remaining cost to the ends, per cell, or per node if `exact`. Nodes are omitted if
    the paths through them cost more than the limit. Once the cost of the best end is known, the limit is `reach`
    times that cost plus `slack`.

    Returns the cost of each node, its predecessor (-1 for none), and the limit.
    """
    speed, targets, weights = metric.speed, metric.targets, metric.weights
    reach, slack, limit = limits.reach, limits.slack, limits.limit
    lines, stride = (speed.shape[2] + 1) // 2, speed.shape[2]
    flat = speed.ravel()
    size = (speed.shape[1] + 1) // 2 * lines * HEADINGS
    layer = 0 if len(speed) == 1 else speed.shape[1] * stride
    cost = np.full(size, np.inf)
    parent = np.full(size, -1, dtype=np.int32)
    arrival = np.full(size, np.inf)
    for k in range(len(ends.nodes)):
        arrival[ends.nodes[k]] = min(arrival[ends.nodes[k]], ends.costs[k])
    count, n_parts = targets.shape[1], weights.shape[2] // 2
    ahead, cells = np.empty((HEADINGS, count), np.int64), np.empty((HEADINGS, count), np.int64)
    # Simpson's rule on each straight part of a move: offsets of its three points, and 1/6 of its length.
    begin, middle = np.empty((HEADINGS, count, n_parts), np.int64), np.empty((HEADINGS, count, n_parts), np.int64)
    end, length = np.empty((HEADINGS, count, n_parts), np.int64), np.empty((HEADINGS, count, n_parts))
    for k in range(HEADINGS):
        for move in range(count):
            dx, dy, change = targets[k, move]
            other = (k + change) % HEADINGS
            cells[k, move] = dx * lines + dy
            ahead[k, move] = (dx * lines + dy) * HEADINGS + other - k
            for part in range(n_parts):
                at = metric.points[k, move, 2 * part : 2 * part + 3]
                before, after = (k, k) if 2 * part + 2 <= n_parts else (other, other)
                if n_parts == 1:
                    after = other
                begin[k, move, part] = layer * before + at[0, 0] * stride + at[0, 1]
                middle[k, move, part] = layer * before + at[1, 0] * stride + at[1, 1]
                end[k, move, part] = layer * after + at[2, 0] * stride + at[2, 1]
                length[k, move, part] = 0.25 * weights[k, move, 2 * part + 1]
    straight = n_parts == 1 and layer == 0  # moves on one straight line
    straight_length = length[:, :, 0].copy()
    first = np.inf
    for k in range(len(seeds.nodes)):
        node = seeds.nodes[k]
        first = min(first, seeds.costs[k] + (rest[node] if exact else rest[node // HEADINGS]))
    if first == np.inf:
        return cost, parent, limit
    # The order within a bucket is arbitrary: a node whose cost decreases later is queued again.
    width = max(first, slack) / BUCKETS_PER_COST
    bucket, is_open = np.full(BUCKETS, -1, dtype=np.int32), np.zeros(size, dtype=np.bool_)
    entries = np.empty((max(2 * size, len(seeds.nodes)), 2), dtype=np.int32)
    current, visited, queued = 0, 0, 0
    for k in range(len(seeds.nodes)):
        node = seeds.nodes[k]
        bound = seeds.costs[k] + (rest[node] if exact else rest[node // HEADINGS])
        # `rest` is infinite for a seed without a path to the ends, and so is the limit while it is unknown.
        if seeds.costs[k] < cost[node] and bound <= limit and bound < np.inf:
            cost[node], is_open[node] = seeds.costs[k], True
            enqueue(bucket, entries, queued, node, int(min((bound - first) / width, BUCKETS - 1.0)))
            queued += 1
    best = np.inf
    while visited < queued:
        entry = bucket[current % BUCKETS]
        if entry < 0:
            current += 1
            continue
        node, bucket[current % BUCKETS] = entries[entry, 0], entries[entry, 1]
        visited += 1
        if not is_open[node]:
            continue
        is_open[node] = False
        key = cost[node]
        k = node % HEADINGS
        position = node // HEADINGS
        if key + (rest[node] if exact else rest[position]) > limit:
            continue
        if key + arrival[node] < best:
            best = key + arrival[node]
            limit = min(limit, reach * best + slack)
        entries = with_room(entries, queued + count)
        here = 2 * (position // lines) * stride + 2 * (position % lines)
        speed_here = flat[here]
        for move in range(count):
            following = node + ahead[k, move]
            if straight:  # saves a quarter of the time
                between = middle[k, move, 0]
                total = key + straight_length[k, move] * (
                    speed_here + 4.0 * flat[here + between] + flat[here + 2 * between]
                )
            else:
                total = key
                for part in range(n_parts):
                    edge = flat[here + begin[k, move, part]] + 4.0 * flat[here + middle[k, move, part]]
                    total += length[k, move, part] * (edge + flat[here + end[k, move, part]])
            if total < cost[following]:
                bound = total + (rest[following] if exact else rest[position + cells[k, move]])
                if bound <= limit and bound < np.inf:
                    cost[following], parent[following], is_open[following] = total, node, True
                    # A node beyond the last bucket is put into the last bucket: it may be visited early, and is queued
                    # again if its cost decreases later.
                    index = min(
                        max(int(min((bound - first) / width, MAX_BUCKET_INDEX)), current), current + BUCKETS - 1
                    )
                    enqueue(bucket, entries, queued, following, index % BUCKETS)
                    queued += 1
    return cost, parent, limit


@kernel(tuple_of(INTEGERS, VECTOR)(INDICES, INDICES, VECTOR, VECTOR, float64))
def meeting_nodes(ahead, behind, cost_ahead, cost_behind, limit):
    """Return the nodes at which both trees share an edge, and the costs of the paths through them, up to `limit`.

    Only there the path through a node is locally shortest; through all other nodes it is a detour. (These nodes are the
    plateaus of alternative routes: I. Abraham et al., Alternative Routes in Road Networks, J. Exp. Algorithmics, 2013.)
    """
    found = np.empty(len(ahead), dtype=np.int64)
    through = np.empty(len(ahead))
    count = 0
    for node in range(len(ahead)):
        total = cost_ahead[node] + cost_behind[node]
        if total <= limit and (behind[node] < 0 or ahead[behind[node]] == node):
            found[count], through[count] = node, total
            count += 1
    return found[:count], through[:count]


@kernel(INTEGERS(int64, INDICES, INDICES))
def path_through(node, ahead, behind):
    """Return the nodes of the path through a node, from a seed of the tree `ahead` to a seed of the tree `behind`."""
    before, after = 0, 0
    at = node
    while ahead[at] >= 0:
        at = ahead[at]
        before += 1
    at = node
    while behind[at] >= 0:
        at = behind[at]
        after += 1
    path = np.empty(before + 1 + after, dtype=np.int64)
    at = node
    for k in range(before, -1, -1):
        path[k] = at
        at = ahead[at]
    at = node
    for k in range(before, before + after + 1):
        path[k] = at
        at = behind[at]
    return path


@kernel(NOTHING(FLAGS, INTEGERS, int64, int64, int64))
def mark(marked, path, lines, cells, headings):
    """Mark the nodes within `cells` in x and y and `headings` heading steps of a path."""
    columns = len(marked) // (lines * HEADINGS)
    for node in path:
        i, j, k = node // (lines * HEADINGS), node // HEADINGS % lines, node % HEADINGS
        for a in range(max(0, i - cells), min(columns, i + cells + 1)):
            for b in range(max(0, j - cells), min(lines, j + cells + 1)):
                for c in range(k - headings, k + headings + 1):
                    marked[(a * lines + b) * HEADINGS + c % HEADINGS] = True


@kernel(NOTHING(INTEGERS, int64, float64, float64, float64, MATRIX))
def fill_poses(path, lines, x0, y0, cell, poses):
    """Fill `poses` (N + 2, 3), except for the first and the last one, with those of nodes (N,), unwrapped.

    Args:
        path: nodes.
        lines: cells in y.
        x0, y0: position (m) of the cell (0, 0).
        cell: side of a cell (m).
        poses: x, y (m) and heading (rad), of which the first one is given.

    """
    for k in range(len(path)):
        node = path[k]
        poses[k + 1, 0] = x0 + cell * (node // (lines * HEADINGS))
        poses[k + 1, 1] = y0 + cell * (node // HEADINGS % lines)
        before, angle = poses[k, 2], ANGLES[node % HEADINGS]
        turn = (angle - before) / (2.0 * math.pi)
        poses[k + 1, 2] = angle - 2.0 * math.pi * math.floor(turn + 0.5)


@kernel(float64(VECTOR, VECTOR, float64))
def energy_of(lengths, phi, horizon):
    """Return E for which a path of given lengths and Phi takes the time `horizon`, by bisection on log E."""
    low, high = math.log(1e-6), math.log(1e4)
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        energy = math.exp(middle)
        duration = 0.0
        for k in range(len(lengths)):
            duration += lengths[k] / math.sqrt(2.0 * (energy + phi[k]))
        if duration > horizon:
            low = middle
        else:
            high = middle
    return math.exp(0.5 * (low + high))
