"""The Leapfrog method: a feasible path is improved by solving sub-problems between every other node.

J. L. Noakes, A global algorithm for geodesics, J. Austral. Math. Soc. A 65 (1998); C. Y. Kaya and J. L. Noakes,
Leapfrog for optimal control, SIAM J. Numer. Anal. 46 (2008).

The iterate is a feasible path with nodes z_0..z_p at times t_0..t_p. For i = 1..p-1 a sweep solves the sub-problem from
node i-1 to node i+1 by single shooting, and moves node i onto the extremal of the sub-problem, at the mean time or at
half of its cost. The path stays feasible, and its cost never increases, because a move that would increase it is
rejected. Costates need no guess: they are estimated from the chord between two nodes, and later taken from the last
sweep. When a sweep reduces the cost by less than the fraction MIN_GAIN, two arcs are replaced by one if that does not
raise the cost, until p = 2 and the last sub-problem is the whole problem.

With a free horizon the sub-problems keep their durations, and after each sweep all times are scaled by a factor that
reduces the cost, so that the path stays feasible and its cost still never increases.
"""

from __future__ import annotations

from dataclasses import replace

from leapnav.experts.problem.certificate import certify
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.solvers.feasible_path import LONG_ARC_ACCURACY, FeasiblePath
from leapnav.experts.solvers.multiple_shooting import confirm, polish
from leapnav.experts.solvers.nodes import MAX_SEGMENTS, MIN_SEGMENTS, SolverOptions, first_mesh, start_nodes
from leapnav.experts.solvers.single_shooting import single_shooting

# Largest end error of an arc, and tolerance of the integrator: state defects stay below 1e-9 although errors grow along
# an arc. Long arcs, which only occur after nodes were removed, need LONG_ARC_ACCURACY.
ARC_TOLERANCE, ACCURACY = 1e-10, 1e-12
# Total number of sweeps after which Newton's method is tried; it usually converges after the first.
SWEEPS_BEFORE_NEWTON = (1, 2, 4, 8, 16, 32, 64)
# Nodes are removed when a sweep reduces the cost by less than this fraction.
MIN_GAIN = 1e-3
MAX_SWEEPS = 500
MAX_FAILED_REDUCTIONS = 2  # after these, sweeps continue until the costates are continuous at the nodes
COST_TOLERANCE = 1e-6  # relative error of the cost of a last Newton iterate whose residual is predicted
MAX_REJECTED_SWEEPS = 3  # consecutive sweeps with rejected moves before the arcs are halved


def leapfrog(problem: OptimalControlProblem, path: Trajectory, options: SolverOptions) -> Extremal:
    """Solve by Leapfrog sweeps, followed by Newton's method (`polish`) or by a reduction of the nodes."""
    times, nodes = start_nodes(problem, path, first_mesh(path, options))
    accuracy = ACCURACY if options.polish else LONG_ARC_ACCURACY
    half_cost = options.update == "half_cost"
    iterate = FeasiblePath(problem, times, nodes, ARC_TOLERANCE, accuracy, half_cost)
    if not iterate.feasible:
        return _certify(iterate, Status.SUBPROBLEM)
    return (_sweep_and_polish if options.polish else _sweep_and_reduce)(iterate, options)


def _sweep_and_polish(iterate: FeasiblePath, options: SolverOptions) -> Extremal:
    """Sweep until Newton's method converges to an extremal that is no more expensive than the path.

    Nodes are removed after a sweep that hardly reduces the cost, with Newton's method tried after each removal.
    """
    done = 0
    for sweeps in SWEEPS_BEFORE_NEWTON:
        gains = True
        while gains and done < sweeps:
            before = iterate.cost
            iterate.sweep(options.order == "red_black")
            gains, done = before - iterate.cost > MIN_GAIN * abs(before), done + 1
        times, nodes = iterate.times.copy(), iterate.nodes.copy()
        status, rows, evaluations = polish(iterate.problem, times, nodes, options.tol, options.max_iterations)
        iterate.evaluations += evaluations
        # An extremal that costs more than the feasible path is not the one to which the sweeps converge.
        if status is Status.SUCCESS and rows[-1].cost <= iterate.cost + COST_TOLERANCE * (1 + abs(iterate.cost)):
            history = (*iterate.history, *rows)
            extremal = confirm(iterate.problem, times, nodes, status, history, iterate.evaluations, options)
            # Such an extremal is a saddle, and further sweeps reduce the cost.
            is_saddle = extremal.status in (Status.CONJUGATE_POINT, Status.TIME_NOT_MINIMAL)
            if not is_saddle or sweeps == SWEEPS_BEFORE_NEWTON[-1]:
                return extremal
        if not gains and iterate.reduce() == 0:
            break
    # Newton's method did not converge, so the problem is solved by sweeps alone.
    iterate.accuracy = LONG_ARC_ACCURACY
    return _sweep_and_reduce(iterate, options)


def _sweep_and_reduce(iterate: FeasiblePath, options: SolverOptions) -> Extremal:
    """Sweep and remove nodes until one arc is left, or until the costates are continuous at the nodes."""
    min_gain, failures, n_rejected_sweeps, status = MIN_GAIN, 0, 0, Status.MAX_ITERATIONS
    for _ in range(MAX_SWEEPS):
        before = iterate.cost
        # With two arcs the only sub-problem is the whole problem in a fixed time, which a reduction solves.
        if iterate.segments > 2:
            iterate.sweep(options.order == "red_black")
        if before - iterate.cost > min_gain * abs(before):
            continue
        if failures == MAX_FAILED_REDUCTIONS:
            if iterate.defects()[1] <= options.tol:
                status = Status.SUCCESS
                break
            n_rejected_sweeps = n_rejected_sweeps + 1 if iterate.history[-1].rejected else 0
            # With rejected moves in every sweep the arcs are too long for shooting to improve the path further.
            if n_rejected_sweeps > MAX_REJECTED_SWEEPS:
                if iterate.segments > MAX_SEGMENTS:
                    status = Status.SUBPROBLEM
                    break
                if not iterate.split():
                    status = Status.DIVERGED
                    break
                n_rejected_sweeps = 0
            continue
        removed = iterate.reduce()
        if iterate.segments == 1:
            guess = Trajectory(iterate.times, iterate.states, iterate.costates)
            extremal = single_shooting(iterate.problem, guess, options)
            if extremal.success:
                return replace(
                    extremal, history=tuple(iterate.history), n_evaluations=iterate.evaluations + extremal.n_evaluations
                )
            removed = 0
        if removed == 0:
            # Shooting over a long arc needs accurate costates, and amplifies errors. Sweeps over shorter arcs improve
            # the costates and amplify errors less.
            failures += 1
            min_gain *= 0.1
            while iterate.segments < MIN_SEGMENTS // 2:
                if not iterate.split():
                    return _certify(iterate, Status.DIVERGED)
    return _certify(iterate, status)


def _certify(iterate: FeasiblePath, status: Status) -> Extremal:
    """Return the extremal of an iterate with its certificate."""
    history = tuple(iterate.history)
    return certify(iterate.problem, iterate.times, iterate.nodes, status, history, iterate.evaluations)
