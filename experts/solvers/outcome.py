"""Statuses of the exit codes of the Newton kernels."""

from leapnav.experts.problem.extremal import Status
from leapnav.experts.solvers.newton import CONVERGED, DIVERGED, MAX_ITERATIONS, SINGULAR, STALLED

KERNEL_STATUS = {
    CONVERGED: Status.SUCCESS,
    STALLED: Status.STALLED,
    DIVERGED: Status.DIVERGED,
    SINGULAR: Status.SINGULAR,
    MAX_ITERATIONS: Status.MAX_ITERATIONS,
}
