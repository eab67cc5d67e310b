"""Helpers of several tests: problems and scenarios with known costs, and the stored reference data."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from leapnav.cli import main
from leapnav.envs import NavigateEnv, Scenario
from leapnav.envs.robots.base import MODELS
from leapnav.experts import ControlAffineSystem, OptimalControlProblem, Status, Trajectory
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.search import local_optima
from leapnav.experts.solve import METHODS
from leapnav.training import CloningConfig, make_policy

DATA = Path(__file__).parent / "data"
ROOT = Path(__file__).parents[1]
D3RLPY = ROOT / ".venv" / "examples"  # `make test-all` installs it there
# All built-in robots and solvers.
ROBOTS = tuple(name for name, kind in MODELS.items() if kind.__module__.startswith("leapnav."))
SOLVERS = tuple(METHODS)
QUICK = CloningConfig(epochs=3, batch_size=256, validation_share=0.2)  # a quick fit of low quality
SMALL = (32, 32)  # hidden layers of a small network
DISC_AND_TRIANGLE = Scenario(
    name="a disc and a triangle",
    arena=(0.0, 0.0, 5.0, 5.0),
    start=(0.8, 0.8, 0.3),
    goal=(4.2, 4.0, 1.2),
    horizon=6.5,
    obstacles=(
        {"circle": {"center": (2.6, 2.2), "radius": 0.4}},
        {"polygon": {"vertices": ((1.0, 3.0), (2.0, 3.4), (1.2, 4.2))}},
    ),
)


def run_with_d3rlpy(script: str, words: list[str], folder: Path) -> str:
    """Run a script of the repository in a directory, and return what it prints; skip the test without d3rlpy.

    It is a process of its own, because d3rlpy brings other versions of packages that the tests use.
    """
    if not D3RLPY.exists():
        pytest.skip("d3rlpy is not installed; `make test-all` installs it")
    path = os.pathsep.join(filter(None, [str(D3RLPY), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, str(ROOT / script), *words]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=folder, env={**os.environ, "PYTHONPATH": path}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def best_known() -> list[tuple[Scenario, float]]:
    """Return scenarios with the best known cost of each."""
    entries = json.loads((DATA / "best_known.json").read_text())
    return [(Scenario.from_dict(entry["scenario"]), entry["best_known_cost"]) for entry in entries]


def published_problems() -> dict[str, tuple[OptimalControlProblem, float, str]]:
    """Return published problems by name, with the known cost and the source (data/published_problems.json)."""
    entries = json.loads((DATA / "published_problems.json").read_text())
    return {entry["name"]: (_problem(entry), entry["cost"], entry["source"]) for entry in entries}


class KnownProblem(NamedTuple):
    """A problem of data/known_problems.json with one of the methods that solve it from nothing.

    Attributes:
        name: name of the problem.
        problem: the problem.
        value: the known cost, or the minimum time (s) if the method is `minimum_time`.
        method: a method of `solve`, or "minimum_time".
        is_slow: whether this takes more than 2 s.

    """

    name: str
    problem: OptimalControlProblem
    value: float
    method: str
    is_slow: bool


def known_problems() -> list[KnownProblem]:
    """Return problems with known solutions, once for each method that solves them (data/known_problems.json).

    Each entry has the source of the problem and a second method that confirmed the value. Its field `fails` has the
    status of the methods that do not solve the problem.
    """
    return [
        KnownProblem(
            entry["name"], _problem(entry), entry["time" if "time" in entry else "cost"], method, key == "slow"
        )
        for entry in json.loads((DATA / "known_problems.json").read_text())
        for key in ("methods", "slow")
        for method in entry.get(key, ())
    ]


def _problem(entry: dict) -> OptimalControlProblem:
    symbols = tuple(sp.Symbol(name) for name in entry["state"])
    known = {str(s): s for s in symbols}
    bounds = entry.get("state_bounds")
    system = ControlAffineSystem(
        state=symbols,
        drift=[sp.sympify(e, locals=known) for e in entry["drift"]],
        fields=[[sp.sympify(e, locals=known) for e in column] for column in entry["fields"]],
    )
    return OptimalControlProblem(
        system,
        start=entry["start"],
        goal=entry["goal"],
        horizon=entry["horizon"],
        control_weight=entry["control_weight"],
        state_cost=sp.sympify(entry["state_cost"], locals=known),
        control_bounds=entry.get("control_bounds"),
        time_weight=0.0 if entry["horizon"] is not None else 1.0,
        state_bounds=None if bounds is None else [pair and _interval(*pair) for pair in bounds],
    )


def _interval(low: float | None, high: float | None) -> tuple[float, float]:
    """Return a pair of limits, of which JSON has null for an infinite one."""
    return -math.inf if low is None else low, math.inf if high is None else high


def scenario_fields(**changes: object) -> dict:
    """Return the fields of a valid scenario file, with some of them changed."""
    fields = {
        "name": "small",
        "arena": [0, 0, 10, 10],
        "robot": {"model": "unicycle", "radius": 0.25, "max_speed": 2.0, "max_turn_rate": 3.0},
        "start": [1.0, 1.0, 0.0],
        "goal": [8.0, 8.0, 1.5],
        "horizon": 12.0,
        "obstacles": [
            {"circle": {"center": [4.0, 4.5], "radius": 0.8}},
            {"polygon": {"vertices": [[6.0, 3.0], [7.0, 3.5], [6.5, 5.0]]}},
        ],
        "cost": {"speed_weight": 1.0, "turn_weight": 0.5, "proximity_weight": 1.0, "proximity_scale": 0.1},
    }
    return {**fields, **changes}


def shooting_guess(problem, costate):
    """Return the path of the extremal flow from an initial costate."""
    n = problem.system.n

    def flow(_, z):
        return problem.arrays.rates(z)

    times = np.linspace(0.0, problem.horizon, 65)
    start = np.concatenate([np.asarray(problem.start, dtype=float), costate])
    z = solve_ivp(flow, (0.0, problem.horizon), start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    return Trajectory(times, z[:, :n], z[:, n:])


def fresh(env, seed=0, hidden=SMALL):
    """Return a small untrained policy."""
    return make_policy(env.observation_space, env.action_space, seed, hidden)


def info_of_plan(optimum, scenario):
    """The last info of an episode with the controls of an optimum."""
    env = NavigateEnv(scenario=scenario)
    env.reset()
    info = {}
    for action in plan_actions(optimum, scenario, env.control_period):
        info = env.step(action)[-1]
    return info


def failing(arguments, capsys):
    """Runs a command that must fail: its exit code and its one line on standard error."""
    capsys.readouterr()
    code = main([str(a) for a in arguments])
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines(keepends=True) if not line.startswith("leapnav: compiling")]
    assert "Traceback" not in line
    return code, line


class FastClock:
    """A clock of pygame that does not wait."""

    def tick(self, fps):
        assert fps == 20


@contextmanager
def cluster_that_loses_a_worker(folder: Path, pattern: str) -> Iterator[str]:
    """Provide the address of a Dask cluster with two workers, of which one is killed when a file matches a pattern."""
    from dask.distributed import Client, LocalCluster

    killed = []

    def kill_one(client):
        while not list(folder.glob(pattern)):
            time.sleep(0.01)
        pid = next(iter(client.run(os.getpid).values()))
        os.kill(pid, signal.SIGKILL)
        killed.append(pid)

    with (
        mock.patch.dict(
            os.environ
        ),  # Dask leaves OMP_NUM_THREADS=1, with which later processes compute other last bits
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        killer = threading.Thread(target=kill_one, args=(client,))
        killer.start()
        yield cluster.scheduler_address
        killer.join()
    assert len(killed) == 1


def let_newton_stall(monkeypatch, cost):
    """Let Newton's method stall in the search at extremals of a given cost."""
    polish = local_optima.polish_in_stages

    def stalled(*arguments):
        status, rows, evaluations = polish(*arguments)
        is_it = status is Status.SUCCESS and abs(rows[-1].cost - cost) < 1e-3 * cost
        return (Status.STALLED if is_it else status), rows, evaluations

    monkeypatch.setattr(local_optima, "polish_in_stages", stalled)


def drawn_scenario(env, **arguments):
    """Return the scenario of an episode that `env.reset(**arguments)` starts."""
    env.reset(**arguments)
    return env.unwrapped.scenario
