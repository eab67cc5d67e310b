"""Optimal control by the minimum principle: solvers, the search for optima, and the expert policy."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from leapnav.experts.acting.policy import ExpertPolicy, NoOptimumError
from leapnav.experts.bounds.lower_bound import LowerBound, lower_bound
from leapnav.experts.continuation import continuation
from leapnav.experts.minimum_length import MinimumLength, minimum_length
from leapnav.experts.minimum_time import MinimumTime, minimum_time
from leapnav.experts.optimum import Optimum, find_optimum, find_reached_optimum, shortest_horizon
from leapnav.experts.problem.certificate import certify, verify
from leapnav.experts.problem.extremal import Certificate, Extremal, SolveError, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.problem.system import ControlAffineSystem, unicycle
from leapnav.experts.proofs.checker import check_proof
from leapnav.experts.proofs.proof import Proof
from leapnav.experts.solve import solve

if TYPE_CHECKING:
    from leapnav.experts.data.banks import build_bank, build_bank_of
    from leapnav.experts.data.demonstrations import load_demonstrations
    from leapnav.experts.data.optima import find_optima
    from leapnav.experts.data.rollouts import rollout
    from leapnav.experts.plotting.extremals import plot_extremal

__all__ = [
    "Certificate",
    "ControlAffineSystem",
    "ExpertPolicy",
    "Extremal",
    "LowerBound",
    "MinimumLength",
    "MinimumTime",
    "NoOptimumError",
    "OptimalControlProblem",
    "Optimum",
    "Proof",
    "SolveError",
    "Status",
    "Trajectory",
    "build_bank",
    "build_bank_of",
    "certify",
    "check_proof",
    "continuation",
    "find_optima",
    "find_optimum",
    "find_reached_optimum",
    "load_demonstrations",
    "lower_bound",
    "minimum_length",
    "minimum_time",
    "plot_extremal",
    "rollout",
    "shortest_horizon",
    "solve",
    "unicycle",
    "verify",
]

# Names whose modules import Minari, joblib or Matplotlib, which take up to a second; they are loaded at first use.
_LAZY = {
    "build_bank": "leapnav.experts.data.banks",
    "build_bank_of": "leapnav.experts.data.banks",
    "find_optima": "leapnav.experts.data.optima",
    "load_demonstrations": "leapnav.experts.data.demonstrations",
    "plot_extremal": "leapnav.experts.plotting.extremals",
    "rollout": "leapnav.experts.data.rollouts",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
