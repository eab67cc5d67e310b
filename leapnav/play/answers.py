"""What the page asks for, as plain numbers: optima, sweeps of Leapfrog, and the way that a policy takes."""

from __future__ import annotations

import threading
import uuid
from collections import OrderedDict
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import check_family
from leapnav.envs.obstacles import clearances
from leapnav.envs.scenario import Scenario
from leapnav.experts.extremal import Extremal
from leapnav.experts.feasible_path import dense_path, telling_sweeps
from leapnav.experts.methods import solve
from leapnav.experts.optimum import Optimum, as_optimum, find_optimum

POINTS, POINTS_OF_OTHERS = 201, 101  # of the optimum, and of each alternative and sweep
KEPT = 64  # optima that a page may go on from
LONGEST_DRIVE = 300.0  # s
CANDIDATES = 6  # of a search while the user drags
MOST_SWEEPS, FIRST_SWEEPS = 40, 16


class Answers:
    """Answers the page's questions, one at a time; what it solved last is where it starts from next.

    Args:
        policies: names of policies that may drive, see `leapnav.training.entrants.make_entrant`.

    """

    def __init__(self, policies: Sequence[str]) -> None:
        self.policies = tuple(policies)
        self._solved: OrderedDict[str, Extremal] = OrderedDict()
        self._lock = threading.Lock()

    def follow(self, scenario: Scenario, before: str | None) -> dict[str, Any]:
        """The optimum while the user drags: from the one before, or where that is lost by a short search."""
        with self._lock:
            start = perf_counter()
            guess = self._solved.get(before or "")
            found = None if guess is None else solve(scenario, method="multiple_shooting", guess=guess)
            if found is not None and found.success:
                return {**self._describe(scenario, found, start), "searched": False}
            found = find_optimum(scenario, CANDIDATES, thorough=False)
            return {**self._describe(scenario, found, start), "searched": True}

    def search(self, scenario: Scenario) -> dict[str, Any]:
        """The optimum with its alternatives, by the whole search."""
        with self._lock:
            start = perf_counter()
            return {**self._describe(scenario, find_optimum(scenario), start), "searched": True}

    def sweeps(self, scenario: Scenario) -> dict[str, Any]:
        """Leapfrog's feasible paths, from the best path of the lattice search to the extremal."""
        with self._lock:
            extremal = solve(scenario, method="leapfrog", polish=False)
        rows = [row for row in extremal.history if row.times is not None]
        sweeps = []
        for number in telling_sweeps(len(rows), FIRST_SWEEPS, MOST_SWEEPS):
            times, nodes = rows[number].times, rows[number].nodes
            assert times is not None and nodes is not None
            _, states = dense_path(extremal.problem, times, nodes, POINTS_OF_OTHERS)
            sweeps.append(
                {"number": number, "cost": rows[number].cost, "states": _rows(states), "nodes": _rows(nodes[:, :2])}
            )
        return {"status": extremal.status.name, "advice": extremal.status.value, "sweeps": sweeps}

    def drive(self, scenario: Scenario, policy: str) -> dict[str, Any]:
        """The way that a policy takes.

        Raises:
            ValueError: it is none of those that may drive, or the horizon is too long.

        """
        from leapnav.envs.navigation import NavigateEnv
        from leapnav.training.entrants import BASELINES, make_entrant
        from leapnav.training.policies import policy_environment

        if policy not in self.policies:
            raise ValueError(f"policy: expected one of {', '.join(self.policies) or 'none'}, got {policy!r}")
        if scenario.horizon > LONGEST_DRIVE:
            raise ValueError(f"horizon: here a policy drives for at most {LONGEST_DRIVE:g} s, got {scenario.horizon:g}")
        with self._lock:
            env = NavigateEnv(scenario=scenario, **({} if policy in BASELINES else policy_environment(policy)))
            driver = make_entrant(policy, env)
            observation, info = env.reset(seed=0)
            states, state, start, done = [_pose(info)], None, True, False
            while not done:
                action, state = driver.predict(observation, state, np.array([start]), deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                states.append(_pose(info))
                start, done = False, terminated or truncated
            env.close()
        return {
            "policy": policy,
            "states": states,
            "period": env.settings.control_period,
            "success": bool(info["is_success"]),
            "collision": bool(info["collision"]),
            "cost": float(info["cost"]),
        }

    def _describe(self, scenario: Scenario, extremal: Extremal, start: float) -> dict[str, Any]:
        milliseconds = 1000.0 * (perf_counter() - start)
        optimum = extremal if isinstance(extremal, Optimum) else as_optimum(extremal)
        answer: dict[str, Any] = {
            "id": None,
            "status": optimum.status.name,
            "advice": optimum.status.value,
            "success": optimum.success,
            "milliseconds": milliseconds,
            "path": None,
            "alternatives": [_summary(scenario, other, POINTS_OF_OTHERS) for other in optimum.alternatives],
        }
        if len(optimum.times):
            answer["path"] = _path(scenario, optimum)
        if optimum.success:
            answer["id"] = uuid.uuid4().hex
            self._solved[answer["id"]] = optimum
            while len(self._solved) > KEPT:
                self._solved.popitem(last=False)
        return answer


def banked(family: str, index: int) -> Scenario:
    """A scenario of a family's test bank, by its number.

    Raises:
        ValueError: there is no such family or number.

    """
    check_family(family)
    bank = ScenarioBank.shipped(family, "test")
    if not 0 <= index < len(bank):
        raise ValueError(f"index: expected 0 to {len(bank) - 1}, got {index}")
    return bank[index]


def _path(scenario: Scenario, optimum: Optimum) -> dict[str, Any]:
    """The optimum over time."""
    times = np.linspace(0.0, optimum.problem.horizon, POINTS)
    _, controls, costates = optimum.evaluate(times)
    summary = _summary(scenario, optimum, POINTS)
    certificate = optimum.certificate
    return {
        **summary,
        "times": np.round(times, 6).tolist(),
        "controls": _rows(controls),
        "costates": _rows(costates),
        "hamiltonian": np.interp(times, optimum.times, optimum.hamiltonian).tolist(),
        "along": np.round(clearances(optimum.interpolate(times)[:, :2], scenario.field), 6).tolist(),
        "residual": None if certificate is None else max(certificate.residual, certificate.defect),
        "conjugate_point": None if certificate is None else certificate.conjugate_point,
    }


def _summary(scenario: Scenario, optimum: Optimum, points: int) -> dict[str, Any]:
    states = optimum.interpolate(np.linspace(0.0, optimum.problem.horizon, points))[:, :3]
    certificate = optimum.certificate
    return {
        "cost": optimum.cost,
        "states": _rows(states),
        "driving": list(optimum.driving_modes),
        "sides": "".join(side[0].upper() for side in optimum.path_class),
        "clearance": None if certificate is None else certificate.clearance,
    }


def _pose(info: dict[str, Any]) -> list[float]:
    return [float(value) for value in info["pose"]]


def _rows(array: np.ndarray) -> list[list[float]]:
    return np.round(array, 6).tolist()
