"""Node updates of the Leapfrog method (kernels). See `leapnav.experts.solvers.leapfrog` for the method."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import FLAGS, MATRIX, VECTOR, tuple_of
from leapnav.experts.numerics.flow import END_CONDITION, FLOW, NEWTON_OPTIONS, EndCondition
from leapnav.experts.numerics.integrator import propagate
from leapnav.experts.numerics.shooting import hamiltonian
from leapnav.experts.solvers.newton import CONVERGED, solve_arc

# Largest distance of the end of an arc that was not found from its target, relative to the distance of the two nodes.
# With 0.3, Rayleigh's problem with bounds is solved as well; with 0.01, not to a fixed end.
MAX_MISS = 0.1
MIN_FRACTION = 0.05  # smallest distance in time of a node from its neighbours, relative to the sub-problem's duration
MIN_HALF_COST_STEPS = 16  # smallest number of integration steps of the search for half of the cost


class ArcPath(NamedTuple):
    """A path of p arcs, each an extremal from its node to the next.

    Attributes:
        times: (p + 1,), of the nodes (s).
        nodes: (p + 1, 2n), states and costates.
        costs: (p,), of the arcs; infinite if the two nodes are not connected.

    """

    times: np.ndarray
    nodes: np.ndarray
    costs: np.ndarray


ARC_PATH = record_type(ArcPath, times=VECTOR, nodes=MATRIX, costs=VECTOR)


@kernel(tuple_of(int64, float64, int64)(FLOW, VECTOR, VECTOR, END_CONDITION, float64, NEWTON_OPTIONS, VECTOR))
def _solve_arc(flow, z, target, end, duration, options, z_end):
    """Solve for the extremal from z, in place, to a target node; return (exit code, cost, evaluations).

    `end.free` marks the free components of the target.
    """
    return solve_arc(flow, z, EndCondition(target[: len(end.free)], end.free, False), duration, options, z_end)


@kernel(END_CONDITION(END_CONDITION, boolean))
def _condition(end, at_horizon):
    """Return the end condition of a sub-problem, in a fixed time; components may be free only at the horizon."""
    free = np.empty(len(end.free), np.bool_)
    for i in range(len(free)):
        free[i] = at_horizon and end.free[i]
    return EndCondition(end.goal, free, False)


@kernel(tuple_of(float64, float64, int64)(FLOW, ARC_PATH, END_CONDITION, float64))
def measure_defects(flow, path, end, accuracy):
    """Return the largest defects of states and of costates at the nodes, and the number of evaluations of the flow.

    If the final time is free, the Hamiltonian at the start counts as a defect of the costates. Where the flow diverges,
    both defects are infinite.
    """
    times, Z = path.times, path.nodes
    n = len(end.goal)
    p = len(times) - 1
    S = np.empty((2 * n, 0))
    states, costates, evaluations = 0.0, 0.0, 0
    if end.free_time:
        costates = abs(hamiltonian(flow, Z[0], np.empty(2 * n)))
    for k in range(p):
        z = Z[k].copy()
        success, _, _, _, count = propagate(flow, z, S, times[k + 1] - times[k], accuracy, 0.0, False)
        evaluations += count
        if not success:
            return np.inf, np.inf, evaluations
        for i in range(n):
            if k < p - 1:
                states = max(states, abs(z[i] - Z[k + 1, i]))
                costates = max(costates, abs(z[n + i] - Z[k + 1, n + i]))
            else:
                states = max(states, abs(z[n + i]) if end.free[i] else abs(z[i] - end.goal[i]))
    return states, costates, evaluations


@kernel(boolean(VECTOR, VECTOR, VECTOR, int64))
def _is_close(end, target, start, n):
    """Return whether an arc from `start` ends close to its target, compared with the distance of the two."""
    error, length = 0.0, 0.0
    for i in range(n):
        error += (end[i] - target[i]) ** 2
        length += (target[i] - start[i]) ** 2
    return error <= MAX_MISS**2 * length


@kernel(tuple_of(int64, int64)(FLOW, ARC_PATH, END_CONDITION, NEWTON_OPTIONS))
def connect(flow, path, end, options):
    """Make a path feasible: solve for each arc separately, with the costates at the nodes as initial guess.

    If that fails, the final costate of the arc before is tried. If that fails too, an inner node moves to the end of
    the arc, if that is close: a node that is computed only approximately is beyond reach where the controls are at
    their bounds. Fills the costs of the arcs. Returns (number of arcs that were not found, evaluations of the flow).
    """
    times, Z, costs = path.times, path.nodes, path.costs
    n = len(end.goal)
    p = len(times) - 1
    arrival, before, z = Z[0].copy(), np.empty(n), np.empty(2 * n)
    none = np.empty((2 * n, 0))
    failed, evaluations = 0, 0
    for k in range(p):
        costs[k] = np.inf
        condition, duration = _condition(end, k == p - 1), times[k + 1] - times[k]
        for i in range(n):
            before[i] = arrival[n + i]
        for attempt in range(2):
            for i in range(n):
                z[i] = Z[k, i]
                z[n + i] = before[i] if attempt == 1 else Z[k, n + i]
            status, cost, count = _solve_arc(flow, z, Z[k + 1], condition, duration, options, arrival)
            evaluations += count
            if status == CONVERGED:
                costs[k] = cost
                for i in range(2 * n):
                    Z[k, i] = z[i]
                    if k == p - 1:
                        Z[p, i] = arrival[i]
                break
        else:
            for i in range(2 * n):
                arrival[i] = Z[k, i]
            success, cost, _, _, count = propagate(flow, arrival, none, duration, options.accuracy, 0.0, False)
            evaluations += count
            if success and k < p - 1 and _is_close(arrival, Z[k + 1], Z[k], n):
                costs[k] = cost
                for i in range(n):
                    Z[k + 1, i] = arrival[i]
                continue
            failed += 1
            for i in range(2 * n):
                arrival[i] = Z[k + 1, i]
    return failed, evaluations


@kernel(tuple_of(boolean, float64, float64, int64)(FLOW, VECTOR, float64, float64, float64))
def _half_cost(flow, z, duration, cost, accuracy):
    """Advance z, in place, to half of the cost of its extremal.

    Returns (success, elapsed time, cost so far, evaluations); without success the flow diverged, and z is NaN.
    """
    S = np.empty((len(z), 0))
    probe, evaluations = z.copy(), 0
    reached, elapsed, step, target = 0.0, 0.0, duration / MIN_HALF_COST_STEPS, cost / 2.0
    part, taken = 0.0, 0.0
    while elapsed < duration:
        rest = min(step, duration - elapsed)
        success, part, taken, following, count = propagate(flow, probe, S, rest, accuracy, step, True)
        evaluations += count
        if not success:
            for i in range(len(z)):
                z[i] = np.nan
            return False, elapsed, reached, evaluations
        if reached + part > target:
            break
        for i in range(len(z)):
            z[i] = probe[i]
        reached += part
        elapsed += taken
        step = min(following, duration / MIN_HALF_COST_STEPS)
    # Within the last step the cost grows almost linearly in time.
    rest = taken * (target - reached) / part if part > 0 else 0.0
    success, part, _, _, count = propagate(flow, z, S, rest, accuracy, 0.0, False)
    return success, elapsed + rest, reached + part, evaluations + count


@kernel(int64(FLOW, ARC_PATH, END_CONDITION, NEWTON_OPTIONS, boolean, int64, int64, FLAGS))
def sweep(flow, path, end, options, half_cost, first, stride, rejected):
    """Sweep over the inner nodes first, first + stride, ... in place; stride 2 updates the red or the black nodes.

    With `half_cost` a node moves to half of its sub-problem's cost, which changes its time; otherwise it moves to the
    mean time of its neighbours. `rejected` (p + 1,) marks the nodes whose move was rejected. Returns the number of
    evaluations of the flow.
    """
    times, Z, costs = path.times, path.nodes, path.costs
    tolerance, accuracy = options.tolerance, options.accuracy
    n = len(end.goal)
    p = len(times) - 1
    S = np.empty((2 * n, 0))
    z, middle, arrival = np.empty(2 * n), np.empty(2 * n), np.empty(2 * n)
    evaluations = 0
    for i in range(first, p, stride):
        duration = times[i + 1] - times[i - 1]
        before = costs[i - 1] + costs[i]
        slack = 10.0 * tolerance * (1.0 + abs(before))
        condition = _condition(end, i == p - 1)
        cost = 0.0
        for attempt in range(2):
            for e in range(n):
                z[e] = Z[i - 1, e]
                # Costates change slowly along an extremal, so the node's own costate is the second guess.
                z[n + e] = Z[i, n + e] if attempt == 1 else Z[i - 1, n + e]
            status, cost, count = _solve_arc(flow, z, Z[i + 1], condition, duration, options, arrival)
            evaluations += count
            if status == CONVERGED and (cost <= before + slack or before == np.inf):
                break
        else:
            rejected[i] = True
            continue
        elapsed, first_cost, success = 0.0, 0.0, False
        for e in range(2 * n):
            middle[e] = z[e]
        if half_cost and cost > 0.0:
            success, elapsed, first_cost, count = _half_cost(flow, middle, duration, cost, accuracy)
            evaluations += count
        # Half of the cost is reached close to a neighbour, or nowhere, if the cost accrues at one end or is negative.
        if not success or not MIN_FRACTION * duration < elapsed < (1.0 - MIN_FRACTION) * duration:
            for e in range(2 * n):
                middle[e] = z[e]
            elapsed = duration / 2.0
            success, first_cost, _, _, count = propagate(flow, middle, S, elapsed, accuracy, 0.0, False)
            evaluations += count
        if not success:  # the extremal cannot be integrated to its middle, although shooting found its end
            rejected[i] = True
            continue
        for e in range(2 * n):
            Z[i - 1, e], Z[i, e] = z[e], middle[e]
            if i == p - 1:
                Z[p, e] = arrival[e]
        times[i] = times[i - 1] + elapsed
        costs[i - 1] = first_cost
        # An increase within the end errors of the arcs is ignored.
        costs[i] = min(cost, before) - first_cost
    return evaluations


@kernel(int64(FLOW, ARC_PATH, END_CONDITION, NEWTON_OPTIONS, FLAGS, FLAGS))
def merge(flow, path, end, options, keep, rejected):
    """Replace pairs of neighbouring arcs by one arc if that does not raise the cost; removes at most every other node.

    `keep` (p + 1,) becomes False at a removed node, and the arc before it gets the cost of the new arc. `rejected`
    marks the nodes that could not be removed. Returns the number of evaluations of the flow.
    """
    times, Z, costs = path.times, path.nodes, path.costs
    n = len(end.goal)
    p = len(times) - 1
    arrival = np.empty(2 * n)
    evaluations = 0
    i = 1
    while i < p:
        z = Z[i - 1].copy()
        condition, duration = _condition(end, i == p - 1), times[i + 1] - times[i - 1]
        status, cost, count = _solve_arc(flow, z, Z[i + 1], condition, duration, options, arrival)
        evaluations += count
        before = costs[i - 1] + costs[i]
        if status == CONVERGED and cost <= before + 10.0 * options.tolerance * (1.0 + abs(before)):
            for e in range(2 * n):
                Z[i - 1, e] = z[e]
                if i == p - 1:
                    Z[p, e] = arrival[e]
            # An increase within the end errors of the arcs is ignored.
            costs[i - 1] = min(cost, before)
            keep[i] = False
            i += 2
        else:
            rejected[i] = True
            i += 1
    return evaluations
