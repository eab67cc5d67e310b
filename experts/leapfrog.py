"""The Leapfrog method: a feasible path, improved by solving the problem between every other node.

J. L. Noakes, A global algorithm for geodesics, J. Austral. Math. Soc. A 65 (1998); C. Y. Kaya and J. L. Noakes,
Leapfrog for optimal control, SIAM J. Numer. Anal. 46 (2008). Nodes z_0..z_p stand on a feasible path at times
t_0..t_p. A sweep goes through i = 1..p-1, solves the sub-problem from node i-1 to node i+1 by simple shooting, and
moves node i onto the sub-problem's extremal: at half its cost, or at the mean time. The path stays feasible, meets both
boundary conditions, and its cost never rises: a move that would raise it is rejected. Costates need no guess: they
come from the chord between two nodes, and later from the last sweep.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, njit, types

from leapnav.experts.integrator import FLOW, constant, matrix, propagate, vector
from leapnav.experts.multiple_shooting import flags
from leapnav.experts.single_shooting import CONVERGED, shoot

SUBPROBLEM_ITERATIONS = 12


@njit(
    types.Tuple((int64, int64))(FLOW, vector, matrix, vector, flags, constant, constant, float64, float64, vector),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def connect(flow, times, Z, goal, free, data, field, tolerance, accuracy, costs):
    """Makes a path of nodes feasible: solves each segment on its own, from the costates guessed in Z.

    `costs` (p,) becomes the cost of each segment, infinite where shooting failed. Returns (failed segments, steps).
    """
    n = len(goal)
    p = len(times) - 1
    fixed = np.zeros(n, dtype=np.bool_)
    end = np.empty(2 * n)
    failed, work = 0, 0
    for k in range(p):
        z = Z[k].copy()
        # Only at the horizon may a component be free.
        status, _, _, cost, steps = shoot(
            flow,
            z,
            Z[k + 1, :n].copy(),
            end,
            free if k == p - 1 else fixed,
            times[k + 1] - times[k],
            data,
            field,
            tolerance,
            accuracy,
            SUBPROBLEM_ITERATIONS,
        )
        work += steps
        costs[k] = np.inf
        if status == CONVERGED:
            Z[k] = z
            costs[k] = cost
            if k == p - 1:
                Z[p] = end
        else:
            failed += 1
    return failed, work


@njit(
    types.Tuple((int64, int64))(
        FLOW, vector, matrix, vector, flags, constant, constant, float64, float64, boolean, vector, int64, int64
    ),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def sweep(flow, times, Z, goal, free, data, field, tolerance, accuracy, half_cost, costs, first, stride):
    """One sweep over the inner nodes first, first + stride, ... in place (stride 2: the red or black nodes).

    With `half_cost` a node moves to half the sub-problem's cost and its time changes, else it stays at the mean time of
    its neighbours. Returns (rejected moves, integration steps).
    """
    n = len(goal)
    p = len(times) - 1
    fixed = np.zeros(n, dtype=np.bool_)
    S = np.empty((2 * n, 0))
    end = np.empty(2 * n)
    rejected, work = 0, 0
    for i in range(first, p, stride):
        z = Z[i - 1].copy()
        duration = times[i + 1] - times[i - 1]
        status, _, _, cost, steps = shoot(
            flow,
            z,
            Z[i + 1, :n].copy(),
            end,
            free if i == p - 1 else fixed,
            duration,
            data,
            field,
            tolerance,
            accuracy,
            SUBPROBLEM_ITERATIONS,
        )
        work += steps
        before = costs[i - 1] + costs[i]
        # The slack is the integrator's error: a node that stands still must not be counted as rejected.
        if status != CONVERGED or not cost <= before + 10.0 * accuracy * (1.0 + cost):
            rejected += 1
            continue
        middle = z.copy()
        if half_cost:
            reached, elapsed, step, target = 0.0, 0.0, duration / 16.0, cost / 2.0
            part, taken = 0.0, 0.0
            here = middle.copy()
            while elapsed < duration:
                part, taken, following, steps = propagate(
                    flow, here, S, min(step, duration - elapsed), data, field, accuracy, step, True
                )
                work += 1
                if steps < 0 or reached + part > target:
                    break
                middle[:] = here
                reached += part
                elapsed += taken
                step = min(following, duration / 16.0)
            # Within the last step the cost grows almost linearly.
            rest = taken * (target - reached) / part if part > 0 else 0.0
            part, _, _, _ = propagate(flow, middle, S, rest, data, field, accuracy, 0.0, False)
            elapsed += rest
            first_cost = reached + part
        else:
            elapsed = duration / 2.0
            first_cost, _, _, steps = propagate(flow, middle, S, elapsed, data, field, accuracy, 0.0, False)
            work += steps
        Z[i - 1] = z
        Z[i] = middle
        if i == p - 1:
            Z[p] = end
        times[i] = times[i - 1] + elapsed
        costs[i - 1] = first_cost
        costs[i] = cost - first_cost
    return rejected, work
