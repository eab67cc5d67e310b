"""The Leapfrog method: a feasible path, improved by solving the problem between every other node.

J. L. Noakes, A global algorithm for geodesics, J. Austral. Math. Soc. A 65 (1998); C. Y. Kaya and J. L. Noakes,
Leapfrog for optimal control, SIAM J. Numer. Anal. 46 (2008). Nodes z_0..z_p stand on a feasible path at times
t_0..t_p. A sweep goes through i = 1..p-1, solves the sub-problem from node i-1 to node i+1 by simple shooting, and
moves node i onto the sub-problem's extremal: at the mean time, or at half its cost. The path stays feasible, meets both
boundary conditions, and its cost never rises: a move that would raise it is rejected. Costates need no guess: they
come from the chord between two nodes, and later from the last sweep. When a sweep gains little, nodes are removed whose
sub-problem's extremal costs no more than the two arcs that it replaces, until p = 2 and the last sub-problem is the
whole problem.
"""

from __future__ import annotations

from dataclasses import replace

from leapnav.experts.certificate import certify
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.feasible_path import LONG_ACCURACY, FeasiblePath
from leapnav.experts.multiple_shooting import confirm, polish
from leapnav.experts.nodes import FEWEST_SEGMENTS, MOST_SEGMENTS, Settings, default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.single_shooting import single_shooting

# Largest end error of an arc, and the integrator's accuracy: a jump of the states stays below 1e-9 even where errors
# grow along the arc. Long arcs, which only a reduction of the nodes makes, need more.
FEASIBLE, ACCURACY = 1e-10, 1e-12
# Newton's method is tried after so many sweeps in all, and mostly takes over after the first.
SWEEPS_BEFORE_NEWTON = (1, 2, 4, 8, 16, 32, 64)
# Without it: nodes are removed when a sweep gains less than this share of the cost.
LITTLE = 1e-3
MOST_SWEEPS = 500
REDUCTIONS_FAILED = 2  # thereafter the sweeps go on until the costates do not jump at the nodes
SAME_COST = 1e-6  # the cost of a last iterate of Newton's method is known to this
MOST_STUCK = 3  # sweeps with rejected moves, before arcs are halved


def leapfrog(problem: OptimalControlProblem, path: Path, settings: Settings) -> Extremal:
    """Sweeps until Newton's method takes over (`polish`), or until the last sub-problem is the whole problem."""
    times, nodes = start_nodes(problem, path, settings.segments or default_segments(path))
    accuracy = ACCURACY if settings.polish else LONG_ACCURACY
    track = FeasiblePath(problem, times, nodes, FEASIBLE, accuracy, settings.update == "half_cost", thorough=True)
    if not track.feasible:
        return certify(problem, track.times, track.nodes, Status.SUBPROBLEM, tuple(track.history), track.work)
    return (_sweep_and_polish if settings.polish else _sweep_and_reduce)(track, settings)


def _sweep_and_polish(track: FeasiblePath, settings: Settings) -> Extremal:
    done = 0
    for sweeps in SWEEPS_BEFORE_NEWTON:
        while done < sweeps:
            track.sweep(settings.order == "red_black")
            done += 1
        nodes = track.nodes.copy()
        status, rows, work = polish(track.problem, track.times, nodes, settings.tol, settings.max_iterations)
        track.work += work
        # From a feasible path the way down leads to a cheaper extremal; a dearer one is another path's.
        if status is Status.SUCCESS and rows[-1].cost <= track.cost + SAME_COST * (1 + abs(track.cost)):
            history = (*track.history, *rows)
            extremal = confirm(track.problem, track.times, nodes, status, history, track.work, settings)
            # From a saddle the sweeps lead further down.
            if extremal.status is not Status.CONJUGATE_POINT or sweeps == SWEEPS_BEFORE_NEWTON[-1]:
                return extremal
    # Newton's method does not take over: the sweeps alone have to do.
    track.accuracy = LONG_ACCURACY
    return _sweep_and_reduce(track, settings)


def _sweep_and_reduce(track: FeasiblePath, settings: Settings) -> Extremal:
    little, failures, stuck, status = LITTLE, 0, 0, Status.MAX_ITERATIONS
    for _ in range(MOST_SWEEPS):
        before = track.cost
        if track.segments > 2:  # else the whole problem is the only sub-problem, and a reduction solves it
            track.sweep(settings.order == "red_black")
        if before - track.cost > little * abs(before):
            continue
        if failures == REDUCTIONS_FAILED:
            if track.jumps()[1] <= settings.tol:
                status = Status.SUCCESS
                break
            stuck = stuck + 1 if track.history[-1].rejected else 0
            if stuck > MOST_STUCK:  # arcs so long that shooting loses the digits that are left to gain
                if track.segments > MOST_SEGMENTS:
                    status = Status.SUBPROBLEM
                    break
                track.split()
                stuck = 0
            continue
        removed = track.reduce()
        if track.segments == 1:
            extremal = single_shooting(track.problem, Path(track.times, *track.halves()), settings)
            if extremal.success:
                return replace(extremal, history=tuple(track.history), work=track.work + extremal.work)
            removed = 0
        if removed == 0:
            # Shooting over that long needs better costates, or amplifies its errors too much. Sweeps over shorter arcs
            # improve the former and do not mind the latter.
            failures += 1
            little *= 0.1
            while track.segments < FEWEST_SEGMENTS // 2:
                track.split()
    return certify(track.problem, track.times, track.nodes, status, tuple(track.history), track.work)
