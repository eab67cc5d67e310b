from itertools import pairwise

import numpy as np
import pytest
from helpers import best_known
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from leapnav.experts import OptimalControlProblem, Trajectory
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.transcription.direct import discretise, optimise
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.shortest_paths import (
    ANGLES,
    HEADINGS,
    MOVES,
    Limits,
    Metric,
    Nodes,
    meeting_nodes,
    path_through,
    plane_costs,
    tree,
)

COLUMNS, LINES, CELL, SPEED_WEIGHT, TURN_WEIGHT = 14, 12, 0.3, 1.5, 0.4


def random_speed(seed):
    """Return speeds on the half-cell grid with some closed cells, and the border that the kernels require."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.5, 2.0, (2 * COLUMNS - 1, 2 * LINES - 1))
    speed[rng.random(speed.shape) < 0.1] = np.inf
    for side in (np.s_[:4], np.s_[-4:]):
        speed[side] = speed[:, side] = np.inf
    return speed


def node(i, j, heading):
    return (i * LINES + j) * HEADINGS + heading


def graph(speed):
    """Return the lattice as an explicit graph, from the definition of its edges."""
    heads, tails, weights = [], [], []
    for i in range(2, COLUMNS - 2):
        for j in range(2, LINES - 2):
            for k in range(HEADINGS):
                for dx, dy, change in MOVES[k]:
                    other = (k + change) % HEADINGS
                    mean = speed[2 * i, 2 * j] + 4 * speed[2 * i + dx, 2 * j + dy] + speed[2 * (i + dx), 2 * (j + dy)]
                    if np.isfinite(mean):
                        turn = (ANGLES[other] - ANGLES[k] + np.pi) % (2 * np.pi) - np.pi
                        length = np.sqrt(SPEED_WEIGHT * (dx**2 + dy**2) * CELL**2 + TURN_WEIGHT * turn**2)
                        heads.append(node(i, j, k))
                        tails.append(node(i + dx, j + dy, other))
                        weights.append(length * mean / 6)
    size = COLUMNS * LINES * HEADINGS
    return coo_array((weights, (heads, tails)), shape=(size, size)).tocsr()


def ends(speed):
    free = np.argwhere(np.isfinite(speed[::2, ::2]))
    return node(*free[0], 3), node(*free[-1], 9)


def trees(speed, reach):
    start, goal = ends(speed)
    root, target = Nodes(np.array([start]), np.zeros(1)), Nodes(np.array([goal]), np.zeros(1))
    metric = Metric(speed, CELL, SPEED_WEIGHT, TURN_WEIGHT)
    bound = plane_costs(metric, root._replace(nodes=root.nodes // HEADINGS))
    behind = tree(metric, target, root, bound, False, Limits(reach, 0.5, np.inf))
    ahead = tree(metric, root, target, behind[0], True, Limits(reach, 0.5, behind[2]))
    return start, goal, bound, ahead, behind


@pytest.mark.parametrize("seed", range(5))
def test_the_trees_have_the_costs_of_an_independent_dijkstra(seed):
    speed = random_speed(seed)
    start, goal, bound, (ahead, _, limit), (behind, _, same_limit) = trees(speed, reach=1.3)
    from_start = dijkstra(graph(speed), indices=start)
    from_goal = dijkstra(graph(speed).T, indices=goal)
    best = from_start[goal]
    assert np.isfinite(best)
    assert limit == pytest.approx(1.3 * best + 0.5)
    assert same_limit == pytest.approx(limit)
    assert behind[start] == pytest.approx(best)
    assert ahead[goal] == pytest.approx(best)
    # Every node on a path within the limit is found at its true cost, and no other in the second tree.
    through = from_start + from_goal
    within = through <= limit * (1 - 1e-12)
    assert within.sum() > 100
    assert ahead[within] == pytest.approx(from_start[within])
    assert behind[within] == pytest.approx(from_goal[within])
    assert not np.isfinite(ahead[through > limit * (1 + 1e-12)]).any()
    # The plane's costs bound the lattice's from below.
    cells = np.arange(COLUMNS * LINES * HEADINGS) // HEADINGS
    finite = np.isfinite(from_start)
    assert (bound[cells[finite]] <= from_start[finite] + 1e-9).all()


def test_paths_through_meeting_nodes_are_paths_of_their_cost_in_order():
    speed = random_speed(1)
    start, goal, _, (ahead, parent, limit), (behind, child, _) = trees(speed, reach=1.5)
    nodes = meeting_nodes(parent, child, ahead, behind, limit)
    costs = (ahead + behind)[nodes]
    assert (np.diff(costs) >= 0).all()
    assert costs[0] == pytest.approx(ahead[goal])
    edges = graph(speed)
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
    _, _, _, (ahead, _, limit), (behind, _, _) = trees(speed, reach=1.3)
    assert limit == np.inf
    assert not np.isfinite(ahead).any()
    assert not np.isfinite(behind[: COLUMNS // 2 * LINES * HEADINGS]).any()


def test_the_best_path_is_among_the_first_candidates():
    """The search relies on the cost in the metric to rank the candidates."""
    ranks = []
    for scenario, cost in best_known()[::4]:
        problem = OptimalControlProblem.from_scenario(scenario)
        paths = (Trajectory(c.times, c.poses) for c in CandidateSearch(Lattice(scenario)).candidates())
        optima = (optimise(problem.with_winding_of(path.states), discretise(path)).cost for path in paths)
        ranks.append(next(rank for rank, found in enumerate(optima) if found < cost * 1.005))
    assert np.median(ranks) == 0
    assert max(ranks) < 12
