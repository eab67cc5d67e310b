"""What several tests share: the lists that general tests run over, and the stored reference data."""

import json
from pathlib import Path

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp

from leapnav.envs import Scenario
from leapnav.experts import ControlAffineSystem, OptimalControlProblem
from leapnav.experts import Path as Guess
from leapnav.training import CloningConfig, make_policy

DATA = Path(__file__).parent / "data"
QUICK = CloningConfig(epochs=3, batch_size=256, validation_share=0.2)  # a fit that is not to be good
SMALL = (32, 32)  # a network, too


def best_known() -> list[tuple[Scenario, float]]:
    """Scenarios with the best cost known for each."""
    entries = json.loads((DATA / "best_known.json").read_text())
    return [(Scenario.from_dict(entry["scenario"]), entry["best_known_cost"]) for entry in entries]


def published_problems() -> dict[str, tuple[OptimalControlProblem, float, str]]:
    """Published problems by name, with the known cost and the source (file: data/published_problems.json)."""
    problems = {}
    for entry in json.loads((DATA / "published_problems.json").read_text()):
        symbols = tuple(sp.Symbol(name) for name in entry["state"])
        known = {str(s): s for s in symbols}
        system = ControlAffineSystem(
            state=symbols,
            drift=[sp.sympify(e, locals=known) for e in entry["drift"]],
            fields=[[sp.sympify(e, locals=known) for e in column] for column in entry["fields"]],
        )
        problem = OptimalControlProblem(
            system,
            start=entry["start"],
            goal=entry["goal"],
            horizon=entry["horizon"],
            control_weight=entry["control_weight"],
            state_cost=sp.sympify(entry["state_cost"], locals=known),
        )
        problems[entry["name"]] = problem, entry["cost"], entry["source"]
    return problems


def scenario_fields(**changes: object) -> dict:
    """A valid scenario as its file has it, with some fields changed."""
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
    """The path that the flow draws from an initial costate."""
    n = problem.system.n

    def flow(_, z):
        dz, empty = np.empty(2 * n), np.empty((2 * n, 0))
        problem.arrays.flow(z, problem.arrays.data, problem.arrays.field, empty, dz, empty)
        return dz

    times = np.linspace(0.0, problem.horizon, 65)
    start = np.concatenate([np.asarray(problem.start, dtype=float), costate])
    z = solve_ivp(flow, (0.0, problem.horizon), start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    return Guess(times, z[:, :n], z[:, n:])


def fresh(env, seed=0, hidden=SMALL):
    """A small policy that has learned nothing."""
    return make_policy(env.observation_space, env.action_space, seed, hidden)
