"""The computations behind the page of `leapnav play`, with results as plain numbers: optima, sweeps, episodes."""

from __future__ import annotations

import threading
import uuid
from collections import OrderedDict
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import FAMILIES
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import check_choice, check_integer
from leapnav.experts.optimum import Optimum, as_optimum, find_optimum, shortest_horizon
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.search.initial_guess import best_path
from leapnav.experts.solve import solve
from leapnav.experts.solvers.feasible_path import dense_path, select_sweeps
from leapnav.play.episodes import Driving, play_policy
from leapnav.play.lessons import LESSONS

OPTIMUM_POINTS, OTHER_POINTS = 201, 101  # of the optimum, and of each alternative and sweep
MAX_STORED = 64  # optima that can be initial guesses of a request
MAX_SWEEPS, FIRST_SWEEPS = 40, 16  # sent to the page; the first ones are sent without omissions


class PlaySolver:
    """Solves the scenarios of the page, one request at a time.

    Args:
        policies: names of the policies that may drive, see `leapnav.training.scoring.policy_specs`.

    """

    def __init__(self, policies: Sequence[str]) -> None:
        self.policies = tuple(policies)
        self._stored: OrderedDict[str, Extremal] = OrderedDict()
        self._lock = threading.Lock()
        self._driving: Driving | None = None

    def follow(self, scenario: Scenario, previous: str | None) -> dict[str, Any]:
        """Return a local optimum while the user drags.

        It is re-solved from a previous one. If that fails, a short search follows.

        Args:
            scenario: the changed scenario.
            previous: `id` of an earlier result, or None.

        """
        with self._lock:
            start = perf_counter()
            guess = self._stored.get(previous or "")
            found = None if guess is None else solve(scenario, method="multiple_shooting", guess=guess)
            if found is not None and found.success:
                return {**self._describe(scenario, found, start), "searched": False}
            found = find_optimum(scenario, "low")
            return {**self._describe(scenario, found, start), "searched": True}

    def search(self, scenario: Scenario) -> dict[str, Any]:
        """Return the optimum and its alternatives, from the full search, with their values over time for the plots.

        If the horizon is too short, `needed_horizon` is the shortest horizon (s) with a certified optimum, or None.
        """
        with self._lock:
            start = perf_counter()
            optimum = find_optimum(scenario)
            result = {**self._describe(scenario, optimum, start), "searched": True}
            result["alternatives"] = [_path(scenario, other, OTHER_POINTS) for other in optimum.alternatives]
            if optimum.status is Status.HORIZON_TOO_SHORT:
                result["needed_horizon"] = shortest_horizon(scenario)
            return result

    def sweeps(self, scenario: Scenario) -> dict[str, Any]:
        """Return Leapfrog's feasible paths to the extremal.

        The first is the best path of the lattice search, or for a robot with further states or among moving obstacles
        the initial guess of `solve`.
        """
        with self._lock:
            has_path = scenario.robot.sizes()[0] == 3 and not scenario.moves
            guess = best_path(scenario) if has_path else None
            extremal = solve(scenario, method="leapfrog", guess=guess, polish=False)
        rows = [row for row in extremal.history if row.times is not None]
        sweeps = []
        for index in select_sweeps(len(rows), FIRST_SWEEPS, MAX_SWEEPS):
            times, nodes = rows[index].times, rows[index].nodes
            assert times is not None and nodes is not None
            _, states = dense_path(extremal.problem, times, nodes, OTHER_POINTS)
            sweeps.append(
                {"index": index, "cost": rows[index].cost, "states": _rows(states), "nodes": _rows(nodes[:, :2])}
            )
        return {"status": extremal.status.name, "advice": extremal.status.value, "sweeps": sweeps}

    def drive(self, scenario: Scenario, policy: str) -> dict[str, Any]:
        """Play an episode of a policy and return its path and regret, see `leapnav.play.episodes`.

        Raises:
            ValueError: the policy is not one of `policies`, or the horizon is too long.

        """
        check_choice("policy", policy, self.policies)
        with self._lock:
            return play_policy(scenario, policy)

    def start_driving(self, scenario: Scenario) -> dict[str, Any]:
        """Start an episode that a person drives, and return its first state, see `Driving`.

        Raises:
            ValueError: the horizon is too long.

        """
        self._driving = Driving(scenario)
        return self._driving.described()

    def driving(self, identity: Any) -> Driving:
        """Return the episode that a person drives.

        Raises:
            ValueError: another one has been started since.

        """
        if self._driving is None or self._driving.id != identity:
            raise ValueError(f"id: there is no such episode, or another one has been started, got {str(identity)[:40]}")
        return self._driving

    def lesson(self, name: str) -> dict[str, Any]:
        """Return the content of a lesson, see `leapnav.play.lessons`; it is computed at the first request.

        Raises:
            ValueError: there is no such lesson.

        """
        check_choice("lesson", name, LESSONS)
        with self._lock:
            return LESSONS[name]()

    def _describe(self, scenario: Scenario, extremal: Extremal, start: float) -> dict[str, Any]:
        """Return the result of a solve, and store it as an initial guess if it is certified."""
        milliseconds = 1000.0 * (perf_counter() - start)
        optimum = extremal if isinstance(extremal, Optimum) else as_optimum(extremal)
        result: dict[str, Any] = {
            "id": None,
            "status": optimum.status.name,
            "advice": optimum.status.value,
            "success": optimum.success,
            "milliseconds": milliseconds,
            "path": None,
            "alternatives": [_summary(other, OTHER_POINTS) for other in optimum.alternatives],
        }
        if len(optimum.times):
            result["path"] = _path(scenario, optimum)
        if optimum.success:
            result["id"] = uuid.uuid4().hex
            self._stored[result["id"]] = optimum
            while len(self._stored) > MAX_STORED:
                self._stored.popitem(last=False)
        return result


