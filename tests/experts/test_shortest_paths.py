from itertools import pairwise

import numpy as np
import pytest
from helpers import best_known
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from leapnav.envs.robots.moves import ANGLES, DIRECTIONS, HEADINGS, curved_moves, rotating_moves
from leapnav.experts import OptimalControlProblem, Trajectory
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.shortest_paths import (
    Limits,
    Metric,
    Nodes,
    enqueue,
    meeting_nodes,
    path_through,
    plane_costs,
    tree,
    with_room,
)
from leapnav.experts.transcription.direct import discretise, optimise

COLUMNS, LINES, CELL, SPEED_WEIGHT, TURN_WEIGHT = 18, 16, 0.3, 1.5, 0.4
MOVES = {
    "rotating": rotating_moves(CELL, SPEED_WEIGHT, TURN_WEIGHT),
    "curved": curved_moves(CELL, SPEED_WEIGHT, TURN_WEIGHT, (0.7, 0.7)),  # one cell along each heading
    "rotating backwards": rotating_moves(CELL, SPEED_WEIGHT, TURN_WEIGHT, modes=(-1,)),
    "curved ahead": curved_moves(CELL, SPEED_WEIGHT, TURN_WEIGHT, (0.7, 0.6), modes=(1,)),
}


def random_speed(seed, closed=0.1):
    """Return speeds on the half-cell grid with some closed cells, and the border that the kernels require."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.5, 2.0, (2 * COLUMNS - 1, 2 * LINES - 1))
    speed[rng.random(speed.shape) < closed] = np.inf
    for side in (np.s_[:8], np.s_[-8:]):
        speed[side] = speed[:, side] = np.inf
    return speed


def node(i, j, heading):
    return (i * LINES + j) * HEADINGS + heading


def graph(speed, moves):
    """Return the lattice as an explicit graph, from the definition of its edges."""
    heads, tails, weights = [], [], []
    for i in range(4, COLUMNS - 4):
        for j in range(4, LINES - 4):
            for k in range(HEADINGS):
                for move, (dx, dy, change) in enumerate(moves.targets[k]):
                    other = (k + change) % HEADINGS
                    points = moves.points[k, move] + (2 * i, 2 * j)
                    speeds = speed[points[:, 0], points[:, 1]]
                    if not np.isfinite(speeds).all():
                        continue
                    turn = (ANGLES[other] - ANGLES[k] + np.pi) % (2 * np.pi) - np.pi
                    if moves.points.shape[2] == 3:
                        length = np.sqrt(SPEED_WEIGHT * (dx**2 + dy**2) * CELL**2 + TURN_WEIGHT * turn**2)
                        cost = length * (speeds[0] + 4 * speeds[1] + speeds[2]) / 6
                    else:  # along the old heading, then along the new one
                        headings = [k, other] if change else [k]
                        parts = np.sqrt(SPEED_WEIGHT) * CELL * np.hypot(*DIRECTIONS[headings].T)
                        means = [speeds[2 * p : 2 * p + 3] @ [1, 4, 1] / 6 for p in range(len(parts))]
                        cost = parts @ means * np.hypot(parts.sum(), np.sqrt(TURN_WEIGHT) * turn) / parts.sum()
                    heads.append(node(i, j, k))
                    tails.append(node(i + dx, j + dy, other))
                    weights.append(cost)
    size = COLUMNS * LINES * HEADINGS
    return coo_array((weights, (heads, tails)), shape=(size, size)).tocsr()


def ends(speed, moves):
    """Return the first and the last free node; if the robot cannot reverse, the last one that it reaches."""
    free = np.argwhere(np.isfinite(speed[::2, ::2]))
    start = node(*free[0], 3)
    if moves.reversible:
        return start, node(*free[-1], 9)
    return start, int(np.flatnonzero(np.isfinite(dijkstra(graph(speed, moves), indices=start)))[-1])


def trees(speed, reach, moves, layers=1):
    start, goal = ends(speed, moves)
    root, target = Nodes(np.array([start]), np.zeros(1)), Nodes(np.array([goal]), np.zeros(1))
    layered = np.repeat(speed[None], layers, axis=0)
    metric = Metric(layered, speed, CELL, SPEED_WEIGHT, TURN_WEIGHT, moves.targets, moves.points, moves.weights)
    moves = moves.reverse()
    back = metric._replace(targets=moves.targets, points=moves.points, weights=moves.weights)
    bound = plane_costs(metric, root._replace(nodes=root.nodes // HEADINGS))
    behind = tree(back, target, root, bound, False, Limits(reach, 0.5, np.inf))
    ahead = tree(metric, root, target, behind[0], True, Limits(reach, 0.5, behind[2]))
    return start, goal, bound, ahead, behind


def test_the_queue_keeps_its_entries_when_it_grows():
    bucket, entries = np.full(2, -1, dtype=np.int32), np.empty((2, 2), dtype=np.int32)
    for entry, (node, index) in enumerate([(7, 0), (8, 1), (9, 0), (7, 0), (5, 0)]):
        entries = with_room(entries, entry + 1)
        enqueue(bucket, entries, entry, node, index)
    assert len(entries) == 8
    found, entry = [], bucket[0]
    while entry >= 0:
        found.append(entries[entry, 0])
        entry = entries[entry, 1]
    assert found == [5, 7, 9, 7]


@pytest.mark.parametrize("layers", [1, HEADINGS])
@pytest.mark.parametrize("kind", MOVES)
@pytest.mark.parametrize("seed", range(3))
def test_the_trees_have_the_costs_of_an_independent_dijkstra(seed, kind, layers):
    speed = random_speed(seed, 0.1 if MOVES[kind].reversible else 0.01)
    start, goal, bound, (ahead, _, limit), (behind, _, same_limit) = trees(speed, 1.3, MOVES[kind], layers)
    edges = graph(speed, MOVES[kind])
    from_start = dijkstra(edges, indices=start)
    from_goal = dijkstra(edges.T, indices=goal)
    best = from_start[goal]
    assert np.isfinite(best)
    assert limit == pytest.approx(1.3 * best + 0.5)
    assert same_limit == pytest.approx(limit)
    assert behind[start] == pytest.approx(best)
    assert ahead[goal] == pytest.approx(best)
    # Every node on a path within the limit is found at its true cost, and no other in the second tree.
    through = from_start + from_goal
    within = through <= limit * (1 - 1e-12)
    assert within.sum() > (20 if MOVES[kind].reversible else 4)
    assert ahead[within] == pytest.approx(from_start[within])
    assert behind[within] == pytest.approx(from_goal[within])
    assert not np.isfinite(ahead[through > limit * (1 + 1e-12)]).any()
    # The plane's costs bound the lattice's from below.
    cells = np.arange(COLUMNS * LINES * HEADINGS) // HEADINGS
    finite = np.isfinite(from_start)
    assert (bound[cells[finite]] <= from_start[finite] + 1e-9).all()


def test_paths_through_meeting_nodes_are_paths_of_their_cost():
    speed = random_speed(1)
    start, goal, _, (ahead, parent, limit), (behind, child, _) = trees(speed, 1.5, MOVES["rotating"])
    nodes, costs = meeting_nodes(parent, child, ahead, behind, limit)
    np.testing.assert_array_equal(costs, (ahead + behind)[nodes])
    assert costs.min() == pytest.approx(ahead[goal])
    edges = graph(speed, MOVES["rotating"])
    for through in nodes[:: max(1, len(nodes) // 20)]:
        path = path_through(through, parent, child)
        assert path[0] == start
        assert path[-1] == goal
        assert through in path
        assert sum(edges[a, b] for a, b in pairwise(path)) == pytest.approx(ahead[through] + behind[through])
        # Both trees contain the edge behind the node, so the path is not a detour there.
        assert child[through] < 0 or parent[child[through]] == through


def test_a_goal_that_cannot_be_reached_leaves_both_trees_apart():
    speed = random_speed(0)
    speed[2 * (COLUMNS // 2) - 2 : 2 * (COLUMNS // 2) + 3] = np.inf
    _, _, _, (ahead, _, limit), (behind, _, _) = trees(speed, 1.3, MOVES["rotating"])
    assert limit == np.inf
    assert not np.isfinite(ahead).any()
    assert not np.isfinite(behind[: COLUMNS // 2 * LINES * HEADINGS]).any()


def test_the_best_path_is_among_the_first_candidates():
    """The search relies on the cost in the metric to rank the candidates."""
    ranks = []
    for scenario, cost in best_known()[::4]:
        problem = OptimalControlProblem.from_scenario(scenario)
        paths = (Trajectory(c.times, c.poses) for c in CandidateSearch(Lattice(scenario)).candidates())
        optima = (optimise(problem.with_winding_of(path.states), discretise(problem, path)).cost for path in paths)
        ranks.append(next(rank for rank, found in enumerate(optima) if found < cost * 1.005))
    assert np.median(ranks) == 0
    assert max(ranks) < 12
