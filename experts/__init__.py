"""Optimal control by the minimum principle: solvers, the search for optima, and the expert policy."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from leapnav.deprecated import deprecated_names
from leapnav.experts.acting.policy import ExpertPolicy, NoOptimumError
from leapnav.experts.continuation import continuation
from leapnav.experts.minimum_time import MinimumTime, minimum_time
from leapnav.experts.optimum import Optimum, find_optimum, find_reached_optimum, shortest_horizon
from leapnav.experts.problem.certificate import certify, verify
from leapnav.experts.problem.extremal import Certificate, Extremal, Iteration, SolveError, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.problem.system import ControlAffineSystem, differential_drive, unicycle, unicycle_with_inertia
from leapnav.experts.solve import solve

if TYPE_CHECKING:
    from leapnav.experts.data.banks import build_bank
    from leapnav.experts.data.demonstrations import load_demonstrations
    from leapnav.experts.data.rollouts import check_dataset, rollout
    from leapnav.experts.plotting import plot_extremal

__all__ = [
    "Certificate",
    "ControlAffineSystem",
    "ExpertPolicy",
    "Extremal",
    "Iteration",
    "MinimumTime",
    "NoOptimumError",
    "OptimalControlProblem",
    "Optimum",
    "SolveError",
    "Status",
    "Trajectory",
    "build_bank",
    "certify",
    "check_dataset",
    "continuation",
    "differential_drive",
    "find_optimum",
    "find_reached_optimum",
    "load_demonstrations",
    "minimum_time",
    "plot_extremal",
    "rollout",
    "shortest_horizon",
    "solve",
    "unicycle",
    "unicycle_with_inertia",
    "verify",
]

# Names whose modules import Minari, joblib or Matplotlib, which take up to a second; they are loaded at first use.
_LAZY = {
    "build_bank": "leapnav.experts.data.banks",
    "check_dataset": "leapnav.experts.data.rollouts",
    "load_demonstrations": "leapnav.experts.data.demonstrations",
    "plot_extremal": "leapnav.experts.plotting",
    "rollout": "leapnav.experts.data.rollouts",
}


_deprecated = deprecated_names(__name__, {"Path": "Trajectory"})


def __getattr__(name: str) -> Any:
    return getattr(import_module(_LAZY[name]), name) if name in _LAZY else _deprecated(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
