"""Shortest paths of a point among discs by a visibility graph of circumscribed polygons, independent of the package."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

SIDES = 180  # of the polygon around a disc, which is longer than the circle by 0.01 %


def shortest_length(start: np.ndarray, goal: np.ndarray, discs: np.ndarray) -> float:
    """Return the length of the shortest path that keeps out of discs (K, 3), too long by at most 0.01 %.

    The corners are those of regular polygons around the discs. An edge of the graph is a line between two corners that
    enters no disc and leaves both polygons on one side, as every line of a shortest path does.
    """
    angles = np.arange(SIDES) * (2 * math.pi / SIDES)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1) / math.cos(math.pi / SIDES)
    corners = np.concatenate([np.stack([start, goal]), *[(x, y) + r * circle for x, y, r in discs]])
    count = len(corners)
    index = np.arange(2, count)
    disc, side = np.divmod(index - 2, SIDES)
    before, after = np.arange(count), np.arange(count)
    before[2:], after[2:] = 2 + SIDES * disc + (side - 1) % SIDES, 2 + SIDES * disc + (side + 1) % SIDES
    # Corners inside other discs belong to no path.
    kept = np.array([all(np.hypot(*(corner - (x, y))) >= r - 1e-9 for x, y, r in discs) for corner in corners])
    rows, columns, lengths = [], [], []
    for k in np.flatnonzero(kept):
        others = np.flatnonzero(kept[k + 1 :]) + k + 1
        line = corners[others] - corners[k]
        supports = np.ones(len(others), dtype=bool)
        for own in (np.full(len(others), k), others):
            one, two = (_cross(line, corners[near[own]] - corners[own]) for near in (before, after))
            supports &= one * two >= -1e-9
        others, line = others[supports], line[supports]
        squared = np.maximum((line**2).sum(axis=1), 1e-300)
        free = np.ones(len(others), dtype=bool)
        for x, y, r in discs:
            to_centre = np.array([x, y]) - corners[k]
            fraction = ((line @ to_centre) / squared).clip(0, 1)
            free &= np.hypot(*(fraction[:, None] * line - to_centre).T) >= r - 1e-9
        rows.append(np.full(int(free.sum()), k))
        columns.append(others[free])
        lengths.append(np.sqrt(squared[free]))
    graph = coo_matrix((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    return float(dijkstra(graph.tocsr(), directed=False, indices=0)[1])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
