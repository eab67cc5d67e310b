"""Optimal control by the minimum principle: solvers, the search for the optimum, and the expert that drives it."""

from leapnav.experts.banks import build_bank
from leapnav.experts.certificate import certify, verify
from leapnav.experts.extremal import Certificate, Extremal, Iteration, SolveError, Status
from leapnav.experts.homotopy import continuation
from leapnav.experts.methods import solve
from leapnav.experts.optimum import Optimum, find_optimum
from leapnav.experts.policy import ExpertPolicy, NoOptimumError
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.system import ControlAffineSystem, differential_drive, unicycle, unicycle_with_inertia

__all__ = [
    "Certificate",
    "ControlAffineSystem",
    "ExpertPolicy",
    "Extremal",
    "Iteration",
    "NoOptimumError",
    "OptimalControlProblem",
    "Optimum",
    "Path",
    "SolveError",
    "Status",
    "build_bank",
    "certify",
    "continuation",
    "differential_drive",
    "find_optimum",
    "solve",
    "unicycle",
    "unicycle_with_inertia",
    "verify",
]