def bank_scenario(family: str, index: int) -> Scenario:
    """Return a scenario of a family's test bank.

    Raises:
        ValueError: the family is unknown, or the index is out of range.

    """
    check_choice("family", family, FAMILIES)  # a request must not import a module
    bank = ScenarioBank.shipped(family, "test")
    return bank[check_integer("index", index, 0, len(bank) - 1)]


def _path(scenario: Scenario, optimum: Optimum, points: int = OPTIMUM_POINTS) -> dict[str, Any]:
    """A local optimum over time, for the plots."""
    times = np.linspace(0.0, optimum.horizon, points)
    _, controls, costates = optimum.evaluate(times)
    costates = costates[:, : len(scenario.robot.state_names)]  # without that of the time
    certificate = optimum.certificate
    return {
        **_summary(optimum, points),
        "times": np.round(times, 6).tolist(),
        "controls": _rows(controls),
        "costates": _rows(costates),
        "hamiltonian": np.interp(times, optimum.times, optimum.hamiltonian).tolist(),
        "clearances": np.round(_clearances(scenario, optimum.interpolate(times)), 6).tolist(),
        "residual": None if certificate is None else max(certificate.residual, certificate.defect),
    }


def _clearances(scenario: Scenario, values: np.ndarray) -> np.ndarray:
    """Return the clearance (m) of the robot at states and costates (N, 2n)."""
    return footprint_clearances(values, scenario.outline, scenario.field)


def _summary(optimum: Optimum, points: int) -> dict[str, Any]:
    n = optimum.problem.system.n - (optimum.problem.clock >= 0)
    states = optimum.interpolate(np.linspace(0.0, optimum.horizon, points))[:, :n]
    certificate = optimum.certificate
    return {
        "cost": optimum.cost,
        "barrier": optimum.barrier,
        "states": _rows(states),
        "driving": list(optimum.driving_modes),
        "sides": "".join(side[0].upper() for side in optimum.path_class),
        "clearance": None if certificate is None else certificate.clearance,
    }


def _rows(array: np.ndarray) -> list[list[float]]:
    return np.round(array, 6).tolist()
