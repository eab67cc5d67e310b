"""Shortest paths on the lattice for any motion primitives, and with speeds that depend on the heading (kernel).

`leapnav.experts.search.shortest_paths.tree` is the same for robots that rotate in place and have one layer of speeds.
There the moves are constants of the machine code, and a search takes about 3/4 of the time.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, float64

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import INDICES, VECTOR, tuple_of
from leapnav.envs.robots.moves import HEADINGS
from leapnav.experts.search.shortest_paths import (
    BUCKETS,
    BUCKETS_PER_COST,
    LIMITS,
    MAX_BUCKET_INDEX,
    METRIC,
    NODES,
    dequeue,
    enqueue,
)


@kernel(tuple_of(VECTOR, INDICES, float64)(METRIC, NODES, NODES, VECTOR, boolean, LIMITS))
def general_tree(metric, seeds, ends, rest, exact, limits):
    """Compute the tree of shortest paths from the seeds as `shortest_paths.tree`, for any moves.

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
    first = np.inf
    for k in range(len(seeds.nodes)):
        node = seeds.nodes[k]
        first = min(first, seeds.costs[k] + (rest[node] if exact else rest[node // HEADINGS]))
    if first == np.inf:
        return cost, parent, limit
    # The order within a bucket is arbitrary: a node whose cost decreases later is queued again.
    width = max(first, slack) / BUCKETS_PER_COST
    bucket = np.full(BUCKETS, -1, dtype=np.int32)
    links = np.full((size, 3), -1, dtype=np.int32)
    current, waiting = 0, 0
    for k in range(len(seeds.nodes)):
        node = seeds.nodes[k]
        bound = seeds.costs[k] + (rest[node] if exact else rest[node // HEADINGS])
        # `rest` is infinite for a seed without a path to the ends, and so is the limit while it is unknown.
        if seeds.costs[k] < cost[node] and bound <= limit and bound < np.inf:
            cost[node] = seeds.costs[k]
            waiting += enqueue(bucket, links, node, int(min((bound - first) / width, BUCKETS - 1.0)))
    best = np.inf
    while waiting > 0:
        node = bucket[current % BUCKETS]
        if node < 0:
            current += 1
            continue
        waiting -= dequeue(bucket, links, node)
        key = cost[node]
        k = node % HEADINGS
        position = node // HEADINGS
        if key + (rest[node] if exact else rest[position]) > limit:
            continue
        if key + arrival[node] < best:
            best = key + arrival[node]
            limit = min(limit, reach * best + slack)
        here = 2 * (position // lines) * stride + 2 * (position % lines)
        for move in range(count):
            following = node + ahead[k, move]
            total = key
            for part in range(n_parts):
                edge = flat[here + begin[k, move, part]] + 4.0 * flat[here + middle[k, move, part]]
                total += length[k, move, part] * (edge + flat[here + end[k, move, part]])
            if total < cost[following]:
                bound = total + (rest[following] if exact else rest[position + cells[k, move]])
                if bound <= limit and bound < np.inf:
                    cost[following] = total
                    parent[following] = node
                    # A node beyond the last bucket is put into the last bucket: it may be visited early, and is queued
                    # again if its cost decreases later.
                    index = min(
                        max(int(min((bound - first) / width, MAX_BUCKET_INDEX)), current), current + BUCKETS - 1
                    )
                    waiting += enqueue(bucket, links, following, index % BUCKETS)
    return cost, parent, limit
