"""Optimal control by the minimum principle: solvers, the search for the optimum, and the expert that drives it."""

from leapnav.experts.certificate import certify
from leapnav.experts.extremal import Certificate, Extremal, Iteration, Status
from leapnav.experts.optimum import find_optimum
from leapnav.experts.policy import ExpertPolicy, NoOptimumError
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.solve import solve
from leapnav.experts.system import ControlAffineSystem, unicycle

__all__ = [
    "Certificate",
    "ControlAffineSystem",
    "ExpertPolicy",
    "Extremal",
    "Iteration",
    "NoOptimumError",
    "OptimalControlProblem",
    "Path",
    "Status",
    "certify",
    "find_optimum",
    "solve",
    "unicycle",
]
