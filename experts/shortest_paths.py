"""Kernels of the lattice search: the graph, its shortest paths, and the paths through chosen nodes.

A node is a cell (i, j) and one of 16 headings; its number is (i * lines + j) * HEADINGS + heading. `speed` holds
sqrt(2 (E + Phi)) on the half-cell grid, infinite where the robot must not be, so an edge costs its length in the
weights' metric times the mean speed along it. The BORDER outermost cells are never free: no move leaves the grid.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.compiling import njit
from leapnav.experts.integrator import matrix, vector

# 16 headings whose directions are exact lattice vectors, so a straight move never drifts off its line.
_QUADRANT = np.array([(1, 0), (2, 1), (1, 1), (1, 2)], dtype=np.int64)
_QUARTER_TURN = np.array([(0, 1), (-1, 0)], dtype=np.int64)
DIRECTIONS = np.concatenate([_QUADRANT @ np.linalg.matrix_power(_QUARTER_TURN, k) for k in range(4)])
ANGLES = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) % (2 * np.pi)
HEADINGS = len(ANGLES)
BORDER = 2  # cells, the reach of the longest move


def _moves() -> np.ndarray:
    """Moves from each heading: rows (cells x, cells y, heading change) of shape (HEADINGS, 12, 3).

    Forwards and backwards: straight, or one heading step to either side along the old or the new heading (each the
    other's reverse, so the graph is symmetric). Then the turns on the spot.
    """
    table = []
    for heading in range(HEADINGS):
        rows = []
        for gear in (1, -1):
            rows.append((*(gear * DIRECTIONS[heading]), 0))
            for change in (1, -1):
                rows.append((*(gear * DIRECTIONS[heading]), change))
                rows.append((*(gear * DIRECTIONS[(heading + change) % HEADINGS]), change))
        table.append([*rows, (0, 0, 1), (0, 0, -1)])
    return np.array(table, dtype=np.int64)


MOVES = _moves()
MOVES.flags.writeable = False
numbers = types.Array(types.int64, 1, "C")
indices = types.Array(types.int32, 1, "C")
links_type = types.Array(types.int32, 2, "C")
# A ring of buckets, and how many of them the least cost of a path from end to end fills.
BUCKETS, BUCKETS_PER_COST = 4096, 2000
FARTHEST = 1e15


@njit(vector(matrix, numbers, vector, float64, float64), cache=True, error_model="numpy", nogil=True)
def plane_costs(speed, seeds, seed_costs, cell, speed_weight):
    """Cost from the seeds (cells) to every cell if turning were free: a lower bound of the lattice's own costs."""
    lines, stride = (speed.shape[1] + 1) // 2, speed.shape[1]
    flat = speed.ravel()
    cost = np.full((speed.shape[0] + 1) // 2 * lines, np.inf)
    ahead, middle, length = np.empty(HEADINGS, np.int64), np.empty(HEADINGS, np.int64), np.empty(HEADINGS)
    for k in range(HEADINGS):
        dx, dy = DIRECTIONS[k]
        ahead[k], middle[k] = dx * lines + dy, dx * stride + dy
        length[k] = math.sqrt(speed_weight * (dx * dx + dy * dy)) * cell / 6.0
    queue = [(0.0, 0)]
    queue.pop()
    for k in range(len(seeds)):
        if seed_costs[k] < cost[seeds[k]]:
            cost[seeds[k]] = seed_costs[k]
            heapq.heappush(queue, (seed_costs[k], seeds[k]))
    while len(queue) > 0:
        key, node = heapq.heappop(queue)
        if key > cost[node]:
            continue
        here = 2 * (node // lines) * stride + 2 * (node % lines)
        for k in range(HEADINGS):
            following = node + ahead[k]
            total = key + length[k] * (flat[here] + 4.0 * flat[here + middle[k]] + flat[here + 2 * middle[k]])
            if total < cost[following]:
                cost[following] = total
                heapq.heappush(queue, (total, following))
    return cost


@njit(int64(indices, links_type, int64), cache=True, nogil=True)
def _dequeue(bucket, links, node):
    """Takes a node out of its bucket; returns 1, or 0 if it is in none."""
    place = links[node, 2]
    if place < 0:
        return 0
    before, after = links[node, 0], links[node, 1]
    if before >= 0:
        links[before, 1] = after
    else:
        bucket[place] = after
    if after >= 0:
        links[after, 0] = before
    links[node, 2] = -1
    return 1


@njit(int64(indices, links_type, int64, int64), cache=True, nogil=True)
def _enqueue(bucket, links, node, place):
    """Puts a node into a bucket, out of the one that it may be in; returns by how many nodes the queue grew.

    `links` (nodes, 3): the node before and the one after in the bucket's chain, and the bucket (-1: none).
    """
    grown = 1 - _dequeue(bucket, links, node)
    head = bucket[place]
    links[node, 0], links[node, 1], links[node, 2] = -1, head, place
    if head >= 0:
        links[head, 0] = node
    bucket[place] = node
    return grown


@njit(
    types.Tuple((vector, indices, float64))(
        matrix, numbers, vector, numbers, vector, vector, boolean, float64, float64, float64, float64, float64, float64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def tree(
    speed, seeds, seed_costs, targets, target_costs, rest, exact, cell, speed_weight, turn_weight, reach, slack, limit
):
    """Cost from the seeds to every node worth it, and its predecessor (-1: none); A* with the lower bounds `rest`.

    `rest` holds what remains to the targets at least: per cell, or, if `exact`, per node. Nodes through which paths
    cost more than `limit` are left out; it becomes `reach` times the cost of the best target, and `slack` more, once
    that is known, and is returned.
    """
    lines, stride = (speed.shape[1] + 1) // 2, speed.shape[1]
    flat = speed.ravel()
    size = (speed.shape[0] + 1) // 2 * lines * HEADINGS
    cost = np.full(size, np.inf)
    parent = np.full(size, -1, dtype=np.int32)
    arrival = np.full(size, np.inf)
    for k in range(len(targets)):
        arrival[targets[k]] = min(arrival[targets[k]], target_costs[k])
    count = MOVES.shape[1]
    ahead, cells = np.empty((HEADINGS, count), np.int64), np.empty((HEADINGS, count), np.int64)
    middle, length = np.empty((HEADINGS, count), np.int64), np.empty((HEADINGS, count))
    for k in range(HEADINGS):
        for number in range(count):
            dx, dy, change = MOVES[k, number]
            other = (k + change) % HEADINGS
            turn = abs(ANGLES[other] - ANGLES[k])
            turn = min(turn, 2.0 * math.pi - turn)
            cells[k, number] = dx * lines + dy
            ahead[k, number] = (dx * lines + dy) * HEADINGS + other - k
            middle[k, number] = dx * stride + dy
            square = speed_weight * (dx * dx + dy * dy) * cell * cell + turn_weight * turn * turn
            length[k, number] = math.sqrt(square) / 6.0
    first = np.inf
    for k in range(len(seeds)):
        first = min(first, seed_costs[k] + (rest[seeds[k]] if exact else rest[seeds[k] // HEADINGS]))
    if first == np.inf:
        return cost, parent, limit
    # Within a bucket the order is arbitrary: a node that turns out cheaper later is queued again.
    width = max(first, slack) / BUCKETS_PER_COST
    bucket = np.full(BUCKETS, -1, dtype=np.int32)
    links = np.full((size, 3), -1, dtype=np.int32)
    current, waiting = 0, 0
    for k in range(len(seeds)):
        node = seeds[k]
        bound = seed_costs[k] + (rest[node] if exact else rest[node // HEADINGS])
        # From a seed without a way to the targets `rest` is infinite, as is the limit as long as it is not known.
        if seed_costs[k] < cost[node] and bound <= limit and bound < np.inf:
            cost[node] = seed_costs[k]
            waiting += _enqueue(bucket, links, node, int(min((bound - first) / width, BUCKETS - 1.0)))
    best = np.inf
    while waiting > 0:
        node = bucket[current % BUCKETS]
        if node < 0:
            current += 1
            continue
        waiting -= _dequeue(bucket, links, node)
        key = cost[node]
        k = node % HEADINGS
        position = node // HEADINGS
        if key + (rest[node] if exact else rest[position]) > limit:
            continue
        if key + arrival[node] < best:
            best = key + arrival[node]
            limit = min(limit, reach * best + slack)
        here = 2 * (position // lines) * stride + 2 * (position % lines)
        for number in range(count):
            following = node + ahead[k, number]
            between = middle[k, number]
            total = key + length[k, number] * (flat[here] + 4.0 * flat[here + between] + flat[here + 2 * between])
            if total < cost[following]:
                bound = total + (rest[following] if exact else rest[position + cells[k, number]])
                if bound <= limit and bound < np.inf:
                    cost[following] = total
                    parent[following] = node
                    # Farther ahead than the ring of buckets is long is treated as less far: early, but not wrong.
                    # (Held below what an integer can be: deep in an obstacle whose scale is tiny a cost is 1e40.)
                    place = min(max(int(min((bound - first) / width, FARTHEST)), current), current + BUCKETS - 1)
                    waiting += _enqueue(bucket, links, following, place % BUCKETS)
    return cost, parent, limit


@njit(numbers(indices, indices, vector, vector, float64), cache=True, nogil=True)
def meeting_nodes(ahead, behind, cost_ahead, cost_behind, limit):
    """Nodes at which the two trees share an edge, in order of the cost of the path through them, up to `limit`.

    Only there is a path through a node as short as any from a little before it to a little behind it; through all other
    nodes it is a detour. (These are the plateaus of the alternative routes of road maps: Abraham et al., Alternative
    Routes in Road Networks, 2013.)
    """
    found = np.empty(len(ahead), dtype=np.int64)
    through = np.empty(len(ahead))
    count = 0
    for node in range(len(ahead)):
        total = cost_ahead[node] + cost_behind[node]
        if total <= limit and (behind[node] < 0 or ahead[behind[node]] == node):
            found[count], through[count] = node, total
            count += 1
    return found[:count][np.argsort(through[:count])]


@njit(numbers(int64, indices, indices), cache=True, nogil=True)
def path_through(node, ahead, behind):
    """Nodes of the path through one, from a seed of the tree `ahead` to a seed of the tree `behind`."""
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


@njit(types.void(boolean[::1], numbers, int64, int64, int64), cache=True, nogil=True)
def mark(taken, path, lines, cells, headings):
    """Marks the nodes within `cells` in x and y and `headings` steps of heading of a path."""
    columns = len(taken) // (lines * HEADINGS)
    for node in path:
        i, j, k = node // (lines * HEADINGS), node // HEADINGS % lines, node % HEADINGS
        for a in range(max(0, i - cells), min(columns, i + cells + 1)):
            for b in range(max(0, j - cells), min(lines, j + cells + 1)):
                for c in range(k - headings, k + headings + 1):
                    taken[(a * lines + b) * HEADINGS + c % HEADINGS] = True


@njit(float64(vector, vector, float64), cache=True, error_model="numpy", nogil=True)
def energy_of(lengths, phi, horizon):
    """E such that a path of these lengths, in the weights' metric, and Phi takes the horizon; by bisection on log E."""
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
