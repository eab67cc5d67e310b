"""`leapnav solve`: solutions of one scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, get_args

import tyro

from leapnav.outputs import FAILED, check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.envs.scenarios.scenario import Scenario
    from leapnav.experts import Extremal, Optimum


@dataclass(frozen=True)
class Solve:
    """Find the optimum of a scenario, solve it with one method, or compare the methods.

    Exit code 0: certified; 1: no certified solution, or a cheaper one that is not certified; 2: invalid input.
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (JSON)."""
    method: Literal["optimum", "leapfrog", "multiple_shooting", "single_shooting", "collocation", "all"] = "optimum"
    """Method: "optimum" searches globally; the others solve from the best path of the lattice search, improved by
    direct transcription; "all" compares them."""
    plot: Path | None = None
    """Picture of the solution (.png, .pdf or .svg), or an animation (.gif); with "all", of the certified one of lowest
    cost."""
    json: Path | None = None
    """JSON file of the solution (cost, certificate, states, controls, costates, history), with "all" of one per method;
    "-" for standard output."""

    def run(self) -> int:
        """Solve and report."""
        from leapnav.envs.scenarios.scenario import Scenario

        scenario = Scenario.from_json(self.scenario)
        check_outputs(self.json, **{"animation" if self._is_animated else "plot": self.plot})
        return self._compare(scenario) if self.method == "all" else self._solve(scenario)

    def _solve(self, scenario: Scenario) -> int:
        from leapnav.experts import Optimum, find_optimum, solve

        assert self.method != "all"
        extremal = find_optimum(scenario) if self.method == "optimum" else solve(scenario, method=self.method)
        doubts = extremal.doubts if isinstance(extremal, Optimum) else ()
        for doubt in doubts:
            print(f"{scenario.name}: a cheaper solution is not certified: J = {doubt.cost:.6g}: {doubt.status.value}")
        print(f"{scenario.name}: {extremal.status.name}: {extremal.status.value}")
        certificate = extremal.certificate
        if certificate is not None:
            conjugate = certificate.conjugate_point
            print(f"  cost               {extremal.cost:.9f}")
            if extremal.problem.has_hard_limits:
                print(f"  barrier            {100 * extremal.barrier:.3f} % of the cost, which excludes it")
            if scenario.horizon is None:
                print(f"  horizon            {extremal.horizon:.6f} s (free)")
                print(f"  d2J/dT2            {certificate.time_curvature:.3g}")
            print(f"  residual           {certificate.residual:.1e}")
            print(f"  defect             {certificate.defect:.1e}")
            print(f"  drift of H         {certificate.hamiltonian_drift:.1e}")
            print(f"  conjugate point    {_describe_conjugate_point(conjugate)}")
            print(f"  clearance          {_describe_clearance(certificate.clearance)}")
            scope = " (of the best candidate only)" if self.method == "optimum" else ""
            print(f"  iterations         {len(extremal.history)}{scope}")
            print(f"  evaluations        {extremal.n_evaluations}{scope}")
        if isinstance(extremal, Optimum) and extremal.success:
            _print_alternatives(extremal)
        self._write(scenario, extremal, extremal.to_dict())
        return 0 if extremal.success and not doubts else FAILED

    @property
    def _is_animated(self) -> bool:
        return self.plot is not None and self.plot.suffix == ".gif"

    def _compare(self, scenario: Scenario) -> int:
        extremals = _solve_by_all_methods(scenario)
        best = min(extremals.values(), key=lambda extremal: (not extremal.success, extremal.cost))
        content = {method: extremal.to_dict() for method, extremal in extremals.items()}
        self._write(scenario, best if best.success else None, content)
        return 0 if best.success else FAILED

    def _write(self, scenario: Scenario, extremal: Extremal | None, content: dict[str, Any]) -> None:
        from leapnav.experts.plotting.animation import animate_extremal
        from leapnav.experts.plotting.extremals import plot_extremal

        write_json(content, self.json)
        if self.plot is not None and extremal is not None and len(extremal.times):
            draw = animate_extremal if self._is_animated else plot_extremal
            draw(extremal, self.plot, scenario)
            print(f"wrote {self.plot}")


def _describe_clearance(clearance: float | None) -> str:
    """Return a clearance in millimetres, or with two digits below that, as close to hard obstacles."""
    if clearance is None:
        return "-"
    return f"{clearance:.3f} m" if abs(clearance) >= 0.01 else f"{clearance:.2g} m"


def _describe_conjugate_point(time: float | None) -> str:
    if time is None:
        return "none"
    return "unknown: the sensitivities diverge" if math.isnan(time) else f"{time:.3f} s"


def _solve_by_all_methods(scenario: Scenario) -> dict[str, Extremal]:
    """Solve by every method from the same initial guess, and print the results side by side."""
    from leapnav.experts import OptimalControlProblem, Status, solve
    from leapnav.experts.problem.certificate import failure
    from leapnav.experts.search.initial_guess import initial_guess
    from leapnav.experts.solve import Method

    problem = OptimalControlProblem.from_scenario(scenario)
    guess = initial_guess(scenario, problem)
    if guess is None:
        print(f"{scenario.name}: {Status.NO_PATH.name}: {Status.NO_PATH.value}")
        return dict.fromkeys(get_args(Method), failure(problem, Status.NO_PATH))
    extremals, seconds = {}, {}
    for method in get_args(Method):
        # The first solve loads or compiles the kernels, so that the second one measures the method alone.
        solve(scenario, method=method, guess=guess[1])
        start = perf_counter()
        extremals[method] = solve(scenario, method=method, guess=guess[1])
        seconds[method] = perf_counter() - start
    print(f"{scenario.name}: every method from the best path of the lattice search, improved by direct transcription")
    _print_comparison(extremals, seconds)
    for method, extremal in extremals.items():
        if not extremal.success:
            print(f"{method}: {extremal.status.value}")
    return extremals


def _print_comparison(extremals: Mapping[str, Extremal], seconds: Mapping[str, float]) -> None:
    from leapnav.envs.utils.tables import print_table

    is_free = any(extremal.problem.horizon is None for extremal in extremals.values())
    rows = []
    for method, extremal in extremals.items():
        certificate = extremal.certificate
        rows.append(
            (
                method,
                extremal.status.name,
                "-" if certificate is None else f"{extremal.cost:.9g}",
                *((f"{extremal.horizon:.6g}",) if is_free else ()),
                "-" if certificate is None else f"{max(certificate.residual, certificate.defect):.1e}",
                str(len(extremal.history)),
                str(extremal.n_evaluations),
                f"{1000 * seconds[method]:.1f}",
            )
        )
    horizon = ("horizon\ns",) if is_free else ()
    columns = ("method", "status", "cost", *horizon, "residual", "iterations", "evaluations", "time\nms")
    print_table(columns, rows, text=2)


def _print_alternatives(optimum: Optimum) -> None:
    from leapnav.envs.utils.tables import print_table

    rows = []
    for extremal in (optimum, *optimum.alternatives):
        clearance = extremal.certificate.clearance if extremal.certificate is not None else None
        rows.append(
            (
                ", ".join(extremal.driving_modes) or "rotate in place",
                "".join(side[0].upper() for side in extremal.path_class) or "-",
                f"{extremal.cost:.6f}",
                f"{100 * (extremal.cost / optimum.cost - 1):.2f} %" if optimum.cost > 0 else "-",
                f"{extremal.heading_winding:+d}" if extremal.heading_winding else "0",
                _describe_clearance(clearance),
            )
        )
    print("Local optima (excess: cost above the optimum; sides: Left or Right of the path, for each obstacle)")
    print_table(("driving", "sides", "cost", "excess", "winding", "clearance"), rows, text=2)
